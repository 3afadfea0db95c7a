// Samples that accumulate over frames without a plan: "so many more until the camera moves". In one process and over
// MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <numeric>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

namespace frame_cases {

namespace accumulation {

enum class Loop { ImageOwned, ImageRoundRobin, ImageDynamic, Data, Mixed, Deep, Ordered, Declared, ByHand };

inline bool isImageParallel(Loop loop)
{
    return loop == Loop::ImageOwned || loop == Loop::ImageRoundRobin || loop == Loop::ImageDynamic;
}

// Renders one frame. The pixels depend on tile.sample. With `fails`, every rank that renders something throws.
template <class FrameBuffer>
dfb::FrameReport render(FrameBuffer& fb, Loop loop, const scene::Scene& s, const dfb::World& world,
                        const dfb::SharedWorld& shared, dfb::FrameConfig params, bool fails = false)
{
    using Tile = typename FrameBuffer::Tile;
    const auto renderBrick = [&](const dfb::Brick& b, auto& tile) {
        if (fails)
            throw std::runtime_error("on purpose");
        const int pass = tile.pass;
        tile.pass = tile.sample; // the scene knows only passes
        scene::renderBrick(s, b, tile);
        tile.pass = pass;
    };
    const auto renderFirst = [&](auto& tile) { renderBrick(s.bricks.front(), tile); };
    scene::PassesInTurn inTurn;
    switch (loop) {
    case Loop::ImageOwned: return dfb::ImageParallelLoop(fb).render(renderFirst, params);
    case Loop::ImageRoundRobin:
        return dfb::ImageParallelLoop(fb, dfb::WorkDistribution::RoundRobin).render(renderFirst, params);
    case Loop::ImageDynamic:
        return dfb::ImageParallelLoop(fb, dfb::WorkDistribution::Dynamic).render(renderFirst, params);
    case Loop::Mixed:
        return dfb::MixedParallelLoop(fb, shared, inTurn).render(scene::FlatCamera(), renderBrick, params);
    case Loop::Ordered: {
        std::vector<int> order(shared.bricks().size()); // by id, as they are in the scene
        std::iota(order.begin(), order.end(), 0);
        return dfb::OrderedLoop(fb, shared, inTurn).render(scene::FlatCamera(), order, renderBrick, params);
    }
    case Loop::Deep:
        if constexpr ((Tile::channels & dfb::farChannel) != 0)
            return dfb::DeepParallelLoop(fb, world, 1)
                .render(
                    scene::FlatCamera(),
                    [&](const dfb::Brick& b, dfb::DeepTile& deep) {
                        if (fails)
                            throw std::runtime_error("on purpose");
                        const dfb::Region& r = deep.header().region;
                        for (int y = r.y0; y < r.y1; ++y)
                            for (int x = r.x0; x < r.x1; ++x)
                                if (const auto sample = sampleOf(s, b, deep.header().sample, x, y))
                                    deep.add(x, y, {sample->rgba, sample->depth, sample->depth});
                    },
                    params);
        break;
    case Loop::Declared:
    case Loop::ByHand: {
        const bool isDeclared = loop == Loop::Declared;
        params.declared = isDeclared;
        auto frame = fb.begin(params);
        const auto tile = std::make_unique<Tile>();
        const auto pairs = dfb::visibleTiles(world, scene::FlatCamera(), fb.layout());
        if (isDeclared)
            frame.declare(dfb::inputsOf(world, pairs));
        for (const int index : fb.ownedTiles())
            for (int pass = 0; !isDeclared && pass < params.passes; ++pass)
                scene::sendParent(frame, *tile, index, scene::bricksIn(fb, s, index), pass);
        try {
            for (const dfb::BrickInTile& pair : pairs)
                for (int pass = 0; pass < params.passes; ++pass) {
                    const dfb::Brick& b = world.bricks()[static_cast<std::size_t>(pair.brick)];
                    frame.start(*tile, pair.tile, pass);
                    tile->generation = 1;
                    tile->source = b.id;
                    renderBrick(b, *tile);
                    frame.setTile(*tile);
                }
        } catch (...) {
            frame.abort(std::current_exception());
        }
        return frame.end();
    }
    case Loop::Data: break;
    }
    return dfb::DataParallelLoop(fb, world).render(scene::FlatCamera(), renderBrick, params);
}

// The reference of a scene, computed once for each number of bricks, blend rule, seed and number of samples.
inline const std::vector<dfb::testing::Pixel>& referenceOf(scene::Scene s, int samples)
{
    static std::mutex mutex;
    static std::map<std::tuple<std::size_t, dfb::BlendRule, std::uint64_t, int>, std::vector<dfb::testing::Pixel>>
        known;
    const std::lock_guard<std::mutex> lock(mutex);
    s.passes = samples;
    std::vector<dfb::testing::Pixel>& pixels = known[{s.bricks.size(), s.rule, s.seed, samples}];
    if (pixels.empty())
        pixels = scene::referenceOf(s);
    return pixels;
}

} // namespace accumulation

// Each frame renders the next samples. The image is the mean of all samples since the id changed or a frame failed.
struct NextSamples {
    using Loop = accumulation::Loop;

