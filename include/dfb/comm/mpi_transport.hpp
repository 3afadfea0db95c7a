// MpiTransport: ranks are MPI processes. The only header that includes mpi.h.
//
// All MPI calls are made by the constructor, stop() and poll(), none of them blocks once the constructor is done
// (MPI libraries spin while they block). Works on a duplicate of the caller's communicator; never initialises or
// finalises MPI.
#pragma once

#include <dfb/comm/transport.hpp>

#include <mpi.h>

#include <chrono>
#include <cstddef>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace dfb {

class MpiTransport {
public:
    using Communicator = MPI_Comm;
    static constexpr const char* name = "mpi";

    // Collective over `communicator`. Throws TransportError if MPI is not initialised, is finalised, or was initialised
    // at a lower thread level than `progress` needs.
    MpiTransport(const Communicator& communicator, std::shared_ptr<MemoryPool> pool, Progress progress)
        : pool_(std::move(pool))
    {
        int initialized = 0, finalized = 0;
        MPI_Initialized(&initialized);
        MPI_Finalized(&finalized);
        if (!initialized || finalized)
            throw TransportError(finalized ? "MPI has been finalised"
                                           : "MPI is not initialised: call MPI_Init_thread first");
        int level = MPI_THREAD_SINGLE;
        MPI_Query_thread(&level);
        const int needed = progress == Progress::Thread ? MPI_THREAD_MULTIPLE : MPI_THREAD_FUNNELED;
        if (level < needed)
            throw TransportError(std::string("MPI was initialised at thread level ") + levelName(level) + ", "
                                 + levelName(needed) + " is needed: call MPI_Init_thread with it"
                                 + (progress == Progress::Thread ? ", or configure Progress::Caller" : ""));
        check(MPI_Comm_dup(communicator, &comm_), "MPI_Comm_dup");
        MPI_Comm_set_errhandler(comm_, MPI_ERRORS_RETURN);
        MPI_Comm_rank(comm_, &rank_);
        MPI_Comm_size(comm_, &size_);
    }
    MpiTransport(const MpiTransport&) = delete;
    MpiTransport& operator=(const MpiTransport&) = delete;
    ~MpiTransport()
    {
        int finalized = 0;
        MPI_Finalized(&finalized);
        if (comm_ != MPI_COMM_NULL && !finalized)
            MPI_Comm_free(&comm_);
    }

    int rank() const noexcept { return rank_; }
    int size() const noexcept { return size_; }
    bool needsPolling() const noexcept { return true; }
    bool mayPoll() const noexcept { return true; }
    bool wakesOnArrival() const noexcept { return false; }
    void nap(std::chrono::nanoseconds limit) { signal_.nap(limit); }
    void interrupt() { signal_.interrupt(); }

    void start(TransportHandler& handler) { handler_ = &handler; }

    void send(int destination, Buffer&& message)
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            outbox_.emplace_back(destination, std::move(message));
        }
        signal_.interrupt();
    }

    bool quiet() const
    {
        std::lock_guard<std::mutex> lock(mutex_);
        return outbox_.empty() && pendingSends_ == 0;
    }

    bool poll()
    {
        try {
            const bool sent = startSends();
            const bool arrived = startReceives();
            const bool delivered = finishReceives();
            const bool completed = finishSends();
            return sent || arrived || delivered || completed;
        } catch (const Error& e) {
            handler_->fail(e.info());
            return false;
        }
    }

    // Orderly it is collective, and goes on receiving until the sends of all ranks have completed.
    void stop(bool orderly)
    {
        if (!orderly) {
            // MPI may still use these buffers, and freeing a communicator waits for others: both are left to it.
            new std::vector<Buffer>(std::move(sending_));
            new std::vector<Receive>(std::move(receiving_));
            comm_ = MPI_COMM_NULL;
            return;
        }
        MPI_Request barrier = MPI_REQUEST_NULL;
        bool entered = false;
        for (int done = 0; !done;) {
            poll();
            if (!entered && quiet()) {
                check(MPI_Ibarrier(comm_, &barrier), "MPI_Ibarrier");
                entered = true;
            }
            if (entered)
                check(MPI_Test(&barrier, &done, MPI_STATUS_IGNORE), "MPI_Test");
            if (!done)
                std::this_thread::sleep_for(std::chrono::microseconds(20));
        }
        while (poll()) {
        }
    }

