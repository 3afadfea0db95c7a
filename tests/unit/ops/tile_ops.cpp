// The tile operations against the serial reference: adversarial fragments, sent through the wire format, in every
// arrival order.
#include "brief.hpp"
#include "catch.hpp"

#include <dfb/ops/image_parallel.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/adversarial.hpp>
#include <dfb/wire/fragment_message.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <iterator>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

namespace tile_ops_cases {

namespace {

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr float notANumber = std::numeric_limits<float>::quiet_NaN();

using dfb::testing::adversarial;
using dfb::testing::ErrorReport;
using dfb::testing::Random;
using dfb::testing::TileInputs;
using dfb::testing::TileOutput;
using dfb::testing::uniform;

// A user's operation: the image is white where any input has a depth.
struct HasDepth {
    static constexpr int tileSize = 8;
    static constexpr dfb::ChannelMask channels = dfb::colorChannel | dfb::depthChannel;
    static constexpr bool activeByDepth = true;

    void newFrame(const dfb::TileInfo& info) { there_.assign(static_cast<std::size_t>(info.region.width()) * 8, 0); }
    void add(dfb::Fragment&& fragment)
    {
        dfb::FragmentCursor cursor(fragment);
        for (std::size_t y = 0; y < 8; ++y) {
            const dfb::FragmentRow row = cursor.next();
            for (int s = 0; s < row.spanCount; ++s)
                std::fill_n(there_.begin() + static_cast<std::ptrdiff_t>(8 * y + row.spans[s].x), row.spans[s].count,
                            1);
        }
    }
    void finish(dfb::FinishedTile& out)
    {
        for (int y = 0; y < 8; ++y) {
            double row[32];
            for (int i = 0; i < 32; ++i)
                row[i] = there_[static_cast<std::size_t>(8 * y + i / 4)];
            out.setRow(y, row, nullptr);
        }
    }

private:
    std::vector<int> there_;
};

template <class Op>
dfb::testing::ErrorReport compare(const TileInputs<Op::tileSize>& in)
{
    return dfb::testing::compare<Op>(in, dfb::testing::referenceOf(in));
}

// An input with 8 bits a channel, and the same pixels as floats.
struct ByteInput {
    std::vector<std::uint8_t> bytes = std::vector<std::uint8_t>(4 * 50 * 20);
    std::vector<float> floats, depth = std::vector<float>(50 * 20), normal = std::vector<float>(3 * 50 * 20, 0.5f);
    dfb::Region valid{0, 0, 50, 20};
    float depthLimit = infinity;
    bool isInPlace = false;
    int pass = 0;

