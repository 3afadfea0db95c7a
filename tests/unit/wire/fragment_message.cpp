// The wire format: tiles are unchanged after encoding and decoding, in all encodings and with compression, and bytes
// that are not a message are refused.
#include "brief.hpp"
#include "catch.hpp"

#include <dfb/wire/fragment_message.hpp>
#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

namespace fragment_message_cases {

namespace {

using dfb::detail::fragmentPrefix;
using Random = std::mt19937_64;

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr float notANumber = std::numeric_limits<float>::quiet_NaN();

template <int Size>
using TileOf = dfb::Tile<dfb::colorChannel | dfb::depthChannel, Size>;

enum class Content { Empty, OnePixel, Spans, Checkers, OneGap, Dense, Constant, ConstantColor };

// A cleared tile of a layout, with its header filled in.
template <int Size>
std::unique_ptr<TileOf<Size>> makeTile(const dfb::TileLayout& layout, int index)
{
    auto tile = std::make_unique<TileOf<Size>>();
    static_cast<dfb::TileHeader&>(*tile) = {77, index, layout.region(index), 2, 5, 3, 0xfedcba98u, 0x7654};
    tile->clear();
    // Pixels outside the region are never read: make it show if they are.
    for (int y = 0; y < Size; ++y)
        for (int x = 0; x < Size; ++x)
            if (x >= tile->region.width() || y >= tile->region.height()) {
                std::fill_n(tile->pixel(x, y), 4, notANumber);
                tile->depth[y * Size + x] = notANumber;
            }
    return tile;
}

template <int Size>
void fill(TileOf<Size>& tile, Content content, Random& random)
{
    const int width = tile.region.width(), height = tile.region.height();
    const auto number = [&] { return static_cast<float>(random() >> 40) * 0x1p-24f + 0x1p-30f; };
    const int gapX = static_cast<int>(random() % static_cast<unsigned>(width)),
              gapY = static_cast<int>(random() % static_cast<unsigned>(height));
    bool inSpan = false;
    const float constant[4] = {number(), number(), number(), number()};
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            bool active = false;
            switch (content) {
            case Content::Empty: break;
            case Content::OnePixel: active = x == gapX && y == gapY; break;
            case Content::Spans:
                if (random() % 7 == 0)
                    inSpan = !inSpan;
                active = inSpan && y % 5 != 3;
                break;
            case Content::Checkers: active = (x + y) % 2 == 0; break;
            case Content::OneGap: active = x != gapX || y != gapY; break;
            case Content::Dense:
            case Content::Constant:
            case Content::ConstantColor: active = true; break;
            }
            if (!active)
                continue;
            float* p = tile.pixel(x, y);
            float& depth = tile.depth[y * Size + x];
            if (content == Content::Constant || content == Content::ConstantColor) {
                std::copy_n(constant, 4, p);
                depth = content == Content::Constant ? 0.5f : number();
            } else {
                // One channel alone makes a pixel active.
                const bool alone = random() % 4 == 0;
                for (int c = 0; c < 4; ++c)
                    p[c] = alone ? 0.0f : number();
                p[random() % 4] = random() % 9 == 0 ? -number() : number();
                depth = random() % 5 == 0 ? infinity : number() - 0.5f;
            }
        }
}

bool isActive(const float* p) { return p[0] != 0 || p[1] != 0 || p[2] != 0 || p[3] != 0; }

// Number of pixels where the fragment is not the tile, bit for bit (a depth in its canonical form).
template <int Size>
std::size_t differences(const TileOf<Size>& tile, const dfb::Fragment& fragment, bool withDepth)
{
    std::size_t wrong = 0;
    dfb::FragmentCursor cursor(fragment);
    for (int y = 0; y < tile.region.height(); ++y) {
        const dfb::FragmentRow row = cursor.next();
        std::vector<int> index(static_cast<std::size_t>(tile.region.width()), -1);
        int next = 0;
        for (int s = 0; s < row.spanCount; ++s)
            for (int i = 0; i < row.spans[s].count; ++i)
                index.at(static_cast<std::size_t>(row.spans[s].x + i)) = next++;
        for (int x = 0; x < tile.region.width(); ++x) {
            const int k = index[static_cast<std::size_t>(x)];
            if ((k >= 0) != isActive(tile.pixel(x, y))) {
                ++wrong;
                continue;
            }
            if (k < 0)
                continue;
            wrong += std::memcmp(row.color + 4 * k, tile.pixel(x, y), 4 * sizeof(float)) != 0;
            if (withDepth != (row.depth != nullptr))
                ++wrong;
            else if (withDepth)
                wrong += row.depth[k] != tile.depth[y * Size + x];
        }
    }
    // forEachPixel() gives each of these pixels once, row by row, with the same values.
    std::size_t seen = 0;
    int last = -1;
    const auto look = [&](int x, int y, const float* rgba, float depth) {
        const int place = y * Size + x;
        wrong += place <= last || !isActive(tile.pixel(x, y))
                 || std::memcmp(rgba, tile.pixel(x, y), 4 * sizeof(float)) != 0
                 || depth != (withDepth ? tile.depth[place] : infinity);
        last = place;
        ++seen;
    };
    fragment.forEachPixel(look);
    const std::size_t active = seen;
    last = -1;
    fragment.forEachPixel([&](int x, int y, const float* rgba, float depth, const dfb::FragmentRow& row, int k) {
        wrong += rgba != row.color + 4 * k || (withDepth && depth != row.depth[k]);
        look(x, y, rgba, depth);
    });
    return wrong + (active != fragment.activePixels()) + (seen != 2 * active);
}

dfb::FragmentEncoding expectedEncoding(Content content, bool withDepth, std::size_t active, std::size_t pixels)
{
    if (active == 0)
        return dfb::FragmentEncoding::Empty;
    if (active < pixels)
        return dfb::FragmentEncoding::Sparse;
    const bool constant =
        pixels == 1 || content == Content::Constant || (content == Content::ConstantColor && !withDepth);
    return constant ? dfb::FragmentEncoding::Constant : dfb::FragmentEncoding::Dense;
}

// All contents, with and without depth, at a place of a layout.
template <int Size>
void roundTrips(const dfb::TileLayout& layout, int index, const dfb::Codec* codec, Random& random)
{
    const auto pool = dfb::MemoryPool::create();
    for (const Content content : {Content::Empty, Content::OnePixel, Content::Spans, Content::Checkers, Content::OneGap,
                                  Content::Dense, Content::Constant, Content::ConstantColor})
        for (const bool withDepth : {true, false}) {
            auto tile = makeTile<Size>(layout, index);
            fill(*tile, content, random);
            const auto wanted = static_cast<dfb::ChannelMask>(dfb::colorChannel | (withDepth ? dfb::depthChannel : 0));
            dfb::detail::InputFaults faults;
            dfb::Buffer message = dfb::detail::encodeFragment(*pool, *tile, wanted, 9, codec, dfb::detail::WireCoder(),
                                                              dfb::WireFormat::Float32, faults);
            dfb::detail::InputFaults uncounted;
            const std::size_t rawBytes =
                dfb::detail::encodeFragment(*pool, *tile, wanted, 9, nullptr, dfb::detail::WireCoder(),
                                            dfb::WireFormat::Float32, uncounted)
                    .size();
            INFO("size " << Size << ", content " << static_cast<int>(content) << ", depth " << withDepth << ", region "
                         << tile->region.width() << "x" << tile->region.height());
            std::size_t active = 0;
            for (int y = 0; y < tile->region.height(); ++y)
                for (int x = 0; x < tile->region.width(); ++x)
                    active += isActive(tile->pixel(x, y));
            const auto pixels = static_cast<std::size_t>(tile->region.width() * tile->region.height());

            // The same pixels somewhere in a larger image.
            const std::size_t stride = static_cast<std::size_t>(Size) + 13;
            std::vector<float> rgba(4 * stride * Size, notANumber), depth(stride * Size, notANumber);
            dfb::TileView<TileOf<Size>::channels, Size> view;
            static_cast<dfb::TileHeader&>(view) = *tile;
            view.stride = stride;
            view.color = &rgba[4 * 7];
            view.depth = withDepth ? &depth[7] : nullptr;
            for (int y = 0; y < tile->region.height(); ++y) {
                const std::size_t first = static_cast<std::size_t>(y) * stride + 7;
                const auto width = static_cast<std::size_t>(tile->region.width());
                std::memcpy(&rgba[4 * first], tile->pixel(0, y), 4 * sizeof(float) * width);
                std::memcpy(&depth[first], tile->depth + y * Size, sizeof(float) * width);
            }
            const dfb::Buffer viewed = dfb::detail::encodeFragment(
                *pool, view, wanted, 9, codec, dfb::detail::WireCoder(), dfb::WireFormat::Float32, uncounted);
            CHECK(viewed.size() == message.size());
            CHECK(std::memcmp(viewed.data(), message.data(), message.size()) == 0);

            CHECK(faults.nonFinite == 0);
            CHECK(message.size() <= rawBytes);
            const auto header = dfb::detail::readMessageHeader(message);
            CHECK(header.kind == dfb::detail::MessageKind::Fragment);
            CHECK(header.number == 77);
            CHECK(header.receiver == 9);
            const std::size_t sizeBefore = message.size();
            const dfb::Fragment fragment = dfb::detail::decodeFragment(
                *pool, std::move(message), layout, [](int) { return 3; }, codec, dfb::detail::WireCoder());
            const dfb::TileHeader& h = fragment.header();
            CHECK((h.frame == 77 && h.tile == index && h.region == tile->region && h.pass == 2 && h.generation == 5
                   && h.children == 3 && h.source == 0xfedcba98u && h.part == 0x7654));
            const dfb::FragmentEncoding encoding = expectedEncoding(content, withDepth, active, pixels);
            CHECK(fragment.encoding() == encoding);
            CHECK(fragment.activePixels() == active);
            CHECK(fragment.empty() == (active == 0));
            CHECK(differences(*tile, fragment, withDepth) == 0);
            // What travels: nothing, one pixel, or the active pixels and at most the table of spans.
            const std::size_t pixelBytes = withDepth ? 20 : 16;
            if (encoding == dfb::FragmentEncoding::Empty)
                CHECK(sizeBefore == fragmentPrefix);
            else if (encoding == dfb::FragmentEncoding::Constant)
                CHECK(rawBytes == fragmentPrefix + pixelBytes);
            else if (encoding == dfb::FragmentEncoding::Dense)
                CHECK(rawBytes == fragmentPrefix + pixels * pixelBytes);
            else
                CHECK(rawBytes
                      <= fragmentPrefix + active * pixelBytes + 4 * active + 2 * static_cast<std::size_t>(Size));
        }
}

void allRoundTrips(const dfb::Codec* codec)
{
    Random random(11);
    roundTrips<8>(dfb::TileLayout(8, 8, 8), 0, codec, random);
    roundTrips<8>(dfb::TileLayout(1, 1, 8), 0, codec, random);
    roundTrips<8>(dfb::TileLayout(13, 11, 8), 1, codec, random);
    roundTrips<64>(dfb::TileLayout(64, 64, 64), 0, codec, random);
    roundTrips<64>(dfb::TileLayout(101, 67, 64), 3, codec, random);
    roundTrips<256>(dfb::TileLayout(256, 256, 256), 0, codec, random);
    roundTrips<256>(dfb::TileLayout(257, 300, 256), 1, codec, random);
}

// One valid message of each kind.
std::vector<std::vector<std::byte>> validMessages(const dfb::TileLayout& layout, const dfb::Codec* codec)
{
    const auto pool = dfb::MemoryPool::create();
    Random random(5);
    std::vector<std::vector<std::byte>> messages;
    for (const Content content :
         {Content::Empty, Content::OnePixel, Content::Spans, Content::OneGap, Content::Dense, Content::Constant}) {
        auto tile = makeTile<8>(layout, 1);
        fill(*tile, content, random);
        dfb::detail::InputFaults faults;
        const dfb::Buffer message = dfb::detail::encodeFragment(*pool, *tile, 3, 9, codec, dfb::detail::WireCoder(),
                                                                dfb::WireFormat::Float32, faults);
        messages.emplace_back(message.data(), message.data() + message.size());
    }
    return messages;
}

enum class Outcome { Decoded, Refused };

// Decodes and reads every pixel (for the address sanitizer); anything but Error passes through.
Outcome tryDecode(const std::vector<std::byte>& bytes, const dfb::TileLayout& layout, const dfb::Codec* codec)
{
    const auto pool = dfb::MemoryPool::create();
    dfb::Buffer message = pool->acquire(bytes.size());
    std::copy(bytes.begin(), bytes.end(), message.data());
    try {
        dfb::detail::readMessageHeader(message);
        const dfb::Fragment fragment = dfb::detail::decodeFragment(
            *pool, std::move(message), layout, [](int) { return 3; }, codec, dfb::detail::WireCoder());
        dfb::FragmentCursor cursor(fragment);
        const int width = fragment.header().region.width();
        std::uint32_t pixels = 0;
        float sum = 0;
        for (int y = 0; y < fragment.header().region.height(); ++y) {
            const dfb::FragmentRow row = cursor.next();
            std::size_t k = 0;
            for (int s = 0; s < row.spanCount; ++s) {
                if (row.spans[s].x + row.spans[s].count > width)
                    throw std::logic_error("a span outside its row was let through");
                for (int i = 0; i < row.spans[s].count; ++i, ++k, ++pixels) {
                    for (std::size_t c = 0; c < 4; ++c)
                        sum += row.color[4 * k + c];
                    if (row.depth && std::isnan(row.depth[k]))
                        throw std::logic_error("a NaN for a depth was let through");
                }
            }
        }
        volatile float sink = sum; // the reads must happen
        (void)sink;
        if (pixels != fragment.activePixels())
            throw std::logic_error("the count of active pixels is wrong");
        return Outcome::Decoded;
    } catch (const dfb::Error& e) {
        if (e.info().kind != dfb::ErrorKind::MalformedMessage)
            throw std::logic_error(std::string("refused, but as: ") + e.what());
        return Outcome::Refused;
    }
}

void prefixesAndFlips(const dfb::Codec* codec)
{
    const dfb::TileLayout layout(13, 11, 8);
    Random random(3);
    int refusedFlips = 0, decodedFlips = 0;
    for (const auto& message : validMessages(layout, codec)) {
        REQUIRE(tryDecode(message, layout, codec) == Outcome::Decoded);
        std::size_t decodedPrefixes = 0;
        for (std::size_t length = 0; length < message.size(); ++length)
            decodedPrefixes +=
                tryDecode({message.begin(), message.begin() + static_cast<std::ptrdiff_t>(length)}, layout, codec)
                == Outcome::Decoded;
        CHECK(decodedPrefixes == 0);
        auto longer = message;
        longer.push_back(std::byte{0});
        CHECK(tryDecode(longer, layout, codec) == Outcome::Refused);
        for (int i = 0; i < repeats(3000); ++i) {
            auto broken = message;
            // Mostly in the header and the table, where it hurts.
            const std::size_t range =
                i % 3 == 0 ? broken.size() : std::min<std::size_t>(broken.size(), fragmentPrefix + 32);
            for (std::uint64_t flips = 1 + random() % 3; flips > 0; --flips)
                broken[random() % range] ^= static_cast<std::byte>(1u << random() % 8);
            CHECK_NOTHROW(tryDecode(broken, layout, codec) == Outcome::Decoded ? ++decodedFlips : ++refusedFlips);
        }
    }
    // Both happen: the test looks at decoded garbage as well as at refusals.
    CHECK(refusedFlips > repeats(1000));
    CHECK(decodedFlips > repeats(100));
}

} // namespace

