// Threads that load a scene together. Each acts as a rank.
#pragma once

#include <loaders.hpp>

#include <condition_variable>
#include <cstdint>
#include <cstring>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace test {

// Lets threads exchange bytes: each thread gets the bytes of all.
class Exchange {
public:
    explicit Exchange(int size) : parts_(static_cast<std::size_t>(size)) {}

    std::vector<example::Loaders::Bytes> gather(int rank, const example::Loaders::Bytes& own)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        parts_[static_cast<std::size_t>(rank)] = own;
        const int round = round_;
        if (++there_ == static_cast<int>(parts_.size())) {
            there_ = 0;
            all_ = parts_;
            ++round_;
            changed_.notify_all();
        } else {
            changed_.wait(lock, [&] { return round_ != round; });
        }
        return all_; // no thread writes to the next round before all have returned
    }

private:
    std::mutex mutex_;
    std::condition_variable changed_;
    std::vector<example::Loaders::Bytes> parts_, all_;
    int there_ = 0, round_ = 0;
};

// Calls `function` at the same time on all ranks, with the loaders of each.
inline void together(int size, const std::function<void(const example::Loaders&)>& function)
{
    Exchange exchange(size);
    std::vector<std::thread> threads;
    for (int rank = 0; rank < size; ++rank)
        threads.emplace_back([&, rank] {
            const auto gather = [&, rank](const example::Loaders::Bytes& own) { return exchange.gather(rank, own); };
            const auto sum = [&gather](const std::vector<std::int64_t>& values) {
                const auto* first = reinterpret_cast<const std::byte*>(values.data());
                std::vector<std::int64_t> sums(values.size());
                for (const example::Loaders::Bytes& bytes : gather({first, first + values.size() * sizeof values[0]}))
                    for (std::size_t i = 0; i < sums.size(); ++i) {
                        std::int64_t value = 0;
                        std::memcpy(&value, bytes.data() + i * sizeof value, sizeof value);
                        sums[i] += value;
                    }
                return sums;
            };
            function(example::Loaders(rank, size, gather, sum));
        });
    for (std::thread& thread : threads)
        thread.join();
}

// What each rank says, by rank.
template <class Value>
std::vector<Value> ofRanks(int size, const std::function<Value(const example::Loaders&)>& function)
{
    std::vector<Value> values(static_cast<std::size_t>(size));
    together(size, [&](const example::Loaders& loaders) {
        values[static_cast<std::size_t>(loaders.rank())] = function(loaders);
    });
    return values;
}

} // namespace test
