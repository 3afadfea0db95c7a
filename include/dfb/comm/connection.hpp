// Connection: carries the messages of any number of framebuffers over one communicator (section 3.2 of the paper). It
// passes each message to the object that it is for, and checks that it comes once and whole.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/base/processors.hpp>
#include <dfb/comm/heartbeat.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/comm/progress.hpp>
#include <dfb/comm/reduction.hpp>
#include <dfb/comm/transport.hpp>
#include <dfb/exec.hpp>
#include <dfb/fwd.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <exception>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <new>
#include <optional>
#include <string>
#include <thread>
#include <unordered_map>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// How messages travel between ranks, for all framebuffers and walls of a connection. `checksums` must be the same on
// all ranks; the first object that is made on the connection checks it.
struct NetworkConfig {
    Progress progress = Progress::Auto; // which calls or thread move messages
    // True: each message carries a CRC-32C, for networks that are not trusted. Costs a pass over each message.
    bool checksums = false;
    // True: ranks of one node pass messages in shared memory. False: all messages go through MPI.
    bool sharedMemory = true;
    // A rank counts as lost if no message has come from it for this long while messages are expected. It may have
    // ended, hang, or be out of reach. Needs a progress thread on both ranks. 0: this rank watches no other, and no
    // other watches it. Otherwise 100 ms to 24 days; framebuffers refuse other values. Below 400 ms it must be the same
    // on all ranks. After a message that could not be read, reductions have this time-out, too; here 0 means no limit,
    // unless the frame has a time-out.
    std::chrono::milliseconds peerTimeout = defaultPeerTimeout;
    // Called once when a rank is lost, on those of the others that notice it, by a thread of the library or the one
    // that destroys the connection. It must be quick and not throw. All ranks then get a TransportError with the lost
    // rank in ErrorInfo::rank. Null: the error is printed, and MPI_Abort ends the job, as MPI cannot go on without a
    // rank.
    std::function<void(const ErrorInfo&)> onPeerLost{};
};

namespace detail {

// An object that gets messages. Its members are quick and never block. Any thread may call them, several at once.
class MessageReceiver {
public:
    virtual void receive(int source, const MessageHeader& header, Buffer&& message) = 0;
    virtual void malformed(const ErrorInfo& error) = 0; // a message of rank error.from that was perhaps for this object
    virtual void connectionFailed() = 0;

protected:
    ~MessageReceiver() = default;
};

// Records which messages of one sender have come. They come in any order; each number counts once.
class SequenceWindow {
public:
    SequenceWindow() { holes_.reserve(16); }

    // Returns whether the message is new. Throws Error (MalformedMessage) for a number that is too far ahead.
    bool arrive(std::uint32_t sequence)
    {
        const auto ahead = static_cast<std::int32_t>(sequence - next_);
        if (ahead >= 0) {
            if (ahead > maxHoles - static_cast<std::int32_t>(holes_.size()))
                failMalformed("a running number far from the others");
            for (; next_ != sequence; ++next_)
                holes_.push_back(next_);
            ++next_;
            return true;
        }
        const auto hole = std::lower_bound(holes_.begin(), holes_.end(), sequence, [this](auto a, auto b) {
            return next_ - a > next_ - b; // also right if the numbers have wrapped around
        });
        if (hole == holes_.end() || *hole != sequence)
            return false;
        holes_.erase(hole);
        return true;
    }

    // How many messages are missing: later ones have overtaken them, or they are lost.
    std::size_t missing() const noexcept { return holes_.size(); }

private:
    static constexpr std::int32_t maxHoles = 1 << 20;
    std::uint32_t next_ = 0;
    std::vector<std::uint32_t> holes_; // the oldest first
};

} // namespace detail

