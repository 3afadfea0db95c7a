// What the messaging layer costs, compared with plain MPI: latency and bandwidth, the processor time of waiting, the
// time that a computing thread loses, and how messages move when there are more ranks than cores.
//   mpirun -n 2 bench_messaging        or -n 8; --quick; a list of parts such as 14 runs only those
// --trace FILE: of what goes with credit in part 1; the other messages are below what a trace is told of.
#include "baselines.hpp"
#include "trace.hpp"

#include <dfb/comm/mailbox.hpp>
#include <dfb/comm/mpi_transport.hpp>
#include <dfb/image_compositor.hpp>

#include <array>
#include <atomic>
#include <functional>
#include <memory>
#include <optional>

namespace {

using bench::Figure;
using bench::Signal;
using bench::Table;
using bench::Waiting;
using dfb::Buffer;
using dfb::Connection;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;

constexpr std::size_t tileBytes = 64 * 64 * 5 * sizeof(float); // colour and depth
constexpr std::array<Waiting, 3> waitings{Waiting::Blocking, Waiting::Yield, Waiting::Nap};

// A receiver that expects messages as long as it lives. To a connection it looks like an open frame.
class Endpoint final : private dfb::detail::MessageReceiver {
public:
    using OnMessage = std::function<void(int source, const MessageHeader&, Buffer&&)>;

    // It must be made, and destroyed, in the same order on all ranks. `onMessage` is called by the progress thread.
    Endpoint(Connection& connection, OnMessage onMessage) : connection_(connection), onMessage_(std::move(onMessage))
    {
        connection_.expectMessages(true);
        connection_.attach(*this, address_);
    }
    Endpoint(const Endpoint&) = delete;
    Endpoint& operator=(const Endpoint&) = delete;
    ~Endpoint()
    {
        connection_.detach(address_);
        connection_.expectMessages(false);
    }

    // With `byteCount` bytes after the header, which nobody looks at.
    void send(int destination, std::size_t byteCount, std::int64_t number = 0)
    {
        Buffer message = connection_.pool()->acquire(sizeof(MessageHeader) + byteCount);
        forward(destination, std::move(message), MessageKind::Fragment, number);
    }

    void forward(int destination, Buffer&& message, MessageKind kind = MessageKind::Fragment, std::int64_t number = 0)
    {
        MessageHeader header;
        header.kind = kind;
        header.receiver = address_;
        header.number = number;
        std::memcpy(message.data(), &header, sizeof header);
        connection_.send(destination, std::move(message));
    }

private:
    void receive(int source, const MessageHeader& header, Buffer&& message) override
    {
        onMessage_(source, header, std::move(message));
    }
    void malformed(const dfb::ErrorInfo& error) override { throw dfb::Error(error); }
    void connectionFailed() override { std::abort(); }

    Connection& connection_;
    OnMessage onMessage_;
    std::uint32_t address_ = 0;
};

struct Group {
    MPI_Comm comm;
    int rank, size;

