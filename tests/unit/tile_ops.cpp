// The tile operations against the serial reference: adversarial fragments, through the wire, in every arrival order.
#include "catch.hpp"
#include "reference.hpp"

#include <dfb/detail/wire.hpp>
#include <dfb/ops/image_parallel.hpp>
#include <dfb/ops/sort_last.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

namespace {

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr float notANumber = std::numeric_limits<float>::quiet_NaN();
constexpr float smallestDenormal = 1e-45f;

template <int Size>
using TileOf = dfb::Tile<dfb::colorChannel | dfb::depthChannel, Size>;

// One tile of an image, and the inputs that it gets.
template <int Size>
struct Inputs {
    dfb::TileLayout layout{Size, Size, Size};
    int tile = 0;
    int passes = 1;
    reference::Color background{};
    std::vector<std::unique_ptr<TileOf<Size>>> tiles;

    dfb::Region region() const { return layout.region(tile); }

    TileOf<Size>& add(int pass, std::uint32_t source, std::uint16_t part = 0, int generation = 1)
    {
        tiles.push_back(std::make_unique<TileOf<Size>>());
        TileOf<Size>& t = *tiles.back();
        static_cast<dfb::TileHeader&>(t) = {1, tile, region(), pass, generation, 0, source, part};
        t.clear();
        return t;
    }
};

struct Output {
    std::vector<std::byte> color;
    std::vector<float> depth;
    std::uint64_t nonFinite = 0;

