// Messaging: the asynchronous messaging layer (section 3.2 of the paper): an inbox that is emptied by tasks,
// progress of the transport, reductions, and waiting without spinning.
#pragma once

#include <dfb/comm/message.hpp>
#include <dfb/comm/progress.hpp>
#include <dfb/comm/reduction.hpp>
#include <dfb/comm/transport.hpp>
#include <dfb/exec.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <exception>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

namespace dfb::detail {

// What receives the messages; it knows what they mean.
class MessageReceiver {
public:
    // In a task; several at once, in any order. Reductions come here too, to be let through with receiveReduction();
    // but for those of reduce().
    virtual void incoming(int source, const MessageHeader& header, Buffer&& message) = 0;
    virtual void malformed(int source, const std::exception_ptr& error) = 0;

protected:
    ~MessageReceiver() = default;
};

template <class Transport>
class Messaging final : private TransportHandler {
public:
    using Bytes = ReductionTable::Bytes;
    static constexpr std::uint32_t ownScope = 0; // of reduce(); the receiver uses others

    Messaging(const typename Transport::Communicator& communicator, std::shared_ptr<MemoryPool> pool, Progress mode,
              std::shared_ptr<Executor> executor, std::uint32_t id, MessageReceiver& receiver)
        : pool_(pool), transport_(communicator, std::move(pool), mode), mode_(mode), executor_(std::move(executor)),
          id_(id), receiver_(receiver), reductions_(transport_.rank(), transport_.size(),
                                                    [this](int to, const ReductionKey& key, bool up,
                                                           const Bytes& bytes) { sendReduction(to, key, up, bytes); })
    {
    }

    // From here on the receiver is called.
    void start()
    {
        transport_.start(*this);
        if (transport_.needsPolling() && mode_ == Progress::Thread)
            progress_.start();
    }

    // Collective where the transport's stop() is.
    ~Messaging()
    {
        progress_.stop();
        transport_.stop(!failed_);
        std::unique_lock<std::mutex> lock(mutex_);
        changed_.wait(lock, [this] { return tasks_ == 0; });
    }

    int rank() const noexcept { return transport_.rank(); }
    int size() const noexcept { return transport_.size(); }
    bool failed() const noexcept { return failed_; }
    Executor& executor() const noexcept { return *executor_; }

    // From any thread; to this rank as well.
    void send(int destination, Buffer&& message)
    {
        if (destination == rank()) {
            receive(destination, std::move(message));
            return;
        }
        bytesSent_ += static_cast<std::int64_t>(message.size());
        ++messagesSent_;
        transport_.send(destination, std::move(message));
    }

    void send(int destination, MessageKind kind, std::int64_t number, const Bytes& body = {})
    {
        MessageHeader header;
        header.kind = kind;
        header.framebuffer = id_;
        header.number = number;
        send(destination, makeMessage(*pool_, header, body.data(), body.size()));
    }

    // Message bytes and messages to other ranks since the start.
    std::int64_t bytesSent() const noexcept { return bytesSent_; }
    std::int64_t messagesSent() const noexcept { return messagesSent_; }

