// Messages as bytes. Every message starts with a MessageHeader, which is checked before the message is used, and has
// its checksum. SmallBytes: the body of a small control message, such as a manifest or a verdict, written field by
// field. ByteReader reads it, and never reads beyond its end.
#pragma once

#include <dfb/buffer.hpp>
#include <dfb/error.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__ARM_FEATURE_CRC32) && !defined(__ARM_BIG_ENDIAN)
#include <arm_acle.h>
#endif

// crc32c: the checksum of messages, CRC-32C (Castagnoli) as in iSCSI (RFC 3720). It finds all errors of up to three
// bits in messages of up to 256 MiB, and all errors whose wrong bits lie within 32 bits.

DFB_NAMESPACE_BEGIN
namespace detail {

using Crc32cTables = std::array<std::array<std::uint32_t, 256>, 8>;

// [k][b]: what byte b adds to the sum when k more bytes follow.
constexpr Crc32cTables makeCrc32cTables()
{
    Crc32cTables tables{};
    for (std::uint32_t b = 0; b < 256; ++b) {
        std::uint32_t sum = b;
        for (int bit = 0; bit < 8; ++bit)
            sum = (sum >> 1) ^ ((sum & 1) != 0 ? 0x82f63b78u : 0); // the polynomial, bit-reversed
        tables[0][b] = sum;
    }
    for (std::size_t k = 1; k < tables.size(); ++k)
        for (std::size_t b = 0; b < 256; ++b)
            tables[k][b] = (tables[k - 1][b] >> 8) ^ tables[0][tables[k - 1][b] & 255];
    return tables;
}

inline constexpr Crc32cTables crc32cTables = makeCrc32cTables();

// For any processor, eight bytes at a time.
inline std::uint32_t crc32cByTable(const std::byte* data, std::size_t byteCount, std::uint32_t before)
{
    const auto& t = crc32cTables;
    const auto byte = [&data](int i) { return std::to_integer<std::uint32_t>(data[i]); };
    std::uint32_t sum = ~before;
    for (; byteCount >= 8; byteCount -= 8, data += 8)
        sum = t[7][(sum & 255) ^ byte(0)] ^ t[6][(sum >> 8 & 255) ^ byte(1)] ^ t[5][(sum >> 16 & 255) ^ byte(2)]
              ^ t[4][(sum >> 24) ^ byte(3)] ^ t[3][byte(4)] ^ t[2][byte(5)] ^ t[1][byte(6)] ^ t[0][byte(7)];
    for (; byteCount > 0; --byteCount, ++data)
        sum = (sum >> 8) ^ t[0][(sum & 255) ^ byte(0)];
    return ~sum;
}

using Crc32cFunction = std::uint32_t (*)(const std::byte*, std::size_t, std::uint32_t);

// Uses the processor's instruction, where there is one.
#if defined(__x86_64__)
__attribute__((target("sse4.2"))) inline std::uint32_t crc32cByInstruction(const std::byte* data, std::size_t byteCount,
                                                                           std::uint32_t before)
{
    std::uint64_t sum = ~before, word = 0;
    for (; byteCount >= 8; byteCount -= 8, data += 8) {
        std::memcpy(&word, data, 8);
        sum = __builtin_ia32_crc32di(sum, word); // <nmmintrin.h> would take long to compile
    }
    return crc32cByTable(data, byteCount, ~static_cast<std::uint32_t>(sum));
}
inline Crc32cFunction fastestCrc32c() { return __builtin_cpu_supports("sse4.2") ? crc32cByInstruction : crc32cByTable; }
#elif defined(__ARM_FEATURE_CRC32) && !defined(__ARM_BIG_ENDIAN)
inline std::uint32_t crc32cByInstruction(const std::byte* data, std::size_t byteCount, std::uint32_t before)
{
    std::uint64_t word = 0;
    std::uint32_t sum = ~before;
    for (; byteCount >= 8; byteCount -= 8, data += 8) {
        std::memcpy(&word, data, 8);
        sum = __crc32cd(sum, word);
    }
    return crc32cByTable(data, byteCount, ~sum);
}
inline Crc32cFunction fastestCrc32c() { return crc32cByInstruction; }
#else
inline Crc32cFunction fastestCrc32c() { return crc32cByTable; }
#endif

} // namespace detail

