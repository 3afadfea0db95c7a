// Runs the cases of tests/algorithms with ranks in this process.
#pragma once

#include "../algorithms/everywhere.hpp"

#include <future>
#include <vector>

// With all numbers of ranks at once, for a case that mostly waits; one after the other under ThreadSanitizer, with
// which it mostly computes.
template <class Case>
void everywhereAtOnce()
{
    auto how = std::launch::async;
#if defined(__has_feature)
#if __has_feature(thread_sanitizer)
    how = std::launch::deferred;
#endif
#endif
    const std::vector<int> counts{1, 2, 3, 4, 7};
    std::vector<std::future<algorithms::Result>> results;
    for (const int ranks : counts)
        results.push_back(std::async(how, algorithms::inProcess<Case>, ranks));
    std::uint64_t hash = 0; // with one rank
    for (std::size_t i = 0; i < counts.size(); ++i) {
        const algorithms::Result result = results[i].get();
        if (i == 0)
            hash = result.hash;
        INFO(counts[i] << " ranks");
        CHECK(result.wrong == "");
        CHECK(result.hash == hash);
    }
}

template <class Case>
void everywhere()
{
    const algorithms::Result one = algorithms::inProcess<Case>(1);
    CHECK(one.wrong == "");
    for (const int ranks : {2, 3, 4, 7}) {
        const algorithms::Result result = algorithms::inProcess<Case>(ranks);
        INFO(ranks << " ranks");
        CHECK(result.wrong == "");
        CHECK(result.hash == one.hash);
    }
}
