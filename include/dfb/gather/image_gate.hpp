// ImageGate: lets other processes write finished tiles straight into the image of the display rank, if they see its
// memory. They may do so only while the frame is open there: after that the program reads the image.
#pragma once

#include <dfb/buffer.hpp>
#include <dfb/channels.hpp>

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <thread>
#include <utility>

DFB_NAMESPACE_BEGIN
namespace detail {

// Lies in shared memory. A writer first counts itself in and then looks whether the gate is open. close() first closes
// the gate and then looks whether a writer is inside. So at least one of the two sees the other. When an image is gone,
// another one uses its gate (MemoryPool::acquireGate()), and lets no writer of the old image in.
class ImageGate {
    struct Leave {
        void operator()(ImageGate* gate) const noexcept { gate->writers_.fetch_sub(1); }
    };

public:
    // A writer that is inside until this is destroyed. Null: it was not let in.
    using Writer = std::unique_ptr<ImageGate, Leave>;

    // Returns the visit for a frame of the framebuffer with this address: not 0, and another one for each frame and
    // framebuffer.
    static std::int64_t visitOf(std::uint32_t address, std::int64_t frame) noexcept
    {
        return static_cast<std::int64_t>(std::uint64_t{address} << 32 | static_cast<std::uint32_t>(frame));
    }

    Writer enter(std::int64_t visit) noexcept
    {
        writers_.fetch_add(1);
        Writer writer(this);
        return visit_.load() == visit ? std::move(writer) : nullptr;
    }

    void open(std::int64_t visit) noexcept { visit_.store(visit); }
    // Returns false if a writer does not leave in time; it may have died.
    bool close(std::chrono::milliseconds limit) noexcept
    {
        visit_.store(0);
        const auto end = std::chrono::steady_clock::now() + limit;
        while (writers_.load() != 0) {
            if (std::chrono::steady_clock::now() > end)
                return false;
            std::this_thread::sleep_for(std::chrono::microseconds(100));
        }
        return true;
    }

private:
    std::atomic<std::int64_t> visit_{0}; // 0: closed
    std::atomic<std::int32_t> writers_{0};
};
static_assert(std::atomic<std::int64_t>::is_always_lock_free && std::atomic<std::int32_t>::is_always_lock_free);

// Where the gate and the planes of an image lie in the shared memory of its rank: places as Connection::placeOf() gives
// them; -1: nowhere. The display rank sends this to the ranks that see its memory.
struct ImagePlaces {
    std::int32_t gate = -1;
    std::array<std::int32_t, channelCount> planes{};
};

// Gate and planes as pointers; null until they are known.
struct SharedImage {
    ImageGate* gate = nullptr;
    Planes planes;
};

} // namespace detail
DFB_NAMESPACE_END
