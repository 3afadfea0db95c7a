// MpiTransport: ranks are MPI processes.
//
// Only the constructor, the destructor, poll(), stop() and abort() communicate by MPI. None of them waits in a blocking
// call, because MPI libraries spin there: a caller that has to wait tests and naps. Works on a duplicate of the
// caller's communicator; never initialises or finalises MPI.
//
// Small messages to one rank travel together, in packets (comm/packet.hpp) of at most 8 KiB, which the libraries send
// without asking the receiver first. A larger message is announced in a packet. To a rank of the same node the packet
// says where it lies in memory that both see (comm/node_memory.hpp), and nothing is copied. Otherwise it is sent on its
// own, under the tag that the announcement names, straight into the block that the handler gets. Receives of packets
// are posted beforehand, so there is no probing. They take 64 KiB per transport.
#pragma once

#include <dfb/base/fifo.hpp>
#include <dfb/base/function_ref.hpp>
#include <dfb/base/processors.hpp>
#include <dfb/comm/connection.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/comm/mpi_calls.hpp>
#include <dfb/comm/mpi_ranks.hpp>
#include <dfb/comm/node_memory.hpp>
#include <dfb/comm/packet.hpp>
#include <dfb/comm/transport.hpp>
#include <dfb/compiled.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

class MpiTransport {
public:
    using Communicator = MPI_Comm;

    static constexpr int postedPackets = 8;                         // receives of packets posted at a time
    static constexpr std::size_t chunkBytes = std::size_t(1) << 30; // the most that one call sends: counts are ints

    // Collective over `communicator`. Waits for all ranks. Throws InvalidArgument for MPI_COMM_NULL or an
    // intercommunicator. Throws TransportError if MPI is not initialised, is finalised, or is another one than that of
    // the headers, and below MPI_THREAD_SERIALIZED on any thread but the one that initialised it: the other ranks then
    // wait. Throws TransportError on all ranks if they were built with different packet formats, or if one of them
    // cannot make its transport; the error then has that rank and the reason, such as that `progress` is Thread and MPI
    // is below MPI_THREAD_MULTIPLE there. But if a collective of MPI fails on one rank, or there is no memory for its
    // result, the other ranks wait.
    MpiTransport(const Communicator& communicator, std::shared_ptr<MemoryPool> pool, Progress progress)
        : onlyThread_(onlyThread()),
          noFinalize_(progress != Progress::Caller && detail::mpiLevel() == MPI_THREAD_MULTIPLE),
          pool_(std::move(pool)), ranks_(communicator, *pool_), packet_(pool_)
    {
        int failed = size();
        try {
            ranks_.attempt([this, progress] { prepare(progress); });
            failed = ranks_.firstFailed();
        } catch (...) {
            abandon();
            throw;
        }
        if (failed < size()) {
            release();
            throw TransportError(ranks_.reason(), failed);
        }
    }
    // Frees the duplicate of the communicator, which is collective, unless stop() was not orderly.
    ~MpiTransport()
    {
        if (comm() != MPI_COMM_NULL && !detail::mpiSays(MPI_Finalized))
            release();
    }

    // True if any thread may call MPI while others do. Also false if MPI cannot be used: the constructor then says why.
    static bool mayHaveThread(const Communicator&) noexcept
    {
        return detail::mpiSays(MPI_Initialized) && !detail::mpiSays(MPI_Finalized)
               && detail::mpiLevel() == MPI_THREAD_MULTIPLE;
    }

