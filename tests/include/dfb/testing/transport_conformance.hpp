// checkTransport: checks whether a transport keeps the contract of comm/transport.hpp. For authors of transports. It
// needs no test framework, and no connection between the ranks other than the transport itself.
//
//   for (const auto& result : dfb::testing::checkTransport<MyTransport>(communicator))
//       if (!result.passed())
//           std::cerr << result.name << ": " << result.message << '\n';
#pragma once

#include <dfb/comm/transport.hpp>
#include <dfb/testing/detail/conformance_tools.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <functional>
#include <future>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

namespace dfb::testing {

struct ConformanceResult {
    std::string name;
    std::string message; // empty if the case passed here and, as far as this rank heard, on all others
    bool ran = true;     // false if it was not run, after a case that could not end
    bool passed() const { return message.empty(); }
};

struct ConformanceOptions {
    std::uint64_t seed = 1;                            // of the contents, sizes and pauses; the same on all ranks
    std::size_t largestMessage = std::size_t{1} << 24; // bytes. A rank holds a few of them
    int smallMessages = 20000;                         // of all ranks together, in the cases with many messages
    std::chrono::milliseconds timeLimit{10000};        // of a case. What must happen soon gets a tenth of it
    bool duplicatesAllowed = false;                    // whether messages may come more than once
    std::vector<Progress> modes{Progress::Thread, Progress::Caller};
};

// A line for each case that failed; empty if all passed.
inline std::string describeFailures(const std::vector<ConformanceResult>& results)
{
    std::string text;
    int notRun = 0;
    for (const ConformanceResult& result : results) {
        notRun += !result.ran;
        if (result.ran && !result.passed())
            text += result.name + ": " + result.message + '\n';
    }
    return notRun == 0 ? text : text + "and " + std::to_string(notRun) + " cases were not run\n";
}

namespace detail {

// The state of a suite that runs in another thread.
class Report {
public:
    // Begins a case, or another step that must end within `limit`.
    void enter(const std::string& what, Clock::duration limit)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        activity_ = what;
        until_ = Clock::now() + limit;
    }
    void add(ConformanceResult result)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        results_.push_back(std::move(result));
    }

    // Waits for the end of the suite. Returns false if a step has not ended in time. The last result then says so.
    bool waitFor(const std::future<void>& end)
    {
        while (end.wait_for(std::chrono::milliseconds(100)) != std::future_status::ready) {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (Clock::now() > until_) {
                results_.push_back({activity_, "has not ended: a call of the transport does not return", true});
                return false;
            }
        }
        return true;
    }
    std::vector<ConformanceResult> results() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return results_;
    }

private:
    mutable std::mutex mutex_;
    std::string activity_ = "constructor";
    Clock::time_point until_ = Clock::time_point::max();
    std::vector<ConformanceResult> results_;
};

// The cases, on one rank. All ranks go through them in step: they send announcements over a transport of the suite's
// own, and repeat them until they are heard. So the suite itself works over a transport that loses messages, and the
// cases find that out.
template <class Transport>
class Suite {
public:
    Suite(const typename Transport::Communicator& communicator, const ConformanceOptions& options, Report& report)
        : communicator_(communicator), options_(options), report_(report), soon_(options.timeLimit / 10),
          longNap_(options.timeLimit / 5), controlMailbox_(bell_), control_(communicator_, pool_, Progress::Caller),
          rank_(control_.rank()), size_(control_.size())
    {
        std::thread([this] { anyThread_ = control_.mayPoll(); }).join();
    }

    // Whether run() may be called from another thread than the constructor.
    bool anyThread() const { return anyThread_; }

