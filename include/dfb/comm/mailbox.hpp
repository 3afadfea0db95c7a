// Mailbox: sends and receives the messages of one object that exists on all ranks, such as a framebuffer. Tasks of the
// executor empty its inbox. It has messages with and without credit, reductions, and waiting without spinning.
#pragma once

#include <dfb/base/fifo.hpp>
#include <dfb/base/function_ref.hpp>
#include <dfb/comm/connection.hpp>
#include <dfb/comm/flow_control.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/comm/quiescence.hpp>
#include <dfb/comm/reduction.hpp>
#include <dfb/exec.hpp>
#include <dfb/trace.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <new>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// The object that the messages are for.
class MailboxOwner {
public:
    // Takes a message. Called in tasks, for several messages at once and in any order. Messages of the owner's own
    // reductions come here, too, to be passed on to receiveReduction(); those of reduce() do not. If it throws Error or
    // std::bad_alloc, the connection fails.
    virtual void incoming(int source, const MessageHeader& header, Buffer&& message) = 0;
    // A message of rank error.from could not be read. Its kind and its receiver are not known. If no frame can fail
    // because of it, the owner calls keepDamage().
    virtual void undecodable(const ErrorInfo& error) = 0;
    virtual void work(int) {} // runs the work of submitWork(number), in a task
    virtual void polled() {}  // called by wait() after it has moved messages itself

protected:
    ~MailboxOwner() = default;
};

class Mailbox final : private MessageReceiver {
public:
    using Bytes = ReductionTable::Bytes;
    using Clock = std::chrono::steady_clock;
    // The scopes of reduce(), and of the rounds that check whether anything is under way. The owner uses others.
    static constexpr std::uint32_t ownScope = 0, quietScope = ~std::uint32_t{0};

    // `poolBytes`: see FlowControl. `trace` may be null.
    Mailbox(std::shared_ptr<Connection> connection, std::shared_ptr<Executor> executor, std::size_t poolBytes,
            MailboxOwner& handler, TraceSink* trace = nullptr)
        : connection_(std::move(connection)), executor_(std::move(executor)), handler_(handler), trace_(trace),
          flow_(connection_->size(), poolBytes,
                {[this](int to, Buffer&& message) { pass(to, std::move(message)); },
                 [this](int to, const FlowControl::Request& request) {
                     sendBody(to, MessageKind::CreditRequest, epoch_, request);
                 },
                 [this](int to, const FlowControl::Credit& credit) {
                     sendBody(to, MessageKind::Credit, epoch_, credit);
                 }}),
          reductions_(connection_->rank(), connection_->size(),
                      [this](int to, const ReductionKey& key, bool up, const Bytes& bytes) {
                          Bytes body;
                          body.put(key.scope);
                          body.append(bytes.begin(), bytes.end());
                          send(to, up ? MessageKind::ReduceUp : MessageKind::ReduceDown, key.number, body);
                      })
    {
        inbox_.reserve(256); // usually no more wait at once
    }

    // Begins to call the handler. Collective: all ranks call it in the same order for the objects of a connection.
    void start() { connection_->attach(*this, address_); }

    ~Mailbox() { stop(); }

