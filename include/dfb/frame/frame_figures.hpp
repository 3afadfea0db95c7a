// FrameFigures: numbers of one rank that all ranks get to know with the frame's verdict.
#pragma once

#include <dfb/frame/verdict.hpp>

#include <algorithm>
#include <cstdint>
#include <mutex>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// All members may be called from any thread.
class FrameFigures {
public:
    void newFrame()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        figures_.clear();
        mergeErrors_.clear();
    }

    // See Frame::addFigure().
    void add(std::uint64_t key, double value)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        figures_.push_back({key, value});
    }

    // An input of that tile may be off by so much.
    void addMergeError(int tile, double bound)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        mergeErrors_.push_back({static_cast<std::uint64_t>(tile), bound});
    }

    // Of the tiles that this rank has finished: what their operation says.
    static std::vector<Figure> of(const std::vector<TileError>& errors)
    {
        std::vector<Figure> figures;
        for (const TileError& e : errors)
            figures.push_back({static_cast<std::uint64_t>(e.tile), e.error});
        return sums(std::move(figures));
    }

    void addTo(Verdict& verdict) const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        verdict.figures = sums(figures_);
        verdict.mergeErrors = sums(mergeErrors_);
    }

private:
    // One per key. Of values of one key, too, the order must not be that of the threads: they are added.
    static std::vector<Figure> sums(std::vector<Figure> figures)
    {
        std::sort(figures.begin(), figures.end(),
                  [](const Figure& a, const Figure& b) { return a.key != b.key ? a.key < b.key : a.value < b.value; });
        return Verdict::summed(std::move(figures));
    }

    mutable std::mutex mutex_;
    std::vector<Figure> figures_, mergeErrors_; // by key, by tile
};

} // namespace detail
DFB_NAMESPACE_END