    explicit Group(MPI_Comm c) : comm(c), rank(bench::rankIn(c)), size(bench::sizeOf(c)) {}
    int next() const { return (rank + 1) % size; }
    int previous() const { return (rank + size - 1) % size; }
};

double usSince(double start) { return 1e6 * (bench::now() - start); }

void append(std::vector<double>& to, const std::vector<double>& more) { to.insert(to.end(), more.begin(), more.end()); }

// ---- 1: latency. One way times in us; measured on rank 0.

constexpr int warmUp = 5; // round trips that do not count

std::vector<double> pingPongPlain(const Group& pair, std::size_t byteCount, int trips, Waiting waiting)
{
    std::vector<double> samples;
    std::vector<std::byte> data(byteCount);
    const int other = 1 - pair.rank;
    for (int i = 0; i < trips + warmUp; ++i) {
        const double start = bench::now();
        if (pair.rank == 0)
            bench::plainSend(data.data(), byteCount, other, 1, pair.comm, waiting);
        bench::plainReceive(data.data(), byteCount, other, 1, pair.comm, waiting);
        if (pair.rank == 1)
            bench::plainSend(data.data(), byteCount, other, 1, pair.comm, waiting);
        else if (i >= warmUp)
            samples.push_back(usSince(start) / 2);
    }
    return samples;
}

// Each message is answered where it comes in, as tasks of a frame are started there.
std::vector<double> pingPongInReceive(const Group& pair, Connection& connection, std::size_t byteCount, int trips)
{
    std::vector<double> samples;
    Signal done;
    const Connection::Hurry hurry(connection); // as in Frame::end()
    double start = 0;
    int got = 0;
    std::optional<Endpoint> endpoint;
    bench::meet(pair.comm);
    endpoint.emplace(connection, [&](int source, const MessageHeader&, Buffer&& message) {
        if (pair.rank == 0 && got >= warmUp)
            samples.push_back(usSince(start) / 2);
        start = bench::now();
        const bool last = ++got == trips + warmUp;
        if (pair.rank == 1 || !last)
            endpoint->forward(source, std::move(message));
        if (last)
            done.set();
    });
    bench::meet(pair.comm);
    if (pair.rank == 0) {
        start = bench::now();
        endpoint->send(1, byteCount);
    }
    done.wait();
    bench::meet(pair.comm);
    return samples;
}

// Each message is answered by a thread that waits for it.
std::vector<double> pingPongInThread(const Group& pair, Connection& connection, std::size_t byteCount, int trips)
{
    std::vector<double> samples;
    Signal arrived;
    const Connection::Hurry hurry(connection); // as in Frame::end()
    Buffer ball;
    Endpoint endpoint(connection, [&](int, const MessageHeader&, Buffer&& message) {
        ball = std::move(message);
        arrived.set();
    });
    bench::meet(pair.comm);
    for (int i = 0; i < trips + warmUp; ++i) {
        const double start = bench::now();
        if (pair.rank == 0 && i == 0)
            endpoint.send(1, byteCount);
        else if (pair.rank == 0)
            endpoint.forward(1, std::move(ball));
        arrived.wait();
        if (pair.rank == 1)
            endpoint.forward(0, std::move(ball));
        else if (i >= warmUp)
            samples.push_back(usSince(start) / 2);
    }
    bench::meet(pair.comm);
    return samples;
}

// ---- 1: bandwidth, in MB/s of payload, from rank 0 to rank 1 until rank 0 knows that all has come

struct Stream {
    std::size_t byteCount;
    int total, window; // messages

