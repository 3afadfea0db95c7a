// TileLoop: what the rendering loops have in common: tiles to render into, a job per tile and pass on all
// workers, and a frame in which a renderer may throw. inPlace(): for renderers that have their pixels already.
#pragma once

#include <algorithm>
#include <any>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
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

// What find() gives: called once for each declaration of inputs, not in the frames that go by the last one.
template <class Frame, class Find>
const auto& foundOnce(const Frame& frame, const Find& find)
{
    struct Found { // a type for each place that this is called at: loops do not take each other's
        decltype(find()) value;
    };
    auto* found = std::any_cast<std::shared_ptr<Found>>(&frame.declaredFrom());
    if (!found)
        found = &frame.declaredFrom().template emplace<std::shared_ptr<Found>>(new Found{find()});
    return (*found)->value;
}

// A job for each pass of each of some items, numbered item by item.
class PassJobs {
public:
    // `passesOf(item)`: how many passes an item has.
    template <class PassesOf>
    PassJobs(std::size_t itemCount, const PassesOf& passesOf) : firstJob_(itemCount + 1, 0)
    {
        for (std::size_t i = 0; i < itemCount; ++i)
            firstJob_[i + 1] = firstJob_[i] + passesOf(i);
    }

    std::int64_t count() const noexcept { return firstJob_.back(); }

    struct Job {
        std::size_t item = 0;
        int pass = 0;
    };
    Job at(std::int64_t job) const
    {
        const auto next = std::upper_bound(firstJob_.begin(), firstJob_.end(), job);
        const auto item = static_cast<std::size_t>(next - firstJob_.begin()) - 1;
        return {item, static_cast<int>(job - firstJob_[item])};
    }

private:
    std::vector<std::int64_t> firstJob_;
};

// An exception of a job makes the frame fail on all ranks; then no further job is begun. Lives as long as the frame is
// rendered, on the thread that began it.
template <class FrameBuffer, class Render>
class TileLoop {
    using Tile = typename TileOf<FrameBuffer, Render>::Type;

public:
    TileLoop(FrameBuffer& fb, typename FrameBuffer::Frame& frame) : fb_(fb), frame_(frame) {}

    // Calls job(i, tile) for i in [0, count) on the framebuffer's executor, each with a tile of its own.
    template <class Job>
    void run(std::size_t count, const Job& job)
    {
        guard([&] {
            fb_.executor().parallelFor(count, [&](std::size_t i) {
                if (frame_.failed())
                    return;
                // Not one per thread: a renderer that waits inside a job may be given another job on the same thread.
                std::unique_ptr<Tile> tile = take();
                guard([&] { job(i, *tile); }); // the frame may do without that one
                const std::lock_guard<std::mutex> lock(mutex_);
                spare_.push_back(std::move(tile));
            });
        });
    }

    // Calls body(); what it throws makes the frame fail.
    template <class Body>
    void guard(const Body& body)
    {
        try {
            body();
        } catch (...) {
            frame_.abort(std::current_exception());
        }
    }

private:
    std::unique_ptr<Tile> take()
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (!spare_.empty()) {
                std::unique_ptr<Tile> tile = std::move(spare_.back());
                spare_.pop_back();
                return tile;
            }
        }
        return std::unique_ptr<Tile>(new Tile); // start() clears it
    }

    FrameBuffer& fb_;
    typename FrameBuffer::Frame& frame_;
    std::mutex mutex_;
    std::vector<std::unique_ptr<Tile>> spare_; // under mutex_
};

} // namespace detail

} // namespace dfb