    int rank() const noexcept { return ranks_.rank(); }
    int size() const noexcept { return ranks_.size(); }
    // How many ranks of this node may run on this rank's processors (CPU affinity when the transports were made).
    int sharingRanks() const noexcept { return ranks_.sharingRanks(); }
    // Whether messages to that rank stay where they are, in memory that it sees.
    bool lendsTo(int other) const noexcept { return ranks_[other].seesMine; }
    // The place of a block of the pool in the memory that other ranks see; -1: it is not there.
    std::int32_t placeOf(const std::byte* block) const noexcept
    {
        static_assert(detail::NodeMemory::alignment == bytesOfPlace);
        const auto& memory = ranks_.memory();
        return memory && memory->holds(block) ? memory->placeOf(block) : -1;
    }
    // The block at a place in another rank's memory, valid as long as this lives; null: this rank does not see that
    // memory.
    std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const noexcept
    {
        const auto& memory = ranks_[other].itsMemory;
        return memory ? memory->at(place, byteCount) : nullptr;
    }
    bool needsPolling() const noexcept { return true; }
    // Below MPI_THREAD_SERIALIZED only the thread that initialised MPI may.
    bool mayPoll() const noexcept
    {
        return onlyThread_ == std::thread::id() || onlyThread_ == std::this_thread::get_id();
    }
    // Where ranks share cores, naps of less than 10 ms are longer, because waking up takes the core from a rank that
    // computes. If all that this rank waits for comes from this node, naps are long, since the doorbell ends them.
    void nap(std::chrono::nanoseconds limit)
    {
        napLimit_ = limit;
        const bool isAwaiting = limit < std::chrono::milliseconds(1);
        if (Clock::now() - lastWake_.load() < 2 * wakePause) // then send() may not end this nap
            limit = std::min(limit, wakePause);
        if (limit < std::chrono::milliseconds(10))
            limit = limit * oversubscription_ / 4;
        if (listener_)
            listener_->nap(isAwaiting && isRungForAll_ ? std::max(limit, rungNap) : limit, isAwaiting);
        else
            signal_.nap(limit);
    }
    void interrupt() { listener_ ? ranks_.memory()->doorbell().interrupt() : signal_.interrupt(); }

    void start(TransportHandler& handler) { handler_ = &handler; }

    void send(int destination, Buffer&& message)
    {
        bool first = false;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            first = outbox_.empty();
            outbox_.push_back({destination, std::move(message)});
        }
        if (first && mayWake())
            interrupt();
    }

    bool quiet() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return outbox_.empty() && !sending_;
    }

    // If it fails, it tells the other ranks, which would wait for this one: their poll() then fails with that error.
    // After that it sends and receives nothing else.
    bool poll()
    {
        // At MPI_THREAD_SERIALIZED threads of several connections come here, each with another lock.
        static std::mutex onlyOne;
        std::unique_lock<std::mutex> lock(onlyOne, std::defer_lock);
        if (isSerialized_ && !lock.try_lock())
            return false;
        if (failed_)
            finishNotices();
        return !failed_ && guarded([this] { return move(); });
    }

    // An orderly stop is collective: it moves messages until all ranks have called stop() and all messages have come.
    // Then MPI has no request of this transport left.
    void stop(bool orderly)
    {
        if (detail::mpiSays(MPI_Finalized)) {
            std::fputs(detail::finalizedTooEarly, stderr);
        } else if (orderly && !failed_) {
            if (guarded([this] { return finish(); }))
                return;
            flush();
        }
        abandon();
    }

    // Ends all ranks of MPI_COMM_WORLD. For another communicator MPICH first waits for its ranks, even for dead ones.
    [[noreturn]] void abort(const std::string& text)
    {
        std::fprintf(stderr, "%s\n", text.c_str());
        std::fflush(stderr);
        std::this_thread::sleep_for(std::chrono::milliseconds(500)); // launchers drop output not passed on yet
        MPI_Abort(MPI_COMM_WORLD, 1);
        std::abort(); // it should not return
    }

