// NodeMemory: memory that all processes of one node see, so that messages between them are not copied. The sender says
// where a block lies; the receiver reads it there and gives it back. It also has a doorbell for each process.
//
// The memory has no name in the file system that could be left behind. Others reach it through the process that made
// it, and it ends when no process maps it any more. Linux only; elsewhere, or where a process may not look at another,
// there is no such memory.
#pragma once

#include <dfb/buffer.hpp>

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <mutex>
#include <new>
#include <string>

#if defined(__linux__)
#include <fcntl.h>
#include <linux/futex.h>
#include <sys/mman.h>
#include <sys/random.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

DFB_NAMESPACE_BEGIN
namespace detail {

// Doorbell: a word in memory that the processes of a node share, with which they wake a rank that naps.
class Doorbell {
public:
    // The side of the rank that naps. Its members may be called from several threads at once.
    class Listener {
    public:
        explicit Listener(Doorbell& doorbell)
            : doorbell_(doorbell), heard_(doorbell.word_.load()), seen_(doorbell.word_.load())
        {
        }

        // Call it before looking for messages: rings before that need not end a nap.
        void look() noexcept { heard_ = doorbell_.word_.load(); }

        // Naps for `limit`, or until it is interrupted, or, with `isAwaiting`, until a rank rings. Ends at once if it
        // was interrupted since the last nap, or if a rank has rung since the last nap or look().
        void nap(std::chrono::nanoseconds limit, bool isAwaiting) noexcept
        {
            const std::uint32_t word = doorbell_.word_.load();
            if (ringsOf(word) == ringsOf(heard_) && interruptsOf(word) == interruptsOf(seen_)) {
                auto& nappers = isAwaiting ? doorbell_.awaiting_ : doorbell_.napping_;
                nappers.fetch_add(1);
                doorbell_.wait(word, limit); // returns at once if the word is another one by now
                nappers.fetch_sub(1);
            }
            heard_ = seen_ = doorbell_.word_.load();
        }

    private:
        static std::uint32_t ringsOf(std::uint32_t word) { return word & 0xffff; }
        static std::uint32_t interruptsOf(std::uint32_t word) { return word >> 16; }

        Doorbell& doorbell_;
        std::atomic<std::uint32_t> heard_, seen_;
    };

    // For the rank itself: ends its nap, or else the next one.
    void interrupt() noexcept
    {
        word_.fetch_add(0x10000);
        if (awaiting_.load() + napping_.load() > 0)
            wake();
    }
    // For another rank, which has sent something.
    void ring() noexcept
    {
        word_.fetch_add(1);
        if (awaiting_.load() > 0)
            wake();
    }

private:
#if defined(__linux__)
    void wait(std::uint32_t word, std::chrono::nanoseconds limit) noexcept
    {
        const timespec time{static_cast<time_t>(limit.count() / 1000000000),
                            static_cast<long>(limit.count() % 1000000000)};
        syscall(SYS_futex, &word_, FUTEX_WAIT, word, &time, nullptr, 0);
    }
    void wake() noexcept
    {
        syscall(SYS_futex, &word_, FUTEX_WAKE, std::numeric_limits<int>::max(), nullptr, nullptr, 0);
    }
#else
    void wait(std::uint32_t, std::chrono::nanoseconds) noexcept {} // there is no such memory
    void wake() noexcept {}
#endif

    std::atomic<std::uint32_t> word_{0}; // rings in the lower half, interrupts in the upper one
    std::atomic<std::uint32_t> awaiting_{0}, napping_{0};
};
static_assert(std::atomic<std::uint32_t>::is_always_lock_free && sizeof(Doorbell) == 3 * sizeof(std::uint32_t));

class NodeMemory final : public SharedMemory, public BlockOwner, public std::enable_shared_from_this<NodeMemory> {
public:
    // How another process of the node finds the memory. All 0: it cannot.
    struct Address {
        std::int64_t process = 0, file = 0;
        std::uint64_t secret[2] = {}; // to check that it is this memory
    };

