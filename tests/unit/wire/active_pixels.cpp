// ActivePixels: which pixels of a row are active, and the check of copied pixels. Fast loops equal plain ones.
#include "catch.hpp"

#include <dfb/wire/active_pixels.hpp>
#include <dfb/wire/wire_kernels.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <random>
#include <vector>

namespace active_pixels_cases {

namespace {

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr float notANumber = std::numeric_limits<float>::quiet_NaN();
constexpr float denormal = std::numeric_limits<float>::denorm_min();

} // namespace

TEST_CASE("A pixel is active if any of its channels is not 0, whatever the sign", "[wire]")
{
    std::mt19937 random(5);
    const float values[] = {0, -0.0f, 0, -0.0f, 0, 1, denormal, -denormal, notANumber, infinity};
    for (int count = 1; count <= 64; ++count)
        for (int round = 0; round < 20; ++round) {
            std::vector<float> row(4 * static_cast<std::size_t>(count) + 1);
            for (float& value : row)
                value = values[random() % (round % 2 ? 10 : 5)];
            const float* rgba = row.data() + random() % 2; // not aligned either
            row.back() = 0;
            const int pixels = count - 1;
            std::uint64_t expected = 0;
            for (int i = 0; i < pixels; ++i) {
                const float* p = rgba + 4 * i;
                const bool isActive = p[0] != 0 || p[1] != 0 || p[2] != 0 || p[3] != 0;
                expected |= std::uint64_t{isActive} << i;
            }
            CHECK(dfb::detail::activePixelBits(rgba, rgba, pixels) == expected);
            CHECK(dfb::detail::findActivePixels(rgba, pixels) == expected);
            bool isGood = true;
            CHECK(dfb::detail::findActivePixelsPlain<false>(rgba, rgba, pixels, nullptr, isGood) == expected);
            const auto* bytes = reinterpret_cast<const std::byte*>(rgba); // one is active if any bit is set
            CHECK(dfb::detail::activeByteBits(bytes, pixels) == dfb::detail::findActiveBytes(bytes, pixels));
        }
}

TEST_CASE("By depth a pixel is active if that is below infinity, and NaN is noticed", "[wire]")
{
    std::mt19937 random(8);
    const float values[] = {infinity, infinity, notANumber, -notANumber, -infinity, 0, -0.0f, -1, 1e38f, denormal};
    for (int count = 0; count <= 64; ++count)
        for (int round = 0; round < 20; ++round) {
            std::vector<float> row(static_cast<std::size_t>(count) + 1);
            for (float& value : row)
                value = values[random() % 10];
            const float* depth = row.data() + random() % 2; // not aligned either
            const float limit = round % 3 == 0 ? 0.0f : infinity;
            std::uint64_t active = 0, nan = 0;
            for (int i = 0; i < count; ++i) {
                active |= std::uint64_t{depth[i] < limit} << i;
                nan |= std::uint64_t{std::isnan(depth[i])} << i;
            }
            for (const auto& bits :
                 {dfb::detail::depthBits(depth, count, limit), dfb::detail::findDepths(depth, count, limit)}) {
                CHECK(bits.active == active);
                CHECK(bits.nan == nan);
            }
        }
}

TEST_CASE("What is copied is checked, in each channel of each pixel", "[wire]")
{
    using namespace dfb::detail;
    const float fine[] = {0, -0.0f, 1, 0.5f, denormal, 0x1p-126f}, colors[] = {-1e30f, 1e38f, 2, -denormal};
    const float never[] = {notANumber, -notANumber, infinity, -infinity};
    std::mt19937 random(6);
    for (int count = 1; count <= 20; ++count) {
        std::vector<float> rgba(4 * static_cast<std::size_t>(count)), out(rgba.size());
        for (std::size_t i = 0; i < rgba.size(); ++i)
            rgba[i] = i % 4 < 3 && random() % 2 ? colors[random() % 4] : fine[random() % 6];
        const auto isClean = [&] {
            std::fill(out.begin(), out.end(), 7.0f);
            const bool plain = copyAndCheckColors(rgba.data(), count, out.data());
            CHECK(std::memcmp(rgba.data(), out.data(), 4 * rgba.size()) == 0);
            std::fill(out.begin(), out.end(), 7.0f);
            CHECK(DFB_FASTEST(copyAndCheckColors, copyAndCheckColorsAvx2, rgba.data(), count, out.data()) == plain);
            CHECK(std::memcmp(rgba.data(), out.data(), 4 * rgba.size()) == 0);
            return plain;
        };
        CHECK(isClean());
        for (std::size_t i = 0; i < rgba.size(); ++i) {
            const float before = rgba[i];
            for (const float wrong : never) {
                rgba[i] = wrong;
                CHECK_FALSE(isClean());
            }
            for (const float alpha : {std::nextafter(1.0f, 2.0f), -denormal, -1.0f}) {
                rgba[i] = alpha;
                CHECK(isClean() == (i % 4 != 3));
            }
            rgba[i] = before;
        }
        std::vector<float> depth(static_cast<std::size_t>(count), infinity), to(depth.size());
        for (std::size_t i = 0; i <= depth.size(); ++i) {
            if (i < depth.size())
                depth[i] = i % 2 ? notANumber : -notANumber;
            CHECK(copyAndCheckDepths(depth.data(), count, to.data()) == (i == depth.size()));
            CHECK(fastest<copyAndCheckDepths>(depth.data(), count, to.data()) == (i == depth.size()));
            for (std::size_t k = 0; k < depth.size(); ++k) // NaN is farthest,
                CHECK((to[k] == (k == i ? infinity : depth[k]) && (to[k] != 0 || !std::signbit(to[k])))); // nor -0
            if (i < depth.size())
                depth[i] = i % 3 ? -infinity : -0.0f;
        }
    }
}

TEST_CASE("Pixels that are copied as they are looked at are those that are found, and checked alike", "[wire]")
{
    using namespace dfb::detail;
    const float values[] = {0, 0, -0.0f, 0.5f, 1, denormal, -1, 2, infinity, notANumber};
    std::mt19937 random(7);
    for (int count = 1; count <= 64; ++count)
        for (int round = 0; round < 30; ++round) {
            const unsigned kinds = round % 3 == 0 ? 3 : round % 3 == 1 ? 6 : 10; // empty, without faults, all
            std::vector<float> row(4 * static_cast<std::size_t>(count) + 1), out(row.size(), 7.0f), plain(out);
            for (float& value : row)
                value = values[random() % kinds];
            const float* rgba = row.data() + random() % 2; // not aligned either
            const bool wasGood = round % 4 != 0;
            const bool isExpected = copyAndCheckColors(rgba, count, plain.data()) && wasGood;
            for (const auto copyAndFind : {copyAndFindActivePixels, findActivePixelsPlain<true>}) {
                bool isGood = wasGood;
                std::fill(out.begin(), out.end(), 7.0f);
                CHECK(copyAndFind(rgba, rgba, count, out.data(), isGood) == findActivePixels(rgba, count));
                CHECK(isGood == isExpected);
                CHECK(std::memcmp(out.data(), plain.data(), sizeof(float) * out.size()) == 0); // and no more
            }
        }
}

TEST_CASE("A row in place is read alike, whatever the row above was", "[wire]")
{
    using namespace dfb::detail;
    constexpr int width = 150, height = 60, stride = 160;
    std::mt19937 random(9);
    int full = 0;
    for (int round = 0; round < 40; ++round) {
        std::vector<float> colors(4 * stride * height), depths(stride * height);
        std::uint32_t kind = 0;
        for (std::size_t i = 0; i < depths.size(); ++i) {
            if (i % stride == 0) // rows are full, or have gaps, or faults; often several alike
                kind = random() % 3 == 0 ? random() % 4 : kind;
            const bool isThere = kind == 0 || random() % (kind == 1 ? 40 : 3) != 0;
            for (std::size_t c = 0; c < 4; ++c)
                colors[4 * i + c] = isThere ? 0.25f * static_cast<float>(random() % 4 + 1) : 0.0f;
            depths[i] = static_cast<float>(random() % 5);
            if (kind == 3 && random() % 20 == 0)
                colors[4 * i + random() % 4] = random() % 2 ? notANumber : 1.5f;
            if (kind == 3 && random() % 20 == 0)
                depths[i] = notANumber;
        }
        PixelsInPlace pixels;
        pixels.color = reinterpret_cast<const std::byte*>(colors.data());
        pixels.depth = round % 2 ? depths.data() : nullptr;
        pixels.stride = stride;
        pixels.valid = round % 4 < 2 ? dfb::Region{0, 0, width, height} : dfb::Region{3, 2, width - 1, height - 5};
        pixels.activity.depthLimit = round % 8 == 7 ? 3.0f : infinity;
        RowPixels kept;
        InputFaults faults, expectedFaults;
        for (int y = 0; y < height; ++y) {
            RowPixels expected;
            pixels.readRow(y, kept, faults);
            pixels.readRow(y, expected, expectedFaults);
            REQUIRE(kept.active.spans.size() == expected.active.spans.size());
            for (std::size_t i = 0; i < kept.active.spans.size(); ++i) {
                CHECK(kept.active.spans[i].x == expected.active.spans[i].x);
                CHECK(kept.active.spans[i].count == expected.active.spans[i].count);
            }
            const std::size_t count = kept.active.pixels;
            REQUIRE(count == expected.active.pixels);
            CHECK((count == 0 || std::memcmp(kept.color.data(), expected.color.data(), 16 * count) == 0));
            CHECK(
                (!pixels.depth || count == 0 || std::memcmp(kept.depth.data(), expected.depth.data(), 4 * count) == 0));
            full += kept.isFull;
        }
        CHECK(faults.nonFinite == expectedFaults.nonFinite);
        CHECK(faults.alphaOutside == expectedFaults.alphaOutside);
    }
    CHECK(full > 100);
}

} // namespace active_pixels_cases
