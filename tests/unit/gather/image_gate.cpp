// ImageGate: writers can enter while their frame is open, and after the gate has closed no writer is inside.
#include "catch.hpp"

#include <dfb/gather/image_gate.hpp>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <thread>
#include <utility>
#include <vector>

namespace image_gate_cases {

using dfb::detail::ImageGate;
using std::chrono::milliseconds;

TEST_CASE("Only writers of the frame that is open get in", "[gather]")
{
    ImageGate gate;
    CHECK_FALSE(gate.enter(1));
    gate.open(1);
    CHECK(gate.enter(1));
    CHECK_FALSE(gate.enter(2));
    CHECK(gate.close(milliseconds(0)));
    CHECK_FALSE(gate.enter(1));
    gate.open(2);
    CHECK_FALSE(gate.enter(1));
    CHECK(gate.enter(2));
}

TEST_CASE("A gate does not close before all writers have left, and says if it cannot", "[gather]")
{
    ImageGate gate;
    gate.open(5);
    ImageGate::Writer first = gate.enter(5), second = gate.enter(5);
    ImageGate::Writer moved = std::move(first);
    CHECK_FALSE(gate.close(milliseconds(1)));
    CHECK_FALSE(gate.enter(5));
    moved = nullptr;
    CHECK_FALSE(gate.close(milliseconds(1)));
    second = nullptr;
    CHECK(gate.close(milliseconds(0)));
}

TEST_CASE("Nobody writes once the gate is closed", "[gather]")
{
    ImageGate gate;
    std::atomic<std::int64_t> frame{0};
    std::atomic<bool> over{false};
    std::atomic<int> written{0};
    std::int64_t image = 0; // not atomic, so that ThreadSanitizer finds races of writers
    std::atomic<int> turn{0};
    std::vector<std::thread> writers;
    for (int t = 0; t < 3; ++t)
        writers.emplace_back([&, t] {
            while (!over) {
                if (turn != t) { // one at a time, as for tiles
                    std::this_thread::yield();
                    continue;
                }
                if (const auto writer = gate.enter(frame)) {
                    ++image;
                    ++written;
                }
                turn = (t + 1) % 3;
            }
        });
    int wrong = 0;
    for (std::int64_t f = 1; f <= 300; ++f) {
        frame = f;
        gate.open(f);
        const int before = written;
        while (written == before)
            std::this_thread::yield();
        REQUIRE(gate.close(milliseconds(20000)));
        const std::int64_t seen = image;
        std::this_thread::yield();
        wrong += image != seen || seen != written;
    }
    over = true;
    for (std::thread& writer : writers)
        writer.join();
    CHECK(wrong == 0);
}

} // namespace image_gate_cases
