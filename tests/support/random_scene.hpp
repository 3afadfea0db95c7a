// Scene: bricks whose pixels are a pure function of (seed, brick, pass, pixel), the loops that render them on any
// number of ranks, and the reference image of the same scene. Used with ranks in one process and over MPI.
#pragma once

#include <dfb/dfb.hpp>
#include <dfb/testing/reference.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <deque>
#include <limits>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace scene {

// Bricks are boxes whose x and y are pixels: FlatCamera looks straight at them.
struct FlatCamera {
    dfb::Region project(const dfb::Box3& b, int, int) const
    {
        return {static_cast<int>(b.lower.x), static_cast<int>(b.lower.y), static_cast<int>(b.upper.x),
                static_cast<int>(b.upper.y)};
    }
};

// Whether a brick may have pixels of a tile.
template <class FrameBuffer>
bool meets(const FrameBuffer& fb, const dfb::Brick& brick, int tile)
{
    return !dfb::intersection(FlatCamera().project(brick.bounds, 0, 0), fb.layout().region(tile)).empty();
}

struct Scene {
    int width = 97, height = 61; // primes
    int passes = 1;
    std::chrono::milliseconds timeout{0};
    bool allowPartial = false;
    dfb::BlendRule rule = dfb::BlendRule::SortByDepth; // InOrder: in the order of `bricks`
    std::array<float, 4> background{0.125f, 0.25f, 0.0f, 0.5f};
    std::uint64_t seed = 1;
    std::vector<dfb::Brick> bricks;
    dfb::TileOwners owners; // null: those of the owner map
};

inline std::uint64_t mix(std::uint64_t h)
{
    h += 0x9e3779b97f4a7c15u;
    h = (h ^ (h >> 30)) * 0xbf58476d1ce4e5b9u;
    h = (h ^ (h >> 27)) * 0x94d049bb133111ebu;
    return h ^ (h >> 31);
}

// Makes bricks at pseudo-random places, each over a part of the image. Some overlap, and some tiles may stay
// background.
inline Scene makeScene(int brickCount, std::uint64_t seed = 1, int width = 97, int height = 61, int passes = 1)
{
    Scene s;
    s.width = width, s.height = height, s.passes = passes, s.seed = seed;
    for (int i = 0; i < brickCount; ++i) {
        const std::uint64_t h = mix(seed * 131 + static_cast<std::uint64_t>(i));
        const int w = std::max(1, static_cast<int>(h % static_cast<std::uint64_t>(width)) / 2 + width / 8);
        const int v = std::max(1, static_cast<int>((h >> 16) % static_cast<std::uint64_t>(height)) / 2 + height / 8);
        const int x = static_cast<int>((h >> 32) % static_cast<std::uint64_t>(width));
        const int y = static_cast<int>((h >> 48) % static_cast<std::uint64_t>(height));
        s.bricks.push_back(
            {static_cast<std::uint32_t>(10 + 3 * i),
             {{static_cast<float>(x), static_cast<float>(y), 0},
              {static_cast<float>(std::min(width, x + w)), static_cast<float>(std::min(height, y + v)), 1}}});
    }
    return s;
}

// The sample of a brick at a pixel, or nothing if the pixel is outside the brick or in a hole of it.
inline std::optional<dfb::testing::Sample> sampleOf(const Scene& s, const dfb::Brick& brick, int pass, int x, int y)
{
    if (!FlatCamera().project(brick.bounds, s.width, s.height).contains(x, y))
        return std::nullopt;
    const std::uint64_t h = mix(mix(mix(s.seed ^ mix(brick.id)) + static_cast<std::uint64_t>(pass))
                                + static_cast<std::uint64_t>(y) * 65536 + static_cast<std::uint64_t>(x));
    if (h % 8 == 0)
        return std::nullopt;
    dfb::testing::Sample sample;
    sample.source = brick.id;
    sample.depth = static_cast<float>((h >> 8) % 5); // many ties
    const auto part = [h](int shift) { return static_cast<float>((h >> shift) & 0x3ff) / 1024.0f; };
    const float alpha = h % 32 == 1 ? 0.0f : h % 32 == 2 ? 1.0f : part(12);
    sample.rgba = {part(22) * (alpha > 0 ? alpha : 1), part(32) * alpha, part(42) * alpha, alpha};
    if (h % 64 == 3)
        sample.rgba = {1e-41f, 0, 0, 0}; // a denormal
    return sample;
}

