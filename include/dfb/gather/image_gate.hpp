// ImageGate: lets other processes write finished tiles straight into the image of the display rank, where they see its
// memory: while the frame is open there, and never into an image that a user may be looking at.
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

// Lies in shared memory. A writer says that it is there and then looks whether the gate is open; who closes it closes
// it and then looks whether anybody is there: one of them sees the other.
class ImageGate {
    struct Leave {
        void operator()(ImageGate* gate) const noexcept { gate->writers_.fetch_sub(1); }
    };

public:
    // Somebody who is inside; null: nobody.
    using Writer = std::unique_ptr<ImageGate, Leave>;

    Writer enter(std::int64_t frame) noexcept
    {
        writers_.fetch_add(1);
        Writer writer(this);
        return frame_.load() == frame ? std::move(writer) : nullptr;
    }

    void open(std::int64_t frame) noexcept { frame_.store(frame); } // not 0
    // False if a writer does not leave in time; it may have died.
    bool close(std::chrono::milliseconds limit) noexcept
    {
        frame_.store(0);
        const auto end = std::chrono::steady_clock::now() + limit;
        while (writers_.load() != 0) {
            if (std::chrono::steady_clock::now() > end)
                return false;
            std::this_thread::sleep_for(std::chrono::microseconds(100));
        }
        return true;
    }

private:
    std::atomic<std::int64_t> frame_{0};
    std::atomic<std::int32_t> writers_{0};
};
static_assert(std::atomic<std::int64_t>::is_always_lock_free && std::atomic<std::int32_t>::is_always_lock_free);

// Where the gate and the planes of an image lie in its rank's shared memory, as that counts places; -1: nowhere. The
// display rank tells it to the ranks that see its memory.
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