    template <class Op>
    static void accumulate(const Transport::Communicator& communicator, const std::vector<Loop>& loops, Result& result)
    {
        for (const Loop loop : loops) {
            scene::Scene s = scene::makeScene(accumulation::isImageParallel(loop) ? 1 : 6, 4, 45, 37);
            s.rule = loop == Loop::Ordered ? dfb::BlendRule::InOrder : dfb::BlendRule::SortByDepth;
            if (accumulation::isImageParallel(loop))
                s.bricks[0].bounds = {{0, 0, 0}, {45, 37, 1}};
            dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport> fb(communicator, configOf(s, 2));
            const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
            const dfb::SharedWorld shared(fb, world);
            dfb::FrameConfig params = paramsOf(s);
            params.timeout = std::chrono::milliseconds(20000); // nothing waits for it
            // Renders the next `passes` samples. The image must then have `all` samples; if `all` is 0, the frame
            // fails.
            const auto frame = [&](int passes, int all) {
                params.passes = passes;
                dfb::FrameReport report;
                const std::string outcome = scene::outcomeOf(
                    [&] { report = accumulation::render(fb, loop, s, world, shared, params, all == 0); });
                const std::string what = "loop " + std::to_string(static_cast<int>(loop)) + ", id "
                                         + std::to_string(params.accumulationId) + ", " + std::to_string(all)
                                         + " samples: ";
                if (all == 0 || outcome != "fine") {
                    result.expect(scene::has(outcome, "on purpose") == (all == 0), what + outcome);
                } else if (fb.isDisplayRank()) {
                    const scene::Picture picture(fb.image(), report);
                    const std::size_t wrong = wrongValues(picture, accumulation::referenceOf(s, all));
                    result.expect(wrong == 0, what + std::to_string(wrong) + " values");
                    result.hash = 31 * result.hash + picture.hash();
                }
            };
            frame(2, 2); // without an id
            frame(1, 3);
            params.accumulationId = 8;
            frame(3, 3);
            frame(1, 4);
            frame(3, 7);
            s.seed = 23; // something has moved
            ++params.accumulationId;
            frame(2, 2);
            frame(1, 3);
            frame(2, 0);
            frame(1, 1); // after a failure it begins again
            frame(2, 3);
            // A plan itself says which samples come next. After a frame with a plan, accumulation begins again.
            auto plan = std::make_shared<std::vector<dfb::TileSamples>>(
                static_cast<std::size_t>(fb.layout().tileCount()), dfb::TileSamples{3, 2});
            params.samples = plan;
            if (loop != Loop::Declared && loop != Loop::ByHand) // which know no plans
                frame(1, 5);
            params.samples = nullptr;
            params.accumulationId += loop == Loop::Declared || loop == Loop::ByHand;
            frame(1, 1);
            frame(1, 2);
            params.passes = std::numeric_limits<int>::max();
            const std::string outcome = scene::outcomeOf([&] { (void)fb.begin(params); });
            result.expect(scene::has(outcome, "InvalidArgument") && scene::has(outcome, "take another accumulationId"),
                          "more samples than can be counted: " + outcome);
        }
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        accumulate<dfb::Progressive<dfb::BasicImageParallel<16>>>(
            communicator, {Loop::ImageOwned, Loop::ImageRoundRobin, Loop::ImageDynamic}, result);
        accumulate<dfb::Progressive<dfb::BasicAlphaBlend<16>>>(
            communicator, {Loop::Data, Loop::Mixed, Loop::Declared, Loop::ByHand}, result);
        accumulate<dfb::Progressive<dfb::BasicDeepBlend<16>>>(communicator, {Loop::Deep}, result);
        accumulate<dfb::Progressive<dfb::BasicOrderedBlend<16>>>(communicator, {Loop::Ordered}, result);
        return result;
    }
};

// Bricks move, come and go, and the id stays. The image is the mean of the samples of all frames, each with the bricks
// of its frame, also in tiles that were empty at first or are empty now.
struct MovingSamples {
    template <class Op>
    static void accumulate(const Transport::Communicator& communicator, const std::vector<accumulation::Loop>& loops,
                           Result& result)
    {
        for (const auto loop : loops) {
            scene::Scene s = scene::makeScene(0, 4, 93, 45);
            dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport> fb(communicator, configOf(s, 2));
            std::vector<std::vector<dfb::testing::Pixel>> samples; // each pixel's
            samples.resize(static_cast<std::size_t>(s.width * s.height));
            int all = 0;
            for (int number = 0; number < 6; ++number) {
                s.bricks.clear();
                for (int i = 0; i < 3; ++i)
                    if ((number + i) % 3 > 0) {
                        const auto x = static_cast<float>(14 * number), y = static_cast<float>(11 * i);
                        s.bricks.push_back({static_cast<std::uint32_t>(5 + i), {{x, y, 0}, {x + 20, y + 15, 1}}});
                    }
                if (number == 3)
                    s.bricks.clear();
                const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
                const dfb::SharedWorld shared(fb, world);
                dfb::FrameConfig params = paramsOf(s);
                params.timeout = std::chrono::milliseconds(20000); // nothing waits for it
                params.accumulationId = 1;
                params.passes = 1 + number % 2;
                const std::string what =
                    "loop " + std::to_string(static_cast<int>(loop)) + ", frame " + std::to_string(number) + ": ";
                dfb::FrameReport report;
                const std::string outcome =
                    scene::outcomeOf([&] { report = accumulation::render(fb, loop, s, world, shared, params); });
                result.expect(outcome == "fine", what + outcome);
                if (!fb.isDisplayRank() || outcome != "fine")
                    continue;
                std::vector<dfb::testing::Pixel> expected;
                for (std::size_t i = 0; i < samples.size(); ++i) {
                    for (int pass = 0; pass < params.passes; ++pass) {
                        const int x = static_cast<int>(i) % s.width, y = static_cast<int>(i) / s.width;
                        std::vector<dfb::testing::Sample> found;
                        for (const dfb::Brick& b : s.bricks)
                            if (const auto sample = sampleOf(s, b, all + pass, x, y);
                                sample && sample->rgba != std::array<float, 4>{})
                                found.push_back(*sample);
                        samples[i].push_back(dfb::testing::composite(std::move(found), s.background));
                    }
                    expected.push_back(dfb::testing::mean(samples[i]));
                }
                all += params.passes;
                const scene::Picture picture(fb.image(), report);
                const std::size_t wrong = wrongValues(picture, expected);
                result.expect(wrong == 0, what + std::to_string(wrong) + " values");
                result.hash = 31 * result.hash + picture.hash();
            }
        }
    }