// The progress thread and the memory pool that framebuffers and walls share. These must be made in the same order on
// all ranks, and destroyed before it. Any thread may call any member, unless it says otherwise.
class Connection final : private TransportHandler {
public:
    // See connect(). `pool`: the pool that `link` was made with.
    Connection(NetworkConfig config, std::shared_ptr<MemoryPool> pool, std::unique_ptr<Link> link)
        : config_(std::move(config)), pool_(std::move(pool)), link_(std::move(link))
    {
        link_->start(*this);
        if (!hasOwnThread()) {
            if (link_->needsPolling())
                progress_.leaveToCallers();
            return;
        }
        try {
            progress_.start();
            if (heartbeat_.isOn())
                for (const int other : detail::treeNeighbours(rank_, size_))
                    sendSign(other, detail::MessageKind::Pong);
        } catch (const std::exception& e) { // no thread or memory: the others may wait for this rank
            leave(e.what());
            end();
            throw;
        }
    }

    // Collective. Waits for the other ranks. But if an exception is passing on this rank alone, it tells the others,
    // and does not wait: they may never come here.
    ~Connection()
    {
        if (std::uncaught_exceptions() > exceptions_ && thrownByAll_.expired())
            leave("an exception has ended its connection");
        end();
    }

    int rank() const noexcept { return rank_; }
    int size() const noexcept { return size_; }
    // The configuration that it was made with; Progress::Auto is replaced by Thread or Caller.
    const NetworkConfig& config() const noexcept { return config_; }
    const std::shared_ptr<MemoryPool>& pool() const noexcept { return pool_; }

    // How many threads this rank should use: P / R, at least 1. P is the number of processors that the calling thread
    // may run on, and R the number of ranks on this node that may run there, with this one. A framebuffer that is given
    // no executor makes this many threads. Waits for nothing.
    int threadShare() const noexcept
    {
        return dfb::threadShare(Processors::ofThisThread().count(), link_->sharingRanks());
    }

    // Whether there are more than two ranks per processor.
    bool isOversubscribed() const noexcept { return isOversubscribed_; }

    // Moves messages, and returns whether any moved. Not needed with a progress thread. Does nothing on a thread that
    // may not call MPI. Never blocks. Without a progress thread it also moves those of the other such connections that
    // the calling thread has made: a rank that waits in one of them may be needed in another.
    bool poll()
    {
        return (progress_.needsCaller() && link_->mayPoll() && progress_.tryPoll())
               || ProgressThread::pollOthers(&progress_);
    }

    // ---- for the objects that it serves

