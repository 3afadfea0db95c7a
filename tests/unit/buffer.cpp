// Buffer and MemoryPool: alignment, reuse, and the high-water mark.
#include "catch.hpp"

#include <dfb/buffer.hpp>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <new>
#include <set>
#include <thread>
#include <utility>
#include <vector>

namespace buffer_cases {

TEST_CASE("Blocks are aligned, large enough and used again", "[memory]")
{
    const auto pool = dfb::MemoryPool::create();
    CHECK(pool->peakBytes() == 0);
    for (const std::size_t size : {0, 1, 255, 256, 257, 384, 385, 4096, 100000}) {
        dfb::Buffer b = pool->acquire(size);
        CHECK(b.size() == size);
        CHECK(reinterpret_cast<std::uintptr_t>(b.data()) % 64 == 0);
        std::memset(b.data(), 0xff, size); // for the address sanitizer
    }
    const std::uint64_t peak = pool->peakBytes();
    const std::byte* first = nullptr;
    for (int i = 0; i < 10; ++i) {
        const dfb::Buffer b = pool->acquire(100000);
        if (i == 0)
            first = b.data();
        CHECK(b.data() == first);
    }
    CHECK(pool->peakBytes() == peak);
}

TEST_CASE("The peak is at least what is held and at most half as much again", "[memory]")
{
    const auto pool = dfb::MemoryPool::create();
    std::vector<dfb::Buffer> held;
    std::uint64_t bytes = 0;
    for (std::size_t size = 256; size < 200000; size += 977) {
        held.push_back(pool->acquire(size));
        bytes += size;
        CHECK(pool->peakBytes() >= bytes);
        CHECK(pool->peakBytes() <= bytes + bytes / 2);
    }
    const std::uint64_t peak = pool->peakBytes();
    held.clear();
    CHECK(pool->peakBytes() == peak); // a high-water mark
    CHECK_THROWS_AS(pool->acquire(~std::size_t{0}), std::bad_alloc);
    CHECK(pool->peakBytes() == peak);
}

TEST_CASE("Buffers move, shrink and outlive the last handle of their pool", "[memory]")
{
    auto pool = dfb::MemoryPool::create();
    dfb::Buffer a = pool->acquire(1000);
    std::byte* data = a.data();
    dfb::Buffer b = std::move(a);
    CHECK(b.data() == data);
    CHECK(b.size() == 1000);
    b.shrink(10);
    CHECK(b.size() == 10);
    b.shrink(20);
    CHECK(b.size() == 10);
    dfb::Buffer c = pool->acquire(1000);
    CHECK(c.data() != data);
    c = std::move(b); // gives its own back
    CHECK(c.data() == data);
    pool.reset();
    std::memset(c.data(), 1, c.size());
    CHECK(c.data()[9] == std::byte{1});
}

TEST_CASE("No two threads hold the same block", "[memory]")
{
    const auto pool = dfb::MemoryPool::create();
    std::atomic<int> spoilt{0};
    std::vector<std::thread> threads;
    for (int t = 0; t < 4; ++t)
        threads.emplace_back([&, t] {
            for (int i = 0; i < 2000; ++i) {
                dfb::Buffer b = pool->acquire(256);
                std::memset(b.data(), t, 256);
                dfb::Buffer other = pool->acquire(300);
                std::memset(other.data(), t + 10, 300);
                for (std::size_t k = 0; k < 256; ++k)
                    spoilt += b.data()[k] != static_cast<std::byte>(t);
            }
        });
    for (std::thread& thread : threads)
        thread.join();
    CHECK(spoilt == 0);
    CHECK(pool->peakBytes() <= 4 * (256 + 384)); // what was held at once, not the sum
}

TEST_CASE("The block of a gate is zeros at first, and never anything else than a gate's", "[memory]")
{
    const auto pool = dfb::MemoryPool::create();
    const std::byte* gate = nullptr;
    {
        dfb::Buffer first = pool->acquireGate();
        gate = first.data();
        CHECK(std::all_of(first.data(), first.data() + first.size(), [](std::byte b) { return b == std::byte{}; }));
        first.data()[5] = std::byte{7};
    }
    const dfb::Buffer other = pool->acquire(dfb::MemoryPool::smallestShared), again = pool->acquireGate();
    CHECK(other.data() != gate);
    CHECK(again.data() == gate);
    CHECK(again.data()[5] == std::byte{7}); // another process may be counting there
}

} // namespace buffer_cases
