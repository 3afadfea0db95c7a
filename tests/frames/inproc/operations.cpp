// Tile and pixel operations inside the framebuffer: those of the library and those of a user. Ranks are threads.
#include "catch.hpp"
#include "random_scene.hpp"

#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <utility>
#include <vector>
#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

namespace operations_cases {

namespace {

using scene::Loop;
using scene::Picture;
using scene::Scene;
using Blend = dfb::BasicAlphaBlend<16>;

template <class TileOp, class PixelOp = dfb::NoPixelOp>
using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, dfb::InprocTransport>;

dfb::FrameBufferConfig configFor(const Scene& s, dfb::OutputFormat format = dfb::OutputFormat::RGBA32F,
                                 bool depth = true)
{
    dfb::FrameBufferConfig config;
    config.image.width = s.width;
    config.image.height = s.height;
    config.image.format = format;
    config.image.depth = depth;
    config.executor = std::make_shared<dfb::ThreadExecutor>(2);
    return config;
}

template <class TileOp, class PixelOp>
Picture pictureOf(const Scene& s, Loop loop, const PixelOp& op, dfb::OutputFormat format = dfb::OutputFormat::RGBA32F,
                  bool depth = true, int ranks = 3, const typename dfb::detail::FrameDataOf<PixelOp>::type& data = {})
{
    Picture result;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<TileOp, PixelOp> fb(communicator, configFor(s, format, depth), op);
        const auto mine = scene::bricksOf(s, fb.rank(), fb.size());
        dfb::FrameReport report;
        if (loop == Loop::Declared)
            report = dfb::DataParallelLoop(fb, dfb::World(mine))
                         .render(
                             scene::FlatCamera(),
                             [&](const dfb::Brick& brick, auto& tile) { scene::renderBrick(s, brick, tile); },
                             scene::paramsOf(s), {}, data);
        else
            report = dfb::ImageParallelLoop(fb).render(
                [&](auto& tile) { scene::renderBrick(s, s.bricks.front(), tile); }, scene::paramsOf(s), {}, data);
        if (fb.isDisplayRank())
            result = Picture(fb.image(), report);
    });
    return result;
}

// Computes ToneMap on the float image of a frame without it, which is what a PixelOp gets.
std::vector<float> toneMapped(const Picture& plain, float exposure)
{
    std::vector<float> result(plain.bytes.size() / sizeof(float));
    for (std::size_t i = 0; i < result.size(); i += 4) {
        const float a = plain.value(i + 3) > 0 ? plain.value(i + 3) : 1.0f;
        for (std::size_t c = 0; c < 3; ++c) {
            const double k = static_cast<double>(exposure) * static_cast<double>(plain.value(i + c));
            result[i + c] = static_cast<float>(static_cast<double>(a) * k / (static_cast<double>(a) + k));
        }
        result[i + 3] = plain.value(i + 3);
    }
    return result;
}

std::int64_t worstUlps(const Picture& picture, const std::vector<float>& expected)
{
    std::int64_t worst =
        picture.bytes.size() == expected.size() * sizeof(float) ? 0 : std::numeric_limits<std::int64_t>::max();
    for (std::size_t i = 0; worst < 1000000 && i < expected.size(); ++i)
        worst = std::max(worst, dfb::testing::ulpsBetween(picture.value(i), expected[i]));
    return worst;
}

// A pixel operation that sees whole tiles, as it is not pointwise. It counts how often it sees each pixel, and marks
// pixels.
struct Watcher {
    struct Log {
        std::mutex mutex;
        std::map<int, int> tiles;
        std::vector<int> pixels;
        int wrong = 0;
    };
    std::shared_ptr<Log> log;
    int width = 0;
    bool withDepth = false;
    bool mark = false;

    void process(dfb::PixelTile& tile) const
    {
        const std::lock_guard<std::mutex> lock(log->mutex);
        ++log->tiles[tile.tile];
        log->wrong += (tile.depth != nullptr) != withDepth || tile.color == nullptr;
        for (int y = tile.region.y0; y < tile.region.y1; ++y)
            for (int x = tile.region.x0; x < tile.region.x1; ++x)
                ++log->pixels.at(static_cast<std::size_t>(y * width + x));
        // The tile's number, which is not a function of the pixel alone.
        for (std::size_t i = 0; mark && i < tile.pixelCount(); ++i)
            tile.color[4 * i] = static_cast<float>(tile.tile);
    }
};

