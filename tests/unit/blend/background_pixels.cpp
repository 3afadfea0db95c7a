// BackgroundPixels: pixels of a tile that show the background already are written again only if they must be.
#include "brief.hpp"
#include "catch.hpp"

#include <dfb/blend/background_pixels.hpp>
#include <dfb/tile_op.hpp>

#include <algorithm>
#include <cstddef>
#include <limits>
#include <random>
#include <vector>

namespace background_pixels_cases {

TEST_CASE("Of pixels that become background those are written that are not", "[background_pixels]")
{
    for (const int width : {1, 63, 64, 65, 200}) {
        constexpr int height = 3;
        std::mt19937 random(static_cast<unsigned>(width));
        std::vector<bool> known(static_cast<std::size_t>(width * height), false);
        dfb::detail::BackgroundPixels pixels;
        pixels.newFrame(width, height, 7);
        int writes = 0;
        for (int round = 0; round < repeats(3000); ++round) {
            const int y = static_cast<int>(random() % height), x = static_cast<int>(random() % unsigned(width));
            const int count = static_cast<int>(random() % unsigned(width - x + 1));
            const auto at = known.begin() + y * width;
            if (round % 3 == 0) {
                pixels.remove(x, y, count);
                std::fill(at + x, at + x + count, false);
                continue;
            }
            int last = x - 1; // the end of the last run, as runs do not touch
            pixels.add(x, y, count, [&](int from, int some) {
                ++writes;
                REQUIRE((some > 0 && from > last && from + some <= x + count));
                REQUIRE(std::none_of(at + from, at + from + some, [](bool b) { return b; }));
                std::fill(at + from, at + from + some, true);
                last = from + some;
            });
            REQUIRE(std::all_of(at + x, at + x + count, [](bool b) { return b; }));
        }
        CHECK(writes > repeats(100));
    }
}

TEST_CASE("Nothing is known of another image, or of none", "[background_pixels]")
{
    const auto written = [](dfb::detail::BackgroundPixels& pixels) {
        int count = 0;
        pixels.add(10, 1, 100, [&](int, int some) { count += some; });
        return count;
    };
    dfb::detail::BackgroundPixels pixels;
    pixels.newFrame(128, 2, 1);
    CHECK(written(pixels) == 100);
    pixels.newFrame(128, 2, 1);
    CHECK(written(pixels) == 0);
    pixels.newFrame(128, 2, 2); // the background has changed
    CHECK(written(pixels) == 100);
    pixels.newFrame(128, 2, 0); // a message
    CHECK(written(pixels) == 100);
    CHECK(written(pixels) == 100);
    pixels.newFrame(128, 2, 2); // it is not known what the display rank has put there
    CHECK(written(pixels) == 100);
}

TEST_CASE("A finished tile leaves alone what is the background already, and nothing else", "[background_pixels]")
{
    constexpr int width = 70, height = 2;
    const dfb::Region region{0, 0, width, height};
    std::vector<float> color(4 * width * height, 9), depth(width * height, 9);
    dfb::detail::Planes planes;
    planes.at[dfb::detail::Color] = reinterpret_cast<std::byte*>(color.data());
    planes.at[dfb::detail::Depth] = reinterpret_cast<std::byte*>(depth.data());
    const float background[4] = {0.5f, 0, 0, 1};
    const auto* stored = reinterpret_cast<const std::byte*>(background);
    dfb::detail::BackgroundPixels pixels;
    const auto frame = [&](auto&& write) {
        pixels.newFrame(width, height, 1);
        dfb::FinishedTile out(region, dfb::OutputFormat::RGBA32F, planes, width, false, &pixels);
        write(out);
        return out.writtenPixels();
    };
    const auto all = [&](dfb::FinishedTile& out) {
        for (int y = 0; y < height; ++y)
            out.fillPixels(0, y, width, stored);
    };
    CHECK(frame(all) == width * height);
    CHECK((color.back() == 1 && depth.back() == std::numeric_limits<float>::infinity()));
    color.back() = 7; // shows whether it is written
    CHECK(frame(all) == 0);
    CHECK(color.back() == 7);
    const std::vector<double> rgba(4 * width, 0.25);
    const std::vector<float> near(width, 1);
    CHECK(frame([&](dfb::FinishedTile& out) { out.setPixels(60, 1, 10, rgba.data(), near.data()); }) == 10);
    CHECK(frame([&](dfb::FinishedTile& out) { out.setRow(0, rgba.data(), near.data()); }) == width);
    CHECK(frame(all) == width + 10);
    CHECK(std::count(depth.begin(), depth.end(), std::numeric_limits<float>::infinity()) == width * height);
    CHECK((color.back() == 1 && color.front() == 0.5f));
}

} // namespace background_pixels_cases