    void run()
    {
        if (rank_ < 0 || rank_ >= size_) {
            report_.add(
                {"ranks and sizes", "this is rank " + std::to_string(rank_) + " of " + std::to_string(size_), true});
            return;
        }
        peers_.resize(static_cast<std::size_t>(size_));
        control_.start(controlMailbox_);
        for (const Progress mode : options_.modes) {
            mode_ = mode;
            runCase("ranks and sizes", [this] { checkRanks(); });
            runCase("messages of all sizes", [this] { checkSizes(); });
            runCase("many small messages, all to all", [this] { checkManyMessages(1); });
            runCase("sends from several threads", [this] { checkManyMessages(4); });
            runCase("send() never blocks", [this] { checkFlood(); });
            runCase("what was sent needs no polls after quiet()", [this] { checkQuiet(); });
            runCase("poll() and quiet() come to rest", [this] { checkRest(); });
            runCase("nap() ends by its limit and by interrupt()", [this] { checkNap(); });
            runCase("send() ends the nap", [this] { checkNapOfSender(); });
            runCase("stop(true) after everything has come", [this] { checkEnd(); });
            runCase("messages before start()", [this] { checkEarlyMessages(); });
            runCase("two transports at once", [this] { checkTwoAtOnce(); });
            runCase("made and ended again and again", [this] { checkAgain(); });
            runCase("stop(true) loses nothing", [this] { checkOrderlyStop(); });
            runCase("stop(true) ends when the handler has failed", [this] { checkHopelessStop(); });
            runCase("stop(false) waits for nobody", [this] { checkAbandon(); });
        }
        report_.enter("stop() at the end", 2 * options_.timeLimit);
        controlMailbox_.failAt(Clock::now() + options_.timeLimit);
        control_.stop(allPassed_);
    }

private:
    using SizeOf = std::function<std::size_t(std::uint64_t)>;
    static constexpr std::size_t smallSize = 64, mediumSize = std::size_t{1} << 16, largeSize = std::size_t{1} << 20;

    // A transport under test and what drives it. Its mailbox outlives it.
    struct End {
        End(Suite& suite, Mailbox& itsMailbox)
            : mailbox(itsMailbox), transport(suite.communicator_, suite.pool_, suite.mode_), channel(++suite.channels_),
              polledHere(transport.needsPolling() && suite.mode_ == Progress::Caller)
        {
        }

        Mailbox& mailbox;
        Transport transport;
        std::uint32_t channel;
        bool polledHere;
        bool started = false, resting = false;
        bool mayFail = false; // a rank has left it, or will, and others may be told of a failure
        std::unique_ptr<Poller<Transport>> poller;
    };

    // A rank's message to the others: it has reached this step. After the last step of a case, a text follows that says
    // how the case went.
    struct Announcement {
        std::uint64_t magic = controlMagic, checksum = 0;
        std::uint32_t step = 0;
        std::int32_t rank = 0;
        std::uint32_t givesUp = 0, wantsAnswer = 0;
    };
    static_assert(std::has_unique_object_representations_v<Announcement>);
    struct Peer {
        std::uint32_t step = 0;
        bool givesUp = false;
        std::map<std::uint32_t, std::string> verdicts; // by step; not empty
    };
    static constexpr std::uint32_t stepsPerCase = 1 << 16; // at least as many as ranks

    template <class Body>
    void runCase(const char* what, const Body& body)
    {
        const std::string name =
            std::string(what) + (mode_ == Progress::Thread ? " (Progress::Thread)" : " (Progress::Caller)");
        if (!gaveUpIn_.empty()) {
            report_.add({name, "not run after '" + gaveUpIn_ + "'", false});
            return;
        }
        const Clock::duration grace = std::max<Clock::duration>(options_.timeLimit, std::chrono::seconds(1));
        step_ = series_ = ++caseNumber_ * stepsPerCase;
        problems_.clear();
        report_.enter(name, options_.timeLimit + grace);
        deadline_ = Clock::now() + options_.timeLimit;
        bool givesUp = false;
        try {
            body();
        } catch (const std::exception& e) { // GaveUp, or an exception of the transport
            problems_.add(e.what());
            lookForStrays();
            givesUp = true;
        }
        lookForLateCalls();

        // A rank that gives up waits only long enough for the others to hear of it.
        const Clock::duration patience = givesUp ? soon_ : 2 * options_.timeLimit + std::chrono::seconds(2);
        report_.enter(name + ", waiting for the other ranks", patience + grace);
        step_ = caseNumber_ * stepsPerCase + stepsPerCase - 1;
        announce(problems_.text(), givesUp);
        if (!waitUntil([this] { return allHaveCome(); }, Clock::now() + patience) && !givesUp) {
            problems_.add(whoHasNotCome(patience));
            givesUp = true;
        }
        std::string text = problems_.text();
        for (int r = 0; r < size_; ++r) {
            const auto verdict = peer(r).verdicts.find(step_);
            if (text.empty() && verdict != peer(r).verdicts.end())
                text = "rank " + std::to_string(r) + ": " + verdict->second;
            givesUp = givesUp || peer(r).givesUp;
        }
        allPassed_ = allPassed_ && text.empty();
        report_.add({name, text, true});
        if (!givesUp)
            return;
        gaveUpIn_ = name;
        report_.enter("stop(false) after '" + name + "'", options_.timeLimit);
        while (!ends_.empty())
            close(*ends_.back(), false);
    }

