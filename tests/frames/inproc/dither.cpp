// Dithered images: right by the reference, and the same bit for bit for any ranks, tile sizes and owners. Ranks are
// threads.
#include "catch.hpp"
#include "random_scene.hpp"

#include <cstddef>
#include <cstdint>
#include <mutex>
#include <string>
#include <vector>

namespace dither_cases {

namespace {

using scene::Loop;
using scene::Picture;
using scene::Scene;

constexpr dfb::OutputFormat formats[] = {dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8};

// The image of the second frame.
template <class TileOp, class PixelOp = dfb::NoPixelOp>
Picture pictureOf(const Scene& s, int ranks, dfb::OutputFormat format, bool dither,
                  const dfb::OwnerMap& owners = dfb::latticeOwner)
{
    Picture result;
    std::mutex mutex;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config = scene::configOf(s, 2);
        config.image.format = format;
        config.image.dither = dither;
        config.image.ownerMap = owners;
        dfb::DistributedFrameBuffer<TileOp, PixelOp, dfb::InprocTransport> fb(communicator, config);
        scene::renderLoop(fb, s, Loop::Declared);
        const auto report = scene::renderLoop(fb, s, Loop::Declared);
        const std::lock_guard<std::mutex> lock(mutex);
        if (fb.isDisplayRank())
            result = Picture(fb.image(), report);
    });
    return result;
}

// Tiles of 12 pixels begin at other places than the dither pattern of 8 pixels.
template <template <int> class TileOp, class PixelOp = dfb::NoPixelOp>
std::vector<Picture> picturesOf(const Scene& s, dfb::OutputFormat format)
{
    std::vector<Picture> all;
    for (const int ranks : {1, 2, 3, 4}) {
        all.push_back(pictureOf<TileOp<12>, PixelOp>(s, ranks, format, true));
        all.push_back(pictureOf<TileOp<12>, PixelOp>(s, ranks, format, true, dfb::hashOwner));
        all.push_back(pictureOf<TileOp<64>, PixelOp>(s, ranks, format, true));
    }
    return all;
}

template <int Size>
using Blend = dfb::BasicAlphaBlend<Size>;

// 9 bricks. Some tiles stay background, none of whose channels is an exact 8-bit level, and whose green equals alpha.
Scene sceneOf(int passes)
{
    Scene s = scene::makeScene(9, 21, 97, 61, passes);
    s.background = {0.125f, 0.35f, 0.3f, 0.35f};
    return s;
}

} // namespace

TEST_CASE("A dithered image is the same from 1 to 4 ranks, for all tile sizes and owners", "[dither]")
{
    for (const auto format : formats)
        for (const int passes : {1, 3}) {
            const Scene s = sceneOf(passes);
            const auto all = picturesOf<Blend>(s, format);
            const Picture rounded = pictureOf<Blend<64>>(s, 1, format, false);
            INFO("format " << static_cast<int>(format) << ", " << passes << " passes");
            for (const Picture& p : all)
                CHECK(p.hash() == all.front().hash());
            CHECK(rounded.hash() != all.front().hash());
            CHECK(all.front().depth == rounded.depth);
        }
}

TEST_CASE("The same after a pixel operation", "[dither]")
{
    for (const auto format : formats) {
        const auto all = picturesOf<Blend, dfb::ToneMap>(sceneOf(1), format);
        for (const Picture& p : all)
            CHECK(p.hash() == all.front().hash());
        CHECK(pictureOf<Blend<64>, dfb::ToneMap>(sceneOf(1), 1, format, false).hash() != all.front().hash());
    }
}

TEST_CASE("Dithered colour is that of the float image, alpha is exact and not exceeded", "[dither]")
{
    for (const auto format : formats)
        for (const int passes : {1, 3}) { // means of 3 have ties that are not binary fractions
            const Scene s = sceneOf(passes);
            const auto exact = scene::referenceOf(s);
            const Picture floats = pictureOf<Blend<12>>(s, 3, dfb::OutputFormat::RGBA32F, false);
            const Picture rounded = pictureOf<Blend<12>>(s, 3, format, false);
            const Picture p = pictureOf<Blend<12>>(s, 3, format, true);
            REQUIRE(p.bytes.size() == 4 * exact.size());
            int wrong = 0, wrongAlpha = 0, aboveAlpha = 0, other = 0;
            for (std::size_t i = 0; i < exact.size(); ++i) {
                const int x = static_cast<int>(i) % s.width, y = static_cast<int>(i) / s.width;
                float rgba[4];
                for (std::size_t c = 0; c < 4; ++c)
                    rgba[c] = floats.value(4 * i + c);
                std::byte expected[4];
                dfb::ditherPixels(rgba, 1, format, x, y, expected);
                const std::byte* got = p.bytes.data() + 4 * i;
                for (std::size_t c = 0; c < 3; ++c) {
                    wrong += got[c] != expected[c];
                    other += got[c] != rounded.bytes[4 * i + c];
                    aboveAlpha += format == dfb::OutputFormat::RGBA8 && rgba[c] <= rgba[3] && got[c] > got[3];
                }
                wrongAlpha += static_cast<std::uint8_t>(got[3]) != dfb::testing::toUnorm8(exact[i].rgba[3]);
            }
            INFO("format " << static_cast<int>(format) << ", " << passes << " passes");
            CHECK(wrong == 0);
            CHECK(wrongAlpha == 0);
            CHECK(aboveAlpha == 0);
            CHECK(other > 1000);
        }
}

TEST_CASE("Float images are not dithered", "[dither]")
{
    const Scene s = sceneOf(1);
    CHECK(pictureOf<Blend<12>>(s, 2, dfb::OutputFormat::RGBA32F, true).hash()
          == pictureOf<Blend<12>>(s, 2, dfb::OutputFormat::RGBA32F, false).hash());
}

TEST_CASE("Ranks must agree whether to dither", "[dither]")
{
    std::vector<std::string> said(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config = scene::configOf(sceneOf(1));
        config.image.dither = communicator.rank() == 1;
        using FrameBuffer = dfb::DistributedFrameBuffer<Blend<12>, dfb::NoPixelOp, dfb::InprocTransport>;
        said[static_cast<std::size_t>(communicator.rank())] =
            scene::outcomeOf([&] { FrameBuffer(communicator, config); });
    });
    for (const std::string& text : said)
        CHECK(scene::has(text, "InvalidArgument: "));
}

} // namespace dither_cases