// Returns the checksum of `byteCount` bytes. If data comes in pieces, `before` is the checksum of the pieces before.
// Any thread. On a server processor it takes about 11 GB/s with the instruction and 3 GB/s without; memcpy has 25 to
// 100 GB/s there.
inline std::uint32_t crc32c(const std::byte* data, std::size_t byteCount, std::uint32_t before = 0)
{
    static const detail::Crc32cFunction fastest = detail::fastestCrc32c();
    return fastest(data, byteCount, before);
}

namespace detail {

enum class MessageKind : std::uint8_t {
    ReduceUp,      // a partial result of a reduction
    ReduceDown,    // the result of a reduction
    Fragment,      // an input of a tile, to its owner
    Manifest,      // which inputs the sender will send to this owner
    ManifestAck,   // the owner has the manifest
    FinishedTiles, // a batch of them, to the display rank
    TilesDone,     // how many finished tiles a rank has for the display rank, and which it has put into the image
    Abort,         // the frame has failed on the sender
    CreditRequest, // the sender has more for this rank than it may send
    Credit,        // how much the receiver of this message may send
    JobRequest,    // to the rank that hands out jobs: the sender has nothing more to render
    Jobs,          // a range of jobs
    ImagePlace,    // where in shared memory the image of the display rank lies
    Failure,       // the sender's connection cannot go on, nor can ranks that wait for it
    Ping,          // to be answered at once with a Pong
    Pong,          // the sender is there, and answers whenever it is asked
    Hidden,        // from which generation on inputs of a tile cannot be seen
    TileLost,      // the sender's renderer has failed in a tile of this owner, in a frame that may be partial
    Leaving,       // the sender destroys its object, and takes part in nothing that begins from now on
    End            // no kind
};

struct MessageHeader {
    static constexpr std::uint16_t magicNumber = 0x0dfb, magicSwapped = 0xfb0d;
    static constexpr std::uint8_t formatVersion = 15; // raise it when a header, a body or the meaning of a kind changes

    std::uint16_t magic = magicNumber; // in the sender's byte order
    std::uint8_t version = formatVersion;
    MessageKind kind = MessageKind::Fragment;
    std::uint32_t receiver = 0; // address of the receiving object
    std::int64_t number = 0;    // of the frame, or of the reduction
    std::uint32_t sequence = 0; // running number per sender and destination; set by the connection
    std::uint32_t checksum = 0; // set by the connection: CRC-32C of the message with 0 in this place; 0: none

    static MessageHeader of(MessageKind kind, std::uint32_t receiver = 0, std::int64_t number = 0)
    {
        return {magicNumber, formatVersion, kind, receiver, number, 0, 0};
    }
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

// Whether a message says that its sender lives, or why it cannot go on. Such a message must not wait behind pixels: on
// a slow network the receiver would take its sender for dead.
inline bool isUrgent(const Buffer& message)
{
    if (message.size() < sizeof(MessageHeader))
        return false;
    const auto header = loadAs<MessageHeader>(message.data());
    return header.magic == MessageHeader::magicNumber
           && (header.kind == MessageKind::Ping || header.kind == MessageKind::Pong
               || header.kind == MessageKind::Failure);
}

// Writes values one after the other; returns where the last ends.
template <class... Values>
std::byte* storeAll(std::byte* to, const Values&... values)
{
    static_assert((std::is_trivially_copyable_v<Values> && ...));
    ((std::memcpy(to, &values, sizeof values), to += sizeof values), ...);
    return to;
}

// Returns the body of a message that has a header, one Body, and nothing else. Throws Error (MalformedMessage)
// otherwise.
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
    if (header.kind >= MessageKind::End)
        failMalformed("unknown kind of message", -1, static_cast<std::int64_t>(header.kind));
    return header;
}

// A message that has come, with its header, and the rank that sent it.
struct Arrival {
    int source;
    MessageHeader header;
    Buffer message;
};

// The bytes of a control message, written one field after the other. A message of usual size needs no memory from the
// heap.
class SmallBytes {
public:
    SmallBytes() = default;
    [[gnu::noinline]] SmallBytes(const SmallBytes&) = default; // not inlined: these are called in many places
    [[gnu::noinline]] SmallBytes(SmallBytes&&) = default;
    [[gnu::noinline]] SmallBytes& operator=(const SmallBytes&) = default;
    [[gnu::noinline]] SmallBytes& operator=(SmallBytes&&) = default;
    [[gnu::noinline]] ~SmallBytes() = default;
    SmallBytes(const std::byte* first, const std::byte* last) { append(first, last); }

