// Wire precision and early termination: errors are within what was asked for and what is reported, for any number of
// ranks. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace frame_cases {

// Like renderBrick(), with colours in [0, alpha].
template <class Tile>
void renderInRange(const scene::Scene& s, const dfb::Brick& brick, Tile& tile)
{
    renderBrick(s, brick, tile);
    tile.forEachPixel([](int, int, float* rgba, float&) {
        for (int c = 0; c < 3; ++c)
            rgba[c] = std::min(rgba[c], rgba[3]);
    });
}

struct Precision {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5, 11);
        const auto connection = dfb::connect<Transport>(communicator);
        const auto frame = [&](const dfb::Precision& wire, float minTransmittance, int maxLayers,
                               bool inRange) -> std::pair<std::vector<float>, dfb::FrameReport> {
            auto config = configOf(s, 1);
            config.precision = wire;
            config.minTransmittance = minTransmittance;
            dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(connection, config);
            auto params = paramsOf(s);
            params.maxLayers = maxLayers;
            const auto report = dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
                                    .render(
                                        scene::FlatCamera(),
                                        [&](const dfb::Brick& b, auto& tile) {
                                            if (inRange)
                                                renderInRange(s, b, tile);
                                            else
                                                renderBrick(s, b, tile);
                                        },
                                        params);
            std::vector<float> values;
            if (!fb.image().empty())
                values.assign(fb.image().rgba32f(), fb.image().rgba32f() + 4 * fb.image().pixelCount());
            return {values, report};
        };
        const auto exact = frame(dfb::WireFormat::Float32, 0, 0, true);
        result.expect(exact.second.wireErrorBound == 0, "a bound for float32");
        const auto check = [&](const std::string& name, const std::pair<std::vector<float>, dfb::FrameReport>& got,
                               double promised) {
            double worst = 0;
            for (std::size_t i = 0; i < got.first.size(); ++i)
                worst =
                    std::max(worst, std::abs(static_cast<double>(got.first[i]) - static_cast<double>(exact.first[i])));
            const double bound = got.second.wireErrorBound;
            // Both images were rounded to float.
            result.expect(worst <= bound + 0x1p-23,
                          name + ": off by " + std::to_string(worst) + " of " + std::to_string(bound));
            result.expect(bound <= promised, name + ": bound " + std::to_string(bound));
            result.expect(promised > 1 || bound == 0 || worst > 0 || got.first.empty(), name + ": nothing was rounded");
            result.hash = result.hash * 31 + dfb::testing::hashOf(got.first.data(), got.first.size() * sizeof(float));
        };
        const struct {
            double budget;
            dfb::WireFormat expected;
        } budgets[] = {{4e-2, dfb::WireFormat::Unorm8},
                       {1e-2, dfb::WireFormat::Unorm16},
                       {5e-4, dfb::WireFormat::Unorm16},
                       {1e-5, dfb::WireFormat::Float32}};
        for (const auto& b : budgets) {
            const auto got = frame(dfb::ErrorBudget{b.budget}, 0, 5, true);
            check("budget " + std::to_string(b.budget), got, b.budget);
            result.expect(got.second.wireColor == b.expected, "picked " + std::string(nameOf(got.second.wireColor)));
        }
        const auto unknown = frame(dfb::ErrorBudget{2e-3}, 0, 0, true);
        check("layers not known", unknown, 2e-3);
        result.expect(unknown.second.wireColor == dfb::WireFormat::Float16, "not known: not float16");
        check("early termination", frame(dfb::WireFormat::Float32, 0.05f, 0, true), static_cast<double>(0.05f));
        check("both", frame(dfb::ErrorBudget{0.06}, 0.05f, 5, true), 0.06);
        // Emissive colours are above alpha. Such tiles are sent exactly, and the error bound of the others accounts for
        // them.
        const auto emission = frame(dfb::WireFormat::Float32, 0, 0, false);
        const auto lossy = frame(dfb::WireFormat::Unorm16, 0, 0, false);
        double worst = 0;
        for (std::size_t i = 0; i < lossy.first.size(); ++i)
            worst =
                std::max(worst, std::abs(static_cast<double>(lossy.first[i]) - static_cast<double>(emission.first[i])));
        result.expect(worst <= lossy.second.wireErrorBound + 0x1p-23, "emission");
        return result;
    }
};