private:
    // The only thread that may call MPI; none if all may.
    static std::thread::id onlyThread()
    {
        detail::requireMpiOfHeaders();
        const int level = detail::mpiLevel();
        if (level >= MPI_THREAD_SERIALIZED)
            return {};
        if (!detail::mpiSays(MPI_Is_thread_main))
            throw TransportError(
                detail::printed("MPI was initialised at thread level %s by another thread: only that one may call MPI",
                                detail::mpiLevelName(level)));
        return std::this_thread::get_id();
    }

    void prepare(Progress progress)
    {
        const int level = detail::mpiLevel();
        isSerialized_ = level == MPI_THREAD_SERIALIZED;
        if (level < MPI_THREAD_MULTIPLE && progress == Progress::Thread)
            throw TransportError(
                detail::printed("MPI was initialised at thread level %s, Progress::Thread needs MPI_THREAD_MULTIPLE: "
                                "call MPI_Init_thread with it, or leave Progress::Auto",
                                detail::mpiLevelName(level)));
        const int* tagBound = nullptr;
        int found = 0;
        check(MPI_Comm_get_attr(comm(), MPI_TAG_UB, &tagBound, &found), "MPI_Comm_get_attr");
        lastTag_ = found ? std::min(*tagBound, 1 << 20) : 32767;
        // The square of the number of ranks per core: so many ranks wake up, and each delays as many.
        const std::int64_t ranksPerCore =
            std::int64_t{4} * sharingRanks() / Processors::ofThisThread().count(); // in quarters
        oversubscription_ = static_cast<int>(std::clamp<std::int64_t>(ranksPerCore * ranksPerCore / 4, 4, 16));
        if (ranks_.memory())
            listener_.emplace(ranks_.memory()->doorbell());
        peers_.resize(static_cast<std::size_t>(size()));
        for (int i = 0; i < postedPackets; ++i)
            receive(packets_, {pool_->acquire(detail::packetBytes), 0, MPI_ANY_SOURCE, 0});
    }

    // Whether send() ends the nap under way. While nobody waits here (naps are long), a renderer sends tile after tile.
    // To wake the polling thread for each would take more CPU time than sending it, and several fit into one packet.
    bool mayWake()
    {
        if (napLimit_.load() < std::chrono::milliseconds(1))
            return true;
        const Clock::time_point now = Clock::now();
        if (now - lastWake_.load() < wakePause)
            return false;
        lastWake_ = now;
        return true;
    }

    using Clock = std::chrono::steady_clock;
    static constexpr std::chrono::nanoseconds wakePause{300000};
    static constexpr std::chrono::nanoseconds rungNap{2000000};

    using Record = detail::PacketRecord;

    // Bytes that MPI is sending or receiving. If the message is longer than a chunk, the next chunk follows when this
    // one is through.
    struct Transfer {
        Buffer data;
        std::size_t offset = 0; // of the chunk
        int peer = -1;
        int tag = 0;

        int count() const { return static_cast<int>(std::min(data.size() - offset, chunkBytes)); }
    };

    // Requests that have not completed, each with what it moves.
    struct Transfers {
        std::vector<MPI_Request> requests;
        std::vector<Transfer> items;
    };

    struct Peer {
        detail::Fifo<Buffer> waiting;
        int inFlight = 0; // sends to it that have not completed
        int tag = 0;      // the last one used
        bool addressed = false;
    };

    // More transfers at once would not be faster, but every poll() looks at each.
    static constexpr int sendsPerPeer = 32;
    static constexpr std::size_t bodiesAtOnce = 64;

    MPI_Comm comm() const noexcept { return ranks_.comm(); }
    void check(int code, const char* call, int peer = -1) const { detail::checkMpi(code, call, rank(), peer); }

    // Returns action(), or false if it threw; the transport has then failed.
    bool guarded(detail::FunctionRef<bool()> action)
    {
        try {
            return action();
        } catch (const Error& e) {
            fail(e.info());
        } catch (const std::exception& e) {
            fail(TransportError(e.what(), rank()).info());
        }
        return false;
    }

    void fail(const ErrorInfo& error)
    {
        failed_ = true;
        if (error.rank < 0 || error.rank == rank()) // else another rank has told all
            tellFailure(error.message);
        finishNotices();
        handler_->fail(error);
    }

    // Tries to tell all other ranks: MPI itself may have failed.
    void tellFailure(const std::string& text)
    {
        try {
            const std::size_t length = std::min(text.size(), detail::packetBytes - sizeof(Record));
            detail::PacketWriter notice(pool_);
            notice.add({length, 0, Record::Failure}, reinterpret_cast<const std::byte*>(text.data()), length);
            notices_.items.push_back({notice.take(), 0, -1, 0});
            const Transfer& sent = notices_.items.back();
            for (int peer = 0; peer < size(); ++peer) {
                MPI_Request request = MPI_REQUEST_NULL;
                if (peer != rank()
                    && MPI_Isend(sent.data.data(), sent.count(), MPI_BYTE, peer, 0, comm(), &request) == MPI_SUCCESS)
                    notices_.requests.push_back(request);
            }
        } catch (const std::exception&) {
        }
    }

    // The transport is quiet when the notices have gone, or cannot go.
    void finishNotices()
    {
        int done = 1;
        if (MPI_Testall(static_cast<int>(notices_.requests.size()), notices_.requests.data(), &done,
                        MPI_STATUSES_IGNORE)
            != MPI_SUCCESS)
            done = 1;
        const std::lock_guard<std::mutex> lock(mutex_);
        outbox_.clear();
        sending_ = !done;
    }

    bool completed(MPI_Request& request) const
    {
        int done = 0;
        check(MPI_Test(&request, &done, MPI_STATUS_IGNORE), "MPI_Test");
        return done != 0;
    }

    bool move()
    {
        if (listener_)
            listener_->look();
        const bool started = !leaving_ && startSends();
        // Tries a second time, because Open MPI's MPI_Testsome returns what had come before the call, and only then
        // looks for more: the doorbell would not ring again for that.
        const bool arrived = receivePackets() || receivePackets();
        const bool delivered = receiveBodies();
        const bool completed = finishSends();
        isRungForAll_ =
            ranks_.doAllSeeMine() && sends_.requests.empty() && receives_.requests.empty() && waitingPeers_.empty();
        return started || arrived || delivered || completed;
    }

    // Wakes a rank of this node that naps: MPI has something for it.
    void ring(int other)
    {
        if (const auto& memory = ranks_[other].itsMemory)
            memory->doorbell().ring();
    }

    // --- sending

    bool startSends()
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            starting_.swap(outbox_);
            if (!starting_.empty())
                sending_ = true;
        }
        for (auto& [destination, message] : starting_) {
            Peer& peer = peers_[static_cast<std::size_t>(destination)];
            peer.addressed = true;
            // Else it goes soon, and need not overtake what was sent before it.
            const bool isStalled = peer.inFlight >= sendsPerPeer;
            if (isStalled && detail::isUrgent(message) && detail::PacketWriter::canHold(message.size())) {
                packet_.add({message.size(), 0, Record::Message}, message.data(), message.size());
                sendPacket(destination);
                continue;
            }
            if (peer.waiting.empty())
                waitingPeers_.push_back(destination);
            peer.waiting.push(std::move(message));
        }
        starting_.clear();

        bool any = false;
        const auto sendTo = [this, &any](int destination) {
            Peer& peer = peers_[static_cast<std::size_t>(destination)];
            any = startSends(destination, peer) || any;
            return peer.waiting.empty();
        };
        waitingPeers_.erase(std::remove_if(waitingPeers_.begin(), waitingPeers_.end(), sendTo), waitingPeers_.end());
        return any;
    }

    bool startSends(int destination, Peer& peer)
    {
        if (peer.inFlight >= sendsPerPeer)
            return false;
        while (!peer.waiting.empty() && peer.inFlight < sendsPerPeer) {
            Buffer message = peer.waiting.pop();
            Record record{message.size(), 0, Record::Message};
            const std::byte* lent = nullptr;
            if (lendsTo(destination) && message.size() >= MemoryPool::smallestShared) // copying less is quicker
                lent = pool_->lend(message);
            if (lent)
                record = {record.byteCount, ranks_.memory()->placeOf(lent), Record::Lent};
            else if (!detail::PacketWriter::canHold(message.size()))
                record = {record.byteCount, peer.tag % lastTag_ + 1, Record::Announcement};
            const std::size_t payloadBytes = record.kind == Record::Message ? message.size() : 0;
            if (!packet_.hasRoom(payloadBytes))
                sendPacket(destination);
            packet_.add(record, message.data(), payloadBytes);
            if (record.kind == Record::Announcement) {
                peer.tag = record.tag;
                bodies_.push_back({std::move(message), 0, destination, record.tag});
                ++peer.inFlight;
            }
        }
        // Announcements first, so that the receiver is ready.
        sendPacket(destination);
        for (Transfer& body : bodies_)
            addSend(std::move(body));
        bodies_.clear();
        return true;
    }

    void sendPacket(int destination)
    {
        if (packet_.empty())
            return;
        ++peers_[static_cast<std::size_t>(destination)].inFlight;
        addSend({packet_.take(), 0, destination, 0});
    }

    void addSend(Transfer&& transfer)
    {
        const MPI_Request request = startSend(transfer);
        sends_.requests.push_back(request);
        sends_.items.push_back(std::move(transfer));
    }

    MPI_Request startSend(const Transfer& transfer)
    {
        MPI_Request request = MPI_REQUEST_NULL;
        check(MPI_Isend(transfer.data.data() + transfer.offset, transfer.count(), MPI_BYTE, transfer.peer, transfer.tag,
                        comm(), &request),
              "MPI_Isend", transfer.peer);
        ring(transfer.peer);
        return request;
    }

    bool finishSends()
    {
        if (!testSome(sends_, [this](Transfer& sent, const MPI_Status&) {
                sent.offset += static_cast<std::size_t>(sent.count());
                if (sent.offset < sent.data.size())
                    return startSend(sent);
                ring(sent.peer); // the message may have left only now
                --peers_[static_cast<std::size_t>(sent.peer)].inFlight;
                return MPI_REQUEST_NULL;
            }))
            return false;
        if (sends_.requests.empty() && waitingPeers_.empty()) {
            const std::lock_guard<std::mutex> lock(mutex_);
            sending_ = false;
        }
        return true;
    }

    // --- receiving

    bool receivePackets()
    {
        return testSome(packets_, [this](Transfer& packet, const MPI_Status& status) {
            unpack(packet, status);
            return startReceive(packet);
        });
    }

    // An empty packet says goodbye, see finish().
    void unpack(const Transfer& packet, const MPI_Status& status)
    {
        const int source = status.MPI_SOURCE;
        const bool isPacket = detail::readPacket(
            packet.data.data(), byteCountOf(status), [&](const Record& record, const std::byte* payload) {
                const auto payloadBytes = static_cast<std::size_t>(record.byteCount);
                if (record.kind == Record::Announcement) {
                    announced_.push({source, record});
                } else if (record.kind == Record::Lent) {
                    const auto& memory = ranks_[source].itsMemory;
                    Buffer message = memory ? memory->borrow(record.tag, record.byteCount) : Buffer();
                    if (message.empty())
                        throw TransportError(
                            detail::printed("rank %d has lent a block that is not in the memory of this node", source),
                            rank());
                    handler_->receive(source, std::move(message));
                } else if (record.kind == Record::Failure) {
                    throw TransportError(std::string(reinterpret_cast<const char*>(payload), payloadBytes), source);
                } else {
                    Buffer message = pool_->acquire(payloadBytes);
                    std::memcpy(message.data(), payload, payloadBytes);
                    handler_->receive(source, std::move(message));
                }
            });
        if (!isPacket)
            throw TransportError(detail::printed("a packet from rank %d is malformed", source), rank());
    }

    bool receiveBodies()
    {
        while (!announced_.empty() && receives_.requests.size() < bodiesAtOnce) {
            const auto [source, record] = announced_.pop();
            receive(receives_, {pool_->acquire(static_cast<std::size_t>(record.byteCount)), 0, source, record.tag});
        }
        return testSome(receives_, [this](Transfer& body, const MPI_Status& status) {
            if (byteCountOf(status) != static_cast<std::size_t>(body.count()))
                throw TransportError(
                    detail::printed("a message from rank %d is not as long as it was announced", body.peer), rank());
            body.offset += static_cast<std::size_t>(body.count());
            if (body.offset < body.data.size())
                return startReceive(body);
            handler_->receive(body.peer, std::move(body.data));
            return MPI_REQUEST_NULL;
        });
    }

    void receive(Transfers& transfers, Transfer&& body)
    {
        transfers.requests.push_back(startReceive(body));
        transfers.items.push_back(std::move(body));
    }

    MPI_Request startReceive(Transfer& body)
    {
        MPI_Request request = MPI_REQUEST_NULL;
        check(MPI_Irecv(body.data.data() + body.offset, body.count(), MPI_BYTE, body.peer, body.tag, comm(), &request),
              "MPI_Irecv", body.peer);
        return request;
    }

    std::size_t byteCountOf(const MPI_Status& status) const
    {
        int byteCount = 0;
        check(MPI_Get_count(&status, MPI_BYTE, &byteCount), "MPI_Get_count");
        return static_cast<std::size_t>(byteCount);
    }

    // --- completion

    // Calls `next(item, status)` for each transfer that has completed. It returns the request of the next chunk, or
    // MPI_REQUEST_NULL after the last one; that transfer is then removed. Returns whether any has completed.
    // MPI_Testsome reports errors to the handler of MPI_COMM_SELF or MPI_COMM_WORLD, which by default ends the job.
    bool testSome(Transfers& transfers, detail::FunctionRef<MPI_Request(Transfer&, const MPI_Status&)> next)
    {
        auto& [requests, items] = transfers;
        if (requests.empty())
            return false;
        if (indices_.size() < requests.size()) {
            indices_.resize(requests.size());
            statuses_.resize(requests.size());
        }
        int count = 0, kind = MPI_SUCCESS;
        const int code =
            MPI_Testsome(static_cast<int>(requests.size()), requests.data(), &count, indices_.data(), statuses_.data());
        const auto which = [this](int i) { return static_cast<std::size_t>(indices_[static_cast<std::size_t>(i)]); };
        if (code != MPI_SUCCESS && MPI_Error_class(code, &kind) == MPI_SUCCESS && kind == MPI_ERR_IN_STATUS)
            for (int i = 0; i < count; ++i)
                check(statuses_[static_cast<std::size_t>(i)].MPI_ERROR, "MPI_Testsome", items[which(i)].peer);
        check(code, "MPI_Testsome");
        if (count == 0 || count == MPI_UNDEFINED)
            return false;
        for (int i = 0; i < count; ++i)
            requests[which(i)] = next(items[which(i)], statuses_[static_cast<std::size_t>(i)]);
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

    // --- the end

    // Moves messages until done(). Returns false if the handler has failed: then the awaited event may never come.
    bool moveUntil(detail::FunctionRef<bool()> done)
    {
        for (detail::Backoff backoff; !done();) {
            handler_->waiting();
            if (handler_->failed())
                return false;
            if (move())
                backoff.reset();
            else
                backoff.nap();
        }
        return true;
    }

    bool barrier()
    {
        MPI_Request request = MPI_REQUEST_NULL;
        check(MPI_Ibarrier(comm(), &request), "MPI_Ibarrier");
        return moveUntil([&] { return completed(request); });
    }

    // First waits until nothing waits to be sent on any rank. Meanwhile each rank gives signs of life, so that none is
    // taken for lost while others still move messages. Then each rank says goodbye to those that it has sent to, with
    // an empty packet sent synchronously. When that send has completed, the receiver has all packets that went before.
    // Once this is so on all ranks, only announced bodies can be on the way. Returns false as moveUntil() does.
    bool finish()
    {
        if (!barrier() || !moveUntil([this] { return quiet(); }) || !barrier())
            return false;
        leaving_ = true;
        std::vector<MPI_Request> goodbyes;
        for (int peer = 0; peer < size(); ++peer) {
            if (!peers_[static_cast<std::size_t>(peer)].addressed)
                continue;
            goodbyes.push_back(MPI_REQUEST_NULL);
            check(MPI_Issend(nullptr, 0, MPI_BYTE, peer, 0, comm(), &goodbyes.back()), "MPI_Issend");
        }
        const auto haveLeft = [&] {
            return std::all_of(goodbyes.begin(), goodbyes.end(), [this](MPI_Request& each) { return completed(each); });
        };
        if (!moveUntil(haveLeft) || !barrier())
            return false;
        // A receive that cannot be cancelled any more has a packet.
        cancelPackets([this](const Transfer& packet, const MPI_Status& status) { unpack(packet, status); });
        return moveUntil(
            [this] { return announced_.empty() && receives_.requests.empty() && sends_.requests.empty(); });
    }

    // Cancels the posted receives. Calls `came(packet, status)` for those that have got a packet before.
    void cancelPackets(detail::FunctionRef<void(const Transfer&, const MPI_Status&)> came)
    {
        for (std::size_t i = 0; i < packets_.requests.size(); ++i) {
            MPI_Request& request = packets_.requests[i];
            if (request == MPI_REQUEST_NULL)
                continue;
            MPI_Status status;
            int cancelled = 0;
            check(MPI_Cancel(&request), "MPI_Cancel");
            detail::waitMpi(request, rank(), &status);
            check(MPI_Test_cancelled(&status, &cancelled), "MPI_Test_cancelled");
            if (!cancelled)
                came(packets_.items[i], status);
        }
    }

    // Frees what MPI holds for this transport, when no rank needs it any more.
    void release()
    {
        try {
            cancelPackets([](const Transfer&, const MPI_Status&) {}); // if stop() was never called
        } catch (const std::exception&) {
        }
        ranks_.free();
    }

    // Tries to send the messages that tell the others why this rank leaves, for a short time.
    void flush()
    {
        leaving_ = false;
        for (int tries = 0; tries < 100 && !failed_ && !quiet(); ++tries) {
            guarded([this] { return move(); });
            std::this_thread::sleep_for(std::chrono::milliseconds(1));
        }
    }

    // Leaves to MPI the buffers of requests that cannot be cancelled, which it may still use. Leaves it the
    // communicator, too, because freeing that is collective.
    void abandon()
    {
        const bool isOver = detail::mpiSays(MPI_Finalized);
        int areSent = 0;
        if (isOver
            || MPI_Testall(static_cast<int>(notices_.requests.size()), notices_.requests.data(), &areSent,
                           MPI_STATUSES_IGNORE)
                   != MPI_SUCCESS
            || !areSent)
            new Transfers(std::move(notices_)); // several requests send one item
        for (Transfers* all : {&packets_, &receives_, &sends_})
            for (std::size_t i = 0; i < all->requests.size(); ++i) {
                MPI_Request& request = all->requests[i];
                int done = 0;
                if (!isOver && request != MPI_REQUEST_NULL && (all == &packets_ || all == &receives_))
                    MPI_Cancel(&request);
                if (!isOver && request != MPI_REQUEST_NULL)
                    MPI_Test(&request, &done, MPI_STATUS_IGNORE);
                if (request != MPI_REQUEST_NULL)
                    new Transfer(std::move(all->items[i]));
            }
        ranks_.abandon();
    }

    const std::thread::id onlyThread_; // the only one that may call MPI; none if all may
    bool isSerialized_ = false;        // all may, but one at a time
    detail::NoFinalize noFinalize_;
    std::shared_ptr<MemoryPool> pool_;
    detail::MpiRanks ranks_;
    TransportHandler* handler_ = nullptr; // since start(), before which nothing is sent or received
    int lastTag_ = 1;
    int oversubscription_ = 4; // the factor by which naps are longer, in quarters

    std::optional<detail::Doorbell::Listener> listener_; // of this rank's doorbell; without, signal_ is used
    std::atomic<bool> isRungForAll_{false};              // nothing can come that is not announced by the doorbell
    NapSignal signal_;
    mutable std::mutex mutex_;
    std::vector<std::pair<int, Buffer>> outbox_;                                  // under mutex_
    std::atomic<std::chrono::nanoseconds> napLimit_{std::chrono::nanoseconds(0)}; // of the last nap
    std::atomic<Clock::time_point> lastWake_{Clock::time_point()};                // by send()
    bool sending_ = false; // under mutex_; something has left the outbox and not completed

    // Only the thread that polls uses these.
    bool failed_ = false, leaving_ = false;
    std::vector<std::pair<int, Buffer>> starting_;
    std::vector<Peer> peers_;
    std::vector<int> waitingPeers_;                  // those with messages that wait
    detail::PacketWriter packet_;                    // the one that is being filled
    std::vector<Transfer> bodies_;                   // they are sent after that packet
    Transfers sends_, receives_, notices_, packets_; // packets_: the posted receives
    detail::Fifo<std::pair<int, Record>> announced_; // source and record of messages to come
    std::vector<int> indices_;
    std::vector<MPI_Status> statuses_;
};

static_assert(is_transport_v<MpiTransport>);
DFB_COMPILED_TEMPLATE(std::shared_ptr<Connection> connect<MpiTransport>(const MPI_Comm&, NetworkConfig));

DFB_NAMESPACE_END
