// The bytes of small control messages (manifests, verdicts): SmallBytes holds them, ByteWriter and ByteReader go field
// by field. A reader never reads beyond its end.
#pragma once

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

DFB_NAMESPACE_BEGIN
namespace detail {

// The bytes of a control message, of which the usual ones need no memory of their own.
class SmallBytes {
public:
    SmallBytes() = default;
    [[gnu::noinline]] SmallBytes(const SmallBytes&) = default; // not inlined: these are called in many places
    [[gnu::noinline]] SmallBytes(SmallBytes&&) = default;
    [[gnu::noinline]] SmallBytes& operator=(const SmallBytes&) = default;
    [[gnu::noinline]] SmallBytes& operator=(SmallBytes&&) = default;
    [[gnu::noinline]] ~SmallBytes() = default;
    SmallBytes(const std::byte* first, const std::byte* last) { append(first, last); }

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
    // Not of its own bytes.
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
    static constexpr std::size_t most = 256; // a verdict without an error or figures has 221

    std::size_t fewCount_ = 0;
    std::array<std::byte, most> few_{};
    std::vector<std::byte> many_; // all of them, if they are more than that
};

class ByteWriter {
public:
    template <class T>
    void put(const T& value)
    {
        static_assert(std::is_trivially_copyable_v<T>);
        const auto* first = reinterpret_cast<const std::byte*>(&value);
        bytes_.append(first, first + sizeof value);
    }
    void putText(const std::string& text)
    {
        put(static_cast<std::uint32_t>(text.size()));
        const auto* first = reinterpret_cast<const std::byte*>(text.data());
        bytes_.append(first, first + text.size());
    }
    void putBytes(const std::byte* first, const std::byte* last) { bytes_.append(first, last); }
    void clear() noexcept { bytes_.clear(); }
    const SmallBytes& bytes() const& noexcept { return bytes_; }
    SmallBytes bytes() && noexcept { return std::move(bytes_); }

private:
    SmallBytes bytes_;
};

class ByteReader {
public:
    ByteReader(const std::byte* data, std::size_t size) : next_(data), left_(size) {}
    explicit ByteReader(const SmallBytes& bytes) : ByteReader(bytes.data(), bytes.size()) {}

    // Throws Error (MalformedMessage) when fewer bytes are left.
    template <class T>
    T get()
    {
        static_assert(std::is_trivially_copyable_v<T>);
        T value;
        std::memcpy(&value, take(sizeof value), sizeof value);
        return value;
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
    // All that is left.
    void copyTo(ByteWriter& out) const { out.putBytes(next_, next_ + left_); }
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

inline void put(ByteWriter& out, const ErrorInfo& e)
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
