// SnappyCodec: message compression by Google's Snappy. The only header that includes it.
#pragma once

#include <dfb/comm/compression.hpp>

#include <snappy.h>

DFB_NAMESPACE_BEGIN

class SnappyCodec final : public Codec {
public:
    std::uint8_t id() const noexcept override { return 1; }
    std::size_t bound(std::size_t byteCount) const override { return snappy::MaxCompressedLength(byteCount); }
    std::size_t compress(const std::byte* in, std::size_t byteCount, std::byte* out) const override
    {
        std::size_t written = 0;
        snappy::RawCompress(reinterpret_cast<const char*>(in), byteCount, reinterpret_cast<char*>(out), &written);
        return written;
    }
    bool decompress(const std::byte* in, std::size_t byteCount, std::byte* out, std::size_t rawByteCount) const override
    {
        const auto* bytes = reinterpret_cast<const char*>(in);
        std::size_t length = 0;
        return snappy::GetUncompressedLength(bytes, byteCount, &length) && length == rawByteCount
               && snappy::RawUncompress(bytes, byteCount, reinterpret_cast<char*>(out));
    }
};

DFB_NAMESPACE_END