    // --- in step with the other ranks

    Peer& peer(int r) { return peers_[static_cast<std::size_t>(r)]; }

    void announce(const std::string& verdict, bool givesUp)
    {
        verdict_ = verdict;
        givesUp_ = givesUp;
        for (int r = 0; r < size_; ++r)
            if (r != rank_)
                tell(r, false);
        nextRepeat_ = Clock::now() + repeatAfter;
        // This rank may now enter a call that waits for the others. So its announcements must have left: without them,
        // the others would not get to that call.
        waitUntil([this] { return control_.quiet(); }, nextRepeat_);
    }

    static std::uint64_t checksumOf(Announcement announcement, const std::string& text)
    {
        announcement.checksum = 0;
        std::string bytes(reinterpret_cast<const char*>(&announcement), sizeof announcement);
        bytes += text;
        std::uint64_t sum = bytes.size();
        for (const char c : bytes)
            sum = mix(sum ^ static_cast<unsigned char>(c));
        return sum;
    }

    void tell(int destination, bool wantsAnswer)
    {
        Announcement announcement;
        announcement.step = step_;
        announcement.rank = rank_;
        announcement.givesUp = givesUp_;
        announcement.wantsAnswer = wantsAnswer;
        announcement.checksum = checksumOf(announcement, verdict_);
        Buffer message = pool_->acquire(sizeof announcement + verdict_.size());
        std::memcpy(message.data(), &announcement, sizeof announcement);
        if (!verdict_.empty())
            std::memcpy(message.data() + sizeof announcement, verdict_.data(), verdict_.size());
        control_.send(destination, std::move(message));
    }

    void hear(int source, const Buffer& message)
    {
        const std::string from = "a message of the suite from rank " + std::to_string(source);
        Announcement announcement;
        if (message.size() >= sizeof announcement)
            std::memcpy(&announcement, message.data(), sizeof announcement);
        std::string text;
        if (message.size() > sizeof announcement)
            text.assign(reinterpret_cast<const char*>(message.data()) + sizeof announcement,
                        message.size() - sizeof announcement);
        if (announcement.magic == testMagic) {
            problems_.add("a message from rank " + std::to_string(source) + " belongs to another transport");
        } else if (message.size() < sizeof announcement || announcement.checksum != checksumOf(announcement, text)
                   || announcement.rank < 0 || announcement.rank >= size_) {
            problems_.add(from + " is damaged");
        } else {
            if (announcement.rank != source)
                problems_.add(from + " was sent by rank " + std::to_string(announcement.rank));
            Peer& sender = peer(announcement.rank);
            sender.step = std::max(sender.step, announcement.step);
            sender.givesUp = sender.givesUp || announcement.givesUp != 0;
            if (!text.empty())
                sender.verdicts[announcement.step] = text;
            if (announcement.wantsAnswer != 0 && announcement.rank != rank_ && announcement.step <= step_)
                tell(announcement.rank, false);
        }
    }

    bool allHaveCome()
    {
        bool all = true;
        const bool repeat = Clock::now() >= nextRepeat_;
        for (int r = 0; r < size_; ++r)
            if (r != rank_ && peer(r).step < step_) {
                all = false;
                if (repeat)
                    tell(r, true);
            }
        if (repeat)
            nextRepeat_ = Clock::now() + repeatAfter;
        return all;
    }

    std::string whoHasNotCome(Clock::duration limit)
    {
        Problems missing;
        for (int r = 0; r < size_; ++r)
            if (r != rank_ && peer(r).step < step_)
                missing.add("nothing heard from rank " + std::to_string(r) + " within " + inSeconds(limit));
        return missing.text();
    }

    // Waits until all ranks have reached this step.
    void meet()
    {
        ++step_;
        announce("", false);
        // This waits a little longer than for a message: the rank that misses a message has more to say than those that
        // wait for it.
        await([this] { return allHaveCome(); }, [this] { return whoHasNotCome(options_.timeLimit); }, soon_);
        // The announcement must leave even if this rank does not poll in what comes next, such as a constructor.
        waitUntil([this] { return control_.quiet(); }, Clock::now() + std::chrono::milliseconds(100));
    }

    // --- waiting

    // Makes progress with everything that this thread polls.
    bool pump()
    {
        bool moved = control_.needsPolling() && control_.poll();
        for (const auto& end : ends_)
            if (end->polledHere && end->started && !end->resting)
                moved = end->transport.poll() || moved;
        for (const auto& [source, message] : controlMailbox_.take())
            hear(source, message);
        return moved;
    }