    template <class T>
    void put(const T& value)
    {
        static_assert(std::is_trivially_copyable_v<T>);
        const auto* first = reinterpret_cast<const std::byte*>(&value);
        append(first, first + sizeof value);
    }
    void putText(const std::string& text)
    {
        put(static_cast<std::uint32_t>(text.size()));
        const auto* first = reinterpret_cast<const std::byte*>(text.data());
        append(first, first + text.size());
    }

    std::size_t size() const noexcept { return many_.empty() ? fewCount_ : many_.size(); }
    bool empty() const noexcept { return size() == 0; }
    std::byte* data() noexcept { return many_.empty() ? few_.data() : many_.data(); }
    const std::byte* data() const noexcept { return many_.empty() ? few_.data() : many_.data(); }
    const std::byte* begin() const noexcept { return data(); }
    const std::byte* end() const noexcept { return data() + size(); }

    void clear() noexcept
    {
        fewCount_ = 0;
        many_.clear();
    }
    // The bytes must not be its own.
    void append(const std::byte* first, const std::byte* last)
    {
        const auto count = static_cast<std::size_t>(last - first);
        if (many_.empty() && count <= most - fewCount_) {
            std::copy(first, last, few_.data() + fewCount_);
            fewCount_ += count;
            return;
        }
        if (many_.empty())
            many_.assign(few_.data(), few_.data() + fewCount_);
        many_.insert(many_.end(), first, last);
    }

private:
    static constexpr std::size_t most = 256; // more than a verdict without an error or figures has

    std::size_t fewCount_ = 0;
    std::array<std::byte, most> few_{};
    std::vector<std::byte> many_; // all bytes, if there are more than `most`
};

inline Buffer makeMessage(MemoryPool& pool, const MessageHeader& header, const SmallBytes& body = {})
{
    Buffer message = pool.acquire(sizeof header + body.size());
    std::copy(body.begin(), body.end(), storeAll(message.data(), header));
    return message;
}

class ByteReader {
public:
    ByteReader(const std::byte* data, std::size_t size) : next_(data), left_(size) {}
    explicit ByteReader(const SmallBytes& bytes) : ByteReader(bytes.data(), bytes.size()) {}

    // Throws Error (MalformedMessage) when fewer bytes are left.
    template <class T>
    T get()
    {
        return loadAs<T>(take(sizeof(T)));
    }
    std::string getText()
    {
        const auto length = get<std::uint32_t>();
        const auto* first = reinterpret_cast<const char*>(take(length));
        return std::string(first, length);
    }
    void getBytes(std::byte* to, std::size_t count)
    {
        const std::byte* from = take(count);
        std::copy(from, from + count, to);
    }
    // Appends all bytes that are left to `out`.
    void copyTo(SmallBytes& out) const { out.append(next_, next_ + left_); }
    // Throws Error (MalformedMessage) when bytes are left.
    void end() const
    {
        if (left_ > 0)
            failMalformed("a control message is too long", 0, static_cast<std::int64_t>(left_));
    }
    // Throws Error (MalformedMessage) unless the value read is a possible one.
    void require(bool canBe) const
    {
        if (!canBe)
            failMalformed("a control message says what cannot be", 0, static_cast<std::int64_t>(left_));
    }
    std::size_t left() const noexcept { return left_; }

private:
    const std::byte* take(std::size_t count)
    {
        if (count > left_)
            failMalformed("a control message is too short", static_cast<std::int64_t>(count),
                          static_cast<std::int64_t>(left_));
        const std::byte* first = next_;
        next_ += count;
        left_ -= count;
        return first;
    }

    const std::byte* next_;
    std::size_t left_;
};

inline void put(SmallBytes& out, const ErrorInfo& e)
{
    out.put(e.kind);
    out.put(static_cast<std::int32_t>(e.rank));
    out.put(static_cast<std::int32_t>(e.from));
    for (std::int64_t v : {e.frame, e.tile, e.pass, e.generation, e.source, e.expected, e.got})
        out.put(v);
    out.putText(e.message);
}

inline ErrorInfo getErrorInfo(ByteReader& in)
{
    ErrorInfo e;
    e.kind = in.get<ErrorKind>();
    in.require(e.kind <= ErrorKind::MissingInput);
    e.rank = in.get<std::int32_t>();
    e.from = in.get<std::int32_t>();
    for (std::int64_t* v : {&e.frame, &e.tile, &e.pass, &e.generation, &e.source, &e.expected, &e.got})
        *v = in.get<std::int64_t>();
    e.message = in.getText();
    return e;
}

} // namespace detail
DFB_NAMESPACE_END
