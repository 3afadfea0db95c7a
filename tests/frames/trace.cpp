// A TraceSink's events: they agree with the report of the frame on every rank; sends and receipts pair up; differing
// clocks are aligned; frames that fail end their spans. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"
#include "send_all.hpp"

#include <dfb/comm/mailbox.hpp>
#include <dfb/trace_file.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <map>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace frame_cases {

using TraceKind = dfb::TraceEvent::Kind;
using Records = std::vector<dfb::detail::TraceRecord>;

// Keeps events, with times as if this rank's clock were ahead.
class KeepingSink final : public dfb::TraceSink {
public:
    explicit KeepingSink(std::chrono::nanoseconds ahead = {}) : ahead_(ahead) {}

    void add(const dfb::TraceEvent& event) noexcept override
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        const int thread =
            threads_.emplace(std::this_thread::get_id(), static_cast<int>(threads_.size())).first->second;
        records_.push_back({event, thread});
        records_.back().event.begin += ahead_;
        records_.back().event.end += ahead_;
    }
    Records records() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return records_;
    }

private:
    const std::chrono::nanoseconds ahead_;
    mutable std::mutex mutex_;
    std::map<std::thread::id, int> threads_;
    Records records_;
};

using TracedBlend = dfb::BasicAlphaBlend<16>;

// A framebuffer with a sink. Without shared memory owners send their finished tiles, so all bytes are in messages.
struct Traced {
    Traced(const Transport::Communicator& communicator, std::chrono::nanoseconds aheadByRank = {},
           int framesInFlight = 1)
    {
        dfb::NetworkConfig network;
        network.sharedMemory = false;
        auto connection = dfb::connect<Transport>(communicator, network);
        sink = std::make_shared<KeepingSink>(aheadByRank * connection->rank());
        auto config = configOf(scene::makeScene(1), 2);
        config.framesInFlight = framesInFlight;
        config.trace = sink;
        fb = std::make_unique<FrameBuffer>(std::move(connection), config);
    }

    // The records of all ranks, on all ranks. Collective.
    std::vector<Records> all()
    {
        for (int round = 0; round < 10; ++round)
            fb->allGather({});
        const Records mine = sink->records();
        std::vector<std::byte> bytes(mine.size() * sizeof mine[0]);
        std::memcpy(bytes.data(), mine.data(), bytes.size());
        std::vector<Records> ranks;
        for (const auto& part : fb->allGather(bytes)) {
            ranks.emplace_back(part.size() / sizeof mine[0]);
            std::memcpy(ranks.back().data(), part.data(), part.size());
        }
        return ranks;
    }

    using FrameBuffer = dfb::DistributedFrameBuffer<TracedBlend, dfb::NoPixelOp, Transport>;
    std::shared_ptr<KeepingSink> sink;
    std::unique_ptr<FrameBuffer> fb;
};

std::vector<dfb::TraceEvent> eventsOf(const Records& records, TraceKind kind, std::int64_t frame)
{
    std::vector<dfb::TraceEvent> events;
    for (const auto& r : records)
        if (r.event.kind == kind && r.event.frame == frame)
            events.push_back(r.event);
    return events;
}

double msOf(const dfb::TraceEvent& e) { return std::chrono::duration<double, std::milli>(e.end - e.begin).count(); }

// The send and receipt of each message, by sender, receiver and running number.
using Journeys = std::map<std::array<int, 3>, std::pair<const dfb::TraceEvent*, const dfb::TraceEvent*>>;
Journeys journeysOf(const std::vector<Records>& ranks)
{
    Journeys all;
    for (std::size_t r = 0; r < ranks.size(); ++r)
        for (const auto& record : ranks[r]) {
            const dfb::TraceEvent& e = record.event;
            const int rank = static_cast<int>(r), number = static_cast<int>(e.sequence);
            if (e.kind == TraceKind::Send)
                all[{rank, e.peer, number}].first = &e;
            else if (e.kind == TraceKind::Receive && e.peer != rank)
                all[{e.peer, rank, number}].second = &e;
        }
    return all;
}

// Whether a message of a frame has not been handled yet. Frames do not wait for all of them.
bool isAnyUnderWay(const std::vector<Records>& ranks)
{
    const Journeys all = journeysOf(ranks);
    return std::any_of(all.begin(), all.end(), [](const auto& one) {
        const auto& [sent, received] = one.second;
        return sent && sent->frame >= 0 && !received;
    });
}

