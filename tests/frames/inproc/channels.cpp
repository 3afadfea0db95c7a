// Auxiliary channels in every operation: positions and ids need no depth in the image, and Verified compares all
// channels. Ranks are threads.
#include "aux.hpp"
#include "catch.hpp"

#include <dfb/testing/verified.hpp>

#include <cmath>
#include <cstdint>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

namespace channels_cases {

namespace {

using frame_cases::renderWithAux;
using frame_cases::wrongAux;

constexpr dfb::ChannelMask channels = dfb::allChannels & ~dfb::farChannel;
using Blend = dfb::BasicAlphaBlend<16, channels>;
using Single = dfb::BasicImageParallel<16, channels>;
using Ordered = dfb::BasicOrderedBlend<16, channels>;
using Nearest = dfb::BasicDepthComposite<16, channels>;
template <class Op>
using FrameBuffer = dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, dfb::InprocTransport>;

scene::Scene sceneOf(dfb::BlendRule rule, bool isSingle, int passes)
{
    scene::Scene s = scene::makeScene(isSingle ? 1 : 6, 21, 61, 47, passes);
    if (isSingle)
        s.bricks[0].bounds = {{0, 0, 0}, {61, 47, 1}};
    s.rule = rule;
    return s;
}

// Renders one frame of the scene, or, to accumulate, a frame of one sample for each of its passes.
template <class Op>
void render(FrameBuffer<Op>& fb, const scene::Scene& s, bool accumulates,
            const typename FrameBuffer<Op>::TileFrameData& data = {})
{
    const dfb::SharedWorld shared(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())));
    std::vector<int> order;
    for (std::size_t i = 0; i < s.bricks.size(); ++i)
        order.push_back(static_cast<int>(i));
    dfb::RoundRobinBricks owner;
    dfb::ImageParallelLoop image(fb);
    dfb::OrderedLoop ordered(fb, shared, owner);
    dfb::MixedParallelLoop mixed(fb, shared, owner);
    for (int frame = 0; frame < (accumulates ? s.passes : 1); ++frame) {
        dfb::FrameConfig params = paramsOf(s);
        if (accumulates) {
            params.accumulationId = 1;
            params.samples = std::make_shared<std::vector<dfb::TileSamples>>(
                static_cast<std::size_t>(fb.layout().tileCount()), dfb::TileSamples{frame, 1});
        }
        const auto renderBrick = [&](const dfb::Brick& b, auto& tile) {
            const int pass = std::exchange(tile.pass, tile.sample);
            renderWithAux(s, b, tile);
            tile.pass = pass;
        };
        if (s.bricks.size() == 1)
            image.render([&](auto& tile) { renderBrick(s.bricks[0], tile); }, params, data);
        else if (s.rule == dfb::BlendRule::InOrder)
            ordered.render(scene::FlatCamera(), order, renderBrick, params, data);
        else
            mixed.render(scene::FlatCamera(), renderBrick, params, data);
    }
}

template <class Op>
void check(dfb::BlendRule rule, bool isSingle, bool accumulates = false)
{
    for (const int passes : {1, 3})
        for (const bool depth : {true, false}) {
            const scene::Scene s = sceneOf(rule, isSingle, passes);
            std::size_t wrong = 1;
            dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
                auto config = configOf(s);
                config.image.aux = dfb::imageAuxChannels;
                config.image.depth = depth;
                FrameBuffer<Op> fb(communicator, config);
                render(fb, s, accumulates);
                if (fb.isDisplayRank())
                    wrong = wrongAux(s, fb.image());
            });
            INFO(passes << " passes, depth " << depth);
            CHECK(wrong == 0);
        }
}

} // namespace

TEST_CASE("Positions and ids are right without depth in the image, image-parallel", "[channels]")
{
    check<Single>(dfb::BlendRule::InOrder, true);
    check<dfb::Progressive<Single>>(dfb::BlendRule::InOrder, true, true);
}

TEST_CASE("Positions and ids are right without depth in the image, blended in order", "[channels]")
{
    check<Ordered>(dfb::BlendRule::InOrder, false);
    check<dfb::Progressive<Ordered>>(dfb::BlendRule::InOrder, false, true);
}

TEST_CASE("Positions and ids are right without depth in the image, sorted", "[channels]")
{
    check<Blend>(dfb::BlendRule::SortByDepth, false);
    check<dfb::Progressive<Blend>>(dfb::BlendRule::SortByDepth, false, true);
}

TEST_CASE("Positions and ids are right without depth in the image, the nearest", "[channels]")
{
    check<Nearest>(dfb::BlendRule::Nearest, false);
    check<dfb::Progressive<Nearest>>(dfb::BlendRule::Nearest, false, true);
}

