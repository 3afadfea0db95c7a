// FragmentCompositor: rows of fragments in order equal a fold of each pixel by itself.
#include "brief.hpp"
#include "catch.hpp"

#include <dfb/blend/fragment_compositor.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <random>
#include <vector>

namespace fragment_compositor_cases {

namespace {

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr int width = 290, height = 12;

// The pixels of a fragment, in spans of about `span` pixels.
struct Pixels {
    std::vector<float> colors = std::vector<float>(4 * width * height), depths = std::vector<float>(width * height);

    Pixels(std::mt19937& random, unsigned span, bool isOpaque)
    {
        bool isThere = false;
        for (std::size_t i = 0; i < depths.size(); ++i) {
            if (random() % span == 0)
                isThere = !isThere;
            const float alpha = isOpaque ? 1.0f : static_cast<float>(random() % 1000) / 1000.0f;
            for (std::size_t c = 0; c < 4 && isThere; ++c)
                colors[4 * i + c] = c == 3 ? alpha : static_cast<float>(random() % 1000) / 999.0f;
            depths[i] = static_cast<float>(random() % 9);
        }
    }

    dfb::Fragment fragment(bool hasDepth, const dfb::Region& valid = {0, 0, width, height},
                           dfb::detail::FaultCounts* faults = nullptr) const
    {
        dfb::TileHeader header;
        header.region = {0, 0, width, height};
        dfb::Fragment::Parts parts;
        parts.encoding = dfb::FragmentEncoding::InPlace;
        parts.channels = hasDepth ? dfb::colorChannel | dfb::depthChannel : dfb::colorChannel;
        parts.inPlace.color = reinterpret_cast<const std::byte*>(colors.data());
        parts.inPlace.depth = hasDepth ? depths.data() : nullptr;
        parts.inPlace.stride = width;
        parts.inPlace.valid = valid;
        parts.faults = faults;
        return dfb::Fragment(header, dfb::Buffer(), parts);
    }
    bool isActive(std::size_t pixel) const
    {
        return std::any_of(&colors[4 * pixel], &colors[4 * pixel] + 4, [](float value) { return value != 0; });
    }
};

struct Folded {
    double rgba[4] = {0, 0, 0, 0}, transmittance = 1;
    float depth = infinity;
    int layers = 0;
};

// Folds a pixel of inputs that are ordered front to back.
Folded fold(const std::vector<const Pixels*>& inputs, std::size_t pixel, double minTransmittance)
{
    Folded result;
    for (const Pixels* input : inputs) {
        if (!input->isActive(pixel))
            continue;
        ++result.layers;
        const float* color = &input->colors[4 * pixel];
        for (int c = 0; c < 4; ++c)
            result.rgba[c] += result.transmittance * static_cast<double>(color[c]);
        result.transmittance *= 1.0 - static_cast<double>(color[3]);
        if (minTransmittance > 0 && result.transmittance < minTransmittance)
            result.transmittance = 0;
        if (color[3] > 0)
            result.depth = std::min(result.depth, input->depths[pixel]);
    }
    return result;
}

std::vector<const Pixels*> inOrder(const std::vector<Pixels>& inputs)
{
    std::vector<const Pixels*> all;
    for (const Pixels& input : inputs)
        all.push_back(&input);
    return all;
}

// The inputs sorted by their depth at a pixel. NaN counts as farthest.
std::vector<const Pixels*> sorted(const std::vector<Pixels>& inputs, std::size_t pixel)
{
    const auto depthOf = [=](const Pixels* input) {
        return std::isnan(input->depths[pixel]) ? infinity : input->depths[pixel];
    };
    std::vector<const Pixels*> all = inOrder(inputs);
    std::stable_sort(all.begin(), all.end(), [&](const Pixels* a, const Pixels* b) { return depthOf(a) < depthOf(b); });
    return all;
}

// A compositor of inputs that all have the same bounds, except the second one, and a row for it.
struct Stack {
    dfb::detail::FaultCounts faults;
    std::vector<dfb::Fragment> fragments;
    dfb::FragmentCompositor compositor;
    dfb::CompositeRow row;