    // Ends the calls of the handler, and waits for those under way. Tells the neighbours in the tree of reductions that
    // this rank takes no part in what begins later.
    void stop()
    {
        if (!isEnding_ && !failed())
            orGiveUp([&] {
                for (const int neighbour : treeNeighbours(rank(), size()))
                    sendBody(neighbour, MessageKind::Leaving, epoch_,
                             Leaving{reductionCount_, std::uncaught_exceptions()});
            });
        connection_->detach(address_);
        std::unique_lock<std::mutex> lock(mutex_);
        isEnding_ = true;
        while (tasks_ > 0) {
            lock.unlock();
            const bool did = executor_->help(); // without workers nobody else runs the tasks
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
    TraceSink* trace() const noexcept { return trace_; } // or null

    // Begins an epoch and counts credit anew; see FlowControl. No task may be handling a message with credit.
    void newEpoch(std::int64_t number)
    {
        workSent_ = workTaken_ = 0;
        bytesSent_ = messagesSent_ = 0;
        flow_.newEpoch();
        enterEpoch(number);
    }
    // Begins an epoch without counting credit anew. Gives up if a neighbour in the tree of reductions has left before
    // that.
    void enterEpoch(std::int64_t number)
    {
        epoch_ = number;
        checkLeft();
    }
    FlowControl& flow() noexcept { return flow_; }

    // Sends a message, also to this rank itself. Any thread; never blocks. A message with pixels needs credit of its
    // receiver, and is kept here until there is enough.
    void send(int destination, Buffer&& message)
    {
        const auto header = loadAs<MessageHeader>(message.data());
        if (destination == rank()) {
            enqueue(destination, header, std::move(message));
            return;
        }
        // Counts it now, so that the figures of the frame include it even if it has to wait.
        bytesSent_ += static_cast<std::int64_t>(message.size());
        ++messagesSent_;
        const bool isCounted = isWork(header.kind, message);
        workSent_ += isCounted;
        try {
            if (needsCredit(header.kind))
                flow_.send(destination, std::move(message));
            else
                pass(destination, std::move(message));
        } catch (...) { // no rank will take it
            workSent_ -= isCounted;
            throw;
        }
    }

    void send(int destination, MessageKind kind, std::int64_t number, const Bytes& body = {})
    {
        const auto header = MessageHeader::of(kind, address_, number);
        send(destination, makeMessage(*connection_->pool(), header, body));
    }

    // Sends a message whose body is a trivially copyable struct.
    template <class Body>
    void sendBody(int destination, MessageKind kind, std::int64_t number, const Body& body)
    {
        Bytes bytes;
        bytes.put(body);
        send(destination, kind, number, bytes);
    }

    static bool needsCredit(MessageKind kind)
    {
        return kind == MessageKind::Fragment || kind == MessageKind::FinishedTiles;
    }

    // Waits until over(), or until the messages that receivers have not taken out of their inboxes have at most
    // poolBytes in all. Runs waiting tasks meanwhile, so that ranks that wait for each other go on. Does not wait on a
    // thread that cannot move messages. Returns false if no message is taken for as long as `limit`; 0: no limit.
    bool waitForRoom(FunctionRef<bool()> over, std::chrono::milliseconds limit)
    {
        std::size_t before = flow_.underWay();
        const auto roomy = [this] { return flow_.underWay() <= flow_.poolBytes(); };
        const auto done = [&] { return roomy() || failed() || over(); };
        if (done())
            return true;
        const TraceSpan span(trace_, TraceEvent::Kind::Wait, epoch_);
        const Connection::Hurry hurry(*connection_);
        for (auto lastChange = Clock::now(); !done();) {
            if (const std::size_t now = flow_.underWay(); now != before) { // or it has grown: another thread found room
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

    // Throws InvalidArgument if the calling thread must move messages while it waits, but may not call MPI. Calls that
    // wait begin with this check.
    void requireProgress() const
    {
        if (connection_->needsCaller() && !connection_->mayPoll())
            failArgument("below MPI_THREAD_SERIALIZED only the thread that has initialised MPI may make this call");
    }

    // Counts a message of the epoch as taken.
    void countTaken(int source, const MessageHeader& header, const Buffer& message)
    {
        if (source != rank() && isWork(header.kind, message))
            ++workTaken_;
    }

    // Returns how many messages of the epoch this rank has sent and taken; only those count that make their receiver do
    // something. Returns nothing unless this object rests: none of its tasks is queued or runs, and nothing waits to be
    // sent.
    std::optional<Quiescence::Report> countsAtRest()
    {
        const Quiescence::Report counts{workSent_, workTaken_};
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (tasks_ > 0)
                return std::nullopt;
        }
        if (!flow_.allSent() || !connection_->quiet() || counts.sent != workSent_ || counts.taken != workTaken_)
            return std::nullopt;
        return counts; // they are the same before and after the check for tasks
    }

    // Takes a message about credit of the current epoch, which its sender may wait to have answered. Returns false if
    // the message is of another kind. Throws Error (MalformedMessage).
    bool receiveCredit(int source, const MessageHeader& header, const Buffer& message)
    {
        if (header.kind == MessageKind::CreditRequest)
            makePart([&] { flow_.requested(source, bodyOf<FlowControl::Request>(message)); });
        else if (header.kind == MessageKind::Credit)
            makePart([&] { flow_.credited(source, bodyOf<FlowControl::Credit>(message)); });
        else
            return false;
        return true;
    }

    // Bytes and number of the messages to other ranks since newEpoch().
    std::int64_t bytesSent() const noexcept { return bytesSent_; }
    std::int64_t messagesSent() const noexcept { return messagesSent_; }

    // Runs the handler's work(number) on the executor; the destructor waits for it. It must not throw.
    void submitWork(int number)
    {
        submit([number](Mailbox& self) { self.handler_.work(number); });
    }

    ReductionTable& reductions() noexcept { return reductions_; }

    // The scope and the bytes of a ReduceUp or ReduceDown message.
    static std::uint32_t scopeOf(const Buffer& message)
    {
        return loadAs<std::uint32_t>(message.data() + sizeof(MessageHeader));
    }
    static Bytes bytesOf(const Buffer& message)
    {
        return Bytes(message.data() + sizeof(MessageHeader) + sizeof(std::uint32_t), message.data() + message.size());
    }

    // Without this message the reduction would never have a result: if this throws, giveUp().
    void receiveReduction(int source, const MessageHeader& header, const Buffer& message)
    {
        reductions_.receive(source, {scopeOf(message), header.number}, header.kind == MessageKind::ReduceUp,
                            bytesOf(message));
    }

    // A message of rank `source` that needed credit has left the inbox. Other ranks may wait for the credit.
    void consumed(int source, std::size_t byteCount)
    {
        orGiveUp([&] { flow_.consumed(source, byteCount); });
    }

    // Keeps the error of a message that could not be read. The message may have been for something that this rank has
    // not begun yet, which then fails: the next frame, or the next reduce().
    void keepDamage(const ErrorInfo& error)
    {
        const std::lock_guard<std::mutex> lock(damageMutex_);
        damage_ = error;
    }
    std::optional<ErrorInfo> takeDamage()
    {
        const std::lock_guard<std::mutex> lock(damageMutex_);
        return std::exchange(damage_, std::nullopt);
    }

    // Ends the connection, because a message of rank `source` was needed to go on and is of no use.
    void giveUp(int source, ErrorInfo error)
    {
        error.rank = rank();
        error.from = source;
        connection_->giveUp(error);
    }

    // As makePart(), but throws nothing if memory is lacking: the connection has failed, which all calls notice.
    void orGiveUp(FunctionRef<void()> step)
    {
        try {
            makePart(step);
        } catch (const std::bad_alloc&) {
        }
    }

    // Makes all threads in wait() check their condition again.
    void notify()
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            changed_.notify_all();
        }
        connection_->interrupt();
    }

    // For as long as it lives, a worker waits: perhaps all of them do.
    class WorkerWaits {
    public:
        explicit WorkerWaits(Mailbox& mailbox) noexcept : mailbox_(mailbox) { ++mailbox_.waitingWorkers_; }
        ~WorkerWaits() { --mailbox_.waitingWorkers_; }
        WorkerWaits(const WorkerWaits&) = delete;
        WorkerWaits& operator=(const WorkerWaits&) = delete;

    private:
        Mailbox& mailbox_;
    };

    // Waits until ready() was true once: another thread may take what this one has waited for. It must not take a lock
    // that a caller of notify() holds. Moves messages itself if no other thread does. Returns false if `deadline`
    // passes before. Throws TransportError.
    bool wait(FunctionRef<bool()> ready, std::optional<Clock::time_point> deadline = std::nullopt)
    {
        const TraceSpan span(trace_, TraceEvent::Kind::Wait, epoch_);
        bool isReady = false;
        const auto over = [&] { return isReady || failed() || (isReady = ready()); };
        const auto late = [&] { return deadline && Clock::now() >= *deadline; };
        waitAwake(over);
        const Connection::Hurry hurry(*connection_);
        std::unique_lock<std::mutex> lock(mutex_);
        if (!connection_->needsCaller()) {
            // All workers may be in waitForRoom(): those of several ranks in one process can wait for each other. So
            // this thread looks for tasks now and then. While there are none it looks less and less often, because with
            // many ranks in a process looking would take all the time.
            constexpr std::chrono::milliseconds shortest{2}, longest{32};
            for (std::chrono::milliseconds pause = shortest; !over() && !late();) {
                const auto next = Clock::now() + pause;
                changed_.wait_until(lock, deadline ? std::min(*deadline, next) : next,
                                    [&] { return over() || (runsTasksAtOnce() && executor_->hasTasks()); });
                lock.unlock();
                pause = std::min(2 * pause, longest);
                while (!over() && !late() && executor_->help())
                    pause = shortest;
                lock.lock();
            }
        } else {
            // This thread stays awake at first: a nap takes about 0.1 ms, and a frame waits for some five messages one
            // after the other. But a rank that is awake takes time from the ranks that share its processor.
            SpinWait spin(std::chrono::microseconds(connection_->isOversubscribed() ? 30 : 1000));
            // Messages that were just queued, such as results for ranks below in the tree, must leave even if the wait
            // is over. They get a second for it if the deadline comes sooner.
            std::optional<Clock::time_point> leaveBy;
            const auto goesOn = [&] {
                if (!over())
                    return !late();
                if (!connection_->mayPoll())
                    return false; // only another thread can send them
                if (deadline && !leaveBy)
                    leaveBy = std::max(*deadline, Clock::now() + std::chrono::seconds(1));
                return !failed() && !connection_->quiet() && !(leaveBy && Clock::now() >= *leaveBy);
            };
            while (goesOn()) {
                lock.unlock();
                // Polls before running a task, as other ranks may wait for messages that this one has queued.
                const bool moved = connection_->poll();
                if (executor_->help() || moved)
                    spin.renew();
                else if (!over() && !spin.yield())
                    connection_->nap(std::chrono::microseconds(50));
                handler_.polled();
                lock.lock();
            }
        }
        isReady = isReady || ready();
        lock.unlock();
        if (!isReady)
            connection_->throwIfFailed();
        return isReady;
    }

    // Combines `own` over all ranks, and returns the result. Collective. Waits for all ranks. Throws InvalidArgument as
    // requireProgress() does, and TransportError. A message that could not be read may have been a part of this
    // reduction. Then reduce() throws TransportError, too, if there is no result within a second; or within
    // peerTimeout, if the message came before this call. See waitForResult().
    Bytes reduce(Bytes own, ReductionTable::Combine combine)
    {
        requireProgress();
        struct Result {
            std::atomic<bool> there{false};
            Bytes bytes;
        };
        const auto result = std::make_shared<Result>(); // outlives this call if the transport fails
        const std::int64_t number = reductionCount_++;
        auto damage = takeDamage(); // now: with this rank's part the others go on to what comes next
        checkLeft();
        const Connection::Expecting expecting(*connection_);
        try {
            makePart([&] {
                reductions_.enter({ownScope, number}, std::move(own), std::move(combine),
                                  [this, result](const Bytes& bytes) {
                                      result->bytes = bytes;
                                      result->there = true;
                                      notify();
                                  });
            });
        } catch (const Error& e) { // an earlier message of a rank below in the tree is malformed
            giveUp(-1, e.info());
        }
        waitForResult([&] { return result->there.load(); }, number == 0, std::move(damage));
        return result->bytes;
    }

    // Calls make(), which makes or sends a part that other ranks wait for. If it lacks memory, the connection fails on
    // all ranks, and this throws std::bad_alloc.
    void makePart(FunctionRef<void()> make) { connection_->giveUpWithoutMemory(make); }

private:
    // A message that could not be read may have been a part of this reduction, if some ranks have not entered it yet,
    // or of the next, if the other ranks are through. The first reduction is the one in the constructor of the
    // mailbox's owner. `damage`: the error of a message that came before this reduction.
    void waitForResult(FunctionRef<bool()> ready, bool isFirst, std::optional<ErrorInfo> damage)
    {
        constexpr std::chrono::milliseconds soon{1000}; // when all ranks seem to be here
        const std::chrono::milliseconds late = connection_->config().peerTimeout;
        if (!isFirst && late.count() == 0)
            damage.reset(); // no limit; a message that is damaged from now on sets one
        const bool wasBefore = damage.has_value();
        std::optional<Clock::time_point> deadline;
        if (damage)
            deadline = Clock::now() + (isFirst ? soon : late);
        do { // even with the result: with Progress::Caller it is wait() that sends it on
            if (!wait([&] { return ready() || (!damage && isDamaged()); }, deadline)) {
                giveUp(damage->from, *damage);
            } else if (!damage && (damage = takeDamage())) {
                deadline = Clock::now() + soon;
            }
        } while (!ready());
        if (damage && !wasBefore)
            keepDamage(*damage);
    }

    bool isDamaged()
    {
        const std::lock_guard<std::mutex> lock(damageMutex_);
        return damage_.has_value();
    }

    // How long a thread that waits stays awake: until nothing has come for `limit`, or others need the processor.
    class SpinWait {
    public:
        explicit SpinWait(std::chrono::microseconds limit) : limit_(limit) {}

        void renew() { last_ = Clock::now(); } // something has come

        // Offers the core to others. Returns false if it is time to sleep.
        bool yield() const
        {
            constexpr std::chrono::microseconds taken{50};
            const auto now = Clock::now();
            if (now - last_ > limit_)
                return false;
            std::this_thread::yield();
            return Clock::now() - now <= taken;
        }

    private:
        const std::chrono::microseconds limit_;
        Clock::time_point last_ = Clock::now();
    };

    // For a moment a waiting thread runs tasks and moves messages itself: threads that it would wake may have to wait
    // for a core.
    void waitAwake(FunctionRef<bool()> over)
    {
        if (!connection_->hasProgressThread() || connection_->needsCaller())
            return;
        for (SpinWait spin(std::chrono::microseconds(200)); !over();) {
            if (executor_->help() || connection_->helpProgress())
                spin.renew();
            else if (!spin.yield())
                return;
        }
    }

    // Runs task(*this) on the executor. A task with at most 8 bytes of captures needs no memory from the heap: a
    // std::function holds 16, and `this` takes 8.
    template <class Task>
    void submit(Task task)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            ++tasks_;
        }
        try {
            executor_->submit([this, task = std::move(task)] {
                task(*this);
                taskDone();
            });
        } catch (...) {
            taskDone();
            throw;
        }
        if (runsTasksAtOnce())
            notify();
    }

