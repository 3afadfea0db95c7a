// SmallBytes: the bytes of a control message, of which the usual ones need no memory of their own.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <vector>

namespace dfb::detail {

class SmallBytes {
public:
    SmallBytes() = default;
    explicit SmallBytes(std::size_t count) : fewCount_(std::min(count, most)), many_(count > most ? count : 0) {}
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

    friend bool operator==(const SmallBytes& a, const SmallBytes& b)
    {
        return std::equal(a.begin(), a.end(), b.begin(), b.end());
    }
    friend bool operator!=(const SmallBytes& a, const SmallBytes& b) { return !(a == b); }

private:
    static constexpr std::size_t most = 256; // a verdict without an error or figures has 221

    std::size_t fewCount_ = 0;
    std::array<std::byte, most> few_{};
    std::vector<std::byte> many_; // all of them, if they are more than that
};

} // namespace dfb::detail