// An input with an alpha outside [0, 1] is exact, but how much it lets through of rounded inputs is not known.
struct AlphaOutside {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5, 11);
        auto config = configOf(s, 1);
        config.precision = dfb::WireFormat::Unorm8;
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(communicator, config);
        const auto report = dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
                                .render(
                                    scene::FlatCamera(),
                                    [&](const dfb::Brick& b, auto& tile) {
                                        renderInRange(s, b, tile);
                                        if (b.id == s.bricks[0].id)
                                            tile.forEachPixel([](int, int, float* rgba, float&) { rgba[3] *= 3; });
                                    },
                                    paramsOf(s));
        result.expect(report.alphaOutsidePixels > 0, "no alpha is outside");
        result.expect(std::isinf(report.wireErrorBound), "a bound of " + std::to_string(report.wireErrorBound));
        return result;
    }
};

// HalfLevel: float images, and inputs that stay within a node, are exact. No 8-bit level is off by more than one.
struct WithinHalfALevel {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5, 11);
        for (const bool sharesMemory : {true, false}) {
            dfb::NetworkConfig network;
            network.sharedMemory = sharesMemory;
            const auto connection = dfb::connect<Transport>(communicator, network);
            bool hasFarRanks = false;
            for (int other = 0; other < connection->size(); ++other)
                hasFarRanks = hasFarRanks || (other != connection->rank() && !connection->sharesMemoryWith(other));
            // With 200 layers, 16 bits are not enough for half a level of sRGB, whose curve is steep in the dark.
            for (const auto& [format, layers] :
                 {std::make_pair(dfb::OutputFormat::RGBA8, 5), std::make_pair(dfb::OutputFormat::RGBA8, 200),
                  std::make_pair(dfb::OutputFormat::SRGBA8, 5), std::make_pair(dfb::OutputFormat::SRGBA8, 200),
                  std::make_pair(dfb::OutputFormat::RGBA32F, 5)}) {
                const dfb::OutputFormat output = format;
                const int maxLayers = layers;
                const auto frame = [&](const dfb::Precision& precision) {
                    auto config = configOf(s, 1);
                    config.image.format = output;
                    config.precision = precision;
                    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(connection,
                                                                                                        config);
                    auto params = paramsOf(s);
                    params.maxLayers = maxLayers;
                    const auto report =
                        dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
                            .render(
                                scene::FlatCamera(),
                                [&](const dfb::Brick& b, auto& tile) { renderInRange(s, b, tile); }, params);
                    std::vector<std::byte> bytes;
                    fb.image().forEachPlane([&](const std::byte* plane, std::size_t count) {
                        bytes.insert(bytes.end(), plane, plane + count);
                    });
                    return std::make_pair(bytes, report);
                };
                const auto exact = frame({}), half = frame(dfb::HalfLevel{});
                const bool isFloat = output == dfb::OutputFormat::RGBA32F, isSrgb = output == dfb::OutputFormat::SRGBA8;
                const bool isLossy = hasFarRanks && !isFloat && !(isSrgb && maxLayers == 200);
                const std::string name =
                    std::string(dfb::nameOf(output)) + (sharesMemory ? ", shared memory" : ", through MPI");
                const double budget = isSrgb ? 0.5 / 255 / 12.92 : 0.5 / 255;
                result.expect((half.second.wireColor != dfb::WireFormat::Float32) == isLossy,
                              name + ": travels as " + dfb::nameOf(half.second.wireColor));
                result.expect(half.second.wireErrorBound <= (isLossy ? budget : 0),
                              name + ": a bound of " + std::to_string(half.second.wireErrorBound));
                result.expect(isLossy ? half.second.bytesSent < exact.second.bytesSent : half.first == exact.first,
                              name + (isLossy ? ": no fewer bytes" : ": another image"));
                const std::size_t colors = half.first.empty() ? 0 : 4 * static_cast<std::size_t>(s.width * s.height);
                int worst = 0;
                for (std::size_t i = 0; i < colors && !isFloat; ++i)
                    worst =
                        std::max(worst, std::abs(static_cast<int>(half.first[i]) - static_cast<int>(exact.first[i])));
                result.expect(worst <= 1, name + ": off by " + std::to_string(worst) + " levels");
            }
        }
        return result;
    }
};

