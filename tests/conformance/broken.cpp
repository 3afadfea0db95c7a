// The conformance suite must find faults: transports that break the contract, each in one way, and the failure that
// checkTransport() must report for each. 2 ranks, which are threads. Time limits are short; a case that was not found
// is run again with longer ones, as on a machine that stands still another failure may come first.
#include "catch.hpp"
#include "shuffled.hpp"

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/testing/fault_transport.hpp>
#include <dfb/testing/transport_conformance.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <future>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace broken_cases {

using namespace dfb;
using std::chrono::milliseconds;
using testing::ConformanceOptions;

namespace {

enum class Defect {
    LosesSome,
    LosesEmptyMessages,
    LosesTheEndOfLargeMessages,
    DeliversTwice,
    NamesTheWrongSource,
    LosesWhatComesBeforeStart,
    MixesTransports, // messages of the other transports of a rank go to the one started last
    BlocksInSend,
    BlocksInInterrupt, // called by a handler
    WaitsInAbandon,
    CallsAfterStop,
    Oversleeps,
    HardlySleeps,
    IsNotInterrupted,
    ForgetsAnEarlyInterrupt, // ends a nap under way, but not the next one
    SleepsOverSends,
    ClaimsToNeedNoPolls,
    AlwaysSaysThatItMoved,
    HasAnotherRankEachTime,
    ForgetsWhatItHoldsInStop,
    LiesAboutQuiet,
    IsNeverQuiet
};

std::atomic<bool> testIsOver{false};

// The handlers of the transports on each of the two ranks of a run, in the order in which they were started.
struct Started {
    std::mutex mutex;
    std::array<std::vector<TransportHandler*>, 2> handlers;
};

// One class has all defects, as each instantiation of the suite takes a while to compile.
class Broken : private TransportHandler {
public:
    using Base = testing::FaultTransport<ShuffledTransport>;
    struct Communicator {
        Base::Communicator communicator;
        Defect defect;
        std::shared_ptr<Started> started; // also for calls that end after the run
        milliseconds timeLimit;           // of a case of the suite
    };

    Broken(const Communicator& communicator, std::shared_ptr<MemoryPool> pool, Progress progress)
        : defect_(communicator.defect), started_(communicator.started), timeLimit_(communicator.timeLimit), pool_(pool),
          base_(communicator.communicator, std::move(pool), progress)
    {
    }
    ~Broken()
    {
        if (late_.joinable())
            late_.join();
    }

    int rank() const
    {
        static std::array<std::atomic<int>, 2> calls{0, 0};
        return has(Defect::HasAnotherRankEachTime) ? ++calls[own()] % 2 : base_.rank();
    }
    int size() const { return base_.size(); }
    bool needsPolling() const { return base_.needsPolling() && !has(Defect::ClaimsToNeedNoPolls); }
    bool mayPoll() const { return true; }
    bool quiet() const { return (base_.quiet() || has(Defect::LiesAboutQuiet)) && !has(Defect::IsNeverQuiet); }

    void start(TransportHandler& handler)
    {
        handler_ = &handler;
        {
            const std::lock_guard<std::mutex> lock(started_->mutex);
            started_->handlers[own()].push_back(handler_);
        }
        starting_ = true;
        base_.start(*this);
        starting_ = false;
    }

    void send(int destination, Buffer&& message)
    {
        const int number = ++sent_;
        if ((has(Defect::LosesSome) && number % 40 == 0) || (has(Defect::LosesEmptyMessages) && message.empty()))
            return;
        if (has(Defect::LosesTheEndOfLargeMessages))
            message.shrink(20000);
        while (has(Defect::BlocksInSend) && number == 100 && !testIsOver)
            std::this_thread::sleep_for(milliseconds(1));
        base_.send(destination, std::move(message));
    }

    bool poll() { return base_.poll() || has(Defect::AlwaysSaysThatItMoved); }

