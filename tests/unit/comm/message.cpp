// CRC-32C: the vectors of RFC 3720, both implementations, sums of pieces, and errors that it must find.
#include "catch.hpp"

#include <dfb/comm/message.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <random>
#include <string>
#include <vector>

namespace message_cases {

namespace {

using Bytes = std::vector<std::byte>;
using dfb::detail::crc32cByTable;

// On a processor without the instruction this is crc32cByTable().
const dfb::detail::Crc32cFunction fastest = dfb::detail::fastestCrc32c();

Bytes randomBytes(std::size_t count)
{
    std::mt19937 random(static_cast<unsigned>(count));
    Bytes bytes(count);
    std::generate(bytes.begin(), bytes.end(), [&] { return static_cast<std::byte>(random()); });
    return bytes;
}

// The definition of CRC-32C, bit by bit.
std::uint32_t reference(const std::byte* data, std::size_t byteCount)
{
    std::uint32_t sum = 0xffffffff;
    for (std::size_t i = 0; i < byteCount; ++i) {
        sum ^= std::to_integer<std::uint32_t>(data[i]);
        for (int bit = 0; bit < 8; ++bit)
            sum = (sum >> 1) ^ (sum % 2 == 1 ? 0x82f63b78 : 0);
    }
    return ~sum;
}

TEST_CASE("crc32c gives the values of RFC 3720")
{
    const std::string digits = "123456789";
    Bytes text(digits.size()), ascending(32), descending(32);
    std::memcpy(text.data(), digits.data(), digits.size());
    for (std::size_t i = 0; i < 32; ++i) {
        ascending[i] = static_cast<std::byte>(i);
        descending[31 - i] = static_cast<std::byte>(i);
    }
    for (const auto function : {&dfb::crc32c, fastest, &crc32cByTable}) {
        const auto sum = [&](const Bytes& bytes) { return function(bytes.data(), bytes.size(), 0); };
        CHECK(sum(text) == 0xe3069283);
        CHECK(sum(Bytes(32, std::byte{0x00})) == 0x8a9136aa);
        CHECK(sum(Bytes(32, std::byte{0xff})) == 0x62a8ab43);
        CHECK(sum(ascending) == 0x46dd794e);
        CHECK(sum(descending) == 0x113fdb5c);
        CHECK(function(nullptr, 0, 0) == 0);
    }
}

TEST_CASE("crc32c with the processor's instruction is crc32c with a table, at every size and alignment")
{
#if defined(__x86_64__)
    CHECK((fastest != &crc32cByTable) == (__builtin_cpu_supports("sse4.2") != 0));
#endif
    const Bytes bytes = randomBytes(20000);
    std::mt19937 random(1);
    for (std::size_t start = 0; start <= 5000; ++start) {
        const std::size_t count = random() % (start % 16 == 0 ? bytes.size() - start + 1 : 600);
        const std::uint32_t before = random() % 2 == 0 ? 0 : static_cast<std::uint32_t>(random());
        INFO(count << " bytes from " << start);
        REQUIRE(fastest(&bytes[start], count, before) == crc32cByTable(&bytes[start], count, before));
        if (before == 0 && count < 600)
            REQUIRE(crc32cByTable(&bytes[start], count, 0) == reference(&bytes[start], count));
    }
    for (std::size_t count = 0; count <= 5000; ++count) {
        INFO(count << " bytes");
        REQUIRE(fastest(&bytes[count % 8], count, 0) == crc32cByTable(&bytes[count % 8], count, 0));
    }
}

TEST_CASE("crc32c of the pieces is crc32c of the whole")
{
    const Bytes bytes = randomBytes(10000);
    const std::uint32_t whole = dfb::crc32c(bytes.data(), bytes.size());
    for (std::size_t cut = 0; cut <= bytes.size(); cut += cut < 100 ? 1 : 97) {
        INFO("cut at " << cut);
        const std::uint32_t before = dfb::crc32c(bytes.data(), cut);
        REQUIRE(dfb::crc32c(bytes.data() + cut, bytes.size() - cut, before) == whole);
        REQUIRE(crc32cByTable(bytes.data() + cut, bytes.size() - cut, before) == whole);
    }
}

TEST_CASE("crc32c finds each wrong bit of a message, and two")
{
    Bytes bytes = randomBytes(100);
    const std::uint32_t right = dfb::crc32c(bytes.data(), bytes.size());
    const auto flip = [&](std::size_t bit) { bytes[bit / 8] ^= std::byte{1} << (bit % 8); };
    std::size_t missed = 0;
    for (std::size_t one = 0; one < 800; ++one) {
        flip(one);
        missed += dfb::crc32c(bytes.data(), bytes.size()) == right;
        for (std::size_t other = 0; other < one; ++other) {
            flip(other);
            missed += dfb::crc32c(bytes.data(), bytes.size()) == right;
            flip(other);
        }
        flip(one);
    }
    CHECK(missed == 0);
    CHECK(dfb::crc32c(bytes.data(), bytes.size()) == right);
}

} // namespace

} // namespace message_cases