    // Sleeps a little, since there may be more ranks than cores.
    void pause(Clock::duration time)
    {
        End* polled = nullptr;
        for (const auto& end : ends_)
            if (end->polledHere && end->started && !end->resting)
                polled = end.get();
        if (polled)
            polled->transport.nap(time);
        else
            bell_.nap(time);
    }

    template <class Ready>
    bool waitUntil(const Ready& ready, Clock::time_point deadline)
    {
        constexpr std::chrono::microseconds shortest(20), longest(1000);
        for (Clock::duration time = shortest; !ready();) {
            if (Clock::now() >= deadline)
                return false;
            if (pump()) {
                time = shortest;
            } else {
                pause(time);
                time = std::min<Clock::duration>(time * 3 / 2, longest);
            }
        }
        return true;
    }

    // Waits until ready() is true. Throws GaveUp, with the text of what(), if it is not within the time limit of the
    // case plus `longer`; and earlier if there is no more hope.
    template <class Ready, class What>
    void await(const Ready& ready, const What& what, Clock::duration longer = {})
    {
        const Clock::time_point deadline = deadline_ + longer;
        std::string trouble;
        const auto over = [&] {
            trouble = hopeless();
            return !trouble.empty() || ready();
        };
        // The thing that is missing here says more than that another rank gave up.
        if (!waitUntil(over, deadline) || (!trouble.empty() && Clock::now() >= deadline))
            throw GaveUp(what());
        if (!trouble.empty())
            throw GaveUp(trouble);
    }

    std::string hopeless()
    {
        if (const std::string failure = controlMailbox_.failure(); !failure.empty())
            return "the transport reports: " + failure;
        for (const auto& end : ends_) {
            if (const std::string failure = end->mailbox.failure(); !failure.empty() && !end->mayFail)
                return "the transport reports: " + failure;
            if (end->poller && !end->poller->mayPoll())
                return "mayPoll() forbids it to the thread that Progress::Thread asks for";
        }
        for (int r = 0; r < size_; ++r)
            if (peer(r).givesUp) {
                const auto& verdicts = peer(r).verdicts;
                return "rank " + std::to_string(r) + " gave up"
                       + (verdicts.empty() ? "" : ": " + verdicts.rbegin()->second);
            }
        return "";
    }

    void idle(Clock::duration time)
    {
        waitUntil([] { return false; }, Clock::now() + time);
    }

    // --- transports under test

    End& make()
    {
        mailboxes_.push_back(std::make_unique<Mailbox>(bell_));
        ends_.push_back(std::make_unique<End>(*this, *mailboxes_.back()));
        return *ends_.back();
    }

    void begin(End& end)
    {
        end.mailbox.setInterrupt([&transport = end.transport] { transport.interrupt(); });
        end.transport.start(end.mailbox);
        end.started = true;
        if (end.transport.needsPolling() && !end.polledHere)
            end.poller = std::make_unique<Poller<Transport>>(end.transport);
    }

    // The suite does not poll a transport while it rests.
    void rest(End& end, bool resting)
    {
        end.resting = resting;
        if (end.poller)
            end.poller->pause(resting);
    }

    void close(End& end, bool orderly)
    {
        end.poller.reset();
        end.mailbox.failAt(deadline_);
        if (end.started)
            end.transport.stop(orderly);
        end.mailbox.close();
        const bool late = orderly && Clock::now() > deadline_;
        const std::size_t more = end.mailbox.take().size();
        ends_.erase(std::find_if(ends_.begin(), ends_.end(), [&end](const auto& e) { return e.get() == &end; }));
        if (late)
            throw GaveUp("stop(true) has not ended within " + inSeconds(options_.timeLimit) + " of the start");
        if (orderly && more > 0 && !options_.duplicatesAllowed)
            problems_.add(std::to_string(more) + " messages more than were sent");
    }

    void lookForLateCalls()
    {
        for (const auto& mailbox : mailboxes_)
            if (const int calls = mailbox->takeTooLate(); calls > 0)
                problems_.add("the handler was called after stop(), " + std::to_string(calls) + " times");
    }

    // A message that is missing in one transport may have come to another.
    void lookForStrays()
    {
        for (const auto& end : ends_)
            for (const auto& [source, message] : end->mailbox.take()) {
                Label found;
                if (message.size() >= sizeof found)
                    std::memcpy(&found, message.data(), sizeof found);
                if (found.magic == controlMagic || (found.magic == testMagic && found.channel != end->channel))
                    problems_.add("a message from rank " + std::to_string(source) + " belongs to another transport");
            }
    }