Watcher makeWatcher(const Scene& s, bool withDepth, bool mark)
{
    Watcher w;
    w.log = std::make_shared<Watcher::Log>();
    w.log->pixels.resize(static_cast<std::size_t>(s.width * s.height));
    w.width = s.width;
    w.withDepth = withDepth;
    w.mark = mark;
    return w;
}

// A user's tile operation. Red is the number of inputs of a pixel, times a factor in the frame data; green the rank
// that owns the tile; blue the frame; alpha a value in the frame data.
struct CountInputs {
    static constexpr int tileSize = 16;
    static constexpr dfb::ChannelMask channels = dfb::colorChannel;
    struct FrameData {
        double factor = 0;
        std::vector<double> alpha; // by number of passes
    };

    void newFrame(const dfb::TileInfo& info, const FrameData& data)
    {
        info_ = info;
        data_ = data;
        counts_.assign(static_cast<std::size_t>(info.region.width() * info.region.height()), 0.0);
    }
    void add(dfb::Fragment&& fragment)
    {
        dfb::FragmentCursor cursor(fragment);
        for (int y = 0; y < info_.region.height(); ++y) {
            const dfb::FragmentRow row = cursor.next();
            for (int s = 0; s < row.spanCount; ++s)
                for (int i = 0; i < row.spans[s].count; ++i)
                    ++counts_.at(static_cast<std::size_t>(y * info_.region.width() + row.spans[s].x + i));
        }
    }
    void finish(dfb::FinishedTile& out)
    {
        std::vector<double> row(4 * static_cast<std::size_t>(out.width()));
        for (int y = 0; y < out.height(); ++y) {
            for (int x = 0; x < out.width(); ++x) {
                double* p = row.data() + 4 * x;
                p[0] = counts_[static_cast<std::size_t>(y * out.width() + x)] * data_.factor;
                p[1] = info_.rank;
                p[2] = static_cast<double>(info_.frame);
                p[3] = data_.alpha.at(static_cast<std::size_t>(info_.passes));
            }
            out.setRow(y, row.data(), nullptr);
        }
    }

private:
    dfb::TileInfo info_;
    FrameData data_;
    std::vector<double> counts_;
};
static_assert(dfb::is_tile_op_v<CountInputs>);

// An operation that has enough after the first input with pixels.
struct FirstOpaque : dfb::BasicAlphaBlend<16> {
    void newFrame(const dfb::TileInfo& info)
    {
        BasicAlphaBlend::newFrame(info);
        enough_ = false;
    }
    void add(dfb::Fragment&& fragment)
    {
        enough_ = enough_ || !fragment.empty();
        BasicAlphaBlend::add(std::move(fragment));
    }
    bool isComplete() const { return enough_; }

private:
    bool enough_ = false;
};
static_assert(dfb::is_tile_op_v<FirstOpaque>);

} // namespace

TEST_CASE("ToneMap is Reinhard's operator on the composited float image", "[operations]")
{
    const float exposure = 2.5f;
    for (const Loop loop : {Loop::Declared, Loop::ImageOwned}) {
        Scene s = scene::makeScene(5, 3);
        s.bricks[0].bounds = {{0, 0, 0}, {70, 50, 1}}; // leaves background tiles
        const auto mapped = [&](dfb::OutputFormat format, bool depth) {
            return loop == Loop::Declared
                       ? pictureOf<Blend>(s, loop, dfb::ToneMap(), format, depth, 3, {exposure})
                       : pictureOf<dfb::BasicImageParallel<16>>(s, loop, dfb::ToneMap(), format, depth, 3, {exposure});
        };
        const Picture plain = loop == Loop::Declared
                                  ? pictureOf<Blend>(s, loop, dfb::NoPixelOp())
                                  : pictureOf<dfb::BasicImageParallel<16>>(s, loop, dfb::NoPixelOp());
        const auto expected = toneMapped(plain, exposure);
        const Picture floats = mapped(dfb::OutputFormat::RGBA32F, true);
        // ToneMap rounds 4 times in float, by half an ulp each, where the reference rounds once. No error is amplified.
        CHECK(worstUlps(floats, expected) <= 4);
        CHECK(floats.depth == plain.depth);
        // With a PixelOp the output is rounded from its float result.
        for (const auto format : {dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8}) {
            const Picture bytes = mapped(format, false);
            REQUIRE(bytes.bytes.size() == expected.size());
            std::size_t wrong = 0;
            for (std::size_t i = 0; i < expected.size(); ++i) {
                const dfb::testing::Exact v = floats.value(i);
                const bool srgb = format == dfb::OutputFormat::SRGBA8 && i % 4 != 3;
                wrong += static_cast<std::uint8_t>(bytes.bytes[i])
                         != (srgb ? dfb::testing::toSrgb8(v) : dfb::testing::toUnorm8(v));
            }
            CHECK(wrong == 0);
        }
    }
}