    // Gives the receiver an address, equal on all ranks, and then the messages that have already come for it.
    void attach(detail::MessageReceiver& receiver, std::uint32_t& address)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        address = addresses_++;
        receivers_.push_back({address, &receiver});
        std::vector<detail::Arrival> all, its;
        all.swap(unexpected_);
        for (detail::Arrival& e : all)
            (e.header.receiver == address ? its : unexpected_).push_back(std::move(e));
        for (detail::Arrival& e : its)
            receiver.receive(e.source, e.header, std::move(e.message));
        if (stray_)
            receiver.malformed(*stray_);
        stray_.reset();
    }

    // Waits for calls of the receiver that are under way; then there are no more. Messages that still come for it are
    // dropped.
    void detach(std::uint32_t address)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (const auto place = findReceiver(address); place != receivers_.end())
            receivers_.erase(place);
    }

    // `message` starts with a MessageHeader; `destination` is another rank. Returns the message's running number. Never
    // blocks.
    std::uint32_t send(int destination, Buffer&& message)
    {
        auto header = detail::loadAs<detail::MessageHeader>(message.data());
        {
            const std::lock_guard<std::mutex> lock(peersMutex_);
            header.sequence = peers_[destination].sent++;
        }
        header.checksum = config_.checksums ? checksumOf(header, message) : 0;
        detail::storeAll(message.data(), header);
        link_->send(destination, std::move(message));
        return header.sequence;
    }

    // isSeenBy(): whether another rank sees memory of this rank. placeOf(): the place of a block of pool() in that
    // memory, or -1. blockAt(): the memory at a place of another rank, or null.
    bool isSeenBy(int other) const { return other != rank() && link_->lendsTo(other); }
    std::int32_t placeOf(const std::byte* block) const { return link_->placeOf(block); }
    std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const
    {
        return link_->blockAt(other, place, byteCount);
    }

    // Whether this rank and the other one see memory of each other.
    bool sharesMemoryWith(int other) const { return isSeenBy(other) && blockAt(other, 2, 0); }

    // The lowest rank on this rank's node: of this rank and those that share memory with it. 0 if the transport knows
    // no shared memory: all ranks then count as being on one node.
    int firstOnNode() const
    {
        int first = 0;
        while (link_->knowsSharedMemory() && first != rank() && !sharesMemoryWith(first))
            ++first;
        return first;
    }

    // offsetOf(): the offset of any byte of a block of pool() in the memory of this rank that others see, or -1.
    // bytesAt(): the bytes at an offset in such memory of another rank, or null.
    std::int64_t offsetOf(const std::byte* address) const
    {
        const std::int64_t place = placeOf(address);
        return place < 0 ? -1
                         : bytesOfPlace * place
                               + static_cast<std::int64_t>(reinterpret_cast<std::uintptr_t>(address) % bytesOfPlace);
    }
    const std::byte* bytesAt(int other, std::int64_t offset, std::int64_t byteCount) const
    {
        const std::int64_t place = offset / bytesOfPlace, before = offset % bytesOfPlace;
        if (offset < 0 || byteCount < 0 || place > std::numeric_limits<std::int32_t>::max())
            return nullptr;
        const std::byte* block =
            blockAt(other, static_cast<std::int32_t>(place), static_cast<std::size_t>(before + byteCount));
        return block ? block + before : nullptr;
    }

    // Notes that all ranks have the same configuration, `checksums` included. Until then, messages of the set-up may
    // come with or without a checksum, so that ranks can tell each other what differs. May be called any number of
    // times.
    void setAlike() noexcept { isAlike_ = true; }

    // How many messages came twice and were dropped, since the last call.
    std::int64_t takeDuplicates() noexcept { return duplicates_.exchange(0); }

    // Names the ranks that have sent messages which did not arrive although later ones did. May be empty.
    std::string lost() const
    {
        const std::lock_guard<std::mutex> lock(peersMutex_);
        std::string text;
        for (int source = 0; source < size_; ++source)
            if (const auto peer = peers_.find(source); peer != peers_.end() && peer->second.received.missing() > 0)
                text += detail::printed("%s%zu from rank %d", text.empty() ? "messages on the way or lost: " : ", ",
                                        peer->second.received.missing(), source);
        return text;
    }

    // Says that messages may come from now on (true), or no more (false). Each true is followed by one false.
    void expectMessages(bool expect) { progress_.expectMessages(expect); }

    // For an exception that all ranks throw now: returns an object that the exception must keep. While the object
    // exists, the connection ends in order although an exception is passing.
    std::shared_ptr<const void> throwByAll()
    {
        auto whileThrown = std::make_shared<char>();
        const std::lock_guard<std::mutex> lock(failureMutex_);
        thrownByAll_ = whileThrown;
        return whileThrown;
    }

    // Tells the progress thread something for as long as an object of this type exists.
    template <void (ProgressThread::*Tell)(bool)>
    class Telling {
    public:
        explicit Telling(Connection& connection) : progress_(connection.progress_) { (progress_.*Tell)(true); }
        Telling(const Telling&) = delete;
        Telling& operator=(const Telling&) = delete;
        ~Telling() { (progress_.*Tell)(false); }

    private:
        ProgressThread& progress_;
    };
    // Messages may come.
    using Expecting = Telling<&ProgressThread::expectMessages>;
    // The connection looks for messages often.
    using Hurry = Telling<&ProgressThread::hurry>;
    // The calling thread, which stays in calls that move messages, replaces the progress thread. Otherwise the two
    // threads, if they share a processor, would take turns for each message.
    using StandIn = Telling<&ProgressThread::standIn>;

    // For a thread that waits: moves messages in place of the progress thread, if there is one. Returns whether any
    // moved.
    bool helpProgress() { return progress_.tryPoll(); }
    bool hasProgressThread() const noexcept { return progress_.running(); }
    // Whether only threads that wait move messages: when none waits any more, nobody does.
    bool hasOnlyCallers() const noexcept { return link_->needsPolling() && !progress_.running(); }

    // Whether a thread that waits must call poll() itself.
    bool needsCaller() const noexcept { return link_->needsPolling() && progress_.needsCaller(); }
    bool mayPoll() const noexcept { return link_->mayPoll(); }
    bool quiet() const { return link_->quiet(); }
    void nap(std::chrono::nanoseconds limit) { link_->nap(limit); }
    void interrupt()
    {
        if (needsCaller())
            link_->interrupt();
    }

    bool failed() const noexcept override { return failed_; }
    void throwIfFailed() const
    {
        if (!failed_)
            return;
        const std::lock_guard<std::mutex> lock(failureMutex_);
        throw TransportError(failure_);
    }

    // Tells the other ranks that this one cannot go on, so that nobody waits for it. Returns false if the connection
    // had failed already.
    bool giveUp(const ErrorInfo& error)
    {
        if (!setFailure(error))
            return false;
        detail::SmallBytes body;
        put(body, error);
        const auto header = detail::MessageHeader::of(detail::MessageKind::Failure);
        for (int other = 0; other < size(); ++other)
            if (other != rank())
                send(other, detail::makeMessage(*pool_, header, body));
        tellReceivers();
        return true;
    }

    // Runs a step that makes an object of all ranks. If it throws, the connection fails, because the other ranks would
    // wait for this one. Throws what the step throws.
    void giveUpIfThrows(detail::FunctionRef<void()> step)
    {
        try {
            step();
        } catch (const std::exception& e) {
            leave(e.what());
            throw;
        } catch (...) {
            leave("an exception that is not a std::exception");
            throw;
        }
    }

    // As giveUpIfThrows(), but only if memory is lacking: other errors are those of all ranks.
    void giveUpWithoutMemory(detail::FunctionRef<void()> step)
    {
        try {
            step();
        } catch (const std::bad_alloc& e) {
            leave(e.what());
            throw;
        }
    }

