// Adversarial images of several ranks, which are threads, in every way in which they can travel: copied, read in place,
// as floats or bytes, in an order, with a codec. They are compared with the reference, and are the same bit for bit.
// Rounded values keep their error bound.
#include "catch.hpp"

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/image_compositor.hpp>
#include <dfb/testing/adversarial.hpp>

#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

namespace {

using dfb::ImageBlend;
using dfb::testing::ErrorReport;
using dfb::testing::Random;

constexpr int ranks = 3, width = 37, height = 21;
constexpr std::size_t pixels = std::size_t{width} * height;

// Of one rank.
struct Pixels {
    std::vector<float> rgba, depth;
    std::vector<std::uint8_t> levels; // those of rgba, if it has some
};

// Half of the seeds: many of an image's pixels are empty, others in each image.
bool hasGaps(std::uint64_t seed) { return seed % 4 >= 2; }

// Colours are any; or levels, from 0 to alpha.
std::vector<Pixels> adversarialImages(std::uint64_t seed, bool hasLevels)
{
    Random random(seed);
    std::vector<Pixels> images(ranks);
    for (Pixels& image : images)
        for (std::size_t i = 0; i < pixels; ++i) {
            const float alpha = dfb::testing::anyAlpha(random);
            std::array<float, 4> rgba{0, 0, 0, alpha};
            for (std::size_t c = 0; c < 3; ++c)
                rgba[c] = dfb::testing::anyColor(random, alpha);
            if (i % 5 == 1 || (hasGaps(seed) && i / (3 + 4 * static_cast<std::size_t>(&image - images.data())) % 3 > 0))
                rgba = {0, 0, 0, 0};
            for (float& value : rgba) {
                if (hasLevels) {
                    const float share = std::clamp(value, 0.0f, &value == &rgba[3] ? 1.0f : rgba[3]);
                    image.levels.push_back(static_cast<std::uint8_t>(255 * share));
                    value = static_cast<float>(image.levels.back() / 255.0);
                }
                image.rgba.push_back(value);
            }
            image.depth.push_back(dfb::testing::anyDepth(random, seed % 8));
        }
    return images;
}

enum class Memory { Copied, Own, Shared };

struct Way {
    std::string name;
    Memory memory = Memory::Copied;
    bool hasBytes = false;
    bool sharesNode = true; // else each rank is taken to be on a node of its own
    std::shared_ptr<const dfb::Codec> codec{};
    dfb::Precision precision{};
};

struct Picture : dfb::testing::TileOutput {
    dfb::FrameReport frame;
};

// The second of two pictures: memory is used again.
Picture pictureOf(const std::vector<Pixels>& images, ImageBlend blend, dfb::OutputFormat format, const Way& way,
                  bool wantsDepth)
{
    Picture picture;
    dfb::runRanks(ranks, [&](const dfb::InprocCommunicator& communicator) {
        dfb::NetworkConfig network;
        network.sharedMemory = way.sharesNode;
        dfb::FrameBufferConfig config(width, height, format);
        config.image.depth = wantsDepth;
        config.precision = way.precision;
        config.messages.codec = way.codec;
        dfb::ImageCompositor compositor(dfb::connect<dfb::InprocTransport>(communicator, network), blend, config);
        const Pixels& mine = images[static_cast<std::size_t>(compositor.rank())];
        const std::size_t depthAt = 16 * pixels;
        std::vector<std::byte> own(20 * pixels);
        dfb::Buffer shared;
        if (way.memory == Memory::Shared)
            shared = compositor.sharedMemory(own.size());
        std::byte* const at = way.memory == Memory::Shared ? shared.data() : own.data();
        if (way.hasBytes)
            std::memcpy(at, mine.levels.data(), 4 * pixels);
        else
            std::memcpy(at, mine.rgba.data(), 16 * pixels);
        std::memcpy(at + depthAt, mine.depth.data(), 4 * pixels);
        dfb::InputImage image;
        if (way.hasBytes)
            image.rgba8 = reinterpret_cast<const std::uint8_t*>(at);
        else
            image.rgba32f = reinterpret_cast<const float*>(at);
        image.staysUntilEnd = way.memory != Memory::Copied;
        if (blend == ImageBlend::ByDepth)
            image.depth = reinterpret_cast<const float*>(at + depthAt);
        dfb::FrameConfig frame;
        frame.background = {0.5f, 0.25f, 1, 1};
        for (int round = 0; round < 2; ++round) {
            compositor.start(image, blend == ImageBlend::InOrder ? ranks - 1 - compositor.rank() : -1, frame);
            const dfb::FrameReport report = compositor.end();
            if (!compositor.isDisplayRank())
                continue;
            const auto* color = reinterpret_cast<const std::byte*>(
                format == dfb::OutputFormat::RGBA32F ? static_cast<const void*>(compositor.image().rgba32f())
                                                     : compositor.image().rgba8());
            picture.color.assign(color, color + bytesPerPixel(format) * pixels);
            if (config.image.depth)
                picture.depth.assign(compositor.image().depth(), compositor.image().depth() + pixels);
            picture.frame = report;
        }
    });
    return picture;
}

std::vector<dfb::testing::Pixel> referenceOf(const std::vector<Pixels>& images, ImageBlend blend)
{
    std::vector<dfb::testing::Pixel> result;
    for (std::size_t i = 0; i < pixels; ++i) {
        std::vector<dfb::testing::Sample> samples;
        for (int rank = 0; rank < ranks; ++rank) {
            const Pixels& image =
                images[static_cast<std::size_t>(blend == ImageBlend::InOrder ? ranks - 1 - rank : rank)];
            dfb::testing::Sample sample;
            std::copy_n(image.rgba.begin() + static_cast<std::ptrdiff_t>(4 * i), 4, sample.rgba.begin());
            sample.depth = image.depth[i];
            sample.source = static_cast<std::uint32_t>(rank);
            samples.push_back(sample);
        }
        const dfb::testing::Color background{0.5f, 0.25f, 1, 1};
        result.push_back(blend == ImageBlend::ByDepth ? dfb::testing::composite(samples, background)
                                                      : dfb::testing::compositeInOrder(samples, background));
    }
    return result;
}

std::vector<Way> exactWays(bool hasLevels)
{
    // Threads as ranks read only their own images in place; frames/in_place.cpp has those of others, over MPI.
    std::vector<Way> ways{
        {"copied"}, {"own read in place", Memory::Own}, {"own read in shared memory", Memory::Shared}};
    Way apart{"ranks on nodes of their own"};
    apart.sharesNode = false;
    ways.push_back(apart);
#if defined(DFB_HAS_SNAPPY)
    apart.name = "Snappy";
    apart.codec = std::make_shared<dfb::SnappyCodec>();
    ways.push_back(apart);
#endif
    if (hasLevels)
        for (std::size_t i = 0, floats = ways.size(); i < floats; ++i) {
            ways.push_back(ways[i]);
            ways.back().name += ", bytes";
            ways.back().hasBytes = true;
        }
    return ways;
}

} // namespace

