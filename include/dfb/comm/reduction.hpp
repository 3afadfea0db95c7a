// ReductionTable: non-blocking all-reduce operations made of messages, along a binomial tree rooted at rank 0.
//
// Each has a key, so that any number may be under way, contributions may come before this rank takes part, and those
// of an abandoned one are recognised. (A collective of the MPI library would have to be entered by all ranks in the
// same order, also by a rank whose frame has failed.)
#pragma once

#include <dfb/error.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <limits>
#include <map>
#include <mutex>
#include <tuple>
#include <utility>
#include <vector>

namespace dfb {

struct ReductionKey {
    std::uint32_t scope = 0; // what it is for
    std::int64_t number = 0; // which one
    bool operator<(const ReductionKey& o) const { return std::tie(scope, number) < std::tie(o.scope, o.number); }
};

// All members may be called from any thread. The callbacks are called without a lock held, on the calling thread.
class ReductionTable {
public:
    using Bytes = std::vector<std::byte>;
    using Combine = std::function<Bytes(const Bytes&, const Bytes&)>; // associative
    using Done = std::function<void(const Bytes&)>;
    // Sends a partial result up to the parent or the result down to a child.
    using Send = std::function<void(int destination, const ReductionKey&, bool up, const Bytes&)>;

    ReductionTable(int rank, int size, Send send) : rank_(rank), size_(size), send_(std::move(send))
    {
        for (int bit = 1; bit < size_ && !(rank_ & bit); bit <<= 1)
            if (rank_ + bit < size_)
                children_.push_back(rank_ + bit);
    }

    // Combines arrays of int64 element by element. Arrays of different lengths give one byte, which is no array.
    template <class Operation>
    static Bytes combineElements(const Bytes& a, const Bytes& b, Operation operation)
    {
        if (a.size() != b.size() || a.size() % sizeof(std::int64_t) != 0)
            return Bytes(1);
        Bytes result(a.size());
        for (std::size_t i = 0; i < a.size(); i += sizeof(std::int64_t)) {
            std::int64_t x, y;
            std::memcpy(&x, a.data() + i, sizeof x);
            std::memcpy(&y, b.data() + i, sizeof y);
            x = operation(x, y);
            std::memcpy(result.data() + i, &x, sizeof x);
        }
        return result;
    }

    // Takes part with `own`; every rank does so once per key. `done` gets the result, the same on all ranks.
    void enter(const ReductionKey& key, Bytes own, Combine combine, Done done)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        State& state = states_[key];
        state.entered = true;
        state.parts.emplace_back(rank_, std::move(own));
        state.combine = std::move(combine);
        state.done = std::move(done);
        advance(lock, key);
    }

    // Throws Error (MalformedMessage) for what the tree has no place for, and what `combine` throws.
    void receive(int source, const ReductionKey& key, bool up, Bytes bytes)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        const bool isNeighbour = up ? std::find(children_.begin(), children_.end(), source) != children_.end()
                                    : rank_ != 0 && source == parent();
        if (!isNeighbour)
            fail("a part of a reduction from a rank that has none", up ? -1 : parent(), source);
        const auto floor = forgotten_.find(key.scope);
        if (floor != forgotten_.end() && key.number <= floor->second)
            return;
        if (up) {
            auto& parts = states_[key].parts;
            if (std::any_of(parts.begin(), parts.end(), [&](const auto& part) { return part.first == source; }))
                fail("a second part of a reduction", -1, source);
            parts.emplace_back(source, std::move(bytes));
            advance(lock, key);
        } else {
            const auto place = states_.find(key);
            if (place != states_.end() && !hasAll(place->second))
                fail("a reduction's result before all of its parts", -1, source);
            finish(lock, key, bytes);
        }
    }

    // The neighbours in the tree that this rank waits for: children whose parts have not come, or else its parent.
    std::vector<int> missing(const ReductionKey& key)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        const auto place = states_.find(key);
        if (place == states_.end())
            return {};
        std::vector<int> ranks;
        for (int child : children_)
            if (std::none_of(place->second.parts.begin(), place->second.parts.end(),
                             [child](const auto& part) { return part.first == child; }))
                ranks.push_back(child);
        if (ranks.empty() && rank_ != 0)
            ranks.push_back(parent());
        return ranks;
    }

    // Drops what is known of this scope up to `number`, now and when it comes later.
    void forget(std::uint32_t scope, std::int64_t number)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        auto& floor = forgotten_.emplace(scope, number).first->second;
        floor = std::max(floor, number);
        states_.erase(states_.lower_bound({scope, std::numeric_limits<std::int64_t>::min()}),
                      states_.upper_bound({scope, number}));
    }

private:
    int parent() const noexcept { return rank_ & (rank_ - 1); }

    [[noreturn]] static void fail(const char* message, std::int64_t expected, std::int64_t got)
    {
        ErrorInfo info;
        info.kind = ErrorKind::MalformedMessage;
        info.expected = expected;
        info.got = got;
        info.message = message;
        throw Error(std::move(info));
    }

    struct State {
        bool entered = false;
        std::vector<std::pair<int, Bytes>> parts; // of the children and our own
        Combine combine;
        Done done;
    };

    // All parts are here.
    bool hasAll(const State& state) const { return state.entered && state.parts.size() > children_.size(); }

    void advance(std::unique_lock<std::mutex>& lock, const ReductionKey& key)
    {
        State& state = states_[key];
        if (!hasAll(state))
            return;
        // In order of rank, so that the result does not depend on who came first.
        std::sort(state.parts.begin(), state.parts.end(),
                  [](const auto& a, const auto& b) { return a.first < b.first; });
        Bytes result = std::move(state.parts.front().second);
        for (std::size_t i = 1; i < state.parts.size(); ++i)
            result = state.combine(result, state.parts[i].second);
        if (rank_ == 0) {
            finish(lock, key, result);
            return;
        }
        lock.unlock();
        send_(parent(), key, true, result);
    }

    void finish(std::unique_lock<std::mutex>& lock, const ReductionKey& key, const Bytes& result)
    {
        const auto place = states_.find(key);
        if (place == states_.end())
            return;
        const Done done = std::move(place->second.done);
        states_.erase(place);
        lock.unlock();
        for (auto child = children_.rbegin(); child != children_.rend(); ++child)
            send_(*child, key, false, result);
        if (done)
            done(result);
    }

    int rank_, size_;
    Send send_;
    std::vector<int> children_;
    std::mutex mutex_;
    std::map<ReductionKey, State> states_;
    std::map<std::uint32_t, std::int64_t> forgotten_;
};

} // namespace dfb
