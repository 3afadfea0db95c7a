// Parts of the conformance suite of transports: messages that can be checked, a record of their arrival, expectations,
// and a thread that polls. Not for users.
#pragma once

#include <dfb/comm/transport.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

namespace dfb::testing::detail {

using Clock = std::chrono::steady_clock;

inline std::uint64_t mix(std::uint64_t x) noexcept
{
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return (x ^ (x >> 31)) + 0x9e3779b97f4a7c15u;
}

inline std::string inSeconds(Clock::duration time)
{
    const auto ms = std::chrono::duration_cast<std::chrono::milliseconds>(time).count();
    return ms % 1000 ? std::to_string(ms) + " ms" : std::to_string(ms / 1000) + " s";
}

// The label at the start of a case's messages, if they are long enough. The rest of a message follows from its label,
// so that the receiver can check every byte.
struct Label {
    std::uint64_t magic = 0;
    std::uint32_t channel = 0, series = 0; // the transport; the case, and the round in it
    std::int32_t source = 0, destination = 0;
    std::uint64_t number = 0, size = 0, checksum = 0;

    std::uint64_t sum() const noexcept
    {
        std::uint64_t state = magic;
        for (const std::uint64_t part :
             {std::uint64_t{channel}, std::uint64_t{series}, static_cast<std::uint64_t>(source),
              static_cast<std::uint64_t>(destination), number, size})
            state = mix(state ^ part);
        return state;
    }
};
static_assert(std::has_unique_object_representations_v<Label>);

inline constexpr std::uint64_t testMagic = 0x74736574'6266640au, controlMagic = 0x6c727463'6266640au;

// Calls `visit(place, bytes, count)` for each piece of the content, up to 1 KiB long.
template <class Visit>
void forContent(const Label& label, std::uint64_t seed, const Visit& visit)
{
    std::size_t place = 0;
    if (label.size >= sizeof label) {
        visit(std::size_t{0}, reinterpret_cast<const unsigned char*>(&label), sizeof label);
        place = sizeof label;
    }
    std::uint64_t state = mix(seed ^ label.sum()), words[128];
    while (place < label.size) {
        for (std::uint64_t& word : words) {
            state = state * 6364136223846793005u + 1442695040888963407u;
            word = state ^ (state >> 31);
        }
        const std::size_t count = std::min(sizeof words, static_cast<std::size_t>(label.size) - place);
        visit(place, reinterpret_cast<const unsigned char*>(words), count);
        place += count;
    }
}

inline Buffer makeMessage(MemoryPool& pool, const Label& label, std::uint64_t seed)
{
    Buffer message = pool.acquire(static_cast<std::size_t>(label.size));
    forContent(label, seed, [&message](std::size_t place, const unsigned char* bytes, std::size_t count) {
        std::memcpy(message.data() + place, bytes, count);
    });
    return message;
}

// Counts the problems that keep a case from passing, and keeps the first few in words.
class Problems {
public:
    void add(const std::string& text)
    {
        if (++count_ <= 3)
            text_ += (count_ > 1 ? "; " : "") + text;
    }
    void clear() { *this = Problems(); }
    std::string text() const { return count_ > 3 ? text_ + "; and " + std::to_string(count_ - 3) + " more" : text_; }

private:
    int count_ = 0;
    std::string text_;
};

// The case cannot go on: something did not happen in time.
class GaveUp : public std::runtime_error {
    using std::runtime_error::runtime_error;
};

// Where a transport delivers. It outlives the transport, to notice what comes too late.
class Mailbox final : public TransportHandler {
public:
    explicit Mailbox(NapSignal& bell) : bell_(bell) {}