    void nap(std::chrono::nanoseconds limit)
    {
        napping_ = true;
        if (has(Defect::SleepsOverSends))
            signal_.nap(limit);
        else
            base_.nap(has(Defect::Oversleeps)     ? limit + timeLimit_ / 8
                      : has(Defect::HardlySleeps) ? limit / 100
                                                  : limit);
        napping_ = false;
    }
    void interrupt()
    {
        while (has(Defect::BlocksInInterrupt) && inHandler() && !testIsOver)
            std::this_thread::sleep_for(milliseconds(1));
        signal_.interrupt();
        if (!has(Defect::IsNotInterrupted) && (!has(Defect::ForgetsAnEarlyInterrupt) || napping_))
            base_.interrupt();
    }

    void stop(bool orderly)
    {
        if (has(Defect::WaitsInAbandon) && !orderly)
            std::this_thread::sleep_for(timeLimit_ / 2);
        base_.stop(orderly && !has(Defect::ForgetsWhatItHoldsInStop));
        {
            const std::lock_guard<std::mutex> lock(started_->mutex);
            auto& handlers = started_->handlers[own()];
            handlers.erase(std::find(handlers.begin(), handlers.end(), handler_));
        }
        if (has(Defect::CallsAfterStop))
            late_ = std::thread([this] {
                std::this_thread::sleep_for(milliseconds(5));
                handler_->receive(1 - base_.rank(), Buffer());
            });
    }

private:
    bool has(Defect defect) const { return defect_ == defect; }
    std::size_t own() const { return static_cast<std::size_t>(base_.rank()); }
    static bool& inHandler()
    {
        static thread_local bool is = false;
        return is;
    }

    void receive(int source, Buffer&& message) override
    {
        const int number = ++received_;
        if (has(Defect::LosesWhatComesBeforeStart) && starting_ && message.size() >= 64)
            return;
        if (has(Defect::NamesTheWrongSource) && message.size() > 60000)
            source = base_.rank();
        if (has(Defect::DeliversTwice) && number % 100 == 0) {
            Buffer copy = pool_->acquire(message.size());
            std::copy(message.data(), message.data() + message.size(), copy.data());
            handler_->receive(source, std::move(copy));
        }
        if (has(Defect::MixesTransports) && number % 10 == 0 && message.size() >= 64) {
            const std::lock_guard<std::mutex> lock(started_->mutex);
            started_->handlers[own()].back()->receive(source, std::move(message));
        } else {
            inHandler() = true;
            handler_->receive(source, std::move(message));
            inHandler() = false;
        }
    }
    void fail(const ErrorInfo& error) override { handler_->fail(error); }
    bool failed() const override { return handler_->failed(); }

    Defect defect_;
    std::shared_ptr<Started> started_;
    milliseconds timeLimit_;
    std::shared_ptr<MemoryPool> pool_;
    Base base_;
    NapSignal signal_;
    TransportHandler* handler_ = nullptr;
    std::atomic<bool> starting_{false}, napping_{false};
    std::atomic<int> sent_{0}, received_{0};
    std::thread late_;
};

// The transport under the broken one: one that delivers at once, one that holds messages back at the sender, or one
// that holds them back at the receiver.
enum class Over { Plain, Late, Shuffled };

struct Case {
    Defect defect;
    // The failure that must be found: a line that begins with `name` and contains `what`.
    std::string name, what;
    Over over = Over::Plain;
    Progress mode = Progress::Caller;
};

std::string failuresOf(const Case& c, milliseconds timeLimit)
{
    const auto started = std::make_shared<Started>();
    ConformanceOptions options;
    options.timeLimit = timeLimit;
    options.largestMessage = std::size_t{1} << 16;
    options.smallMessages = 400;
    options.modes = {c.mode};
    testing::FaultOptions faults;
    faults.delay = c.over == Over::Late ? 1 : 0;
    std::mutex mutex;
    std::string text;
    const auto seed = c.over == Over::Shuffled ? std::optional<std::uint64_t>(1) : std::nullopt;
    runRanks(2, [&](const InprocCommunicator& communicator) {
        const Broken::Communicator broken{{{communicator, seed}, faults}, c.defect, started, timeLimit};
        const std::string own = testing::describeFailures(testing::checkTransport<Broken>(broken, options));
        const std::lock_guard<std::mutex> lock(mutex);
        text += own;
    });
    return text;
}

// Whether `text` has a line that begins with `name` and contains `what`.
bool finds(const std::string& text, const std::string& name, const std::string& what)
{
    for (std::size_t from = 0, to = 0; from < text.size(); from = to + 1) {
        to = text.find('\n', from);
        const std::string line = text.substr(from, to - from);
        if (line.compare(0, name.size(), name) == 0 && line.find(what) != std::string::npos)
            return true;
    }
    return false;
}

// Runs all cases at the same time, as they mostly wait; then those again that were not found.
void checkFound(const std::vector<Case>& cases)
{
    std::vector<std::string> texts(cases.size());
    const auto found = [&](std::size_t i) { return finds(texts[i], cases[i].name, cases[i].what); };
    for (const milliseconds timeLimit : {milliseconds(400), milliseconds(2000), milliseconds(8000)}) {
        std::vector<std::future<void>> runs;
        for (std::size_t i = 0; i < cases.size(); ++i)
            if (!found(i))
                runs.push_back(
                    std::async(std::launch::async, [&, i, timeLimit] { texts[i] = failuresOf(cases[i], timeLimit); }));
        for (auto& run : runs)
            run.get();
    }
    for (std::size_t i = 0; i < cases.size(); ++i) {
        INFO(cases[i].what << " is to be found in\n" << texts[i]);
        CHECK(found(i));
    }
}

} // namespace

