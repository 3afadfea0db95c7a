// GatheredImage: the image is complete only when every rank that owns tiles has said how many it sends. Whole frames
// are in tests/frames, wrong batches in tests/fuzz/finished.cpp.
#include "catch.hpp"

#include <dfb/gather/gathered_image.hpp>

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <utility>

namespace gathered_image_cases {

using dfb::detail::GatheredImage;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;

TEST_CASE("A count of tiles from a rank that owns none does not complete the image", "[gather]")
{
    const auto pool = dfb::MemoryPool::create(false);
    const dfb::FrameBufferConfig config;
    const dfb::TileLayout layout(128, 64, 64);
    const auto ownerOf = [](int) { return 1; };
    GatheredImage display(pool, layout, config, dfb::ChannelMask{0}, 0, 3, ownerOf, nullptr);
    display.newFrame(1);
    const auto give = [&](int source, std::int32_t tiles, std::int32_t batches) {
        const std::pair body(tiles, batches);
        const auto header = MessageHeader::of(MessageKind::TilesDone, 0, 1);
        dfb::Buffer message = pool->acquire(sizeof header + sizeof body);
        std::memcpy(message.data(), &header, sizeof header);
        std::memcpy(message.data() + sizeof header, &body, sizeof body);
        display.receive(source, header, std::move(message));
    };
    CHECK_FALSE(display.complete());
    CHECK_THROWS_AS(give(2, 0, 0), dfb::Error);
    CHECK_THROWS_AS(give(0, 0, 0), dfb::Error); // the display rank sends itself nothing
    CHECK_FALSE(display.complete());
    give(1, 0, 0);
    CHECK(display.complete());
}

} // namespace gathered_image_cases