TEST_CASE("ToneMap keeps emission and alpha", "[operations]")
{
    dfb::ToneMap op;
    op.newFrame({2.0f});
    std::vector<float> pixels{0.5f, 0.25f, 0, 0.5f, /* emission */ 1.0f, 0, 0, 0, /* nothing */ 0, 0, 0, 0};
    dfb::PixelTile tile{0, {0, 0, 3, 1}, pixels.data(), nullptr};
    op.process(tile);
    // Colour 1, times exposure 2: 2/3, times alpha. Colour 0.5: 1/2. Emission 1: 2/3.
    CHECK(dfb::testing::ulpsBetween(pixels[0], 1.0f / 3) <= 4);
    CHECK(pixels[1] == 0.25f);
    CHECK(pixels[3] == 0.5f);
    CHECK(dfb::testing::ulpsBetween(pixels[4], 2.0f / 3) <= 4);
    CHECK(pixels[7] == 0.0f);
    CHECK(pixels[8] == 0.0f);
    // An infinite colour becomes alpha, which is the limit of the curve.
    const float infinity = std::numeric_limits<float>::infinity();
    pixels = {3e38f, infinity, 0, 0.5f};
    tile = {0, {0, 0, 1, 1}, pixels.data(), nullptr};
    op.process(tile);
    CHECK(pixels == std::vector<float>{0.5f, 0.5f, 0, 0.5f});
}

TEST_CASE("PixelOpChain runs the first, then the second, each with its data", "[operations]")
{
    Scene s = scene::makeScene(5, 3);
    using Chain = dfb::PixelOpChain<dfb::ToneMap, dfb::ToneMap>;
    Chain::FrameData data;
    data.first.exposure = 3.0f;
    data.second.exposure = 0.5f;
    const Picture plain = pictureOf<Blend>(s, Loop::Declared, dfb::NoPixelOp());
    const Picture once =
        pictureOf<Blend>(s, Loop::Declared, dfb::ToneMap(), dfb::OutputFormat::RGBA32F, true, 3, {3.0f});
    const Picture both = pictureOf<Blend>(s, Loop::Declared, Chain(), dfb::OutputFormat::RGBA32F, true, 3, data);
    CHECK(worstUlps(both, toneMapped(once, 0.5f)) <= 4);
    CHECK(both.hash() != once.hash());
    CHECK(once.hash() != plain.hash());

    // A chain with a member that is not pointwise is not pointwise: that member sees all tiles, after the first member.
    const Watcher watcher = makeWatcher(s, true, false);
    using Watched = dfb::PixelOpChain<dfb::ToneMap, Watcher>;
    Watched::FrameData watchedData;
    watchedData.first.exposure = 3.0f;
    const Picture watched =
        pictureOf<Blend>(s, Loop::Declared, Watched{{}, watcher}, dfb::OutputFormat::RGBA32F, true, 3, watchedData);
    CHECK(watched.hash() == once.hash());
    CHECK(watcher.log->tiles.size() == 28);
}

