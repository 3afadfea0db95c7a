// Compression: a rank for which compression gains nothing is skipped, and tried again more and more rarely.
#include "catch.hpp"

#include <dfb/comm/compression.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <random>
#include <vector>

namespace compression_cases {

namespace {

// No test compresses with it.
struct NoCodec final : dfb::Codec {
    std::uint8_t id() const noexcept override { return 1; }
    std::size_t bound(std::size_t byteCount) const override { return byteCount; }
    std::size_t compress(const std::byte*, std::size_t byteCount, std::byte*) const override { return byteCount; }
    bool decompress(const std::byte*, std::size_t, std::byte*, std::size_t) const override { return false; }
};

// The frames, of `frames`, in which compression for rank 1 of 2 is tried, if 1000 bytes to it become `sent(frame)`.
template <class Sent>
std::vector<int> triedIn(int frames, const Sent& sent)
{
    dfb::detail::Compression compression(std::make_shared<NoCodec>(), dfb::CompressionMode::Auto, 2);
    std::vector<int> tried;
    for (int frame = 0; frame < frames; ++frame) {
        CHECK(compression.isWorthwhile(0)); // nothing is sent to it
        if (compression.isWorthwhile(1)) {
            tried.push_back(frame);
            compression.sent(1, 600, static_cast<std::size_t>(sent(frame)) - 400);
            compression.sent(1, 400, 400); // nothing gained with this one
            CHECK(compression.links() == (sent(frame) < 1000));
        }
        compression.endFrame(1);
        CHECK(compression.links() == 0);
    }
    return tried;
}

} // namespace

TEST_CASE("Compression for a rank that gains goes on", "[compression]")
{
    CHECK(triedIn(500, [](int) { return 940; }).size() == 500); // no more than a little
}

TEST_CASE("Compression for a rank that gains nothing is tried more and more seldom", "[compression]")
{
    const std::vector<int> tried = triedIn(3000, [](int) { return 1000; });
    REQUIRE(tried.size() > 8);
    CHECK(std::vector<int>(tried.begin(), tried.begin() + 5) == std::vector<int>{0, 17, 50, 115, 180});
    CHECK(tried.size() < 50); // once in 65 frames
}

TEST_CASE("A rank that begins to gain is compressed for again, if it is worth it", "[compression]")
{
    CHECK(triedIn(1000, [](int frame) { return frame < 10 ? 1000 : 500; }).size() == 1000 - 16);
    // There is a margin between giving up and coming back.
    CHECK(triedIn(1000, [](int frame) { return frame < 10 ? 1000 : 930; }).size() < 20);
}

} // namespace compression_cases

// CompressionTrial: finds the better of two ways and keeps it, whatever the noise, and finds it anew when things
// change.
namespace compression_trial_cases {

using dfb::detail::CompressionTrial;

namespace {

// The number of compressed frames, and the time of all frames. `time(compressed, frame)` is the time of one frame.
struct Run {
    int compressed = 0;
    double total = 0;
};
template <class Time>
Run run(CompressionTrial& trial, int frames, const Time& time)
{
    Run result;
    for (int frame = 0; frame < frames; ++frame) {
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
        int slowAfterTen = 0; // before the slower way is tried again
        const Run r = run(trial, 1000, [&](bool compressed, int frame) {
            slowAfterTen += frame >= 10 && frame < 42 && compressed != with;
            return compressed == with ? 1.0 : 2.0;
        });
        CHECK(slowAfterTen == 0);
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

TEST_CASE("Frames whose times vary much cost few trials", "[compression]")
{
    double total = 0;
    for (unsigned seed = 1; seed <= 50; ++seed) {
        std::mt19937 random(seed);
        CompressionTrial trial;
        // Half of the frames take 1.5 times the median or more, or less than 2/3 of it.
        const auto jitter = [&] { return std::exp(1.2 * (static_cast<double>(random() % 1001) / 1000 - 0.5)); };
        const Run r = run(trial, 1000, [&](bool compressed, int) { return (compressed ? 1.0 : 4.0) * jitter(); });
        total += (r.compressed + 4.0 * (1000 - r.compressed)) / 1000; // 1: never the wrong way
    }
    CHECK(total / 50 < 1.1);
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
    // If only the better way changes, this is noticed at the next trial.
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
