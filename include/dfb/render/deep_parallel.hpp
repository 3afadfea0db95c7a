// DeepParallelLoop: data-parallel rendering with several segments per pixel. So bricks need not be convex, and may be
// interleaved (A before B before A along a ray).
#pragma once

#include <dfb/frame.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/render/loops.hpp>
#include <dfb/render/world.hpp>
#include <dfb/tile.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// The composited colour between two depths of a ray.
struct Segment {
    std::array<float, 4> rgba{}; // premultiplied
    float depth = 0, farDepth = 0;
};

// A tile whose pixels may have several segments, all of one brick. A segment is the brick's colour along one piece of a
// ray. Other bricks may have segments in the gaps between them. A pixel keeps at most `maxSegments`, which bounds
// memory and messages. If one more is added, two neighbours are merged: those whose merge may change the pixel least.
//
// The error of a merge: it is exact if no other brick lies between the two. Otherwise the layer between them, with
// colour c' and alpha a', is blended behind both. Let the farther of the two have colour c2 and alpha a2, and let T be
// the part of the light that passes all segments of the brick in front of it. The error is then T |c' a2 - c2 a'|: at
// most T max(a2, |c2|) if c' <= a' <= 1. The sum over all merges bounds the error of a pixel: errorBound(). For colours
// with c' > a', multiply it by the largest c' / a'.
class DeepTile {
public:
    // `maxSegments`: segments a pixel, 1 to 65535. Less counts as 1, more as 65535. All pixels have equal room, which
    // doubles when one needs more. One thread at a time may use the tile. reset() and add() throw std::bad_alloc.
    explicit DeepTile(int maxSegments) : maxSegments_(std::clamp(maxSegments, 1, 65535)) {}

    int maxSegments() const noexcept { return maxSegments_; }

    // Makes it empty, for the tile and pass of this header.
    void reset(const TileHeader& header)
    {
        header_ = header;
        const std::size_t pixels =
            static_cast<std::size_t>(header.region.width()) * static_cast<std::size_t>(header.region.height());
        counts_.assign(pixels, 0);
        errors_.assign(pixels, 0.0);
        segments_.resize(pixels * room_);
        layers_ = 0;
        errorBound_ = 0;
    }

    const TileHeader& header() const noexcept { return header_; }

    // Adds a segment to pixel (x, y) of the image, which is in the tile's region. Segments of one pixel come in any
    // order and should not overlap; those of equal depth keep the order of these calls. A segment without colour and
    // alpha is left out. Nobody checks x and y.
    void add(int x, int y, const Segment& segment)
    {
        if (segment.rgba == std::array<float, 4>{})
            return;
        const std::size_t pixel = pixelAt(x - header_.region.x0, y - header_.region.y0);
        std::uint16_t& count = counts_[pixel];
        if (count == room_ && count < maxSegments_)
            makeRoom();
        Segment* first = segments_.data() + pixel * room_;
        if (count == maxSegments_) {
            std::vector<Segment>& all = scratch_;
            all.assign(first, first + count);
            all.insert(std::upper_bound(all.begin(), all.end(), segment, nearer), segment);
            errors_[pixel] += mergeCheapest(all);
            errorBound_ = std::max(errorBound_, errors_[pixel]);
            std::copy(all.begin(), all.end(), first);
            return;
        }
        Segment* place = std::upper_bound(first, first + count, segment, nearer);
        std::copy_backward(place, first + count, first + count + 1);
        *place = segment;
        layers_ = std::max<int>(layers_, ++count);
    }

    // The largest number of segments of a pixel, at most maxSegments().
    int layers() const noexcept { return layers_; }

    // How much merging may have changed a pixel, at most: see DeepTile.
    double errorBound() const noexcept { return errorBound_; }

    // Writes segment `layer` of each pixel, counted from 0 at the front, into a cleared tile of the same region. Pixels
    // with fewer segments stay empty. Not checked: `layer` is 0 or more, and the regions are equal.
    template <class TileType>
    void writeLayer(int layer, TileType& tile) const
    {
        static_assert((TileType::channels & (depthChannel | farChannel)) == (depthChannel | farChannel),
                      "dfb: segments need a tile with depth and farChannel");
        for (int y = 0; y < header_.region.height(); ++y)
            for (int x = 0; x < header_.region.width(); ++x) {
                const std::size_t pixel = pixelAt(x, y);
                if (layer >= counts_[pixel])
                    continue;
                const Segment& s = segments_[pixel * room_ + static_cast<std::size_t>(layer)];
                std::copy(s.rgba.begin(), s.rgba.end(), tile.pixel(x, y));
                tile.depth[y * TileType::size + x] = s.depth;
                tile.farDepth[y * TileType::size + x] = s.farDepth;
            }
    }

private:
    static bool nearer(const Segment& a, const Segment& b) { return depthOf(a) < depthOf(b); }
    static float depthOf(const Segment& s) // NaN counts as infinity, as in tile operations
    {
        return std::isnan(s.depth) ? std::numeric_limits<float>::infinity() : s.depth;
    }

    // Doubles the room of each pixel.
    void makeRoom()
    {
        const std::size_t room = std::min(2 * room_, static_cast<std::size_t>(maxSegments_));
        std::vector<Segment> wider(counts_.size() * room);
        for (std::size_t pixel = 0; pixel < counts_.size(); ++pixel)
            std::copy_n(segments_.begin() + static_cast<std::ptrdiff_t>(pixel * room_), counts_[pixel],
                        wider.begin() + static_cast<std::ptrdiff_t>(pixel * room));
        segments_ = std::move(wider);
        room_ = room;
    }

