// Shared by the fuzz targets. Each target is a file with seeds() and LLVMFuzzerTestOneInput(), which libFuzzer or
// tests/fuzz/driver.cpp calls. A target checks more than crashes: an accepted input must have the properties that the
// library relies on, and a refused one must give the typed error.
#pragma once

#include <dfb/buffer.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size);

namespace fuzz {

// The named inputs that fuzzing begins with; the driver writes them with `--write-seeds`.
std::vector<std::pair<std::string, std::string>> seeds();

[[noreturn]] inline void fail(const std::string& what)
{
    std::fprintf(stderr, "fuzz: %s\n", what.c_str());
    std::abort();
}
inline void require(bool holds, const char* what)
{
    if (!holds)
        fail(std::string("not so: ") + what);
}

// An input that is read from its front. After its end come zeros.
class Input {
public:
    Input(const std::uint8_t* data, std::size_t size) : next_(data), left_(size) {}
    explicit Input(const std::string& bytes) : Input(reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size())
    {
    }

    template <class T>
    T take()
    {
        static_assert(std::is_trivially_copyable_v<T>);
        T value{};
        const std::size_t count = std::min(left_, sizeof value);
        if (count > 0)
            std::memcpy(&value, next_, count);
        next_ += count;
        left_ -= count;
        return value;
    }
    // The next `count` bytes, or fewer at the end.
    std::string text(std::size_t count)
    {
        const std::string bytes(reinterpret_cast<const char*>(next_), std::min(count, left_));
        next_ += bytes.size();
        left_ -= bytes.size();
        return bytes;
    }
    std::string rest() { return text(left_); }
    std::size_t left() const noexcept { return left_; }

private:
    const std::uint8_t* next_;
    std::size_t left_;
};

// Writes what Input reads.
class Output {
public:
    template <class T>
    Output& put(const T& value)
    {
        static_assert(std::is_trivially_copyable_v<T>);
        bytes_.append(reinterpret_cast<const char*>(&value), sizeof value);
        return *this;
    }
    Output& text(const std::string& bytes)
    {
        bytes_ += bytes;
        return *this;
    }
    std::string bytes() const { return bytes_; }

private:
    std::string bytes_;
};

inline const std::byte* bytesOf(const std::string& text) { return reinterpret_cast<const std::byte*>(text.data()); }
inline std::vector<std::byte> vectorOf(const std::string& text) { return {bytesOf(text), bytesOf(text) + text.size()}; }
inline std::string textOf(const std::byte* bytes, std::size_t count)
{
    return std::string(reinterpret_cast<const char*>(bytes), count);
}
template <class Bytes>
std::string textOf(const Bytes& bytes)
{
    return textOf(bytes.data(), bytes.size());
}

// Blocks of exactly the requested size, so that AddressSanitizer finds reads beyond them. Those of a MemoryPool are
// larger.
class ExactBlocks final : public dfb::BlockOwner {
public:
    static dfb::Buffer copyOf(const std::string& bytes)
    {
        static const auto owner = std::make_shared<ExactBlocks>();
        auto* block = static_cast<std::byte*>(::operator new(std::max<std::size_t>(bytes.size(), 1), alignment));
        if (!bytes.empty())
            std::memcpy(block, bytes.data(), bytes.size());
        return dfb::Buffer(owner, block, bytes.size(), 0);
    }
    void giveBack(std::byte* block, int) noexcept override { ::operator delete(block, alignment); }

private:
    static constexpr std::align_val_t alignment{64};
};

} // namespace fuzz