// Whether any two spans of a thread are nested or disjoint.
bool areNested(Records records)
{
    std::stable_sort(records.begin(), records.end(), [](const auto& a, const auto& b) {
        return a.event.begin != b.event.begin ? a.event.begin < b.event.begin : a.event.end > b.event.end;
    });
    std::map<int, std::vector<dfb::TraceEvent>> open;
    for (const auto& r : records) {
        if (r.event.kind <= TraceKind::Verdict)
            continue;
        auto& around = open[r.thread];
        while (!around.empty() && around.back().end <= r.event.begin)
            around.pop_back();
        if (!around.empty() && around.back().end < r.event.end)
            return false;
        around.push_back(r.event);
    }
    return true;
}

// With two frames in flight, each figure that is both in the report and in the trace is the same in both.
struct TraceAgrees {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        Traced traced(communicator, {}, 2);
        auto& fb = *traced.fb;
        std::vector<dfb::FrameReport> reports;
        for (std::uint64_t round = 0; round < 3; ++round) {
            const scene::Scene a = scene::makeScene(5, 2 * round + 1), b = scene::makeScene(7, 2 * round + 2);
            auto first = fb.begin(paramsOf(a));
            sendAll(fb, first, a, false);
            auto second = fb.begin(paramsOf(b));
            sendAll(fb, second, b, false);
            sendAll(fb, first, a, true);
            sendAll(fb, second, b, true);
            reports.push_back(first.end());
            reports.push_back(second.end());
        }
        std::vector<Records> ranks = traced.all();
        for (int round = 0; round < 50 && isAnyUnderWay(ranks); ++round) { // the same on all ranks
            std::this_thread::sleep_for(std::chrono::milliseconds(100));
            ranks = traced.all();
        }
        for (const Records& records : ranks)
            result.expect(areNested(records), "spans of a thread overlap");
        for (const dfb::FrameReport& report : reports)
            check(result, fb, report, ranks);
        std::size_t pairs = 0;
        for (const auto& [key, journey] : journeysOf(ranks)) {
            if (!journey.first || journey.first->frame < 0)
                continue; // the last messages of all() are still under way
            const bool isWhole = journey.second && journey.second->byteCount == journey.first->byteCount
                                 && journey.second->message == journey.first->message
                                 && journey.second->frame == journey.first->frame;
            result.expect(isWhole, "a message that was not received, or another one");
            pairs += isWhole;
        }
        result.expect((pairs > 0) == (fb.size() > 1), "pairs");
        return result;
    }

    template <class FrameBuffer>
    static void check(Result& result, const FrameBuffer& fb, const dfb::FrameReport& report,
                      const std::vector<Records>& ranks)
    {
        const auto isNear = [](double a, double b) { return std::abs(a - b) <= 0.01 * std::abs(b); };
        std::map<TraceKind, std::size_t> counts;
        double bytes = 0, votedBytes = 0, messages = 0, longest = 0;
        for (const Records& records : ranks) {
            for (const TraceKind kind : {TraceKind::SetTile, TraceKind::Input, TraceKind::Finish, TraceKind::Verdict})
                counts[kind] += eventsOf(records, kind, report.frame).size();
            const auto verdicts = eventsOf(records, TraceKind::Verdict, report.frame);
            if (verdicts.size() != 1)
                return result.expect(false, "not one verdict");
            votedBytes += static_cast<double>(verdicts[0].byteCount);
            longest = std::max(longest, msOf(eventsOf(records, TraceKind::Render, report.frame).at(0)));
            for (const dfb::TraceEvent& e : eventsOf(records, TraceKind::Send, report.frame)) {
                const auto kind = static_cast<dfb::detail::MessageKind>(e.message);
                if (dfb::detail::Mailbox::needsCredit(kind) || e.begin < verdicts[0].begin) { // counted in the report
                    bytes += static_cast<double>(e.byteCount);
                    messages += 1;
                }
            }
        }
        const Records& mine = ranks[static_cast<std::size_t>(fb.rank())];
        const auto ms = [&](TraceKind kind) { return msOf(eventsOf(mine, kind, report.frame).at(0)); };
        result.expect(isNear(ms(TraceKind::Frame), report.totalMs), "totalMs");
        result.expect(isNear(ms(TraceKind::Render), report.renderMs), "renderMs");
        result.expect(isNear(ms(TraceKind::End), report.compositingOverheadMs), "compositingOverheadMs");
        result.expect(isNear(longest, report.renderMsMax), "renderMsMax");
        result.expect(isNear(votedBytes, static_cast<double>(report.bytesSent)), "bytes of votes");
        result.expect(isNear(bytes, static_cast<double>(report.bytesSent)),
                      "bytes of messages: " + std::to_string(bytes) + " for " + std::to_string(report.bytesSent));
        result.expect(std::abs(messages - static_cast<double>(report.messagesSent))
                          <= std::max(1.0, 0.01 * static_cast<double>(report.messagesSent)),
                      "messages: " + std::to_string(messages) + " for " + std::to_string(report.messagesSent));
        result.expect(counts[TraceKind::SetTile] == counts[TraceKind::Input], "inputs");
        result.expect(counts[TraceKind::Finish] == static_cast<std::size_t>(report.tilesTotal), "finished tiles");
    }
};

