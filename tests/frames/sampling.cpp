// Which rank renders which samples: work distribution, accumulation over frames, adaptive sampling. In one process and
// over MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <atomic>
#include <chrono>
#include <cmath>
#include <functional>
#include <memory>
#include <thread>
#include <type_traits>
#include <utility>

namespace frame_cases {

// A scene of one brick that every rank has and that covers the whole image.
inline scene::Scene wholeScene(int width, int height, int passes)
{
    scene::Scene s = scene::makeScene(1, 11, width, height, passes);
    s.bricks[0].bounds = {{0, 0, 0}, {static_cast<float>(width), static_cast<float>(height), 1}};
    return s;
}

// Renders a tile with its sample number as pass, as the scene knows only passes.
template <class Tile>
void renderSample(const scene::Scene& s, const dfb::Brick& brick, Tile& tile)
{
    const int pass = tile.pass;
    tile.pass = tile.sample;
    renderBrick(s, brick, tile);
    tile.pass = pass;
}

// ---- distributions ---------------------------------------------------------------------------------------------

struct Distributions {
    static Result run(const Transport::Communicator& communicator)
    {
        using dfb::WorkDistribution;
        Result result;
        const scene::Scene s = wholeScene(97, 61, 3);
        dfb::DistributedFrameBuffer<dfb::BasicImageParallel<16>, dfb::NoPixelOp, Transport> fb(communicator,
                                                                                               configOf(s, 2));
        for (const auto distribution : {WorkDistribution::Owned, WorkDistribution::Linear, WorkDistribution::RoundRobin,
                                        WorkDistribution::Dynamic, WorkDistribution::Dynamic}) {
            const std::string name = "distribution " + std::to_string(static_cast<int>(distribution));
            std::atomic<std::int64_t> rendered{0};
            const auto report = dfb::ImageParallelLoop(fb, distribution)
                                    .render(
                                        [&](auto& tile) {
                                            ++rendered;
                                            renderBrick(s, s.bricks[0], tile);
                                        },
                                        paramsOf(s));
            const std::int64_t all = fb.allReduce({rendered.load()}, decltype(fb)::Reduce::Sum).front();
            const std::int64_t most = fb.allReduce({rendered.load()}, decltype(fb)::Reduce::Max).front();
            result.expect(all == 28 * 3, name + ": " + std::to_string(all) + " tiles rendered");
            if (distribution == WorkDistribution::Linear || distribution == WorkDistribution::RoundRobin)
                result.expect(most == (84 + fb.size() - 1) / fb.size(),
                              name + ": " + std::to_string(most) + " on a rank");
            const std::uint64_t hash = checkedHash(result, fb, report, s, name);
            result.expect(result.hash == 0 || result.hash == hash, name + ": another image");
            result.hash = hash;
        }
        return result;
    }
};

// Rank 0 is stuck in its first tile until the others have rendered more than their fair share. They can do so only if
// jobs are handed out on demand. (Over MPI, ranks do not see each other's counts, so no rank is stuck.)
struct Dynamic {
    static Result run(const Transport::Communicator& communicator)
    {
        static std::atomic<int> ofOthers{0};
        Result result;
        const scene::Scene s = wholeScene(160, 160, 2);
        dfb::DistributedFrameBuffer<dfb::BasicImageParallel<16>, dfb::NoPixelOp, Transport> fb(communicator,
                                                                                               configOf(s, 1));
        const int jobs = fb.layout().tileCount() * s.passes, fairShare = jobs - jobs / fb.size();
        const bool isStuck = fb.rank() == 0 && fb.size() > 1 && communicator.isInProcess;
        ofOthers = 0;
        fb.allReduce({0}, decltype(fb)::Reduce::Sum); // so that no rank counts earlier
        std::atomic<std::int64_t> rendered{0};
        const auto report =
            dfb::ImageParallelLoop(fb, dfb::WorkDistribution::Dynamic)
                .render(
                    [&](auto& tile) {
                        const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(20);
                        while (isStuck && ofOthers <= fairShare && std::chrono::steady_clock::now() < limit)
                            std::this_thread::yield();
                        ++rendered;
                        ofOthers += fb.rank() != 0;
                        renderBrick(s, s.bricks[0], tile);
                    },
                    paramsOf(s));
        const auto all = fb.allReduce({rendered.load()}, decltype(fb)::Reduce::Sum).front();
        result.expect(all == jobs, std::to_string(all) + " tiles rendered of " + std::to_string(jobs));
        result.expect(!isStuck || rendered < jobs / fb.size(), std::to_string(rendered) + " tiles on the slow rank");
        if (fb.isDisplayRank())
            result.hash = scene::Picture(fb.image(), report).hash();
        return result;
    }
};

// ---- accumulation ----------------------------------------------------------------------------------------------

// Frames of 3, 1 and 5 samples, some of which come later in some tiles, give the same image as one frame of 9 samples.
struct Accumulation {
    template <class Op>
    static void accumulate(const Transport::Communicator& communicator, Result& result, bool isData)
    {
        scene::Scene s = isData ? scene::makeScene(6, 4, 61, 47, 9) : wholeScene(61, 47, 9);
        auto config = configOf(s, 2);
        dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport> fb(communicator, config);
        const int tiles = fb.layout().tileCount();
        const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
        std::uint64_t id = 0;
        for (int run = 0; run < 2; ++run) { // the second time, accumulation begins again
            s.seed += static_cast<std::uint64_t>(run);
            ++id;
            std::vector<int> taken(static_cast<std::size_t>(tiles), 0);
            dfb::FrameReport report;
            dfb::DataParallelLoop dataLoop(fb, world);
            dfb::ImageParallelLoop imageLoop(fb, dfb::WorkDistribution::RoundRobin);
            for (const int wanted : {3, 4, 9}) {
                auto plan = std::make_shared<std::vector<dfb::TileSamples>>();
                for (int t = 0; t < tiles; ++t) {
                    int& had = taken[static_cast<std::size_t>(t)];
                    const int target = wanted == 4 && t % 3 == 0 ? 3 : wanted; // some get none in frame 2
                    plan->push_back({had, target - had});
                    had = target;
                }
                dfb::FrameConfig params = paramsOf(s);
                params.passes = 1;
                params.samples = plan;
                params.accumulationId = id;
                if (isData)
                    report = dataLoop.render(
                        scene::FlatCamera(), [&](const dfb::Brick& b, auto& tile) { renderSample(s, b, tile); },
                        params);
                else
                    report = imageLoop.render([&](auto& tile) { renderSample(s, s.bricks[0], tile); }, params);
                if (wanted == 4)
                    result.expect(report.tilesTouched <= tiles - (tiles + 2) / 3,
                                  std::to_string(report.tilesTouched) + " tiles touched");
            }
            result.hash = result.hash * 31 + checkedHash(result, fb, report, s, "run " + std::to_string(run));
        }
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        accumulate<dfb::Progressive<dfb::BasicImageParallel<16>>>(communicator, result, false);
        accumulate<dfb::Progressive<dfb::BasicAlphaBlend<16>>>(communicator, result, true);
        return result;
    }
};

// If one rank accumulates on while the others begin again, all ranks get an error; then all can begin again.
struct Reset {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = wholeScene(61, 47, 4);
        dfb::DistributedFrameBuffer<dfb::Progressive<dfb::BasicImageParallel<16>>, dfb::NoPixelOp, Transport> fb(
            communicator, configOf(s, 1));
        // The first frame has nothing to go on with, whatever its accumulationId.
        dfb::FrameConfig first = paramsOf(s);
        for (const int id : {0, 1}) {
            first.accumulationId = static_cast<std::uint64_t>(id);
            first.samples = std::make_shared<const std::vector<dfb::TileSamples>>(
                static_cast<std::size_t>(fb.layout().tileCount()), dfb::TileSamples{0, 0});
            const std::string outcome = scene::outcomeOf([&] { fb.begin(first).end(); });
            result.expect(scene::has(outcome, "give each tile samples, from 0 on"), "begins with nothing: " + outcome);
        }
        dfb::AdaptiveSampler sampler(fb.layout(), {0, 2, 4, 2});
        dfb::ImageParallelLoop loop(fb);
        dfb::FrameReport report;
        const auto render = [&] {
            report = loop.render([&](auto& tile) { renderSample(s, s.bricks[0], tile); }, sampler.next(paramsOf(s)));
            sampler.update(report);
        };
        render();
        if (fb.rank() == 0)
            sampler.reset();
        const std::string outcome = scene::outcomeOf(render);
        if (fb.size() > 1) {
            result.expect(scene::has(outcome, "FrameConfig::samples"), "the rank was not found: " + outcome);
            if (fb.rank() != 0) {
                const std::string goingOn = scene::outcomeOf(render);
                result.expect(scene::has(goingOn, "give each tile samples, from 0 on"), "goes on after a failure: " + goingOn);
                sampler.reset();
            }
            sampler.reset();
        }
        while (!sampler.done())
            render();
        if (fb.isDisplayRank()) {
            const scene::Picture picture(fb.image(), report);
            result.expect(wrongValues(picture, referenceOf(s)) == 0, "values after the reset");
            result.hash = picture.hash();
        }
        return result;
    }
};

