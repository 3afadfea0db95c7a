// Deep fragments: bricks that interleave along the rays. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace frame_cases {

// A scene in which each ray has 12 slots. Each slot is filled by one of three bricks, or is empty.
struct Interleaved {
    static constexpr int slots = 12, bricks = 3;
    int width = 61, height = 47;
    std::array<float, 4> background{0.25f, 0.125f, 0.5f, 1.0f};

    std::uint64_t hashAt(int x, int y, int slot, int pass) const
    {
        return scene::mix(scene::mix(static_cast<std::uint64_t>(slot) * 17 + static_cast<std::uint64_t>(pass))
                          + static_cast<std::uint64_t>(y) * 65536 + static_cast<std::uint64_t>(x));
    }
    int brickAt(int x, int y, int slot, int pass) const
    {
        return static_cast<int>(hashAt(x, y, slot, pass) % 4);
    } // 3: nobody
    dfb::Segment segmentAt(int x, int y, int slot, int pass) const
    {
        const std::uint64_t h = hashAt(x, y, slot, pass);
        const auto part = [h](int shift) { return static_cast<float>((h >> shift) & 0x3ff) / 1024.0f; };
        const float alpha = 0.7f * part(8);
        return {{alpha * part(18), alpha * part(28), alpha * part(38), alpha},
                static_cast<float>(slot),
                static_cast<float>(slot + 1)};
    }

    dfb::World world(int rank, int size) const
    {
        dfb::World mine;
        for (int b = 0; b < bricks; ++b) // their bounds are all the same
            if (b % size == rank)
                mine.add({static_cast<std::uint32_t>(b + 5),
                          {{0, 0, 0}, {static_cast<float>(width), static_cast<float>(height), 1}}});
        return mine;
    }

    std::vector<dfb::testing::Pixel> image(int passCount) const
    {
        std::vector<dfb::testing::Pixel> result;
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                std::vector<dfb::testing::Pixel> passes;
                for (int pass = 0; pass < passCount; ++pass) {
                    std::vector<dfb::testing::Sample> samples;
                    for (int slot = 0; slot < slots; ++slot)
                        if (brickAt(x, y, slot, pass) < bricks) {
                            const dfb::Segment s = segmentAt(x, y, slot, pass);
                            samples.push_back({s.rgba, s.depth, 0, 0});
                        }
                    passes.push_back(dfb::testing::composite(samples, background));
                }
                result.push_back(dfb::testing::mean(passes));
            }
        return result;
    }

    // Number of pixels in which the intervals of bricks, each from its first slot to its last, overlap.
    std::int64_t overlapping() const
    {
        std::int64_t count = 0;
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                int first[bricks], last[bricks];
                for (int b = 0; b < bricks; ++b) {
                    first[b] = slots, last[b] = -1;
                    for (int slot = 0; slot < slots; ++slot)
                        if (brickAt(x, y, slot, 0) == b && segmentAt(x, y, slot, 0).rgba[3] > 0) {
                            first[b] = std::min(first[b], slot);
                            last[b] = slot;
                        }
                }
                bool overlap = false;
                for (int a = 0; a < bricks; ++a)
                    for (int b = a + 1; b < bricks; ++b)
                        overlap = overlap || (first[a] <= last[b] && first[b] <= last[a]);
                count += overlap;
            }
        return count;
    }

    void render(const dfb::Brick& brick, dfb::DeepTile& deep, bool backToFront) const
    {
        const dfb::Region& r = deep.header().region;
        for (int y = r.y0; y < r.y1; ++y)
            for (int x = r.x0; x < r.x1; ++x)
                for (int i = 0; i < slots; ++i) {
                    const int slot = backToFront ? slots - 1 - i : i;
                    if (brickAt(x, y, slot, deep.header().pass) == static_cast<int>(brick.id) - 5)
                        deep.add(x, y, segmentAt(x, y, slot, deep.header().pass));
                }
    }
};

using DeepFrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicDeepBlend<16>, dfb::NoPixelOp, Transport>;

