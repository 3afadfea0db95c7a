// Packets: records come out as they went in, and bytes that are not a packet are refused without reading beyond them.
#include "catch.hpp"

#include <dfb/comm/packet.hpp>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>
#include <random>
#include <utility>
#include <vector>

namespace packet_cases {

namespace {

using dfb::detail::packetBytes;
using dfb::detail::PacketRecord;
using dfb::detail::PacketWriter;
using dfb::detail::readPacket;
using Bytes = std::vector<std::byte>;

struct Item {
    PacketRecord record;
    Bytes payload;
};

Bytes randomBytes(std::mt19937_64& random, std::size_t count)
{
    Bytes bytes(count);
    for (std::byte& b : bytes)
        b = std::byte(random() & 255);
    return bytes;
}

Bytes bytesOf(const dfb::Buffer& packet) { return {packet.data(), packet.data() + packet.size()}; }

// Reads the records of a packet into `items`; false if it is refused. Copies it to its exact size, for
// AddressSanitizer.
bool read(const Bytes& packet, std::vector<Item>& items)
{
    const auto exact = std::make_unique<std::byte[]>(packet.size());
    std::copy(packet.begin(), packet.end(), exact.get());
    return readPacket(exact.get(), packet.size(), [&items](const PacketRecord& record, const std::byte* payload) {
        const std::size_t count =
            record.kind == PacketRecord::Announcement ? 0 : static_cast<std::size_t>(record.byteCount);
        items.push_back({record, payload ? Bytes(payload, payload + count) : Bytes()});
    });
}

} // namespace

TEST_CASE("What goes into packets comes out of them, in order", "[packet]")
{
    std::mt19937_64 random(1);
    PacketWriter writer(dfb::MemoryPool::create());
    std::vector<Item> put, got;
    int packets = 0;
    const auto takePacket = [&] {
        const dfb::Buffer packet = writer.take();
        CHECK(packet.size() <= packetBytes);
        CHECK(writer.empty());
        CHECK(read(bytesOf(packet), got));
        ++packets;
    };
    for (int i = 0; i < 5000; ++i) {
        const bool announced = random() % 8 == 0;
        const std::size_t count = announced ? 0 : random() % (random() % 4 == 0 ? packetBytes - 15 : 200);
        Item item{{announced ? random() % 1000000 + 1 : count, announced ? static_cast<int>(random() % 100) + 1 : 0,
                   announced ? PacketRecord::Announcement : PacketRecord::Message},
                  randomBytes(random, count)};
        REQUIRE(PacketWriter::canHold(count));
        if (!writer.hasRoom(count))
            takePacket();
        REQUIRE(writer.hasRoom(count));
        writer.add(item.record, item.payload.data(), count);
        put.push_back(std::move(item));
    }
    takePacket();
    REQUIRE(got.size() == put.size());
    std::size_t wrong = 0;
    for (std::size_t i = 0; i < put.size(); ++i)
        wrong +=
            std::memcmp(&put[i].record, &got[i].record, sizeof put[i].record) != 0 || put[i].payload != got[i].payload;
    CHECK(wrong == 0);
    CHECK(packets < 1000); // the packets are filled
    CHECK(PacketWriter::canHold(packetBytes - 16));
    CHECK_FALSE(PacketWriter::canHold(packetBytes - 15));
}

TEST_CASE("Bytes that are no packet are refused, or read as something that lies within them", "[packet]")
{
    std::mt19937_64 random(2);
    PacketWriter writer(dfb::MemoryPool::create());
    for (const std::size_t count : {0, 1, 16, 17, 100}) {
        const Bytes payload = randomBytes(random, count);
        writer.add({count, 0, PacketRecord::Message}, payload.data(), count);
    }
    writer.add({70000, 3, PacketRecord::Announcement}, nullptr, 0);
    writer.add({5, 0, PacketRecord::Failure}, randomBytes(random, 5).data(), 5);
    const Bytes packet = bytesOf(writer.take());
    std::vector<Item> items;
    REQUIRE(read(packet, items));
    REQUIRE(items.size() == 7);
    REQUIRE(read({}, items));

    int refused = 0, accepted = 0;
    const auto tryBytes = [&](const Bytes& bytes) {
        items.clear();
        ++(read(bytes, items) ? accepted : refused);
        std::size_t total = 0;
        for (const Item& item : items)
            total += sizeof item.record + item.payload.size();
        CHECK(total <= bytes.size());
    };
    for (std::size_t length = 1; length < packet.size(); ++length)
        tryBytes({packet.begin(), packet.begin() + static_cast<std::ptrdiff_t>(length)});
    CHECK(accepted == 6); // after each record but the last
    for (std::size_t place = 0; place < packet.size(); ++place)
        for (int bit = 0; bit < 8; ++bit) {
            Bytes flipped = packet;
            flipped[place] ^= std::byte(1 << bit);
            tryBytes(flipped);
        }
    for (int i = 0; i < 20000; ++i)
        tryBytes(randomBytes(random, random() % 300));
    CHECK(refused > 20000);
}

} // namespace packet_cases
