// OpenFrame: every transition of its states, which messages and tiles belong to a frame, and that closing waits for all
// threads that are inside.
#include "catch.hpp"

#include <dfb/error.hpp>
#include <dfb/frame/open_frame.hpp>

#include <atomic>
#include <cstddef>
#include <functional>
#include <memory>
#include <thread>
#include <utility>
#include <vector>

namespace open_frame_cases {

using dfb::detail::FrameState;
using dfb::detail::OpenFrame;

const auto noHelp = [] { return false; };
const auto yes = [] { return true; };
const auto no = [] { return false; };

namespace {

dfb::ErrorInfo errorOf(dfb::ErrorKind kind)
{
    dfb::ErrorInfo info;
    info.kind = kind;
    return info;
}

// All events of a frame.
const std::vector<std::pair<const char*, std::function<void(OpenFrame&)>>> events{
    {"open", [](OpenFrame& f) { f.open(); }},
    {"open, failed", [](OpenFrame& f) { f.open(errorOf(dfb::ErrorKind::UserCode)); }},
    {"close inputs", [](OpenFrame& f) { f.closeInputs(); }},
    {"fail", [](OpenFrame& f) { f.fail(errorOf(dfb::ErrorKind::UserCode)); }},
    {"note", [](OpenFrame& f) { f.note(errorOf(dfb::ErrorKind::UserCode)); }},
    {"vote, done", [](OpenFrame& f) { f.vote(yes, yes); }},
    {"vote, not done", [](OpenFrame& f) { f.vote(no, yes); }},
    {"vote, may not", [](OpenFrame& f) { f.vote(yes, no); }},
    {"decide", [](OpenFrame& f) { f.decide(); }},
    {"close", [](OpenFrame& f) { f.close(noHelp); }}};

// A frame that was brought into a state in the shortest way.
std::unique_ptr<OpenFrame> frameIn(FrameState state)
{
    auto frame = std::make_unique<OpenFrame>();
    if (state == FrameState::Closed)
        return frame;
    frame->open();
    if (state == FrameState::Rendering)
        return frame;
    if (state == FrameState::Failed) {
        frame->fail(errorOf(dfb::ErrorKind::UserCode));
        return frame;
    }
    frame->closeInputs();
    if (state == FrameState::Finishing)
        return frame;
    frame->vote(yes, yes);
    if (state == FrameState::Decided)
        frame->decide();
    return frame;
}

} // namespace

TEST_CASE("Every event in every state leads to the state that the drawing shows", "[open_frame]")
{
    using S = FrameState;
    struct Row {
        S from;
        std::vector<S> to; // by event
    };
    const std::vector<Row> rows{
        // open     open, failed  close        fail         note          done         not done      may not
        //     decide  close
        {S::Closed,
         {S::Rendering, S::Failed, S::Closed, S::Closed, S::Closed, S::Closed, S::Closed, S::Closed, S::Closed,
          S::Closed}},
        {S::Rendering,
         {S::Rendering, S::Rendering, S::Finishing, S::Failed, S::Rendering, S::Rendering, S::Rendering, S::Rendering,
          S::Rendering, S::Closed}},
        {S::Finishing,
         {S::Finishing, S::Finishing, S::Finishing, S::Failed, S::Finishing, S::Voted, S::Finishing, S::Finishing,
          S::Finishing, S::Closed}},
        {S::Failed,
         {S::Failed, S::Failed, S::Failed, S::Failed, S::Failed, S::Voted, S::Voted, S::Failed, S::Failed, S::Closed}},
        {S::Voted,
         {S::Voted, S::Voted, S::Voted, S::Voted, S::Voted, S::Voted, S::Voted, S::Voted, S::Decided, S::Closed}},
        {S::Decided,
         {S::Decided, S::Decided, S::Decided, S::Decided, S::Decided, S::Decided, S::Decided, S::Decided, S::Decided,
          S::Closed}}};
    REQUIRE(rows.size() == 6);
    for (const Row& row : rows) {
        REQUIRE(row.to.size() == events.size());
        for (std::size_t e = 0; e < events.size(); ++e) {
            INFO("in state " << static_cast<int>(row.from) << ": " << events[e].first);
            const auto frame = frameIn(row.from);
            REQUIRE(frame->state() == row.from);
            const bool isRefused = e < 2 && row.from != S::Closed; // a frame that is open already
            if (isRefused)
                CHECK_THROWS_AS(events[e].second(*frame), dfb::InvalidArgument);
            else
                events[e].second(*frame);
            CHECK(frame->state() == row.to[e]);
        }
    }
}

TEST_CASE("What a failure says depends on whether this rank has voted, and who was told first", "[open_frame]")
{
    OpenFrame frame;
    frame.open();
    CHECK_FALSE(frame.failed());
    CHECK(frame.note(errorOf(dfb::ErrorKind::DuplicateInput)));
    CHECK_FALSE(frame.failed());
    auto failure = frame.fail(errorOf(dfb::ErrorKind::MalformedMessage));
    CHECK((failure.isFirst && failure.inTime && frame.failed() && frame.isDamaged()));
    CHECK(frame.reason()->kind == dfb::ErrorKind::DuplicateInput); // the noted error came first
    failure = frame.fail(errorOf(dfb::ErrorKind::UserCode));
    CHECK((!failure.isFirst && failure.inTime));
    CHECK_FALSE(frame.vote(no, no));
    CHECK(frame.vote(no, yes));
    CHECK_FALSE(frame.vote(yes, yes)); // only once
    CHECK_FALSE(frame.note(errorOf(dfb::ErrorKind::UserCode)));
    CHECK_FALSE(frame.fail(errorOf(dfb::ErrorKind::UserCode)).inTime);
    frame.close(noHelp);
    CHECK(frame.failed()); // until the next frame
    frame.open();
    CHECK((!frame.failed() && !frame.isDamaged() && !frame.reason()));
    frame.close(noHelp);

    frame.open(); // a failure after the vote only stops this rank's work
    frame.closeInputs();
    CHECK(frame.vote(yes, yes));
    failure = frame.fail(errorOf(dfb::ErrorKind::UserCode));
    CHECK((failure.isFirst && !failure.inTime && frame.failed()));
    frame.close(noHelp);

    frame.open(errorOf(dfb::ErrorKind::UserCode)); // the caller has told the others
    CHECK(frame.failed());
    CHECK_FALSE(frame.fail(errorOf(dfb::ErrorKind::MalformedMessage)).isFirst);
    CHECK(frame.reason()->kind == dfb::ErrorKind::UserCode);
    CHECK(frame.vote(no, yes));
    frame.close(noHelp);
}

TEST_CASE("A rank does not vote on a frame that has failed while it reads inputs in place", "[open_frame]")
{
    OpenFrame frame;
    frame.open();
    CHECK(frame.beginReading());
    CHECK(frame.beginReading(true)); // two threads
    frame.fail(errorOf(dfb::ErrorKind::UserCode));
    CHECK_FALSE(frame.vote(yes, yes));
    CHECK_FALSE(frame.beginReading()); // no more reader may begin
    CHECK_FALSE(frame.endReading());
    CHECK_FALSE(frame.vote(yes, yes));
    CHECK(frame.endReading()); // the last reader must try again
    CHECK(frame.vote(yes, yes));
    frame.close(noHelp);

    frame.open(); // copied inputs may be read for long
    CHECK(frame.beginReading());
    frame.fail(errorOf(dfb::ErrorKind::TimedOut));
    CHECK(frame.vote(yes, yes));
    CHECK(frame.endReading());
    frame.close(noHelp);

    frame.open(); // a good frame waits for its tiles, not only for readers
    CHECK(frame.beginReading(true));
    frame.closeInputs();
    CHECK_FALSE(frame.endReading());
    CHECK(frame.vote(yes, yes));
    frame.close(noHelp);
}

TEST_CASE("The tiles of a rank are finished when all are known and none is left", "[open_frame]")
{
    OpenFrame frame;
    frame.open();
    CHECK_FALSE(frame.tileFinished()); // it can be counted later
    frame.expectTiles(2);
    CHECK_FALSE(frame.areTilesKnown());
    CHECK_FALSE(frame.expectNoMore());
    CHECK(frame.areTilesKnown());
    CHECK(frame.tileFinished());
    CHECK_FALSE(frame.areTilesFinished());
    frame.setTilesFinished();
    CHECK(frame.areTilesFinished());
    frame.close(noHelp);
    frame.open(); // nothing of it is left
    CHECK_FALSE(frame.areTilesKnown());
    CHECK_FALSE(frame.areTilesFinished());
    CHECK(frame.expectNoMore()); // a rank that has none
    frame.close(noHelp);
}

TEST_CASE("Frames that take turns are numbered in turns", "[open_frame]")
{
    OpenFrame first(1, 2), second(2, 2);
    for (const int frame : {1, 3, 5}) {
        CHECK(first.next() == frame);
        first.open();
        CHECK(first.number() == frame);
        first.close(noHelp);
        second.open();
        CHECK(second.number() == frame + 1);
        second.close(noHelp);
    }
}

TEST_CASE("A message is of this frame, the last, the next, or none that can be", "[open_frame]")
{
    OpenFrame frame(2, 3);
    frame.open();
    const auto enter = [&](std::int64_t number) {
        dfb::detail::MessageHeader header;
        header.number = number;
        dfb::Buffer message;
        return frame.enter(1, header, message);
    };
    CHECK(enter(2) == OpenFrame::Entry::Inside);
    frame.leave();
    CHECK(enter(-1) == OpenFrame::Entry::Late);
    CHECK(enter(5) == OpenFrame::Entry::Kept);
    CHECK(enter(8) == OpenFrame::Entry::Absurd);
    CHECK(enter(std::int64_t{1} << 62) == OpenFrame::Entry::Absurd);
    frame.close(noHelp);
    CHECK(frame.open().size() == 1);
    frame.close(noHelp);
}

TEST_CASE("Closing does itself what it waits for", "[open_frame]")
{
    OpenFrame frame;
    frame.open();
    int asked = 0;
    std::vector<OpenFrame::Inside> inside;
    for (int i = 0; i < 3; ++i) {
        inside.push_back(frame.enter(1));
        CHECK(inside.back());
    }
    frame.close([&] {
        if (++asked % 2 == 0) // not at once
            return false;
        inside.pop_back();
        return true;
    });
    CHECK(inside.empty());
}

TEST_CASE("Closing waits for work that somebody inside has begun meanwhile", "[open_frame]")
{
    OpenFrame frame;
    for (int number = 1; number <= 3; ++number) { // the count must be right again for the next frame
        frame.open();
        OpenFrame::Inside first = frame.enter(number);
        REQUIRE(first);
        std::atomic<bool> closed{false};
        std::thread closing([&] {
            frame.close(noHelp);
            closed = true;
        });
        while (frame.enter(number)) // until it has begun to close
            std::this_thread::yield();
        OpenFrame::Inside second = frame.enterAgain();
        first.reset();
        for (int i = 0; i < 1000; ++i)
            std::this_thread::yield();
        CHECK_FALSE(closed);
        second.reset();
        closing.join();
        CHECK(closed);
        CHECK_FALSE(frame.enter(number));
    }
}

} // namespace open_frame_cases