struct Deep {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const Interleaved scene;
        scene::Scene size;
        size.width = scene.width, size.height = scene.height;
        DeepFrameBuffer fb(communicator, configOf(size, 2));
        const dfb::World world = scene.world(fb.rank(), fb.size());
        dfb::FrameConfig params;
        params.background = scene.background;
        const auto largestError = [&](const std::vector<dfb::testing::Pixel>& expected) {
            double largest = 0;
            for (std::size_t i = 0; i < expected.size(); ++i)
                for (std::size_t c = 0; c < 4; ++c)
                    largest = std::max(largest, std::fabs(static_cast<double>(fb.image().rgba32f()[4 * i + c])
                                                          - static_cast<double>(expected[i].rgba[c])));
            return largest;
        };

        // With all segments the image is exact.
        dfb::DeepParallelLoop exact(fb, world, Interleaved::slots);
        for (const bool backToFront : {false, true}) {
            params.passes = 2;
            const auto report = exact.render(
                scene::FlatCamera(),
                [&](const dfb::Brick& b, dfb::DeepTile& deep) { scene.render(b, deep, backToFront); }, params);
            result.expect(report.orderUndefinedPixels == 0, "an order is said to be undefined");
            result.expect(report.mergeErrorBound == 0, "something was merged");
            if (fb.isDisplayRank()) {
                const scene::Picture picture(fb.image(), report);
                const std::size_t wrong = wrongValues(picture, scene.image(2));
                result.expect(wrong == 0, std::to_string(wrong) + " values with all segments");
                result.expect(result.hash == 0 || result.hash == picture.hash(), "the order of adding shows");
                result.hash = picture.hash();
            }
        }

        // With fewer segments the error stays within the bound, which falls as there are more segments.
        double boundBefore = 10;
        params.passes = 1;
        for (const int segments : {1, 2, 3, 5}) {
            const auto report =
                dfb::DeepParallelLoop(fb, world, segments)
                    .render(
                        scene::FlatCamera(),
                        [&](const dfb::Brick& b, dfb::DeepTile& deep) { scene.render(b, deep, false); }, params);
            result.expect(report.mergeErrorBound > 0 && report.mergeErrorBound < boundBefore,
                          "a bound of " + std::to_string(report.mergeErrorBound) + " with " + std::to_string(segments));
            boundBefore = report.mergeErrorBound;
            if (segments == 1)
                result.expect(report.orderUndefinedPixels == scene.overlapping(),
                              std::to_string(report.orderUndefinedPixels) + " pixels of undefined order, not "
                                  + std::to_string(scene.overlapping()));
            if (fb.isDisplayRank()) {
                const double error = largestError(scene.image(1));
                result.expect(error > 1e-4 && error <= report.mergeErrorBound,
                              "off by " + std::to_string(error) + ", the bound is "
                                  + std::to_string(report.mergeErrorBound));
            }
        }

        // The bound counts as long as the frame is in the image.
        dfb::DistributedFrameBuffer<dfb::Progressive<dfb::BasicDeepBlend<16>>, dfb::NoPixelOp, Transport> means(
            communicator, configOf(size, 2));
        std::vector<double> bounds;
        for (const auto& [accumulationId, segments] :
             {std::pair(1, 1), std::pair(1, Interleaved::slots), std::pair(2, Interleaved::slots)}) {
            params.accumulationId = static_cast<std::uint64_t>(accumulationId);
            bounds.push_back(dfb::DeepParallelLoop(means, world, segments)
                                 .render(
                                     scene::FlatCamera(),
                                     [&](const dfb::Brick& b, dfb::DeepTile& deep) { scene.render(b, deep, false); },
                                     params)
                                 .mergeErrorBound);
        }
        result.expect(bounds[0] > 0 && bounds[1] == bounds[0] && bounds[2] == 0, "the bound of a mean");
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("Interleaved bricks are exact with deep fragments, and reported without", "[deep]")
{
    everywhere<frame_cases::Deep>();
}
