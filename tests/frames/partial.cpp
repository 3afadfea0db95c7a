// Frames that lose inputs: with allowPartial, the rest of the image is there, with a list of what is missing. Frames
// that are cancelled by any rank and thread at any time. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"
#include "send_all.hpp"

#include <algorithm>
#include <chrono>
#include <memory>
#include <set>
#include <stdexcept>
#include <thread>
#include <vector>

namespace frame_cases {

// An operation that fails for one tile if it is told to.
struct FailsAt {
    int tile = -1;
    bool inNewFrame = false;
};
class FailingBlend : public dfb::BasicAlphaBlend<16> {
public:
    using FrameData = FailsAt;

    void newFrame(const dfb::TileInfo& info, const FailsAt& data)
    {
        BasicAlphaBlend::newFrame(info);
        fails_ = info.tile == data.tile;
        if (fails_ && data.inNewFrame)
            throw std::runtime_error("this loop cannot, nor can the operation");
    }
    void finish(dfb::FinishedTile& out)
    {
        if (fails_)
            throw std::runtime_error("this operation cannot");
        BasicAlphaBlend::finish(out);
    }

private:
    bool fails_ = false;
};

// On the display rank: complete tiles are right, and the others show the background. All of `missing` are incomplete;
// with `exactly` no other tile is. Without, a busy machine may let a time-out pass that was not meant for other tiles.
template <class FrameBuffer>
void checkTiles(Result& result, const FrameBuffer& fb, const dfb::FrameReport& report, const scene::Scene& s,
                const std::set<int>& missing, bool exactly, const std::string& what)
{
    if (!fb.isDisplayRank())
        return;
    const scene::Picture picture(fb.image(), report);
    std::set<int> incomplete;
    for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
        if (!fb.isComplete(tile))
            incomplete.insert(tile);
    const std::size_t wrong = wrongValues(picture, referenceOf(s, fb, referenceOf(s)));
    result.expect(wrong == 0, what + ": " + std::to_string(wrong) + " values");
    result.expect(exactly ? incomplete == missing
                          : std::includes(incomplete.begin(), incomplete.end(), missing.begin(), missing.end()),
                  what + ": other tiles are missing, " + std::to_string(incomplete.size()));
    const bool mayLoseAll = report.failure && report.failure->kind == dfb::ErrorKind::Cancelled;
    result.expect(mayLoseAll || 2 * incomplete.size() < static_cast<std::size_t>(fb.layout().tileCount()),
                  what + ": most tiles are missing, " + std::to_string(incomplete.size()));
    result.expect(report.tilesIncomplete == static_cast<std::int64_t>(incomplete.size()), what + ": the count");
    if (exactly)
        result.hash = result.hash * 31 + picture.hash();
}

struct PartialFrames {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        for (const bool shared : {true, false}) {
            dfb::NetworkConfig options;
            options.sharedMemory = shared;
            const scene::Scene s = scene::makeScene(5, 3);
            constexpr int never = 20000, soon = 2000; // ms; even if busy, enough for all that is not lost
            auto config = configOf(s, 2);
            config.quiet = std::chrono::milliseconds(never);
            using FrameBuffer = dfb::DistributedFrameBuffer<FailingBlend, dfb::NoPixelOp, Transport>;
            FrameBuffer fb(communicator, config, options);
            auto params = paramsOf(s);
            params.allowPartial = true;
            const auto mine = bricksOf(s, fb.rank(), fb.size());
            // The first two tiles that meet the first brick; most owner maps give them to different ranks.
            std::set<int> two;
            for (int tile = 0; two.size() < 2; ++tile)
                if (scene::meets(fb, s.bricks[0], tile))
                    two.insert(tile);
            const int lost = *two.begin();
            const std::set<int> one{lost}, none;
            const dfb::World world(mine);
            dfb::DataParallelLoop loop(fb, world);
            const auto frame = [&](int timeoutMs, const auto& render, const FailsAt& fails) {
                params.timeout = std::chrono::milliseconds(timeoutMs);
                return loop.render(scene::FlatCamera(), render, params, fails);
            };
            const auto renderAll = [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); };
            const auto fails = [&](const dfb::FrameReport& report, dfb::ErrorKind kind, const std::string& text,
                                   const std::set<int>& missing, bool exactly, const std::string& what) {
                result.expect(report.failure && report.failure->kind == kind
                                  && scene::has(report.failure->message, text),
                              what + ": " + (report.failure ? report.failure->message : std::string("no failure")));
                checkTiles(result, fb, report, s, missing, exactly, what);
            };
            const auto isFine = [&](const std::string& what) {
                const dfb::FrameReport report = frame(never, renderAll, {});
                result.expect(!report.failure && report.tilesIncomplete == 0, what + ": it does not count as whole");
                checkTiles(result, fb, report, s, none, true, what);
            };
            isFine("the first");
            const auto start = std::chrono::steady_clock::now();
            fails(frame(never,
                        [&](const dfb::Brick& b, auto& tile) {
                            if (two.count(tile.tile) == 1 && b.id == s.bricks[0].id)
                                throw std::runtime_error("this renderer cannot");
                            renderBrick(s, b, tile);
                        },
                        {}),
                  dfb::ErrorKind::UserCode, "this renderer cannot", two, true, "a renderer");
            isFine("after a renderer");
            {
                // Without declarations; the operation cannot begin one of the tiles.
                auto open = fb.begin(params, {lost, true});
                const auto tile = std::make_unique<FrameBuffer::Tile>();
                for (const dfb::Brick& b : mine)
                    for (const int index : two)
                        if (b.id == s.bricks[0].id)
                            open.abort(std::make_exception_ptr(std::runtime_error("this loop cannot")), index);
                for (int index = 0; index < fb.layout().tileCount(); ++index) {
                    if (fb.tileOwner(index) == fb.rank())
                        scene::sendParent(open, *tile, index, scene::bricksIn(fb, s, index));
                    for (const dfb::Brick& b : mine)
                        if (scene::meets(fb, b, index) && (two.count(index) == 0 || b.id != s.bricks[0].id))
                            scene::sendInput(open, *tile, s, b, index);
                }
                fails(open.end(), dfb::ErrorKind::UserCode, "this loop cannot", two, true, "a loop");
            }
            fails(frame(never, renderAll, {lost}), dfb::ErrorKind::UserCode, "this operation cannot", one, true,
                  "an operation");
            result.expect(std::chrono::steady_clock::now() - start < std::chrono::milliseconds(never / 2),
                          "a frame waits for what is lost");
            isFine("after an operation");
            {
                // Inputs that are announced and never come.
                params.timeout = std::chrono::milliseconds(soon);
                auto open = fb.begin(params);
                const auto tile = std::make_unique<FrameBuffer::Tile>();
                if (fb.tileOwner(lost) == fb.rank()) {
                    open.start(*tile, lost);
                    tile->source = 1000;
                    tile->children = 1;
                    open.setTile(*tile);
                }
                for (int index = 0; index < fb.layout().tileCount(); ++index)
                    if (index != lost && fb.tileOwner(index) == fb.rank())
                        scene::sendParent(open, *tile, index, scene::bricksIn(fb, s, index));
                for (int index = 0; index < fb.layout().tileCount(); ++index)
                    for (const dfb::Brick& b : mine)
                        if (index != lost && scene::meets(fb, b, index))
                            scene::sendInput(open, *tile, s, b, index);
                fails(open.end(), dfb::ErrorKind::TimedOut, "tile " + std::to_string(lost), one, false,
                      "a missing input");
            }
            {
                params.timeout = std::chrono::milliseconds(never);
                auto open = fb.begin(params);
                sendAll(fb, open, s, false);
                if (fb.rank() == fb.size() / 2)
                    open.cancel();
                fails(open.end(), dfb::ErrorKind::Cancelled, "cancelled", none, false, "a frame that is cancelled");
            }
            isFine("the last");
        }
        return result;
    }
};