    ByteInput(Random& random, int passes, bool mayBeInPlace)
    {
        const float depths[] = {1, 2, 0, -0.0f, 1, -infinity, infinity, notANumber, 0.5f, 3};
        const std::uint64_t kind = random() % 4; // in short runs, in long ones, everywhere, the same everywhere
        std::uint32_t pixel = 0;
        std::size_t which = 0;
        for (std::size_t i = 0; i < depth.size(); ++i) {
            if (i == 0 || (kind != 3 && random() % (kind == 0 ? 2 : 40) == 0)) {
                pixel = static_cast<std::uint32_t>(random()) | (random() % 2 ? 0xff000000u : 0);
                which = random() % (kind < 2 ? 10 : 6);
            }
            std::memcpy(&bytes[4 * i], &pixel, 4);
            depth[i] = depths[which];
        }
        for (const std::uint8_t byte : bytes)
            floats.push_back(static_cast<float>(byte) / 255.0f);
        if (random() % 2) {
            valid.x0 = static_cast<int>(random() % 20), valid.x1 = 21 + static_cast<int>(random() % 30);
            valid.y0 = static_cast<int>(random() % 10), valid.y1 = 11 + static_cast<int>(random() % 10);
        }
        depthLimit = random() % 3 == 0 ? 2.0f : infinity;
        isInPlace = mayBeInPlace && random() % 2;
        pass = static_cast<int>(random() % static_cast<std::uint64_t>(passes));
    }
};

struct ByteOutput {
    TileOutput tile;
    std::vector<float> normal;
    std::int64_t faults = 0;
};

// Composites the inputs as bytes, which stay unchanged until finish(), or as floats.
template <class Op>
ByteOutput runBytes(const std::vector<ByteInput>& inputs, const dfb::TileInfo& info, bool asBytes,
                    dfb::OutputFormat format, bool dither)
{
    namespace d = dfb::detail;
    const auto pool = dfb::MemoryPool::create();
    const dfb::TileLayout layout(50, 20, 64);
    const d::WireCoder coder(dfb::Precision(), d::active_by_depth_v<Op>, true);
    const auto sent = static_cast<dfb::ChannelMask>(dfb::colorChannel | dfb::depthChannel | info.wanted);
    ByteOutput out;
    d::InputFaults faults;
    d::FaultCounts counts;
    Op op;
    op.newFrame(info);
    for (std::size_t i = inputs.size(); i-- > 0;) {
        const ByteInput& input = inputs[i];
        dfb::TileView<dfb::colorChannel | dfb::depthChannel | dfb::normalChannel, 64> view;
        view.tile = 0;
        view.region = layout.region(0);
        view.source = static_cast<std::uint32_t>(i);
        view.pass = input.pass;
        view.stride = 50;
        view.color8 = asBytes ? input.bytes.data() : nullptr;
        view.color = asBytes ? nullptr : input.floats.data();
        view.depth = input.depth.data();
        view.normal = input.normal.data();
        view.valid = input.valid;
        d::InputPixels pixels(view);
        pixels.depthLimit = input.depthLimit;
        if (input.isInPlace) {
            dfb::Fragment::Parts parts;
            parts.encoding = dfb::FragmentEncoding::InPlace;
            parts.channels = sent;
            parts.inPlace = d::pixelsInPlace(pixels, sent, coder.activeByDepth());
            parts.faults = &counts;
            op.add(dfb::Fragment(view, dfb::Buffer(), parts));
            continue;
        }
        dfb::Buffer message =
            d::encodeFragment(*pool, pixels, sent, 0, nullptr, coder, dfb::WireFormat::Float32, faults);
        op.add(d::decodeFragment(
            *pool, std::move(message), layout, [&](int) { return info.passes; }, nullptr, coder));
    }
    const bool hasDepth = (info.wanted & dfb::depthChannel) != 0, hasNormal = (info.wanted & dfb::normalChannel) != 0;
    out.tile.color.assign(50 * 20 * dfb::bytesPerPixel(format), std::byte{0xcd});
    out.tile.depth.assign(hasDepth ? 50 * 20 : 0, -7.0f);
    out.normal.assign(hasNormal ? 3 * 50 * 20 : 0, -7.0f);
    d::Planes planes;
    planes.at[d::Color] = out.tile.color.data();
    planes.at[d::Depth] = hasDepth ? reinterpret_cast<std::byte*>(out.tile.depth.data()) : nullptr;
    planes.at[d::Normal] = hasNormal ? reinterpret_cast<std::byte*>(out.normal.data()) : nullptr;
    dfb::FinishedTile finished(layout.region(0), format, planes, 50, dither);
    op.finish(finished);
    out.faults = counts.nonFinite + static_cast<std::int64_t>(faults.nonFinite);
    return out;
}

// Whether all colours of a row of floats become 0 if all are -0.
bool hasNoSign(bool isPastCache, bool dither)
{
    namespace d = dfb::detail;
    constexpr int width = 35;
    alignas(64) static float image[4 * width];
    std::fill(std::begin(image), std::end(image), 7.0f);
    d::Planes planes;
    planes.at[d::Color] = reinterpret_cast<std::byte*>(image);
    dfb::FinishedTile finished({0, 0, width, 1}, dfb::OutputFormat::RGBA32F, planes, width, dither);
    if (isPastCache)
        finished.storePastCache();
    finished.setRow(0, std::vector<float>(std::size_t{4} * width, -0.0f).data(), nullptr);
    return std::all_of(std::begin(image), std::end(image), [](float v) { return v == 0 && !std::signbit(v); });
}

template <class Op>
void checkBytes(std::uint64_t seed)
{
    Random random(seed);
    dfb::TileInfo info;
    info.region = {0, 0, 50, 20};
    info.passes = random() % 4 == 0 ? 2 : 1;
    info.wanted = random() % 2 ? dfb::depthChannel : dfb::ChannelMask{0};
    if ((Op::channels & dfb::normalChannel) != 0)
        info.wanted |= dfb::normalChannel;
    if (random() % 2)
        info.background = {0.1f, 0.25f, 0.5f, random() % 2 ? 1.0f : 0.5f};
    std::vector<ByteInput> inputs;
    for (std::uint64_t i = 0, count = random() % 6; i < count; ++i)
        inputs.emplace_back(random, info.passes, (Op::channels & dfb::normalChannel) == 0);
    const dfb::OutputFormat formats[] = {dfb::OutputFormat::RGBA8, dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8,
                                         dfb::OutputFormat::RGBA32F};
    const dfb::OutputFormat format = formats[random() % 4];
    const bool dither = random() % 5 == 0;
    INFO("seed " << seed << ", " << inputs.size() << " inputs, " << info.passes << " passes");
    const ByteOutput bytes = runBytes<Op>(inputs, info, true, format, dither);
    const ByteOutput floats = runBytes<Op>(inputs, info, false, format, dither);
    CHECK(bytes.tile == floats.tile);
    CHECK(bytes.normal == floats.normal);
    CHECK(bytes.faults == floats.faults);
}

} // namespace

TEST_CASE("A row of floats becomes the same wherever it is stored: 0 for -0", "[tile_ops]")
{
    for (const bool isPastCache : {false, true})
        for (const bool dither : {false, true})
            CHECK(hasNoSign(isPastCache, dither));
}

TEST_CASE("AlphaBlend is within 1 ulp of exact in float, exact in 8 bits and in depth", "[ops]")
{
    std::uint64_t seed = 100;
    for (int layers : {1, 2, 3, 5, 8, 16, 33, 64})
        for (int passes : {1, 2, 3})
            for (int i = 0; i < 3; ++i) {
                INFO("seed " << seed << ", " << layers << " layers, " << passes << " passes");
                const ErrorReport c = compare<dfb::BasicAlphaBlend<8>>(adversarial<8>(seed++, layers, passes));
                // The bound is 1 ulp: two roundings, to double on the way and to float, can both go the wrong way at a
                // tie.
                CHECK(c.ulpsBelow() <= 2);
                CHECK(c.wrongBytes == 0);
            }
    // Rows wide enough for the fast path that finds how far an order holds.
    for (int layers : {2, 4, 7}) {
        INFO("seed " << seed << ", " << layers << " layers of 64x64");
        const ErrorReport c = compare<dfb::AlphaBlend>(adversarial<64>(seed++, layers, 1));
        CHECK(c.ulpsBelow() <= 2);
        CHECK(c.wrongBytes == 0);
    }
}

TEST_CASE("DepthComposite is within 1 ulp of exact in float, exact in 8 bits and in depth", "[ops]")
{
    using Op = dfb::BasicDepthComposite<8>;
    for (std::uint64_t seed = 300; seed < 340; ++seed) {
        auto in = adversarial<8>(seed, 1 + static_cast<int>(seed % 9), 1 + static_cast<int>(seed % 3));
        Random random(seed);
        for (const auto& tile : in.tiles) // without colour, without depth, with a NaN depth
            for (int i = 0; i < 64; ++i) {
                if (random() % 4 == 0)
                    std::fill_n(tile->color + 4 * i, 4, 0.0f);
                if (random() % 8 == 0)
                    tile->depth[i] = random() % 2 ? infinity : notANumber;
            }
        const auto expected = dfb::testing::referenceOf(in, [&](const std::vector<dfb::testing::Sample>& samples) {
            return dfb::testing::nearest(samples, in.background);
        });
        INFO("seed " << seed);
        const ErrorReport c = dfb::testing::compare<Op>(in, expected);
        CHECK(c.ulpsBelow() <= 2);
        CHECK(c.wrongBytes == 0);
    }
}

TEST_CASE("Pixels of 8 bits a channel give the same picture as the same pixels as floats, bit for bit", "[ops]")
{
    for (int seed = 1000; seed < 1000 + repeats(600); ++seed) {
        checkBytes<dfb::DepthComposite>(seed);
        checkBytes<dfb::BasicDepthComposite<64, dfb::colorChannel | dfb::depthChannel | dfb::normalChannel>>(seed);
        checkBytes<dfb::AlphaBlend>(seed);
    }
}

TEST_CASE("An operation of a user's may say that depth is what counts", "[ops]")
{
    TileInputs<8> in;
    auto& tile = in.add(0, 0);
    tile.fill({1, 1, 1, 1});
    for (int i = 0; i < 64; i += 3) {
        tile.depth[i] = static_cast<float>(i);
        std::fill_n(tile.color + 4 * i, 4, 0.0f);
    }
    const TileOutput out = dfb::testing::runTileOp<HasDepth>(in, {0}, dfb::OutputFormat::RGBA32F);
    int wrong = 0;
    for (std::size_t i = 0; i < 64; ++i)
        wrong += out.value(4 * i) != (i % 3 == 0 ? 1.0f : 0.0f);
    CHECK(wrong == 0);
}

TEST_CASE("ImageParallel is within 1 ulp of exact in float, exact in 8 bits and in depth", "[ops]")
{
    for (std::uint64_t seed = 1; seed <= 12; ++seed) {
        INFO("seed " << seed);
        const ErrorReport c =
            compare<dfb::BasicImageParallel<16>>(adversarial<16>(seed, 1, 1 + static_cast<int>(seed % 3), true));
        CHECK(c.ulpsBelow() <= 2);
        CHECK(c.wrongBytes == 0);
    }
}

TEST_CASE("ImageParallel takes tiles of generation 0 without children only", "[ops]")
{
    TileInputs<8> in;
    in.add(0, 0, 0, 1);
    CHECK_THROWS_AS(dfb::testing::runTileOp<dfb::BasicImageParallel<8>>(in, {0}, dfb::OutputFormat::RGBA8),
                    dfb::InvalidArgument);
    in.tiles[0]->generation = 0;
    in.tiles[0]->children = 2;
    CHECK_THROWS_AS(dfb::testing::runTileOp<dfb::BasicImageParallel<8>>(in, {0}, dfb::OutputFormat::RGBA8),
                    dfb::InvalidArgument);
    in.tiles[0]->children = 0;
    CHECK_NOTHROW(dfb::testing::runTileOp<dfb::BasicImageParallel<8>>(in, {0}, dfb::OutputFormat::RGBA8));
}

TEST_CASE("Arrival order does not show", "[ops]")
{
    for (std::uint64_t seed = 500; seed < 512; ++seed) {
        const TileInputs<8> in = adversarial<8>(seed, 2 + static_cast<int>(seed % 11), 1 + static_cast<int>(seed % 3));
        auto order = in.order();
        Random random(seed);
        for (const auto format : {dfb::OutputFormat::RGBA32F, dfb::OutputFormat::SRGBA8}) {
            const TileOutput first = dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, order, format);
            std::size_t different = 0;
            for (int i = 0; i < 12; ++i) {
                std::shuffle(order.begin(), order.end(), random);
                different += !(dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, order, format) == first);
            }
            INFO("seed " << seed);
            CHECK(different == 0);
        }
    }
}

