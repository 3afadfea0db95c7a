// decodeFragment: a fragment that it accepts can be read to its last pixel, lies within its tile, and is the same after
// it is encoded and decoded once more. An input that is read in place lies within the memory that its sender shares.
//
// An input: flags, then a FragmentHeader and the payload.
#include "fuzz.hpp"

#include <dfb/wire/fragment_message.hpp>
#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

namespace {

namespace d = dfb::detail;

constexpr int side = 8;
using Tile = dfb::Tile<dfb::allChannels, side>;
enum Flags : std::uint8_t { HasCodec = 1, Compress = 2, ByDepth = 4, LargeColors = 8 };
constexpr int passes = 3;

const dfb::Codec* codec()
{
#if defined(DFB_HAS_SNAPPY)
    static const dfb::SnappyCodec snappy;
    return &snappy;
#else
    return nullptr;
#endif
}

d::WireCoder coderFor(std::uint8_t flags)
{
    dfb::Precision precision;
    precision.maxColor = flags & LargeColors ? 40.0f : 1.0f;
    return d::WireCoder(precision, (flags & ByDepth) != 0);
}

const dfb::TileLayout& layout()
{
    static const dfb::TileLayout whole(20, 13, side); // border tiles are 4 wide or 5 high
    return whole;
}

// The memory that the sender shares. Reading beyond it is an error.
const std::vector<float>& sharedFloats()
{
    static const std::vector<float> floats = [] {
        std::vector<float> all(1000);
        for (std::size_t i = 0; i < all.size(); ++i)
            all[i] = i % 7 == 3 ? 0.0f : static_cast<float>(i % 29) / 32;
        all[500] = std::numeric_limits<float>::quiet_NaN();
        return all;
    }();
    return floats;
}
const auto sharedBytes = [](std::int64_t offset, std::int64_t byteCount) {
    const auto size = static_cast<std::int64_t>(sharedFloats().size() * sizeof(float));
    const bool isThere = offset >= 0 && byteCount >= 0 && offset <= size && byteCount <= size - offset;
    return isThere ? reinterpret_cast<const std::byte*>(sharedFloats().data()) + offset : nullptr;
};

dfb::Fragment decode(dfb::MemoryPool& pool, dfb::Buffer&& message, const dfb::Codec* with, const d::WireCoder& coder)
{
    d::readMessageHeader(message);
    return d::decodeFragment(
        pool, std::move(message), layout(), [](int tile) { return tile == 2 ? 0 : passes; }, with, coder, sharedBytes,
        nullptr);
}

// Copies the fragment to a tile, and checks what callers may assume of spans and counts.
std::unique_ptr<Tile> tileOf(const dfb::Fragment& fragment)
{
    auto tile = std::make_unique<Tile>();
    static_cast<dfb::TileHeader&>(*tile) = fragment.header();
    tile->clear();
    const int width = tile->region.width(), height = tile->region.height();
    const d::ConstPlanes planes = tile->planes();
    dfb::FragmentCursor cursor(fragment);
    std::uint32_t pixels = 0;
    for (int y = 0; y < height; ++y) {
        const dfb::FragmentRow row = cursor.next();
        d::ConstPlanes from = row.aux;
        from.at[d::Color] = reinterpret_cast<const std::byte*>(row.color);
        from.at[d::Depth] = reinterpret_cast<const std::byte*>(row.depth);
        int next = 0;
        std::size_t k = 0;
        for (int s = 0; s < row.spanCount; ++s) {
            const dfb::Span span = row.spans[s];
            fuzz::require(span.x >= next && span.count > 0 && span.x + span.count <= width,
                          "spans are ordered and within their row");
            next = span.x + span.count;
            for (int x = span.x; x < next; ++x, ++k, ++pixels)
                for (std::size_t c = 0; c < d::channelCount; ++c) {
                    if (!d::hasChannel(fragment.channels(), c))
                        continue;
                    fuzz::require(from.at[c] != nullptr, "a channel of the mask is there");
                    const std::size_t bytes = 4 * d::channelWords[c];
                    auto* to = const_cast<std::byte*>(planes.at[c]) + bytes * static_cast<std::size_t>(y * side + x);
                    std::memcpy(to, from.at[c] + bytes * k, bytes);
                }
            if (row.depth)
                for (std::size_t i = k - span.count; i < k; ++i)
                    fuzz::require(!std::isnan(row.depth[i]), "no depth is NaN");
        }
    }
    fuzz::require(pixels == fragment.activePixels() || fragment.encoding() == dfb::FragmentEncoding::InPlace,
                  "the count of active pixels is right");
    return tile;
}

bool isActive(const Tile& tile, int x, int y, bool byDepth)
{
    const float* p = tile.pixel(x, y);
    return byDepth ? tile.depth[y * side + x] < std::numeric_limits<float>::infinity()
                   : p[0] != 0 || p[1] != 0 || p[2] != 0 || p[3] != 0;
}

// Whether the words are equal, where 0 equals -0, as rounding may turn one into the other.
bool areAlike(const std::byte* a, const std::byte* b, std::size_t words)
{
    for (std::size_t i = 0; i < 4 * words; i += 4) {
        const auto x = d::loadAs<float>(a + i), y = d::loadAs<float>(b + i);
        if (std::memcmp(a + i, b + i, 4) != 0 && !(x == 0 && y == 0))
            return false;
    }
    return true;
}

bool areAlike(const Tile& a, const Tile& b, dfb::ChannelMask channels, bool byDepth)
{
    const d::ConstPlanes as = a.planes(), bs = b.planes();
    for (int y = 0; y < a.region.height(); ++y)
        for (int x = 0; x < a.region.width(); ++x)
            for (std::size_t c = 0; c < d::channelCount; ++c) {
                const std::size_t words = d::channelWords[c], at = 4 * words * static_cast<std::size_t>(y * side + x);
                if ((isActive(a, x, y, byDepth) || isActive(b, x, y, byDepth)) && d::hasChannel(channels, c)
                    && !areAlike(as.at[c] + at, bs.at[c] + at, words))
                    return false;
            }
    return true;
}

bool isSame(const dfb::TileHeader& a, const dfb::TileHeader& b)
{
    return a.frame == b.frame && a.tile == b.tile && a.region == b.region && a.pass == b.pass
           && a.generation == b.generation && a.children == b.children && a.source == b.source && a.part == b.part;
}

// The message of a tile or, with WireFormat::Bytes, of an 8-bit image of the tile.
dfb::Buffer encode(dfb::MemoryPool& pool, const Tile& tile, dfb::ChannelMask channels, const dfb::Codec* with,
                   const d::WireCoder& coder, dfb::WireFormat color)
{
    d::InputFaults faults;
    if (color != dfb::WireFormat::Bytes)
        return d::encodeFragment(pool, tile, channels, 0, with, coder, color, faults);
    std::vector<std::uint8_t> levels(4 * side * side);
    for (std::size_t i = 0; i < levels.size(); ++i)
        levels[i] = static_cast<std::uint8_t>(std::lround(255 * tile.color[i]));
    d::InputPixels bytes(tile);
    bytes.planes.at[d::Color] = reinterpret_cast<const std::byte*>(levels.data());
    bytes.hasBytes = true;
    return d::encodeFragment(pool, bytes, channels, 0, with, coder, dfb::WireFormat::Float32, faults);
}

// Returns whether the bytes are an input of a tile.
bool take(fuzz::Input in)
{
    static const auto pool = dfb::MemoryPool::create(false);
    const auto flags = in.take<std::uint8_t>();
    const d::WireCoder coder = coderFor(flags);
    const dfb::Codec* with = flags & HasCodec ? codec() : nullptr;

    d::MessageHeader m;
    m.number = 7;
    auto h = in.take<d::FragmentHeader>();
    std::string payload = in.rest();
    if (with && (flags & Compress)) {
        std::string packed(with->bound(payload.size()), '\0');
        packed.resize(
            with->compress(fuzz::bytesOf(payload), payload.size(), reinterpret_cast<std::byte*>(packed.data())));
        payload = packed;
        h.codec = with->id();
        h.shape.isSplit = 1;
    }
    const std::string message = fuzz::Output().put(m).put(h).text(payload).bytes();

    dfb::Fragment fragment;
    try {
        fragment = decode(*pool, fuzz::ExactBlocks::copyOf(message), with, coder);
    } catch (const dfb::Error& e) {
        fuzz::require(e.info().kind == dfb::ErrorKind::MalformedMessage, "it is refused as malformed");
        return false;
    }
    const dfb::TileHeader& header = fragment.header();
    fuzz::require(header.tile >= 0 && header.tile < layout().tileCount() && header.tile != 2
                      && header.region == layout().region(header.tile),
                  "the tile is one of the image");
    fuzz::require(header.pass >= 0 && header.pass < passes, "the pass is one of the tile's");
    fuzz::require(header.generation >= 0 && header.frame == 7, "generation and frame");
    fuzz::require((fragment.channels() & dfb::colorChannel) && !(fragment.channels() & ~dfb::allChannels),
                  "the channels are such that there are");
    fuzz::require(fragment.hasDepth() == ((fragment.channels() & dfb::depthChannel) != 0) || fragment.empty(),
                  "depth is there if the mask says so");
    const auto tile = tileOf(fragment);
    fuzz::require(!fragment.isOpaque() || tile->isOpaque(), "what is opaque is so in all pixels");
    if (fragment.encoding() == dfb::FragmentEncoding::InPlace)
        return true; // shared floats may be out of range
    if (coder.activeByDepth() && !(fragment.channels() & dfb::depthChannel))
        return true; // refused for its channels

    dfb::Buffer again = encode(*pool, *tile, fragment.channels(), with, coder, fragment.colorFormat());
    const dfb::Fragment second = decode(*pool, std::move(again), with, coder);
    fuzz::require(isSame(header, second.header()), "the header comes back");
    fuzz::require(fragment.channels() == second.channels(), "the channels come back");
    fuzz::require(areAlike(*tile, *tileOf(second), fragment.channels(), coder.activeByDepth()), "the pixels come back");
    return true;
}

} // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size)
{
    take(fuzz::Input(data, size));
    return 0;
}