struct CancelledFrames {
    static Result run(const Transport::Communicator& communicator)
    {
        enum When { AtOnce, HalfWay, BeforeEnd, InEnd, Times };
        Result result;
        const scene::Scene s = scene::makeScene(5, 3);
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(communicator,
                                                                                            configOf(s, 2));
        for (int who = 0; who < fb.size(); ++who)
            for (int when = AtOnce; when < Times; ++when) {
                const std::string what = "rank " + std::to_string(who) + " at " + std::to_string(when);
                {
                    auto frame = fb.begin(paramsOf(s));
                    const auto cancel = [&](int now) {
                        if (fb.rank() == who && when == now)
                            std::thread([&] { frame.cancel(); }).join(); // any thread may cancel
                    };
                    cancel(AtOnce);
                    sendAll(fb, frame, s, false);
                    cancel(HalfWay);
                    if (when == BeforeEnd)
                        sendAll(fb, frame, s, true);
                    cancel(BeforeEnd);
                    std::thread other;
                    if (fb.rank() == who && when == InEnd) // end() cannot return without it
                        other = std::thread([&] { frame.cancel(); });
                    const std::string outcome = scene::outcomeOf([&] { frame.end(); });
                    if (other.joinable())
                        other.join();
                    result.expect(when == BeforeEnd ? outcome == "fine" || scene::has(outcome, "cancelled")
                                                    : scene::has(outcome, "FrameError")
                                                          && scene::has(outcome, "the frame was cancelled"),
                                  what + ": " + outcome);
                }
                const dfb::FrameReport report = renderLoop(fb, s, scene::Loop::Listing3);
                result.hash = checkedHash(result, fb, report, s, what + ": the frame after");
            }
        return result;
    }
};

