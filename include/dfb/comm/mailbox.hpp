// Mailbox: the messages of one object on all ranks: an inbox that is emptied by tasks, messages with and without
// credit, reductions, and waiting without spinning.
#pragma once

#include <dfb/base/fifo.hpp>
#include <dfb/base/function_ref.hpp>
#include <dfb/comm/byte_io.hpp>
#include <dfb/comm/connection.hpp>
#include <dfb/comm/flow_control.hpp>
#include <dfb/comm/quiescence.hpp>
#include <dfb/comm/reduction.hpp>
#include <dfb/exec.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

namespace dfb::detail {

// What the messages are handed to; it knows what they mean.
class MailboxOwner {
public:
    // In a task; several at once, in any order. Reductions come here too, to be let through with receiveReduction();
    // but for those of reduce().
    virtual void incoming(int source, const MessageHeader& header, Buffer&& message) = 0;
    // A message of whatever kind, perhaps not even for this object: what it cannot fail for, it leaves to
    // keepDamage().
    virtual void undecodable(int source, const ErrorInfo& error) = 0;
    virtual void work(int) {} // what submitWork() was given
    virtual void polled() {}  // messages have moved while this rank waits and nobody else would move them

protected:
    ~MailboxOwner() = default;
};

class Mailbox final : private MessageReceiver {
public:
    using Bytes = ReductionTable::Bytes;
    using Clock = std::chrono::steady_clock;
    // Of reduce(), and of rounds that only look whether anything is under way; the handler uses others as well.
    static constexpr std::uint32_t ownScope = 0, quietScope = ~std::uint32_t{0};

    // `poolBytes`: see FlowControl.
    Mailbox(std::shared_ptr<Connection> connection, std::shared_ptr<Executor> executor, std::size_t poolBytes,
            MailboxOwner& handler)
        : connection_(std::move(connection)), executor_(std::move(executor)), handler_(handler),
          flow_(connection_->size(), poolBytes,
                {[this](int to, Buffer&& message) { connection_->send(to, std::move(message)); },
                 [this](int to, const FlowControl::Request& request) {
                     sendBody(to, MessageKind::CreditRequest, epoch_, request);
                 },
                 [this](int to, const FlowControl::Credit& credit) {
                     sendBody(to, MessageKind::Credit, epoch_, credit);
                 }}),
          reductions_(connection_->rank(), connection_->size(),
                      [this](int to, const ReductionKey& key, bool up, const Bytes& bytes) {
                          sendReduction(to, key, up, bytes);
                      })
    {
        inbox_.reserve(256); // how many wait at once depends on time: mostly no more
    }

    // From here on the handler is called. Collective, in the same order for all objects of a connection.
    void start() { connection_->attach(*this, address_); }

    ~Mailbox() { stop(); }

    // Afterwards the handler is not called any more.
    void stop()
    {
        connection_->detach(address_);
        std::unique_lock<std::mutex> lock(mutex_);
        isEnding_ = true;
        while (tasks_ > 0) {
            lock.unlock();
            const bool did = executor_->help(); // who else would, if it has no workers?
            lock.lock();
            if (!did)
                changed_.wait_for(lock, std::chrono::milliseconds(2), [this] { return tasks_ == 0; });
        }
    }

    int rank() const noexcept { return connection_->rank(); }
    int size() const noexcept { return connection_->size(); }
    bool failed() const noexcept { return connection_->failed(); }
    std::uint32_t address() const noexcept { return address_; }
    Connection& connection() noexcept { return *connection_; }
    Executor& executor() const noexcept { return *executor_; }

    // Credits are counted from here again; see FlowControl. No message with credit may be in a task.
    void newEpoch(std::int64_t number)
    {
        epoch_ = number;
        sentOn_ = takenOn_ = 0;
        flow_.newEpoch();
    }
    FlowControl& flow() noexcept { return flow_; }

    // Messages that say little pass at once; from any thread; to this rank as well.
    void send(int destination, Buffer&& message)
    {
        if (destination == rank()) {
            enqueue(destination, loadAs<MessageHeader>(message.data()), std::move(message));
            return;
        }
        countSent(message);
        connection_->send(destination, std::move(message));
    }

    void send(int destination, MessageKind kind, std::int64_t number, const Bytes& body = {})
    {
        MessageHeader header;
        header.kind = kind;
        header.receiver = address_;
        header.number = number;
        send(destination, makeMessage(*connection_->pool(), header, body.data(), body.size()));
    }

