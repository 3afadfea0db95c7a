// Display walls: each display shows what the single image has in its place. In one process and over MPI
// (everywhere.hpp).

#include "everywhere.hpp"

#include <algorithm>
#include <chrono>
#include <cstring>
#include <exception>
#include <memory>
#include <stdexcept>
#include <utility>

namespace frame_cases {

template <class TileOp, class PixelOp>
using FrameBufferOf = dfb::DistributedFrameBuffer<TileOp, PixelOp, Transport>;

struct Wall {
    template <class TileOp, class Render>
    static void check(const std::shared_ptr<dfb::Connection>& connection, const dfb::WallLayout& layout,
                      dfb::OutputFormat format, Result& result, const std::string& name, const Render& render)
    {
        auto executor = std::make_shared<dfb::ThreadExecutor>(2);
        dfb::DisplayWall wall(connection, layout, format, executor);
        dfb::FrameBufferConfig config = wall.frameBufferConfig();
        config.executor = executor;
        FrameBufferOf<TileOp, dfb::ToWall> toWall(connection, config, {&wall});
        config.image.format = format;
        FrameBufferOf<TileOp, dfb::NoPixelOp> single(connection, config);
        result.expect(wall.imageFrame() == -1, name + ": a frame before the first");
        for (int d = 0; d < layout.displayCount(); ++d)
            if (layout.ranks[static_cast<std::size_t>(d)] == single.rank())
                result.expect(wall.image(d).empty(), name + ": an image before the first");
        for (int frame = 0; frame < 3; ++frame) {
            const std::int64_t number = render(toWall, frame).frame;
            wall.finish(number);
            result.expect(wall.imageFrame() == number && toWall.imageFrame() == -1, name + ": another frame");
            render(single, frame);
            result.expect(toWall.image().empty(), name + ": an image where there is to be none");
            // Rank 0 has the single image, and sends it to all ranks to compare.
            std::vector<std::byte> pixels;
            if (single.isDisplayRank())
                pixels.assign(single.image().bytes(),
                              single.image().bytes() + single.image().pixelCount() * dfb::bytesPerPixel(format));
            pixels = single.allGather(pixels).front();
            for (int d = 0; d < layout.displayCount(); ++d) {
                if (layout.ranks[static_cast<std::size_t>(d)] != single.rank())
                    continue;
                const dfb::Region region = layout.region(d);
                const std::size_t pixelBytes = dfb::bytesPerPixel(format);
                int wrongRows = 0;
                for (int y = 0; y < layout.displayHeight; ++y) {
                    const std::size_t bytes = pixelBytes * static_cast<std::size_t>(layout.displayWidth);
                    const std::size_t first =
                        pixelBytes
                        * (static_cast<std::size_t>(region.y0 + y) * static_cast<std::size_t>(layout.width())
                           + static_cast<std::size_t>(region.x0));
                    wrongRows += std::memcmp(wall.image(d).bytes() + static_cast<std::size_t>(y) * bytes,
                                             pixels.data() + first, bytes)
                                 != 0;
                }
                result.expect(wrongRows == 0, name + ": display " + std::to_string(d) + " has "
                                                  + std::to_string(wrongRows) + " wrong rows in frame "
                                                  + std::to_string(frame));
            }
            if (single.isDisplayRank())
                result.hash = result.hash * 31 + dfb::testing::hashOf(pixels.data(), pixels.size());
        }
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        const int size = connection->size();
        const auto dealt = [size](dfb::WallLayout layout, int first) {
            for (int d = 0; d < layout.displayCount(); ++d)
                layout.ranks.push_back((d + first) % size);
            return layout;
        };
        const auto paramsOfFrame = [](int frame) {
            dfb::FrameConfig params;
            params.background = {0.25f * static_cast<float>(frame), 0.5f, 0, 1}; // tiles without bricks change as well
            return params;
        };
        const auto data = [&](auto& fb, int frame) {
            const scene::Scene s = scene::makeScene(3, static_cast<std::uint64_t>(frame + 4), fb.config().image.width,
                                                    fb.config().image.height);
            return dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
                .render(
                    scene::FlatCamera(), [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); },
                    paramsOfFrame(frame));
        };
        const auto image = [&](auto& fb, int frame) {
            const scene::Scene s = scene::makeScene(1, static_cast<std::uint64_t>(frame + 2), fb.config().image.width,
                                                    fb.config().image.height);
            return dfb::ImageParallelLoop(fb, dfb::WorkDistribution::RoundRobin)
                .render([&](auto& tile) { renderBrick(s, s.bricks[0], tile); }, paramsOfFrame(frame));
        };
        check<dfb::BasicAlphaBlend<16>>(connection, dealt({2, 2, 40, 30, 0, 0, {}}, 0), dfb::OutputFormat::RGBA32F,
                                        result, "2x2", data);
        check<dfb::BasicImageParallel<32>>(connection, dealt({3, 1, 25, 41, 7, 0, {}}, 1), dfb::OutputFormat::SRGBA8,
                                           result, "3x1 with bezels", image);
        check<dfb::BasicAlphaBlend<16>>(connection, dealt({1, 5, 61, 9, 0, 40, {}}, 2), dfb::OutputFormat::RGBA8,
                                        result, "1x5 with wide bezels", data);
        dfb::WallLayout wrong = dealt({2, 2, 8, 8, 0, 0, {}}, 0);
        wrong.ranks[3] = size;
        const std::string outcome =
            scene::outcomeOf([&] { dfb::DisplayWall(connection, wrong, dfb::OutputFormat::RGBA8); });
        result.expect(scene::has(outcome, "is driven by rank"), outcome);
        const std::string huge = scene::outcomeOf([&] {
            dfb::DisplayWall(connection, {65536, 65536, 64, 64, 0, 0, {}}, dfb::OutputFormat::RGBA8);
        });
        result.expect(scene::has(huge, "InvalidArgument") && scene::has(huge, "cannot be"), "a huge wall: " + huge);
        return result;
    }
};

