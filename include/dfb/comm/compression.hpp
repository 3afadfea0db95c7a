// Codec: the contract of a lossless compressor for message payloads. A flag in each message tells whether it
// was used: a payload that does not get smaller travels as it is.
#pragma once

#include <dfb/version.hpp>

#include <cstddef>
#include <cstdint>

namespace dfb {

// Stateless: all members are called from several threads at once.
class Codec {
public:
    virtual ~Codec() = default;

    // What stands in the messages; the same number must mean the same format on all ranks. Not 0.
    virtual std::uint8_t id() const noexcept = 0;
    // The most that compress() writes for `byteCount` bytes.
    virtual std::size_t bound(std::size_t byteCount) const = 0;
    // Returns the number of bytes written.
    virtual std::size_t compress(const std::byte* in, std::size_t byteCount, std::byte* out) const = 0;
    // False if `in` does not decompress to exactly `rawByteCount` bytes; never writes more than that.
    virtual bool decompress(const std::byte* in, std::size_t byteCount, std::byte* out,
                            std::size_t rawByteCount) const = 0;
};

} // namespace dfb
