// The plain rendering loops: ImageParallelLoop, where all ranks have the scene, and DataParallelLoop, where each has
// bricks of it. A loop gives each tile to a renderer, on all workers; the renderer may throw.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/frame.hpp>
#include <dfb/framebuffer_base.hpp>
#include <dfb/render/link_owners.hpp>
#include <dfb/render/shared_world.hpp>
#include <dfb/render/visibility.hpp>
#include <dfb/render/world.hpp>
#include <dfb/tile.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <numeric>
#include <optional>
#include <type_traits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

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

// Makes a renderer, for any loop except DeepParallelLoop, from pixels that exist already, such as a rank's own image.
// find(brick, view), or find(view) for ImageParallelLoop, points the planes of a TileView to the pixels of view.region;
// a view left without colour is empty. Several threads call it at once. Pixels are copied before find() is called again
// on the same thread, so it may reuse their memory, unless it sets staysUntilEnd.
template <class Find>
InPlace<Find> inPlace(Find find)
{
    return {std::move(find)};
}

namespace detail {

template <class Render>
inline constexpr bool is_in_place_v = false;
template <class Find>
inline constexpr bool is_in_place_v<InPlace<Find>> = true;

// The tile that a loop hands to a renderer.
template <class FrameBuffer, class Render>
using TileFor = std::conditional_t<is_in_place_v<Render>, typename FrameBuffer::TileView, typename FrameBuffer::Tile>;

// A pass of an item, such as a pair of brick and tile.
struct Job {
    std::size_t item = 0;
    int pass = 0;
};

// Makes a job of each pass of some items. Jobs are numbered item by item.
class PassJobs {
public:
    // `passesOf(item)`: how many passes an item has.
    void find(std::size_t itemCount, FunctionRef<int(std::size_t)> passesOf)
    {
        firstJob_.assign(1, 0);
        for (std::size_t i = 0; i < itemCount; ++i)
            firstJob_.push_back(firstJob_.back() + passesOf(i));
    }

    std::int64_t count() const noexcept { return firstJob_.back(); }

    Job at(std::int64_t job) const
    {
        const auto next = std::upper_bound(firstJob_.begin(), firstJob_.end(), job);
        const auto item = static_cast<std::size_t>(next - firstJob_.begin()) - 1;
        return {item, static_cast<int>(job - firstJob_[item])};
    }

private:
    std::vector<std::int64_t> firstJob_{0}; // the first job of each item; at the end, the number of jobs
};

// Returns a stride whose multiples, modulo `count`, are all numbers below `count`. Consecutive multiples are spread
// evenly over the image. Neighbouring tiles cost alike, so a rank that gets consecutive multiples gets a fair share.
inline std::int64_t scatteringStride(std::int64_t count)
{
    auto stride = static_cast<std::int64_t>(0.6180339887498949 * static_cast<double>(count)); // the golden section
    while (stride > 1 && std::gcd(stride, count) != 1)
        --stride;
    return std::max<std::int64_t>(stride, 1);
}

} // namespace detail

// Which rank renders which tile (section 4.1.1 of the paper). All but Owned deal out pairs of tile and pass, so many
// ranks render a tile that needs many samples. The image does not depend on which rank renders a tile.
enum class WorkDistribution : std::uint8_t {
    Owned,      // a rank renders the tiles that it owns: no input travels
    Linear,     // equal contiguous shares in the order of tiles
    RoundRobin, // dealt out one by one
    Dynamic     // one half dealt out evenly, the other handed out on demand, in shares that shrink
};

namespace detail {

// The jobs of a rank in an image-parallel frame: pairs of tile and pass.
class ImageShare {
public:
    // Some jobs of this rank: first, first + step and so on, modulo the number of all jobs.
    struct Part {
        std::int64_t first = 0, count = 0, step = 1;
    };