TEST_CASE("Equal depths are decided by source, then part", "[ops]")
{
    TileInputs<8> in;
    const auto put = [&](std::uint32_t source, std::uint16_t part, float red, float green) {
        auto& t = in.add(0, source, part);
        t.fill({red, green, 0, 1}, 2.0f);
    };
    put(3, 0, 0.5f, 0.0f);
    put(1, 1, 0.0f, 0.5f);
    put(1, 0, 0.25f, 0.75f); // the lowest source and part wins
    const TileOutput out = dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, {0, 1, 2}, dfb::OutputFormat::RGBA32F);
    CHECK(out.value(0) == 0.25f);
    CHECK(out.value(1) == 0.75f);
}

TEST_CASE("4096 thin layers at one pixel", "[ops]")
{
    // In single precision, accumulation would be off by hundreds of ulps.
    for (const float alpha : {1.0f / 4096.0f, 0x1p-20f, 0.01f}) {
        Random random(7);
        TileInputs<8> in;
        for (std::uint32_t i = 0; i < 4096; ++i) {
            auto& t = in.add(0, i);
            float* p = t.pixel(5, 2);
            p[3] = alpha * (0.5f + uniform(random));
            for (int c = 0; c < 3; ++c)
                p[c] = p[3] * uniform(random);
            t.depth[2 * 8 + 5] = static_cast<float>(dfb::testing::below(random, 1000)); // many ties
        }
        INFO("alpha about " << alpha);
        const ErrorReport c = compare<dfb::BasicAlphaBlend<8>>(in);
        CHECK(c.ulpsBelow() <= 2);
        CHECK(c.wrongBytes == 0);
    }
}