private:
    struct Receive {
        int source;
        Buffer message;
    };

    static const char* levelName(int level)
    {
        return level == MPI_THREAD_SINGLE       ? "MPI_THREAD_SINGLE"
               : level == MPI_THREAD_FUNNELED   ? "MPI_THREAD_FUNNELED"
               : level == MPI_THREAD_SERIALIZED ? "MPI_THREAD_SERIALIZED"
                                                : "MPI_THREAD_MULTIPLE";
    }

    void check(int code, const char* call) const
    {
        if (code == MPI_SUCCESS)
            return;
        char text[MPI_MAX_ERROR_STRING];
        int length = 0;
        MPI_Error_string(code, text, &length);
        throw TransportError(std::string(call) + ": " + std::string(text, static_cast<std::size_t>(length)), rank_);
    }

    bool startSends()
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            if (outbox_.empty())
                return false;
            starting_.swap(outbox_);
            pendingSends_ += starting_.size();
        }
        for (auto& [destination, message] : starting_) {
            if (message.size() > static_cast<std::size_t>(std::numeric_limits<int>::max()))
                throw TransportError("a message of " + std::to_string(message.size()) + " bytes is over 2 GiB", rank_);
            MPI_Request request = MPI_REQUEST_NULL;
            check(
                MPI_Isend(message.data(), static_cast<int>(message.size()), MPI_BYTE, destination, 0, comm_, &request),
                "MPI_Isend");
            sendRequests_.push_back(request);
            sending_.push_back(std::move(message));
        }
        starting_.clear();
        return true;
    }

    // A probe looks before it makes progress, so what this poll brings in shows at the next probe: two in a row.
    bool startReceives()
    {
        bool any = false;
        for (int misses = 0; misses < 2 && receiving_.size() < 64;) {
            int found = 0;
            MPI_Message handle = MPI_MESSAGE_NULL;
            MPI_Status status;
            check(MPI_Improbe(MPI_ANY_SOURCE, MPI_ANY_TAG, comm_, &found, &handle, &status), "MPI_Improbe");
            if (!found) {
                ++misses;
                continue;
            }
            int byteCount = 0;
            MPI_Get_count(&status, MPI_BYTE, &byteCount);
            Buffer message = pool_->acquire(static_cast<std::size_t>(byteCount));
            MPI_Request request = MPI_REQUEST_NULL;
            check(MPI_Imrecv(message.data(), byteCount, MPI_BYTE, &handle, &request), "MPI_Imrecv");
            receiveRequests_.push_back(request);
            receiving_.push_back({status.MPI_SOURCE, std::move(message)});
            any = true;
        }
        return any;
    }

    // Calls `finished(i)` for each completed request and removes it, keeping `items` in step.
    template <class Item, class Finished>
    bool testSome(std::vector<MPI_Request>& requests, std::vector<Item>& items, const Finished& finished)
    {
        if (requests.empty())
            return false;
        int count = 0;
        indices_.resize(requests.size());
        check(MPI_Testsome(static_cast<int>(requests.size()), requests.data(), &count, indices_.data(),
                           MPI_STATUSES_IGNORE),
              "MPI_Testsome");
        if (count == MPI_UNDEFINED || count == 0)
            return false;
        for (int i = 0; i < count; ++i)
            finished(items[static_cast<std::size_t>(indices_[static_cast<std::size_t>(i)])]);
        std::size_t kept = 0;
        for (std::size_t i = 0; i < requests.size(); ++i) {
            if (requests[i] == MPI_REQUEST_NULL)
                continue;
            if (kept != i) {
                requests[kept] = requests[i];
                items[kept] = std::move(items[i]);
            }
            ++kept;
        }
        requests.resize(kept);
        items.resize(kept);
        return true;
    }

    bool finishReceives()
    {
        return testSome(receiveRequests_, receiving_,
                        [this](Receive& r) { handler_->receive(r.source, std::move(r.message)); });
    }

    bool finishSends()
    {
        if (!testSome(sendRequests_, sending_, [](Buffer& message) { message = Buffer(); }))
            return false;
        std::lock_guard<std::mutex> lock(mutex_);
        pendingSends_ = sending_.size();
        return true;
    }

    std::shared_ptr<MemoryPool> pool_;
    TransportHandler* handler_ = nullptr;
    MPI_Comm comm_ = MPI_COMM_NULL;
    int rank_ = 0, size_ = 1;

    NapSignal signal_;
    mutable std::mutex mutex_;
    std::vector<std::pair<int, Buffer>> outbox_; // under mutex_
    std::size_t pendingSends_ = 0;               // under mutex_

    // Only poll() uses these.
    std::vector<std::pair<int, Buffer>> starting_;
    std::vector<MPI_Request> sendRequests_, receiveRequests_;
    std::vector<Buffer> sending_;
    std::vector<Receive> receiving_;
    std::vector<int> indices_;
};

static_assert(is_transport_v<MpiTransport>);

} // namespace dfb