    // Calls render(part) until this rank has nothing more to render in this frame.
    void forEachPart(FrameBase& frame, const FrameBufferBase& fb, WorkDistribution distribution,
                     FunctionRef<void(const Part&)> render)
    {
        tiles_ = distribution == WorkDistribution::Owned ? &frame.ownedTiles() : nullptr;
        jobs_.find(tiles_ ? tiles_->size() : static_cast<std::size_t>(fb.layout().tileCount()),
                   [&](std::size_t item) { return frame.samples(tileOf(item)).count; });
        const std::int64_t count = jobs_.count(), rank = fb.rank(), size = fb.size();
        switch (distribution) {
        case WorkDistribution::Owned: render({0, count}); break;
        case WorkDistribution::Linear:
            render({count * rank / size, count * (rank + 1) / size - count * rank / size});
            break;
        case WorkDistribution::RoundRobin: render({rank, (count - rank + size - 1) / size, size}); break;
        case WorkDistribution::Dynamic: {
            const std::int64_t stride = scatteringStride(count);
            frame.forEachWorker([&] {
                for (std::int64_t job = frame.nextJob(count); job >= 0; job = frame.nextJob(count))
                    render({job * stride, 1});
            });
            break;
        }
        }
    }

    // The tile of the i-th job of a part, and its pass.
    std::pair<int, int> at(const Part& part, std::int64_t i) const
    {
        const Job job = jobs_.at((part.first + i * part.step) % jobs_.count());
        return {tileOf(job.item), job.pass};
    }

private:
    int tileOf(std::size_t item) const { return tiles_ ? (*tiles_)[item] : static_cast<int>(item); }

    const std::vector<int>* tiles_ = nullptr; // null: all tiles of the image
    PassJobs jobs_;
};

} // namespace detail

// Image-parallel rendering (Listing 2 of the paper): all ranks have the scene, and one of them renders each tile and
// pass. One object per rank, for any number of frames; it keeps memory from frame to frame. One thread at a time may
// use it. The framebuffer must outlive it.
template <class FrameBuffer>
class ImageParallelLoop {
public:
    // The distribution must be the same on all ranks; nobody checks it. Not collective. Waits for nothing.
    explicit ImageParallelLoop(FrameBuffer& fb, WorkDistribution distribution = WorkDistribution::Owned)
        : fb_(fb), distribution_(distribution)
    {
    }

    // Begins a frame, renders this rank's share, and returns the frame: call end(). All ranks must call it.
    // renderTile(tile) writes the pixels of tile.region into the tile, which Frame::start() has cleared. Several
    // threads call it at once, once for each pass: tile.pass and tile.sample tell which. Waits for other ranks only for
    // room, as setTile(), and with WorkDistribution::Dynamic for jobs. Throws what FrameBuffer::begin() throws. An
    // exception of renderTile comes out of Frame::end() on all ranks, as a FrameError.
    template <class RenderTile>
    typename FrameBuffer::Frame start(const RenderTile& renderTile, FrameConfig params = {},
                                      const typename FrameBuffer::TileFrameData& tileData = {},
                                      const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        params.declared = false;
        params.maxLayers = 1;
        auto frame = fb_.begin(params, tileData, pixelData);
        const auto render = [&](const detail::ImageShare::Part& part) {
            frame.template forEachTile<detail::TileFor<FrameBuffer, RenderTile>>(
                part.count, [&](std::int64_t i, auto& tile) {
                    const auto [index, pass] = share_.at(part, i);
                    frame.start(tile, index, pass);
                    renderTile(tile);
                    frame.setTile(tile);
                });
        };
        frame.guard([&] { share_.forEachPart(frame, fb_, distribution_, render); });
        return frame;
    }

    // Renders a whole frame: start() and Frame::end(). Collective. Waits and throws as both do.
    template <class RenderTile>
    FrameReport render(const RenderTile& renderTile, const FrameConfig& params = {},
                       const typename FrameBuffer::TileFrameData& tileData = {},
                       const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        return start(renderTile, params, tileData, pixelData).end();
    }

private:
    FrameBuffer& fb_;
    WorkDistribution distribution_;
    detail::ImageShare share_;
};

namespace detail {

// Finds the order and the owners of a loop's frames from a SharedWorld and a camera.
class FromWorld {
public:
    // The rank that renders a brick in a tile.
    using RankOf = FunctionRef<int(const SharedBrick& brick, int tile)>;