// A tile that converged long ago still appears on the wall, and a frame that failed leaves nothing there.
struct WallProgressive {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        dfb::WallLayout layout{2, 1, 40, 50, 3, 0, {0, connection->size() - 1}};
        auto executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::RGBA32F, executor);
        auto config = wall.frameBufferConfig();
        config.executor = executor;
        using Op = dfb::Progressive<dfb::BasicImageParallel<16>>;
        FrameBufferOf<Op, dfb::PixelOpChain<dfb::ToneMap, dfb::ToWall>> fb(connection, config,
                                                                           {dfb::ToneMap{}, dfb::ToWall{&wall}});
        dfb::AdaptiveSampler sampler(fb.layout(), {0.05, 2, 16, 4});
        dfb::ImageParallelLoop loop(fb);
        const auto render = [&](bool fails) {
            // Noise on the left, which takes many samples; no noise on the right.
            const auto report = loop.render(
                [&](auto& tile) {
                    tile.forEachPixel([&](int x, int y, float* rgba, float&) {
                        const bool lit =
                            scene::mix(static_cast<std::uint64_t>(tile.sample * 1000003 + y * 1009 + x)) % 2 != 0;
                        rgba[1] = x >= 43 ? 0.5f : lit ? 1.0f : 0.0f;
                        rgba[3] = 1;
                    });
                    if (fails && tile.tile == 7)
                        throw std::runtime_error("on purpose");
                },
                sampler.next());
            sampler.update(report);
            wall.finish(report.frame, std::chrono::seconds(20));
        };
        render(false);
        const auto pixels = [&] {
            std::vector<std::byte> all;
            for (int d = 0; d < 2; ++d)
                if (layout.ranks[static_cast<std::size_t>(d)] == fb.rank())
                    all.insert(all.end(), wall.image(d).bytes(),
                               wall.image(d).bytes() + wall.image(d).pixelCount() * 16);
            return all;
        };
        const std::vector<std::byte> before = pixels();
        result.expect(scene::has(scene::outcomeOf([&] { render(true); }), "on purpose"), "the frame did not fail");
        result.expect(wall.imageFrame() == 1 && pixels() == before, "a frame that failed is on the wall");
        sampler.reset();
        while (!sampler.done())
            render(false);
        result.expect(sampler.samplesSaved() > 0, "nothing was saved");
        for (int d = 0; d < 2; ++d)
            if (layout.ranks[static_cast<std::size_t>(d)] == fb.rank()) {
                int wrong = 0;
                for (std::size_t i = 0; i < wall.image(d).pixelCount(); ++i) {
                    const float green = wall.image(d).rgba32f()[4 * i + 1];
                    wrong += d == 1 ? std::fabs(green - 0.5f / 1.5f) > 1e-6f : green < 0.03f || green > 0.4999f;
                }
                result.expect(wrong == 0, std::to_string(wrong) + " wrong pixels on display " + std::to_string(d));
            }
        return result;
    }
};

