// MessageHeader: what every message starts with, so that it is recognised before it is used.
#pragma once

#include <dfb/buffer.hpp>
#include <dfb/error.hpp>

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>
#include <type_traits>
#include <utility>

namespace dfb::detail {

enum class MessageKind : std::uint8_t {
    ReduceUp,      // a partial result of a reduction
    ReduceDown,    // its result
    Fragment,      // an input of a tile, to its owner
    Manifest,      // what a rank will send to this owner
    ManifestAck,   // the owner has it
    FinishedTiles, // a batch, to the display rank
    TilesDone,     // how many finished tiles a rank has for the display rank, and which it has put into the image
    Abort,         // the frame has failed on the sender
    CreditRequest, // the sender has more for this rank than it may send
    Credit,        // how much the receiver of this may send
    JobRequest,    // the sender has nothing more to render, to the rank that hands jobs out
    Jobs,          // a range of them
    ImagePlace,    // where in shared memory the image of the display rank lies
    Failure,       // the sender's connection can not go on, nor can anybody who waits for it
    AreYouThere,   // to be answered at once with the next
    Present,       // the sender is there, and answers whenever it is asked
    Hidden         // from which generation on inputs of a tile can not be seen
};

struct MessageHeader {
    static constexpr std::uint16_t magicNumber = 0x0dfb, magicSwapped = 0xfb0d;
    static constexpr std::uint8_t formatVersion = 8;

    std::uint16_t magic = magicNumber; // in the sender's byte order
    std::uint8_t version = formatVersion;
    MessageKind kind = MessageKind::Fragment;
    std::uint32_t receiver = 0; // address of the receiving object
    std::int64_t number = 0;    // of the frame; of the reduction
    std::uint32_t sequence = 0; // running, per sender and destination; set by the connection, as is the next
    std::uint32_t checksum = 0; // CRC-32C of the message with 0 in this place; 0: there is none
};
static_assert(sizeof(MessageHeader) == 24 && std::is_trivially_copyable_v<MessageHeader>);

template <class T>
T loadAs(const std::byte* bytes)
{
    static_assert(std::is_trivially_copyable_v<T>);
    T value;
    std::memcpy(&value, bytes, sizeof value);
    return value;
}

[[noreturn]] inline void failMalformed(std::string message, std::int64_t expected = -1, std::int64_t got = -1)
{
    ErrorInfo info;
    info.kind = ErrorKind::MalformedMessage;
    info.expected = expected;
    info.got = got;
    info.message = std::move(message);
    throw Error(std::move(info));
}

// What a message has after its header, if that is a Body and nothing else. Throws Error (MalformedMessage).
template <class Body>
Body bodyOf(const Buffer& message)
{
    if (message.size() != sizeof(MessageHeader) + sizeof(Body))
        failMalformed("wrong message size", sizeof(MessageHeader) + sizeof(Body),
                      static_cast<std::int64_t>(message.size()));
    return loadAs<Body>(message.data() + sizeof(MessageHeader));
}

// Checks and returns the header of a message. Throws Error (MalformedMessage).
inline MessageHeader readMessageHeader(const Buffer& message)
{
    if (message.size() < sizeof(MessageHeader))
        failMalformed("shorter than a header", sizeof(MessageHeader), static_cast<std::int64_t>(message.size()));
    const auto header = loadAs<MessageHeader>(message.data());
    if (header.magic == MessageHeader::magicSwapped)
        failMalformed("the sender has another byte order");
    if (header.magic != MessageHeader::magicNumber)
        failMalformed("not a message of dfb");
    if (header.version != MessageHeader::formatVersion)
        failMalformed("the sender was built with another version of dfb, or of its wire format",
                      MessageHeader::formatVersion, header.version);
    if (header.kind > MessageKind::Hidden)
        failMalformed("unknown kind of message", -1, static_cast<std::int64_t>(header.kind));
    return header;
}

// A message of `byteCount` bytes after the header.
inline Buffer makeMessage(MemoryPool& pool, const MessageHeader& header, const std::byte* body, std::size_t byteCount)
{
    Buffer message = pool.acquire(sizeof header + byteCount);
    std::memcpy(message.data(), &header, sizeof header);
    if (byteCount > 0)
        std::memcpy(message.data() + sizeof header, body, byteCount);
    return message;
}

} // namespace dfb::detail
