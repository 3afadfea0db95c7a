// Accumulation: with which samples a frame begins, and which plans of samples it refuses.
#include "catch.hpp"

#include <dfb/frame/accumulation.hpp>

#include <limits>
#include <memory>
#include <string>
#include <vector>

namespace accumulation_cases {

using dfb::TileSamples;
using dfb::detail::Accumulation;
using dfb::detail::OperationTraits;

namespace {

constexpr int most = std::numeric_limits<int>::max();

// A frame of an image of two tiles.
struct Case {
    std::vector<TileSamples> samples;
    bool keepsState = false, isPointwise = true;
    int framesInFlight = 1;
    bool lastFailed = false;
};

// The text of the error, or "".
std::string errorOf(const Case& c)
{
    OperationTraits traits;
    traits.keepsState = c.keepsState;
    traits.pixelOpIsPointwise = c.isPointwise;
    dfb::FrameConfig frame;
    frame.samples = std::make_shared<const std::vector<TileSamples>>(c.samples);
    try {
        Accumulation().begin(frame, traits, 2, c.framesInFlight, c.lastFailed);
        return "";
    } catch (const dfb::InvalidArgument& e) {
        return e.what();
    }
}

} // namespace

TEST_CASE("Plans of samples that a frame cannot take are refused", "[sampling]")
{
    struct Wrong {
        Case frame;
        const char* text;
    };
    const std::vector<Wrong> wrongs{{{{{0, 1}}}, "a plan of the samples of 1 tiles for an image of 2"},
                                    {{{{0, 1}, {0, -1}}}, "a tile cannot have -1 samples from 0 on"},
                                    {{{{0, 1}, {-1, 1}}}, "a tile cannot have 1 samples from -1 on"},
                                    {{{{0, 1}, {1, most}}}, "a tile cannot have 2147483647 samples from 1 on"},
                                    {{{{0, 1}, {1, 1}}}, "samples of a tile begin with 0"},
                                    {{{{0, 1}, {1, 1}}, true, true, 1, true}, "tile 1 has 1 samples from 1 on"},
                                    {{{{0, 1}, {0, 0}}, true, true, 1, true}, "tile 1 has 0 samples from 0 on"},
                                    {{{{0, 1}, {0, 0}}, false, true, 1, true}, "the last frame failed"},
                                    {{{{0, 1}, {0, 0}}, false, true, 2}, "this needs framesInFlight = 1"},
                                    {{{{0, 1}, {0, 0}}, false, false}, "the pixel operation wants all tiles"}};
    for (const Wrong& wrong : wrongs) {
        const std::string text = errorOf(wrong.frame);
        INFO(text);
        CHECK(text.find(wrong.text) != std::string::npos);
    }
    CHECK(errorOf({{{0, 1}, {0, 0}}}).empty());
    CHECK(errorOf({{{0, 1}, {0, 1}}, false, false, 2, true}).empty());
}

TEST_CASE("A frame goes on with the samples of the last one if that had its id and did not fail", "[sampling]")
{
    OperationTraits traits;
    traits.keepsState = true;
    Accumulation accumulation;
    dfb::FrameConfig frame;
    frame.passes = 3;
    frame.accumulationId = 7;
    const auto begin = [&](bool lastFailed = false) { return accumulation.begin(frame, traits, 2, 1, lastFailed); };
    CHECK(begin().firstSample == 0);
    accumulation.ended(frame, 0);
    CHECK(begin().keeps);
    CHECK(begin().firstSample == 3);
    CHECK_FALSE(begin(true).keeps);
    CHECK(begin(true).firstSample == 0);
    frame.passes = most - 2;
    CHECK_THROWS_AS(begin(), dfb::InvalidArgument);
    frame.accumulationId = 8;
    CHECK_FALSE(begin().keeps);
    CHECK(begin().firstSample == 0);
}

} // namespace accumulation_cases
