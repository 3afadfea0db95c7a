// Buffer: a block of pooled, 64-byte aligned memory with one owner. MemoryPool: where blocks come from, with
// the high-water mark of all it ever held.
#pragma once

#include <dfb/version.hpp>

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

namespace dfb {

class MemoryPool;

// Move-only handle of a block. Its destructor gives the block back to its pool, from any thread.
class Buffer {
public:
    Buffer() = default;
    Buffer(Buffer&& other) noexcept
        : pool_(std::move(other.pool_)), data_(std::exchange(other.data_, nullptr)),
          size_(std::exchange(other.size_, 0)), sizeClass_(other.sizeClass_)
    {
    }
    Buffer& operator=(Buffer&& other) noexcept
    {
        Buffer moved(std::move(other));
        swap(moved);
        return *this;
    }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    inline ~Buffer();

    void swap(Buffer& other) noexcept
    {
        std::swap(pool_, other.pool_);
        std::swap(data_, other.data_);
        std::swap(size_, other.size_);
        std::swap(sizeClass_, other.sizeClass_);
    }

    std::byte* data() noexcept { return data_; }
    const std::byte* data() const noexcept { return data_; }
    std::size_t size() const noexcept { return size_; }
    bool empty() const noexcept { return size_ == 0; }

    // Makes the block count as shorter; the memory stays. `byteCount` must not exceed size().
    void shrink(std::size_t byteCount) noexcept { size_ = byteCount < size_ ? byteCount : size_; }

private:
    friend class MemoryPool;
    Buffer(std::shared_ptr<MemoryPool> pool, std::byte* data, std::size_t size, int sizeClass)
        : pool_(std::move(pool)), data_(data), size_(size), sizeClass_(sizeClass)
    {
    }

    std::shared_ptr<MemoryPool> pool_;
    std::byte* data_ = nullptr;
    std::size_t size_ = 0;
    int sizeClass_ = 0;
};

// Free lists in size classes of 2^k and 3*2^(k-1) bytes. Blocks are kept until the last Buffer and the last
// handle of the pool are gone. All members may be called from any thread.
class MemoryPool : public std::enable_shared_from_this<MemoryPool> {
public:
    static std::shared_ptr<MemoryPool> create() { return std::shared_ptr<MemoryPool>(new MemoryPool); }
    MemoryPool(const MemoryPool&) = delete;
    MemoryPool& operator=(const MemoryPool&) = delete;
    ~MemoryPool()
    {
        for (int c = 0; c < classCount; ++c)
            for (std::byte* block : free_[static_cast<std::size_t>(c)])
                ::operator delete (block, std::align_val_t{alignment});
    }

    // A block of at least `byteCount` bytes, not cleared. Throws std::bad_alloc.
    Buffer acquire(std::size_t byteCount)
    {
        const int c = classOf(byteCount);
        std::byte* block = nullptr;
        {
            std::lock_guard<std::mutex> lock(mutex_);
            auto& list = free_[static_cast<std::size_t>(c)];
            if (!list.empty()) {
                block = list.back();
                list.pop_back();
            } else {
                list.reserve(++blockCount_[static_cast<std::size_t>(c)]); // so that giving back never throws
                heldBytes_ += bytesOf(c);
            }
        }
        if (!block)
            block = static_cast<std::byte*>(::operator new (bytesOf(c), std::align_val_t{alignment}));
        return Buffer(shared_from_this(), block, byteCount, c);
    }

    // Bytes taken from the system so far. The pool gives nothing back before its end, so this is its peak.
    std::uint64_t peakBytes() const
    {
        std::lock_guard<std::mutex> lock(mutex_);
        return heldBytes_;
    }

private:
    friend class Buffer;
    static constexpr std::size_t alignment = 64;
    static constexpr std::size_t smallest = 256;
    static constexpr int classCount = 2 * 48;

    MemoryPool() = default;

    static std::size_t bytesOf(int c)
    {
        const std::size_t base = smallest << (c / 2);
        return c % 2 ? base + base / 2 : base;
    }
    static int classOf(std::size_t byteCount)
    {
        int c = 0;
        while (c < classCount && bytesOf(c) < byteCount)
            ++c;
        if (c == classCount)
            throw std::bad_alloc();
        return c;
    }
    void giveBack(std::byte* block, int c) noexcept
    {
        std::lock_guard<std::mutex> lock(mutex_);
        free_[static_cast<std::size_t>(c)].push_back(block);
    }

    mutable std::mutex mutex_;
    std::array<std::vector<std::byte*>, classCount> free_;
    std::array<std::size_t, classCount> blockCount_{};
    std::uint64_t heldBytes_ = 0;
};

inline Buffer::~Buffer()
{
    if (data_)
        pool_->giveBack(data_, sizeClass_);
}

} // namespace dfb
