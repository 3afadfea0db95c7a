// crc32c: the checksum of messages, CRC-32C (Castagnoli) as in iSCSI (RFC 3720). It finds all errors of up to three
// bits in messages of up to 256 MiB, and all that lie within 32 bits.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>

#if defined(__x86_64__) && defined(__GNUC__) // Clang's, too
#include <nmmintrin.h>
#elif defined(__ARM_FEATURE_CRC32) && !defined(__ARM_BIG_ENDIAN)
#include <arm_acle.h>
#endif

namespace dfb {
namespace detail {

using Crc32cTables = std::array<std::array<std::uint32_t, 256>, 8>;

// [k][b]: what byte b adds to the sum when k more bytes follow.
constexpr Crc32cTables makeCrc32cTables()
{
    Crc32cTables tables{};
    for (std::uint32_t b = 0; b < 256; ++b) {
        std::uint32_t sum = b;
        for (int bit = 0; bit < 8; ++bit)
            sum = (sum >> 1) ^ ((sum & 1) != 0 ? 0x82f63b78u : 0); // the polynomial, its highest power last
        tables[0][b] = sum;
    }
    for (std::size_t k = 1; k < tables.size(); ++k)
        for (std::size_t b = 0; b < 256; ++b)
            tables[k][b] = (tables[k - 1][b] >> 8) ^ tables[0][tables[k - 1][b] & 255];
    return tables;
}

inline constexpr Crc32cTables crc32cTables = makeCrc32cTables();

// On any processor, eight bytes at a time.
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

// With the processor's instruction, where there is one.
#if defined(__x86_64__) && defined(__GNUC__)
__attribute__((target("sse4.2"))) inline std::uint32_t crc32cByInstruction(const std::byte* data, std::size_t byteCount,
                                                                           std::uint32_t before)
{
    std::uint64_t sum = ~before, word = 0;
    for (; byteCount >= 8; byteCount -= 8, data += 8) {
        std::memcpy(&word, data, 8);
        sum = _mm_crc32_u64(sum, word);
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

// The checksum of `byteCount` bytes; of bytes that come in pieces, with that of the pieces `before`. From any thread.
// On a server processor about 11 GB/s with the instruction and 3 GB/s without, where memcpy has 25 to 100.
inline std::uint32_t crc32c(const std::byte* data, std::size_t byteCount, std::uint32_t before = 0)
{
    static const detail::Crc32cFunction fastest = detail::fastestCrc32c();
    return fastest(data, byteCount, before);
}

} // namespace dfb