TEST_CASE("Exact cases by hand", "[ops]")
{
    using Blend = dfb::BasicAlphaBlend<8>;
    SECTION("nothing at all is the background")
    {
        TileInputs<8> in;
        in.background = {0.1f, 0.2f, 0.3f, 0.4f};
        const TileOutput out = dfb::testing::runTileOp<Blend>(in, {}, dfb::OutputFormat::RGBA32F);
        std::size_t wrong = 0;
        for (std::size_t i = 0; i < 64; ++i)
            for (std::size_t c = 0; c < 4; ++c)
                wrong += out.value(4 * i + c) != in.background[c] || out.depth[i] != infinity;
        CHECK(wrong == 0);
    }
    SECTION("emission: colour with alpha 0 adds, hides nothing and has no depth")
    {
        TileInputs<8> in;
        in.add(0, 0).fill({4.0f, 0.5f, 0.0f, 0.0f}, 1.0f);
        in.add(0, 1).fill({0.5f, 0.25f, 0.0f, 0.5f}, 2.0f);
        const TileOutput out = dfb::testing::runTileOp<Blend>(in, {1, 0}, dfb::OutputFormat::RGBA32F);
        CHECK(out.value(0) == 4.5f);
        CHECK(out.value(1) == 0.75f);
        CHECK(out.value(3) == 0.5f);
        CHECK(out.depth[0] == 2.0f);
    }
    SECTION("an opaque layer hides what is behind, exactly")
    {
        TileInputs<8> in;
        in.background = {1, 1, 1, 1};
        in.add(0, 0).fill({1e30f, 1e30f, 1e30f, 0.5f}, 3.0f);
        in.add(0, 1).fill({0.25f, 0.5f, 0.75f, 1.0f}, -1.0f);
        const TileOutput out = dfb::testing::runTileOp<Blend>(in, {0, 1}, dfb::OutputFormat::RGBA32F);
        CHECK(out.value(0) == 0.25f);
        CHECK(out.value(1) == 0.5f);
        CHECK(out.value(2) == 0.75f);
        CHECK(out.value(3) == 1.0f);
        CHECK(out.depth[0] == -1.0f);
    }
    SECTION("8 bits round ties to even")
    {
        // 0.5 * 255 = 127.5 is the only tie that floats can produce.
        TileInputs<8> in;
        in.add(0, 0).fill({0.5f, std::nextafter(0.5f, 0.0f), std::nextafter(0.5f, 1.0f), 0.25f}, 0.0f);
        const TileOutput out = dfb::testing::runTileOp<Blend>(in, {0}, dfb::OutputFormat::RGBA8);
        CHECK(static_cast<int>(out.color[0]) == 128);
        CHECK(static_cast<int>(out.color[1]) == 127);
        CHECK(static_cast<int>(out.color[2]) == 128);
        CHECK(static_cast<int>(out.color[3]) == 64);
    }
    SECTION("passes are composited each by itself, then averaged")
    {
        // Two bricks that cover the same half of a pixel: both are hit in pass 0, neither in pass 1.
        TileInputs<8> in;
        in.passes = 2;
        in.background = {0, 0, 1, 1};
        in.add(0, 0).fill({1, 0, 0, 1}, 1.0f);
        in.add(0, 1).fill({0, 1, 0, 1}, 2.0f);
        const TileOutput out = dfb::testing::runTileOp<Blend>(in, {0, 1}, dfb::OutputFormat::RGBA32F);
        CHECK(out.value(0) == 0.5f);
        CHECK(out.value(1) == 0.0f);
        CHECK(out.value(2) == 0.5f);
        CHECK(out.value(3) == 1.0f);
        CHECK(out.depth[0] == 1.0f);
    }
    SECTION("without depth, fragments count as equally near and go by source")
    {
        TileInputs<8> in;
        in.add(0, 1).fill({1, 0, 0, 1}, 1.0f);
        in.add(0, 0).fill({0, 1, 0, 1}, 2.0f);
        const TileOutput out =
            dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, {0, 1}, dfb::OutputFormat::RGBA32F, false);
        CHECK(out.value(0) == 1.0f); // AlphaBlend needs depth and gets it, whatever the output has
        CHECK(out.depth.empty());
    }
}

