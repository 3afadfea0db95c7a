// TraceFile: keeps the events of a rank, and writes those of all ranks into one file in the Trace Event Format, which
// Perfetto (ui.perfetto.dev) and speedscope open. The file has a process for each rank, with rows for its frames and
// its threads, and an arrow for each message.
#pragma once

#include <dfb/comm/message.hpp>
#include <dfb/error.hpp>
#include <dfb/trace.hpp>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <fstream>
#include <locale>
#include <map>
#include <mutex>
#include <new>
#include <ostream>
#include <set>
#include <string>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

namespace detail {

// An event, and which thread of its rank reported it.
struct TraceRecord {
    TraceEvent event;
    std::int32_t thread = 0; // from 0
};
static_assert(std::is_trivially_copyable_v<TraceRecord>); // it travels as it is

// Writes the records of all ranks as text, with their times on one clock.
class TraceWriter {
public:
    using Duration = TraceEvent::Clock::duration;
    // How far a rank's clock is ahead of rank 0's, and by how much that may be wrong.
    struct RankClock {
        Duration ahead{0}, error{0};
    };

    explicit TraceWriter(std::vector<std::vector<TraceRecord>> ranks) : ranks_(std::move(ranks)), clocks_(ranks_.size())
    {
        findMessages();
        alignClocks();
    }

    const std::vector<RankClock>& clocks() const noexcept { return clocks_; }

    // `dropped`: how many records are missing.
    void write(std::ostream& out, std::int64_t dropped)
    {
        first_ = TraceEvent::Clock::time_point::max();
        for (std::size_t rank = 0; rank < ranks_.size(); ++rank)
            for (const TraceRecord& r : ranks_[rank])
                first_ = std::min(first_, r.event.begin - clocks_[rank].ahead);
        out << "{\"displayTimeUnit\": \"ms\", \"otherData\": {\"dropped\": " << dropped << ", \"clockErrorUs\": [";
        for (std::size_t rank = 0; rank < ranks_.size(); ++rank)
            out << (rank > 0 ? ", " : "") << microseconds(clocks_[rank].error);
        out << "]}, \"traceEvents\": [";
        for (std::size_t rank = 0; rank < ranks_.size(); ++rank)
            writeRank(out << (rank > 0 ? ",\n" : "\n"), rank);
        std::size_t id = 0;
        for (const auto& [key, m] : messages_) {
            if (!m.sent || !m.received)
                continue; // the frame had failed, or records are missing
            const auto arrow = printed(R"("cat": "message", "name": "%s", "id": %zu)", messageOf(m.sent->event), ++id);
            out << ",\n{\"ph\": \"s\", " << arrow << place(key[0], rowOf(*m.sent), m.sent->event.begin) << '}';
            out << ",\n{\"ph\": \"f\", \"bp\": \"e\", " << arrow
                << place(key[1], rowOf(*m.received), m.received->event.begin) << '}';
        }
        out << "\n]}\n";
    }

private:
    using Time = TraceEvent::Clock::time_point;
    struct Message {
        const TraceRecord *sent = nullptr, *received = nullptr;
    };

    void findMessages()
    {
        for (std::size_t rank = 0; rank < ranks_.size(); ++rank)
            for (const TraceRecord& r : ranks_[rank]) {
                const auto peer = static_cast<std::size_t>(r.event.peer);
                if (peer == rank)
                    continue; // it did not travel
                if (r.event.kind == TraceEvent::Kind::Send)
                    messages_[{rank, peer, r.event.sequence}].sent = &r;
                else if (r.event.kind == TraceEvent::Kind::Receive)
                    messages_[{peer, rank, r.event.sequence}].received = &r;
            }
    }

    // No message is received before it is sent. So each message, and each chain of messages, limits how far the clock
    // of one rank can be ahead of another's. Chains from and to rank 0 give each rank a lower and an upper limit. The
    // middle of both satisfies all limits.
    void alignClocks()
    {
        std::map<std::pair<std::size_t, std::size_t>, Duration> shortest; // by sender and receiver
        bool isOneClock = true;
        for (const auto& [key, m] : messages_)
            if (m.sent && m.received) {
                const Duration took = m.received->event.begin - m.sent->event.begin;
                Duration& least = shortest.emplace(std::pair(key[0], key[1]), took).first->second;
                least = std::min(least, took);
                isOneClock = isOneClock && took.count() >= 0;
            }
        constexpr Duration never = Duration::max();
        std::vector<Duration> to(ranks_.size(), never), from(ranks_.size(), never);
        to[0] = from[0] = Duration(0);
        bool isBetter = true;
        const auto shorten = [&isBetter, never](Duration& all, Duration rest, Duration step) {
            if (rest == never || rest + step >= all)
                return;
            all = rest + step;
            isBetter = true;
        };
        for (std::size_t round = 0; isBetter && round < ranks_.size(); ++round) {
            isBetter = false;
            for (const auto& [pair, took] : shortest) {
                shorten(to[pair.second], to[pair.first], took);
                shorten(from[pair.first], from[pair.second], took);
            }
        }
        for (std::size_t rank = 0; rank < ranks_.size(); ++rank)
            if (to[rank] != never && from[rank] != never) {
                const Duration ahead = isOneClock ? Duration(0) : (to[rank] - from[rank]) / 2;
                clocks_[rank] = {ahead, std::max(to[rank] - ahead, from[rank] + ahead)};
            }
    }

