// TileOpTest: runs a tile operation on the inputs of one tile, as the framebuffer does, and compares the result with
// the reference. For the library's operations and for your own:
//
//   dfb::testing::TileInputs<MyOp::tileSize> in = dfb::testing::adversarial<MyOp::tileSize>(seed, layers, passes);
//   const auto expected = dfb::testing::referenceOf(in, [&](const std::vector<Sample>& samples) { return ...; });
//   const dfb::testing::ErrorReport report = dfb::testing::compare<MyOp>(in, expected);
//   assert(report.ulpsBelow() <= 2 && report.wrongBytes == 0);
#pragma once

#include <dfb/testing/error_report.hpp>
#include <dfb/tile_op.hpp>
#include <dfb/wire/fragment_message.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

namespace dfb::testing {

template <class Op>
inline constexpr int tileSizeOf = dfb::detail::tile_size_v<Op>;

// One tile of an image, and the inputs that it gets.
template <int Size, ChannelMask Channels = colorChannel | depthChannel>
struct TileInputs {
    using Tile = dfb::Tile<Channels, Size>;

    TileLayout layout{Size, Size, Size};
    int tile = 0;
    int passes = 1;
    Color background{};
    std::vector<std::unique_ptr<Tile>> tiles;

    Region region() const { return layout.region(tile); }

    // Adds an empty input.
    Tile& add(int pass, std::uint32_t source, std::uint16_t part = 0, int generation = 1)
    {
        tiles.push_back(std::make_unique<Tile>());
        Tile& t = *tiles.back();
        static_cast<TileHeader&>(t) = {1, tile, region(), pass, generation, 0, source, part};
        t.clear();
        return t;
    }

    // The order of `tiles`: 0, 1, 2, ...
    std::vector<std::size_t> order() const
    {
        std::vector<std::size_t> all(tiles.size());
        for (std::size_t i = 0; i < all.size(); ++i)
            all[i] = i;
        return all;
    }
};

// How inputs are sent, and what the operation is told of it.
struct TileWire {
    Precision precision;
    float minTransmittance = 0;
    const Codec* codec = nullptr;
};

// A finished tile.
struct TileOutput {
    std::vector<std::byte> color;
    std::vector<float> depth;   // empty if the image has none
    std::vector<std::byte> aux; // the other channels, one after the other; also empty then
    dfb::detail::InputFaults faults;
    TileReport report;
    std::size_t bytes = 0; // of the messages