TEST_CASE("Tiles come through the wire as they were, in the smallest encoding", "[wire]") { allRoundTrips(nullptr); }

TEST_CASE("A colour that is out of its format's range is refused, in every place of it", "[wire]")
{
    const auto pool = dfb::MemoryPool::create();
    const dfb::TileLayout layout(5, 3, 8);
    const dfb::detail::WireCoder coder{dfb::Precision(dfb::WireFormat::Float16)};
    auto tile = makeTile<8>(layout, 0);
    for (int y = 0; y < 3; ++y)
        for (int x = 0; x < 5; ++x) {
            const float red = x % 2 == 0 ? 1.0f : 0.5f; // the largest that there is
            const float rgba[4] = {red, -0.0f, 0.25f, 1};
            std::copy_n(rgba, 4, tile->pixel(x, y));
        }
    const auto isRefused = [&](std::size_t place, std::uint16_t code) {
        dfb::detail::InputFaults faults;
        dfb::Buffer message = dfb::detail::encodeFragment(*pool, *tile, dfb::colorChannel, 9, nullptr, coder,
                                                          dfb::WireFormat::Float16, faults);
        REQUIRE(message.size() == fragmentPrefix + (4 * 15 * 2 + 3) / 4 * 4);
        if (code != 0)
            std::memcpy(message.data() + fragmentPrefix + 2 * place, &code, sizeof code);
        try {
            dfb::detail::decodeFragment(
                *pool, std::move(message), layout, [](int) { return 3; }, nullptr, coder);
            return false;
        } catch (const dfb::Error& e) {
            return e.info().kind == dfb::ErrorKind::MalformedMessage;
        }
    };
    CHECK_FALSE(isRefused(0, 0));
    int wrong = 0;
    for (std::size_t place = 0; place < 4 * 15; ++place) {
        for (const std::uint16_t none : {0x7801, 0x7bff, 0x7c00, 0x7e00, 0x8000, 0x8001, 0xbc00, 0xfc00, 0xffff})
            wrong += !isRefused(place, none);
        for (const std::uint16_t code : {1, 0x0400, 0x7800})
            wrong += isRefused(place, code);
    }
    CHECK(wrong == 0);
}