    void writeRank(std::ostream& out, std::size_t rank) const
    {
        const int pid = static_cast<int>(rank);
        out << printed(R"({"ph": "M", "name": "process_name", "pid": %d, "args": {"name": "rank %d"}})", pid, pid);
        std::vector<TraceRecord> records = ranks_[rank];
        std::sort(records.begin(), records.end(), [](const TraceRecord& a, const TraceRecord& b) {
            const TraceEvent &x = a.event, &y = b.event;
            return x.begin != y.begin ? x.begin < y.begin : x.end != y.end ? x.end > y.end : x.kind < y.kind;
        });
        std::set<int> named;
        std::vector<std::vector<TraceEvent>> open; // for each row of frames: the events that are not over, nested
        for (const TraceRecord& r : records) {
            const TraceEvent& e = r.event;
            const bool isThread = e.kind > TraceEvent::Kind::Verdict;
            const int row = isThread ? rowOf(r) : frameRow(open, e);
            if (named.insert(row).second)
                out << printed(",\n{\"ph\": \"M\", \"name\": \"thread_name\", \"pid\": %d, \"tid\": %d, \"args\": "
                               "{\"name\": \"%s %d\"}}",
                               pid, row, isThread ? "thread" : "frames", isThread ? r.thread : row);
            // Viewers add the duration to the begin, and round. 1 ns less keeps this span from overlapping the next
            // one.
            const bool isPart = e.kind != TraceEvent::Kind::Frame && e.end > e.begin;
            const Duration lasts = e.end - e.begin - std::chrono::nanoseconds(isPart ? 1 : 0);
            out << ",\n{\"ph\": \"X\", \"name\": \"" << nameOf(e) << '"' << place(rank, row, e.begin)
                << ", \"dur\": " << microseconds(lasts) << ", \"args\": {\"frame\": " << e.frame;
            if (e.tile >= 0)
                out << ", \"tile\": " << e.tile;
            if (e.peer >= 0)
                out << (e.kind == TraceEvent::Kind::Send ? ", \"to\": " : ", \"from\": ") << e.peer;
            if (e.byteCount > 0)
                out << ", \"bytes\": " << e.byteCount;
            out << "}}";
        }
    }

    // Frames that overlap have rows of their own. A part of a frame is in the frame's row, unless it overlaps another
    // part there.
    static int frameRow(std::vector<std::vector<TraceEvent>>& open, const TraceEvent& e)
    {
        std::size_t row = open.size();
        for (std::size_t i = open.size(); i-- > 0;) {
            std::vector<TraceEvent>& around = open[i];
            while (!around.empty() && around.back().end <= e.begin)
                around.pop_back();
            if (around.empty()) {
                row = i;
            } else if (around.back().frame == e.frame && around.back().end >= e.end) {
                row = i;
                break;
            }
        }
        if (row == open.size())
            open.emplace_back();
        open[row].push_back(e);
        return static_cast<int>(row);
    }
    static int rowOf(const TraceRecord& r) { return 1000 + r.thread; } // after the rows of frames

    std::string place(std::size_t rank, int row, Time time) const
    {
        return printed(R"(, "pid": %zu, "tid": %d, "ts": %s)", rank, row,
                       microseconds(time - clocks_[rank].ahead - first_).c_str());
    }

    static std::string microseconds(Duration duration)
    {
        const long long ns = std::chrono::nanoseconds(duration).count();
        return printed("%s%lld.%03lld", ns < 0 ? "-" : "", std::llabs(ns) / 1000, std::llabs(ns) % 1000);
    }

    static const char* messageOf(const TraceEvent& e)
    {
        static constexpr std::array<const char*, 19> names{
            "reduction up",   "reduction down", "input",       "manifest", "manifest taken",
            "finished tiles", "tiles done",     "abort",       "ask",      "credit",
            "ask for jobs",   "jobs",           "image place", "failure",  "ping",
            "pong",           "hidden",         "tile lost",   "leaving"};
        static_assert(static_cast<std::size_t>(MessageKind::End) == names.size());
        return names[std::min<std::size_t>(e.message, names.size() - 1)];
    }
    static std::string nameOf(const TraceEvent& e)
    {
        static constexpr std::array<const char*, 11> names{"frame", "render", "end",  "verdict", "tile", "setTile",
                                                           "input", "finish", "send", "receive", "wait"};
        static_assert(static_cast<std::size_t>(TraceEvent::Kind::Wait) + 1 == names.size());
        const bool isMessage = e.kind == TraceEvent::Kind::Send || e.kind == TraceEvent::Kind::Receive;
        return names[std::min(static_cast<std::size_t>(e.kind), names.size() - 1)] + std::string(isMessage ? " " : "")
               + (isMessage ? messageOf(e) : "");
    }

