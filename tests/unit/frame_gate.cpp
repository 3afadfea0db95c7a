// FrameGate: what belongs to which frame, and that closing waits for all who are inside.
#include "catch.hpp"

#include <dfb/detail/frame_gate.hpp>

#include <atomic>
#include <thread>

using dfb::detail::FrameGate;

TEST_CASE("Frames of several gates are numbered in turns", "[frame_gate]")
{
    FrameGate first(1, 2), second(2, 2);
    for (const int frame : {1, 3, 5}) {
        CHECK(first.next() == frame);
        first.open();
        CHECK(first.frame() == frame);
        first.close();
        second.open();
        CHECK(second.frame() == frame + 1);
        second.close();
    }
}

TEST_CASE("Closing waits for work that somebody inside has begun meanwhile", "[frame_gate]")
{
    FrameGate gate;
    for (int frame = 1; frame <= 3; ++frame) { // the count must be right again for the next
        gate.open();
        REQUIRE(gate.enter(frame));
        std::atomic<bool> closed{false};
        std::thread closing([&] {
            gate.close();
            closed = true;
        });
        while (gate.enter(frame)) { // until it has begun to close
            gate.leave();
            std::this_thread::yield();
        }
        gate.enterAgain();
        gate.leave();
        for (int i = 0; i < 1000; ++i)
            std::this_thread::yield();
        CHECK_FALSE(closed);
        gate.leave();
        closing.join();
        CHECK(closed);
        CHECK_FALSE(gate.enter(frame));
    }
}