TEST_CASE("What is not finite spoils its own pixel and is counted", "[ops]")
{
    const int x = 3, y = 4;
    const auto pixel = static_cast<std::size_t>(y * 8 + x);
    struct Spoilt {
        const char* name;
        int channel; // 4: depth
        float value;
    };
    const std::vector<Spoilt> cases{{"red is NaN", 0, notANumber},
                                    {"alpha is NaN", 3, notANumber},
                                    {"green is infinite", 1, infinity},
                                    {"depth is NaN", 4, notANumber}};
    for (const Spoilt& spoilt : cases) {
        INFO(spoilt.name);
        TileInputs<8> in = adversarial<8>(2, 6, 1);
        auto& t = in.add(0, 50);
        t.fill({0.25f, 0.25f, 0.25f, 0.5f}, 0.5f);
        const TileOutput clean =
            dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, in.order(), dfb::OutputFormat::RGBA32F);
        CHECK(clean.faults.nonFinite == 0);
        (spoilt.channel == 4 ? t.depth[y * 8 + x] : t.pixel(x, y)[spoilt.channel]) = spoilt.value;
        const auto order = in.order();
        const TileOutput out = dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, order, dfb::OutputFormat::RGBA32F);
        CHECK(out.faults.nonFinite == 1);
        std::size_t changedElsewhere = 0;
        for (std::size_t i = 0; i < 64; ++i)
            if (i != pixel)
                for (std::size_t c = 0; c < 4; ++c)
                    changedElsewhere += dfb::testing::ulpsBetween(out.value(4 * i + c), clean.value(4 * i + c)) != 0
                                        || out.depth[i] != clean.depth[i];
        CHECK(changedElsewhere == 0);
        // At the damaged pixel the result follows from the arithmetic. So does the reference, in which a NaN depth is
        // farthest.
        const auto expected = dfb::testing::referenceOf(in);
        for (std::size_t c = 0; c < 4; ++c)
            CHECK(dfb::testing::ulpsBetween(out.value(4 * pixel + c), dfb::testing::toFloat(expected[pixel].rgba[c]))
                  <= 1);
        auto reversed = order;
        std::reverse(reversed.begin(), reversed.end());
        CHECK(dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, reversed, dfb::OutputFormat::RGBA8)
              == dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, order, dfb::OutputFormat::RGBA8));
    }

    SECTION("a NaN depth is farther than everything that is finite")
    {
        TileInputs<8> in;
        in.add(0, 0).fill({1, 0, 0, 1}, notANumber);
        in.add(0, 1).fill({0, 1, 0, 1}, 1e38f);
        const TileOutput out = dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, {0, 1}, dfb::OutputFormat::RGBA32F);
        CHECK(out.value(0) == 0.0f);
        CHECK(out.value(1) == 1.0f);
        CHECK(out.depth[0] == 1e38f);
    }
}