    // --- messages

    static std::size_t small(std::uint64_t) { return smallSize; }
    std::size_t atMost(std::size_t size) const { return std::max(smallSize, std::min(size, options_.largestMessage)); }
    // Sizes of messages: the first is large, the second medium, the others small.
    SizeOf mixed() const
    {
        return [large = atMost(largeSize), medium = atMost(mediumSize)](std::uint64_t number) {
            return number == 0 ? large : number == 1 ? medium : smallSize;
        };
    }

    Label label(const End& end) const
    {
        Label result;
        result.magic = testMagic;
        result.channel = end.channel;
        result.series = series_;
        return result;
    }

    void send(End& end, int destination, std::uint64_t number, std::size_t size)
    {
        Label own = label(end);
        own.source = rank_;
        own.destination = destination;
        own.number = number;
        own.size = size;
        own.checksum = own.sum();
        end.transport.send(destination, makeMessage(*pool_, own, options_.seed));
    }

    // All other ranks, or half of them: in a round, the ranks of one parity send to those of the other.
    enum class Others { All, OfOtherParity };
    bool isIn(Others others, int r) const { return r != rank_ && (others == Others::All || r % 2 != rank_ % 2); }
    bool sendsIn(int round) const { return rank_ % 2 == round % 2; }

    // Sends the messages number `first`, `first` + `step`, ... below `count`.
    void sendAll(End& end, Others to, std::uint64_t count, const SizeOf& sizeOf, std::uint64_t first = 0,
                 std::uint64_t step = 1)
    {
        for (std::uint64_t number = first; number < count; number += step)
            for (int r = 0; r < size_; ++r)
                if (isIn(to, r))
                    send(end, r, number, sizeOf(number));
    }

    // Expects `count` messages from each of these ranks.
    Ledger expect(const End& end, Others from, std::uint64_t count, const SizeOf& sizeOf) const
    {
        std::vector<std::uint64_t> counts(static_cast<std::size_t>(size_));
        for (int r = 0; r < size_; ++r)
            counts[static_cast<std::size_t>(r)] = isIn(from, r) ? count : 0;
        return Ledger(label(end), rank_, options_.seed, counts, sizeOf, options_.duplicatesAllowed);
    }

    void receive(End& end, Ledger& ledger, int source = -1)
    {
        await(
            [&] {
                for (const auto& [from, message] : end.mailbox.take())
                    ledger.check(from, message, problems_);
                return ledger.complete(source);
            },
            [&] { return ledger.missing(options_.timeLimit); });
    }

    // How many of `total` messages each rank sends to each other rank.
    std::uint64_t share(int total) const
    {
        return static_cast<std::uint64_t>(std::max(1, size_ > 1 ? total / (size_ * (size_ - 1)) : 1));
    }

    // --- cases

    void checkRanks()
    {
        session_ = &make();
        const Transport& transport = session_->transport;
        if (transport.rank() != rank_ || transport.size() != size_)
            throw GaveUp("rank " + std::to_string(transport.rank()) + " of " + std::to_string(transport.size())
                         + ", in another transport on this communicator rank " + std::to_string(rank_) + " of "
                         + std::to_string(size_));
        if (session_->polledHere && !transport.mayPoll())
            throw GaveUp("mayPoll() forbids it to the thread that made the transport, with Progress::Caller");
        begin(*session_);
        meet(); // messages before start() have a case of their own
        sendAll(*session_, Others::All, 1, small);
        Ledger ledger = expect(*session_, Others::All, 1, small);
        receive(*session_, ledger);
    }

    // Each rank sends to one other at a time: there may not be memory for all at once.
    void checkSizes()
    {
        std::vector<std::size_t> sizes;
        for (const std::size_t base : {std::size_t{0}, std::size_t{16}, std::size_t{64}, std::size_t{8192}, mediumSize,
                                       largeSize, options_.largestMessage})
            for (const std::size_t size : {base, base + 1, base - 1, base + 3, base - 3})
                if (size <= options_.largestMessage && (size <= largeSize + 1 || size == options_.largestMessage)
                    && std::find(sizes.begin(), sizes.end(), size) == sizes.end())
                    sizes.push_back(size);
        const auto sizeOf = [&sizes](std::uint64_t number) { return sizes[static_cast<std::size_t>(number)]; };
        Ledger ledger = expect(*session_, Others::All, sizes.size(), sizeOf);
        for (int shift = 1; shift < size_; ++shift) {
            for (std::size_t i = 0; i < sizes.size(); ++i) { // small ones before and after large ones
                const std::size_t number = i % 2 ? i / 2 : sizes.size() - 1 - i / 2;
                send(*session_, (rank_ + shift) % size_, number, sizes[number]);
            }
            receive(*session_, ledger, (rank_ + size_ - shift) % size_);
            meet();
        }
    }

