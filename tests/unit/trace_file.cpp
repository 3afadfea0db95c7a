// TraceFile: which events it keeps, which it counts when it is full, and that it begins anew after writing.
#include "catch.hpp"

#include <dfb/trace_file.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <locale>
#include <map>
#include <set>
#include <string>
#include <vector>

namespace trace_file_cases {

namespace {

using Bytes = std::vector<std::byte>;

// A rank of a job in which nobody else is: what others give to allGather() is there already.
struct LoneRank {
    int number = 0;
    std::vector<Bytes> ofOthers{};    // the parts of the ranks after it
    Bytes given{};                    // the last that was not empty
    dfb::TraceFile* traced = nullptr; // gets an event at each call
    std::size_t turn = 0;             // of ofOthers: they give theirs one after the other, after this rank

    int rank() const { return number; }
    int size() const { return number + 1 + static_cast<int>(ofOthers.size()); }
    std::vector<Bytes> allGather(const Bytes& mine)
    {
        if (traced)
            traced->add({});
        std::vector<Bytes> all(static_cast<std::size_t>(size()));
        const auto own = all.begin() + number;
        *own = mine;
        if (!mine.empty())
            given = mine;
        else if (!given.empty() && turn < ofOthers.size()) {
            *(own + 1 + static_cast<std::ptrdiff_t>(turn)) = ofOthers[turn];
            ++turn;
        }
        return all;
    }
};

void addEvents(dfb::TraceFile& trace, int count)
{
    for (int i = 0; i < count; ++i)
        trace.add({});
}

// What has been written to the file, which is removed.
struct Written {
    explicit Written(const std::string& path)
    {
        std::ifstream file(path);
        const std::string text{std::istreambuf_iterator<char>(file), {}};
        std::remove(path.c_str());
        const std::string dropped = "\"dropped\": ";
        if (const auto at = text.find(dropped); at != std::string::npos)
            missing = std::stoi(text.substr(at + dropped.size()));
        for (auto at = text.find("\"ph\": \"X\""); at != std::string::npos; at = text.find("\"ph\": \"X\"", at + 1))
            ++spans;
    }
    int missing = -1, spans = 0;
};

} // namespace

TEST_CASE("A trace file keeps what it has room for and counts the rest", "[trace]")
{
    const std::string path = "trace_file_full.json";
    dfb::TraceFile trace(3);
    LoneRank rank;
    addEvents(trace, 3);
    trace.write(rank, path);
    Written all(path);
    CHECK(all.spans == 3);
    CHECK(all.missing == 0);

    // However often it has been written, it keeps no more.
    for (int time = 0; time < 3; ++time) {
        addEvents(trace, 3 + 4);
        trace.write(rank, path);
        const Written full(path);
        CHECK(full.spans == 3);
        CHECK(full.missing == 4);
    }

    // While it writes there is room for the events of that call: 20 exchanges to compare clocks, before it gives its
    // own.
    addEvents(trace, 3);
    rank.traced = &trace;
    trace.write(rank, path);
    Written writing(path);
    CHECK(writing.spans == 3 + 20);
    CHECK(writing.missing == 0);
}

TEST_CASE("A trace file says how many events of all ranks are missing", "[trace]")
{
    dfb::TraceFile first(2), second(5);
    addEvents(first, 5);
    addEvents(second, 12);
    LoneRank other{1};
    second.write(other, "trace_file_of_no_rank.json");
    CHECK(Written("trace_file_of_no_rank.json").missing == -1); // rank 0 writes
    LoneRank rank{0, {other.given}};
    first.write(rank, "trace_file_of_two.json");
    const Written written("trace_file_of_two.json");
    CHECK(written.spans == 2 + 5);
    CHECK(written.missing == 3 + 7);
}

TEST_CASE("A trace file that cannot be written is an error that says why", "[trace]")
{
    dfb::TraceFile trace(1);
    LoneRank rank;
    CHECK_THROWS_AS(trace.write(rank, "no such folder/trace.json"), dfb::InvalidArgument);
    CHECK_THROWS_WITH(trace.write(rank, "no such folder/trace.json"),
                      "dfb: invalid argument: no such folder/trace.json: cannot be written: No such file or "
                      "directory");
}

// Groups digits, as the locale of a program with windows may do.
struct Grouping : std::numpunct<char> {
    char do_thousands_sep() const override { return ','; }
    std::string do_grouping() const override { return "\3"; }
};

TEST_CASE("Parts of a frame are in its row, and numbers are of no locale", "[trace]")
{
    using Kind = dfb::TraceEvent::Kind;
    dfb::TraceFile trace;
    const auto at = [](int us) { return dfb::TraceEvent::Clock::time_point(std::chrono::microseconds(us)); };
    const auto add = [&](Kind kind, std::int64_t frame, int begin, int end) {
        trace.add({kind, 0, at(begin), at(end), frame});
    };
    add(Kind::Frame, 7007, 0, 10);
    add(Kind::Render, 7007, 0, 4);
    add(Kind::Frame, 7008, 2, 30); // in flight with the other
    add(Kind::Render, 7008, 2, 12);
    add(Kind::End, 7008, 12, 30);
    add(Kind::Verdict, 7008, 14, 28);
    LoneRank rank;
    const std::string path = "trace_file_rows.json";
    const std::locale before = std::locale::global(std::locale(std::locale(), new Grouping));
    trace.write(rank, path);
    std::locale::global(before);
    std::ifstream file(path);
    std::map<std::string, std::set<std::string>> rows; // of each frame
    for (std::string line; std::getline(file, line);)
        if (const auto tid = line.find("\"tid\": "), frame = line.find("\"frame\": "); frame != std::string::npos)
            rows[line.substr(frame + 9, 4)].insert(line.substr(tid + 7, 1));
    file.close();
    std::remove(path.c_str());
    CHECK(rows == std::map<std::string, std::set<std::string>>{{"7007", {"0"}}, {"7008", {"1"}}});
}

} // namespace trace_file_cases