    // Merges the two neighbours whose merge may change the pixel least, and returns by how much.
    static double mergeCheapest(std::vector<Segment>& all)
    {
        std::size_t best = 0;
        double bestCost = 0, through = 1;
        for (std::size_t i = 0; i + 1 < all.size(); ++i) {
            const std::array<float, 4>& behind = all[i + 1].rgba;
            float largest = 0;
            for (const float v : behind)
                largest = std::max(largest, std::fabs(v));
            through *= 1 - static_cast<double>(all[i].rgba[3]);
            const double cost = std::fabs(through) * static_cast<double>(largest); // alpha may be above 1
            if (i == 0 || cost < bestCost) {
                best = i;
                bestCost = cost;
            }
        }
        Segment &a = all[best], &b = all[best + 1];
        const double rest = 1 - static_cast<double>(a.rgba[3]);
        for (std::size_t c = 0; c < 4; ++c)
            a.rgba[c] = static_cast<float>(static_cast<double>(a.rgba[c]) + rest * static_cast<double>(b.rgba[c]));
        a.farDepth = std::max(a.farDepth, b.farDepth);
        all.erase(all.begin() + static_cast<std::ptrdiff_t>(best) + 1);
        return bestCost;
    }

    // x and y count from the corner of the region.
    std::size_t pixelAt(int x, int y) const { return static_cast<std::size_t>(y * header_.region.width() + x); }

    int maxSegments_;
    TileHeader header_;
    std::vector<std::uint16_t> counts_; // per pixel
    std::vector<double> errors_;        // per pixel
    std::size_t room_ = 1;              // of each pixel, in segments; at most maxSegments_
    std::vector<Segment> segments_;     // room_ per pixel, the first counts_ of which are used, front to back
    std::vector<Segment> scratch_;
    int layers_ = 0;
    double errorBound_ = 0;
};

// Sorts all segments, including those of one brick. FrameReport::orderUndefinedPixels counts the pixels in which some
// overlap.
template <int TileSize = 64>
using BasicDeepBlend = BasicAlphaBlend<TileSize, colorChannel | depthChannel | farChannel>;
// BasicDeepBlend, with tiles of 64 x 64 pixels.
using DeepBlend = BasicDeepBlend<>;

// Like DataParallelLoop, for bricks that may overlap: the bounds of a brick need only enclose its data. The operation
// of the framebuffer is DeepBlend, or another with depth and farChannel. Framebuffer and world must outlive it. One
// thread at a time may use it.
template <class FrameBuffer>
class DeepParallelLoop {
public:
    // Each pixel of a brick keeps at most `maxSegments` segments. Not collective. Waits for nothing. Throws
    // InvalidArgument if `maxSegments` is not 1 to 65535.
    DeepParallelLoop(FrameBuffer& fb, const World& world, int maxSegments)
        : fb_(fb), world_(world), maxSegments_(maxSegments)
    {
        if (maxSegments < 1 || maxSegments > 65535)
            detail::failArgument("a pixel has 1 to 65535 segments");
    }

    // As DataParallelLoop::start(), but renderBrick(brick, deep) adds the segments of the pixels of
    // deep.header().region to the empty DeepTile. FrameReport::mergeErrorBound says how far a pixel may be off because
    // segments were merged. A brick whose pixels all have one segment in a tile sends one input, as in
    // DataParallelLoop.
    template <class Camera, class RenderBrick>
    typename FrameBuffer::Frame start(const Camera& camera, const RenderBrick& renderBrick, FrameConfig params = {},
                                      const typename FrameBuffer::TileFrameData& tileData = {},
                                      const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        params.declared = true;
        auto frame = fb_.begin(params, tileData, pixelData);
        bricks_.template forEach<void>(fb_, frame, world_, camera, [&](const Brick& brick, auto& tile) {
            std::unique_ptr<DeepTile> deep = takeSpare();
            deep->reset(tile);
            renderBrick(brick, *deep);
            for (int layer = 0; layer == 0 || layer < deep->layers(); ++layer) {
                if (layer > 0)
                    tile.clear();
                tile.generation = layer == 0 ? 1 : 2;
                tile.children = layer == 0 ? std::max(deep->layers() - 1, 0) : 0;
                tile.part = static_cast<std::uint16_t>(layer);
                deep->writeLayer(layer, tile);
                frame.setTile(tile);
            }
            if (deep->errorBound() > 0)
                frame.noteMergeError(tile.tile, deep->errorBound());
            const std::lock_guard<std::mutex> lock(mutex_);
            spare_.push_back(std::move(deep));
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
    std::unique_ptr<DeepTile> takeSpare()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (spare_.empty())
            return std::make_unique<DeepTile>(maxSegments_);
        std::unique_ptr<DeepTile> deep = std::move(spare_.back());
        spare_.pop_back();
        return deep;
    }

    FrameBuffer& fb_;
    const World& world_;
    int maxSegments_;
    detail::OwnBricks bricks_;
    std::mutex mutex_;
    std::vector<std::unique_ptr<DeepTile>> spare_;
};

DFB_NAMESPACE_END