TEST_CASE("8 bits are the exact result rounded also next to a tie", "[ops]")
{
    // Nearly opaque layers: alpha is 1/2 minus something far below the last bit of a double, or plus it.
    for (const bool above : {false, true})
        for (const int passes : {1, 2, 3}) {
            TileInputs<8> in;
            in.passes = passes;
            for (int pass = 0; pass < passes; ++pass)
                for (std::uint32_t source = 0; source < 5; ++source) {
                    auto& tile = in.add(pass, source);
                    for (int i = 0; i < 64; ++i) {
                        // Five times 1 - 2^-24 lets 2^-120 through, which is too little even for this test.
                        const float alpha = source < 3 ? 0x1p-24f * static_cast<float>(i % 7) : 0.5f;
                        tile.depth[i] = static_cast<float>(source);
                        tile.color[4 * i] = source == 0 ? (above ? 1 : -1) * 0x1p-70f : source == 3 ? 0.5f : 0.0f;
                        tile.color[4 * i + 3] = source == 3 || i % 2 ? alpha : 0.0f;
                    }
                }
            const ErrorReport c = compare<dfb::BasicAlphaBlend<8>>(in);
            INFO(passes << " passes, above " << above << ": " << c.text());
            CHECK(c.wrongBytes == 0);
        }
}

TEST_CASE("Layers of one grey over that grey are a tie in each pixel", "[ops]")
{
    for (int layers = 2; layers <= 32; layers *= 2) {
        const auto in = dfb::testing::greyLayers<8>(static_cast<std::uint64_t>(layers), layers);
        const auto out = dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, in.order(), dfb::OutputFormat::RGBA8);
        const std::vector<std::byte> expected{std::byte{128}, std::byte{128}, std::byte{128}, std::byte{255}};
        int wrong = 0;
        for (std::size_t i = 0; i < out.color.size(); ++i)
            wrong += out.color[i] != expected[i % 4];
        CHECK(wrong == 0);
    }
}