TEST_CASE("A pixel operation that is not pointwise sees every tile of the image once", "[operations]")
{
    for (const Loop loop : {Loop::Declared, Loop::ImageOwned})
        for (const int bricks : {0, 2})
            for (const auto format : {dfb::OutputFormat::RGBA32F, dfb::OutputFormat::None})
                for (const int ranks : {1, 4}) {
                    Scene s = scene::makeScene(bricks, 14);
                    if (loop == Loop::ImageOwned && bricks == 0)
                        continue;
                    const Watcher watcher = makeWatcher(s, true, true);
                    const Picture p =
                        loop == Loop::Declared
                            ? pictureOf<Blend>(s, loop, watcher, format, true, ranks)
                            : pictureOf<dfb::BasicImageParallel<16>>(s, loop, watcher, format, true, ranks);
                    INFO("loop " << static_cast<int>(loop) << ", " << bricks << " bricks, " << ranks
                                 << " ranks, format " << static_cast<int>(format));
                    CHECK(watcher.log->wrong == 0);
                    CHECK(watcher.log->tiles.size() == 28);
                    CHECK(std::all_of(watcher.log->tiles.begin(), watcher.log->tiles.end(),
                                      [](const auto& t) { return t.second == 1; }));
                    CHECK(std::all_of(watcher.log->pixels.begin(), watcher.log->pixels.end(),
                                      [](int n) { return n == 1; }));
                    if (format == dfb::OutputFormat::None) {
                        CHECK(p.bytes.empty());
                        continue;
                    }
                    const dfb::TileLayout layout(s.width, s.height, 16);
                    std::size_t unmarked = 0;
                    for (int y = 0; y < s.height; ++y)
                        for (int x = 0; x < s.width; ++x)
                            unmarked += p.value(4 * static_cast<std::size_t>(y * s.width + x))
                                        != static_cast<float>(layout.tileAt(x / 16, y / 16));
                    CHECK(unmarked == 0);
                }
}

TEST_CASE("A tile operation of a user's, with data for the frame", "[operations]")
{
    const Scene s = scene::makeScene(6, 15, 97, 61, 2);
    std::size_t wrong = 0;
    int framesSeen = 0;
    dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
        auto config = configFor(s, dfb::OutputFormat::RGBA32F, false);
        config.image.displayRank = 2;
        FrameBuffer<CountInputs> fb(communicator, config);
        for (int frame = 1; frame <= 3; ++frame) {
            CountInputs::FrameData data;
            data.factor = 0.5 * frame;
            data.alpha = {0, 0, 0.25 * frame};
            dfb::FrameConfig params = scene::paramsOf(s);
            params.declared = true;
            auto open = fb.begin(params, data);
            std::vector<dfb::TileInput> inputs;
            const auto mine = scene::bricksOf(s, fb.rank(), fb.size());
            // Every tile gets every brick, so most inputs are empty.
            for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                for (const dfb::Brick& brick : mine)
                    inputs.push_back({tile, brick.id, 0});
            open.declare(inputs);
            FrameBuffer<CountInputs>::Tile tile;
            for (int pass = 0; pass < s.passes; ++pass)
                for (const dfb::TileInput& input : inputs) {
                    open.start(tile, input.tile, pass);
                    tile.generation = 1;
                    tile.source = input.source;
                    for (const dfb::Brick& brick : mine)
                        for (int y = tile.region.y0; brick.id == input.source && y < tile.region.y1; ++y)
                            for (int x = tile.region.x0; x < tile.region.x1; ++x)
                                if (const auto sample = scene::sampleOf(s, brick, pass, x, y))
                                    std::copy(sample->rgba.begin(), sample->rgba.end(),
                                              tile.pixel(x - tile.region.x0, y - tile.region.y0));
                    open.setTile(tile);
                }
            const dfb::FrameReport report = open.end();
            if (!fb.isDisplayRank())
                continue;
            ++framesSeen;
            const Picture p(fb.image(), report);
            for (int y = 0; y < s.height; ++y)
                for (int x = 0; x < s.width; ++x) {
                    int count = 0;
                    for (int pass = 0; pass < s.passes; ++pass)
                        for (const dfb::Brick& brick : s.bricks) {
                            const auto sample = scene::sampleOf(s, brick, pass, x, y);
                            count += sample
                                     && (sample->rgba[0] != 0 || sample->rgba[1] != 0 || sample->rgba[2] != 0
                                         || sample->rgba[3] != 0);
                        }
                    const std::size_t i = 4 * static_cast<std::size_t>(y * s.width + x);
                    wrong += p.value(i) != static_cast<float>(count * 0.5 * frame);
                    wrong += p.value(i + 1) != static_cast<float>(fb.tileOwner(fb.layout().tileAt(x / 16, y / 16)));
                    wrong += p.value(i + 2) != static_cast<float>(report.frame);
                    wrong += p.value(i + 3) != static_cast<float>(0.25 * frame);
                }
        }
    });
    CHECK(framesSeen == 3);
    CHECK(wrong == 0);
}