    explicit Stream(std::size_t size)
        : byteCount(size), total(static_cast<int>(std::clamp<std::size_t>((std::size_t{128} << 20) / size, 16, 16384))),
          window(static_cast<int>(std::clamp<std::size_t>((std::size_t{64} << 20) / size, 4, 16)))
    {
    }
    double rateSince(double start) const
    {
        return 1e-6 * static_cast<double>(byteCount) * total / (bench::now() - start);
    }
};

std::vector<double> streamPlain(const Group& pair, const Stream& stream, Waiting waiting)
{
    const auto window = static_cast<std::size_t>(stream.window);
    std::vector<std::byte> data(window * stream.byteCount);
    std::vector<MPI_Request> requests(window, MPI_REQUEST_NULL);
    int started = 0, finished = 0;
    const auto startOne = [&](std::size_t slot) {
        if (started == stream.total)
            return;
        ++started;
        std::byte* place = data.data() + slot * stream.byteCount;
        const auto count = static_cast<int>(stream.byteCount);
        if (pair.rank == 0)
            MPI_Isend(place, count, MPI_BYTE, 1, 2, pair.comm, &requests[slot]);
        else
            MPI_Irecv(place, count, MPI_BYTE, 0, 2, pair.comm, &requests[slot]);
    };
    bench::meet(pair.comm);
    const double start = bench::now();
    for (std::size_t slot = 0; slot < window; ++slot)
        startOne(slot);
    while (finished < stream.total)
        for (const int slot : bench::someOf(requests, waiting)) {
            ++finished;
            startOne(static_cast<std::size_t>(slot));
        }
    std::byte last{};
    if (pair.rank == 0)
        bench::plainReceive(&last, 1, 1, 3, pair.comm, waiting);
    else
        bench::plainSend(&last, 1, 0, 3, pair.comm, waiting);
    return {stream.rateSince(start)};
}

// Rank 1 answers every fourth part of the window.
std::vector<double> streamConnection(const Group& pair, Connection& connection, const Stream& stream)
{
    Signal done;
    const Connection::Hurry hurry(connection); // as in Frame::end()
    int sent = 0, got = 0;
    std::optional<Endpoint> endpoint;
    const auto sendUpTo = [&](int count) {
        for (; sent < std::min(count, stream.total); ++sent)
            endpoint->send(1, stream.byteCount);
    };
    bench::meet(pair.comm);
    endpoint.emplace(connection, [&](int, const MessageHeader& header, Buffer&&) {
        if (pair.rank == 0) {
            const auto known = static_cast<int>(header.number);
            sendUpTo(known + stream.window);
            if (known == stream.total)
                done.set();
        } else {
            ++got;
            if (got % (stream.window / 4) == 0 || got == stream.total)
                endpoint->send(0, 0, got);
            if (got == stream.total)
                done.set();
        }
    });
    bench::meet(pair.comm);
    const double start = bench::now();
    if (pair.rank == 0) {
        // The first answer may come meanwhile, to the thread that then sends what follows.
        sent = stream.window;
        for (int i = 0; i < stream.window; ++i)
            endpoint->send(1, stream.byteCount);
    }
    done.wait();
    const double rate = stream.rateSince(start);
    bench::meet(pair.comm);
    return {rate};
}

// The layer that counts credit and has an inbox, as a frame uses it.
class CreditEnd final : private dfb::detail::MailboxOwner {
public:
    CreditEnd(const std::shared_ptr<Connection>& connection, const std::shared_ptr<dfb::Executor>& executor,
              const Stream& stream, dfb::TraceSink* trace)
        : stream_(stream), connection_(connection),
          mailbox_(connection, executor,
                   std::max(std::size_t{64} << 20, 4 * (stream.byteCount + sizeof(MessageHeader))), *this, trace)
    {
        connection_->expectMessages(true);
        mailbox_.start();
        mailbox_.newEpoch(1);
    }
    CreditEnd(const CreditEnd&) = delete;
    CreditEnd& operator=(const CreditEnd&) = delete;
    ~CreditEnd() { connection_->expectMessages(false); }

    void sendAll()
    {
        for (int i = 0; i < stream_.total; ++i) {
            MessageHeader header;
            header.receiver = mailbox_.address();
            header.number = 1;
            Buffer message = connection_->pool()->acquire(sizeof header + stream_.byteCount);
            std::memcpy(message.data(), &header, sizeof header);
            mailbox_.send(1, std::move(message));
            mailbox_.waitForRoom([] { return false; }, std::chrono::milliseconds(0));
        }
    }
    void wait() { done_.wait(); }

private:
    void incoming(int source, const MessageHeader& header, Buffer&& message) override
    {
        switch (header.kind) {
        case MessageKind::Fragment:
            mailbox_.flow().consumed(source, message.size());
            if (++got_ == stream_.total) {
                mailbox_.send(source, MessageKind::TilesDone, 1);
                done_.set();
            }
            break;
        case MessageKind::CreditRequest:
            mailbox_.flow().requested(
                source, dfb::detail::loadAs<dfb::detail::FlowControl::Request>(message.data() + sizeof header));
            break;
        case MessageKind::Credit:
            mailbox_.flow().credited(
                source, dfb::detail::loadAs<dfb::detail::FlowControl::Credit>(message.data() + sizeof header));
            break;
        default: done_.set();
        }
    }
    void undecodable(const dfb::ErrorInfo& error) override { throw dfb::Error(error); }