TEST_CASE("A tie in a row does not change the levels of other pixels", "[ops]")
{
    // The level of red at a pixel with these layers of red and alpha. Its neighbour has 1/2, which is a tie, or 0.3.
    const auto levelBeside = [](float neighbour, const std::vector<std::array<float, 2>>& layers, float least) {
        TileInputs<8> in;
        for (std::size_t i = 0; i < layers.size(); ++i) {
            auto& tile = in.add(0, static_cast<std::uint32_t>(i));
            tile.color[0] = layers[i][0];
            tile.color[3] = layers[i][1];
            tile.depth[0] = static_cast<float>(i);
        }
        std::fill_n(in.tiles[0]->pixel(1, 0), 4, neighbour);
        in.tiles[0]->depth[1] = 0;
        const dfb::testing::TileWire wire{{}, least};
        return dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, in.order(), dfb::OutputFormat::RGBA8, true, wire)
            .color[0];
    };
    // The first three layers let less than 1/100 through, so the last one is left out, with all its light.
    const std::vector<std::array<float, 2>> cut{{0.1f, 0.91f}, {0.1f, 0.73f}, {0.1f, 0.67f}, {1e25f, 0.5f}};
    CHECK(levelBeside(0.5f, cut, 0.01f) == levelBeside(0.3f, cut, 0.01f));
    const std::vector<std::array<float, 2>> infinite{{infinity, 0.25f}, {0.25f, 0.25f}};
    CHECK(levelBeside(0.5f, infinite, 0) == levelBeside(0.3f, infinite, 0));
    // 0.3 remains of these, but double loses it.
    const std::vector<std::array<float, 2>> huge{{1e20f, 0.5f}, {0.6f, 0.5f}, {-4 * 1e20f, 0.5f}};
    CHECK(levelBeside(0.5f, huge, 0) == levelBeside(0.3f, huge, 0));
}

TEST_CASE("Where colour is dithered alpha is the exact result rounded all the same, and not exceeded", "[ops]")
{
    // Alpha is 1/2, which is a tie, minus something far below the last bit of a double.
    TileInputs<8> in;
    in.add(0, 0).fill({0, 0, 0, -0x1p-70f}, 0);
    in.add(0, 1).fill({0.5f, 0.49f, 0, 0.5f}, 1);
    using Op = dfb::BasicAlphaBlend<8>;
    const auto rounded = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA8);
    const auto dithered = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA8, true, {}, true);
    int wrong = 0, other = 0;
    for (std::size_t i = 0; i < 64; ++i) {
        wrong += rounded.color[4 * i + 3] != std::byte{127} || dithered.color[4 * i + 3] != std::byte{127};
        wrong += dithered.color[4 * i] > std::byte{127};
        other += dithered.color[4 * i + 1] != rounded.color[4 * i + 1];
    }
    CHECK(wrong == 0);
    CHECK(other == 3); // 0.49 is 124.95: 61 of 64 places take 125, as all do when it is rounded
}

TEST_CASE("OrderedBlend does not wait for what an opaque input hides, nor take it", "[ops]")
{
    using Op = dfb::BasicOrderedBlend<8>;
    constexpr int inputs = 5;
    // One bit for each input that is opaque. The others have a hole or let something through.
    for (unsigned opaque = 0; opaque < 1u << inputs; ++opaque) {
        TileInputs<8> in;
        for (int g = 0; g < inputs; ++g) {
            auto& tile = in.add(0, static_cast<std::uint32_t>(g), 0);
            const bool isOpaque = (opaque >> g) & 1;
            tile.fill({0.125f * static_cast<float>(g + 1), 0, 0, isOpaque || g % 2 ? 1.0f : 0.5f}, 1.0f);
            if (!isOpaque)
                std::fill_n(tile.pixel(g, g), 4, 0.0f);
            tile.generation = g;
            tile.children = g + 1 < inputs;
        }
        int first = 0; // the first opaque input
        while (first < inputs && !((opaque >> first) & 1))
            ++first;
        if (first + 1 < inputs)
            in.tiles.back()->pixel(0, 0)[0] = infinity; // would show if it were taken
        auto expected = [&] {
            auto order = in.order();
            order.resize(std::min<std::size_t>(order.size(), static_cast<std::size_t>(first) + 1));
            return dfb::testing::runTileOp<Op>(in, order, dfb::OutputFormat::RGBA32F, false);
        }();
        auto order = in.order();
        do {
            const TileOutput out = dfb::testing::runTileOp<Op>(in, order, dfb::OutputFormat::RGBA32F, false);
            REQUIRE(out == expected);

            const auto pool = dfb::MemoryPool::create();
            dfb::TileInfo info;
            info.region = in.region();
            info.passes = 1;
            Op op;
            op.newFrame(info);
            std::vector<bool> there(inputs, false);
            for (const std::size_t i : order) {
                dfb::detail::InputFaults faults;
                const dfb::detail::WireCoder coder{dfb::Precision()};
                op.add(dfb::detail::decodeFragment(
                    *pool,
                    dfb::detail::encodeFragment(*pool, *in.tiles[i], dfb::colorChannel, 0, nullptr, coder,
                                                dfb::WireFormat::Float32, faults),
                    in.layout, [](int) { return 1; }, nullptr, coder));
                there[i] = true;
                const bool isEnough =
                    first < inputs && std::all_of(there.begin(), there.begin() + first + 1, [](bool b) { return b; });
                REQUIRE(op.isComplete() == isEnough);
            }
        } while (std::next_permutation(order.begin(), order.end()));
    }
}