TEST_CASE("Messages that are lost, added or changed are found")
{
    checkFound({
        {Defect::LosesSome, "", "no message from rank "},
        {Defect::LosesEmptyMessages, "messages of all sizes", "of 0 bytes is missing"},
        {Defect::LosesTheEndOfLargeMessages, "messages of all sizes", "20000 of its 65536 bytes came"},
        {Defect::DeliversTwice, "many small messages", "came twice"},
        {Defect::NamesTheWrongSource, "messages of all sizes", "there can be none from there"},
        {Defect::LosesWhatComesBeforeStart, "messages before start()", "no message from rank "},
        {Defect::MixesTransports, "", "belongs to another transport"},
        {Defect::ClaimsToNeedNoPolls, "", "nothing heard from rank ", Over::Shuffled},
        {Defect::ForgetsWhatItHoldsInStop, "stop(true) loses nothing", "no message from rank ", Over::Late},
    });
}

TEST_CASE("Calls that do not return, and those that come too late, are found")
{
    testIsOver = false;
    checkFound({
        {Defect::BlocksInSend, "", "has not ended: a call of the transport does not return"},
        {Defect::BlocksInInterrupt, "", "has not ended: a call of the transport does not return"},
        {Defect::WaitsInAbandon, "stop(false) waits for nobody", "it took "},
        {Defect::CallsAfterStop, "", "the handler was called after stop()"},
    });
    testIsOver = true;
}

TEST_CASE("Naps that are too long or too short are found")
{
    const std::string limits = "nap() ends by its limit and by interrupt()";
    checkFound({
        {Defect::Oversleeps, limits, "nap(1 ms) took "},
        {Defect::HardlySleeps, limits, "it hardly sleeps"},
        {Defect::IsNotInterrupted, limits, ", interrupted after "},
        {Defect::ForgetsAnEarlyInterrupt, limits, " just after interrupt() took "},
        {Defect::SleepsOverSends, "send() ends the nap", "messages sent during a nap of ", Over::Late,
         Progress::Thread},
    });
}

TEST_CASE("Wrong answers are found")
{
    checkFound({
        {Defect::HasAnotherRankEachTime, "ranks and sizes", "in another transport on this communicator"},
        {Defect::AlwaysSaysThatItMoved, "poll() and quiet() come to rest", "poll() returned true", Over::Shuffled},
        {Defect::LiesAboutQuiet, "what was sent needs no polls after quiet()", "no message from rank ", Over::Late},
        {Defect::IsNeverQuiet, "what was sent needs no polls after quiet()", "quiet() has not come true"},
    });
}

} // namespace broken_cases
