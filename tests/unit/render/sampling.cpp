// Plans of samples: arguments that cannot be. What they do is in tests/frames/sampling.cpp.
#include "catch.hpp"

#include <dfb/render/sampling.hpp>

#include <limits>
#include <vector>

TEST_CASE("Samples of a region and adaptive sampling refuse arguments that cannot be", "[sampling]")
{
    const dfb::TileLayout layout(64, 64, 32);
    CHECK_THROWS_AS(dfb::samplesIn(layout, {0, 0, 8, 8}, 0), dfb::InvalidArgument);
    CHECK(dfb::samplesIn(layout, {0, 0, 8, 8}, 2)->at(0).count == 2);
    CHECK(dfb::samplesIn(layout, {0, 0, 8, 8}, 2)->at(1).count == 0);

    constexpr double notANumber = std::numeric_limits<double>::quiet_NaN();
    const std::vector<dfb::SamplingConfig> wrongs{
        {0.1, 1, 16, 4}, {0.1, 8, 7, 4}, {0.1, 8, 16, 0}, {-0.1, 8, 16, 4}, {notANumber, 8, 16, 4}};
    for (const dfb::SamplingConfig& wrong : wrongs)
        CHECK_THROWS_AS(dfb::AdaptiveSampler(layout, wrong), dfb::InvalidArgument);
    CHECK_NOTHROW(dfb::AdaptiveSampler(layout, {0.1, 2, 2, 1}));
}