template <class Tile>
void renderBrick(const Scene& s, const dfb::Brick& brick, Tile& tile)
{
    for (int y = tile.region.y0; y < tile.region.y1; ++y)
        for (int x = tile.region.x0; x < tile.region.x1; ++x)
            if (const auto sample = sampleOf(s, brick, tile.pass, x, y)) {
                const int px = x - tile.region.x0, py = y - tile.region.y0;
                std::copy(sample->rgba.begin(), sample->rgba.end(), tile.pixel(px, py));
                tile.depth[py * Tile::size + px] = sample->depth;
            }
}

inline dfb::FrameConfig paramsOf(const Scene& s)
{
    dfb::FrameConfig params;
    params.background = s.background;
    params.passes = s.passes;
    params.timeout = s.timeout;
    params.allowPartial = s.allowPartial;
    params.owners = s.owners;
    return params;
}

inline dfb::TileOwners anyOwners(const dfb::TileLayout& layout, int rankCount, std::uint64_t seed)
{
    std::vector<int> owners;
    for (int tile = 0; tile < layout.tileCount(); ++tile)
        owners.push_back(static_cast<int>(mix(seed * 977 + static_cast<std::uint64_t>(tile))
                                          % static_cast<std::uint64_t>(rankCount)));
    return std::make_shared<const std::vector<int>>(std::move(owners));
}

// The bricks of one rank. Different values of `deal` deal them out differently; -1 gives all to the last rank.
inline std::vector<dfb::Brick> bricksOf(const Scene& s, int rank, int rankCount, int deal = 0)
{
    std::vector<dfb::Brick> mine;
    for (std::size_t i = 0; i < s.bricks.size(); ++i) {
        const auto n = static_cast<std::uint64_t>(rankCount);
        const std::uint64_t owner = deal < 0    ? n - 1
                                    : deal == 0 ? i % n
                                                : mix(i * 7 + static_cast<std::uint64_t>(deal)) % n;
        if (static_cast<int>(owner) == rank)
            mine.push_back(s.bricks[i]);
    }
    return mine;
}

enum class Loop {
    Listing3,   // a loop by hand, as in the paper: the owner sends a background tile that announces the bricks
    Declared,   // DataParallelLoop
    ImageOwned, // ImageParallelLoop, each rank renders the tiles that it owns; the scene has one brick
    ImageDealt  // the same image; which rank renders a tile does not depend on its owner
};

inline bool isDataParallel(Loop loop) { return loop == Loop::Listing3 || loop == Loop::Declared; }

// As makeScene(); if the loop is not data-parallel, the scene has one brick, which fills the image.
inline Scene makeSceneFor(Loop loop, int bricks, std::uint64_t seed, int width = 97, int height = 61, int passes = 1)
{
    Scene s = makeScene(isDataParallel(loop) ? bricks : 1, seed, width, height, passes);
    if (!isDataParallel(loop))
        s.bricks[0].bounds = {{0, 0, 0}, {static_cast<float>(width), static_cast<float>(height), 1}};
    return s;
}

// A tile-brick owner: deals the tiles of a brick, and their passes, in turn to the ranks that hold it.
struct PassesInTurn {
    int operator()(const dfb::SharedBrick& brick, int tile, int pass) const
    {
        return brick.ranks[(brick.id + static_cast<std::size_t>(tile + pass)) % brick.ranks.size()];
    }
};

// The number of bricks that may have pixels of a tile.
template <class FrameBuffer>
int bricksIn(const FrameBuffer& fb, const Scene& s, int tile)
{
    return static_cast<int>(std::count_if(s.bricks.begin(), s.bricks.end(),
                                          [&](const dfb::Brick& brick) { return meets(fb, brick, tile); }));
}

// Says how many inputs will come for a tile of an open frame. `tile`: memory for it, here and below.
template <class Frame, class Tile>
void sendParent(Frame& frame, Tile& tile, int index, int inputs, int pass = 0)
{
    frame.start(tile, index, pass);
    tile.children = inputs;
    frame.setTile(tile);
}

// Renders a brick's input for a tile of an open frame, and sends it.
template <class Frame, class Tile>
void sendInput(Frame& frame, Tile& tile, const Scene& s, const dfb::Brick& brick, int index, int pass = 0)
{
    frame.start(tile, index, pass);
    tile.generation = 1;
    tile.source = brick.id;
    renderBrick(s, brick, tile);
    frame.setTile(tile);
}

// Listing 3 of the paper.
template <class FrameBuffer>
dfb::FrameReport listing3(FrameBuffer& fb, const Scene& s, const std::vector<dfb::Brick>& mine)
{
    auto frame = fb.begin(paramsOf(s));
    const auto tile = std::make_unique<typename FrameBuffer::Tile>();
    for (int pass = 0; pass < s.passes; ++pass) {
        for (int index : frame.ownedTiles())
            sendParent(frame, *tile, index, bricksIn(fb, s, index), pass);
        for (int index = 0; index < fb.layout().tileCount(); ++index)
            for (const dfb::Brick& brick : mine)
                if (meets(fb, brick, index))
                    sendInput(frame, *tile, s, brick, index, pass);
    }
    return frame.end();
}