// ---- adaptive sampling -----------------------------------------------------------------------------------------

// A scene in which each sample is lit or dark, with a probability for each pixel.
struct NoisyScene {
    int width = 128, height = 128;
    std::function<double(int x, int y)> probability;

    template <class Tile>
    void render(Tile& tile) const
    {
        tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
            const std::uint64_t h =
                scene::mix(scene::mix(static_cast<std::uint64_t>(y) * 65536 + static_cast<std::uint64_t>(x))
                           + static_cast<std::uint64_t>(tile.sample));
            const bool lit = static_cast<double>(h >> 11) * 0x1p-53 < probability(x, y);
            rgba[0] = rgba[1] = rgba[2] = lit ? 1.0f : 0.0f;
            rgba[3] = 1;
            depth = 1;
        });
    }

    // Root mean square error of colour and alpha in a region, against the expected value.
    double error(const dfb::Image& image, const dfb::Region& region) const
    {
        double sum = 0;
        for (int y = region.y0; y < region.y1; ++y)
            for (int x = region.x0; x < region.x1; ++x)
                for (int c = 0; c < 3; ++c) {
                    const std::size_t i =
                        static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
                    const double off =
                        static_cast<double>(image.rgba32f()[4 * i + static_cast<std::size_t>(c)]) - probability(x, y);
                    sum += off * off;
                }
        return std::sqrt(sum / (4.0 * region.width() * region.height()));
    }
};

