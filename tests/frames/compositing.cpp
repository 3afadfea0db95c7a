// Operations on layers: auxiliary channels, blending in a given order, the nearest input. In one process and over MPI
// (everywhere.hpp).

#include "aux.hpp"
#include "everywhere.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <tuple>
#include <utility>

namespace frame_cases {

using dfb::testing::Exact;

struct AuxChannels {
    static Result run(const Transport::Communicator& communicator)
    {
        using Op = dfb::BasicAlphaBlend<16, dfb::allChannels & ~dfb::farChannel>;
        Result result;
        for (const int passes : {1, 3}) {
            const scene::Scene s = scene::makeScene(7, 5, 61, 47, passes);
            auto config = configOf(s, 2);
            config.image.aux = dfb::imageAuxChannels;
            dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport> fb(communicator, config);
            const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
            dfb::DataParallelLoop loop(fb, world);
            for (int frame = 0; frame < 2; ++frame) {
                const auto report = loop.render(
                    scene::FlatCamera(), [&](const dfb::Brick& b, auto& tile) { renderWithAux(s, b, tile); },
                    paramsOf(s));
                if (!fb.isDisplayRank())
                    continue;
                const scene::Picture picture(fb.image(), report);
                result.expect(wrongValues(picture, referenceOf(s)) == 0, "colour or depth");
                const std::size_t wrong = wrongAux(s, fb.image());
                result.expect(wrong == 0, std::to_string(wrong) + " values of auxiliary channels");
                result.hash = result.hash * 31 + hashAux(fb.image());
            }
        }
        return result;
    }
};

// One brick that all ranks have, whose auxiliary channels a pixel operation sees.
struct AuxImageParallel {
    struct SeeAux {
        std::atomic<std::int64_t>* pixels = nullptr;
        void process(dfb::PixelTile& tile) const
        {
            for (std::size_t i = 0; i < tile.pixelCount(); ++i)
                *pixels += tile.aux.instanceId[i] != dfb::noId && tile.aux.normal != nullptr;
        }
    };

    static Result run(const Transport::Communicator& communicator)
    {
        using Op = dfb::BasicImageParallel<16, dfb::allChannels & ~dfb::farChannel>;
        Result result;
        scene::Scene s = scene::makeScene(1, 3, 61, 47, 2);
        s.bricks[0].bounds = {{0, 0, 0}, {61, 47, 1}};
        auto config = configOf(s, 2);
        config.image.aux = dfb::imageAuxChannels;
        std::atomic<std::int64_t> seen{0};
        dfb::DistributedFrameBuffer<Op, SeeAux, Transport> fb(communicator, config, {&seen});
        dfb::ImageParallelLoop(fb).render([&](auto& tile) { renderWithAux(s, s.bricks[0], tile); }, paramsOf(s));
        const std::int64_t all = fb.allReduce({seen.load()}, decltype(fb)::Reduce::Sum).front();
        if (fb.isDisplayRank()) {
            const std::size_t wrong = wrongAux(s, fb.image());
            result.expect(wrong == 0, std::to_string(wrong) + " values of auxiliary channels");
            std::int64_t withId = 0;
            for (std::size_t i = 0; i < fb.image().pixelCount(); ++i)
                withId += fb.image().instanceId()[i] != dfb::noId;
            result.expect(all == withId && all > 1000, "the pixel operation saw " + std::to_string(all) + " pixels");
            result.hash = hashAux(fb.image());
        }
        return result;
    }
};

// ---- the nearest -----------------------------------------------------------------------------------------------

struct Nearest {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(8, 9, 97, 61, 2);
        dfb::DistributedFrameBuffer<dfb::BasicDepthComposite<16>, dfb::NoPixelOp, Transport> fb(communicator,
                                                                                                configOf(s, 2));
        const auto report = dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size(), 3)))
                                .render(
                                    scene::FlatCamera(),
                                    [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); }, paramsOf(s));
        if (!fb.isDisplayRank())
            return result;
        std::vector<dfb::testing::Pixel> expected;
        for (int y = 0; y < s.height; ++y)
            for (int x = 0; x < s.width; ++x) {
                std::vector<dfb::testing::Pixel> passes;
                for (int pass = 0; pass < s.passes; ++pass) {
                    std::vector<dfb::testing::Sample> samples;
                    for (const dfb::Brick& brick : s.bricks)
                        if (const auto sample = sampleOf(s, brick, pass, x, y))
                            samples.push_back(*sample);
                    passes.push_back(dfb::testing::nearest(samples, s.background));
                }
                expected.push_back(dfb::testing::mean(passes));
            }
        const scene::Picture picture(fb.image(), report);
        const std::size_t wrong = wrongValues(picture, expected);
        result.expect(wrong == 0, std::to_string(wrong) + " values");
        result.hash = picture.hash();
        return result;
    }
};

// ---- a pixel with a depth counts, whatever its colour -----------------------------------------------------------

// A surface of black pixels, some with alpha 0, in front of a white one. Its primitive id is 0, and it has no instance
// id. In some tiles it covers all pixels, with equal or different values, in others spans or single pixels. Where it is
// absent, pixels have a renderer's clear colour and infinite depth.
struct BlackInFront {
    static constexpr int width = 90, height = 40;
    static constexpr std::uint32_t front = 20, back = 30;
    using Op = dfb::BasicDepthComposite<16, dfb::allChannels & ~dfb::farChannel>;

    struct Pixel {
        std::array<float, 4> rgba{};
        float depth = std::numeric_limits<float>::infinity();
        std::array<float, 3> normal{}, position{};
        std::uint32_t primitive = dfb::noId, instance = dfb::noId;
    };