    void receive(int source, Buffer&& message) override
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (closed_)
                ++tooLate_;
            else
                messages_.emplace_back(source, std::move(message));
        }
        bell_.interrupt();
        if (interrupts_)
            interrupt_();
    }

    void fail(const ErrorInfo& error) override
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (closed_)
                ++tooLate_;
            else if (failure_.empty())
                failure_ = error.describe();
        }
        bell_.interrupt();
    }

    // So that a stop(true) that waits for ever ends all the same.
    bool failed() const override
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return !failure_.empty() || (failsWithMessage_ && !messages_.empty()) || Clock::now() > failsAt_;
    }
    void failAt(Clock::time_point time)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        failsAt_ = time;
    }
    // Sets the function that interrupts the transport. Call it before the transport starts.
    void setInterrupt(std::function<void()> interrupt) { interrupt_ = std::move(interrupt); }
    // Whether each message that comes does so, within receive().
    void interruptOnReceive(bool interrupts) { interrupts_ = interrupts; }
    void failWithMessage()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        failsWithMessage_ = true;
    }

    std::vector<std::pair<int, Buffer>> take()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return std::exchange(messages_, {});
    }

    std::string failure() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return failure_;
    }

    // From here on nothing may come.
    void close()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        closed_ = true;
    }

    int takeTooLate()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return std::exchange(tooLate_, 0);
    }

private:
    NapSignal& bell_;
    std::function<void()> interrupt_;
    std::atomic<bool> interrupts_{false};
    mutable std::mutex mutex_;
    std::vector<std::pair<int, Buffer>> messages_;
    std::string failure_;
    bool failsWithMessage_ = false;
    Clock::time_point failsAt_ = Clock::time_point::max();
    bool closed_ = false;
    int tooLate_ = 0;
};

// Which messages a rank expects in a case, and which have come.
class Ledger {
public:
    // From rank s come the numbers 0 to counts[s]-1, that of number i with sizeOf(i) bytes; sizes too small for a label
    // differ from each other.
    Ledger(const Label& like, int rank, std::uint64_t seed, const std::vector<std::uint64_t>& counts,
           std::function<std::size_t(std::uint64_t)> sizeOf, bool duplicatesAllowed)
        : like_(like), rank_(rank), seed_(seed), sizeOf_(std::move(sizeOf)), duplicatesAllowed_(duplicatesAllowed)
    {
        for (const std::uint64_t count : counts)
            seen_.emplace_back(static_cast<std::size_t>(count), false);
        got_.resize(counts.size());
    }

    void check(int source, const Buffer& message, Problems& problems)
    {
        const std::string from = "from rank " + std::to_string(source) + ": ";
        if (source < 0 || static_cast<std::size_t>(source) >= seen_.size() || source == rank_) {
            problems.add("a message " + from + "there can be none from there");
            return;
        }
        std::vector<bool>& seen = seen_[static_cast<std::size_t>(source)];
        Label label = like_;
        label.source = source;
        label.destination = rank_;
        label.size = message.size();
        if (message.size() >= sizeof label) {
            Label found;
            std::memcpy(&found, message.data(), sizeof found);
            if (duplicatesAllowed_ && found.magic == testMagic && found.series < like_.series)
                return;
            if (const std::string what = differences(found, label); !what.empty()) {
                problems.add("a message " + from + what);
                return;
            }
            label.number = found.number;
            label.checksum = found.checksum;
        } else {
            while (label.number < seen.size() && sizeOf_(label.number) != message.size())
                ++label.number;
        }
        if (label.number >= seen.size() || sizeOf_(label.number) != message.size()) {
            if (!duplicatesAllowed_ || message.size() >= sizeof label)
                problems.add("a message " + from + std::to_string(message.size()) + " bytes long, which nobody sent");
            return;
        }
        const std::string which =
            from + "message " + std::to_string(label.number) + " of " + std::to_string(message.size()) + " bytes ";
        bool wrong = false;
        forContent(label, seed_, [&](std::size_t place, const unsigned char* bytes, std::size_t count) {
            if (!wrong && std::memcmp(message.data() + place, bytes, count) != 0) {
                problems.add(which + "is changed at byte " + std::to_string(place) + " or soon after");
                wrong = true;
            }
        });
        if (!seen[static_cast<std::size_t>(label.number)]) {
            seen[static_cast<std::size_t>(label.number)] = true;
            ++got_[static_cast<std::size_t>(source)];
        } else if (!duplicatesAllowed_) {
            problems.add(which + "came twice");
        }
    }