    // The most bytes that one process has. Only used pages take memory.
    static constexpr auto capacity = static_cast<std::size_t>(std::uint64_t{1} << 32); // 0 where it has 32 bits
    static constexpr std::size_t alignment = 64;

#if defined(MFD_CLOEXEC)
    // Returns null if the system has no such memory.
    static std::shared_ptr<NodeMemory> create()
    {
        rlimit longest; // a longer file would end the process by a signal
        if (getrlimit(RLIMIT_FSIZE, &longest) != 0 || longest.rlim_cur < capacity)
            return nullptr;
        const int file = sizeof(void*) < 8 ? -1 : memfd_create("dfb", MFD_CLOEXEC);
        if (file < 0)
            return nullptr;
        std::byte* base = ftruncate(file, static_cast<off_t>(capacity)) == 0 ? map(file) : nullptr;
        std::shared_ptr<NodeMemory> memory(new NodeMemory(base, file));
        Address& address = memory->address_;
        if (!base || !allocate(file, base, 0, step) || getrandom(address.secret, sizeof address.secret, 0) < 0)
            return nullptr;
        for (std::uint64_t& word : address.secret)
            word |= 1;
        address.process = getpid();
        address.file = file;
        std::memcpy(base, address.secret, sizeof address.secret);
        new (&memory->doorbell()) Doorbell;
        return memory;
    }

    // Opens the memory of another process, or of this one. Blocks can be borrowed there and given back, but not taken.
    // Returns null if it cannot be reached.
    static std::shared_ptr<NodeMemory> open(const Address& address)
    {
        const std::string path = "/proc/" + std::to_string(address.process) + "/fd/" + std::to_string(address.file);
        const int file = ::open(path.c_str(), O_RDWR | O_CLOEXEC);
        if (file < 0)
            return nullptr;
        struct stat status;
        const bool fits = fstat(file, &status) == 0 && status.st_size == static_cast<off_t>(capacity);
        std::byte* base = fits ? map(file) : nullptr;
        close(file);
        std::shared_ptr<NodeMemory> memory(new NodeMemory(base, -1));
        return base && std::memcmp(base, address.secret, sizeof address.secret) == 0 ? memory : nullptr;
    }
#else
    static std::shared_ptr<NodeMemory> create() { return nullptr; }
    static std::shared_ptr<NodeMemory> open(const Address&) { return nullptr; }
#endif

    ~NodeMemory()
    {
#if defined(MFD_CLOEXEC)
        if (base_)
            munmap(base_, capacity);
        if (file_ >= 0)
            close(file_);
#endif
    }

    const Address& address() const noexcept { return address_; }
    // The doorbell of the process whose memory it is.
    Doorbell& doorbell() const noexcept { return *reinterpret_cast<Doorbell*>(base_ + alignment); }

    std::byte* take(std::size_t byteCount) noexcept override
    {
        const std::size_t bytes = (sizeof(State) + byteCount + alignment - 1) / alignment * alignment;
        const std::lock_guard<std::mutex> lock(mutex_);
        if (file_ < 0 || byteCount > capacity || used_ + bytes > capacity)
            return nullptr;
        if (used_ + bytes > allocated_) {
            // Pages are allocated beforehand: if the first write to one found no memory, that would end the process.
            const std::size_t more = (used_ + bytes - allocated_ + step - 1) / step * step;
            if (allocated_ + more > capacity || !allocate(file_, base_, allocated_, more))
                return nullptr;
            allocated_ += more;
        }
        std::byte* block = base_ + used_ + sizeof(State);
        used_ += bytes;
        new (block - sizeof(State)) State;
        return block;
    }

    bool holds(const std::byte* block) const noexcept override { return block >= base_ && block < base_ + capacity; }
    void lend(std::byte* block) noexcept override { stateOf(block).is.store(lent, std::memory_order_relaxed); }
    bool isLent(const std::byte* block) const noexcept override
    {
        return stateOf(block).is.load(std::memory_order_acquire) != mine;
    }

