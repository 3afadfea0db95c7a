// BackgroundPixels: which pixels of a tile already show the background in the image, and need not be written again.
#pragma once

#include <dfb/base/cpu.hpp>

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
        std::uint64_t* const row = rowOf(y);
        forEachWord(x, x + count, [&](std::size_t word, std::uint64_t range) { row[word] &= ~range; });
    }

    // Pixels [x, x + count) of row y become the background; count > 0. Calls write(x, count) for each run of those
    // that are not background yet.
    template <class Write>
    void add(int x, int y, int count, const Write& write)
    {
        if (bits_.empty()) {
            write(x, count);
            return;
        }
        int begin = 0, end = 0; // a run that may go on in the next word
        std::uint64_t* const row = rowOf(y);
        forEachWord(x, x + count, [&](std::size_t word, std::uint64_t range) {
            const std::uint64_t missing = range & ~row[word];
            row[word] |= range;
            forEachRun(missing, [&](int at, int run) {
                const int first = 64 * static_cast<int>(word) + at;
                if (first != end) {
                    if (end > begin)
                        write(begin, end - begin);
                    begin = first;
                }
                end = first + run;
            });
        });
        if (end > begin)
            write(begin, end - begin);
    }

private:
    std::uint64_t* rowOf(int y) { return bits_.data() + wordsPerRow_ * static_cast<std::size_t>(y); }

    std::int64_t epoch_ = 0;
    std::size_t wordsPerRow_ = 0;
    std::vector<std::uint64_t> bits_; // row by row; empty: nothing is known
};

} // namespace detail
DFB_NAMESPACE_END