    // The same with a body of plain bytes.
    template <class Body>
    void sendBody(int destination, MessageKind kind, std::int64_t number, const Body& body)
    {
        static_assert(std::is_trivially_copyable_v<Body>);
        const auto* first = reinterpret_cast<const std::byte*>(&body);
        send(destination, kind, number, Bytes(first, first + sizeof body));
    }

    // Messages that carry pixels need credit of their receiver, and are kept until they have it. Never blocks.
    void sendWithCredit(int destination, Buffer&& message)
    {
        if (destination == rank()) {
            send(destination, std::move(message));
            return;
        }
        countSent(message); // now, so that a frame's figures have it
        flow_.send(destination, std::move(message));
    }
    static bool needsCredit(MessageKind kind)
    {
        return kind == MessageKind::Fragment || kind == MessageKind::FinishedTiles;
    }

    // Returns when what this rank has sent, and nobody has taken out of an inbox yet, is no more than a pool, or
    // `over()`. Runs waiting tasks meanwhile, so that ranks that wait for each other's inboxes get on. On a thread that
    // could not make progress it returns at once. False if nobody takes anything for as long as `limit`, unless that is
    // 0.
    bool waitForRoom(FunctionRef<bool()> over, std::chrono::milliseconds limit)
    {
        std::size_t before = flow_.underWay();
        const auto roomy = [this] { return flow_.underWay() <= flow_.poolBytes(); };
        const auto done = [&] { return roomy() || failed() || over(); };
        if (done())
            return true;
        const Connection::Hurry hurry(*connection_);
        for (auto lastChange = Clock::now(); !done();) {
            if (const std::size_t now = flow_.underWay(); now < before) {
                before = now;
                lastChange = Clock::now();
            } else if (limit.count() > 0 && Clock::now() - lastChange > limit) {
                return false;
            }
            if (executor_->help())
                continue;
            if (connection_->needsCaller()) {
                if (!connection_->mayPoll())
                    return true;
                if (!connection_->poll() && !done())
                    connection_->nap(std::chrono::microseconds(50));
            } else {
                std::unique_lock<std::mutex> lock(mutex_);
                changed_.wait_for(lock, std::chrono::microseconds(200), [&] { return !inbox_.empty() || roomy(); });
            }
        }
        return true;
    }

    // For calls that wait, before anything has happened: throws InvalidArgument on a thread that could not make the
    // progress that it would wait for.
    void requireProgress() const
    {
        if (connection_->needsCaller() && !connection_->mayPoll())
            failArgument("at this thread level of MPI calls that wait belong to the thread that initialised it");
    }

    // Takes note that this message of the epoch has been taken.
    void countTaken(int source, const MessageHeader& header, const Buffer& message)
    {
        if (source != rank() && carriesOn(header.kind, message))
            ++takenOn_;
    }

    // The messages of the epoch that make who takes them do something, at a moment at which this object rests: no task
    // of it is queued or runs, and nothing waits to be sent. Nothing if it does not rest.
    std::optional<MessageCounts> countsAtRest()
    {
        const MessageCounts counts{sentOn_, takenOn_};
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (tasks_ > 0)
                return std::nullopt;
        }
        if (!flow_.allSent() || !connection_->quiet() || counts.sent != sentOn_ || counts.taken != takenOn_)
            return std::nullopt;
        return counts; // they were these when there was no task
    }

    // Takes a message about credit of the current epoch. False if it is none. Throws Error (MalformedMessage).
    bool receiveCredit(int source, const MessageHeader& header, const Buffer& message)
    {
        if (header.kind == MessageKind::CreditRequest)
            flow_.requested(source, bodyOf<FlowControl::Request>(message));
        else if (header.kind == MessageKind::Credit)
            flow_.credited(source, bodyOf<FlowControl::Credit>(message));
        else
            return false;
        return true;
    }

    // Message bytes and messages to other ranks since the start.
    std::int64_t bytesSent() const noexcept { return bytesSent_; }
    std::int64_t messagesSent() const noexcept { return messagesSent_; }

    // Runs `task` on the executor; the destructor waits for it. It must not throw.
    template <class Task>
    void submit(Task task)
    {
        submitToExecutor([this, task = std::move(task)] {
            task();
            taskDone();
        });
    }

    // The same for the handler's work(number); takes no memory.
    void submitWork(int number)
    {
        submitToExecutor([this, number] {
            handler_.work(number);
            taskDone();
        });
    }