    // Runs `task` on the executor; the destructor waits for it. It must not throw.
    template <class Task>
    void submit(Task task)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            ++tasks_;
        }
        executor_->submit([this, task = std::move(task)] {
            task();
            const std::lock_guard<std::mutex> lock(mutex_);
            --tasks_;
            changed_.notify_all();
        });
    }

    ReductionTable& reductions() noexcept { return reductions_; }

    // What a ReduceUp or ReduceDown message belongs to, and what it brings.
    static ReductionKey keyOf(const MessageHeader& header, const Buffer& message)
    {
        return {loadAs<std::uint32_t>(message.data() + sizeof header), header.number};
    }
    static Bytes bytesOf(const Buffer& message)
    {
        return Bytes(message.data() + sizeof(MessageHeader) + sizeof(std::uint32_t), message.data() + message.size());
    }

    void receiveReduction(int source, const MessageHeader& header, const Buffer& message)
    {
        reductions_.receive(source, keyOf(header, message), header.kind == MessageKind::ReduceUp, bytesOf(message));
    }

    // Between ranks that may have messages for each other: as long as this is so, they are looked for.
    void expectMessages(bool expect) { progress_.expectMessages(expect); }

    // Wakes those in wait(), to ask again.
    void notify()
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            changed_.notify_all();
        }
        if (!progress_.running())
            transport_.interrupt();
    }

    // Waits until `ready()`, which must not lock what is held while calling notify(); makes progress if that is the
    // caller's business. Throws TransportError.
    template <class Ready>
    void wait(const Ready& ready)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        const auto over = [&] { return failed_ || ready(); };
        if (progress_.running() || !transport_.needsPolling()) {
            changed_.wait(lock, over);
        } else {
            // Also when all is over what was just queued must leave, such as a result for ranks below in the tree.
            while (!over() || (!failed_ && !transport_.quiet())) {
                lock.unlock();
                const bool moved = transport_.poll();
                lock.lock();
                if (!moved && !over()) {
                    lock.unlock();
                    transport_.nap(std::chrono::microseconds(50));
                    lock.lock();
                }
            }
        }
        lock.unlock();
        throwIfFailed();
    }

    // Collective: combines `own` over all ranks and waits for the result.
    Bytes reduce(Bytes own, ReductionTable::Combine combine)
    {
        struct Result {
            std::atomic<bool> there{false};
            Bytes bytes;
        };
        const auto result = std::make_shared<Result>(); // outlives this call if the transport fails
        expectMessages(true);
        reductions_.enter({ownScope, reductionCount_++}, std::move(own), std::move(combine),
                          [this, result](const Bytes& bytes) {
                              result->bytes = bytes;
                              result->there = true;
                              notify();
                          });
        wait([&] { return result->there.load(); });
        expectMessages(false);
        return result->bytes;
    }

    // Collective: combines `values` element by element. Throws InvalidArgument on all ranks if their numbers differ.
    template <class Operation>
    std::vector<std::int64_t> allReduce(const std::vector<std::int64_t>& values, Operation operation)
    {
        const auto* first = reinterpret_cast<const std::byte*>(values.data());
        const Bytes result = reduce(
            Bytes(first, first + values.size() * sizeof(std::int64_t)),
            [operation](const Bytes& a, const Bytes& b) { return ReductionTable::combineElements(a, b, operation); });
        if (result.size() != values.size() * sizeof(std::int64_t))
            throw InvalidArgument("allReduce() was called with different numbers of values on different ranks");
        std::vector<std::int64_t> reduced(values.size());
        std::copy(result.begin(), result.end(), reinterpret_cast<std::byte*>(reduced.data()));
        return reduced;
    }

    void throwIfFailed()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (failed_)
            throw TransportError(*failure_);
    }

private:
    void sendReduction(int destination, const ReductionKey& key, bool up, const Bytes& bytes)
    {
        Bytes body(sizeof key.scope + bytes.size());
        std::memcpy(body.data(), &key.scope, sizeof key.scope);
        std::copy(bytes.begin(), bytes.end(), body.begin() + sizeof key.scope);
        send(destination, up ? MessageKind::ReduceUp : MessageKind::ReduceDown, key.number, body);
    }

    // A message only goes into the inbox here; a task takes it out.
    void receive(int source, Buffer&& message) override
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            inbox_.emplace_back(source, std::move(message));
        }
        submit([this] {
            std::pair<int, Buffer> next;
            {
                const std::lock_guard<std::mutex> lock(mutex_);
                next = std::move(inbox_.front());
                inbox_.pop_front();
            }
            dispatch(next.first, std::move(next.second));
        });
    }

    void dispatch(int source, Buffer&& message)
    {
        MessageHeader header;
        try {
            header = readMessageHeader(message, id_);
            if (header.kind == MessageKind::ReduceUp || header.kind == MessageKind::ReduceDown) {
                if (message.size() < sizeof header + sizeof(std::uint32_t))
                    failMalformed("a reduction without a scope");
                const std::byte* body = std::as_const(message).data() + sizeof header;
                if (loadAs<std::uint32_t>(body) == ownScope) {
                    receiveReduction(source, header, message);
                    return;
                }
            }
        } catch (...) {
            receiver_.malformed(source, std::current_exception());
            return;
        }
        receiver_.incoming(source, header, std::move(message));
    }

    void fail(const ErrorInfo& error) override
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (failed_)
            return;
        failure_ = error;
        failed_ = true;
        changed_.notify_all();
    }

    std::shared_ptr<MemoryPool> pool_;
    Transport transport_;
    Progress mode_;
    std::shared_ptr<Executor> executor_;
    std::uint32_t id_;
    MessageReceiver& receiver_;
    ReductionTable reductions_;
    std::atomic<std::int64_t> bytesSent_{0}, messagesSent_{0};
    std::int64_t reductionCount_ = 0; // of reduce()

    std::mutex mutex_;
    std::condition_variable changed_;
    std::deque<std::pair<int, Buffer>> inbox_;
    int tasks_ = 0; // submitted and not yet done
    std::optional<ErrorInfo> failure_;
    std::atomic<bool> failed_{false};

    ProgressThread<Transport> progress_{transport_};
};

} // namespace dfb::detail
