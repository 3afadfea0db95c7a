// NodeMemory: other processes see blocks, blocks come back when those processes release them, and invalid addresses and
// places are refused.
#include "catch.hpp"

#include <dfb/comm/node_memory.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <memory>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

using dfb::Buffer;
using dfb::MemoryPool;
using dfb::detail::NodeMemory;

namespace {

struct SharedPool {
    SharedPool() { pool->share(memory); }
    std::shared_ptr<NodeMemory> memory = NodeMemory::create();
    std::shared_ptr<MemoryPool> pool = MemoryPool::create();
    std::shared_ptr<NodeMemory> seen = NodeMemory::open(memory->address());
};

} // namespace

TEST_CASE("The memory has large pages, if the system makes them", "[memory]")
{
    constexpr std::size_t page = std::size_t{1} << 21;
    const auto memory = NodeMemory::create();
    std::vector<std::byte*> blocks;
    for (int i = 0; i < 4; ++i) {
        blocks.push_back(memory->take(page));
        std::memset(blocks.back(), 1, page);
    }
    CHECK((reinterpret_cast<std::uintptr_t>(&memory->doorbell()) - NodeMemory::alignment) % page == 0);
    const auto largePages = [] { // KB of this process
        std::ifstream map("/proc/self/smaps_rollup");
        std::string word;
        long count = 0;
        while (map >> word)
            if (word == "ShmemPmdMapped:")
                map >> count;
        return count;
    };
    // Only Linux 6.1 and later make large pages on request, and only if a free one is found.
    const auto address = reinterpret_cast<std::uintptr_t>(blocks[1]);
    if (madvise(reinterpret_cast<void*>(address - address % page), page, 25) != 0 || largePages() == 0)
        return; // an emulator may ignore what it does not know
    CHECK(largePages() >= 4 * 2048);
}

TEST_CASE("A doorbell ends a nap, or the next one, and wakes only who wants to be woken", "[memory]")
{
    using namespace std::chrono;
    SharedPool s;
    dfb::detail::Doorbell &mine = s.memory->doorbell(),
                          &others = s.seen->doorbell(); // the same one, mapped as by another process
    dfb::detail::Doorbell::Listener listener(mine);
    // The time is the assertion: a nap that is not ended takes a minute.
    const auto isShort = [&](bool isAwaiting, const auto& before, const auto& meanwhile) {
        before();
        const auto start = steady_clock::now();
        std::thread napper([&] { listener.nap(minutes(1), isAwaiting); });
        meanwhile();
        napper.join();
        return steady_clock::now() - start < seconds(30);
    };
    const auto nothing = [] {};
    const auto ring = [&] { others.ring(); };
    const auto interrupt = [&] { mine.interrupt(); };
    // Whether the nap has begun by then only decides which of two ways is tested.
    const auto later = [](const auto& f) {
        return [&f] {
            std::this_thread::sleep_for(milliseconds(20));
            f();
        };
    };
    for (const bool isAwaiting : {true, false}) {
        CHECK(isShort(isAwaiting, ring, nothing));
        CHECK(isShort(isAwaiting, interrupt, nothing));
        CHECK(isShort(isAwaiting, nothing, interrupt));
        CHECK(isShort(isAwaiting, nothing, later(interrupt)));
    }
    CHECK(isShort(true, nothing, ring));
    CHECK(isShort(true, nothing, later(ring)));
    // An interrupt ends one nap, even if the listener has looked since. A ring before a look ends none.
    mine.interrupt();
    others.ring();
    listener.look();
    const auto timeOf = [&](milliseconds limit) {
        const auto start = steady_clock::now();
        listener.nap(limit, true);
        return steady_clock::now() - start;
    };
    CHECK(timeOf(minutes(1)) < seconds(30));
    CHECK(timeOf(milliseconds(20)) >= milliseconds(20));
}

TEST_CASE("Where files may not be that long there is no memory, and the process goes on", "[memory]")
{
    rlimit before;
    REQUIRE(getrlimit(RLIMIT_FSIZE, &before) == 0);
    rlimit low = before;
    low.rlim_cur = 1 << 20;
    REQUIRE(setrlimit(RLIMIT_FSIZE, &low) == 0);
    const auto memory = NodeMemory::create(); // no assertion here, as it might write to a file
    REQUIRE(setrlimit(RLIMIT_FSIZE, &before) == 0);
    CHECK_FALSE(memory);
}

TEST_CASE("What one process writes another reads in the same place, and gives back", "[memory]")
{
    SharedPool s;
    Buffer buffer = s.pool->acquire(100000);
    std::memset(buffer.data(), 7, buffer.size());
    const std::byte* block = s.pool->lend(buffer);
    REQUIRE(block);
    CHECK(buffer.empty());
    const std::int32_t place = s.memory->placeOf(block);
    CHECK(s.memory->isLent(block));
    const pid_t child = fork();
    if (child == 0) { // no assertions here, as they would be the parent's
        const auto memory = NodeMemory::open(s.memory->address());
        int code = 1;
        if (memory) {
            const Buffer borrowed = memory->borrow(place, 100000);
            std::size_t right = 0;
            for (std::size_t i = 0; i < borrowed.size(); ++i)
                right += borrowed.data()[i] == std::byte{7};
            code = right == 100000 ? 0 : 2;
        }
        _exit(code);
    }
    int status = -1;
    REQUIRE(waitpid(child, &status, 0) == child);
    CHECK(WIFEXITED(status));
    CHECK(WEXITSTATUS(status) == 0);
    CHECK_FALSE(s.memory->isLent(block));
    CHECK(s.pool->acquire(100000).data() == block); // used again
}

