// The bodies of control messages, and the classes that count them: verdicts, agreements, errors, manifests, reductions,
// credit, jobs, sequence numbers and headers. A body that was read is written the same again; an invalid one is
// refused; no rank gets more credit or jobs than there are.
//
// An input: a byte that picks the kind, then its bytes.
#include "fuzz.hpp"

#include <dfb/comm/connection.hpp>
#include <dfb/comm/flow_control.hpp>
#include <dfb/comm/reduction.hpp>
#include <dfb/frame/declarations.hpp>
#include <dfb/frame/job_share.hpp>
#include <dfb/frame/verdict.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <optional>
#include <set>

namespace {

namespace d = dfb::detail;
using Bytes = d::SmallBytes;
enum Which : std::uint8_t { Verdict, Agreement, Manifest, Reduction, Lender, Borrower, Jobs, Numbers, Header, whiches };

Bytes bytesFrom(const std::string& text) { return {fuzz::bytesOf(text), fuzz::bytesOf(text) + text.size()}; }

// Returns whether `call` was refused: as malformed, or with another kind of error that it may have.
template <class Call>
bool refused(const Call& call, dfb::ErrorKind other = dfb::ErrorKind::MalformedMessage)
{
    try {
        call();
        return false;
    } catch (const dfb::Error& e) {
        const dfb::ErrorKind kind = e.info().kind;
        fuzz::require(kind == dfb::ErrorKind::MalformedMessage || kind == other, "it is refused as malformed");
        return true;
    }
}

// Splits an input into two parts. In front of them is the length of the first.
std::pair<Bytes, Bytes> two(fuzz::Input in)
{
    const Bytes first = bytesFrom(in.text(in.take<std::uint16_t>() % 4096));
    return {first, bytesFrom(in.rest())};
}

bool isSame(const Bytes& a, const Bytes& b) { return std::equal(a.begin(), a.end(), b.begin(), b.end()); }

// Returns whether both parts are verdicts.
bool verdicts(const fuzz::Input& in)
{
    const auto parts = two(in);
    const Bytes &a = parts.first, &b = parts.second;
    const auto isOne = [](const Bytes& one) {
        return !refused([&] {
            const d::Verdict v = d::Verdict::from(one);
            fuzz::require(isSame(v.bytes(), one), "a verdict comes back");
            fuzz::require(!v.error || v.error->kind <= dfb::ErrorKind::MissingInput, "an error has a kind");
            dfb::FrameReport report;
            v.addTo(report);
        });
    };
    const bool both = isOne(a) && isOne(b);
    Bytes all;
    const bool combines = !refused([&] { all = d::Verdict::combine(a, b); });
    fuzz::require(combines == (isOne(a) && isOne(b)), "two verdicts are combined if they are two");
    if (both) {
        const d::Verdict v = d::Verdict::from(all);
        const bool failed = d::Verdict::from(a).error || d::Verdict::from(b).error;
        fuzz::require(!failed || v.error, "an error is not lost");
        fuzz::require(v.differing.empty() || v.error, "ranks that differ are told so");
    }
    return both;
}

// Returns whether both parts are agreements.
bool agreements(const fuzz::Input& in)
{
    const auto parts = two(in);
    const Bytes &a = parts.first, &b = parts.second;
    refused([&] { fuzz::require(isSame(d::Agreement::from(a).bytes(), a), "an agreement comes back"); });
    return !refused([&] {
        const auto all = d::Agreement::from(d::Agreement::combine(a, b));
        const auto first = d::Agreement::from(a), second = d::Agreement::from(b);
        fuzz::require(all.fine == (first.fine && second.fine && first.text == second.text),
                      "ranks agree exactly if they say the same");
    });
}

void manifests(const std::string& bytes)
{
    d::Declarations exchange;
    const auto isMine = [](int tile) { return tile >= 0 && tile < 6 && tile % 2 == 0; };
    const bool good = !refused([&] { exchange.receive(1, d::ByteReader(fuzz::bytesOf(bytes), bytes.size()), isMine); });
    int sent = 0;
    const bool isWaiting = exchange.declare(
        {{1, 5, 0}, {3, 7, 1}}, 0, [](int tile) { return tile % 2; },
        [&](int owner, const Bytes& manifest) { sent += owner == 1 && manifest.size() == 20; });
    fuzz::require(isWaiting && sent == 1 && refused([&] { exchange.acknowledged(0); }), "only who was asked answers");
    fuzz::require(exchange.acknowledged(1) && refused([&] { exchange.acknowledged(1); }), "and once");
    exchange.complete();
    std::size_t inputs = 0;
    for (const d::ExpectedInput& input : exchange.expected()) {
        fuzz::require(isMine(input.tile), "a manifest is of this rank's tiles");
        ++inputs;
    }
    fuzz::require(!good || inputs * 10 == bytes.size(), "each input is taken once");
    fuzz::require(refused([&] { exchange.receive(1, d::ByteReader(nullptr, 0), isMine); }), "none comes later");
}

// A rank in a tree of 5. The others send it parts and results in any order.
void reductions(fuzz::Input in)
{
    const int rank = in.take<std::uint8_t>() % 5, parent = rank & (rank - 1);
    const std::array<std::set<int>, 5> childrenOf{{{1, 2, 4}, {}, {3}, {}, {}}};
    const auto& children = childrenOf[static_cast<std::size_t>(rank)];
    struct Model {
        bool entered = false, over = false;
        std::set<int> parts;
        int results = 0;
    };
    std::array<Model, 4> models; // by number
    std::map<std::int64_t, int> up;
    std::map<std::int64_t, std::set<int>> down;
    dfb::ReductionTable table(rank, 5, [&](int to, const dfb::ReductionKey& key, bool isUp, const Bytes&) {
        fuzz::require(isUp ? rank != 0 && to == parent : children.count(to) == 1, "parts go up, results down");
        fuzz::require(isUp ? ++up[key.number] == 1 : down[key.number].insert(to).second, "each once");
    });
    const std::byte zero{0};
    const Bytes one(&zero, &zero + 1);
    for (int step = 0; step < 100 && in.left() > 0; ++step) {
        const auto what = in.take<std::uint8_t>();
        const std::int64_t number = what / 4 % 4;
        Model& m = models[static_cast<std::size_t>(number)];
        const dfb::ReductionKey key{1, number};
        const auto hasAll = [&] { return m.entered && m.parts.size() == children.size(); };
        const int source = in.take<std::uint8_t>() % 5;
        switch (what % 4) {
        case 0:
            if (m.entered || m.over)
                break; // its contract allows only one call
            m.entered = true;
            table.enter(
                key, one,
                [](const Bytes& a, const Bytes& b) {
                    Bytes both = a;
                    both.append(b.begin(), b.end());
                    return both;
                },
                [&](const Bytes&) { ++m.results; });
            break;
        case 1: {
            const bool canBe = children.count(source) == 1 && (m.over || m.parts.count(source) == 0);
            const bool no = refused([&] { table.receive(source, key, true, one); });
            fuzz::require(no == !canBe, "a part comes from each child, and once");
            if (!no && !m.over)
                m.parts.insert(source);
            break;
        }
        case 2: {
            const bool isKnown = !m.over && (m.entered || !m.parts.empty());
            const bool canBe = rank != 0 && source == parent && isKnown && hasAll();
            const bool no = refused([&] { table.receive(source, key, false, one); });
            fuzz::require(no == !canBe, "a result comes from the parent, after all parts");
            if (!no && isKnown)
                m.over = true;
            break;
        }
        default: table.missing(key); break;
        }
        if (rank == 0 && hasAll())
            m.over = true;
        fuzz::require(m.results == (m.over && m.entered ? 1 : 0), "a result when all is there, and once");
        if (rank != 0)
            fuzz::require(up[number] == (hasAll() ? 1 : 0), "the sum goes up when all is there");
        if (m.over)
            return; // a later part belongs to another reduction
    }
}

// A receiver with three senders, which ask for any number of bytes, but send only what they were granted.
void lender(fuzz::Input in)
{
    constexpr std::uint64_t pool = 600, allowance = pool / 2 / 3;
    std::array<std::uint64_t, 4> granted{}, consumed{};
    std::fill(granted.begin(), granted.end(), allowance);
    d::FlowControl flow(4, pool,
                        {[](int, dfb::Buffer&&) {}, [](int, const d::FlowControl::Request&) {},
                         [&](int source, const d::FlowControl::Credit& credit) {
                             std::uint64_t& its = granted[static_cast<std::size_t>(source)];
                             its = std::max(its, credit.granted);
                         }});
    for (int step = 0; step < 200 && in.left() > 0; ++step) {
        const auto what = in.take<std::uint8_t>();
        const std::size_t source = 1 + what / 2 % 3;
        if (what % 2 == 0) {
            const auto wide = what >= 128;
            const std::uint64_t first = wide ? in.take<std::uint64_t>() : in.take<std::uint8_t>() * 4u;
            const std::uint64_t all = wide ? in.take<std::uint64_t>() : first + in.take<std::uint8_t>();
            refused([&] { flow.requested(static_cast<int>(source), {first, all}); });
        } else {
            const std::uint64_t bytes =
                std::min<std::uint64_t>(in.take<std::uint8_t>(), granted[source] - consumed[source]);
            flow.arrived(bytes);
            consumed[source] += bytes;
            flow.consumed(static_cast<int>(source), bytes);
        }
        std::uint64_t sum = 0;
        for (std::size_t i = 1; i < 4; ++i)
            sum += granted[i] - consumed[i];
        fuzz::require(sum <= pool, "what may be on the way is no more than the pool");
    }
    fuzz::require(flow.peakInboxBytes() <= pool, "the inbox is no more than the pool");
}

// A sender whose receivers grant any number of bytes.
void borrower(fuzz::Input in)
{
    constexpr std::uint64_t pool = 600;
    static const auto memory = dfb::MemoryPool::create(false);
    std::array<std::uint64_t, 3> sent{}, granted{};
    std::fill(granted.begin(), granted.end(), pool / 2 / 2);
    d::FlowControl flow(3, pool,
                        {[&](int to, dfb::Buffer&& message) { sent[static_cast<std::size_t>(to)] += message.size(); },
                         [](int, const d::FlowControl::Request& r) {
                             fuzz::require(r.first > 0 && r.first <= r.all, "a request is for something");
                         },
                         [](int, const d::FlowControl::Credit&) {}});
    std::uint64_t given = 0;
    for (int step = 0; step < 200 && in.left() > 0; ++step) {
        const auto what = in.take<std::uint8_t>();
        const std::size_t to = 1 + what / 4 % 2;
        if (what % 4 < 2) {
            const std::size_t bytes = 1 + in.take<std::uint8_t>() % (pool / 4);
            given += bytes;
            flow.send(static_cast<int>(to), memory->acquire(bytes));
        } else {
            const bool wide = what % 4 == 3;
            d::FlowControl::Credit credit;
            credit.granted = wide ? in.take<std::uint64_t>() : in.take<std::uint16_t>();
            credit.consumed = wide ? in.take<std::uint64_t>() : in.take<std::uint16_t>();
            if (!refused([&] { flow.credited(static_cast<int>(to), credit); }))
                granted[to] = std::max(granted[to], credit.granted);
        }
        fuzz::require(sent[1] <= granted[1] && sent[2] <= granted[2], "nothing is sent beyond what was granted");
        fuzz::require(flow.underWay() <= given, "no more is under way than was given");
    }
}

void jobs(fuzz::Input in)
{
    const std::int64_t count = in.take<std::uint8_t>();
    d::JobShare server, worker;
    server.newFrame();
    worker.newFrame();
    for (int step = 0; step < 60 && in.left() > 0; ++step) {
        const auto what = in.take<std::uint8_t>();
        if (what % 3 == 0) {
            const d::JobRequest request{in.take<std::int64_t>(), in.take<std::int32_t>(), 0};
            refused(
                [&] {
                    const d::JobRange range = server.give(request, 1, 3);
                    fuzz::require(range.begin >= 0 && range.begin <= range.end && range.end <= request.count,
                                  "what is handed out is there");
                },
                dfb::ErrorKind::Disagreement); // about the number of jobs
        } else if (what % 3 == 1) {
            bool asks = false;
            if (const auto job = worker.take(count, 1, 3, asks))
                fuzz::require(*job >= -1 && *job < count, "a job is one that there is");
        } else {
            const d::JobRange range{in.take<std::int64_t>(), in.take<std::int64_t>()};
            refused([&] { worker.receive(range); });
        }
    }
}

void numbers(fuzz::Input in)
{
    d::SequenceWindow window;
    std::set<std::uint32_t> seen;
    std::uint32_t next = 0;
    std::size_t missing = 0;
    for (int step = 0; step < 300 && in.left() > 0; ++step) {
        const auto what = in.take<std::uint8_t>();
        const std::uint32_t number = what < 250 ? next + static_cast<std::uint32_t>(what % 16) - 8u
                                                : next + in.take<std::uint32_t>() % 5000 - 100u;
        const bool isAhead = static_cast<std::int32_t>(number - next) >= 0;
        const bool isNew = isAhead || (number < next && seen.count(number) == 0);
        const bool result = window.arrive(number);
        fuzz::require(result == isNew, "each number is new once");
        if (!isNew)
            continue;
        missing += isAhead ? number - next : 0;
        missing -= isAhead ? 0 : 1;
        seen.insert(number);
        next = isAhead ? number + 1 : next;
        fuzz::require(window.missing() == missing, "what is missing is counted");
    }
}

void header(const std::string& bytes)
{
    refused([&] {
        const d::MessageHeader h = d::readMessageHeader(fuzz::ExactBlocks::copyOf(bytes));
        fuzz::require(h.magic == d::MessageHeader::magicNumber && h.version == d::MessageHeader::formatVersion
                          && h.kind < d::MessageKind::End,
                      "a header is of this version, and of a kind that there is");
    });
}

} // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size)
{
    fuzz::Input in(data, size);
    switch (in.take<std::uint8_t>() % whiches) {
    case Verdict: verdicts(in); break;
    case Agreement: agreements(in); break;
    case Manifest: manifests(in.rest()); break;
    case Reduction: reductions(in); break;
    case Lender: lender(in); break;
    case Borrower: borrower(in); break;
    case Jobs: jobs(in); break;
    case Numbers: numbers(in); break;
    default: header(in.rest()); break;
    }
    return 0;
}