    static Result run(const Transport::Communicator& communicator)
    {
        using accumulation::Loop;
        Result result;
        accumulate<dfb::Progressive<dfb::BasicAlphaBlend<16>>>(
            communicator, {Loop::Data, Loop::Mixed, Loop::Declared, Loop::ByHand}, result);
        return result;
    }
};

// Renders grey bricks, rounded for sending; returns the bound of the error.
template <class FrameBuffer>
double boundOfGrey(FrameBuffer& fb, const scene::Scene& s, std::uint64_t id, std::vector<dfb::TileSamples> samples,
                   const std::vector<dfb::Brick>& bricks)
{
    auto params = paramsOf(s);
    params.accumulationId = id;
    params.samples = std::make_shared<const std::vector<dfb::TileSamples>>(std::move(samples));
    return dfb::DataParallelLoop(fb, dfb::World(bricks))
        .render(
            scene::FlatCamera(),
            [](const dfb::Brick&, auto& tile) {
                tile.fill({0.1f, 0.1f, 0.1f, 0.3f}, 1.0f);
            },
            params)
        .wireErrorBound;
}

// Pixels that stay in the image are as far off as in the frame that rendered them.
struct KeptPixels {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5, 11);
        auto config = configOf(s, 1);
        config.precision = dfb::WireFormat::Unorm8;
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(communicator, config);
        const std::vector<dfb::TileSamples> all(static_cast<std::size_t>(fb.layout().tileCount()), {0, 1});
        auto onlyLast = all;
        std::fill_n(onlyLast.begin(), all.size() - 1, dfb::TileSamples{0, 0});
        const double first = boundOfGrey(fb, s, 0, all, bricksOf(s, fb.rank(), fb.size()));
        result.expect(first > 0, "nothing was rounded");
        result.expect(boundOfGrey(fb, s, 0, onlyLast, {}) == first, "another bound while tiles are kept");
        result.expect(boundOfGrey(fb, s, 0, all, {}) == 0, "a bound of what is in the image no more");
        return result;
    }
};