    // placeOf(): where a block lies, in units of `alignment`, for others. borrow(): the first `byteCount` bytes of a
    // block that the process which owns this memory has lent; the Buffer gives it back at its end. Empty if no lent
    // block can be there, or if it is borrowed already: it would be given back twice.
    std::int32_t placeOf(const std::byte* block) const noexcept
    {
        return static_cast<std::int32_t>(static_cast<std::size_t>(block - base_) / alignment);
    }
    Buffer borrow(std::int32_t place, std::uint64_t byteCount)
    {
        std::byte* block = at(place, byteCount);
        std::uint32_t was = lent;
        if (!block
            || !stateOf(block).is.compare_exchange_strong(was, borrowed, std::memory_order_acquire,
                                                          std::memory_order_relaxed))
            return Buffer();
        return Buffer(shared_from_this(), block, static_cast<std::size_t>(byteCount), 0);
    }

    // Returns the block at `place`, or null if no block of that size fits there.
    std::byte* at(std::int32_t place, std::uint64_t byteCount) const noexcept
    {
        if (place < 2 || static_cast<std::size_t>(place) >= capacity / alignment)
            return nullptr;
        const std::size_t offset = static_cast<std::size_t>(place) * alignment;
        return byteCount <= capacity - offset ? base_ + offset : nullptr;
    }

private:
    // In front of each block. As a float `lent` is an unusual NaN, so that a wrong place does not take pixels for it.
    static constexpr std::uint32_t mine = 0, lent = 0xffa5d3b7, borrowed = 1;
    struct alignas(alignment) State {
        std::atomic<std::uint32_t> is{mine};
    };
    static_assert(std::atomic<std::uint32_t>::is_always_lock_free && sizeof(State) == alignment);
    static_assert(capacity / alignment <= std::size_t{1} << 31);
    static constexpr std::size_t step = std::size_t{1} << 21; // the memory grows by this: a large page

    NodeMemory(std::byte* base, int file) : base_(base), file_(file), allocated_(file < 0 ? 0 : step) {}

    State& stateOf(const std::byte* block) const noexcept
    {
        const std::size_t offset = static_cast<std::size_t>(block - base_) - sizeof(State);
        return *reinterpret_cast<State*>(base_ + offset);
    }

    void giveBack(std::byte* block, int) noexcept override { stateOf(block).is.store(mine, std::memory_order_release); }

#if defined(MFD_CLOEXEC)
    // Maps the file at a multiple of `step`, as a large page must begin at one.
    static std::byte* map(int file)
    {
        void* room = mmap(nullptr, capacity + step, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
        if (room == MAP_FAILED)
            return nullptr;
        auto* first = static_cast<std::byte*>(room);
        std::byte* base = first + (step - reinterpret_cast<std::uintptr_t>(first) % step) % step;
        if (base != first)
            munmap(first, static_cast<std::size_t>(base - first));
        if (const auto rest = static_cast<std::size_t>(first + step - base); rest > 0)
            munmap(base + capacity, rest);
        if (mmap(base, capacity, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_NORESERVE | MAP_FIXED, file, 0) == base)
            return base;
        munmap(base, capacity);
        return nullptr;
    }
    // `offset` and `byteCount` are multiples of `step`.
    static bool allocate(int file, std::byte* base, std::size_t offset, std::size_t byteCount)
    {
        if (posix_fallocate(file, static_cast<off_t>(offset), static_cast<off_t>(byteCount)) != 0)
            return false;
        constexpr int makeLargePages = 25; // MADV_COLLAPSE, since Linux 6.1. Without, the pages stay small
        madvise(base + offset, byteCount, makeLargePages);
        return true;
    }
#else
    static bool allocate(int, std::byte*, std::size_t, std::size_t) { return false; }
#endif

    std::byte* const base_;
    const int file_; // -1: opened by open()
    Address address_;
    std::mutex mutex_;
    std::size_t used_ = 2 * alignment, allocated_; // the first bytes are the secret and the doorbell; under mutex_
};

} // namespace detail
DFB_NAMESPACE_END