std::vector<std::pair<std::string, std::string>> fuzz::seeds()
{
    std::vector<std::pair<std::string, std::string>> all;
    const auto add = [&](const std::string& name, Which which, const std::string& bytes) {
        all.emplace_back(name, Output().put(which).text(bytes).bytes());
    };
    const auto both = [](const Bytes& a, const Bytes& b) {
        return Output().put(static_cast<std::uint16_t>(a.size())).text(textOf(a)).text(textOf(b)).bytes();
    };
    const auto addTwo = [&](const std::string& name, Which which, const auto& a, const auto& b) {
        const std::string bytes = both(a.bytes(), b.bytes());
        const Input in(bytes);
        require(which == Verdict ? verdicts(in) : agreements(in), "what is good is taken");
        add(name, which, bytes);
    };
    d::Verdict good, bad;
    good.terms.passes = bad.terms.passes = 77;
    good.sums = {{1, 2, 3, 4, 5, 6, 7, 8}};
    bad.error.emplace();
    bad.error->kind = dfb::ErrorKind::TimedOut;
    bad.error->tile = 4;
    bad.error->message = "tile 4";
    bad.figures = {{3, 0.5}};
    addTwo("verdicts", Verdict, good, bad);
    addTwo("verdicts_failed", Verdict, bad, bad);
    bad.error->rank = 3;
    bad.mergeErrors = {{3, 0.5}, {4, 1}};
    addTwo("verdicts_lists", Verdict, bad, bad);
    bad.error->kind = dfb::ErrorKind::MissingInput; // the last that there is
    addTwo("verdicts_missing", Verdict, good, bad);
    const d::Agreement a{true, "width=4\ntiles=8\n", 0}, b{true, "width=4\ntiles=16\n", 1}, c{false, "no", 2};
    addTwo("agreement", Agreement, a, a);
    addTwo("agreement_differs", Agreement, a, b);
    addTwo("agreement_other_items", Agreement, a, d::Agreement{true, "width=4\n", 1});
    addTwo("agreement_wrong", Agreement, a, c);
    const auto input = [](std::int32_t tile, std::uint32_t source, std::uint16_t part) {
        return Output().put(tile).put(source).put(part).bytes();
    };
    add("manifest", Manifest, input(0, 1, 2) + input(4, 1, 2) + input(0, 5, 0));
    add("manifest_of_another", Manifest, input(0, 1, 2) + input(3, 1, 2));
    const auto bytes = [](const std::vector<int>& values) {
        std::string text;
        for (const int value : values)
            text += static_cast<char>(value);
        return text;
    };
    add("reduction_root", Reduction, bytes({0, 0, 0, 1, 1, 1, 2, 1, 4}));
    add("reduction_inner", Reduction, bytes({2, 1, 3, 0, 0, 2, 0}));
    add("reduction_early_result", Reduction, bytes({2, 1, 3, 2, 0, 0, 0}));
    add("reduction_twice", Reduction, bytes({0, 1, 1, 1, 1, 1, 3}));
    add("lender", Lender, bytes({0, 40, 10, 1, 90, 2, 60, 5, 4, 70, 0, 3, 50, 1, 80, 5, 99}));
    add("lender_greedy", Lender,
        Output().put(std::uint8_t{128}).put(~std::uint64_t{0}).put(~std::uint64_t{0}).text(bytes({2, 60, 5})).bytes());
    add("borrower", Borrower, bytes({0, 100, 0, 100, 0, 40, 4, 30, 2, 44, 1, 100, 0, 2, 44, 1, 44, 1}));
    add("borrower_spoilt", Borrower,
        Output().text(bytes({0, 100, 3})).put(~std::uint64_t{0}).put(std::uint64_t{9}).text(bytes({0, 100})).bytes());
    const auto request = [&](std::int64_t count, std::int32_t workers) {
        return Output().put(std::uint8_t{0}).put(count).put(workers).bytes();
    };
    const auto range = [](std::int64_t from, std::int64_t to) {
        return Output().put(std::uint8_t{2}).put(from).put(to).bytes();
    };
    add("jobs", Jobs, bytes({20, 1, 1}) + range(10, 13) + bytes({1, 1}) + range(13, 13) + request(20, 2));
    add("jobs_that_are_not", Jobs, bytes({20, 1, 1}) + range(10, 33) + bytes({1}));
    add("jobs_of_two_counts", Jobs, bytes({20}) + request(20, 2) + request(4, 2));
    add("numbers", Numbers, bytes({8, 9, 8, 7, 8, 11, 5, 6, 8}));
    d::MessageHeader h;
    add("header", Header, Output().put(h).bytes());
    h.magic = d::MessageHeader::magicSwapped;
    add("header_other_byte_order", Header, Output().put(h).bytes());
    h = {};
    h.version = d::MessageHeader::formatVersion - 1;
    add("header_other_version", Header, Output().put(h).bytes());
    return all;
}