    Stream stream_;
    std::shared_ptr<Connection> connection_;
    Signal done_;
    std::atomic<int> got_{0};
    dfb::detail::Mailbox mailbox_; // last: its tasks use the others
};

std::vector<double> streamCredit(const Group& pair, const std::shared_ptr<Connection>& connection,
                                 const std::shared_ptr<dfb::Executor>& executor, const Stream& stream,
                                 dfb::TraceSink* trace)
{
    CreditEnd end(connection, executor, stream, trace);
    const Connection::Hurry hurry(*connection); // as in Frame::end()
    bench::meet(pair.comm);
    const double start = bench::now();
    if (pair.rank == 0)
        end.sendAll();
    end.wait();
    const double rate = stream.rateSince(start);
    bench::meet(pair.comm);
    return {rate};
}

void latencyAndBandwidth(const Group& pair, bool quick, const bench::Trace& trace)
{
    const auto connection = dfb::connect<dfb::MpiTransport>(pair.comm);
    const auto executor = std::make_shared<dfb::ThreadExecutor>(1);
    Table latency(
        {"payload", nameOf(waitings[0]), nameOf(waitings[1]), nameOf(waitings[2]), "dfb", "dfb, to a thread"});
    Table rates({"payload", nameOf(waitings[0]), nameOf(waitings[1]), nameOf(waitings[2]), "dfb", "dfb with credit"});
    for (std::size_t byteCount = 8; byteCount <= std::size_t{16} << 20; byteCount = byteCount == 8    ? 64
                                                                                    : byteCount == 64 ? 1024
                                                                                                      : byteCount * 4) {
        const int trips = byteCount <= 65536 ? 200 : byteCount <= 1 << 20 ? 40 : 8;
        const Stream stream(byteCount);
        std::array<std::vector<double>, 5> times, speeds;
        for (int repeat = 0; repeat < (quick ? 1 : 7); ++repeat) {
            for (std::size_t w = 0; w < waitings.size(); ++w) {
                bench::meet(pair.comm);
                append(times[w], pingPongPlain(pair, byteCount, trips, waitings[w]));
                append(speeds[w], streamPlain(pair, stream, waitings[w]));
            }
            append(times[3], pingPongInReceive(pair, *connection, byteCount, trips));
            append(times[4], pingPongInThread(pair, *connection, byteCount, trips));
            append(speeds[3], streamConnection(pair, *connection, stream));
            append(speeds[4], streamCredit(pair, connection, executor, stream, trace.sink.get()));
        }
        std::vector<std::string> timeRow{bench::byteText(byteCount)}, speedRow = timeRow;
        for (std::size_t i = 0; i < times.size(); ++i) {
            timeRow.push_back(bench::text(bench::figureOf(times[i])));
            speedRow.push_back(bench::text(bench::figureOf(speeds[i])));
        }
        latency.add(timeRow);
        rates.add(speedRow);
    }
    if (pair.rank == 0) {
        latency.print("1a. Latency, ranks 0 and 1, one way [us]");
        rates.print("1b. Bandwidth, rank 0 to rank 1, up to 16 messages or 64 MiB under way [MB/s]");
    }
    if (trace.sink) { // which is written through something that makes pictures
        dfb::FrameBufferConfig config(64, 64);
        config.trace = trace.sink;
        dfb::ImageCompositor compositor(connection, dfb::ImageBlend::Nearest, config);
        trace.write(compositor);
    }
}

// ---- what a process does besides a thread that does something else, for parts 2 and 3

// A thread in plain MPI that waits for a message, until the rank before this one is done as well.
class PlainWaiter {
public:
    PlainWaiter(const Group& all, Waiting waiting)
        : all_(all),
          thread_([this, waiting] { bench::plainReceive(&byte_, 1, all_.previous(), 4, all_.comm, waiting); })
    {
    }
    PlainWaiter(const PlainWaiter&) = delete;
    PlainWaiter& operator=(const PlainWaiter&) = delete;
    ~PlainWaiter()
    {
        const std::byte release{};
        MPI_Request request = MPI_REQUEST_NULL;
        MPI_Isend(&release, 1, MPI_BYTE, all_.next(), 4, all_.comm, &request);
        bench::napThrough(request);
        thread_.join();
    }

private:
    Group all_;
    std::byte byte_{};
    std::thread thread_;
};

enum class Beside { Nothing, Idle, Open, Traffic, PlainNap, PlainBlocking };
constexpr std::array<Beside, 6> allBeside{Beside::Nothing, Beside::Idle,     Beside::Open,
                                          Beside::Traffic, Beside::PlainNap, Beside::PlainBlocking};

const char* nameOf(Beside beside)
{
    switch (beside) {
    case Beside::Nothing: return "nothing";
    case Beside::Idle: return "dfb, nothing expected";
    case Beside::Open: return "dfb, a frame open";
    case Beside::Traffic: return "dfb, an 80 KiB tile out and in every ms";
    case Beside::PlainNap: return "MPI_Irecv, MPI_Test + naps";
    default: return "MPI_Recv";
    }
}

// `work(endpoint)` with that beside it; the endpoint, or null, is for those that have traffic.
template <class Work>
void runBeside(const Group& all, Beside beside, const Work& work)
{
    std::shared_ptr<Connection> connection;
    std::optional<Endpoint> endpoint;
    std::optional<PlainWaiter> waiter;
    if (beside == Beside::Idle || beside == Beside::Open || beside == Beside::Traffic)
        connection = dfb::connect(all.comm);
    if (beside == Beside::Open || beside == Beside::Traffic)
        endpoint.emplace(*connection, [](int, const MessageHeader&, Buffer&&) {});
    bench::meet(all.comm);
    if (beside == Beside::PlainNap || beside == Beside::PlainBlocking)
        waiter.emplace(all, beside == Beside::PlainNap ? Waiting::Nap : Waiting::Blocking);
    std::this_thread::sleep_for(std::chrono::milliseconds(20)); // the others too are out of meet()
    work(beside == Beside::Traffic ? &*endpoint : nullptr);
}

// ---- 2: processor time while all sleep

void idle(const Group& all, bool quick)
{
    Table table({"in each process", "CPU of a rank [% of a core]", "all ranks [cores]", "sleeps of a rank [1/s]"});
    for (const Beside beside : allBeside) {
        if (beside == Beside::Traffic)
            continue;
        std::vector<double> shares, sums, rates;
        for (int repeat = 0; repeat < (quick ? 1 : 3); ++repeat) {
            double share = 0, rate = 0;
            runBeside(all, beside, [&](Endpoint*) {
                const double start = bench::now(), cpu = bench::processCpuSeconds(), slept = bench::sleeps();
                std::this_thread::sleep_for(std::chrono::milliseconds(1500));
                const double seconds = bench::now() - start;
                share = 100 * (bench::processCpuSeconds() - cpu) / seconds;
                rate = (bench::sleeps() - slept) / seconds;
            });
            append(shares, bench::collect(all.comm, {share}));
            append(rates, bench::collect(all.comm, {rate}));
            sums.push_back(bench::reduce(all.comm, share, MPI_SUM) / 100);
        }
        table.add({nameOf(beside), bench::text(bench::figureOf(shares)), bench::text(bench::figureOf(sums)),
                   bench::text(bench::figureOf(rates))});
    }
    if (all.rank == 0)
        table.print("2. CPU time while all threads of the program sleep for 1.5 s");
}

// ---- 3: what a thread that computes loses

// Multiplies and adds in the first-level cache for about 10 us.
class Kernel {
public:
    void run()
    {
        for (int round = 0; round < 8; ++round)
            for (float& value : data_)
                value = value * 0.999f + 0.001f;
        ++count_;
    }
    double count() const { return count_; }
    float sum() const
    {
        float sum = 0;
        for (const float value : data_)
            sum += value;
        return sum;
    }

private:
    std::array<float, 4096> data_{};
    double count_ = 0;
};

void neighbour(const Group& all, bool quick)
{
    const double sliceSeconds = 0.15;
    std::array<std::vector<double>, allBeside.size()> left, other;
    volatile float keep = 0; // so that the kernel is not left out
    for (int repeat = 0; repeat < (quick ? 5 : 25); ++repeat) {
        double alone = 0;
        for (std::size_t b = 0; b < allBeside.size(); ++b) {
            double speed = 0, cpuOfOthers = 0;
            runBeside(all, allBeside[b], [&](Endpoint* endpoint) {
                Kernel kernel;
                const double start = bench::now();
                const double cpu = bench::processCpuSeconds() - bench::threadCpuSeconds();
                double time = start;
                for (double nextTile = start; time < start + sliceSeconds; time = bench::now()) {
                    kernel.run();
                    if (endpoint && time >= nextTile) {
                        endpoint->send(all.next(), tileBytes);
                        nextTile = std::max(nextTile + 1e-3, time);
                    }
                }
                cpuOfOthers =
                    std::max(0.0, bench::processCpuSeconds() - bench::threadCpuSeconds() - cpu) / (time - start);
                speed = kernel.count() / (time - start);
                keep = kernel.sum();
            });
            const double together = bench::reduce(all.comm, speed, MPI_SUM);
            if (allBeside[b] == Beside::Nothing)
                alone = together;
            left[b].push_back(100 * together / alone);
            append(other[b], bench::collect(all.comm, {100 * cpuOfOthers}));
        }
    }
    Table table({"beside the thread", "speed of all ranks [%]", "CPU of the other threads of a rank [% of a core]"});
    for (std::size_t b = 0; b < allBeside.size(); ++b)
        table.add(
            {nameOf(allBeside[b]), bench::text(bench::figureOf(left[b])), bench::text(bench::figureOf(other[b]))});
    if (all.rank == 0)
        table.print(
            "3. A thread that computes, one per rank: its speed, compared with that just before beside nothing");
}

// ---- 4: hops

// A message goes round all ranks until `seconds` have passed or it has made `mostRounds` rounds; a sample per round,
// on rank 0, in us per hop. Its first byte says that it is the last.
constexpr int mostRounds = 400, leastRounds = 5;
struct Ring {
    double stop = 0, start = 0;
    int rounds = 0;
    std::vector<double> samples;

