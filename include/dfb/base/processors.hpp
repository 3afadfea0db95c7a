// Processors: the set of processors that a thread may run on, as plain bytes that can be sent. Processors numbered
// `limit` and above are left out.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <bitset>
#include <cstddef>
#include <thread>
#include <type_traits>

#if defined(__linux__)
#include <sched.h>
#endif

DFB_NAMESPACE_BEGIN

class Processors {
public:
    static constexpr int limit = 1024;

    // The CPU mask of the calling thread, which threads that it starts inherit. If the mask cannot be queried, it is
    // all processors of the machine. Never empty.
    static Processors ofThisThread() noexcept
    {
        Processors found;
#if defined(__linux__)
        cpu_set_t mask;
        if (sched_getaffinity(0, sizeof mask, &mask) == 0)
            for (int i = 0; i < std::min<int>(limit, CPU_SETSIZE); ++i)
                if (CPU_ISSET(static_cast<unsigned>(i), &mask))
                    found.add(i);
#endif
        if (found.count() == 0)
            for (int i = 0; i < std::clamp(static_cast<int>(std::thread::hardware_concurrency()), 1, limit); ++i)
                found.add(i);
        return found;
    }

    // `processor`: 0 to limit - 1.
    void add(int processor) noexcept { set_[static_cast<std::size_t>(processor)] = true; }

    int count() const noexcept { return static_cast<int>(set_.count()); }

    // Whether any processor is in both sets.
    bool meets(const Processors& other) const noexcept { return (set_ & other.set_).any(); }

private:
    std::bitset<limit> set_;
};
static_assert(std::is_trivially_copyable_v<Processors> && sizeof(Processors) == Processors::limit / 8);

// How many threads each of `ranks` ranks should have if they share `processors` processors: an equal part, at least 1.
inline int threadShare(int processors, int ranks) noexcept { return std::max(1, processors / std::max(1, ranks)); }

DFB_NAMESPACE_END