    // Sets config.order and config.owners. `isOrdered`: inputs come in an order that the loop was given, without depth.
    // `own`: bricks that must be among those of `world`.
    // Returns the camera's exception, or null. Pass it to begin(), which then makes the frame fail on all ranks. Call
    // begin() even then: other ranks may have sent inputs of this frame already.
    template <class FrameBuffer, class Camera>
    std::exception_ptr set(FrameConfig& config, const FrameBuffer& fb, const SharedWorld& world, const Camera& camera,
                           RankOf rankOf, bool isOrdered = false, const World* own = nullptr)
    {
        try {
            if (own)
                requireBricks(*own, world);
            if constexpr (FrameBuffer::takesOrder && has_common_eye_v<Camera>)
                if (!isOrdered)
                    findOrder(config, world, camera.commonEye());
            if (!FrameBuffer::keepsState)
                findOwners(
                    config, fb, world, !isOrdered && !config.order,
                    [&](const Box3& box, FoundTile found) {
                        forEachTile(camera.project(box, fb.layout().width(), fb.layout().height()), fb.layout(), found);
                    },
                    rankOf);
            return nullptr;
        } catch (...) {
            return std::current_exception();
        }
    }

private:
    static void requireBricks(const World& own, const SharedWorld& world)
    {
        for (const Brick& brick : own.bricks()) {
            const auto its = std::lower_bound(world.bricks().begin(), world.bricks().end(), brick.id,
                                              [](const Brick& other, std::uint32_t id) { return other.id < id; });
            if (its == world.bricks().end() || its->id != brick.id || !(its->bounds == brick.bounds))
                failArgument("brick %u is not in the SharedWorld with these bounds: make a new one when bricks change",
                             brick.id);
        }
    }

    // Sets config.order if it is not set, all rays begin at `eye`, and the bricks have an order. The time grows with
    // the square of the number of bricks, so it does nothing for more than 1024.
    void findOrder(FrameConfig& config, const SharedWorld& world, const std::optional<Vec3>& eye)
    {
        const std::vector<SharedBrick>& bricks = world.bricks();
        if (config.order || !eye || bricks.size() > 1024 || frontToBack_.find(world, *eye))
            return;
        sources_.clear();
        for (const int brick : frontToBack_.order())
            sources_.push_back(bricks[static_cast<std::size_t>(brick)].id);
        if (!order_ || sources_ != orderSources_) {
            order_ = std::make_shared<const SourceOrder>(sources_);
            orderSources_.swap(sources_);
        }
        config.order = order_;
    }

    // Sets config.owners, where ranks are on several nodes, unless it is set or the framebuffer has an owner map.
    // `hasDepth`: whether inputs have depth. `tilesOf(bounds, found)`: the tiles that a box may project to.
    void findOwners(FrameConfig& config, const FrameBufferBase& fb, const SharedWorld& world, bool hasDepth,
                    FunctionRef<void(const Box3&, FoundTile)> tilesOf, RankOf rankOf)
    {
        if (config.owners || fb.config().image.ownerMap)
            return;
        if (!owners_)
            owners_.emplace(fb.nodeOf());
        if (owners_->isOneNode())
            return;
        owners_->start(fb.layout());
        const SamplePlan& plan = config.samples;
        const bool isPlanned = plan && plan->size() == static_cast<std::size_t>(fb.layout().tileCount());
        for (const SharedBrick& b : world.bricks())
            tilesOf(b.bounds, [&](int tile, const Region& pixels) {
                if (!isPlanned || (*plan)[static_cast<std::size_t>(tile)].count > 0)
                    owners_->add(tile, pixels, rankOf(b, tile));
            });
        config.owners = owners_->find(fb.config(), hasDepth, [&](int tile) { return fb.tileOwner(tile); });
    }