TEST_CASE("OrderedBlend does not take two inputs for the two that an opaque one waits for", "[ops]")
{
    using Op = dfb::BasicOrderedBlend<8>;
    for (const bool isFirst : {true, false}) { // that was damaged, or the second
        TileInputs<8> in;
        for (int i = 0; i < 4; ++i) {
            auto& tile = in.add(0, static_cast<std::uint32_t>(i), 0);
            tile.fill({0.25f, 0, 0, i == 3 ? 1.0f : 0.5f}, 1.0f);
            tile.generation = i == (isFirst ? 0 : 1) ? i + 1 : i;
            tile.children = i < 3;
        }
        auto order = in.order();
        do {
            Op op;
            const auto run = [&] { dfb::testing::runTileOp(op, in, order, dfb::OutputFormat::RGBA32F, false); };
            if (isFirst) { // or declared; else the dependency tracker finds it
                run();
                CHECK_FALSE(op.isComplete());
            } else {
                CHECK_THROWS_AS(run(), dfb::InvalidArgument);
            }
        } while (std::next_permutation(order.begin(), order.end()));
    }
}

TEST_CASE("OrderedBlend blends the parts of a source in one generation by their number", "[ops]")
{
    TileInputs<8> in;
    in.background = {};
    for (std::uint16_t part = 0; part < 2; ++part) {
        auto& tile = in.add(0, 0, part);
        tile.fill({part == 0 ? 0.5f : 0.0f, part == 1 ? 0.5f : 0.0f, 0, 0.5f}, 1.0f);
        tile.generation = 1;
    }
    for (const bool withDepth : {true, false}) // without, an opaque input could hide others
        for (const std::vector<std::size_t>& order : {std::vector<std::size_t>{0, 1}, {1, 0}}) {
            const TileOutput out =
                dfb::testing::runTileOp<dfb::BasicOrderedBlend<8>>(in, order, dfb::OutputFormat::RGBA32F, withDepth);
            CHECK(out.value(0) == 0.5f);
            CHECK(out.value(1) == 0.25f);
        }
}

TEST_CASE("What a single layer covers comes out the same whether it is taken as it is or composited", "[ops]")
{
    using Op = dfb::BasicAlphaBlend<64>;
    for (int seed = 900; seed < 900 + repeats(24); ++seed) {
        Random random(seed);
        TileInputs<64> in;
        in.background = {};
        for (std::uint32_t source = 0; source < 3; ++source) {
            auto& tile = in.add(0, source, 0);
            for (int y = 0; y < 64; ++y)
                for (int x = 0; x < 64;) { // runs and gaps of all lengths
                    const int end = std::min(64, x + 1 + static_cast<int>(random() % (seed % 2 ? 60 : 20)));
                    for (const bool isThere = random() % 2; x < end; ++x) {
                        float* p = tile.pixel(x, y);
                        p[3] = isThere ? (random() % 4 ? uniform(random) : 0.5f) : 0.0f;
                        for (int c = 0; c < 3 && isThere; ++c) // up to thresholds, where levels change
                            p[c] = random() % 8 ? p[3] * uniform(random)
                                                : std::nextafter(static_cast<float>(random() % 510) / 510, 1.0f);
                        if (isThere && random() % 64 == 0)
                            p[0] = random() % 2 ? -0.0f : notANumber;
                        tile.depth[y * 64 + x] = static_cast<float>(source);
                    }
                }
        }
        for (const auto format : {dfb::OutputFormat::RGBA32F, dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8}) {
            const TileOutput taken = dfb::testing::runTileOp<Op>(in, in.order(), format, false);
            const TileOutput composited = dfb::testing::runTileOp<Op>(in, in.order(), format, true);
            INFO("seed " << seed << ", format " << static_cast<int>(format));
            CHECK(taken.color == composited.color);
        }
    }
}

} // namespace tile_ops_cases
