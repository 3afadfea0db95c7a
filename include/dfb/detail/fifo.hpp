// Fifo: a queue that keeps its memory, so that one that is filled and emptied again and again allocates no more.
#pragma once

#include <cstddef>
#include <utility>
#include <vector>

namespace dfb::detail {

template <class T>
class Fifo {
public:
    bool empty() const noexcept { return first_ == items_.size(); }
    void push(T&& item) { items_.push_back(std::move(item)); }

    // The oldest; there must be one.
    T pop()
    {
        T item = std::move(items_[first_++]);
        if (empty() || (first_ >= 1024 && first_ >= items_.size() / 2)) {
            items_.erase(items_.begin(), items_.begin() + static_cast<std::ptrdiff_t>(first_));
            first_ = 0;
        }
        return item;
    }

private:
    std::vector<T> items_;
    std::size_t first_ = 0;
};

} // namespace dfb::detail