    bool operator==(const Output& o) const
    {
        return color == o.color && depth.size() == o.depth.size()
               && std::memcmp(depth.data(), o.depth.data(), depth.size() * sizeof(float)) == 0;
    }
    float value(std::size_t i) const
    {
        float v = 0;
        std::memcpy(&v, color.data() + i * sizeof v, sizeof v);
        return v;
    }
};

// What the framebuffer does with one tile, with the inputs arriving in `order`.
template <class Op>
Output runOp(const Inputs<Op::tileSize>& in, const std::vector<std::size_t>& order, dfb::OutputFormat format,
             bool withDepth = true)
{
    const auto pool = dfb::MemoryPool::create();
    const dfb::Region region = in.region();
    dfb::TileInfo info;
    info.frame = 1;
    info.tile = in.tile;
    info.region = region;
    info.passes = in.passes;
    info.wanted = withDepth ? dfb::depthChannel : 0;
    info.background = in.background;
    Op op;
    Output out;
    // Twice: an op is used again from frame to frame.
    for (int frame = 0; frame < 2; ++frame) {
        op.newFrame(info);
        out.nonFinite = 0;
        for (std::size_t i : order) {
            const auto wanted = static_cast<dfb::ChannelMask>(dfb::detail::NeededChannelsOf<Op>::value
                                                              | (withDepth ? dfb::depthChannel : 0));
            dfb::Buffer message = dfb::detail::encodeFragment(*pool, *in.tiles[i], wanted, 0, nullptr, out.nonFinite);
            op.add(dfb::detail::decodeFragment(
                *pool, std::move(message), in.layout, [&](int) { return in.passes; }, nullptr));
        }
        const auto width = static_cast<std::size_t>(region.width()), height = static_cast<std::size_t>(region.height());
        const std::size_t stride = width * dfb::bytesPerPixel(format);
        out.color.assign(stride * height, std::byte{0xcd});
        out.depth.assign(withDepth ? width * height : 0, -7.0f);
        dfb::detail::Planes planes;
        planes.at[dfb::detail::Color] = out.color.data();
        planes.at[dfb::detail::Depth] = withDepth ? reinterpret_cast<std::byte*>(out.depth.data()) : nullptr;
        dfb::FinishedTile finished(region, format, planes, width);
        op.finish(finished);
    }
    return out;
}

template <int Size>
std::vector<std::size_t> inOrder(const Inputs<Size>& in)
{
    std::vector<std::size_t> order(in.tiles.size());
    for (std::size_t i = 0; i < order.size(); ++i)
        order[i] = i;
    return order;
}

// A tile that does not contribute where colour and alpha are all 0.
template <int Size>
std::vector<reference::Pixel> referenceOf(const Inputs<Size>& in)
{
    const dfb::Region region = in.region();
    std::vector<reference::Pixel> result;
    for (int y = 0; y < region.height(); ++y)
        for (int x = 0; x < region.width(); ++x) {
            std::vector<reference::Pixel> passes;
            for (int pass = 0; pass < in.passes; ++pass) {
                std::vector<reference::Sample> samples;
                for (const auto& t : in.tiles) {
                    if (t->pass != pass)
                        continue;
                    const float* p = t->pixel(x, y);
                    samples.push_back({{p[0], p[1], p[2], p[3]}, t->depth[y * Size + x], t->source, t->part});
                }
                passes.push_back(reference::composite(std::move(samples), in.background));
            }
            result.push_back(reference::mean(passes));
        }
    return result;
}

struct Comparison {
    std::int64_t worstUlps = 0;
    std::size_t wrongBytes = 0, wrongDepths = 0;
    std::size_t inexact = 0; // values that are not the exact result rounded (allowed, within 1 ulp)
};

// All three formats against the reference.
template <class Op>
Comparison compare(const Inputs<Op::tileSize>& in)
{
    const auto expected = referenceOf(in);
    const auto order = inOrder(in);
    const Output floats = runOp<Op>(in, order, dfb::OutputFormat::RGBA32F);
    const Output linear = runOp<Op>(in, order, dfb::OutputFormat::RGBA8);
    const Output srgb = runOp<Op>(in, order, dfb::OutputFormat::SRGBA8);
    Comparison result;
    for (std::size_t i = 0; i < expected.size(); ++i) {
        for (std::size_t c = 0; c < 4; ++c) {
            const reference::Exact exact = expected[i].rgba[c];
            const std::int64_t ulps = reference::ulpsBetween(floats.value(4 * i + c), reference::toFloat(exact));
            result.worstUlps = std::max(result.worstUlps, ulps);
            result.inexact += ulps != 0;
            const auto level = static_cast<std::uint8_t>(linear.color[4 * i + c]);
            result.wrongBytes += level != reference::toUnorm8(exact);
            const auto srgbLevel = static_cast<std::uint8_t>(srgb.color[4 * i + c]);
            result.wrongBytes += srgbLevel != (c == 3 ? reference::toUnorm8(exact) : reference::toSrgb8(exact));
        }
        result.wrongDepths += !(floats.depth[i] == expected[i].depth && linear.depth[i] == expected[i].depth);
    }
    return result;
}

using Random = std::mt19937_64;

float uniform(Random& random) { return static_cast<float>(random() >> 40) * 0x1p-24f; }
std::size_t below(Random& random, std::size_t count) { return static_cast<std::size_t>(random() % count); }

float anyAlpha(Random& random)
{
    switch (below(random, 8)) {
    case 0: return 0.0f;
    case 1: return 1.0f;
    case 2: return 0x1p-24f * uniform(random);
    case 3: return std::nextafter(1.0f, 0.0f);
    case 4: return smallestDenormal * static_cast<float>(1 + below(random, 9));
    case 5: return static_cast<float>(below(random, 5)) * 0.25f; // exact results, and ties in 8 bits
    default: return uniform(random);
    }
}

float anyColor(Random& random, float alpha)
{
    switch (below(random, 8)) {
    case 0: return 0.0f;
    case 1: return 1e30f * uniform(random);
    case 2: return smallestDenormal * static_cast<float>(below(random, 1000));
    case 3: return 1.0f;
    default: return alpha > 0.0f ? alpha * uniform(random) : uniform(random); // alpha 0: emission
    }
}

float anyDepth(Random& random, std::size_t kind)
{
    switch (kind) {
    case 0: return 1.0f;
    case 1: return static_cast<float>(below(random, 3));
    case 2: return below(random, 2) ? 0.0f : -0.0f;
    case 3: return below(random, 3) ? uniform(random) : infinity;
    case 4: return smallestDenormal * static_cast<float>(below(random, 4));
    case 5: return uniform(random) - 0.5f;
    default: return 100.0f * uniform(random);
    }
}

// Random spans rather than random pixels, so that orders change within a row and stay over some of it.
template <int Size>
void fillAdversarial(TileOf<Size>& tile, Random& random)
{
    const std::size_t depthKind = below(random, 8);
    const std::size_t density = below(random, 5); // 0: empty; 4: all
    const bool plain = below(random, 3) == 0;     // one colour and depth
    const float plainAlpha = anyAlpha(random), plainColor = anyColor(random, plainAlpha),
                plainDepth = anyDepth(random, depthKind);
    for (int y = 0; y < tile.region.height(); ++y)
        for (int x = 0; x < tile.region.width();) {
            const bool active = density == 4 || below(random, 4) < density;
            const int end = std::min(tile.region.width(), x + 1 + static_cast<int>(below(random, 20)));
            for (; x < end; ++x) {
                if (!active)
                    continue;
                const float alpha = plain ? plainAlpha : anyAlpha(random);
                for (int c = 0; c < 3; ++c)
                    tile.pixel(x, y)[c] = plain ? plainColor : anyColor(random, alpha);
                tile.pixel(x, y)[3] = alpha;
                tile.depth[y * Size + x] = plain ? plainDepth : anyDepth(random, depthKind);
            }
        }
}

template <int Size>
Inputs<Size> adversarial(std::uint64_t seed, int layers, int passes, bool image = false)
{
    Random random(seed);
    Inputs<Size> in;
    if (seed % 3 == 1) { // a tile at the lower right border
        in.layout = dfb::TileLayout(Size + Size / 2 + 1, Size + 3, Size);
        in.tile = 3;
    }
    in.passes = passes;
    if (seed % 2 == 1)
        in.background = {0.25f, 1e-3f, 0.5f, uniform(random)};
    for (int pass = 0; pass < passes; ++pass)
        for (int i = 0; i < (image ? 1 : layers); ++i)
            fillAdversarial(
                in.add(pass, static_cast<std::uint32_t>(i / 2), static_cast<std::uint16_t>(i % 2), image ? 0 : 1),
                random);
    return in;
}

} // namespace