    ReductionTable& reductions() noexcept { return reductions_; }

    // What a ReduceUp or ReduceDown message belongs to, and what it brings.
    static ReductionKey keyOf(const MessageHeader& header, const Buffer& message)
    {
        return {scopeOf(message), header.number};
    }
    static Bytes bytesOf(const Buffer& message)
    {
        return Bytes(message.data() + sizeof(MessageHeader) + sizeof(std::uint32_t), message.data() + message.size());
    }

    void receiveReduction(int source, const MessageHeader& header, const Buffer& message)
    {
        reductions_.receive(source, keyOf(header, message), header.kind == MessageKind::ReduceUp, bytesOf(message));
    }

    // Nobody knows what a message was that could not be read. Where it may have been for what this rank has not begun
    // yet, that fails: the next frame, which takes this, or the next reduce().
    void keepDamage(int source, const ErrorInfo& error)
    {
        const std::lock_guard<std::mutex> lock(damageMutex_);
        damage_.emplace(source, error);
    }
    std::optional<std::pair<int, ErrorInfo>> takeDamage()
    {
        const std::lock_guard<std::mutex> lock(damageMutex_);
        return std::exchange(damage_, std::nullopt);
    }

    // For a message of rank `source` that nothing goes on without.
    void giveUp(int source, ErrorInfo error)
    {
        error.rank = rank();
        error.from = source;
        connection_->giveUp(error);
    }

    // Wakes those in wait(), to ask again.
    void notify()
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            changed_.notify_all();
        }
        connection_->interrupt();
    }

    // Waits until `ready()`, which must not lock what is held while calling notify(); makes progress if that is the
    // caller's business. False if `deadline` has passed before. Throws TransportError.
    bool wait(FunctionRef<bool()> ready, std::optional<Clock::time_point> deadline = std::nullopt)
    {
        const auto over = [&] { return failed() || ready(); };
        const auto late = [&] { return deadline && Clock::now() >= *deadline; };
        waitAwake(over);
        const Connection::Hurry hurry(*connection_);
        std::unique_lock<std::mutex> lock(mutex_);
        if (!connection_->needsCaller()) {
            while (!over() && !late()) {
                const auto next = Clock::now() + std::chrono::milliseconds(2);
                changed_.wait_until(lock, deadline ? std::min(*deadline, next) : next,
                                    [&] { return over() || (!executor_->hasWorkers() && executor_->hasTasks()); });
                // Workers may be short: those of several ranks in one process can all be in waitForRoom(), each for
                // the others.
                lock.unlock();
                while (!over() && !late() && executor_->help()) {
                }
                lock.lock();
            }
        } else {
            // Also when all is over what was just queued must leave, such as a result for ranks below in the tree.
            while ((!over() || (!failed() && !connection_->quiet())) && !late()) {
                lock.unlock();
                if (!executor_->help() && !connection_->poll() && !over())
                    connection_->nap(std::chrono::microseconds(50));
                handler_.polled();
                lock.lock();
            }
        }
        const bool isReady = ready();
        lock.unlock();
        if (!isReady)
            connection_->throwIfFailed();
        return isReady;
    }

    // Collective: combines `own` over all ranks and waits for the result. Throws TransportError, also when a message
    // could not be read that may have been a part of this: when there is no result after a second, or `peerTimeout`
    // if it came before this rank was here; InvalidArgument, see requireProgress().
    Bytes reduce(Bytes own, ReductionTable::Combine combine)
    {
        requireProgress();
        struct Result {
            std::atomic<bool> there{false};
            Bytes bytes;
        };
        const auto result = std::make_shared<Result>(); // outlives this call if the transport fails
        const std::int64_t number = reductionCount_++;
        auto damage = takeDamage(); // now: when the others have this rank's part, they may go on to what comes after
        connection_->expectMessages(true);
        try {
            try {
                reductions_.enter({ownScope, number}, std::move(own), std::move(combine),
                                  [this, result](const Bytes& bytes) {
                                      result->bytes = bytes;
                                      result->there = true;
                                      notify();
                                  });
            } catch (const Error& e) { // of what ranks below in the tree have sent before
                ErrorInfo error = e.info();
                error.rank = rank();
                connection_->giveUp(error);
            }
            waitForResult([&] { return result->there.load(); }, number == 0, std::move(damage));
        } catch (...) {
            connection_->expectMessages(false);
            throw;
        }
        connection_->expectMessages(false);
        return result->bytes;
    }

    // Collective: combines `values` element by element. Throws InvalidArgument on all ranks if their numbers differ.
    template <class Operation>
    std::vector<std::int64_t> allReduce(const std::vector<std::int64_t>& values, Operation operation)
    {
        ByteWriter mine;
        mine.put(static_cast<std::int32_t>(rank()));
        for (const std::int64_t value : values)
            mine.put(value);
        const Bytes result = reduce(mine.bytes(), [operation](const Bytes& a, const Bytes& b) {
            return ReductionTable::combineElements(a, b, operation);
        });
        ByteReader in(result);
        if (in.get<std::int32_t>() < 0)
            throw InvalidArgument("the number of values in allReduce() is " + in.getText()
                                  + ": it must be the same on all ranks");
        in.require(in.left() == values.size() * sizeof(std::int64_t));
        std::vector<std::int64_t> reduced(values.size());
        for (std::int64_t& value : reduced)
            value = in.get<std::int64_t>();
        return reduced;
    }

    // Collective: what each rank has given, by rank. The numbers of bytes may differ.
    std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& own)
    {
        ByteWriter out; // of each rank: which it is, the size, the bytes
        out.put(static_cast<std::int32_t>(rank()));
        out.put(static_cast<std::uint64_t>(own.size()));
        Bytes mine = out.bytes();
        mine.append(own.data(), own.data() + own.size());
        const Bytes all = reduce(std::move(mine), [](const Bytes& a, const Bytes& b) {
            Bytes both = a;
            both.append(b.begin(), b.end());
            return both;
        });
        std::vector<std::vector<std::byte>> result;
        ByteReader in(all);
        for (int from = 0; from < size(); ++from) { // in order, as they were combined
            const auto whose = in.get<std::int32_t>();
            const auto byteCount = in.get<std::uint64_t>();
            in.require(whose == from && byteCount <= in.left());
            result.emplace_back(static_cast<std::size_t>(byteCount));
            in.getBytes(result.back().data(), result.back().size());
        }
        in.end();
        return result;
    }