TEST_CASE("Positions of single passes in order need no depth at all, several passes do", "[channels]")
{
    const auto outcomeOf = [](int passes, std::size_t& wrong) {
        const scene::Scene s = sceneOf(dfb::BlendRule::InOrder, true, passes);
        std::vector<float> color(4 * 61 * 47, 0.5f), position;
        for (int i = 0; i < 3 * 61 * 47; ++i)
            position.push_back(static_cast<float>(i));
        return scene::outcomeOf([&] {
            dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
                auto config = configOf(s);
                config.image.depth = false;
                config.image.aux = dfb::positionChannel;
                FrameBuffer<Single> fb(communicator, config);
                dfb::ImageParallelLoop(fb).render(dfb::inPlace([&](auto& view) {
                                                      const auto at = static_cast<std::size_t>(view.region.y0 * 61
                                                                                               + view.region.x0);
                                                      view.stride = 61;
                                                      view.color = &color[4 * at];
                                                      view.position = &position[3 * at];
                                                  }),
                                                  paramsOf(s));
                wrong = 0;
                for (std::size_t i = 0; i < position.size(); ++i)
                    wrong += fb.image().position()[i] != position[i];
            });
        });
    };
    std::size_t wrong = 1;
    CHECK(outcomeOf(1, wrong) == "fine");
    CHECK(wrong == 0);
    CHECK(scene::has(outcomeOf(2, wrong), "without its depth, which is needed"));
}

namespace {

enum class Damage { None, Depth, Normal, Albedo, Position, PrimitiveId, InstanceId };

// An operation that makes the first row of each tile wrong in one channel.
template <Damage What>
struct Damaged : Blend {
    void finish(dfb::FinishedTile& out)
    {
        Blend::finish(out);
        const auto width = static_cast<std::size_t>(out.width());
        const auto copyOf = [](const auto* from, std::size_t count) { return std::vector(from, from + count); };
        const auto rgba = reinterpret_cast<const float*>(dfb::testing::rowOf(out, dfb::detail::Color, 0));
        const std::vector<double> color(rgba, rgba + 4 * width);
        auto depth = copyOf(dfb::testing::depthRowOf(out, 0), width);
        const dfb::AuxRow row = dfb::testing::auxRowOf(out, 0);
        auto normal = copyOf(row.normal, 3 * width), albedo = copyOf(row.albedo, 3 * width),
             position = copyOf(row.position, 3 * width);
        auto primitive = copyOf(row.primitiveId, width), instance = copyOf(row.instanceId, width);
        for (std::size_t x = 0; x < width; ++x) {
            if (What == Damage::Depth)
                depth[x] = -1;
            if (What == Damage::Normal)
                normal[3 * x] += 2e-7f * (1 + std::fabs(normal[3 * x]));
            if (What == Damage::Albedo)
                albedo[3 * x + 1] += 2e-7f * (1 + std::fabs(albedo[3 * x + 1]));
            if (What == Damage::Position)
                position[3 * x + 2] = std::nextafter(position[3 * x + 2], 100.0f);
            if (What == Damage::PrimitiveId)
                ++primitive[x];
            if (What == Damage::InstanceId)
                ++instance[x];
        }
        out.setRow(0, color.data(), depth.data(),
                   {normal.data(), albedo.data(), position.data(), primitive.data(), instance.data()});
    }
};

template <class Op>
dfb::testing::ErrorReport verify(const scene::Scene& s, bool depth = true)
{
    dfb::testing::ErrorReport all;
    std::mutex mutex;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto config = configOf(s);
        config.image.aux = dfb::imageAuxChannels;
        config.image.depth = depth;
        FrameBuffer<dfb::testing::Verified<Op>> fb(communicator, config);
        dfb::testing::Verification verification;
        render(fb, s, false, &verification);
        const std::lock_guard<std::mutex> lock(mutex);
        all.add(verification.report());
    });
    return all;
}

template <class Op>
void checkFine(dfb::BlendRule rule, bool isSingle)
{
    for (const int passes : {1, 2})
        for (const bool depth : {true, false}) {
            const auto report = verify<Op>(sceneOf(rule, isSingle, passes), depth);
            INFO(passes << " passes, depth " << depth << ": " << report.text());
            CHECK(report.wrongOthers == 0);
            CHECK(report.others >= 61 * 47 * (depth ? 12 : 11) / 2);
            CHECK(report.ulpsBelow() <= 2);
        }
}

template <Damage What>
std::int64_t wrongOthers()
{
    return verify<Damaged<What>>(sceneOf(dfb::BlendRule::SortByDepth, false, 2)).wrongOthers;
}

} // namespace

TEST_CASE("Verified finds nothing wrong with the library's operations, in all channels", "[channels]")
{
    checkFine<Blend>(dfb::BlendRule::SortByDepth, false);
    checkFine<Single>(dfb::BlendRule::InOrder, true);
    checkFine<Ordered>(dfb::BlendRule::InOrder, false);
    checkFine<Nearest>(dfb::BlendRule::Nearest, false);
}

TEST_CASE("Verified notices what is wrong in any channel", "[channels]")
{
    // In each column, the first row of each tile with an input is wrong.
    const std::int64_t wrong = wrongOthers<Damage::Depth>();
    CHECK(wrong >= 61);
    CHECK(wrongOthers<Damage::None>() == 0);
    CHECK(wrongOthers<Damage::Normal>() == wrong);
    CHECK(wrongOthers<Damage::Albedo>() == wrong);
    CHECK(wrongOthers<Damage::Position>() == wrong);
    CHECK(wrongOthers<Damage::PrimitiveId>() == wrong);
    CHECK(wrongOthers<Damage::InstanceId>() == wrong);
}

} // namespace channels_cases