// The wall goes on after frames that are not finish()ed. Those that are come once each, in order.
struct WallSkips {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        dfb::DisplayWall wall(connection, {1, 1, 40, 50, 0, 0, {0}}, dfb::OutputFormat::RGBA32F,
                              std::make_shared<dfb::ThreadExecutor>(1));
        auto config = wall.frameBufferConfig();
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        config.image.ownerMap = [](int, const dfb::TileLayout&, int ranks) { return ranks - 1; };
        FrameBufferOf<dfb::BasicImageParallel<16>, dfb::ToWall> fb(connection, config, {&wall});
        const auto reason = std::make_exception_ptr(std::runtime_error("a camera"));
        const auto show = [&](float shade) {
            dfb::FrameConfig params;
            params.background = {shade, shade, shade, 1};
            return dfb::ImageParallelLoop(fb).render([](auto&) {}, params).frame;
        };
        enum { Cancelled, NotBegunWell, NotFinished };
        for (const int how : {Cancelled, NotBegunWell, NotFinished}) {
            for (int i = 0; i < 20; ++i) {
                if (how == NotFinished) {
                    show(0.125f);
                    continue;
                }
                auto frame = fb.begin({}, {}, {}, how == NotBegunWell ? reason : nullptr);
                if (how == Cancelled)
                    frame.cancel();
                scene::outcomeOf([&] { frame.end(); });
            }
            const float shade = 0.25f * static_cast<float>(how + 1);
            const std::int64_t number = show(shade);
            const std::string outcome = scene::outcomeOf([&] { wall.finish(number); });
            result.expect(outcome == "fine", "after 20 frames: " + outcome);
            for (const std::int64_t old : {number, number - 1}) {
                const std::string again = scene::outcomeOf([&] { wall.finish(old, std::chrono::seconds(5)); });
                result.expect(scene::has(again, "InvalidArgument"), "finished again: " + again);
            }
            result.expect(wall.imageFrame() == number, "another frame");
            for (std::size_t i = 0; fb.rank() == 0 && i < wall.image(0).pixelCount(); ++i)
                result.expect(wall.image(0).rgba32f()[4 * i] == shade, "a wrong pixel");
        }
        const std::string none = scene::outcomeOf([&] { wall.image(fb.rank() == 0 ? 1 : 0); });
        result.expect(scene::has(none, "is not driven by this rank"), "a display of another rank: " + none);
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("Each display of a wall shows what the single image has there", "[wall]") { everywhere<frame_cases::Wall>(); }

TEST_CASE("A wall shows the frame after many that it did not, and none twice", "[wall]")
{
    everywhere<frame_cases::WallSkips>();
}

TEST_CASE("A wall shows converged tiles and survives a frame that fails", "[wall]")
{
    everywhere<frame_cases::WallProgressive>();
}
