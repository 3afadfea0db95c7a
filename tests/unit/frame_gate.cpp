// FrameGate: what belongs to which frame, and that closing waits for all who are inside.
#include "catch.hpp"

#include <dfb/detail/frame_gate.hpp>

#include <atomic>
#include <thread>

namespace frame_gate_cases {

using dfb::detail::FrameGate;

const auto noHelp = [] { return false; };

TEST_CASE("Frames of several gates are numbered in turns", "[frame_gate]")
{
    FrameGate first(1, 2), second(2, 2);
    for (const int frame : {1, 3, 5}) {
        CHECK(first.next() == frame);
        first.open();
        CHECK(first.frame() == frame);
        first.close(noHelp);
        second.open();
        CHECK(second.frame() == frame + 1);
        second.close(noHelp);
    }
}

TEST_CASE("A message is of this frame, the last, the next, or none that can be", "[frame_gate]")
{
    FrameGate gate(2, 3);
    gate.open();
    const auto enter = [&](std::int64_t number) {
        dfb::detail::MessageHeader header;
        header.number = number;
        dfb::Buffer message;
        return gate.enter(1, header, message);
    };
    CHECK(enter(2) == FrameGate::Entry::Inside);
    gate.leave();
    CHECK(enter(-1) == FrameGate::Entry::Late);
    CHECK(enter(5) == FrameGate::Entry::Kept);
    CHECK(enter(8) == FrameGate::Entry::Absurd);
    CHECK(enter(std::int64_t{1} << 62) == FrameGate::Entry::Absurd);
    gate.close(noHelp);
    CHECK(gate.open().size() == 1);
    gate.close(noHelp);
}

TEST_CASE("Closing does itself what it waits for", "[frame_gate]")
{
    FrameGate gate;
    gate.open();
    int inside = 3, asked = 0;
    for (int i = 0; i < inside; ++i)
        CHECK(gate.enter(1));
    gate.close([&] {
        if (++asked % 2 == 0) // not at once
            return false;
        gate.leave();
        --inside;
        return true;
    });
    CHECK(inside == 0);
}

TEST_CASE("Closing waits for work that somebody inside has begun meanwhile", "[frame_gate]")
{
    FrameGate gate;
    for (int frame = 1; frame <= 3; ++frame) { // the count must be right again for the next
        gate.open();
        REQUIRE(gate.enter(frame));
        std::atomic<bool> closed{false};
        std::thread closing([&] {
            gate.close(noHelp);
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

} // namespace frame_gate_cases