TEST_CASE("AlphaBlend is within 1 ulp of exact in float, exact in 8 bits and in depth", "[ops]")
{
    Comparison all;
    std::uint64_t seed = 100;
    const auto take = [&](const Comparison& c) {
        all.worstUlps = std::max(all.worstUlps, c.worstUlps);
        all.wrongBytes += c.wrongBytes;
        all.wrongDepths += c.wrongDepths;
    };
    for (int layers : {1, 2, 3, 5, 8, 16, 33, 64})
        for (int passes : {1, 2, 3})
            for (int i = 0; i < 3; ++i) {
                INFO("seed " << seed << ", " << layers << " layers, " << passes << " passes");
                const Comparison c = compare<dfb::BasicAlphaBlend<8>>(adversarial<8>(seed++, layers, passes));
                // One: two roundings, to double on the way and to float, can both go the wrong way at a tie.
                CHECK(c.worstUlps <= 1);
                CHECK(c.wrongBytes == 0);
                CHECK(c.wrongDepths == 0);
                take(c);
            }
    // Wide enough for the fast path that finds out how far an order holds.
    for (int layers : {2, 4, 7}) {
        INFO("seed " << seed << ", " << layers << " layers of 64x64");
        const Comparison c = compare<dfb::AlphaBlend>(adversarial<64>(seed++, layers, 1));
        CHECK(c.worstUlps <= 1);
        CHECK(c.wrongBytes == 0);
        CHECK(c.wrongDepths == 0);
        take(c);
    }
    CHECK(all.worstUlps <= 1);
}

TEST_CASE("ImageParallel is within 1 ulp of exact in float, exact in 8 bits and in depth", "[ops]")
{
    for (std::uint64_t seed = 1; seed <= 12; ++seed) {
        INFO("seed " << seed);
        const Comparison c =
            compare<dfb::BasicImageParallel<16>>(adversarial<16>(seed, 1, 1 + static_cast<int>(seed % 3), true));
        CHECK(c.worstUlps <= 1);
        CHECK(c.wrongBytes == 0);
        CHECK(c.wrongDepths == 0);
    }
}

TEST_CASE("ImageParallel takes tiles of generation 0 without children only", "[ops]")
{
    Inputs<8> in;
    in.add(0, 0, 0, 1);
    CHECK_THROWS_AS(runOp<dfb::BasicImageParallel<8>>(in, {0}, dfb::OutputFormat::RGBA8), dfb::InvalidArgument);
    in.tiles[0]->generation = 0;
    in.tiles[0]->children = 2;
    CHECK_THROWS_AS(runOp<dfb::BasicImageParallel<8>>(in, {0}, dfb::OutputFormat::RGBA8), dfb::InvalidArgument);
    in.tiles[0]->children = 0;
    CHECK_NOTHROW(runOp<dfb::BasicImageParallel<8>>(in, {0}, dfb::OutputFormat::RGBA8));
}