    Stack(const std::vector<Pixels>& inputs, bool isSorted, bool hasDepth, const dfb::Region& valid,
          const dfb::Region& validOfSecond, double minTransmittance)
    {
        std::vector<const dfb::Fragment*> pointers;
        for (std::size_t k = 0; k < inputs.size(); ++k)
            fragments.push_back(inputs[k].fragment(hasDepth, k == 1 ? validOfSecond : valid, &faults));
        for (const dfb::Fragment& fragment : fragments)
            pointers.push_back(&fragment);
        compositor.start(isSorted ? dfb::BlendRule::SortByDepth : dfb::BlendRule::InOrder, pointers.begin(),
                         pointers.end());
        row.wantsDepth = row.wantsGaps = false;
        row.minTransmittance = minTransmittance;
        row.resize(width);
    }
    void checkFaults(std::uint64_t nonFinite, std::uint64_t alphaOutside) const
    {
        CHECK(static_cast<std::uint64_t>(faults.nonFinite) == nonFinite);
        CHECK(static_cast<std::uint64_t>(faults.alphaOutside) == alphaOutside);
    }
    // Checks pixel x of the row.
    void check(int x, const Folded& expected) const
    {
        const auto at = static_cast<std::size_t>(x);
        CHECK(std::equal(expected.rgba, expected.rgba + 4, &row.rgba[4 * at]));
        CHECK(expected.transmittance == row.transmittance[at]);
    }
};

} // namespace

TEST_CASE("Fragments in order are folded pixel by pixel, in long runs and in short ones", "[compositing]")
{
    std::mt19937 random(11);
    for (int round = 0; round < repeats(60); ++round) {
        const unsigned span = round % 3 == 0 ? 4 : round % 3 == 1 ? 20 : 100;
        const bool hasDepth = round % 4 == 1, wantsGaps = round % 5 < 2;
        const double least = round % 7 == 0 ? 0.05 : 0;
        std::vector<Pixels> inputs;
        std::vector<dfb::Fragment> fragments;
        std::vector<const dfb::Fragment*> pointers;
        for (int k = 0; k < 2 + round % 11; ++k)
            inputs.emplace_back(random, span, round % 6 == 5 && k == 3);
        for (const Pixels& input : inputs)
            fragments.push_back(input.fragment(hasDepth));
        for (const dfb::Fragment& fragment : fragments)
            pointers.push_back(&fragment);
        dfb::FragmentCompositor compositor;
        compositor.start(dfb::BlendRule::InOrder, pointers.begin(), pointers.end());
        dfb::CompositeRow row;
        row.wantsDepth = hasDepth;
        row.wantsGaps = wantsGaps;
        row.wantsSingles = wantsGaps;
        row.minTransmittance = least;
        row.resize(width);
        for (std::size_t y = 0; y < height; ++y) {
            compositor.nextRow(row);
            std::vector<const dfb::FragmentCompositor::Run*> runOf(width);
            int end = 0;
            for (const auto& run : compositor.runs()) {
                CHECK(run.x >= end);
                end = run.x + run.count;
                REQUIRE(end <= width);
                std::fill_n(runOf.begin() + run.x, run.count, &run);
            }
            for (std::size_t x = 0; x < width; ++x) {
                const Folded expected = fold(inOrder(inputs), y * width + x, least);
                if (expected.layers > 0)
                    REQUIRE(runOf[x]);
                if (!runOf[x] && !wantsGaps)
                    continue;
                double rgba[4];
                std::copy_n(&row.rgba[4 * x], 4, rgba);
                if (runOf[x] && runOf[x]->color) {
                    REQUIRE(expected.layers == 1);
                    std::copy_n(runOf[x]->color + 4 * (static_cast<int>(x) - runOf[x]->x), 4, rgba);
                }
                CHECK(std::equal(rgba, rgba + 4, expected.rgba)); // all bits, except that 0 equals -0
                if (hasDepth)
                    CHECK(row.depth[x] == expected.depth);
            }
        }
    }
}

// Flaws of a row of inputs that have no gaps.
enum class Flaw { None, Hole, HoleInOne, NotFinite, AlphaOutside, Crossing, NanDepth };

TEST_CASE("Rows in place without gaps are folded pixel by pixel, in order and sorted", "[compositing]")
{
    std::mt19937 random(13);
    for (int round = 0; round < repeats(400); ++round) {
        const bool isSorted = round % 2 == 1;
        const auto flaw = static_cast<Flaw>(random() % 7);
        const double least = round % 7 == 0 && flaw != Flaw::NotFinite ? 0.05 : 0;
        const int x0 = round % 3 == 0 ? 0 : 5, y0 = round % 5 == 0 ? 2 : 0;
        const int x1 = round % 13 == 12 ? x0 + 1 + round % 3 : round % 3 == 0 ? width : width - 1 - round % 40;
        const dfb::Region valid{x0, y0, x1, height};
        const dfb::Region validOfSecond{x0, y0, round % 11 == 10 ? std::max(x0 + 1, x1 - 1) : x1, height};
        const std::size_t layers = 2 + random() % (round % 20 == 0 ? 36 : 12); // also more than are blended at once
        std::vector<Pixels> inputs;
        for (std::size_t k = 0; k < layers; ++k)
            inputs.emplace_back(random, 1u << 30, false);             // without colours
        const int flawed = static_cast<int>(random() % (2 * height)); // often none
        std::uint64_t nonFinite = 0, alphaOutside = 0;
        for (std::size_t k = 0; k < layers; ++k)
            for (std::size_t i = 0; i < width * height; ++i) {
                const int x = static_cast<int>(i) % width, y = static_cast<int>(i) / width;
                const bool isFlawed = y == flawed;
                if (k == 1 && !validOfSecond.contains(x, y))
                    continue;
                for (std::size_t c = 0; c < 4; ++c)
                    inputs[k].colors[4 * i + c] = static_cast<float>(1 + random() % 900) / 1000.0f;
                // The order changes from row to row. Some depths are equal, and some are 0 beside -0.
                inputs[k].depths[i] = y % 4 == 3 ? (k % 2 ? 0.0f : -0.0f) : static_cast<float>((3 * k + y) % 11 / 2);
                if (isFlawed && (flaw == Flaw::Hole || (flaw == Flaw::HoleInOne && k == 1)) && x >= 40 && x < 120)
                    std::fill_n(&inputs[k].colors[4 * i], 4, x % 2 ? 0.0f : -0.0f);
                if (isFlawed && flaw == Flaw::Crossing && x >= 60)
                    inputs[k].depths[i] = -inputs[k].depths[i];
                const bool isHit = isFlawed && x % 50 == 7 && k == 1;
                if (isHit && flaw == Flaw::NotFinite)
                    inputs[k].colors[4 * i + random() % 3] = random() % 2 ? infinity : -infinity, ++nonFinite;
                if (isHit && flaw == Flaw::AlphaOutside)
                    inputs[k].colors[4 * i + 3] = random() % 2 ? 1.25f : -0.25f, ++alphaOutside;
                if (isHit && flaw == Flaw::NanDepth && isSorted)
                    inputs[k].depths[i] = std::numeric_limits<float>::quiet_NaN(), ++nonFinite;
            }
        std::vector<Pixels> given = inputs;
        for (int i = 0; i < width * height; ++i)
            if (!validOfSecond.contains(i % width, i / width)) // must not be read
                std::fill_n(&given[1].colors[4 * static_cast<std::size_t>(i)], 4, 0.5f);
        Stack stack(given, isSorted, isSorted, valid, validOfSecond, least);
        for (int y = 0; y < height; ++y) {
            stack.compositor.nextRow(stack.row);
            std::vector<bool> isInRun(width);
            for (const auto& run : stack.compositor.runs())
                std::fill_n(isInRun.begin() + run.x, run.count, true);
            for (int x = 0; x < width; ++x) {
                const std::size_t pixel = static_cast<std::size_t>(y * width + x);
                const bool isHole = y == flawed && flaw == Flaw::Hole && x >= 40 && x < 120;
                const bool isThere = valid.contains(x, y) && !isHole;
                const bool isAtEdge = isHole && (x < 43 || x >= 117); // four pixels are blended together
                CHECK((isInRun[static_cast<std::size_t>(x)] == isThere || isAtEdge));
                if (!isThere)
                    continue;
                const Folded expected = fold(isSorted ? sorted(inputs, pixel) : inOrder(inputs), pixel, least);
                stack.check(x, expected);
            }
        }
        stack.checkFaults(nonFinite, alphaOutside);
    }
}

TEST_CASE("Rows in place with many gaps are folded pixel by pixel, in order and sorted", "[compositing]")
{
    std::mt19937 random(17);
    for (int round = 0; round < repeats(200); ++round) {
        const bool isSorted = round % 2 == 1, hasDepth = isSorted && round % 10 != 9;
        const double least = round % 7 == 0 ? 0.05 : 0;
        const dfb::Region valid{round % 3 == 0 ? 0 : 5, 0, round % 3 == 1 ? width : width - round % 40, height};
        const std::size_t layers = 2 + random() % (round % 20 == 0 ? 36 : 8);
        std::vector<Pixels> inputs;
        for (std::size_t k = 0; k < layers; ++k)
            inputs.emplace_back(random, round % 3 == 0 ? 4 : round % 3 == 1 ? 20 : 60, false);
        // A few pixels have values that a row must not have, some of them beside a gap. They are composited in another
        // way, and counted.
        std::uint64_t nonFinite = 0, alphaOutside = 0;
        for (Pixels& input : inputs)
            for (std::size_t i = 0; i < input.depths.size(); ++i) {
                const bool isRead = valid.contains(static_cast<int>(i) % width, static_cast<int>(i) / width);
                float* const color = &input.colors[4 * i];
                if (!isRead)
                    std::fill_n(color, 4, 0.5f);
                if (!isRead || random() % 2000 != 0)
                    continue;
                if (const auto flaw = random() % 3; flaw == 0 && least == 0)
                    color[random() % 3] = random() % 2 ? infinity : -infinity, ++nonFinite;
                else if (flaw == 1)
                    color[3] = random() % 2 ? 1.25f : -0.25f, ++alphaOutside;
                else if (hasDepth)
                    nonFinite += input.isActive(i), input.depths[i] = std::numeric_limits<float>::quiet_NaN();
            }
        Stack stack(inputs, isSorted, hasDepth, valid, valid, least);
        for (int y = 0; y < height; ++y) {
            stack.compositor.nextRow(stack.row);
            std::vector<bool> isInRun(width);
            int end = -1000;
            for (const auto& run : stack.compositor.runs()) {
                CHECK(run.x > end); // a run ends at a gap
                end = run.x + run.count;
                std::fill_n(isInRun.begin() + run.x, run.count, true);
            }
            for (int x = 0; x < width; ++x) {
                const std::size_t pixel = static_cast<std::size_t>(y * width + x);
                const bool isInside = valid.contains(x, y), isThere = isInRun[static_cast<std::size_t>(x)];
                const Folded expected = fold(hasDepth ? sorted(inputs, pixel) : inOrder(inputs), pixel, least);
                if (!isInside)
                    CHECK_FALSE(isThere);
                if (isInside && expected.layers > 0)
                    REQUIRE(isThere);
                if (!isThere)
                    continue;
                stack.check(x, expected);
            }
        }
        stack.checkFaults(nonFinite, alphaOutside);
    }
}

TEST_CASE("An infinity behind what is opaque shows in place what it shows otherwise", "[compositing]")
{
    std::mt19937 random(19);
    std::vector<Pixels> inputs(2, Pixels(random, 1u << 30, false));
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x)
            for (std::size_t k = 0; k < 2; ++k) {
                const auto i = static_cast<std::size_t>(y * width + x);
                const bool isFront = (k == 0) == (x < (y % 2 ? 6 : 10)); // so rows begin with the order of another
                inputs[k].depths[i] = isFront ? 1.0f : 2.0f;
                inputs[k].colors[4 * i] = y % 2 && x == 6 && !isFront ? infinity : 0.25f;
                inputs[k].colors[4 * i + 3] = y % 2 && isFront && x >= 4 && x < 8 ? 1.0f : 0.5f;
            }
    const dfb::Region valid{0, 0, width, height};
    Stack inPlace(inputs, true, true, valid, valid, 0), copied(inputs, true, true, valid, valid, 0);
    copied.row.wantsDepth = true; // which is not found in place
    copied.row.resize(width);
    for (int y = 0; y < height; ++y) {
        inPlace.compositor.nextRow(inPlace.row);
        copied.compositor.nextRow(copied.row);
        CHECK(std::isnan(inPlace.row.rgba[4 * 6]) == std::isnan(copied.row.rgba[4 * 6]));
    }
}

} // namespace fragment_compositor_cases
