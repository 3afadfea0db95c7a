#include "catch.hpp"

#include <dfb/frame/job_share.hpp>

#include <optional>

namespace job_share_cases {

using dfb::detail::JobShare;

TEST_CASE("A rank asks for more jobs when one is left, and keeps none from others before", "[jobs]")
{
    JobShare share;
    share.newFrame();
    // 16 jobs for 2 ranks: 8 are shared out beforehand, of which rank 1 has the second half.
    const auto take = [&](std::optional<int> job, bool asks) {
        bool hasAsked = !asks;
        const bool isReady = share.ready();
        CHECK(share.take(16, 1, 2, hasAsked) == job);
        CHECK(hasAsked == asks);
        CHECK((isReady || !job || *job == 4)); // the first take() shares out
    };
    take(4, false);
    take(5, false);
    take(6, true);
    take(7, false);
    take(std::nullopt, false);
    CHECK(!share.ready());
    share.receive({10, 13});
    take(10, false);
    take(11, true);
    share.receive({14, 15});
    take(12, false);
    take(14, true);
    share.receive({16, 16}); // no more
    take(-1, false);
    take(-1, false);
    CHECK(share.ready());
}

TEST_CASE("Shares of jobs shrink with the work that is left, and no job is handed out twice", "[jobs]")
{
    JobShare share;
    share.newFrame();
    std::int64_t next = 50, last = 50;
    for (;;) {
        const auto range = share.give({100, 2, 0}, 0, 2);
        CHECK(range.begin == next);
        CHECK(range.count() <= last);
        if (range.count() == 0)
            break;
        CHECK((range.count() >= 2 || range.end == 100)); // at least one for each worker
        last = range.count();
        next = range.end;
    }
    CHECK(next == 100);
}

} // namespace job_share_cases