// The clocks of ranks are seconds apart, in either direction.
struct ClocksApart {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        for (const std::chrono::nanoseconds ahead :
             {std::chrono::nanoseconds(1'234'567'891), -std::chrono::nanoseconds(77'000'000'003)}) {
            Traced traced(communicator, ahead);
            const scene::Scene s = scene::makeScene(5, 3);
            const auto begin = std::chrono::steady_clock::now();
            auto frame = traced.fb->begin(paramsOf(s));
            sendAll(*traced.fb, frame, s, false);
            sendAll(*traced.fb, frame, s, true);
            frame.end();
            const auto took = std::chrono::steady_clock::now() - begin; // long on a busy machine, as are messages
            const std::vector<Records> ranks = traced.all();
            const auto clocks = dfb::detail::TraceWriter(ranks).clocks();
            for (std::size_t r = 0; r < ranks.size(); ++r) {
                const std::chrono::nanoseconds off = clocks[r].ahead - ahead * static_cast<int>(r);
                result.expect(std::chrono::abs(off) <= clocks[r].error, "further off than said");
                result.expect(clocks[r].error < took + std::chrono::milliseconds(500), "not known well");
            }
            for (const auto& [key, journey] : journeysOf(ranks))
                if (journey.first && journey.second) {
                    const auto began = [&](const dfb::TraceEvent* e, int rank) {
                        return e->begin - clocks[static_cast<std::size_t>(rank)].ahead;
                    };
                    result.expect(began(journey.first, key[0]) <= began(journey.second, key[1]),
                                  "received before it was sent");
                }
        }
        return result;
    }
};

// One frame that a rank aborts, one that a rank leaves without end(), and one that succeeds.
struct FailedFramesEnd {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        Traced traced(communicator);
        auto& fb = *traced.fb;
        const bool isLast = fb.rank() == fb.size() - 1;
        const scene::Scene s = scene::makeScene(5, 3);
        {
            auto frame = fb.begin(paramsOf(s));
            sendAll(fb, frame, s, false);
            if (isLast)
                frame.abort(std::make_exception_ptr(std::runtime_error("on purpose")));
            sendAll(fb, frame, s, true);
            result.expect(scene::has(scene::outcomeOf([&] { frame.end(); }), "on purpose"), "not aborted");
        }
        {
            auto frame = fb.begin(paramsOf(s));
            sendAll(fb, frame, s, false);
            if (!isLast)
                result.expect(scene::has(scene::outcomeOf([&] { frame.end(); }), "without end()"), "not left");
        }
        auto frame = fb.begin(paramsOf(s));
        sendAll(fb, frame, s, false);
        sendAll(fb, frame, s, true);
        frame.end();
        const std::vector<Records> ranks = traced.all();
        for (std::int64_t number = 1; number <= 3; ++number)
            for (const Records& records : ranks) {
                const auto at = [&](TraceKind kind) {
                    const auto events = eventsOf(records, kind, number);
                    result.expect(events.size() == 1, "a frame without its spans");
                    return events.empty() ? dfb::TraceEvent() : events.front();
                };
                const dfb::TraceEvent whole = at(TraceKind::Frame), first = at(TraceKind::Render),
                                      rest = at(TraceKind::End), verdict = at(TraceKind::Verdict);
                result.expect(whole.begin == first.begin && first.end == rest.begin && rest.end == whole.end,
                              "parts that are not the whole");
                result.expect(whole.begin <= verdict.begin && verdict.begin <= verdict.end && verdict.end <= whole.end,
                              "a verdict outside of its frame");
                for (const auto& r : records)
                    if (r.event.frame == number && r.event.kind == TraceKind::Finish)
                        result.expect(r.event.begin >= whole.begin && r.event.end <= whole.end, "a tile after the end");
            }
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("a trace agrees with the reports of its frames", "[trace]") { everywhere<frame_cases::TraceAgrees>(); }
TEST_CASE("a trace has the clocks of all ranks on one") { everywhere<frame_cases::ClocksApart>(); }
TEST_CASE("a trace has the ends of frames that fail") { everywhere<frame_cases::FailedFramesEnd>(); }
