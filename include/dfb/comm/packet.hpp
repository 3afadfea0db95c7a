// Packets: several small messages to one rank travel as one message of the network. In a packet, each follows a record.
// A large message is only announced: its record says that it follows by itself, or where it lies in memory that the
// receiver sees.
#pragma once

#include <dfb/buffer.hpp>

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <utility>

DFB_NAMESPACE_BEGIN
namespace detail {

struct PacketRecord {
    enum Kind : std::uint32_t { Message, Announcement, Lent, Failure };
    std::uint64_t byteCount;
    std::int32_t tag; // the tag of an announced message; the place of a lent one
    Kind kind;
};
static_assert(sizeof(PacketRecord) == 16);

constexpr std::size_t packetBytes = 8192; // at most

// The format of packets, and of all else that transports over a network send each other. Raise it with every change:
// ranks with different formats cannot read each other's packets, and find that out before the first one.
constexpr std::uint64_t packetFormat = 3;

// The bytes of a record and its payload in a packet: records begin at multiples of 16.
constexpr std::size_t paddedRecord(std::size_t payloadBytes)
{
    return (2 * sizeof(PacketRecord) - 1 + payloadBytes) / sizeof(PacketRecord) * sizeof(PacketRecord);
}

// Fills one packet after the other.
class PacketWriter {
public:
    explicit PacketWriter(std::shared_ptr<MemoryPool> pool) : pool_(std::move(pool)) {}

    // Whether a message can travel in a packet at all, and whether the present one has room for that many bytes.
    static constexpr bool canHold(std::size_t payloadBytes) { return paddedRecord(payloadBytes) <= packetBytes; }
    bool hasRoom(std::size_t payloadBytes) const noexcept { return used_ + paddedRecord(payloadBytes) <= packetBytes; }
    bool empty() const noexcept { return used_ == 0; }

    // There must be room for it.
    void add(const PacketRecord& record, const std::byte* payload, std::size_t payloadBytes)
    {
        if (empty())
            packet_ = pool_->acquire(packetBytes);
        std::byte* to = packet_.data() + used_;
        std::memcpy(to, &record, sizeof record);
        if (payloadBytes > 0)
            std::memcpy(to + sizeof record, payload, payloadBytes);
        const std::size_t end = sizeof record + payloadBytes;
        std::memset(to + end, 0, paddedRecord(payloadBytes) - end);
        used_ += paddedRecord(payloadBytes);
    }

    // Returns the packet, and begins the next.
    Buffer take()
    {
        packet_.shrink(std::exchange(used_, 0));
        return std::move(packet_);
    }

private:
    std::shared_ptr<MemoryPool> pool_;
    Buffer packet_;
    std::size_t used_ = 0;
};

// Calls `visit(record, payload)` for each record. The payload is null if the message is elsewhere. Returns false if the
// bytes, which need not be trusted, are no packet; the records before the fault have then been visited. An empty packet
// is valid.
template <class Visit>
bool readPacket(const std::byte* from, std::size_t left, const Visit& visit)
{
    while (left > 0) {
        PacketRecord record;
        if (left < sizeof record)
            return false;
        std::memcpy(&record, from, sizeof record);
        if (record.kind > PacketRecord::Failure)
            return false;
        const bool isElsewhere = record.kind == PacketRecord::Announcement || record.kind == PacketRecord::Lent;
        if (isElsewhere ? record.tag < 1 || record.byteCount == 0 : record.byteCount > left)
            return false;
        const std::size_t end = paddedRecord(isElsewhere ? 0 : static_cast<std::size_t>(record.byteCount));
        if (end > left)
            return false;
        visit(record, isElsewhere ? nullptr : from + sizeof record);
        from += end;
        left -= end;
    }
    return true;
}

} // namespace detail
DFB_NAMESPACE_END