TEST_CASE("Depth travels in canonical form, and what is not finite is counted once a pixel", "[wire]")
{
    const auto pool = dfb::MemoryPool::create();
    const dfb::TileLayout layout(8, 8, 8);
    auto tile = makeTile<8>(layout, 0);
    tile->pixel(0, 0)[3] = 1.0f, tile->depth[0] = -0.0f;
    tile->pixel(1, 0)[3] = 1.0f, tile->depth[1] = notANumber;       // counted
    tile->pixel(2, 0)[0] = tile->pixel(2, 0)[1] = infinity;         // counted once
    tile->pixel(3, 0)[2] = notANumber, tile->depth[3] = notANumber; // counted once
    tile->pixel(4, 0)[3] = 1.0f, tile->depth[4] = infinity;         // a depth may be infinite
    tile->depth[5] = notANumber;                                    // not active: does not travel
    dfb::detail::InputFaults faults;
    dfb::Buffer message = dfb::detail::encodeFragment(*pool, *tile, 3, 0, nullptr, dfb::detail::WireCoder(),
                                                      dfb::WireFormat::Float32, faults);
    CHECK(faults.nonFinite == 3);
    const dfb::Fragment fragment = dfb::detail::decodeFragment(
        *pool, std::move(message), layout, [](int) { return 3; }, nullptr, dfb::detail::WireCoder());
    dfb::FragmentCursor cursor(fragment);
    const dfb::FragmentRow row = cursor.next();
    REQUIRE(row.spanCount == 1);
    REQUIRE(row.spans[0].count == 5);
    CHECK_FALSE(std::signbit(row.depth[0]));
    CHECK(row.depth[1] == infinity);
    CHECK(row.depth[4] == infinity);

    faults = {};
    dfb::detail::encodeFragment(*pool, *tile, dfb::colorChannel, 0, nullptr, dfb::detail::WireCoder(),
                                dfb::WireFormat::Float32, faults);
    CHECK(faults.nonFinite == 2); // depth that does not travel is not looked at

    tile->fill({notANumber, 0, 0, 1}, 0.0f);
    faults = {};
    dfb::detail::encodeFragment(*pool, *tile, 3, 0, nullptr, dfb::detail::WireCoder(), dfb::WireFormat::Float32,
                                faults);
    CHECK(faults.nonFinite == 64); // also where the tile is constant and travels as one pixel
}