    static Pixel pixelOf(std::uint32_t brick, int x, int y)
    {
        Pixel p;
        const bool alike = y / 16 % 2 == 0;
        if (brick == back) {
            if (x % 5 != 4)
                p = {{1, 1, 1, 1}, 2, {0, 0, 1}, {2, 0, 0}, 7, 8};
            return p;
        }
        const bool covers[] = {false, true, x % 7 < 3, (x + y) % 2 == 0, true, x % 16 > 1};
        if (!covers[x / 16]) {
            p.rgba = {0.5f, 0.5f, 0.5f, 1};
            return p;
        }
        p.rgba[3] = alike || y % 3 == 0 ? 0.0f : 1.0f;
        p.depth = 1;
        p.normal[0] = p.rgba[3];
        p.position = {1, alike ? 0.0f : static_cast<float>(x), 0};
        p.primitive = 0;
        return p;
    }

    // The channels of one brick, each as large as the image.
    struct Planes {
        std::vector<float> color, depth, normal, albedo, position;
        std::vector<std::uint32_t> primitive, instance;

        explicit Planes(std::uint32_t brick)
        {
            for (int y = 0; y < height; ++y)
                for (int x = 0; x < width; ++x) {
                    const Pixel p = pixelOf(brick, x, y);
                    color.insert(color.end(), p.rgba.begin(), p.rgba.end());
                    depth.push_back(p.depth);
                    normal.insert(normal.end(), p.normal.begin(), p.normal.end());
                    position.insert(position.end(), p.position.begin(), p.position.end());
                    primitive.push_back(p.primitive);
                    instance.push_back(p.instance);
                }
            albedo.resize(normal.size());
        }
    };

    static std::size_t wrongValues(const dfb::Image& image, const std::array<float, 4>& background)
    {
        std::size_t wrong = 0;
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                Pixel p = pixelOf(front, x, y);
                if (!std::isfinite(p.depth))
                    p = pixelOf(back, x, y);
                const auto i = static_cast<std::size_t>(y * width + x);
                for (std::size_t c = 0; c < 4; ++c)
                    wrong += image.rgba32f()[4 * i + c] != p.rgba[c] + (1 - p.rgba[3]) * background[c];
                wrong += image.depth()[i] != p.depth;
                for (std::size_t c = 0; c < 3; ++c) {
                    wrong += image.normal()[3 * i + c] != p.normal[c];
                    wrong += image.position()[3 * i + c] != p.position[c];
                }
                wrong += image.primitiveId()[i] != p.primitive;
                wrong += image.instanceId()[i] != p.instance;
            }
        return wrong;
    }

    template <class TileOp, class RenderBrick>
    static void frame(const std::shared_ptr<dfb::Connection>& connection, dfb::WireFormat format,
                      const RenderBrick& renderBrick, Result& result)
    {
        scene::Scene s;
        s.width = width, s.height = height;
        for (const std::uint32_t id : {front, back})
            s.bricks.push_back({id, {{0, 0, 0}, {width, height, 1}}});
        auto config = configOf(s, 1);
        config.precision = format;
        config.image.aux = dfb::imageAuxChannels;
        dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, Transport> fb(connection, config);
        dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
            .render(scene::FlatCamera(), renderBrick, paramsOf(s));
        if (!fb.isDisplayRank())
            return;
        const std::size_t wrong = wrongValues(fb.image(), s.background);
        result.expect(wrong == 0, std::string(nameOf(format)) + ": " + std::to_string(wrong) + " values");
        result.hash = result.hash * 31 + hashAux(fb.image());
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        const auto render = [](const dfb::Brick& b, auto& tile) {
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                const Pixel p = pixelOf(b.id, x, y);
                const int i = (y - tile.region.y0) * 16 + x - tile.region.x0;
                std::copy(p.rgba.begin(), p.rgba.end(), rgba);
                depth = p.depth;
                std::copy(p.normal.begin(), p.normal.end(), tile.normal + 3 * i);
                std::copy(p.position.begin(), p.position.end(), tile.position + 3 * i);
                tile.primitiveId[i] = p.primitive;
                tile.instanceId[i] = p.instance;
            });
        };
        const Planes planes[] = {Planes(front), Planes(back)};
        const auto find = dfb::inPlace([&](const dfb::Brick& b, auto& view) {
            const Planes& from = planes[b.id == back];
            const auto at = static_cast<std::size_t>(view.region.y0 * width + view.region.x0);
            view.stride = width;
            view.color = &from.color[4 * at], view.depth = &from.depth[at];
            view.normal = &from.normal[3 * at], view.albedo = &from.albedo[3 * at];
            view.position = &from.position[3 * at];
            view.primitiveId = &from.primitive[at], view.instanceId = &from.instance[at];
        });
        for (const auto format :
             {dfb::WireFormat::Float32, dfb::WireFormat::Float16, dfb::WireFormat::Unorm16, dfb::WireFormat::Unorm8}) {
            frame<Op>(connection, format, render, result);
            frame<Op>(connection, format, find, result);
            frame<dfb::Progressive<Op>>(connection, format, render, result);
        }
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("Auxiliary channels come out by their rules, composited", "[compositing]")
{
    everywhere<frame_cases::AuxChannels>();
}

TEST_CASE("Auxiliary channels come out by their rules, image-parallel, and pixel operations see them", "[compositing]")
{
    everywhere<frame_cases::AuxImageParallel>();
}

TEST_CASE("DepthComposite keeps the nearest input of each pixel", "[compositing]")
{
    everywhere<frame_cases::Nearest>();
}

TEST_CASE("DepthComposite takes what has a depth, black or without an id as well", "[compositing]")
{
    everywhere<frame_cases::BlackInFront>();
}