    void checkManyMessages(int threadCount)
    {
        const auto sizeOf = [seed = options_.seed](std::uint64_t number) {
            return smallSize + static_cast<std::size_t>(mix(seed + number) % 256);
        };
        const std::uint64_t count = share(options_.smallMessages);
        const auto step = static_cast<std::uint64_t>(threadCount);
        std::vector<std::thread> threads;
        std::vector<std::string> errors(static_cast<std::size_t>(threadCount));
        std::atomic<int> running{threadCount};
        const auto sendOwn = [&](std::uint64_t first) {
            try {
                sendAll(*session_, Others::All, count, sizeOf, first, step);
            } catch (const std::exception& e) {
                errors[static_cast<std::size_t>(first)] = e.what();
            }
            --running;
        };
        // As in a connection that passes messages on.
        session_->mailbox.interruptOnReceive(true);
        meet();
        Ledger ledger = expect(*session_, Others::All, count, sizeOf);
        if (threadCount == 1) {
            sendOwn(0);
        } else {
            for (std::uint64_t t = 0; t < step; ++t)
                threads.emplace_back(sendOwn, t);
            waitUntil([&running] { return running == 0; }, Clock::time_point::max());
            for (std::thread& thread : threads)
                thread.join();
        }
        for (const std::string& error : errors)
            if (!error.empty())
                throw GaveUp("send() throws: " + error);
        receive(*session_, ledger);
        meet();
        session_->mailbox.interruptOnReceive(false);
    }

    void checkFlood()
    {
        const std::uint64_t count = 3 + share(options_.smallMessages / 4);
        const auto sizeOf = [large = atMost(largeSize)](std::uint64_t number) {
            return number < 2 ? large : std::size_t{1024};
        };
        rest(*session_, true);
        meet();
        sendAll(*session_, Others::All, count, sizeOf);
        meet();
        rest(*session_, false);
        Ledger ledger = expect(*session_, Others::All, count, sizeOf);
        receive(*session_, ledger);
    }

    void checkQuiet()
    {
        for (int round = 0; round < 2; ++round) {
            ++series_;
            const bool sends = sendsIn(round);
            Ledger ledger = expect(*session_, Others::OfOtherParity, sends ? 0 : 20, mixed());
            meet();
            if (sends) {
                sendAll(*session_, Others::OfOtherParity, 20, mixed());
                await([this] { return session_->transport.quiet(); },
                      [this] { return "quiet() has not come true within " + inSeconds(options_.timeLimit); });
                rest(*session_, true);
            }
            receive(*session_, ledger);
            meet();
            rest(*session_, false);
            meet(); // the ledger of the next round starts with an empty mailbox
        }
    }

    void checkRest()
    {
        meet();
        Transport& transport = session_->transport;
        const auto late = [&](const char* what) { return what + (" within " + inSeconds(options_.timeLimit)); };
        await([&] { return transport.quiet(); }, [&] { return late("quiet() has not come true"); });
        rest(*session_, true);
        int misses = 0; // polls in a row that moved nothing
        await([&] { return !transport.needsPolling() || (misses = transport.poll() ? 0 : misses + 1) > 20; },
              [&] { return late("poll() returned true again and again, with nothing to move,"); });
        rest(*session_, false);
        meet();
    }

