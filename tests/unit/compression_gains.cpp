// CompressionGains: who does not gain is left alone, and asked again more and more seldom.
#include "catch.hpp"

#include <dfb/comm/compression.hpp>

#include <vector>

namespace compression_gains_cases {

namespace {

// In which of so many frames rank 1 of 2 is worthwhile, if messages of 1000 bytes to it become `sent(frame)`.
template <class Sent>
std::vector<int> triedIn(int frames, const Sent& sent)
{
    dfb::detail::CompressionGains gains(2);
    std::vector<int> tried;
    for (int frame = 0; frame < frames; ++frame) {
        CHECK(gains.isWorthwhile(0)); // who is not sent anything
        if (gains.isWorthwhile(1)) {
            tried.push_back(frame);
            gains.add(1, 600, static_cast<std::size_t>(sent(frame)) - 400);
            gains.add(1, 400, 400); // nothing gained with this one
            CHECK(gains.links() == (sent(frame) < 1000));
        }
        gains.endFrame();
        CHECK(gains.links() == 0);
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
    CHECK(std::vector<int>(tried.begin(), tried.begin() + 4) == std::vector<int>{0, 17, 50, 115});
    CHECK(tried[8] - tried[7] == 513);
    CHECK(tried.size() < 12);
}

TEST_CASE("A rank that begins to gain is compressed for again, if it is worth it", "[compression]")
{
    CHECK(triedIn(1000, [](int frame) { return frame < 10 ? 1000 : 500; }).size() == 1000 - 16);
    // Between giving up and coming back there is some room.
    CHECK(triedIn(1000, [](int frame) { return frame < 10 ? 1000 : 930; }).size() < 12);
}

} // namespace compression_gains_cases