private:
    using Clock = std::chrono::steady_clock;

    struct Peer {
        std::uint32_t sent = 0;
        detail::SequenceWindow received;
    };

    void leave(const char* why) { giveUp(detail::errorInfo(ErrorKind::Transport, why, rank())); }

    void end()
    {
        progress_.stop();
        if (failed_) // the messages that tell the others should leave, but this waits 0.1 s at most
            for (int tries = 0; tries < 100 && link_->mayPoll() && !link_->quiet(); ++tries) {
                link_->poll();
                std::this_thread::sleep_for(std::chrono::milliseconds(1));
            }
        link_->stop(!failed_);
    }

    // Writes the header, with 0 in place of the checksum.
    static std::uint32_t checksumOf(detail::MessageHeader header, Buffer& message)
    {
        header.checksum = 0;
        detail::storeAll(message.data(), header);
        const std::uint32_t crc = crc32c(message.data(), message.size());
        return crc == 0 ? 1 : crc;
    }

    // Whether messages of this kind tell ranks that their configurations differ, or that a rank cannot go on.
    static bool isOfSetUp(detail::MessageKind kind)
    {
        using Kind = detail::MessageKind;
        return kind == Kind::ReduceUp || kind == Kind::ReduceDown || kind == Kind::Failure || kind == Kind::Ping
               || kind == Kind::Pong;
    }

    void checkChecksum(const detail::MessageHeader& header, Buffer& message) const
    {
        const std::uint32_t got = header.checksum;
        if ((got != 0) != config_.checksums && (isAlike_ || !isOfSetUp(header.kind)))
            detail::failMalformed(got != 0 ? "with a checksum; this rank uses none" : "without a checksum");
        if (got == 0)
            return;
        if (const std::uint32_t sum = checksumOf(header, message); sum != got)
            detail::failMalformed("the checksum is wrong", got, sum);
    }

    void receive(int source, Buffer&& message) override
    {
        detail::MessageHeader header;
        try {
            header = detail::readMessageHeader(message);
            checkChecksum(header, message);
            checkReceiver(header.receiver);
            if (!isNew(source, header))
                return;
            if (header.kind == detail::MessageKind::Failure) {
                detail::ByteReader body(std::as_const(message).data() + sizeof header, message.size() - sizeof header);
                const ErrorInfo error = detail::getErrorInfo(body);
                body.end();
                fail(error);
                return;
            }
            if (header.kind == detail::MessageKind::Ping || header.kind == detail::MessageKind::Pong)
                return;
        } catch (const Error& e) {
            ErrorInfo error = e.info();
            error.from = source;
            const std::lock_guard<std::mutex> lock(mutex_);
            for (const auto& [address, receiver] : receivers_)
                receiver->malformed(error);
            if (receivers_.empty())
                stray_ = error;
            return;
        }
        const std::lock_guard<std::mutex> lock(mutex_);
        if (const auto receiver = findReceiver(header.receiver); receiver != receivers_.end())
            receiver->second->receive(source, header, std::move(message));
        else if (header.receiver >= addresses_)
            unexpected_.push_back({source, header, std::move(message)});
    }

    using Receiver = std::pair<std::uint32_t, detail::MessageReceiver*>;

    // Returns the end if there is none.
    std::vector<Receiver>::iterator findReceiver(std::uint32_t address)
    {
        return std::find_if(receivers_.begin(), receivers_.end(),
                            [&](const Receiver& r) { return r.first == address; });
    }

    // Objects are made in the same order on all ranks, so a sender has few more of them than this rank.
    void checkReceiver(std::uint32_t address)
    {
        constexpr std::uint32_t mostAhead = 1024;
        const std::lock_guard<std::mutex> lock(mutex_);
        if (address >= addresses_ && address - addresses_ >= mostAhead)
            detail::failMalformed("for an object that this rank is far from having", addresses_, address);
    }

    bool isNew(int source, const detail::MessageHeader& header)
    {
        const std::lock_guard<std::mutex> lock(peersMutex_);
        heartbeat_.heard(source, header.kind == detail::MessageKind::Pong);
        if (header.kind == detail::MessageKind::Ping) {
            if (std::find(askers_.begin(), askers_.end(), source) == askers_.end())
                askers_.push_back(source);
            isAsked_ = true;
        }
        const bool isFirst = peers_[source].received.arrive(header.sequence);
        duplicates_ += !isFirst;
        return isFirst;
    }

    bool setFailure(const ErrorInfo& error)
    {
        const std::lock_guard<std::mutex> lock(failureMutex_);
        if (failed_)
            return false;
        failure_ = error;
        failed_ = true;
        return true;
    }

    void fail(const ErrorInfo& error) override
    {
        if (setFailure(error))
            tellReceivers();
    }

    // --- signs of life

    bool hasOwnThread() const { return link_->needsPolling() && config_.progress == Progress::Thread; }

    std::chrono::milliseconds peerTimeout() const
    {
        const bool isOn = hasOwnThread() && config_.peerTimeout >= std::chrono::milliseconds(100)
                          && config_.peerTimeout <= detail::longestTimeout;
        return isOn ? config_.peerTimeout : std::chrono::milliseconds(0);
    }

    // Short enough to answer a Ping in time, even that of a rank with a shorter time-out, down to 400 ms.
    Clock::duration longestNap() const
    {
        const Clock::duration longest = std::chrono::milliseconds(250);
        return heartbeat_.isOn() ? std::min(longest, heartbeat_.patience()) : std::chrono::seconds(1);
    }

    void sendSign(int other, detail::MessageKind kind)
    {
        send(other, detail::makeMessage(*pool_, detail::MessageHeader::of(kind)));
    }

    // Called between two polls, by the thread that polls.
    void beat(Clock::time_point now, bool expecting)
    {
        if (isAsked_ && isAsked_.exchange(false)) {
            std::vector<int> askers;
            {
                const std::lock_guard<std::mutex> lock(peersMutex_);
                askers.swap(askers_);
            }
            for (const int other : askers)
                sendSign(other, detail::MessageKind::Pong);
        }
        if (!heartbeat_.isOn() || failed_ || !heartbeat_.isDue(now)) // only due(), below, changes when it is due
            return;
        detail::Heartbeat::Due due;
        {
            const std::lock_guard<std::mutex> lock(peersMutex_);
            due = heartbeat_.due(now, expecting);
        }
        for (const int other : due.ask)
            sendSign(other, detail::MessageKind::Ping);
        if (due.lost >= 0)
            lose(due.lost);
    }

    void lose(int other)
    {
        const std::string text =
            detail::printed("this rank is lost: it has ended, is stopped or cannot be reached. Rank %d has heard "
                            "nothing of it for %lld ms (peerTimeout)",
                            rank(), static_cast<long long>(config_.peerTimeout.count()));
        const ErrorInfo error = detail::errorInfo(ErrorKind::Transport, text, other);
        if (!config_.onPeerLost)
            link_->abort(error.describe()); // does not return if the transport can do it
        if (giveUp(error) && config_.onPeerLost)
            config_.onPeerLost(error);
    }

    void waiting() override
    {
        beat(Clock::now(), true);
        if (!hasOwnThread())
            ProgressThread::pollOthers(&progress_);
    }

    void tellReceivers()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        for (const auto& [address, receiver] : receivers_)
            receiver->connectionFailed();
    }

    const NetworkConfig config_;
    const int exceptions_ = std::uncaught_exceptions();
    std::shared_ptr<MemoryPool> pool_;
    std::unique_ptr<Link> link_;
    const int rank_ = link_->rank(), size_ = link_->size();
    const bool isOversubscribed_ = link_->sharingRanks() > 2 * Processors::ofThisThread().count();
    std::atomic<std::int64_t> duplicates_{0};
    std::atomic<bool> isAlike_{false};

    mutable std::mutex peersMutex_;
    // Under peersMutex_:
    std::unordered_map<int, Peer> peers_; // made when first needed
    detail::Heartbeat heartbeat_{detail::treeNeighbours(rank_, size_), peerTimeout()};
    std::vector<int> askers_; // the ranks that have sent a Ping

    std::atomic<bool> isAsked_{false}; // there are askers

    std::mutex mutex_; // held while a receiver is called, so that detach() waits for the call
    std::vector<Receiver> receivers_;
    std::vector<detail::Arrival> unexpected_; // for receivers that are not attached yet
    std::optional<ErrorInfo> stray_;          // of a malformed message that came when there was no receiver
    std::uint32_t addresses_ = 0;

    mutable std::mutex failureMutex_;
    ErrorInfo failure_;                     // if failed_; under failureMutex_
    std::weak_ptr<const void> thrownByAll_; // under failureMutex_
    std::atomic<bool> failed_{false};

    ProgressThread progress_{*link_, longestNap(), [this](Clock::time_point now) {
                                 try {
                                     beat(now, progress_.expectsMessages());
                                 } catch (const std::bad_alloc& e) { // the thread has nobody to tell
                                     fail(detail::errorInfo(ErrorKind::Transport, e.what(), rank()));
                                 }
                             }};
};