TEST_CASE("By depth what has one travels, whatever its colour, and nothing else", "[wire]")
{
    const auto pool = dfb::MemoryPool::create();
    const dfb::TileLayout layout(8, 8, 8);
    auto tile = makeTile<8>(layout, 0);
    tile->pixel(0, 0)[3] = 1.0f;                                                  // no depth
    tile->depth[1] = 2.0f;                                                        // no colour
    tile->pixel(2, 0)[0] = notANumber, tile->depth[2] = -infinity;                // counted
    tile->pixel(3, 0)[3] = 1.0f, tile->depth[3] = notANumber;                     // counted, is not there
    tile->pixel(4, 0)[0] = notANumber;                                            // is not looked at
    tile->pixel(5, 0)[0] = 0.5f, tile->pixel(5, 0)[3] = 1.0f, tile->depth[5] = 0; // in range
    for (const auto format : {dfb::WireFormat::Float32, dfb::WireFormat::Unorm8}) {
        const dfb::detail::WireCoder coder(dfb::Precision(format), true);
        dfb::detail::InputFaults faults;
        const dfb::Fragment fragment = dfb::detail::decodeFragment(
            *pool, dfb::detail::encodeFragment(*pool, *tile, 3, 0, nullptr, coder, format, faults), layout,
            [](int) { return 3; }, nullptr, coder);
        CHECK(faults.nonFinite == 2);
        dfb::FragmentCursor cursor(fragment);
        const dfb::FragmentRow row = cursor.next();
        REQUIRE(row.spanCount == 2);
        CHECK((row.spans[0].x == 1 && row.spans[0].count == 2));
        CHECK((row.spans[1].x == 5 && row.spans[1].count == 1));
        CHECK((row.depth[0] == 2.0f && row.depth[1] == -infinity && row.depth[2] == 0.0f));
        CHECK((row.color[3] == 0.0f && row.color[11] == 1.0f));
        CHECK(fragment.activePixels() == 3);
        tile->pixel(2, 0)[0] = 0.0f, tile->depth[3] = infinity; // then alpha 0 is rounded, too
        faults = {};
        const dfb::Fragment rounded = dfb::detail::decodeFragment(
            *pool, dfb::detail::encodeFragment(*pool, *tile, 3, 0, nullptr, coder, format, faults), layout,
            [](int) { return 3; }, nullptr, coder);
        CHECK(faults.nonFinite == 0);
        CHECK(rounded.colorFormat() == format);
        CHECK(rounded.color()[3] == 0.0f);
        tile->pixel(2, 0)[0] = tile->depth[3] = notANumber;
    }
}