// Which frame the image is of, if there is an image.
struct ImageOfFrame {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5, 3);
        for (const int inFlight : {1, 2}) {
            auto config = configOf(s, 2);
            config.framesInFlight = inFlight;
            dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(communicator, config);
            const bool isAlone = inFlight == 1; // then all frames share one image
            const auto expect = [&](std::int64_t frame, const std::string& when) {
                const std::int64_t here = fb.isDisplayRank() ? frame : -1;
                const std::string what = when + ", " + std::to_string(inFlight) + " in flight";
                result.expect(fb.imageFrame() == here, what + ": the image is of " + std::to_string(fb.imageFrame()));
                result.expect(fb.image().empty() == (here < 0), what + ": there is an image or not");
                if (here >= 0) {
                    const scene::Picture picture(fb.image(), {});
                    result.expect(wrongValues(picture, referenceOf(s)) == 0, what + ": values");
                    result.hash = picture.hash();
                }
            };
            const auto isThere = [&](const std::string& when) {
                const std::int64_t frame = renderLoop(fb, s, scene::Loop::Listing3).frame;
                expect(frame, when);
                return frame;
            };
            expect(-1, "before the first frame");
            std::int64_t last = isThere("the first");
            {
                auto frame = fb.begin(paramsOf(s));
                expect(isAlone ? -1 : last, "during a frame");
                sendAll(fb, frame, s, false);
                if (fb.rank() == fb.size() - 1) // when all inputs but some are there
                    frame.abort(std::make_exception_ptr(std::runtime_error("on purpose")));
                sendAll(fb, frame, s, true);
                const std::string outcome = scene::outcomeOf([&] { frame.end(); });
                result.expect(scene::has(outcome, "on purpose"), outcome);
                expect(isAlone ? -1 : last, "after one that failed");
            }
            last = isThere("the next");
            auto wrong = paramsOf(s);
            wrong.timeout = std::chrono::milliseconds(-1);
            result.expect(scene::has(scene::outcomeOf([&] { (void)fb.begin(wrong); }), "InvalidArgument"),
                          "no begin()");
            expect(last, "after a begin() that was refused");
            {
                auto frame = fb.begin(paramsOf(s));
                sendAll(fb, frame, s, false);
            }
            expect(isAlone ? -1 : last, "after one that was left");
            auto partial = paramsOf(s);
            partial.timeout = std::chrono::milliseconds(20000);
            partial.allowPartial = true;
            auto frame = fb.begin(partial);
            sendAll(fb, frame, s, false);
            sendAll(fb, frame, s, true);
            if (fb.rank() == fb.size() - 1)
                frame.abort(std::make_exception_ptr(std::runtime_error("on purpose")));
            const auto report = frame.end();
            result.expect(report.failure && report.tilesIncomplete == 0, "a failure that costs no tile");
            expect(report.frame, "after one that is partial");
            isThere("the last");
        }
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("A frame that may be partial has all tiles but those that lost something", "[partial]")
{
    everywhereAtOnce<frame_cases::PartialFrames>();
}

TEST_CASE("A frame can be cancelled by any rank and thread at any time, and the next is right", "[partial]")
{
    everywhere<frame_cases::CancelledFrames>();
}

TEST_CASE("There is an image of a frame that ended well, and none of one that failed", "[partial]")
{
    everywhere<frame_cases::ImageOfFrame>();
}
