// Sparse planes: spans and planes are unchanged after encoding and decoding, whatever the region, and invalid ones are
// refused.
#include "brief.hpp"
#include "catch.hpp"

#include <dfb/wire/sparse_planes.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <limits>
#include <memory>
#include <random>
#include <string>
#include <type_traits>
#include <vector>

namespace sparse_planes_cases {

namespace {

namespace d = dfb::detail;
using dfb::FragmentEncoding;

constexpr float notANumber = std::numeric_limits<float>::quiet_NaN();

// The spans of the active pixels, which are numbered row by row in the region.
d::ActiveSpans spansOf(const dfb::Region& region, const std::vector<bool>& isActive)
{
    d::ActiveSpans active;
    for (int y = 0; y < region.height(); ++y)
        active.findRow(
            y, 0, region.width(),
            [&](int x, int count) {
                std::uint64_t bits = 0;
                for (int i = 0; i < count; ++i)
                    bits |= std::uint64_t{isActive[static_cast<std::size_t>(y * region.width() + x + i)]} << i;
                return bits;
            },
            [](dfb::Span) {});
    active.endRows();
    return active;
}

// The error of `call`, or "".
template <class Call>
std::string refusal(const Call& call)
{
    try {
        call();
    } catch (const dfb::Error& e) {
        CHECK(e.info().kind == dfb::ErrorKind::MalformedMessage);
        return e.what();
    }
    return "";
}

bool contains(const std::string& text, const char* part) { return text.find(part) != std::string::npos; }

} // namespace

TEST_CASE("Spans reach over the places where a row is cut for the search", "[wire]")
{
    constexpr int size = 256;
    using Tile = dfb::Tile<dfb::colorChannel, size>;
    const auto tile = std::make_unique<Tile>();
    dfb::detail::ActivePixels active;
    dfb::detail::InputFaults faults;
    std::vector<float> colors(4 * size * size);
    for (const int width : {1, 63, 64, 65, 127, 128, 129, 256}) {
        tile->clear();
        tile->region = {0, 0, width, 3};
        for (int x = 0; x < width; ++x) {
            tile->pixel(x, 0)[3] = 1;                   // all
            tile->pixel(x, 1)[0] = x % 64 != 5 ? 1 : 0; // with gaps
        }
        active.gather(*tile, dfb::colorChannel, false, reinterpret_cast<std::byte*>(colors.data()), nullptr, faults);
        REQUIRE(active.rowCounts.size() == 2);
        CHECK(active.rowCounts[0] == 1);
        CHECK(active.spans[0].count == width);
        const int gaps = (width + 58) / 64;
        CHECK(active.rowCounts[1] == gaps + (width % 64 != 6));
        CHECK(active.pixels == static_cast<std::uint32_t>(2 * width - gaps));
    }
}

TEST_CASE("Outside of a view's valid region nothing is read", "[wire]")
{
    constexpr int size = 256, stride = 300;
    using View = dfb::TileView<dfb::colorChannel, size>;
    std::mt19937 random(11);
    std::vector<float> image(4 * stride * size), colors(4 * size * size), expectedColors(colors);
    const dfb::Region places[] = {{100, 40, 100 + size, 40 + size}, {0, 0, 70, 33}};
    for (int round = 0; round < repeats(60); ++round) {
        View view;
        view.region = places[round % 2];
        view.stride = stride;
        view.color = image.data();
        const auto place = [&](int begin, int end) {
            return begin - 10 + static_cast<int>(random() % static_cast<unsigned>(end - begin + 20));
        };
        const dfb::Region& r = view.region;
        view.valid = {place(r.x0, r.x1), place(r.y0, r.y1), place(r.x0, r.x1), place(r.y0, r.y1)};
        const dfb::Region valid = view.validRegion();
        for (int y = 0; y < size; ++y)
            for (int x = 0; x < stride; ++x)
                for (int c = 0; c < 4; ++c)
                    image[static_cast<std::size_t>(4 * (y * stride + x) + c)] =
                        valid.contains(r.x0 + x, r.y0 + y) ? (random() % 8 ? 0.5f : 0.0f) : notANumber;
        dfb::detail::ActivePixels narrow, wide;
        dfb::detail::InputFaults faults;
        narrow.gather(view, dfb::colorChannel, false, reinterpret_cast<std::byte*>(colors.data()), nullptr, faults);
        CHECK((faults.nonFinite == 0 && faults.alphaOutside == 0));
        for (float& value : image)
            value = std::isnan(value) ? 0 : value;
        view.valid = view.region;
        wide.gather(view, dfb::colorChannel, false, reinterpret_cast<std::byte*>(expectedColors.data()), nullptr,
                    faults);
        REQUIRE(narrow.pixels == wide.pixels);
        CHECK((narrow.pixels == 0 || (narrow.rowBegin == wide.rowBegin && narrow.rowEnd == wide.rowEnd)));
        CHECK(narrow.rowCounts == wide.rowCounts);
        CHECK(std::equal(narrow.spans.begin(), narrow.spans.end(), wide.spans.begin(), wide.spans.end(),
                         [](const dfb::Span& a, const dfb::Span& b) { return a.x == b.x && a.count == b.count; }));
        CHECK(std::equal(colors.begin(), colors.begin() + 4 * narrow.pixels, expectedColors.begin()));
    }
}

TEST_CASE("Planes that were split come back", "[wire]")
{
    std::mt19937 random(9);
    const auto check = [&](auto word, auto words) {
        for (const std::size_t pixels : {0u, 1u, 3u, 4u, 25u, 127u, 128u, 129u, 1024u}) {
            const std::size_t bytes = pixels * words * sizeof word;
            std::vector<std::byte> in(bytes), split(bytes + 1), plain(split), out(split);
            for (std::byte& byte : in)
                byte = static_cast<std::byte>(random() % (random() % 2 ? 256 : 3));
            const std::byte *from = in.data(), *middle = split.data();
            d::fastest<d::splitPlane<decltype(word), words>>(from, pixels, split.data());
            d::splitPlane<decltype(word), words>(from, pixels, plain.data());
            CHECK(split == plain);
            d::fastest<d::joinPlane<decltype(word), words>>(middle, pixels, out.data());
            CHECK(std::equal(in.begin(), in.end(), out.begin()));
            CHECK(out[bytes] == std::byte{0});
            d::joinPlane<decltype(word), words>(middle, pixels, out.data());
            CHECK(std::equal(in.begin(), in.end(), out.begin()));
            CHECK(out[bytes] == std::byte{0});
        }
    };
    check(std::uint8_t{}, std::integral_constant<std::size_t, 4>());
    check(std::uint16_t{}, std::integral_constant<std::size_t, 4>());
    check(std::uint32_t{}, std::integral_constant<std::size_t, 4>());
    check(std::uint32_t{}, std::integral_constant<std::size_t, 3>());
    check(std::uint32_t{}, std::integral_constant<std::size_t, 1>());
}

// Other versions of the library read this layout, so it must not change unnoticed.
TEST_CASE("A plane is split into differences to the pixel before, then into bytes", "[wire]")
{
    const std::uint16_t in[] = {1, 2, 3, 0x400, 3, 1, 3, 0x300}; // two pixels
    std::byte split[16];
    d::splitPlane<std::uint16_t, 4>(reinterpret_cast<const std::byte*>(in), 2, split);
    const int expected[] = {2, 4, 4, 1, 6, 0, 0, 0xff, /* the upper bytes */ 0, 0, 0, 0, 0, 0, 8, 1};
    for (int i = 0; i < 16; ++i)
        CHECK(std::to_integer<int>(split[i]) == expected[i]);
}

TEST_CASE("Active pixels come back at their places, in each format of planes, split or not", "[wire]")
{
    std::mt19937 random(21);
    for (const dfb::Region region : {dfb::Region{0, 0, 1, 1}, dfb::Region{8, 16, 15, 19}, dfb::Region{0, 0, 130, 9}})
        for (const std::size_t colorWordBytes : {1u, 2u, 4u})
            for (const dfb::ChannelMask channels : {dfb::colorChannel, dfb::allChannels})
                for (int round = 0; round < repeats(12); ++round) {
                    const auto all = static_cast<std::size_t>(region.width() * region.height());
                    std::vector<bool> isActive(all);
                    for (std::size_t i = 0; i < all; ++i)
                        isActive[i] = static_cast<int>(random() % 5) < round % 6;
                    const auto count = std::count(isActive.begin(), isActive.end(), true);
                    const d::ActiveSpans active = spansOf(region, isActive);
                    d::SparseShape shape = d::shapeOf(active, region);
                    CHECK(shape.encoding
                          == (count == 0                               ? FragmentEncoding::Empty
                              : static_cast<std::size_t>(count) == all ? FragmentEncoding::Dense
                                                                       : FragmentEncoding::Sparse));
                    shape.check(region);
                    const d::PlaneFormat format(channels, colorWordBytes);
                    std::vector<std::byte> source(16 * all * d::channelCount), body(format.bodyBytes(shape) + 1),
                        split(body), joined(body);
                    for (std::byte& byte : source)
                        byte = static_cast<std::byte>(random());
                    const auto planeOf = [&](std::size_t c) { return source.data() + 16 * all * c; };
                    encodeSparse(format, shape, active, body.data(), [&](std::size_t c, std::byte* out, std::size_t) {
                        const std::size_t each = format.pixelBytes(c);
                        active.forEachSpan(static_cast<std::size_t>(region.width()),
                                           [&](std::size_t first, int pixels) {
                                               const std::size_t bytes = each * static_cast<std::size_t>(pixels);
                                               std::memcpy(out, planeOf(c) + each * first, bytes);
                                               out += bytes;
                                           });
                    });
                    format.split(shape, body.data(), split.data());
                    format.join(shape, split.data(), joined.data());
                    REQUIRE(joined == body);
                    const d::SparseBody read = decodeSparse(format, shape, region.width(), joined.data());
                    std::vector<bool> found(all);
                    if (shape.encoding == FragmentEncoding::Sparse) {
                        const dfb::Span* span = read.spans;
                        for (int y = shape.rowBegin; y < shape.rowEnd; ++y)
                            for (int i = 0; i < read.rowCounts[y - shape.rowBegin]; ++i, ++span)
                                std::fill_n(found.begin() + y * region.width() + span->x, span->count, true);
                    } else {
                        found.assign(all, count > 0);
                    }
                    CHECK(found == isActive);
                    for (std::size_t c = 0; c < d::channelCount; ++c) {
                        REQUIRE((read.planes.at[c] != nullptr) == d::hasChannel(channels, c));
                        const std::size_t each = format.pixelBytes(c);
                        const std::byte* from = read.planes.at[c];
                        bool same = true;
                        for (std::size_t i = 0; i < all && from; ++i)
                            if (isActive[i]) {
                                same = same && std::memcmp(from, planeOf(c) + each * i, each) == 0;
                                from += each;
                            }
                        CHECK(same);
                    }
                }
}

TEST_CASE("A shape that the region cannot have is refused", "[wire]")
{
    const dfb::Region region{8, 8, 13, 11}; // 5 by 3
    d::SparseShape sparse;
    sparse.encoding = FragmentEncoding::Sparse;
    sparse.pixels = 4;
    sparse.spans = 2;
    sparse.rowEnd = 3;
    const auto changed = [&](const std::function<void(d::SparseShape&)>& change) {
        d::SparseShape shape = sparse;
        change(shape);
        return refusal([&] { shape.check(region); });
    };
    const auto with = [&](FragmentEncoding encoding, std::uint32_t pixels) {
        return changed([=](d::SparseShape& s) {
            s.encoding = encoding;
            s.pixels = pixels;
        });
    };
    CHECK(changed([](d::SparseShape&) {}) == "");
    CHECK(with(FragmentEncoding::Empty, 0) == "");
    CHECK(with(FragmentEncoding::Dense, 15) == "");
    CHECK(with(FragmentEncoding::Constant, 15) == "");
    CHECK(contains(with(static_cast<FragmentEncoding>(4), 15), "encoding"));
    CHECK(contains(with(FragmentEncoding::Empty, 1), "number of pixels"));
    CHECK(contains(with(FragmentEncoding::Sparse, 16), "number of pixels"));
    for (const std::uint32_t pixels : {0u, 14u, 16u, 0xffffffffu}) {
        CHECK(contains(with(FragmentEncoding::Dense, pixels), "number of pixels"));
        CHECK(contains(with(FragmentEncoding::Constant, pixels), "number of pixels"));
    }
    CHECK(contains(changed([](d::SparseShape& s) { s.rowEnd = 4; }), "rows"));
    CHECK(contains(changed([](d::SparseShape& s) { s.rowBegin = 3; }), "rows"));
    CHECK(contains(changed([](d::SparseShape& s) { s.rowBegin = 0xffff; }), "rows"));
    CHECK(contains(changed([](d::SparseShape& s) { s.spans = 5; }), "more spans"));
}

TEST_CASE("Spans that are out of order or their row, or do not add up, are refused", "[wire]")
{
    const dfb::Region region{0, 0, 5, 3};
    std::vector<bool> isActive(15);
    for (const std::size_t i : {1u, 3u, 10u, 11u})
        isActive[i] = true; // two spans in row 0, one of 2 pixels in row 2
    const d::ActiveSpans active = spansOf(region, isActive);
    const d::PlaneFormat format(dfb::colorChannel, 1);
    const auto refusalOf = [&](const std::function<void(d::SparseShape&, dfb::Span*, std::uint16_t*)>& change) {
        d::SparseShape shape = d::shapeOf(active, region);
        std::vector<std::uint32_t> body((format.bodyBytes(shape) + 3) / 4 + 2);
        auto* bytes = reinterpret_cast<std::byte*>(body.data());
        encodeSparse(format, shape, active, bytes, [](std::size_t, std::byte*, std::size_t) {});
        auto* spans = reinterpret_cast<dfb::Span*>(bytes + 16);
        change(shape, spans, reinterpret_cast<std::uint16_t*>(spans + 3));
        return refusal([&] { decodeSparse(format, shape, region.width(), bytes); });
    };
    using Shape = d::SparseShape;
    using Span = dfb::Span;
    CHECK(refusalOf([](Shape&, Span*, std::uint16_t*) {}) == "");
    CHECK(contains(refusalOf([](Shape&, Span* s, std::uint16_t*) { std::swap(s[0], s[1]); }), "outside its row"));
    CHECK(contains(refusalOf([](Shape&, Span* s, std::uint16_t*) { s[0].count = 3; }), "outside its row")); // overlap
    CHECK(contains(refusalOf([](Shape&, Span* s, std::uint16_t*) { s[1].count = 0; }), "outside its row"));
    CHECK(contains(refusalOf([](Shape&, Span* s, std::uint16_t*) { s[2].x = 4; }), "outside its row"));
    CHECK(contains(refusalOf([](Shape&, Span* s, std::uint16_t*) { s[2].x = 0xffff; }), "outside its row"));
    CHECK(contains(refusalOf([](Shape&, Span* s, std::uint16_t*) { s[2].count = 3; }), "add up"));
    CHECK(contains(refusalOf([](Shape&, Span*, std::uint16_t* n) { n[2] = 0; }), "add up"));
    CHECK(contains(refusalOf([](Shape&, Span*, std::uint16_t* n) { n[1] = 1; }), "more spans in the rows"));
    CHECK(contains(refusalOf([](Shape&, Span*, std::uint16_t* n) { n[0] = 0xffff; }), "more spans in the rows"));
}

} // namespace sparse_planes_cases