    void checkNap()
    {
        rest(*session_, true);
        meet();
        Transport& transport = session_->transport;
        const auto nap = [&](Clock::duration limit, Clock::duration most, const char* how) {
            const auto before = Clock::now();
            transport.nap(limit);
            const auto time = Clock::now() - before;
            if (time > most)
                problems_.add("nap(" + inSeconds(limit) + ")" + how + " took " + inSeconds(time));
            return time;
        };
        using std::chrono::milliseconds;
        for (int i = 0; i < 3; ++i)
            nap(milliseconds(1), soon_, ""); // to use up interrupts that are left over
        nap(milliseconds(0), soon_, "");
        Clock::duration total{0};
        for (int i = 0; i < 10; ++i)
            total += nap(milliseconds(10), milliseconds(10) + soon_, "");
        if (total < milliseconds(50))
            problems_.add("10 times nap(10 ms) took " + inSeconds(total) + " together: it hardly sleeps");
        transport.interrupt();
        nap(longNap_, soon_, " just after interrupt()");
        std::thread interrupter([&transport] {
            std::this_thread::sleep_for(milliseconds(30));
            transport.interrupt();
        });
        nap(longNap_, soon_, ", interrupted after 30 ms,");
        interrupter.join();

        // The interrupt comes just when the nap begins.
        NapSignal begins;
        std::atomic<bool> over{false};
        interrupter = std::thread([&, seed = options_.seed]() mutable {
            while (begins.nap(std::chrono::hours(1)), !over) {
                const auto until = Clock::now() + std::chrono::nanoseconds((seed = mix(seed)) % 20000);
                while (Clock::now() < until) {
                }
                transport.interrupt();
            }
        });
        for (int i = 0; i < 100; ++i) {
            begins.interrupt();
            if (nap(longNap_, soon_, ", interrupted as it began,") > soon_)
                break;
        }
        over = true;
        begins.interrupt();
        interrupter.join();
        rest(*session_, false);
        meet();
    }

    // Whether a nap ends when a message is sent can be seen only if another thread naps.
    void checkNapOfSender()
    {
        if (!session_->poller)
            return;
        for (int round = 0; round < 4; ++round) {
            ++series_;
            const bool sends = sendsIn(round);
            Ledger ledger = expect(*session_, Others::OfOtherParity, sends ? 0 : 3, small);
            session_->poller->napFor(sends ? longNap_ : Clock::duration::zero());
            meet();
            const auto before = Clock::now();
            for (std::uint64_t number = 0; sends && number < 3; ++number) {
                idle(std::chrono::microseconds(number == 0 ? 10000 : 100)); // then in quick succession
                sendAll(*session_, Others::OfOtherParity, number + 1, small, number);
            }
            receive(*session_, ledger);
            if (const auto time = Clock::now() - before; time > soon_)
                problems_.add("messages sent during a nap of " + inSeconds(longNap_) + " took " + inSeconds(time));
            meet();
        }
        session_->poller->napFor(Clock::duration::zero());
        meet();
    }

    void checkEnd()
    {
        meet();
        close(*session_, true);
    }

    void checkEarlyMessages()
    {
        for (int round = 0; round < 2; ++round) {
            const bool sends = sendsIn(round);
            End& end = make();
            Ledger ledger = expect(end, Others::OfOtherParity, sends ? 0 : 20, mixed());
            if (sends) {
                begin(end);
                sendAll(end, Others::OfOtherParity, 20, mixed());
                idle(std::chrono::milliseconds(10)); // so that they leave, as far as they can
            }
            meet();
            if (!sends)
                begin(end);
            receive(end, ledger);
            meet();
            close(end, true);
        }
    }

    void checkTwoAtOnce()
    {
        End& first = make();
        End& second = make();
        begin(second);
        begin(first);
        meet();
        for (std::uint64_t number = 0; number < 50; ++number)
            for (int shift = 1; shift < size_; ++shift)
                for (End* end : {&first, &second})
                    send(*end, (rank_ + shift) % size_, number, mixed()(number));
        Ledger ofFirst = expect(first, Others::All, 50, mixed()), ofSecond = expect(second, Others::All, 50, mixed());
        receive(second, ofSecond);
        receive(first, ofFirst);
        meet();
        close(first, true);
        ++series_;
        sendAll(second, Others::All, 5, small);
        Ledger later = expect(second, Others::All, 5, small);
        receive(second, later);
        meet();
        close(second, true);
    }

    void checkAgain()
    {
        std::vector<std::pair<int, Buffer>> kept; // a message stays readable when its transport is gone
        for (int round = 0; round < 6; ++round) {
            End& end = make();
            begin(end);
            meet();
            sendAll(end, Others::All, 1, small);
            Ledger ledger = expect(end, Others::All, 1, small);
            const Ledger empty = ledger;
            kept.clear();
            await(
                [&] {
                    for (auto& [source, message] : end.mailbox.take()) {
                        ledger.check(source, message, problems_);
                        kept.emplace_back(source, std::move(message));
                    }
                    return ledger.complete();
                },
                [&] { return ledger.missing(options_.timeLimit); });
            meet();
            close(end, true);
            Ledger afterwards = empty;
            for (const auto& [source, message] : kept)
                afterwards.check(source, message, problems_);
        }
    }

