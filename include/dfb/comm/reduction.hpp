// ReductionTable: non-blocking all-reduce operations made of messages, along a binomial tree rooted at rank 0.
//
// Each reduction has a key. So any number may be under way, parts may come before this rank takes part, and parts of an
// abandoned reduction are recognised.
#pragma once

#include <dfb/comm/message.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// Names a reduction.
struct ReductionKey {
    std::uint32_t scope = 0; // its purpose
    std::int64_t number = 0; // which of this purpose
    bool operator==(const ReductionKey& o) const { return scope == o.scope && number == o.number; }
};

namespace detail {

// The ranks that a rank exchanges parts and results with: its parent, unless it is the root, and then its children.
inline std::vector<int> treeNeighbours(int rank, int size)
{
    std::vector<int> ranks;
    if (rank != 0)
        ranks.push_back(rank & (rank - 1));
    for (int bit = 1; bit < size && !(rank & bit); bit <<= 1)
        if (rank + bit < size)
            ranks.push_back(rank + bit);
    return ranks;
}

} // namespace detail

// All members may be called from any thread. `send` and `done` are called on the calling thread, without a lock held;
// `combine` is called on the calling thread with the table locked.
class ReductionTable {
public:
    using Bytes = detail::SmallBytes;
    using Combine = std::function<Bytes(const Bytes&, const Bytes&)>; // associative
    using Done = std::function<void(const Bytes&)>;
    // Sends a partial result up to the parent or the result down to a child.
    using Send = std::function<void(int destination, const ReductionKey&, bool up, const Bytes&)>;

    ReductionTable(int rank, int size, Send send)
        : rank_(rank), size_(size), send_(std::move(send)), children_(detail::treeNeighbours(rank, size))
    {
        if (rank_ != 0)
            children_.erase(children_.begin());
        for (int i = 0; i < 4; ++i) // more are hardly under way at once
            states_.emplace_back(children_.size() + 1);
    }

    // Takes part with `own`. Every rank does so once per key; it may use the key again when it has got the result.
    // `done` gets the result, which is the same on all ranks. Neither function may be empty.
    void enter(const ReductionKey& key, Bytes own, Combine combine, Done done)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        State& state = stateOf(key);
        state.parts.front() = std::move(own);
        state.combine = std::move(combine);
        state.done = std::move(done);
        advance(lock, state);
    }

    // Throws Error (MalformedMessage) for a message that has no place in the tree, and the exceptions of `combine`.
    void receive(int source, const ReductionKey& key, bool up, Bytes bytes)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        const auto child = std::find(children_.begin(), children_.end(), source);
        if (up ? child == children_.end() : rank_ == 0 || source != parent())
            detail::failMalformed("a part of a reduction from a rank that has none", up ? -1 : parent(), source);
        for (const ReductionKey& last : forgotten_)
            if (last.scope == key.scope && key.number <= last.number)
                return;
        if (up) {
            State& state = stateOf(key);
            auto& part = state.parts[static_cast<std::size_t>(child - children_.begin()) + 1];
            if (part)
                detail::failMalformed("a second part of a reduction", -1, source);
            part = std::move(bytes);
            advance(lock, state);
        } else if (State* state = find(key)) {
            if (!hasAll(*state))
                detail::failMalformed("a reduction's result before all of its parts", -1, source);
            finish(lock, *state, bytes);
        } else {
            detail::failMalformed("a reduction's result where it was not entered", -1, source);
        }
    }

    bool isUnderWay(const ReductionKey& key)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return find(key) != nullptr;
    }

    // A message that this rank waits for in a reduction that it has entered: a part from a child, for the ranks from
    // the child to `last`; or, if all parts are here, the result from the parent.
    struct Missing {
        int rank, last;
    };
    // Empty if the reduction is over.
    std::vector<Missing> missing(const ReductionKey& key)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        const State* state = find(key);
        if (!state)
            return {};
        std::vector<Missing> parts;
        for (std::size_t i = 0; i < children_.size(); ++i)
            if (const int child = children_[i]; !state->parts[i + 1])
                parts.push_back({child, std::min(child + (child & -child), size_) - 1});
        if (parts.empty() && rank_ != 0)
            parts.push_back({parent(), parent()});
        return parts;
    }

    // Drops the parts of this scope up to `number`, now and when they come later.
    void forget(std::uint32_t scope, std::int64_t number)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        ReductionKey* last = nullptr;
        for (ReductionKey& its : forgotten_)
            last = its.scope == scope ? &its : last;
        if (!last)
            last = &forgotten_.emplace_back(ReductionKey{scope, number});
        last->number = std::max(last->number, number);
        for (State& state : states_)
            if (state.key && state.key->scope == scope && state.key->number <= number)
                state.reset();
    }

private:
    int parent() const noexcept { return rank_ & (rank_ - 1); }

    // A reduction under way. States of reductions that are over are used again.
    struct State {
        explicit State(std::size_t partCount) : parts(partCount) {}

        std::optional<ReductionKey> key;         // none: not in use
        std::vector<std::optional<Bytes>> parts; // our own and the children's, by rank
        Combine combine;
        Done done;

        void reset()
        {
            key.reset();
            for (auto& part : parts)
                part.reset();
            combine = nullptr;
            done = nullptr;
        }
    };

    State* find(const ReductionKey& key)
    {
        for (State& state : states_)
            if (state.key == key)
                return &state;
        return nullptr;
    }
    // Returns the state with this key, or a new one.
    State& stateOf(const ReductionKey& key)
    {
        State* state = find(key);
        for (std::size_t i = 0; !state && i < states_.size(); ++i)
            state = states_[i].key ? nullptr : &states_[i];
        if (!state)
            state = &states_.emplace_back(children_.size() + 1);
        state->key = key;
        return *state;
    }

    // Whether all parts are here.
    static bool hasAll(const State& state)
    {
        return std::all_of(state.parts.begin(), state.parts.end(), [](const auto& part) { return part.has_value(); });
    }

    void advance(std::unique_lock<std::mutex>& lock, State& state)
    {
        if (!hasAll(state))
            return;
        // In order of rank, so that the result does not depend on the order of arrival.
        Bytes result = std::move(*state.parts.front());
        for (std::size_t i = 1; i < state.parts.size(); ++i)
            result = state.combine(result, *state.parts[i]);
        if (rank_ == 0) {
            finish(lock, state, result);
            return;
        }
        const ReductionKey key = *state.key;
        lock.unlock();
        send_(parent(), key, true, result);
    }

    void finish(std::unique_lock<std::mutex>& lock, State& state, const Bytes& result)
    {
        const ReductionKey key = *state.key;
        const Done done = std::move(state.done);
        state.reset();
        lock.unlock();
        for (auto child = children_.rbegin(); child != children_.rend(); ++child)
            send_(*child, key, false, result);
        done(result);
    }

    int rank_, size_;
    Send send_;
    std::vector<int> children_;
    std::mutex mutex_;
    std::vector<State> states_;           // few
    std::vector<ReductionKey> forgotten_; // for each scope the last number
};

DFB_NAMESPACE_END
