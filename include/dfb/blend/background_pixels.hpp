// BackgroundPixels: which pixels of a tile already show the background in the image, and need not be written again.
#pragma once

#include <dfb/base/cpu.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// One per tile; used by one thread at a time.
class BackgroundPixels {
public:
    // Call it for each frame in which the tile is written. While `epoch` stays the same, the pixels of the last frame
    // are still there, and the background is stored as the same value. With epoch 0 the pixels may hold anything.
    void newFrame(int width, int height, std::int64_t epoch)
    {
        if (epoch != 0 && epoch == epoch_)
            return;
        epoch_ = epoch;
        wordsPerRow_ = static_cast<std::size_t>(width + 63) / 64;
        bits_.assign(epoch == 0 ? 0 : wordsPerRow_ * static_cast<std::size_t>(height), 0);
    }

    // Pixels [x, x + count) of row y are overwritten by something other than background.
    void remove(int x, int y, int count)
    {
        if (bits_.empty())
            return;
        forEachWord(x, y, count, [](std::uint64_t& known, std::uint64_t range, int) { known &= ~range; });
    }

    // Pixels [x, x + count) of row y become the background. Calls write(x, count) for each run of those that are not
    // background yet.
    template <class Write>
    void add(int x, int y, int count, const Write& write)
    {
        if (bits_.empty()) {
            if (count > 0)
                write(x, count);
            return;
        }
        int begin = 0, end = 0; // a run that may go on in the next word
        forEachWord(x, y, count, [&](std::uint64_t& known, std::uint64_t range, int first) {
            const std::uint64_t missing = range & ~known;
            known |= range;
            forEachRun(missing, [&](int at, int run) {
                if (first + at != end) {
                    if (end > begin)
                        write(begin, end - begin);
                    begin = first + at;
                }
                end = first + at + run;
            });
        });
        if (end > begin)
            write(begin, end - begin);
    }

private:
    // Calls f(word, bits of the range in it, x of its first bit).
    template <class F>
    void forEachWord(int x, int y, int count, const F& f)
    {
        const int end = x + count;
        std::uint64_t* row = bits_.data() + wordsPerRow_ * static_cast<std::size_t>(y);
        for (int first = x / 64 * 64; first < end; first += 64) {
            const int low = std::max(x, first) - first, high = std::min(end, first + 64) - first;
            f(row[first / 64], ~std::uint64_t{0} << low & ~std::uint64_t{0} >> (64 - high), first);
        }
    }

    std::int64_t epoch_ = 0;
    std::size_t wordsPerRow_ = 0;
    std::vector<std::uint64_t> bits_; // row by row; empty: nothing is known
};

} // namespace detail
DFB_NAMESPACE_END