template <class FrameBuffer>
dfb::FrameReport renderLoop(FrameBuffer& fb, const Scene& s, Loop loop, int deal = 0)
{
    const auto mine = bricksOf(s, fb.rank(), fb.size(), deal);
    const auto render = [&](auto& tile) { renderBrick(s, s.bricks.front(), tile); };
    switch (loop) {
    case Loop::Listing3: return listing3(fb, s, mine);
    case Loop::ImageOwned: return dfb::ImageParallelLoop(fb).render(render, paramsOf(s));
    case Loop::ImageDealt: {
        std::vector<int> tiles;
        for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
            if ((tile + tile / 5 + deal) % fb.size() == fb.rank())
                tiles.push_back(tile);
        auto params = paramsOf(s);
        params.maxLayers = 1;
        auto frame = fb.begin(params);
        frame.forEachTile(tiles, [&](auto& tile) {
            render(tile);
            frame.setTile(tile);
        });
        return frame.end();
    }
    case Loop::Declared: break;
    }
    return dfb::DataParallelLoop(fb, dfb::World(mine))
        .render(
            FlatCamera(), [&](const dfb::Brick& brick, auto& tile) { renderBrick(s, brick, tile); }, paramsOf(s));
}

// The image of the display rank after a frame, and the report of this rank.
struct Picture {
    int width = 0, height = 0;
    dfb::OutputFormat format = dfb::OutputFormat::None;
    std::vector<std::byte> bytes;
    std::vector<float> depth;
    dfb::FrameReport report;

    explicit Picture() = default;
    Picture(const dfb::Image& image, const dfb::FrameReport& r)
        : width(image.width()), height(image.height()), format(image.format()), report(r)
    {
        if (!image.empty())
            bytes.assign(image.bytes(), image.bytes() + image.pixelCount() * dfb::bytesPerPixel(format));
        if (image.hasDepth())
            depth.assign(image.depth(), image.depth() + image.pixelCount());
    }

    std::uint64_t hash() const
    {
        return dfb::testing::hashOf(bytes.data(), bytes.size())
               ^ 3 * dfb::testing::hashOf(depth.data(), depth.size() * sizeof(float));
    }
    float value(std::size_t i) const
    {
        float v = 0;
        std::memcpy(&v, bytes.data() + i * sizeof v, sizeof v);
        return v;
    }
};

// Calls `more(sample, pass, x, y)` to add to a sample what it has beside colour and depth.
template <class More>
std::vector<dfb::testing::Pixel> referenceOf(const Scene& s, const More& more)
{
    const auto composited = [&](std::vector<dfb::testing::Sample> samples) {
        return s.rule == dfb::BlendRule::SortByDepth ? dfb::testing::composite(std::move(samples), s.background)
               : s.rule == dfb::BlendRule::InOrder   ? dfb::testing::compositeInOrder(samples, s.background)
                                                     : dfb::testing::nearest(samples, s.background);
    };
    const dfb::testing::Pixel empty = composited({}); // most pixels of many scenes, and slow to compute
    const dfb::testing::Pixel background =
        dfb::testing::mean(std::vector<dfb::testing::Pixel>(static_cast<std::size_t>(s.passes), empty));
    std::vector<dfb::testing::Pixel> result;
    for (int y = 0; y < s.height; ++y)
        for (int x = 0; x < s.width; ++x) {
            std::vector<dfb::testing::Pixel> passes;
            bool isEmpty = true;
            for (int pass = 0; pass < s.passes; ++pass) {
                std::vector<dfb::testing::Sample> samples;
                for (const dfb::Brick& brick : s.bricks) // a sample of 0 counts only for Nearest
                    if (auto sample = sampleOf(s, brick, pass, x, y);
                        sample && (s.rule == dfb::BlendRule::Nearest || sample->rgba != std::array<float, 4>{})) {
                        more(*sample, pass, x, y);
                        samples.push_back(*sample);
                    }
                isEmpty = isEmpty && samples.empty();
                passes.push_back(samples.empty() ? empty : composited(std::move(samples)));
            }
            result.push_back(isEmpty ? background : dfb::testing::mean(passes));
        }
    return result;
}

// Whether the references of both are the same.
inline bool looksLike(const Scene& a, const Scene& b)
{
    static_assert(sizeof(dfb::Brick) == 7 * sizeof(float)); // no padding
    return a.width == b.width && a.height == b.height && a.passes == b.passes && a.rule == b.rule && a.seed == b.seed
           && std::memcmp(&a.background, &b.background, sizeof a.background) == 0 && a.bricks.size() == b.bricks.size()
           && (a.bricks.empty()
               || std::memcmp(a.bricks.data(), b.bricks.data(), a.bricks.size() * sizeof(dfb::Brick)) == 0);
}