    // On rank 0, when it has come round (or begins). True if the next round is the last.
    bool turn(int size, double seconds)
    {
        const double time = bench::now();
        if (rounds == 0)
            stop = time + seconds;
        else
            samples.push_back(1e6 * (time - start) / size);
        start = time;
        ++rounds;
        return rounds >= leastRounds && (time >= stop || rounds >= mostRounds);
    }
};

std::vector<double> ringPlain(const Group& all, std::size_t byteCount, double seconds, Waiting waiting)
{
    std::vector<std::byte> data(byteCount);
    Ring ring;
    for (bool last = false; !last;) {
        if (all.rank == 0) {
            last = ring.turn(all.size, seconds);
            data[0] = std::byte(last);
            bench::plainSend(data.data(), byteCount, all.next(), 5, all.comm, waiting);
        }
        bench::plainReceive(data.data(), byteCount, all.previous(), 5, all.comm, waiting);
        last = data[0] != std::byte(0);
        if (all.rank != 0)
            bench::plainSend(data.data(), byteCount, all.next(), 5, all.comm, waiting);
    }
    if (all.rank == 0)
        ring.turn(all.size, seconds);
    return ring.samples;
}

std::vector<double> ringConnection(const Group& all, Connection& connection, std::size_t byteCount, double seconds)
{
    Ring ring;
    Signal done;
    const Connection::Hurry hurry(connection); // as in Frame::end()
    std::optional<Endpoint> endpoint;
    bench::meet(all.comm);
    endpoint.emplace(connection, [&](int, const MessageHeader& header, Buffer&& message) {
        bool last = header.number != 0;
        const bool arrived = all.rank == 0 && last;
        if (all.rank == 0)
            last = ring.turn(all.size, seconds);
        if (!arrived)
            endpoint->forward(all.next(), std::move(message), MessageKind::Fragment, last ? 1 : 0);
        if (arrived || (all.rank != 0 && last))
            done.set();
    });
    bench::meet(all.comm);
    if (all.rank == 0) {
        ring.turn(all.size, seconds);
        endpoint->send(all.next(), byteCount);
    }
    done.wait();
    bench::meet(all.comm);
    return ring.samples;
}

// Each rank sends a message to each other one and gets it back; when it has all back it begins again. Half the time
// from the sending of a message to its return is a sample, in us, on all ranks.
std::vector<double> exchangeBlocking(const Group& all, std::size_t byteCount, int rounds)
{
    std::vector<double> samples;
    std::vector<std::byte> out(byteCount), in(byteCount);
    const auto count = static_cast<int>(byteCount);
    for (int round = 0; round < rounds; ++round)
        for (int k = 1; k < all.size; ++k) {
            const int to = (all.rank + k) % all.size, from = (all.rank + all.size - k) % all.size;
            const double start = bench::now();
            MPI_Sendrecv(out.data(), count, MPI_BYTE, to, 6, in.data(), count, MPI_BYTE, from, 6, all.comm,
                         MPI_STATUS_IGNORE);
            MPI_Sendrecv(in.data(), count, MPI_BYTE, from, 7, out.data(), count, MPI_BYTE, to, 7, all.comm,
                         MPI_STATUS_IGNORE);
            samples.push_back(usSince(start) / 2);
        }
    return samples;
}

std::vector<double> exchangePlain(const Group& all, std::size_t byteCount, int rounds, Waiting waiting)
{
    if (waiting == Waiting::Blocking)
        return exchangeBlocking(all, byteCount, rounds);
    enum Kind : std::size_t { Out, Back, In, Return, kinds }; // mine goes out and comes back; another comes in, returns
    const auto size = static_cast<std::size_t>(all.size);
    const auto count = static_cast<int>(byteCount);
    std::vector<std::byte> data(size * kinds * byteCount);
    std::vector<MPI_Request> requests(size * kinds, MPI_REQUEST_NULL);
    std::vector<double> samples, starts(size);
    std::vector<int> toCome(size, rounds);
    const auto begin = [&](std::size_t peer, Kind kind) {
        const std::size_t slot = peer * kinds + kind;
        // What returns is what came in.
        std::byte* place = data.data() + (kind == Return ? slot - 1 : slot) * byteCount;
        const int tag = kind == Out || kind == In ? 6 : 7, other = static_cast<int>(peer);
        if (kind == Out || kind == Return)
            MPI_Isend(place, count, MPI_BYTE, other, tag, all.comm, &requests[slot]);
        else
            MPI_Irecv(place, count, MPI_BYTE, other, tag, all.comm, &requests[slot]);
    };
    int left = 4 * rounds * (all.size - 1), outstanding = 0, roundsLeft = rounds;
    const auto beginRound = [&] {
        for (std::size_t k = 1; k < size; ++k) {
            const std::size_t peer = (static_cast<std::size_t>(all.rank) + k) % size;
            starts[peer] = bench::now();
            begin(peer, Back);
            begin(peer, Out);
        }
        outstanding = 2 * (all.size - 1);
        --roundsLeft;
    };
    for (std::size_t peer = 0; peer < size; ++peer)
        if (static_cast<int>(peer) != all.rank)
            begin(peer, In);
    beginRound();
    while (left > 0)
        for (const int index : bench::someOf(requests, waiting)) {
            const std::size_t peer = static_cast<std::size_t>(index) / kinds;
            const auto kind = static_cast<Kind>(static_cast<std::size_t>(index) % kinds);
            --left;
            if (kind == In)
                begin(peer, Return);
            else if (kind == Return && --toCome[peer] > 0)
                begin(peer, In);
            if (kind == Back)
                samples.push_back(usSince(starts[peer]) / 2);
            if ((kind == Back || kind == Out) && --outstanding == 0 && roundsLeft > 0)
                beginRound();
        }
    return samples;
}

std::vector<double> exchangeConnection(const Group& all, Connection& connection, std::size_t byteCount, int rounds)
{
    std::vector<double> samples, starts(static_cast<std::size_t>(all.size));
    Signal done;
    const Connection::Hurry hurry(connection); // as in Frame::end()
    int outstanding = 0, roundsLeft = rounds;
    std::optional<Endpoint> endpoint;
    const auto beginRound = [&] {
        outstanding = all.size - 1;
        --roundsLeft;
        for (int k = 1; k < all.size; ++k) {
            const int to = (all.rank + k) % all.size;
            starts[static_cast<std::size_t>(to)] = bench::now();
            endpoint->send(to, byteCount);
        }
    };
    // Only the progress thread may be in here, so it begins the first round as well, told by a message that is no tile.
    bench::meet(all.comm);
    endpoint.emplace(connection, [&](int source, const MessageHeader& header, Buffer&& message) {
        if (header.kind == MessageKind::Fragment) {
            endpoint->forward(source, std::move(message), MessageKind::FinishedTiles);
            return;
        }
        if (header.kind == MessageKind::FinishedTiles) {
            samples.push_back(usSince(starts[static_cast<std::size_t>(source)]) / 2);
            --outstanding;
        }
        if (outstanding == 0 && roundsLeft > 0)
            beginRound();
        else if (outstanding == 0)
            done.set();
    });
    bench::meet(all.comm);
    endpoint->forward(all.next(), connection.pool()->acquire(sizeof(MessageHeader)), MessageKind::TilesDone);
    done.wait();
    bench::meet(all.comm); // the others may still need answers
    return samples;
}

// `communicate()`, if so wanted with a thread that computes beside it.
template <class Communicate>
std::vector<double> besideCompute(bool compute, const Communicate& communicate)
{
    std::atomic<bool> over{false};
    volatile float keep = 0;
    std::thread computing;
    if (compute)
        computing = std::thread([&] {
            Kernel kernel;
            while (!over)
                kernel.run();
            keep = kernel.sum();
        });
    std::vector<double> samples = communicate();
    over = true;
    if (compute)
        computing.join();
    return samples;
}

void hops(const Group& all, bool quick)
{
    const auto connection = dfb::connect(all.comm);
    const double seconds = quick ? 0.3 : 1.5;
    Table table({"pattern", "payload", nameOf(waitings[0]), nameOf(waitings[1]), nameOf(waitings[2]), "dfb"});
    enum class Pattern { Ring, RingBesideCompute, Exchange };
    for (const Pattern pattern : {Pattern::Ring, Pattern::RingBesideCompute, Pattern::Exchange})
        for (const std::size_t byteCount : {std::size_t{4096}, tileBytes}) {
            std::array<std::vector<double>, 4> samples;
            for (int repeat = 0; repeat < (quick ? 1 : 3); ++repeat)
                for (std::size_t v = 0; v < samples.size(); ++v) {
                    const bool plain = v < waitings.size();
                    const int rounds = v == 0 && all.size > 2 ? 4 : 40;
                    bench::meet(all.comm);
                    append(samples[v],
                           bench::collect(all.comm, besideCompute(pattern == Pattern::RingBesideCompute, [&] {
                                              if (pattern == Pattern::Exchange)
                                                  return plain
                                                             ? exchangePlain(all, byteCount, rounds, waitings[v])
                                                             : exchangeConnection(all, *connection, byteCount, rounds);
                                              return plain ? ringPlain(all, byteCount, seconds, waitings[v])
                                                           : ringConnection(all, *connection, byteCount, seconds);
                                          })));
                }
            std::vector<std::string> row{pattern == Pattern::Ring       ? "ring"
                                         : pattern == Pattern::Exchange ? "all with all"
                                                                        : "ring, a thread computes on each rank",
                                         bench::byteText(byteCount)};
            for (const auto& s : samples)
                row.push_back(bench::text(bench::figureOf(s)));
            table.add(row);
        }
    if (all.rank == 0)
        table.print("4. A hop from rank to rank: of a message that goes round, and half of there and back [us]");
}

} // namespace

