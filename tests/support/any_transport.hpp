// AnyTransport: a transport whose type is chosen at run time by its communicator, so that a case is compiled only once.
#pragma once

#include <dfb/comm/connection.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>

class AnyTransport {
public:
    struct Communicator {
        std::function<std::unique_ptr<dfb::Link>(std::shared_ptr<dfb::MemoryPool>, dfb::Progress)> link;
        std::function<dfb::Progress(dfb::Progress)> resolved;
        bool isInProcess = false;

        // `communicator` must outlive the result and every transport that is made with it.
        template <class Transport>
        static Communicator of(const typename Transport::Communicator& communicator, bool isInProcess)
        {
            Communicator any;
            any.link = [&communicator](std::shared_ptr<dfb::MemoryPool> pool, dfb::Progress progress) {
                return std::make_unique<dfb::detail::LinkOver<Transport>>(communicator, std::move(pool), progress);
            };
            any.resolved = [&communicator](dfb::Progress progress) {
                return dfb::detail::resolved<Transport>(progress, communicator);
            };
            any.isInProcess = isInProcess;
            return any;
        }
    };

    AnyTransport(const Communicator& communicator, std::shared_ptr<dfb::MemoryPool> pool, dfb::Progress progress)
        : link_(communicator.link(std::move(pool), progress))
    {
    }

    static bool mayHaveThread(const Communicator& communicator)
    {
        return communicator.resolved(dfb::Progress::Auto) == dfb::Progress::Thread;
    }

    int rank() const { return link_->rank(); }
    int size() const { return link_->size(); }
    bool needsPolling() const { return link_->needsPolling(); }
    bool mayPoll() const { return link_->mayPoll(); }
    bool quiet() const { return link_->quiet(); }
    bool poll() { return link_->poll(); }
    void nap(std::chrono::nanoseconds limit) { link_->nap(limit); }
    void interrupt() { link_->interrupt(); }
    void start(dfb::TransportHandler& handler) { link_->start(handler); }
    void stop(bool orderly) { link_->stop(orderly); }
    void send(int destination, dfb::Buffer&& message) { link_->send(destination, std::move(message)); }
    bool lendsTo(int other) const { return link_->lendsTo(other); }
    std::int32_t placeOf(const std::byte* block) const { return link_->placeOf(block); }
    std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const
    {
        return link_->blockAt(other, place, byteCount);
    }
    int sharingRanks() const { return link_->sharingRanks(); }
    void abort(const std::string& text) { link_->abort(text); } // does nothing if the transport cannot end the job

private:
    std::unique_ptr<dfb::Link> link_;
};