// Connects the ranks of a communicator, for framebuffers, compositors and walls that share the connection. Collective,
// as is the destruction of the connection. Waits for all ranks. With MPI below MPI_THREAD_SERIALIZED it must be called
// by the thread that initialised MPI. Throws InvalidArgument for MPI_COMM_NULL or an intercommunicator; TransportError;
// and std::system_error on a rank that gets no thread.
template <class Transport = MpiTransport>
std::shared_ptr<Connection> connect(const typename Transport::Communicator& communicator, NetworkConfig config = {})
{
    config.progress = detail::resolved<Transport>(config.progress, communicator);
    auto pool = MemoryPool::create(config.sharedMemory);
    auto link = std::make_unique<detail::LinkOver<Transport>>(communicator, pool, config.progress);
    return std::make_shared<Connection>(std::move(config), std::move(pool), std::move(link));
}

namespace detail {

// Makes an executor with Connection::threadShare() threads. If the system gives no threads, the connection fails.
inline std::shared_ptr<ThreadExecutor> makeThreads(Connection& connection)
{
    std::shared_ptr<ThreadExecutor> threads;
    connection.giveUpIfThrows([&] { threads = std::make_shared<ThreadExecutor>(connection.threadShare()); });
    return threads;
}

} // namespace detail

DFB_NAMESPACE_END
