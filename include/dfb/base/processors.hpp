// Processors: those that a thread may run on, and how many threads each of the ranks should have that share them.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <thread>

#if defined(__linux__)
#include <sched.h>
#endif

namespace dfb {

// A set, as plain bytes that can be sent. Those from `limit` on are left out.
class Processors {
public:
    static constexpr int limit = 1024;

    // The CPU mask of the calling thread, which the threads that it starts inherit; where that can not be asked for,
    // all that the machine has. Never empty.
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
    void add(int processor) noexcept
    {
        words_[static_cast<std::size_t>(processor) / 64] |= std::uint64_t{1} << (processor % 64);
    }

    int count() const noexcept
    {
        int count = 0;
        for (std::uint64_t word : words_)
            for (; word != 0; word &= word - 1)
                ++count;
        return count;
    }

    // Whether any is in both.
    bool meets(const Processors& other) const noexcept
    {
        for (std::size_t i = 0; i < words_.size(); ++i)
            if (words_[i] & other.words_[i])
                return true;
        return false;
    }

private:
    std::array<std::uint64_t, limit / 64> words_{};
};

// How many threads each of `ranks` should have that share so many processors: an equal part, at least 1.
inline int threadShare(int processors, int ranks) noexcept { return std::max(1, processors / std::max(1, ranks)); }

} // namespace dfb