TEST_CASE("Arrival order does not show", "[ops]")
{
    for (std::uint64_t seed = 500; seed < 512; ++seed) {
        const Inputs<8> in = adversarial<8>(seed, 2 + static_cast<int>(seed % 11), 1 + static_cast<int>(seed % 3));
        auto order = inOrder(in);
        Random random(seed);
        for (const auto format : {dfb::OutputFormat::RGBA32F, dfb::OutputFormat::SRGBA8}) {
            const Output first = runOp<dfb::BasicAlphaBlend<8>>(in, order, format);
            std::size_t different = 0;
            for (int i = 0; i < 12; ++i) {
                std::shuffle(order.begin(), order.end(), random);
                different += !(runOp<dfb::BasicAlphaBlend<8>>(in, order, format) == first);
            }
            INFO("seed " << seed);
            CHECK(different == 0);
        }
    }
}

TEST_CASE("Equal depths are decided by source, then part", "[ops]")
{
    Inputs<8> in;
    const auto put = [&](std::uint32_t source, std::uint16_t part, float red, float green) {
        auto& t = in.add(0, source, part);
        t.fill({red, green, 0, 1}, 2.0f);
    };
    put(3, 0, 0.5f, 0.0f);
    put(1, 1, 0.0f, 0.5f);
    put(1, 0, 0.25f, 0.75f); // the lowest source and part wins
    const Output out = runOp<dfb::BasicAlphaBlend<8>>(in, {0, 1, 2}, dfb::OutputFormat::RGBA32F);
    CHECK(out.value(0) == 0.25f);
    CHECK(out.value(1) == 0.75f);
}

TEST_CASE("4096 thin layers at one pixel", "[ops]")
{
    // Where single-precision accumulation is hundreds of ulps off.
    for (const float alpha : {1.0f / 4096.0f, 0x1p-20f, 0.01f}) {
        Random random(7);
        Inputs<8> in;
        for (std::uint32_t i = 0; i < 4096; ++i) {
            auto& t = in.add(0, i);
            float* p = t.pixel(5, 2);
            p[3] = alpha * (0.5f + uniform(random));
            for (int c = 0; c < 3; ++c)
                p[c] = p[3] * uniform(random);
            t.depth[2 * 8 + 5] = static_cast<float>(below(random, 1000)); // many ties
        }
        INFO("alpha about " << alpha);
        const Comparison c = compare<dfb::BasicAlphaBlend<8>>(in);
        CHECK(c.worstUlps <= 1);
        CHECK(c.wrongBytes == 0);
        CHECK(c.wrongDepths == 0);
    }
}

