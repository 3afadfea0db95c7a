// Runs the cases of everywhere.hpp on 1, 2, 3, 4 and 7 ranks in this process; in brief, on 1 and 4.
#include "brief.hpp"
#include "everywhere.hpp"
#include "undisturbed.hpp"

#include <cstddef>
#include <future>
#include <vector>

void frame_cases::runEverywhere(Run run, bool atOnce)
{
#if defined(__has_feature)
#if __has_feature(thread_sanitizer)
    atOnce = false; // with it, a case that mostly waits mostly computes instead
#endif
#endif
    const std::vector<int> counts = isBrief() ? std::vector<int>{1, 4} : std::vector<int>{1, 2, 3, 4, 7};
    const auto again = [](bool stoodStill, const auto& result) { return stoodStill && !result.get().wrong.empty(); };
    std::vector<std::future<Result>> results;
    for (const int ranks : counts)
        results.push_back(std::async(atOnce ? std::launch::async : std::launch::deferred,
                                     [=] { return undisturbed([=] { return inProcess(run, ranks); }, again); }));
    std::uint64_t hash = 0; // of the first run
    for (std::size_t i = 0; i < counts.size(); ++i) {
        const Result result = results[i].get();
        if (i == 0)
            hash = result.hash;
        INFO(counts[i] << " ranks");
        CHECK(result.wrong == "");
        CHECK(result.hash == hash);
    }
}
