// Fifo: a queue that keeps its memory, so that filling and emptying it again and again allocates no more.
#pragma once

#include <dfb/version.hpp>

#include <cstddef>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

template <class T>
class Fifo {
public:
    bool empty() const noexcept { return first_ == items_.size(); }
    std::size_t size() const noexcept { return items_.size() - first_; }
    void reserve(std::size_t count) { items_.reserve(count); }
    void push(T&& item) { items_.push_back(std::move(item)); }
    void push(const T& item) { items_.push_back(item); }
    void clear() noexcept
    {
        items_.clear();
        first_ = 0;
    }

    // The oldest item. The queue must not be empty.
    T& front() noexcept { return items_[first_]; }
    T pop()
    {
        T item = std::move(items_[first_++]);
        if (empty() || (first_ >= 1024 && first_ >= items_.size() / 2)) {
            items_.erase(items_.begin(), items_.begin() + static_cast<std::ptrdiff_t>(first_));
            first_ = 0;
        }
        return item;
    }

    // From the oldest on.
    const T* begin() const noexcept { return items_.data() + first_; }
    const T* end() const noexcept { return items_.data() + items_.size(); }

private:
    std::vector<T> items_;
    std::size_t first_ = 0;
};

} // namespace detail
DFB_NAMESPACE_END
