// Buffer: a block of 64-byte aligned memory with one owner. MemoryPool: gives out blocks, uses them again, and knows
// its peak.
#pragma once

#include <dfb/base/fifo.hpp>
#include <dfb/version.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <memory>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// There is not enough memory. what() says how many bytes were asked for, and for which use.
class OutOfMemory final : public std::bad_alloc {
public:
    // Keeps at most 150 characters of the purpose, in the object itself: there may be no memory for a text.
    OutOfMemory(std::size_t byteCount, const char* purpose) noexcept
    {
        std::snprintf(text_, sizeof text_, "no memory for %zu bytes: %.150s", byteCount, purpose);
    }
    const char* what() const noexcept override { return text_; }

private:
    char text_[200];
};

// Takes a block back when its Buffer is destroyed, on any thread.
class BlockOwner {
public:
    virtual void giveBack(std::byte* block, int sizeClass) noexcept = 0;

protected:
    ~BlockOwner() = default;
};

// Move-only handle of a block. Its destructor gives the block back to its owner, from any thread.
class Buffer {
public:
    Buffer() = default;
    // `sizeClass` is passed to owner->giveBack() unchanged.
    Buffer(std::shared_ptr<BlockOwner> owner, std::byte* data, std::size_t size, int sizeClass) noexcept
        : block_(data, {std::move(owner), sizeClass}), size_(size)
    {
    }

    std::byte* data() noexcept { return block_.get(); }
    const std::byte* data() const noexcept { return block_.get(); }
    std::size_t size() const noexcept { return block_ ? size_ : 0; }
    bool empty() const noexcept { return size() == 0; }

    // Reduces size(); the block keeps its memory. `byteCount` must not exceed size().
    void shrink(std::size_t byteCount) noexcept { size_ = byteCount < size_ ? byteCount : size_; }

private:
    friend class MemoryPool;
    struct GiveBack {
        std::shared_ptr<BlockOwner> owner;
        int sizeClass;
        void operator()(std::byte* block) const noexcept
        {
            if (owner) // always, which GCC does not see
                owner->giveBack(block, sizeClass);
        }
    };

    std::unique_ptr<std::byte, GiveBack> block_;
    std::size_t size_ = 0;
};

// Memory that other processes see, too. A pool may take its blocks from it. See comm/node_memory.hpp. All members may
// be called from any thread.
class SharedMemory {
public:
    // A block that is never given back, 64-byte aligned; null if there is no more.
    virtual std::byte* take(std::size_t byteCount) noexcept = 0;
    virtual bool holds(const std::byte* block) const noexcept = 0;
    // For a block that it holds. lend(): its owner lends the block to another process. isLent(): whether that process
    // has not given it back yet.
    virtual void lend(std::byte* block) noexcept = 0;
    virtual bool isLent(const std::byte* block) const noexcept = 0;

protected:
    ~SharedMemory() = default;
};

// Free lists in size classes of 2^k and 3*2^(k-1) bytes. Blocks are kept until the last Buffer and the last
// handle of the pool are gone. All members may be called from any thread.
class MemoryPool final : public BlockOwner, public std::enable_shared_from_this<MemoryPool> {
public:
    static constexpr std::size_t smallestShared = 2048; // smaller blocks are never in memory that other processes see

    // `mayBeShared`: a transport may put its blocks into memory that other processes see.
    static std::shared_ptr<MemoryPool> create(bool mayBeShared = true)
    {
        return std::shared_ptr<MemoryPool>(new MemoryPool(mayBeShared));
    }
    ~MemoryPool()
    {
        for (SizeClass& sizeClass : classes_)
            for (std::byte* block : sizeClass.free)
                if (!shared_ || !shared_->holds(block))
                    ::operator delete (block, std::align_val_t{alignment});
    }

    // A block of at least `byteCount` bytes, not cleared. Throws OutOfMemory.
    Buffer acquire(std::size_t byteCount) { return acquire(byteCount, classOf(byteCount)); }

    // A block of smallestShared bytes, zeros when it is first given out. Only this function gives it out again, because
    // other processes may still read it after it was given back. Throws OutOfMemory.
    Buffer acquireGate() { return acquire(smallestShared, gates); }

    // Bytes taken from the system so far. This is the peak, as the pool gives nothing back before its end.
    std::uint64_t peakBytes() const noexcept { return heldBytes_; }