TEST_CASE("Adversarial images are exact and the same by every way that rounds nothing", "[ways]")
{
    for (std::uint64_t seed = 0; seed < 16; ++seed)
        for (const ImageBlend blend : {ImageBlend::ByDepth, ImageBlend::InOrder}) {
            const bool hasLevels = seed % 2 == 1;
            const auto images = adversarialImages(seed, hasLevels);
            const auto expected = referenceOf(images, blend);
            const bool wantsDepth = blend == ImageBlend::ByDepth && !hasGaps(seed);
            Picture first[2];
            for (const Way& way : exactWays(hasLevels)) {
                INFO("seed " << seed << (blend == ImageBlend::ByDepth ? ", by depth, " : ", in order, ") << way.name);
                const Picture floats = pictureOf(images, blend, dfb::OutputFormat::RGBA32F, way, wantsDepth),
                              levels = pictureOf(images, blend, dfb::OutputFormat::RGBA8, way, wantsDepth);
                if (way.name == "copied") {
                    ErrorReport report;
                    std::size_t wrongDepths = 0;
                    for (std::size_t i = 0; i < pixels; ++i) {
                        for (std::size_t c = 0; c < 4; ++c) {
                            report.add(floats.value(4 * i + c), expected[i].rgba[c]);
                            report.addByte(std::to_integer<std::uint8_t>(levels.color[4 * i + c]),
                                           dfb::testing::toUnorm8(expected[i].rgba[c]));
                        }
                        wrongDepths += wantsDepth && !(floats.depth[i] == expected[i].depth);
                    }
                    INFO(report.text());
                    CHECK(report.ulpsBelow() <= 2);
                    CHECK(report.wrongBytes == 0);
                    CHECK(wrongDepths == 0);
                    first[0] = floats;
                    first[1] = levels;
                }
                CHECK(floats == first[0]);
                CHECK(levels == first[1]);
            }
        }
}

TEST_CASE("Adversarial images between nodes keep the bounds of half a level and of 16 bits", "[ways]")
{
    for (std::uint64_t seed = 0; seed < 16; ++seed)
        for (const ImageBlend blend : {ImageBlend::ByDepth, ImageBlend::InOrder}) {
            auto images = adversarialImages(seed, seed % 2 == 1);
            for (Pixels& image : images) // what is out of range travels as floats
                for (std::size_t i = 0; seed % 4 != 0 && i < 4 * pixels; ++i)
                    image.rgba[i] = std::min(image.rgba[i], image.rgba[i / 4 * 4 + 3]);
            const auto expected = referenceOf(images, blend);
            Way way{"within half a level"};
            way.sharesNode = false;
            way.precision = dfb::HalfLevel{};
            INFO("seed " << seed);
            const bool wantsDepth = blend == ImageBlend::ByDepth;
            const Picture levels = pictureOf(images, blend, dfb::OutputFormat::RGBA8, way, wantsDepth);
            CHECK(levels.frame.wireErrorBound <= 0.5 / 255);
            ErrorReport report;
            for (std::size_t i = 0; i < 4 * pixels; ++i)
                report.addByte(std::to_integer<std::uint8_t>(levels.color[i]),
                               dfb::testing::toUnorm8(expected[i / 4].rgba[i % 4]));
            CHECK(report.maxLevels <= 1);
            way.precision = dfb::WireFormat::Unorm16;
            const Picture floats = pictureOf(images, blend, dfb::OutputFormat::RGBA32F, way, wantsDepth);
            double worst = 0;
            for (std::size_t i = 0; i < 4 * pixels; ++i)
                if (const auto exact = static_cast<double>(expected[i / 4].rgba[i % 4]); std::abs(exact) <= 2)
                    worst = std::max(worst, std::abs(static_cast<double>(floats.value(i)) - exact));
            CHECK(worst <= floats.frame.wireErrorBound + 0x1p-23);
            CHECK((seed % 4 == 0 || worst > 0));
        }
}