TEST_CASE("Bytes that are no message are refused or decode to something valid", "[wire]") { prefixesAndFlips(nullptr); }

TEST_CASE("A message of another version, byte order or codec is named as such", "[wire]")
{
    const dfb::TileLayout layout(13, 11, 8);
    const auto pool = dfb::MemoryPool::create();
    const auto textFor = [&](std::size_t at, int value) {
        auto bytes = validMessages(layout, nullptr)[2];
        bytes.at(at) = static_cast<std::byte>(value);
        dfb::Buffer message = pool->acquire(bytes.size());
        std::copy(bytes.begin(), bytes.end(), message.data());
        try {
            dfb::detail::readMessageHeader(message);
            dfb::detail::decodeFragment(
                *pool, std::move(message), layout, [](int) { return 3; }, nullptr, dfb::detail::WireCoder());
        } catch (const dfb::Error& e) {
            return std::string(e.what());
        }
        return std::string();
    };
    CHECK(textFor(0, 0xff) != "");
    CHECK(textFor(2, dfb::detail::MessageHeader::formatVersion + 1).find("version") != std::string::npos);
    CHECK(textFor(3, 200).find("kind") != std::string::npos);
    CHECK(textFor(sizeof(dfb::detail::MessageHeader) + offsetof(dfb::detail::FragmentHeader, codec), 1).find("codec")
          != std::string::npos);
    CHECK(textFor(sizeof(dfb::detail::MessageHeader) + offsetof(dfb::detail::FragmentHeader, tile), 99).find("tile")
          != std::string::npos);
    CHECK(textFor(sizeof(dfb::detail::MessageHeader) + offsetof(dfb::detail::FragmentHeader, pass), 3).find("pass")
          != std::string::npos);
}