    bool mayBeShared() const noexcept { return mayBeShared_; }

    // Makes new blocks of smallestShared bytes or more come from `memory`, as far as it has room. Call it once.
    void share(std::shared_ptr<SharedMemory> memory)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        shared_ = std::move(memory);
    }
    std::shared_ptr<SharedMemory> shared() const
    {
        std::lock_guard<std::mutex> lock(mutex_);
        return shared_;
    }

    // Lends the block of `buffer` to another process, and empties `buffer`. Tell that process where the block is. When
    // it has given the block back, the pool uses it again. Returns null, and changes nothing, if the block is not in
    // shared memory.
    std::byte* lend(Buffer& buffer)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        const auto& [owner, sizeClass] = buffer.block_.get_deleter();
        if (owner.get() != this || !shared_ || !shared_->holds(buffer.data()))
            return nullptr;
        classes_[static_cast<std::size_t>(sizeClass)].lent.push(buffer.data());
        shared_->lend(buffer.data());
        return buffer.block_.release();
    }

private:
    static constexpr std::size_t alignment = 64;
    static constexpr std::size_t smallest = 256;
    static constexpr int classCount = 2 * 48, gates = classCount; // gates: a class beside those by size

    struct SizeClass {
        std::vector<std::byte*> free;
        detail::Fifo<std::byte*> lent; // oldest first
        std::size_t blocks = 0;
    };

    explicit MemoryPool(bool mayBeShared) : mayBeShared_(mayBeShared) {}

    static std::size_t bytesOf(int c)
    {
        if (c == gates)
            return smallestShared;
        const std::size_t base = smallest << (c / 2);
        return c % 2 ? base + base / 2 : base;
    }
    static int classOf(std::size_t byteCount)
    {
        int c = 0;
        while (c < classCount && bytesOf(c) < byteCount)
            ++c;
        if (c == classCount)
            throw OutOfMemory(byteCount, "a block");
        return c;
    }

    Buffer acquire(std::size_t byteCount, int c)
    {
        SizeClass& sizeClass = classes_[static_cast<std::size_t>(c)];
        SharedMemory* shared = nullptr;
        std::byte* block = nullptr;
        {
            std::lock_guard<std::mutex> lock(mutex_);
            if (!sizeClass.free.empty()) {
                block = sizeClass.free.back();
                sizeClass.free.pop_back();
            } else if (!(block = returned(sizeClass))) {
                if (++sizeClass.blocks > sizeClass.free.capacity()) // so that giving back never throws
                    sizeClass.free.reserve(2 * sizeClass.blocks);
                heldBytes_ += bytesOf(c);
                shared = bytesOf(c) >= smallestShared ? shared_.get() : nullptr;
            }
        }
        const bool isNew = !block;
        if (isNew && shared)
            block = shared->take(bytesOf(c));
        try {
            if (!block)
                block = static_cast<std::byte*>(::operator new (bytesOf(c), std::align_val_t{alignment}));
        } catch (const std::bad_alloc&) {
            const std::lock_guard<std::mutex> lock(mutex_);
            --sizeClass.blocks;
            heldBytes_ -= bytesOf(c);
            throw OutOfMemory(bytesOf(c), "a block");
        }
        if (isNew && c == gates)
            std::memset(block, 0, bytesOf(c));
        return Buffer(shared_from_this(), block, byteCount, c);
    }

    // A block that was lent and is back, or null. Looks at a few only.
    std::byte* returned(SizeClass& sizeClass)
    {
        detail::Fifo<std::byte*>& lent = sizeClass.lent;
        for (std::size_t tries = std::min<std::size_t>(lent.size(), 8); tries > 0; --tries) {
            std::byte* block = lent.pop();
            if (!shared_->isLent(block))
                return block;
            lent.push(block);
        }
        return nullptr;
    }

    void giveBack(std::byte* block, int c) noexcept override
    {
        std::lock_guard<std::mutex> lock(mutex_);
        classes_[static_cast<std::size_t>(c)].free.push_back(block);
    }

    const bool mayBeShared_;
    mutable std::mutex mutex_;
    std::array<SizeClass, classCount + 1> classes_;
    std::shared_ptr<SharedMemory> shared_;
    std::atomic<std::uint64_t> heldBytes_{0}; // written under mutex_
};

DFB_NAMESPACE_END