using NoisyFrameBuffer =
    dfb::DistributedFrameBuffer<dfb::Progressive<dfb::BasicImageParallel<16>>, dfb::NoPixelOp, Transport>;

inline dfb::FrameBufferConfig configOf(const NoisyScene& s)
{
    dfb::FrameBufferConfig config;
    config.image.width = s.width;
    config.image.height = s.height;
    config.image.format = dfb::OutputFormat::RGBA32F;
    config.executor = std::make_shared<dfb::ThreadExecutor>(1);
    return config;
}

// A noisy disc in front of a flat background: adaptive sampling is as accurate as uniform sampling, with fewer samples.
struct Adaptive {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        NoisyScene s;
        s.probability = [](int x, int y) {
            const double r = std::hypot(x - 63.5, y - 63.5);
            return r < 30 ? 0.2 + 0.02 * r : 1.0;
        };
        const dfb::Region all{0, 0, s.width, s.height};
        NoisyFrameBuffer fb(communicator, configOf(s));
        std::atomic<std::int64_t> rendered{0};
        dfb::AdaptiveSampler sampler(fb.layout(), {0.03, 8, 512, 64});
        dfb::ImageParallelLoop inTurn(fb, dfb::WorkDistribution::RoundRobin);
        while (!sampler.done())
            sampler.update(inTurn.render(
                [&](auto& tile) {
                    ++rendered;
                    s.render(tile);
                },
                sampler.next()));
        const double error = fb.isDisplayRank() ? s.error(fb.image(), all) : 0;
        // All that was rendered was in the sampler's plans.
        const std::int64_t tiles = fb.allReduce({rendered.load()}, NoisyFrameBuffer::Reduce::Sum).front();
        result.expect(tiles * 256 == sampler.samplesTaken(), "tiles were rendered for nothing");
        result.expect(sampler.samplesTaken() + sampler.samplesSaved()
                          == static_cast<std::int64_t>(s.width) * s.height * sampler.next().samples->at(27).first,
                      "samples saved");
        if (fb.isDisplayRank())
            result.hash = dfb::testing::hashOf(fb.image().rgba32f(), 16 * fb.image().pixelCount());