TEST_CASE("Pixels of 8 bits may lie at any address, floats at a multiple of 4 only", "[wire]")
{
    namespace d = dfb::detail;
    const dfb::TileLayout layout(8, 8, 8);
    const auto tile = makeTile<8>(layout, 0);
    const auto pool = dfb::MemoryPool::create();
    const std::vector<std::byte> shared(1100);
    const auto bytesAt = [&](std::int64_t offset, std::int64_t) { return shared.data() + offset; };
    for (const bool hasBytes : {true, false})
        for (const std::int64_t first : {4, 5}) {
            d::InputPixels pixels(*tile);
            pixels.hasBytes = hasBytes;
            pixels.planes.at[d::Color] = shared.data();
            const auto offsetOf = [&](const std::byte* p) -> std::int64_t { return first + (p - shared.data()); };
            const auto decode = [&] {
                d::decodeFragment(
                    *pool, d::encodeInPlace(*pool, pixels, dfb::colorChannel, 0, offsetOf), layout,
                    [](int) { return 3; }, nullptr, d::WireCoder(), bytesAt);
            };
            INFO((hasBytes ? "bytes at " : "floats at ") << first);
            if (hasBytes || first == 4)
                CHECK_NOTHROW(decode());
            else
                CHECK_THROWS_AS(decode(), dfb::Error);
        }
}