int main(int argc, char** argv)
{
    const bench::Arguments arguments(
        argc, argv,
        "usage: mpirun -n RANKS bench_messaging [--quick] [--trace FILE] [PARTS]   2 ranks at least\n"
        "  --quick  fewer repetitions\n"
        "  PARTS    1: latency and bandwidth, 2: processor time of waiting, 3: time that a computing thread loses,\n"
        "           4: more ranks than cores; 14: the first and the last (default: all)");
    bench::withMpi(argc, argv, [&](MPI_Comm comm) {
        const Group all(comm);
        if (all.size < 2) {
            std::printf("at least 2 ranks are needed\n");
            MPI_Abort(MPI_COMM_WORLD, 2);
        }
        if (all.rank == 0)
            std::printf("bench_messaging: %s. Medians ± median absolute deviations.\n",
                        bench::environment(all.comm).c_str());
        if (arguments.wants('1')) {
            if (all.rank < 2) {
                MPI_Group everybody = MPI_GROUP_NULL, firstTwo = MPI_GROUP_NULL;
                const std::array<int, 2> members{0, 1};
                MPI_Comm_group(all.comm, &everybody);
                MPI_Group_incl(everybody, 2, members.data(), &firstTwo);
                MPI_Comm pair = MPI_COMM_NULL;
                MPI_Comm_create_group(all.comm, firstTwo, 0, &pair);
                latencyAndBandwidth(Group(pair), arguments.quick, bench::Trace(arguments.trace));
                MPI_Comm_free(&pair);
                MPI_Group_free(&firstTwo);
                MPI_Group_free(&everybody);
            }
            bench::meet(all.comm);
        }
        if (arguments.wants('2'))
            idle(all, arguments.quick);
        if (arguments.wants('3'))
            neighbour(all, arguments.quick);
        if (arguments.wants('4'))
            hops(all, arguments.quick);
        bench::meet(all.comm);
    });
}
