// What the rendering loops have in common: tiles to render into, a job per tile and pass on all workers, and a
// frame in which a renderer may throw. inPlace(): for renderers that have their pixels already.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

namespace dfb {

// See inPlace().
template <class Find>
struct InPlace {
    Find find;

    template <class... Arguments>
    decltype(auto) operator()(Arguments&&... arguments) const
    {
        return find(std::forward<Arguments>(arguments)...);
    }
};

// For any loop in place of what renders, where the pixels are there already, as in an image that a rank has made by
// itself: `find` gets a TileView in place of a Tile, and says where the pixels of view.region are. Nothing is copied
// into a tile.
template <class Find>
InPlace<Find> inPlace(Find find)
{
    return {std::move(find)};
}

namespace detail {

// What a loop hands to a renderer.
template <class FrameBuffer, class Render>
struct TileOf {
    using Type = typename FrameBuffer::Tile;
};
template <class FrameBuffer, class Find>
struct TileOf<FrameBuffer, InPlace<Find>> {
    using Type = typename FrameBuffer::TileView;
};

// A job for each pass of each of some items, numbered item by item.
class PassJobs {
public:
    // `passesOf(item)`: how many passes an item has.
    template <class PassesOf>
    void find(std::size_t itemCount, const PassesOf& passesOf)
    {
        count_ = 0;
        passes_ = itemCount > 0 ? passesOf(0) : 1;
        firstJob_.clear();
        bool alike = true;
        for (std::size_t i = 0; i < itemCount; ++i) {
            const int passes = passesOf(i);
            alike = alike && passes == passes_;
            count_ += passes;
        }
        if (alike)
            return;
        firstJob_.resize(itemCount + 1, 0);
        for (std::size_t i = 0; i < itemCount; ++i)
            firstJob_[i + 1] = firstJob_[i] + passesOf(i);
    }

    std::int64_t count() const noexcept { return count_; }

    struct Job {
        std::size_t item = 0;
        int pass = 0;
    };
    Job at(std::int64_t job) const
    {
        if (firstJob_.empty())
            return {static_cast<std::size_t>(job / passes_), static_cast<int>(job % passes_)};
        const auto next = std::upper_bound(firstJob_.begin(), firstJob_.end(), job);
        const auto item = static_cast<std::size_t>(next - firstJob_.begin()) - 1;
        return {item, static_cast<int>(job - firstJob_[item])};
    }

private:
    int passes_ = 1; // of the first item
    std::int64_t count_ = 0;
    std::vector<std::int64_t> firstJob_; // of each item, unless all have equally many passes
};

// Calls job(i, tile) for i in [0, count) on the framebuffer's executor, each with a tile of its own, of the kind that
// `Render` wants. An exception of a job makes the frame fail on all ranks; then no further job is begun.
template <class Render, class FrameBuffer, class Job>
void forEachTile(FrameBuffer& fb, typename FrameBuffer::Frame& frame, std::int64_t count, const Job& job)
{
    using Tile = typename TileOf<FrameBuffer, Render>::Type;
    frame.guard([&] {
        fb.executor().parallelFor(static_cast<std::size_t>(count), [&](std::size_t i) {
            if (frame.failed())
                return;
            // Each thread keeps one, out of which it is taken, as a renderer that waits inside a job may be given
            // another job on the same thread.
            static thread_local std::unique_ptr<Tile> spare;
            std::unique_ptr<Tile> tile = std::move(spare);
            if (!tile)
                tile.reset(new Tile); // start() clears it
            tile->tile = -1;
            frame.guard([&] { job(static_cast<std::int64_t>(i), *tile); }, *tile); // the frame may do without that one
            spare = std::move(tile);
        });
    });
}

} // namespace detail

} // namespace dfb