private:
    // A message that could not be read may have been a part of this, for which others may not be here yet, or of what
    // comes after, if they are through. The first one is what its owner's constructor does. `damage`: from before.
    void waitForResult(FunctionRef<bool()> ready, bool isFirst, std::optional<std::pair<int, ErrorInfo>> damage)
    {
        constexpr std::chrono::milliseconds soon{1000}; // when all seem to be here
        const std::chrono::milliseconds late = connection_->config().peerTimeout;
        const bool wasBefore = damage.has_value();
        std::optional<Clock::time_point> deadline;
        if (damage)
            deadline = Clock::now() + (isFirst ? soon : late);
        while (!ready()) {
            if (!wait([&] { return ready() || (!damage && isDamaged()); }, deadline)) {
                giveUp(damage->first, damage->second);
            } else if (!damage && (damage = takeDamage())) {
                deadline = Clock::now() + soon;
            }
        }
        if (damage && !wasBefore)
            keepDamage(damage->first, damage->second);
    }

    bool isDamaged()
    {
        const std::lock_guard<std::mutex> lock(damageMutex_);
        return damage_.has_value();
    }

    // For a moment a waiting thread does by itself what those do that would otherwise have to be woken, each of which
    // may wait for a core then. Gives up when nothing has come for some time, or when others need the core.
    void waitAwake(FunctionRef<bool()> over)
    {
        if (!connection_->hasProgressThread())
            return;
        constexpr std::chrono::microseconds patience{200}, taken{50};
        for (auto last = Clock::now(); !over();) {
            const bool did = executor_->help() || connection_->helpProgress();
            const auto now = Clock::now();
            if (did) {
                last = now;
                continue;
            }
            if (now - last > patience)
                return;
            std::this_thread::yield();
            if (Clock::now() - now > taken)
                return;
        }
    }

    template <class Task>
    void submitToExecutor(Task task)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            ++tasks_;
        }
        executor_->submit(std::move(task));
        if (!executor_->hasWorkers()) // whoever waits is to run it
            notify();
    }

    void taskDone()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        --tasks_;
        if (isEnding_) // others wait for what tasks do, and are told
            changed_.notify_all();
    }

    void countSent(const Buffer& message)
    {
        bytesSent_ += static_cast<std::int64_t>(message.size());
        ++messagesSent_;
        if (carriesOn(loadAs<MessageHeader>(message.data()).kind, message))
            ++sentOn_;
    }

    // Whether a message makes who takes it do something for its frame. Credit does so only for what waits for it.
    static bool carriesOn(MessageKind kind, const Buffer& message)
    {
        switch (kind) {
        case MessageKind::Credit:
        case MessageKind::CreditRequest:
        case MessageKind::ImagePlace: return false;
        case MessageKind::ReduceUp:
        case MessageKind::ReduceDown: {
            const bool hasScope = message.size() >= sizeof(MessageHeader) + sizeof(std::uint32_t);
            const std::uint32_t scope = hasScope ? scopeOf(message) : ownScope;
            return scope != ownScope && scope != quietScope;
        }
        default: return true;
        }
    }
    static std::uint32_t scopeOf(const Buffer& message)
    {
        return loadAs<std::uint32_t>(message.data() + sizeof(MessageHeader));
    }

    struct Arrival {
        int source;
        MessageHeader header;
        Buffer message;
    };

    void sendReduction(int destination, const ReductionKey& key, bool up, const Bytes& bytes)
    {
        const auto* scope = reinterpret_cast<const std::byte*>(&key.scope);
        Bytes body(scope, scope + sizeof key.scope);
        body.append(bytes.begin(), bytes.end());
        send(destination, up ? MessageKind::ReduceUp : MessageKind::ReduceDown, key.number, body);
    }

    void receive(int source, const MessageHeader& header, Buffer&& message) override
    {
        if (needsCredit(header.kind))
            flow_.arrived(message.size());
        enqueue(source, header, std::move(message));
    }

    // A message only goes into the inbox here; a task takes it out.
    void enqueue(int source, const MessageHeader& header, Buffer&& message)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            inbox_.push({source, header, std::move(message)});
        }
        submit([this] {
            std::optional<Arrival> next;
            {
                const std::lock_guard<std::mutex> lock(mutex_);
                next.emplace(inbox_.pop());
            }
            dispatch(std::move(*next));
        });
    }

    void dispatch(Arrival&& a)
    {
        try {
            if (a.header.kind == MessageKind::ReduceUp || a.header.kind == MessageKind::ReduceDown) {
                if (a.message.size() < sizeof a.header + sizeof(std::uint32_t))
                    failMalformed("a reduction without a scope");
                if (keyOf(a.header, a.message).scope == ownScope) {
                    requireCanBe(a.header);
                    receiveReduction(a.source, a.header, a.message);
                    return;
                }
            }
        } catch (const Error& e) {
            giveUp(a.source, e.info()); // nothing goes on without it
            return;
        }
        handler_.incoming(a.source, a.header, std::move(a.message));
    }

    // Of reductions of reduce(): this rank is at the last one that it has begun, and who is at the next one has got the
    // result of that through this rank.
    void requireCanBe(const MessageHeader& header)
    {
        const std::int64_t begun = reductionCount_, number = header.number;
        const bool isLast = number >= 0 && number == begun - 1;
        const bool isNext =
            number == begun && header.kind == MessageKind::ReduceUp && !reductions_.isUnderWay({ownScope, begun - 1});
        if (!isLast && !isNext)
            failMalformed("a reduction that no rank can be at", begun, number);
    }

    void malformed(int source, const ErrorInfo& error) override
    {
        submit([this, source, error] { handler_.undecodable(source, error); });
    }

    void connectionFailed() override { notify(); }

    std::shared_ptr<Connection> connection_;
    std::shared_ptr<Executor> executor_;
    MailboxOwner& handler_;
    std::uint32_t address_ = 0;
    std::atomic<std::int64_t> epoch_{0};
    FlowControl flow_;
    ReductionTable reductions_;
    std::atomic<std::int64_t> bytesSent_{0}, messagesSent_{0};
    std::atomic<std::uint64_t> sentOn_{0}, takenOn_{0}; // see countsAtRest()
    std::atomic<std::int64_t> reductionCount_{0};       // of reduce()
    std::mutex damageMutex_;
    std::optional<std::pair<int, ErrorInfo>> damage_; // under damageMutex_

    std::mutex mutex_;
    std::condition_variable changed_;
    Fifo<Arrival> inbox_;
    int tasks_ = 0; // submitted and not yet done
    bool isEnding_ = false;
};

} // namespace dfb::detail