        dfb::ImageParallelLoop owned(fb);
        dfb::AdaptiveSampler uniform(fb.layout(), {0, 8, 256, 8});
        std::int64_t needed = 0;
        while (!uniform.done()) {
            uniform.update(owned.render([&](auto& tile) { s.render(tile); }, uniform.next()));
            const bool enough = fb.isDisplayRank() && s.error(fb.image(), all) <= error;
            if (fb.allReduce({enough}, NoisyFrameBuffer::Reduce::Max).front() != 0) {
                needed = uniform.samplesTaken();
                break;
            }
        }
        result.expect(needed > 0 && 10 * sampler.samplesTaken() <= 4 * needed,
                      std::to_string(sampler.samplesTaken()) + " samples where uniform sampling needs "
                          + std::to_string(needed));
        return result;
    }
};

// A dark scene: each tile has one bright corner of 4x4 pixels, which few samples hit. No tile is given up too early.
struct DarkCorners {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        NoisyScene s;
        s.probability = [](int x, int y) { return x % 16 >= 12 && y % 16 >= 12 ? 0.1 : 0.0; };
        NoisyFrameBuffer fb(communicator, configOf(s));
        dfb::ImageParallelLoop loop(fb);
        const double maxError = 0.015;
        dfb::AdaptiveSampler sampler(fb.layout(), {maxError, 8, 4096, 64});
        while (!sampler.done())
            sampler.update(loop.render([&](auto& tile) { s.render(tile); }, sampler.next()));
        if (!fb.isDisplayRank())
            return result;
        result.hash = dfb::testing::hashOf(fb.image().rgba32f(), 16 * fb.image().pixelCount());
        for (int tile = 0; tile < fb.layout().tileCount(); ++tile) {
            const dfb::Region r = fb.layout().region(tile);
            // The promised error holds for the block of 8x8 pixels with the corner.
            const double error = s.error(fb.image(), {r.x0 + 8, r.y0 + 8, r.x1, r.y1});
            result.expect(error <= 1.6 * maxError,
                          "tile " + std::to_string(tile) + " is off by " + std::to_string(error) + " after "
                              + std::to_string(sampler.next().samples->at(static_cast<std::size_t>(tile)).first));
        }
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("However the work is distributed, the image is the same and nothing is rendered twice", "[sampling]")
{
    everywhere<frame_cases::Distributions>();
}

TEST_CASE("Work that is handed out on demand goes to those who have time", "[sampling]")
{
    everywhere<frame_cases::Dynamic>();
}

TEST_CASE("Samples of several frames accumulate to the reference image", "[sampling]")
{
    everywhere<frame_cases::Accumulation>();
}

TEST_CASE("A reset reaches all ranks or is an error on all", "[sampling]") { everywhere<frame_cases::Reset>(); }

TEST_CASE("Adaptive sampling needs less than half the samples for the same error", "[sampling]")
{
    everywhere<frame_cases::Adaptive>();
}

TEST_CASE("Adaptive sampling does not lose bright corners of dark tiles", "[sampling]")
{
    everywhere<frame_cases::DarkCorners>();
}