// The mean is off by no more than its worst sample, however many frames ago that was.
struct RoundedSamples {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5, 11);
        auto config = configOf(s, 1);
        config.precision = dfb::WireFormat::Unorm8;
        dfb::DistributedFrameBuffer<dfb::Progressive<dfb::BasicAlphaBlend<16>>, dfb::NoPixelOp, Transport> fb(
            communicator, config);
        const auto boundOf = [&](std::uint64_t id, dfb::TileSamples samples, const std::vector<dfb::Brick>& bricks) {
            return boundOfGrey(fb, s, id, {static_cast<std::size_t>(fb.layout().tileCount()), samples}, bricks);
        };
        const std::vector<dfb::Brick> own = bricksOf(s, fb.rank(), fb.size());
        const double first = boundOf(1, {0, 1}, own);
        result.expect(first > 0, "nothing was rounded");
        result.expect(boundOf(1, {1, 1}, {}) == first, "another bound after an empty sample");
        result.expect(boundOf(1, {2, 0}, own) == first, "another bound after a frame without samples");
        result.expect(boundOf(2, {0, 1}, {}) == 0, "a bound of what is in the image no more");
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("Without a plan each frame renders the next samples, in each loop", "[accumulation]")
{
    everywhere<frame_cases::NextSamples>();
}

TEST_CASE("The image is the mean of all samples also if bricks have moved", "[accumulation]")
{
    everywhere<frame_cases::MovingSamples>();
}

TEST_CASE("How far samples may be off counts as long as they are in the image", "[accumulation]")
{
    everywhere<frame_cases::RoundedSamples>();
}

TEST_CASE("How far pixels may be off counts as long as they are in the image", "[accumulation]")
{
    everywhere<frame_cases::KeptPixels>();
}