    std::vector<std::vector<TraceRecord>> ranks_;
    std::map<std::array<std::size_t, 3>, Message> messages_; // by sender, receiver, and sequence
    std::vector<RankClock> clocks_;
    Time first_{};
};

} // namespace detail

// One object per rank, for the framebuffers of one connection. Frames of different framebuffers may have the same
// number, as each framebuffer counts from 1.
class TraceFile final : public TraceSink {
public:
    // Keeps up to `capacity` events, 64 bytes each, in memory that it allocates now. Later events are only counted.
    // Throws std::bad_alloc.
    explicit TraceFile(std::size_t capacity = 200'000) : capacity_(capacity) { records_.reserve(capacity); }

    void add(const TraceEvent& event) noexcept override
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        try {
            const auto thread = threads_.emplace(std::this_thread::get_id(), static_cast<int>(threads_.size()));
            if (records_.size() < capacity_ + room_) {
                records_.push_back({event, thread.first->second});
                return;
            }
        } catch (const std::bad_alloc&) {
        }
        ++dropped_;
    }

    // Writes the file on rank 0, and forgets the events, even if that fails. The file also has the messages of this
    // call. Collective, outside frames, on the thread that begins frames. Waits for all ranks, without a time-out.
    // `fb`: one of the framebuffers, or an ImageCompositor. Rank 0 needs memory for the events of all ranks, each other
    // rank for those of one more. Throws InvalidArgument on all ranks if the file cannot be written. Throws
    // TransportError, and std::bad_alloc on a rank that lacks memory.
    template <class FrameBuffer>
    void write(FrameBuffer& fb, const std::string& path)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            room_ = 10'000;
        }
        constexpr int rounds = 20; // of messages to compare clocks by: the quickest ones tell most
        for (int round = 0; round < rounds; ++round)
            fb.allGather({});
        const std::vector<std::byte> mine = take();
        std::vector<std::vector<std::byte>> parts; // on rank 0
        for (int rank = 0; rank < fb.size(); ++rank) {
            std::vector<std::vector<std::byte>> one = fb.allGather(rank == fb.rank() ? mine : std::vector<std::byte>());
            if (fb.rank() == 0)
                parts.push_back(std::move(one[static_cast<std::size_t>(rank)]));
        }
        std::string reason; // why rank 0 could not write it
        if (fb.rank() == 0) {
            errno = 0;
            std::ofstream file(path);
            file.imbue(std::locale::classic());
            try {
                writeAll(file, parts);
                file.flush();
            } catch (const std::exception&) { // the others wait for our answer
                file.setstate(std::ios::badbit);
            }
            if (!file)
                reason = std::strerror(errno);
        }
        const auto* text = reinterpret_cast<const std::byte*>(reason.data());
        const std::vector<std::byte> heard = fb.allGather({text, text + reason.size()}).front();
        take(); // those of this call
        if (!heard.empty())
            detail::failArgument("%s: cannot be written: %.*s", path.c_str(), static_cast<int>(heard.size()),
                                 reinterpret_cast<const char*>(heard.data()));
    }

private:
    // Returns, as bytes, the number of events that this rank dropped, and its records; and forgets them.
    std::vector<std::byte> take()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        std::vector<std::byte> bytes(sizeof dropped_ + records_.size() * sizeof(detail::TraceRecord));
        const auto* records = reinterpret_cast<const std::byte*>(records_.data());
        std::copy_n(records, bytes.size() - sizeof dropped_, detail::storeAll(bytes.data(), dropped_));
        dropped_ = 0;
        records_.clear();
        room_ = 0;
        return bytes;
    }

    static void writeAll(std::ostream& out, const std::vector<std::vector<std::byte>>& parts)
    {
        std::int64_t dropped = 0;
        std::vector<std::vector<detail::TraceRecord>> ranks;
        for (const std::vector<std::byte>& part : parts) {
            detail::ByteReader in(part.data(), part.size());
            dropped += in.get<std::int64_t>();
            std::vector<detail::TraceRecord>& records = ranks.emplace_back(in.left() / sizeof(detail::TraceRecord));
            in.getBytes(reinterpret_cast<std::byte*>(records.data()), records.size() * sizeof(detail::TraceRecord));
            in.end();
        }
        detail::TraceWriter(std::move(ranks)).write(out, dropped);
    }

    std::mutex mutex_;
    const std::size_t capacity_;
    std::size_t room_ = 0; // for the events of a call of write()
    std::vector<detail::TraceRecord> records_;
    std::map<std::thread::id, int> threads_;
    std::int64_t dropped_ = 0;
};

DFB_NAMESPACE_END