    // Whether a thread in wait() is to run a task as soon as it comes: perhaps no worker can.
    bool runsTasksAtOnce() const noexcept { return waitingWorkers_ > 0 || !executor_->hasWorkers(); }

    void taskDone()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        --tasks_;
        if (isEnding_) // otherwise nobody waits for the end of a task itself
            changed_.notify_all();
    }

    // Whether a message makes its receiver do something for its frame. Credit does not: it only releases waiting
    // messages, which are counted themselves.
    static bool isWork(MessageKind kind, const Buffer& message)
    {
        switch (kind) {
        case MessageKind::Credit:
        case MessageKind::CreditRequest:
        case MessageKind::ImagePlace:
        case MessageKind::Leaving: return false;
        case MessageKind::ReduceUp:
        case MessageKind::ReduceDown: return !isOwnReduction(kind, message) && scopeOf(message) != quietScope;
        default: return true;
        }
    }
    // Whether a message is of reduce(), or of a reduction without a scope.
    static bool isOwnReduction(MessageKind kind, const Buffer& message)
    {
        return (kind == MessageKind::ReduceUp || kind == MessageKind::ReduceDown)
               && (message.size() < sizeof(MessageHeader) + sizeof(std::uint32_t) || scopeOf(message) == ownScope);
    }

    // Sends a message to another rank; it needs no credit, or has got it.
    void pass(int destination, Buffer&& message)
    {
        TraceSpan span(trace_, TraceEvent::Kind::Send, epoch_);
        trace(span, destination, loadAs<MessageHeader>(message.data()), message);
        const std::uint32_t sequence = connection_->send(destination, std::move(message));
        if (span.event())
            span.event()->sequence = sequence;
    }

    static void trace(TraceSpan& span, int peer, const MessageHeader& header, const Buffer& message)
    {
        TraceEvent* event = span.event();
        if (!event)
            return;
        event->message = static_cast<std::uint8_t>(header.kind);
        event->frame = isOwnReduction(header.kind, message) ? -1 : header.number;
        event->byteCount = static_cast<std::int64_t>(message.size());
        event->peer = peer;
        event->sequence = header.sequence;
    }

    // The body of a Leaving message: how many calls of reduce() its sender has begun, and how many exceptions are
    // passing there.
    struct Leaving {
        std::int64_t reductions, exceptions;
    };

    // A neighbour in the tree of reductions that has destroyed its object, and the last epoch that it had begun.
    struct Left {
        int rank;
        std::int64_t epoch;
        Leaving how;
    };

    // Gives up if this rank has begun something without a rank that has left: it would never end.
    void checkLeft()
    {
        std::vector<Left> all;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            all = left_;
        }
        for (const Left& left : all) {
            if (epoch_ <= left.epoch && reductionCount_ <= left.how.reductions)
                continue;
            const bool isInFrame = epoch_ > left.epoch, isThrown = left.how.exceptions > 0;
            const std::string text = printed(
                "%s its framebuffer, compositor or wall after frame %lld, and rank %d is in %s %lld%s",
                isThrown ? "an exception has ended" : "it has destroyed", static_cast<long long>(left.epoch), rank(),
                isInFrame ? "frame" : "collective call", static_cast<long long>(isInFrame ? epoch_ : reductionCount_),
                isThrown ? "" : ": all ranks must make the same calls");
            connection_->giveUp(errorInfo(ErrorKind::Transport, text, left.rank));
        }
    }

    void receive(int source, const MessageHeader& header, Buffer&& message) override
    {
        if (needsCredit(header.kind))
            flow_.arrived(message.size());
        enqueue(source, header, std::move(message));
    }

    // Puts a message into the inbox; a task takes it out.
    void enqueue(int source, const MessageHeader& header, Buffer&& message)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            inbox_.push({source, header, std::move(message)});
        }
        submit([](Mailbox& self) { self.dispatch(); });
    }

    void dispatch()
    {
        std::unique_lock<std::mutex> lock(mutex_);
        Arrival a = inbox_.pop();
        lock.unlock();
        TraceSpan span(trace_, TraceEvent::Kind::Receive, epoch_);
        trace(span, a.source, a.header, a.message);
        try {
            if (a.header.kind == MessageKind::Leaving) {
                const Left left{a.source, a.header.number, bodyOf<Leaving>(a.message)};
                {
                    const std::lock_guard<std::mutex> leftLock(mutex_);
                    left_.push_back(left);
                }
                checkLeft();
            } else if (isOwnReduction(a.header.kind, a.message)) {
                if (a.message.size() < sizeof a.header + sizeof(std::uint32_t))
                    failMalformed("a reduction without a scope");
                requireCanBe(a.header);
                receiveReduction(a.source, a.header, a.message);
            } else {
                handler_.incoming(a.source, a.header, std::move(a.message));
            }
        } catch (const Error& e) {
            orGiveUp([&] { giveUp(a.source, e.info()); }); // some rank waits for it
        } catch (const std::bad_alloc& e) {
            orGiveUp([&] { giveUp(a.source, errorInfo(ErrorKind::Transport, e.what())); });
        }
    }

    // Checks the number of a message of reduce(). It must be that of the last reduction that this rank has begun, or of
    // the next one if this rank has passed on the result of the last.
    void requireCanBe(const MessageHeader& header)
    {
        const std::int64_t begun = reductionCount_, number = header.number;
        const bool isLast = number >= 0 && number == begun - 1;
        const bool isNext =
            number == begun && header.kind == MessageKind::ReduceUp && !reductions_.isUnderWay({ownScope, begun - 1});
        if (!isLast && !isNext)
            failMalformed("a reduction that no rank can be at", begun, number);
    }

    void malformed(const ErrorInfo& error) override
    {
        submit([error](Mailbox& self) { self.handler_.undecodable(error); });
    }

    void connectionFailed() override { notify(); }

    std::shared_ptr<Connection> connection_;
    std::shared_ptr<Executor> executor_;
    MailboxOwner& handler_;
    TraceSink* const trace_;
    std::uint32_t address_ = 0;
    std::atomic<std::int64_t> epoch_{0};
    FlowControl flow_;
    ReductionTable reductions_;
    std::atomic<std::int64_t> bytesSent_{0}, messagesSent_{0};
    std::atomic<std::uint64_t> workSent_{0}, workTaken_{0}; // see countsAtRest()
    std::atomic<std::int64_t> reductionCount_{0};           // calls of reduce() so far
    std::mutex damageMutex_;
    std::optional<ErrorInfo> damage_; // under damageMutex_

    std::mutex mutex_;
    std::condition_variable changed_;
    std::atomic<int> waitingWorkers_{0};
    Fifo<Arrival> inbox_;
    std::vector<Left> left_;
    int tasks_ = 0; // submitted and not yet done
    bool isEnding_ = false;
};

} // namespace detail
DFB_NAMESPACE_END