// Channels other than colour do not depend on the colour's format, however thin a layer is. If all normals are equal,
// their mean is the same normal.
struct OtherChannels {
    static Result run(const Transport::Communicator& communicator)
    {
        using Op = dfb::BasicAlphaBlend<16, dfb::allChannels & ~dfb::farChannel>;
        Result result;
        const scene::Scene s = scene::makeScene(5, 11);
        const std::array<float, 3> normal{0.6f, 0.0f, -0.8f};
        const auto connection = dfb::connect<Transport>(communicator);
        std::vector<float> depth, position;
        std::vector<std::uint32_t> ids;
        for (const auto format :
             {dfb::WireFormat::Float32, dfb::WireFormat::Float16, dfb::WireFormat::Unorm16, dfb::WireFormat::Unorm8}) {
            auto config = configOf(s, 1);
            config.precision = format;
            config.image.aux = dfb::imageAuxChannels;
            dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport> fb(connection, config);
            dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
                .render(
                    scene::FlatCamera(),
                    [&](const dfb::Brick& b, auto& tile) {
                        renderInRange(s, b, tile);
                        tile.forEachPixel([&](int x, int y, float* rgba, float&) {
                            if (x % 3 == 0) // some are rounded to 0, some are not
                                for (int c = 0; c < 4; ++c)
                                    rgba[c] *= x % 2 ? 0x1p-9f : 0x1p-45f;
                            const int i = (y - tile.region.y0) * 16 + x - tile.region.x0;
                            for (int c = 0; c < 3; ++c) {
                                tile.normal[3 * i + c] = rgba[3] * normal[static_cast<std::size_t>(c)];
                                tile.position[3 * i + c] = static_cast<float>(b.id) + static_cast<float>(c * x);
                            }
                            tile.primitiveId[i] = b.id % 2 ? b.id : dfb::noId;
                            tile.instanceId[i] = b.id;
                        });
                    },
                    paramsOf(s));
            if (!fb.isDisplayRank())
                continue;
            const dfb::Image& image = fb.image();
            const std::size_t n = image.pixelCount();
            const std::vector<float> itsDepth(image.depth(), image.depth() + n),
                itsPosition(image.position(), image.position() + 3 * n);
            std::vector<std::uint32_t> itsIds(image.primitiveId(), image.primitiveId() + n);
            itsIds.insert(itsIds.end(), image.instanceId(), image.instanceId() + n);
            if (depth.empty()) {
                depth = itsDepth, position = itsPosition, ids = itsIds;
            }
            const std::string name = nameOf(format);
            result.expect(itsDepth == depth, name + ": depth");
            result.expect(itsPosition == position, name + ": position");
            result.expect(itsIds == ids, name + ": ids");
            double worst = 0;
            for (std::size_t i = 0; i < 3 * n; ++i)
                if (std::isfinite(depth[i / 3]))
                    worst = std::max(worst, std::abs(static_cast<double>(image.normal()[i] - normal[i % 3])));
            // Products by alpha, the ratio of two alphas and the products by that ratio are rounded to float.
            result.expect(worst <= 4 * 0x1p-24, name + ": normals are off by " + std::to_string(worst));
            result.hash = result.hash * 31 + dfb::testing::hashOf(image.normal(), 12 * n);
        }
        return result;
    }
};

// Invalid precisions are refused on all ranks.
struct NoPrecision {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto [rank, size] = [&] {
            const auto connection = dfb::connect<Transport>(communicator);
            return std::make_pair(connection->rank(), connection->size());
        }();
        const scene::Scene s = scene::makeScene(2, 1);
        const float nan = std::numeric_limits<float>::quiet_NaN();
        const auto refuses = [&](const std::string& what, const auto& change) {
            auto config = configOf(s, 1);
            change(config);
            const std::string outcome = scene::outcomeOf([&] {
                dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(communicator,
                                                                                                    config);
            });
            result.expect(scene::has(outcome, "InvalidArgument") && scene::has(outcome, what), outcome);
        };
        refuses("error budget", [&](auto& c) { c.precision.budget = -1e-3; });
        refuses("error budget", [&](auto& c) { c.precision.maxColor = nan; });
        refuses("least transmittance", [&](auto& c) { c.minTransmittance = nan; });
        if (size > 1)
            refuses("precision.color is float32 on rank 0 and float16 on rank 1", [&, rank = rank](auto& c) {
                if (rank == 1)
                    c.precision.color = dfb::WireFormat::Float16;
            });
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("Within half a level: exact on a node and for floats, else no level is off by more than one", "[precision]")
{
    everywhere<frame_cases::WithinHalfALevel>();
}

TEST_CASE("Lossy formats keep their bounds and budgets, the same on any ranks", "[precision]")
{
    everywhere<frame_cases::Precision>();
}

TEST_CASE("With an alpha outside 0 and 1 the bound of what is rounded beside it is infinite", "[precision]")
{
    everywhere<frame_cases::AlphaOutside>();
}

TEST_CASE("Depth, positions and ids are the same in any format, normals stay means", "[precision]")
{
    everywhere<frame_cases::OtherChannels>();
}

TEST_CASE("A wire precision that cannot be is refused on all ranks", "[precision]")
{
    everywhere<frame_cases::NoPrecision>();
}