#if defined(DFB_HAS_SNAPPY)
TEST_CASE("Compressed tiles come through as they were, never larger than raw", "[wire]")
{
    const dfb::SnappyCodec codec;
    allRoundTrips(&codec);

    // And it is used where it helps.
    const auto pool = dfb::MemoryPool::create();
    const dfb::TileLayout layout(64, 64, 64);
    auto tile = makeTile<64>(layout, 0);
    tile->fill({0.5f, 0.5f, 0.5f, 0.5f}, 1.0f);
    tile->pixel(0, 0)[0] = 0.25f;
    dfb::detail::InputFaults faults;
    const std::size_t raw = dfb::detail::encodeFragment(*pool, *tile, 3, 0, nullptr, dfb::detail::WireCoder(),
                                                        dfb::WireFormat::Float32, faults)
                                .size();
    CHECK(dfb::detail::encodeFragment(*pool, *tile, 3, 0, &codec, dfb::detail::WireCoder(), dfb::WireFormat::Float32,
                                      faults)
              .size()
          < raw / 10);
}

TEST_CASE("Compressed bytes that are no message are refused or decode to something valid", "[wire]")
{
    const dfb::SnappyCodec codec;
    prefixesAndFlips(&codec);
}
#endif

} // namespace fragment_message_cases