std::vector<std::pair<std::string, std::string>> fuzz::seeds()
{
    const auto pool = dfb::MemoryPool::create(false);
    std::vector<std::pair<std::string, std::string>> all;
    const auto add = [&](const std::string& name, const Tile& tile, dfb::ChannelMask channels, dfb::WireFormat color,
                         std::uint8_t flags) {
        const dfb::Codec* with = (flags & HasCodec) && !(flags & Compress) ? codec() : nullptr;
        const dfb::Buffer message = encode(*pool, tile, channels, with, coderFor(flags), color);
        const std::size_t prefix = sizeof(d::MessageHeader);
        std::string body = fuzz::textOf(message.data() + prefix, message.size() - prefix);
        all.emplace_back(name, fuzz::Output().put(flags).text(body).bytes());
        fuzz::require(take(fuzz::Input(all.back().second)), "what is good is taken");
    };
    const dfb::ChannelMask colorAndDepth = dfb::colorChannel | dfb::depthChannel;
    const auto tileWith = [](int index, const auto& isThere) {
        auto tile = std::make_unique<Tile>();
        static_cast<dfb::TileHeader&>(*tile) = {7, index, layout().region(index), 1, 2, 3, 0xfedcba98u, 5};
        tile->clear();
        tile->forEachPixel([&](int x, int y, float* rgba, float& depth) {
            const int px = x - tile->region.x0, py = y - tile->region.y0;
            if (!isThere(px, py))
                return;
            const auto at = static_cast<float>(px + side * py);
            for (int c = 0; c < 4; ++c)
                rgba[c] = (c == 3 ? 0.75f : 0.25f) + at / 512;
            depth = 1 + at / 16;
            tile->farDepth[py * side + px] = 2 + at / 16;
            tile->primitiveId[py * side + px] = 7;
        });
        return tile;
    };
    const auto empty = tileWith(0, [](int, int) { return false; });
    const auto dots = tileWith(1, [](int x, int y) { return (x + y) % 5 == 1 && y > 1; });
    const auto runs = tileWith(5, [](int x, int y) { return y % 3 != 0 && x < 3; });
    const auto dense = tileWith(5, [](int, int) { return true; });
    const auto constant = tileWith(3, [](int, int) { return true; });
    constant->fill({0.5f, 0.25f, 0.125f, 1}, 3);
    using Format = dfb::WireFormat;
    add("empty", *empty, colorAndDepth, Format::Float32, 0);
    add("dots", *dots, colorAndDepth, Format::Float32, 0);
    add("runs", *runs, colorAndDepth, Format::Float32, 0);
    add("dense", *dense, colorAndDepth, Format::Float32, 0);
    add("constant", *constant, colorAndDepth, Format::Float32, 0);
    add("color_only", *dots, dfb::colorChannel, Format::Float32, 0);
    add("all_channels", *runs, dfb::allChannels, Format::Float32, 0);
    add("deep", *dots, colorAndDepth | dfb::farChannel, Format::Float32, 0);
    add("half", *dots, colorAndDepth, Format::Float16, 0);
    add("unorm16", *dense, colorAndDepth, Format::Unorm16, LargeColors);
    add("unorm8", *runs, colorAndDepth, Format::Unorm8, 0);
    add("constant_unorm8", *constant, colorAndDepth, Format::Unorm8, 0);
    const auto black = tileWith(1, [](int x, int y) { return x < y; });
    black->forEachPixel([](int x, int, float* rgba, float&) { std::fill_n(rgba, 4, x % 3 ? 0.0f : 0.5f); });
    add("by_depth", *black, colorAndDepth, Format::Float32, ByDepth);
    add("by_depth_unorm8", *black, colorAndDepth, Format::Unorm8, ByDepth);
    add("compressed", *dots, colorAndDepth, Format::Float32, HasCodec);
    add("compressed_half", *dense, colorAndDepth, Format::Float16, HasCodec);
    add("compressed_here", *runs, dfb::allChannels, Format::Unorm8, HasCodec | Compress);
    add("bytes", *dots, colorAndDepth, Format::Bytes, 0);
    add("bytes_constant", *constant, colorAndDepth, Format::Bytes, 0);
    add("bytes_by_depth", *black, colorAndDepth, Format::Bytes, ByDepth);
    add("bytes_compressed", *runs, dfb::allChannels, Format::Bytes, HasCodec);
    const auto addInPlace = [&](const std::string& name, std::ptrdiff_t first, std::ptrdiff_t stride, bool hasBytes) {
        d::InputPixels tile(*dense);
        const auto* begin = reinterpret_cast<const std::byte*>(sharedFloats().data());
        tile.planes.at[d::Color] = begin + (hasBytes ? 4 : 16) * first;
        tile.planes.at[d::Depth] = begin + 4 * first;
        tile.stride = stride;
        tile.hasBytes = hasBytes;
        const dfb::Buffer message = d::encodeInPlace(
            *pool, tile, colorAndDepth, 0, [&](const std::byte* p) { return static_cast<std::int64_t>(p - begin); });
        const std::size_t prefix = sizeof(d::MessageHeader);
        const std::string body = fuzz::textOf(message.data() + prefix, message.size() - prefix);
        all.emplace_back(name, fuzz::Output().put(std::uint8_t{0}).text(body).bytes());
        fuzz::require(take(fuzz::Input(all.back().second)), "what is good is taken");
    };
    addInPlace("in_place", 16, 10, false);
    addInPlace("in_place_bytes", 200, 20, true);
    addInPlace("in_place_bottom_up", 100, -13, false);
    add("compressed_dense", *dense, colorAndDepth, Format::Float32, HasCodec | Compress);
    return all;
}