TEST_CASE("Exact cases by hand", "[ops]")
{
    using Blend = dfb::BasicAlphaBlend<8>;
    SECTION("nothing at all is the background")
    {
        Inputs<8> in;
        in.background = {0.1f, 0.2f, 0.3f, 0.4f};
        const Output out = runOp<Blend>(in, {}, dfb::OutputFormat::RGBA32F);
        std::size_t wrong = 0;
        for (std::size_t i = 0; i < 64; ++i)
            for (std::size_t c = 0; c < 4; ++c)
                wrong += out.value(4 * i + c) != in.background[c] || out.depth[i] != infinity;
        CHECK(wrong == 0);
    }
    SECTION("emission: colour with alpha 0 adds, hides nothing and has no depth")
    {
        Inputs<8> in;
        in.add(0, 0).fill({4.0f, 0.5f, 0.0f, 0.0f}, 1.0f);
        in.add(0, 1).fill({0.5f, 0.25f, 0.0f, 0.5f}, 2.0f);
        const Output out = runOp<Blend>(in, {1, 0}, dfb::OutputFormat::RGBA32F);
        CHECK(out.value(0) == 4.5f);
        CHECK(out.value(1) == 0.75f);
        CHECK(out.value(3) == 0.5f);
        CHECK(out.depth[0] == 2.0f);
    }
    SECTION("an opaque layer hides what is behind, exactly")
    {
        Inputs<8> in;
        in.background = {1, 1, 1, 1};
        in.add(0, 0).fill({1e30f, 1e30f, 1e30f, 0.5f}, 3.0f);
        in.add(0, 1).fill({0.25f, 0.5f, 0.75f, 1.0f}, -1.0f);
        const Output out = runOp<Blend>(in, {0, 1}, dfb::OutputFormat::RGBA32F);
        CHECK(out.value(0) == 0.25f);
        CHECK(out.value(1) == 0.5f);
        CHECK(out.value(2) == 0.75f);
        CHECK(out.value(3) == 1.0f);
        CHECK(out.depth[0] == -1.0f);
    }
    SECTION("8 bits round ties to even")
    {
        // 0.5 * 255 = 127.5: the only tie that floats can make.
        Inputs<8> in;
        in.add(0, 0).fill({0.5f, std::nextafter(0.5f, 0.0f), std::nextafter(0.5f, 1.0f), 0.25f}, 0.0f);
        const Output out = runOp<Blend>(in, {0}, dfb::OutputFormat::RGBA8);
        CHECK(static_cast<int>(out.color[0]) == 128);
        CHECK(static_cast<int>(out.color[1]) == 127);
        CHECK(static_cast<int>(out.color[2]) == 128);
        CHECK(static_cast<int>(out.color[3]) == 64);
    }
    SECTION("passes are composited each by itself, then averaged")
    {
        // Two bricks that cover the same half of a pixel: pass 0 both, pass 1 neither.
        Inputs<8> in;
        in.passes = 2;
        in.background = {0, 0, 1, 1};
        in.add(0, 0).fill({1, 0, 0, 1}, 1.0f);
        in.add(0, 1).fill({0, 1, 0, 1}, 2.0f);
        const Output out = runOp<Blend>(in, {0, 1}, dfb::OutputFormat::RGBA32F);
        CHECK(out.value(0) == 0.5f);
        CHECK(out.value(1) == 0.0f);
        CHECK(out.value(2) == 0.5f);
        CHECK(out.value(3) == 1.0f);
        CHECK(out.depth[0] == 1.0f);
    }
    SECTION("without depth, fragments count as equally near and go by source")
    {
        Inputs<8> in;
        in.add(0, 1).fill({1, 0, 0, 1}, 1.0f);
        in.add(0, 0).fill({0, 1, 0, 1}, 2.0f);
        const Output out = runOp<dfb::BasicAlphaBlend<8>>(in, {0, 1}, dfb::OutputFormat::RGBA32F, false);
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
        Inputs<8> in = adversarial<8>(2, 6, 1);
        auto& t = in.add(0, 50);
        t.fill({0.25f, 0.25f, 0.25f, 0.5f}, 0.5f);
        const Output clean = runOp<dfb::BasicAlphaBlend<8>>(in, inOrder(in), dfb::OutputFormat::RGBA32F);
        CHECK(clean.nonFinite == 0);
        (spoilt.channel == 4 ? t.depth[y * 8 + x] : t.pixel(x, y)[spoilt.channel]) = spoilt.value;
        const auto order = inOrder(in);
        const Output out = runOp<dfb::BasicAlphaBlend<8>>(in, order, dfb::OutputFormat::RGBA32F);
        CHECK(out.nonFinite == 1);
        std::size_t changedElsewhere = 0;
        for (std::size_t i = 0; i < 64; ++i)
            if (i != pixel)
                for (std::size_t c = 0; c < 4; ++c)
                    changedElsewhere += reference::ulpsBetween(out.value(4 * i + c), clean.value(4 * i + c)) != 0
                                        || out.depth[i] != clean.depth[i];
        CHECK(changedElsewhere == 0);
        // At the pixel itself the rule is arithmetic's own; the reference follows it (and treats a NaN depth as
        // farthest).
        const auto expected = referenceOf(in);
        for (std::size_t c = 0; c < 4; ++c)
            CHECK(reference::ulpsBetween(out.value(4 * pixel + c), reference::toFloat(expected[pixel].rgba[c])) <= 1);
        auto reversed = order;
        std::reverse(reversed.begin(), reversed.end());
        CHECK(runOp<dfb::BasicAlphaBlend<8>>(in, reversed, dfb::OutputFormat::RGBA8)
              == runOp<dfb::BasicAlphaBlend<8>>(in, order, dfb::OutputFormat::RGBA8));
    }

    SECTION("a NaN depth is farther than everything that is finite")
    {
        Inputs<8> in;
        in.add(0, 0).fill({1, 0, 0, 1}, notANumber);
        in.add(0, 1).fill({0, 1, 0, 1}, 1e38f);
        const Output out = runOp<dfb::BasicAlphaBlend<8>>(in, {0, 1}, dfb::OutputFormat::RGBA32F);
        CHECK(out.value(0) == 0.0f);
        CHECK(out.value(1) == 1.0f);
        CHECK(out.depth[0] == 1e38f);
    }
}