    FrontToBack frontToBack_;
    std::vector<std::uint32_t> sources_, orderSources_; // orderSources_: of order_
    std::shared_ptr<const SourceOrder> order_;
    std::optional<LinkOwners> owners_;
};

// The jobs of a rank that renders its own bricks, and its declaration.
class OwnBricks {
public:
    // Calls job(brick, tile) for each brick, tile and pass, with a tile that has been started for them.
    template <class Render, class FrameBuffer, class Camera, class Job>
    void forEach(FrameBuffer& fb, typename FrameBuffer::Frame& frame, const World& world, const Camera& camera,
                 const Job& job)
    {
        frame.guard([&] {
            pairs_ = visibleTiles(world, camera, fb.layout(), std::move(pairs_));
            declare(frame, world);
            frame.template forEachTile<TileFor<FrameBuffer, Render>>(jobs_.count(), [&](std::int64_t i, auto& tile) {
                const auto [item, pass] = jobs_.at(i);
                const Brick& brick = brickOf(world, pairs_[item]);
                frame.start(tile, pairs_[item].tile, pass);
                tile.generation = 1;
                tile.source = brick.id;
                job(brick, tile);
            });
        });
    }

private:
    void declare(FrameBase& frame, const World& world)
    {
        inputs_ = inputsOf(world, pairs_, std::move(inputs_));
        frame.declare(inputs_);
        jobs_.find(pairs_.size(), [&](std::size_t i) { return frame.samples(pairs_[i].tile).count; });
    }

    std::vector<BrickInTile> pairs_;
    std::vector<TileInput> inputs_;
    PassJobs jobs_;
};

} // namespace detail

// Data-parallel rendering (Listing 3 of the paper): each rank renders its bricks wherever they project. One object per
// rank, for any number of frames; it keeps memory from frame to frame. One thread at a time may use it. Framebuffer and
// world must outlive it. The world may change between frames. Each brick must be in the world of one rank only.
template <class FrameBuffer>
class DataParallelLoop {
public:
    // Not collective. Waits for nothing.
    DataParallelLoop(FrameBuffer& fb, const World& world) : fb_(fb), world_(world) {}

    // `all` has the bricks of all ranks, and must outlive the loop. If a brick of `world` is not among them, frames
    // fail (InvalidArgument). If the bricks have an order from front to back for the camera, the loop sets
    // FrameConfig::order: AlphaBlend then sorts nothing, and sends depth only if the image has it. If ranks are on
    // several nodes, tiles belong to ranks near their pixels: see ImageConfig::ownerMap.
    DataParallelLoop(FrameBuffer& fb, const World& world, const SharedWorld& all) : fb_(fb), world_(world), all_(&all)
    {
    }

    // Begins a frame, renders all bricks of the world into the tiles that they may project to, and returns the frame:
    // call end(). All ranks must call it. renderBrick(brick, tile) writes colour and depth of the pixels of
    // tile.region, from the part of each ray that is within brick.bounds; depth grows away from the camera.
    // Frame::start() has cleared the tile. Several threads call renderBrick at once, once for each pass (tile.pass).
    // Unlike in Listing 3, each rank declares its inputs, so owners need not know the bricks. Waits for other ranks
    // only for room, as setTile(). Throws what FrameBuffer::begin() throws. An exception of renderBrick or the camera
    // comes out of Frame::end() on all ranks, as a FrameError, except where FrameConfig::allowPartial says otherwise.
    template <class Camera, class RenderBrick>
    typename FrameBuffer::Frame start(const Camera& camera, const RenderBrick& renderBrick, FrameConfig params = {},
                                      const typename FrameBuffer::TileFrameData& tileData = {},
                                      const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        params.declared = true;
        const auto rankOf = [](const SharedBrick& brick, int) { return brick.ranks.front(); };
        const std::exception_ptr failure =
            all_ ? fromWorld_.set(params, fb_, *all_, camera, rankOf, false, &world_) : nullptr;
        auto frame = fb_.begin(params, tileData, pixelData, failure);
        bricks_.template forEach<RenderBrick>(fb_, frame, world_, camera, [&](const Brick& brick, auto& tile) {
            renderBrick(brick, tile);
            frame.setTile(tile);
        });
        return frame;
    }

    // Renders a whole frame: start() and Frame::end(). Collective. Waits and throws as both do.
    template <class Camera, class RenderBrick>
    FrameReport render(const Camera& camera, const RenderBrick& renderBrick, const FrameConfig& params = {},
                       const typename FrameBuffer::TileFrameData& tileData = {},
                       const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        return start(camera, renderBrick, params, tileData, pixelData).end();
    }

private:
    FrameBuffer& fb_;
    const World& world_;
    const SharedWorld* all_ = nullptr;
    detail::OwnBricks bricks_;
    detail::FromWorld fromWorld_;
};

DFB_NAMESPACE_END