TEST_CASE("A block is not used again before it is back, whoever lets go of it", "[memory]")
{
    SharedPool s;
    REQUIRE(s.seen);
    std::vector<Buffer> borrowed;
    std::set<const std::byte*> lent;
    for (int i = 0; i < 20; ++i) {
        Buffer buffer = s.pool->acquire(5000);
        std::memset(buffer.data(), i, buffer.size());
        const std::byte* block = s.pool->lend(buffer);
        REQUIRE(block);
        CHECK(lent.insert(block).second);
        borrowed.push_back(s.seen->borrow(s.memory->placeOf(block), 5000));
        REQUIRE(borrowed.back().size() == 5000);
        CHECK(borrowed.back().data() != block); // mapped a second time
    }
    for (int i = 0; i < 20; ++i)
        CHECK(borrowed[static_cast<std::size_t>(i)].data()[4999] == static_cast<std::byte>(i));
    const std::uint64_t peak = s.pool->peakBytes();
    borrowed.erase(borrowed.begin(), borrowed.begin() + 10);
    std::vector<Buffer> again;
    for (int i = 0; i < 10; ++i) {
        again.push_back(s.pool->acquire(5000));
        CHECK(lent.count(again.back().data()) == 1);
    }
    CHECK(s.pool->peakBytes() == peak);
    CHECK(lent.count(s.pool->acquire(5000).data()) == 0);
    for (const Buffer& b : borrowed)
        CHECK(b.data()[0] >= std::byte{10});

    // A borrowed block outlives the lender's pool and mapping.
    s.pool.reset();
    s.memory.reset();
    again.clear();
    s.seen.reset();
    CHECK(borrowed.back().data()[4999] == std::byte{19});
}

TEST_CASE("Blocks that nobody else sees are not lent", "[memory]")
{
    const auto plain = MemoryPool::create();
    Buffer buffer = plain->acquire(100000);
    CHECK(plain->lend(buffer) == nullptr);
    CHECK(buffer.size() == 100000);
    SharedPool s;
    CHECK(s.pool->lend(buffer) == nullptr); // of another pool
    Buffer small = s.pool->acquire(100);
    CHECK(s.pool->lend(small) == nullptr);
    CHECK(small.size() == 100);
    Buffer huge = s.pool->acquire(NodeMemory::capacity); // more than there is, so the pool takes other memory
    CHECK(s.pool->lend(huge) == nullptr);
    CHECK(s.memory->take(NodeMemory::capacity) == nullptr);
    CHECK(s.memory->take(~std::size_t{0}) == nullptr);
}

TEST_CASE("A wrong address or place is not believed", "[memory]")
{
    SharedPool s;
    NodeMemory::Address address = s.memory->address();
    CHECK_FALSE(NodeMemory::open({}));
    address.secret[1] ^= 1;
    CHECK_FALSE(NodeMemory::open(address));
    address = s.memory->address();
    address.file = 100000;
    CHECK_FALSE(NodeMemory::open(address));
    address.file = 0; // another file of this process
    CHECK_FALSE(NodeMemory::open(address));

    Buffer buffer = s.pool->acquire(4096);
    const std::int32_t place = s.memory->placeOf(buffer.data());
    CHECK(s.seen->borrow(place, 4096).empty()); // not lent
    CHECK(s.pool->lend(buffer));
    for (const std::int32_t wrong : {-1, 0, 1, 1 << 24, (1 << 24) - 1, 2147483647})
        CHECK(s.seen->borrow(wrong, 4096).empty());
    CHECK(s.seen->borrow(place, NodeMemory::capacity).empty());
    CHECK(s.seen->borrow(place, ~std::uint64_t{0}).empty());
    CHECK(s.seen->borrow(place, 4096).size() == 4096);
}

TEST_CASE("A block is lent once, as a whole", "[memory]")
{
    SharedPool s;
    Buffer buffer = s.pool->acquire(4096);
    std::memset(buffer.data(), 1, buffer.size()); // as if each place in it were that of a lent block
    const std::int32_t place = s.memory->placeOf(buffer.data());
    const std::byte* block = s.pool->lend(buffer);
    REQUIRE(block);
    for (int i = 1; i < 10; ++i)
        CHECK(s.seen->borrow(place + i, 64).empty());
    Buffer borrowed = s.seen->borrow(place, 4096);
    CHECK(borrowed.size() == 4096);
    CHECK(s.seen->borrow(place, 4096).empty());
    CHECK(s.memory->isLent(block)); // still
    borrowed = Buffer();
    CHECK_FALSE(s.memory->isLent(block));
    CHECK(s.seen->borrow(place, 4096).empty());
}
#endif