    bool operator==(const TileOutput& o) const
    {
        return color == o.color && aux == o.aux && depth.size() == o.depth.size()
               && (depth.empty() || std::memcmp(depth.data(), o.depth.data(), depth.size() * sizeof(float)) == 0);
    }
    // Value i of the colour; only for OutputFormat::RGBA32F.
    float value(std::size_t i) const
    {
        float v = 0;
        std::memcpy(&v, color.data() + i * sizeof v, sizeof v);
        return v;
    }
};

// Runs `op` for a tile in one frame as the framebuffer does, but gives it all inputs, without asking isComplete(). They
// arrive in this order. `withDepth`: the image has depth, and those of the other channels that the inputs have and an
// image can have. Sets `written` to the number of pixels that the operation has set.
template <class Op, ChannelMask Channels>
TileOutput runTileOp(Op& op, const TileInputs<tileSizeOf<Op>, Channels>& in, const std::vector<std::size_t>& order,
                     OutputFormat format, bool withDepth = true, const TileWire& wire = {}, bool dither = false,
                     std::int64_t* written = nullptr)
{
    namespace d = dfb::detail;
    const auto pool = MemoryPool::create();
    const Region region = in.region();
    TileInfo info;
    info.frame = 1;
    info.tile = in.tile;
    info.region = region;
    info.passes = in.passes;
    const auto inImage = static_cast<ChannelMask>(withDepth ? depthChannel | (Channels & imageAuxChannels) : 0);
    info.wanted = inImage;
    info.background = in.background;
    info.minTransmittance = wire.minTransmittance;
    const d::WireCoder coder(wire.precision, d::active_by_depth_v<Op>);
    const auto wanted = static_cast<ChannelMask>(d::needed_channels_v<Op> | inImage);
    TileOutput out;
    if constexpr (d::has_new_frame_with_data_v<Op>)
        op.newFrame(info, typename Op::FrameData{});
    else
        op.newFrame(info);
    for (const std::size_t i : order) {
        Buffer message =
            d::encodeFragment(*pool, *in.tiles[i], wanted, 0, wire.codec, coder, wire.precision.color, out.faults);
        out.bytes += message.size();
        op.add(d::decodeFragment(
            *pool, std::move(message), in.layout, [&](int) { return in.passes; }, wire.codec, coder));
    }
    const auto width = static_cast<std::size_t>(region.width()), height = static_cast<std::size_t>(region.height());
    const std::size_t stride = width * bytesPerPixel(format);
    out.color.assign(stride * height, std::byte{0xcd});
    out.depth.assign(withDepth ? width * height : 0, -7.0f);
    d::Planes planes;
    planes.at[d::Color] = out.color.data();
    planes.at[d::Depth] = withDepth ? reinterpret_cast<std::byte*>(out.depth.data()) : nullptr;
    std::size_t words = 0;
    for (std::size_t c = d::Normal; c < d::channelCount; ++c)
        words += d::hasChannel(inImage, c) ? d::channelWords[c] : 0;
    out.aux.assign(4 * words * width * height, std::byte{0xcd});
    std::byte* next = out.aux.data();
    for (std::size_t c = d::Normal; c < d::channelCount; ++c)
        if (d::hasChannel(inImage, c))
            planes.at[c] = std::exchange(next, next + 4 * d::channelWords[c] * width * height);
    FinishedTile finished(region, format, planes, width, dither);
    op.finish(finished);
    if constexpr (d::has_report_v<Op>)
        op.report(out.report);
    if (written)
        *written = finished.writtenPixels();
    return out;
}

// Runs two such frames with a new operation, and returns the second: operations are used again from frame to frame.
template <class Op, ChannelMask Channels>
TileOutput runTileOp(const TileInputs<tileSizeOf<Op>, Channels>& in, const std::vector<std::size_t>& order,
                     OutputFormat format, bool withDepth = true, const TileWire& wire = {}, bool dither = false)
{
    Op op;
    runTileOp(op, in, order, format, withDepth, wire, dither);
    return runTileOp(op, in, order, format, withDepth, wire, dither);
}

// Returns exact pixels: for each, the mean over the passes of what `rule(samples)` returns. The samples are in the
// order of in.tiles. Where an input has nothing, its sample has colour 0 and depth +infinity.
template <int Size, ChannelMask Channels, class Rule>
std::vector<Pixel> referenceOf(const TileInputs<Size, Channels>& in, const Rule& rule)
{
    const Region region = in.region();
    std::vector<Pixel> result;
    for (int y = 0; y < region.height(); ++y)
        for (int x = 0; x < region.width(); ++x) {
            std::vector<std::vector<Sample>> samples(static_cast<std::size_t>(in.passes));
            for (const auto& t : in.tiles) {
                const float* p = t->pixel(x, y);
                samples[static_cast<std::size_t>(t->pass)].push_back(
                    {{p[0], p[1], p[2], p[3]}, t->depth[y * Size + x], t->source, t->part});
            }
            std::vector<Pixel> passes;
            for (const std::vector<Sample>& pass : samples)
                passes.push_back(rule(pass));
            result.push_back(mean(passes));
        }
    return result;
}

// The exact pixels of AlphaBlend and ImageParallel.
template <int Size, ChannelMask Channels>
std::vector<Pixel> referenceOf(const TileInputs<Size, Channels>& in)
{
    return referenceOf(in, [&](const std::vector<Sample>& samples) { return composite(samples, in.background); });
}

// Compares all formats and the depth with exact pixels. A wrong depth counts as 4 wrong bytes.
template <class Op, ChannelMask Channels>
ErrorReport compare(const TileInputs<tileSizeOf<Op>, Channels>& in, const std::vector<Pixel>& expected)
{
    const auto order = in.order();
    const TileOutput floats = runTileOp<Op>(in, order, OutputFormat::RGBA32F);
    const TileOutput linear = runTileOp<Op>(in, order, OutputFormat::RGBA8);
    const TileOutput srgb = runTileOp<Op>(in, order, OutputFormat::SRGBA8);
    ErrorReport result;
    for (std::size_t i = 0; i < expected.size(); ++i) {
        for (std::size_t c = 0; c < 4; ++c) {
            const Exact exact = expected[i].rgba[c];
            result.add(floats.value(4 * i + c), exact);
            result.addByte(static_cast<std::uint8_t>(linear.color[4 * i + c]), toUnorm8(exact));
            result.addByte(static_cast<std::uint8_t>(srgb.color[4 * i + c]), c == 3 ? toUnorm8(exact) : toSrgb8(exact));
        }
        if (!(floats.depth[i] == expected[i].depth && linear.depth[i] == expected[i].depth))
            result.wrongBytes += 4;
    }
    return result;
}

// Checks an operation of your own against the contract in tile_op.hpp, in one line: REQUIRE(checkTileOp<MyOp>() == "").
// Returns a sentence for each fault, or nothing. The image must not depend on the order in which inputs come, nor on
// the frame before. Each pixel must be set. An image of two passes must be the mean of the images of each. Empty inputs
// must show the background. Inputs are random, half transparent, and have a depth and the operation's other channels;
// in half of the rounds many depths are equal. `label(header, layer)` may set the generation and source that the
// operation expects; without it they are generation 1 and source `layer`. For operations that keep no state.
template <class Op, class Label, std::enable_if_t<std::is_invocable_v<const Label&, TileHeader&, int>, int> = 0>
std::string checkTileOp(const Label& label, std::uint64_t seed = 1)
{
    using Inputs = TileInputs<tileSizeOf<Op>, static_cast<ChannelMask>(Op::channels | depthChannel)>;
    constexpr int size = tileSizeOf<Op>, layers = 3;
    std::mt19937_64 random(seed);
    const auto number = [&] { return static_cast<float>(random() >> 40) * 0x1p-24f; };
    bool hasFewDepths = false; // so that many are equal
    // Makes inputs of `passes` passes, for an image `width` pixels wide.
    const auto make = [&](int passes, int width, bool isEmpty) {
        Inputs in;
        in.layout = TileLayout(width, size - 1, size);
        in.passes = passes;
        in.background = {0.25f, 0.5f, 0.125f, 0.75f};
        for (int pass = 0; pass < passes; ++pass)
            for (int layer = 0; layer < layers; ++layer) {
                auto& tile = in.add(pass, static_cast<std::uint32_t>(layer));
                label(static_cast<TileHeader&>(tile), layer);
                const std::uint64_t kind = random() % 3; // sparse, dense, empty
                for (int y = 0; y < tile.region.height() && kind < 2 && !isEmpty; ++y)
                    for (int x = 0; x < tile.region.width(); ++x) {
                        if (kind == 0 && random() % 3 != 0)
                            continue;
                        float* rgba = tile.pixel(x, y);
                        rgba[3] = 0.1f + 0.8f * number();
                        for (int c = 0; c < 3; ++c)
                            rgba[c] = rgba[3] * number();
                        tile.depth[y * size + x] = 1 + (hasFewDepths ? static_cast<float>(random() % 2) : number());
                        tile.forEachPlane(tile,
                                          [&, pixel = static_cast<std::size_t>(y * size + x)](auto c, auto& values) {
                                              const std::size_t words = dfb::detail::channelWords[c];
                                              for (std::size_t w = 0; w < words && c > dfb::detail::Depth; ++w)
                                                  values[words * pixel + w] =
                                                      static_cast<std::decay_t<decltype(values[0])>>(random() % 4);
                                          });
                    }
            }
        return in;
    };
    // The inputs of one pass of `in`, as the only pass.
    const auto passOf = [&](Inputs& in, int pass) {
        Inputs one;
        one.layout = in.layout;
        one.background = in.background;
        for (auto& tile : in.tiles)
            if (tile->pass == pass) {
                one.tiles.push_back(std::make_unique<typename Inputs::Tile>(*tile));
                one.tiles.back()->pass = 0;
            }
        return one;
    };
    const auto run = [](const Inputs& in, const std::vector<std::size_t>& order) {
        Op op;
        return runTileOp(op, in, order, OutputFormat::RGBA32F);
    };
    bool hasOrder = false, hasMemory = false, hasHoles = false, hasOtherMean = false, hasOtherBackground = false;
    for (int round = 0; round < 20; ++round) {
        hasFewDepths = round % 2 == 1;
        Inputs in = make(2, size - round % 3, false);
        const TileOutput expected = run(in, in.order());
        auto order = in.order();
        std::shuffle(order.begin(), order.end(), random);
        hasOrder = hasOrder || !(run(in, order) == expected);

        Op used;
        std::int64_t written = 0;
        const Inputs before = make(3, size, false);
        runTileOp(used, before, before.order(), OutputFormat::RGBA32F);
        const TileOutput again = runTileOp(used, in, in.order(), OutputFormat::RGBA32F, true, {}, false, &written);
        hasMemory = hasMemory || !(again == expected);
        const std::int64_t pixels = static_cast<std::int64_t>(in.region().width()) * in.region().height();
        hasHoles = hasHoles || written != pixels;

        const Inputs first = passOf(in, 0), second = passOf(in, 1);
        const TileOutput a = run(first, first.order()), b = run(second, second.order());
        const Inputs nothing = make(2, size, true);
        const TileOutput empty = run(nothing, nothing.order());
        for (std::size_t i = 0; i < 4 * static_cast<std::size_t>(pixels); ++i) {
            const float mean = 0.5f * (a.value(i) + b.value(i));
            // Each of the three values is rounded to float once.
            hasOtherMean = hasOtherMean || !(std::fabs(expected.value(i) - mean) <= 2 * 0x1p-23f * std::fabs(mean));
        }
        for (std::size_t i = 0; i < empty.color.size() / sizeof(float); ++i)
            hasOtherBackground = hasOtherBackground || empty.value(i) != nothing.background[i % 4];
    }
    std::string text;
    if (hasOrder)
        text += "The image depends on the order in which inputs come. ";
    if (hasMemory)
        text += "The image depends on the frame before. ";
    if (hasHoles)
        text += "Not each pixel is set once. ";
    if (hasOtherMean)
        text += "The image of two passes is not the mean of the images of each. ";
    if (hasOtherBackground)
        text += "Where there is nothing the background does not show. ";
    return text;
}
template <class Op>
std::string checkTileOp(std::uint64_t seed = 1)
{
    return checkTileOp<Op>([](TileHeader&, int) {}, seed);
}

} // namespace dfb::testing