    void checkOrderlyStop()
    {
        for (int round = 0; round < 2; ++round) {
            const bool sends = sendsIn(round);
            End& end = make();
            begin(end);
            Ledger ledger = expect(end, Others::OfOtherParity, sends ? 0 : 50, mixed());
            meet();
            if (sends)
                sendAll(end, Others::OfOtherParity, 50, mixed());
            else
                receive(end, ledger);
            close(end, true); // the senders expect nothing
            meet();
        }
    }

    // The others wait for rank 0, which never calls stop(true). They learn from its message that it has failed.
    void checkHopelessStop()
    {
        End& end = make();
        end.mayFail = true;
        begin(end);
        meet();
        if (rank_ == 0) {
            idle(std::chrono::milliseconds(20));
            sendAll(end, Others::All, 1, small);
        } else {
            end.poller.reset();
            end.mailbox.failWithMessage();
            end.mailbox.failAt(deadline_);
            const auto before = Clock::now();
            end.transport.stop(true);
            end.mailbox.close();
            end.started = false;
            if (const auto time = Clock::now() - before; time > soon_)
                problems_.add("it took " + inSeconds(time));
        }
        meet();
        close(end, false);
    }

    void checkAbandon()
    {
        End& end = make();
        end.mayFail = true;
        begin(end);
        meet();
        sendAll(end, Others::All, 20, mixed());
        if (sendsIn(0)) { // some messages go to ranks that have left
            idle(std::chrono::milliseconds(20));
            sendAll(end, Others::All, 20, mixed());
            idle(std::chrono::milliseconds(20));
        }
        const auto before = Clock::now();
        close(end, false);
        if (const auto time = Clock::now() - before; time > soon_)
            problems_.add("it took " + inSeconds(time));
        meet();
        idle(std::chrono::milliseconds(20)); // for calls that come too late
    }

    typename Transport::Communicator communicator_;
    ConformanceOptions options_;
    Report& report_;
    Clock::duration soon_, longNap_;
    std::shared_ptr<MemoryPool> pool_ = MemoryPool::create();
    NapSignal bell_; // rings when a message has come
    std::vector<std::unique_ptr<Mailbox>> mailboxes_;
    std::vector<std::unique_ptr<End>> ends_;
    End* session_ = nullptr; // the transport of the first cases
    Mailbox controlMailbox_;
    Transport control_;
    int rank_, size_;
    bool anyThread_ = true;

    Progress mode_ = Progress::Thread;
    std::uint32_t channels_ = 0, caseNumber_ = 0, step_ = 0, series_ = 0;
    Clock::time_point deadline_; // of the case
    Problems problems_;          // of the case
    std::string gaveUpIn_;
    bool allPassed_ = true;

    static constexpr std::chrono::milliseconds repeatAfter{100};
    Clock::time_point nextRepeat_;
    std::string verdict_; // the text announced last
    bool givesUp_ = false;
    std::vector<Peer> peers_;
};

} // namespace detail

// Runs all cases. Collective over `communicator`, which may have any size, though one rank alone shows little. Each
// rank returns the same cases, and a case that failed anywhere has a message everywhere (as far as messages arrive).
// After a case that could not end, the others are not run. Every case has a time limit, even if a call never returns:
// such a call is left behind in its thread, with its transport. The time limit does not hold for the first constructor,
// and for transports that only one thread may poll.
template <class Transport>
std::vector<ConformanceResult> checkTransport(const typename Transport::Communicator& communicator,
                                              const ConformanceOptions& options = {})
{
    static_assert(is_transport_v<Transport>, "dfb: checkTransport() needs a transport, see comm/transport.hpp");
    const auto report = std::make_shared<detail::Report>();
    std::shared_ptr<detail::Suite<Transport>> suite;
    try {
        suite = std::make_shared<detail::Suite<Transport>>(communicator, options, *report);
    } catch (const std::exception& e) {
        return {{"constructor", e.what(), true}};
    }
    const auto run = [report, suite] {
        try {
            suite->run();
        } catch (const std::exception& e) {
            report->add({"start and end of the suite", e.what(), true});
        }
    };
    if (!suite->anyThread()) {
        run();
        return report->results();
    }
    std::packaged_task<void()> task(run);
    std::future<void> end = task.get_future();
    std::thread thread(std::move(task));
    if (report->waitFor(end)) {
        thread.join();
        end.get(); // throws only what is no std::exception
    } else {
        thread.detach();
    }
    return report->results();
}

} // namespace dfb::testing
