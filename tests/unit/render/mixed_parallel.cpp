// What the loop over bricks in order does first.
#include "catch.hpp"

#include <dfb/render/mixed_parallel.hpp>

#include <utility>
#include <vector>

namespace mixed_parallel_cases {

TEST_CASE("Fronts come first, and all else in the order that it had", "[mixed]")
{
    // In tiles 0 to 3 bricks 0 to 2 are behind each other, in tile 4 is brick 2 alone.
    dfb::detail::OrderedWork work;
    for (int tile = 0; tile < 5; ++tile) {
        work.firstPair.push_back(static_cast<int>(work.pairs.size()));
        for (int brick = tile == 4 ? 2 : 0; brick < 3; ++brick)
            work.pairs.push_back({brick, tile});
    }
    // A rank has bricks 1 and 2, and what is in front in tile 1 as well; two passes of tile 3.
    for (std::size_t p = 0; p < work.pairs.size(); ++p)
        if (work.pairs[p].brick > 0 || work.pairs[p].tile == 1)
            for (int pass = 0; pass < (work.pairs[p].tile == 3 ? 2 : 1); ++pass)
                work.jobs.push_back({p, pass});

    work.renderFrontsFirst();

    using Order = std::vector<std::vector<int>>; // tile, brick, pass
    Order order;
    for (const auto& job : work.jobs)
        order.push_back({work.pairs[job.item].tile, work.pairs[job.item].brick, job.pass});
    CHECK(order
          == Order{{1, 0, 0},
                   {4, 2, 0}, // these two are fronts
                   {0, 1, 0},
                   {0, 2, 0},
                   {1, 1, 0},
                   {1, 2, 0},
                   {2, 1, 0},
                   {2, 2, 0},
                   {3, 1, 0},
                   {3, 1, 1},
                   {3, 2, 0},
                   {3, 2, 1}});
    CHECK(work.generationOf(work.jobs[1]) == 0);
    CHECK(work.generationOf(work.jobs[5]) == 2);
}

} // namespace mixed_parallel_cases
