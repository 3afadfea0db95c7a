// ShuffledTransport: ranks are threads. With a seed, messages arrive in a pseudo-random order.
#pragma once

#include "forward.hpp"

#include <dfb/comm/inproc_transport.hpp>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <random>
#include <utility>
#include <vector>

class ShuffledTransport : public Forward<dfb::InprocTransport>, private dfb::TransportHandler {
public:
    struct Communicator : dfb::InprocCommunicator {
        Communicator(const dfb::InprocCommunicator& ranks, std::optional<std::uint64_t> shuffleSeed = std::nullopt)
            : InprocCommunicator(ranks), seed(shuffleSeed)
        {
        }
        std::optional<std::uint64_t> seed;
    };

    ShuffledTransport(const Communicator& c, std::shared_ptr<dfb::MemoryPool> pool, dfb::Progress progress)
        : Forward(c, std::move(pool), progress), shuffles_(c.seed.has_value()),
          random_(c.seed.value_or(0) + 7919 * static_cast<std::uint64_t>(c.rank()))
    {
    }
    int sharingRanks() const { return inner_.sharingRanks(); }
    bool needsPolling() const { return shuffles_; }

    void start(dfb::TransportHandler& handler)
    {
        handler_ = &handler;
        inner_.start(*this);
    }

    // Waits until 16 messages have arrived or no more come, then delivers one of them at random.
    bool poll()
    {
        Arrival next;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (waiting_.empty())
                return false;
            if (waiting_.size() < 16 && patience_++ < 3) {
                interrupt(); // so that poll() is called again soon
                return false;
            }
            std::swap(waiting_[static_cast<std::size_t>(random_() % waiting_.size())], waiting_.back());
            next = std::move(waiting_.back());
            waiting_.pop_back();
        }
        handler_->receive(next.first, std::move(next.second));
        return true;
    }

    void stop(bool orderly)
    {
        inner_.stop(orderly);
        waiting_.clear();
    }

private:
    using Arrival = std::pair<int, dfb::Buffer>;

    void receive(int source, dfb::Buffer&& message) override
    {
        if (!shuffles_) {
            handler_->receive(source, std::move(message));
            return;
        }
        const std::lock_guard<std::mutex> lock(mutex_);
        waiting_.emplace_back(source, std::move(message));
        patience_ = 0;
        interrupt();
    }
    void fail(const dfb::ErrorInfo& error) override { handler_->fail(error); }
    bool failed() const override { return handler_->failed(); }

    const bool shuffles_;
    std::mt19937_64 random_;
    dfb::TransportHandler* handler_ = nullptr;
    std::mutex mutex_;
    std::vector<Arrival> waiting_; // under mutex_, as is patience_
    int patience_ = 0;             // polls without an arrival
};