    // From one rank, or from all.
    bool complete(int source = -1) const
    {
        if (source >= 0)
            return got_[static_cast<std::size_t>(source)] == seen_[static_cast<std::size_t>(source)].size();
        for (std::size_t s = 0; s < seen_.size(); ++s)
            if (got_[s] < seen_[s].size())
                return false;
        return true;
    }

    std::string missing(Clock::duration limit) const
    {
        Problems missing;
        for (std::size_t source = 0; source < seen_.size(); ++source) {
            const std::vector<bool>& seen = seen_[source];
            if (got_[source] == seen.size())
                continue;
            const auto first = static_cast<std::uint64_t>(std::find(seen.begin(), seen.end(), false) - seen.begin());
            missing.add("no message from rank " + std::to_string(source) + " within " + inSeconds(limit) + ": got "
                        + std::to_string(got_[source]) + " of " + std::to_string(seen.size()) + ", number "
                        + std::to_string(first) + " of " + std::to_string(sizeOf_(first)) + " bytes is missing");
        }
        return missing.text();
    }

private:
    static std::string differences(const Label& found, const Label& expected)
    {
        if (found.magic == controlMagic)
            return "it belongs to another transport";
        if (found.magic != testMagic || found.checksum != found.sum())
            return "its first bytes are changed";
        if (found.channel != expected.channel)
            return "it belongs to another transport";
        if (found.series != expected.series)
            return "it came once more, or too late: it was for something before";
        if (found.source != expected.source)
            return "it was sent by rank " + std::to_string(found.source);
        if (found.destination != expected.destination)
            return "it was sent to rank " + std::to_string(found.destination);
        if (found.size != expected.size)
            return std::to_string(expected.size) + " of its " + std::to_string(found.size) + " bytes came";
        return "";
    }

    Label like_;
    int rank_;
    std::uint64_t seed_;
    std::vector<std::vector<bool>> seen_;
    std::vector<std::uint64_t> got_;
    std::function<std::size_t(std::uint64_t)> sizeOf_;
    bool duplicatesAllowed_;
};

// A thread that polls a transport and naps in between.
template <class Transport>
class Poller {
public:
    explicit Poller(Transport& transport) : transport_(transport), thread_([this] { run(); }) {}
    Poller(const Poller&) = delete;
    Poller& operator=(const Poller&) = delete;
    ~Poller()
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            stopping_ = true;
        }
        changed_.notify_all();
        transport_.interrupt();
        thread_.join();
    }

    // While paused another thread may poll.
    void pause(bool pause)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        paused_ = pause;
        changed_.notify_all();
        if (!pause)
            return;
        lock.unlock();
        transport_.interrupt();
        lock.lock();
        changed_.wait(lock, [this] { return resting_; });
    }

    // How long it naps whenever nothing moves; zero: not long, as suits a transport that does not wake.
    void napFor(Clock::duration nap)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            nap_ = nap;
        }
        transport_.interrupt();
    }

    bool mayPoll() const { return mayPoll_; }

private:
    void run()
    {
        mayPoll_ = transport_.mayPoll();
        for (int misses = 0, naps = 0;;) {
            Clock::duration nap;
            {
                std::unique_lock<std::mutex> lock(mutex_);
                resting_ = true;
                changed_.notify_all();
                changed_.wait(lock, [this] { return stopping_ || !paused_; });
                resting_ = false;
                if (stopping_)
                    return;
                nap = nap_;
            }
            if (mayPoll_ && transport_.poll()) {
                misses = naps = 0;
            } else if (++misses >= 8) { // it may take a few to get at what is there
                misses = 0;
                transport_.nap(nap > nap.zero() ? nap : std::chrono::microseconds(std::min(50 * ++naps, 1000)));
            }
        }
    }

    Transport& transport_;
    std::mutex mutex_;
    std::condition_variable changed_;
    bool paused_ = false, resting_ = false, stopping_ = false;
    Clock::duration nap_{0};
    std::atomic<bool> mayPoll_{true};
    std::thread thread_;
};

} // namespace dfb::testing::detail