TEST_CASE("A tile operation that has enough ends its tile early", "[operations]")
{
    // Each tile gets an opaque input and also waits for one that never comes.
    Scene s = scene::makeScene(1, 16);
    std::vector<std::int64_t> late(2, -1);
    std::vector<std::size_t> wrong(2, 1);
    const float opaque[4] = {0.25f, 0.5f, 0.75f, 1.0f};
    const auto isOpaque = [&](const Picture& p) {
        std::size_t count = 0;
        for (std::size_t i = 0; i < p.bytes.size() / sizeof(float); ++i)
            count += p.value(i) != opaque[i % 4];
        return count + (p.bytes.empty() ? 1 : 0);
    };
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<FirstOpaque> fb(communicator, configFor(s));
        auto tile = std::make_unique<FrameBuffer<FirstOpaque>::Tile>();
        for (std::size_t frame = 0; frame < 2; ++frame) {
            auto open = fb.begin();
            for (int index : fb.ownedTiles()) {
                open.start(*tile, index);
                tile->children = 2; // the second never comes
                open.setTile(*tile);
            }
            for (int index = 0; index < fb.layout().tileCount(); ++index)
                if (index % 2 == fb.rank()) {
                    open.start(*tile, index);
                    tile->fill({opaque[0], opaque[1], opaque[2], opaque[3]}, 1.0f);
                    tile->generation = 1;
                    open.setTile(*tile);
                }
            const auto report = open.end();
            if (fb.isDisplayRank()) {
                wrong[frame] = isOpaque(Picture(fb.image(), report));
                late[frame] = report.lateMessages;
            }
        }
    });
    CHECK(wrong == std::vector<std::size_t>(2));
    CHECK(late == std::vector<std::int64_t>(2));
}

#if defined(__SSE2__) || defined(__aarch64__)
namespace {

void flushDenormals() // as Embree asks for
{
#if defined(__SSE2__)
    _mm_setcsr(_mm_getcsr() | 0x8040);
#else
    using Environment = dfb::detail::FloatEnvironment;
    Environment::setControlRegister(Environment::controlRegister() | Environment::flushToZero);
#endif
}

} // namespace

TEST_CASE("A renderer that flushes denormals on its threads does not change the image", "[operations]")
{
    Scene s = scene::makeScene(0);
    s.background = {0, 0, 0, 0};
    // A denormal, and 2^-31, which is a denormal in half precision.
    for (const auto& [wire, value] :
         {std::make_pair(dfb::WireFormat::Float32, 1000u), std::make_pair(dfb::WireFormat::Float16, 0x30000000u)}) {
        Picture p;
        dfb::runRanks(2, [&, wire = wire, value = value](dfb::InprocCommunicator communicator) {
            dfb::FrameBufferConfig config = configFor(s);
            config.precision = wire;
            FrameBuffer<Blend> fb(communicator, config);
            const std::vector<dfb::Brick> bricks{{7, {{0, 0, 0}, {97, 61, 1}}}};
            const dfb::World world(fb.rank() == 1 ? bricks : std::vector<dfb::Brick>());
            const auto report =
                dfb::DataParallelLoop(fb, world).render(scene::FlatCamera(), [&](const dfb::Brick&, auto& tile) {
                    flushDenormals(); // and does not undo it
                    for (int i = 0; i < 4 * 16 * 16; ++i)
                        std::memcpy(tile.color + i, &value, sizeof value);
                });
            if (fb.isDisplayRank())
                p = Picture(fb.image(), report);
        });
        std::size_t wrong = 0;
        for (std::size_t i = 0; i < p.bytes.size(); i += 4) {
            std::uint32_t bits = 0;
            std::memcpy(&bits, p.bytes.data() + i, sizeof bits);
            wrong += bits != value;
        }
        CHECK(p.bytes.size() == 97 * 61 * 16);
        CHECK(wrong == 0);
    }
}
#endif

} // namespace operations_cases
