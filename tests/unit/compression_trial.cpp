// CompressionTrial: the better of two ways is found and kept, whatever the noise, and again when things change.
#include "catch.hpp"

#include <dfb/comm/compression.hpp>

#include <algorithm>
#include <random>
#include <vector>

namespace compression_trial_cases {

using dfb::detail::CompressionTrial;

namespace {

// How many of `frames` frames were compressed, and the time of them all. `time(compressed, frame)`: of one.
struct Run {
    int compressed = 0, chosenAfter = -1;
    double total = 0;
};
template <class Time>
Run run(CompressionTrial& trial, int frames, const Time& time)
{
    Run result;
    for (int frame = 0; frame < frames; ++frame) {
        if (trial.isChosen() && result.chosenAfter < 0)
            result.chosenAfter = frame;
        const bool compressed = trial.compresses();
        const double t = time(compressed, frame);
        result.compressed += compressed;
        result.total += t;
        trial.took(t);
    }
    return result;
}

} // namespace

TEST_CASE("The faster way is found within ten frames and kept", "[compression]")
{
    for (const bool with : {false, true}) {
        CompressionTrial trial;
        const Run r = run(trial, 1000, [&](bool compressed, int) { return compressed == with ? 1.0 : 2.0; });
        CHECK(r.chosenAfter == 10);
        CHECK(trial.compresses() == with);
        CHECK(r.total < 1.02 * 1000);
    }
}

TEST_CASE("Where both are alike nothing is compressed", "[compression]")
{
    CompressionTrial trial;
    const Run r = run(trial, 1000, [](bool, int) { return 3.0; });
    CHECK(r.compressed < 30);
}

TEST_CASE("Noise and slow frames do not turn it round", "[compression]")
{
    for (unsigned seed = 1; seed <= 20; ++seed) {
        std::mt19937 random(seed);
        const auto noise = [&] { // up to a tenth, and one frame in twenty three times as long
            return (1 + 0.1 * static_cast<double>(random() % 1000) / 1000) * (random() % 20 == 0 ? 3 : 1);
        };
        for (const bool with : {false, true}) {
            CompressionTrial trial;
            run(trial, 100, [&](bool compressed, int) { return (compressed == with ? 1.0 : 1.5) * noise(); });
            const Run r =
                run(trial, 900, [&](bool compressed, int) { return compressed == with ? noise() : 1.5 * noise(); });
            INFO("seed " << seed << ", with " << with);
            const int right = with ? r.compressed : 900 - r.compressed;
            CHECK(right > 800);
        }
    }
}

TEST_CASE("When the network becomes slow, or fast again, it is noticed soon", "[compression]")
{
    CompressionTrial trial;
    const auto fast = [](bool compressed, int) { return compressed ? 2.0 : 1.0; };
    const auto slow = [](bool compressed, int) { return compressed ? 6.0 : 10.0; };
    run(trial, 3000, fast);
    CHECK_FALSE(trial.compresses());
    CHECK(run(trial, 50, slow).compressed > 30);
    CHECK(trial.compresses());
    run(trial, 3000, slow);
    CHECK(run(trial, 50, fast).compressed < 20);
    CHECK_FALSE(trial.compresses());
    // If nothing else changes than which is better, at the next trial.
    CHECK(run(trial, 2000, [](bool compressed, int) { return compressed ? 0.7 : 1.0; }).compressed > 1000);
}

TEST_CASE("Who is told the same chooses the same", "[compression]")
{
    CompressionTrial a, b;
    std::mt19937 random(3);
    for (int frame = 0; frame < 5000; ++frame) {
        REQUIRE(a.compresses() == b.compresses());
        const double time = static_cast<double>(random() % 100 + 1);
        a.took(time);
        b.took(time);
    }
}

} // namespace compression_trial_cases