// Cases render a scene on several numbers of ranks, and in several ways. So the references that were computed last, up
// to 150 MB, are kept. Any thread.
inline std::vector<dfb::testing::Pixel> referenceOf(const Scene& s)
{
    using Pixels = std::shared_ptr<const std::vector<dfb::testing::Pixel>>;
    constexpr std::size_t most = 600000; // pixels
    static std::mutex mutex;
    static std::deque<std::pair<Scene, Pixels>> kept;
    static std::size_t keptPixels = 0;
    Pixels pixels;
    {
        const std::lock_guard<std::mutex> lock(mutex);
        for (const auto& [scene, its] : kept)
            if (looksLike(scene, s))
                pixels = its;
    }
    if (pixels)
        return *pixels;
    pixels = std::make_shared<const std::vector<dfb::testing::Pixel>>(
        referenceOf(s, [](const dfb::testing::Sample&, int, int, int) {}));
    const std::lock_guard<std::mutex> lock(mutex);
    kept.emplace_back(s, pixels);
    keptPixels += pixels->size();
    while (keptPixels > most) {
        keptPixels -= kept.front().second->size();
        kept.pop_front();
    }
    return *pixels;
}

// The reference in which the tiles that are not complete in `fb` are background.
template <class FrameBuffer>
std::vector<dfb::testing::Pixel> referenceOf(const Scene& s, const FrameBuffer& fb,
                                             std::vector<dfb::testing::Pixel> expected)
{
    const dfb::testing::Pixel background = dfb::testing::mean(std::vector<dfb::testing::Pixel>(
        static_cast<std::size_t>(s.passes), dfb::testing::composite({}, s.background)));
    for (int tile = 0; tile < fb.layout().tileCount(); ++tile) {
        const dfb::Region r = fb.layout().region(tile);
        for (int y = r.y0; y < r.y1 && !fb.isComplete(tile); ++y)
            std::fill_n(expected.begin() + y * s.width + r.x0, r.width(), background);
    }
    return expected;
}

// Number of wrong values. Floats may be off by 1 ulp, bytes and depths not at all. If the size is wrong, all are wrong.
inline std::size_t wrongValues(const Picture& picture, const std::vector<dfb::testing::Pixel>& expected)
{
    const std::size_t count = expected.size();
    if (picture.bytes.size() != count * dfb::bytesPerPixel(picture.format) || picture.bytes.empty()
        || (!picture.depth.empty() && picture.depth.size() != count))
        return 4 * count;
    std::size_t wrong = 0;
    for (std::size_t i = 0; i < count; ++i) {
        for (std::size_t c = 0; c < 4; ++c) {
            const dfb::testing::Exact exact = expected[i].rgba[c];
            if (picture.format == dfb::OutputFormat::RGBA32F) {
                wrong += dfb::testing::ulpsBetween(picture.value(4 * i + c), dfb::testing::toFloat(exact)) > 1;
            } else {
                const bool srgb = picture.format == dfb::OutputFormat::SRGBA8 && c < 3;
                wrong += static_cast<std::uint8_t>(picture.bytes[4 * i + c])
                         != (srgb ? dfb::testing::toSrgb8(exact) : dfb::testing::toUnorm8(exact));
            }
        }
        wrong += !picture.depth.empty() && picture.depth[i] != expected[i].depth;
    }
    return wrong;
}

// The outcome of a call as text: "fine", or the type and message of its exception.
template <class Call>
std::string outcomeOf(const Call& call)
{
    try {
        call();
    } catch (const dfb::FrameError& e) {
        return std::string("FrameError: ") + e.what();
    } catch (const dfb::InvalidArgument& e) {
        return std::string("InvalidArgument: ") + e.what();
    } catch (const dfb::TransportError& e) {
        return std::string("TransportError: ") + e.what();
    } catch (const std::exception& e) {
        return std::string("exception: ") + e.what();
    }
    return "fine";
}

inline bool has(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

// With one worker, tasks run in the order of arrival. Without workers, the threads of the ranks run them.
inline dfb::FrameBufferConfig configOf(const Scene& s, int threads = 1)
{
    dfb::FrameBufferConfig config;
    config.image.width = s.width;
    config.image.height = s.height;
    config.image.format = dfb::OutputFormat::RGBA32F;
    config.image.depth = true;
    if (threads > 0)
        config.executor = std::make_shared<dfb::ThreadExecutor>(threads);
    else
        config.executor = std::make_shared<dfb::CallerExecutor>();
    return config;
}

} // namespace scene
