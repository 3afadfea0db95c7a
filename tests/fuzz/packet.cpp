// readPacket: the messages that it visits lie in the packet, in order and without overlap, and make the same packet
// again.
#include "fuzz.hpp"

#include <dfb/comm/packet.hpp>

#include <memory>

namespace {

using dfb::detail::packetBytes;
using dfb::detail::PacketRecord;
using dfb::detail::PacketWriter;
using dfb::detail::readPacket;

struct Item {
    PacketRecord record;
    std::string payload;
};

bool read(const std::string& packet, std::vector<Item>& items)
{
    const dfb::Buffer block = fuzz::ExactBlocks::copyOf(packet);
    const std::byte *begin = block.data(), *end = begin + packet.size(), *last = begin;
    return readPacket(begin, packet.size(), [&](const PacketRecord& record, const std::byte* payload) {
        const bool isHere = record.kind == PacketRecord::Message || record.kind == PacketRecord::Failure;
        fuzz::require(isHere == (payload != nullptr), "a message that is elsewhere has no payload");
        fuzz::require(record.kind <= PacketRecord::Failure && (isHere || (record.tag > 0 && record.byteCount > 0)),
                      "a record says what can be");
        if (isHere) {
            fuzz::require(payload >= last + sizeof record && payload <= end
                              && record.byteCount <= static_cast<std::uint64_t>(end - payload),
                          "a payload lies in the packet, behind the one before");
            last = payload + record.byteCount;
        }
        items.push_back({record, isHere ? fuzz::textOf(payload, record.byteCount) : std::string()});
    });
}

std::string packetOf(const std::vector<Item>& items)
{
    static const auto pool = dfb::MemoryPool::create(false);
    PacketWriter writer(pool);
    for (const Item& item : items) {
        fuzz::require(writer.hasRoom(item.payload.size()), "what was in a packet has room in one");
        writer.add(item.record, fuzz::bytesOf(item.payload), item.payload.size());
    }
    const dfb::Buffer packet = writer.take();
    return fuzz::textOf(packet.data(), packet.size());
}

} // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size)
{
    const std::string packet(reinterpret_cast<const char*>(data), std::min(size, packetBytes));
    std::vector<Item> items, again;
    if (!read(packet, items))
        return 0;
    fuzz::require(items.empty() == packet.empty(), "only an empty packet has nothing in it");
    if (items.empty())
        return 0;
    const std::string second = packetOf(items);
    fuzz::require(second.size() == packet.size(), "a packet is as long again");
    fuzz::require(read(second, again) && again.size() == items.size(), "a packet comes back");
    for (std::size_t i = 0; i < items.size(); ++i)
        fuzz::require(std::memcmp(&items[i].record, &again[i].record, sizeof(PacketRecord)) == 0
                          && items[i].payload == again[i].payload,
                      "its records come back");
    return 0;
}

std::vector<std::pair<std::string, std::string>> fuzz::seeds()
{
    const auto message = [](std::size_t count) {
        return Item{{count, 0, PacketRecord::Message}, std::string(count, 'm')};
    };
    const Item announced{{70000, 3, PacketRecord::Announcement}, ""}, lent{{4096, 17, PacketRecord::Lent}, ""},
        failure{{5, 0, PacketRecord::Failure}, "alas!"};
    return {{"messages", packetOf({message(0), message(1), message(16), message(17)})},
            {"large_message", packetOf({message(200), announced})},
            {"elsewhere", packetOf({announced, lent, message(3)})},
            {"failure", packetOf({failure})},
            {"goodbye", ""}};
}
