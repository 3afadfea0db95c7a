// ErrorInfo: how its one-line description names ranks, and that all of it can be sent.
#include "catch.hpp"

#include <dfb/comm/message.hpp>
#include <dfb/error.hpp>

#include <string>

namespace error_cases {

namespace {

dfb::ErrorInfo infoOf(dfb::ErrorKind kind, int rank, int from, int generation = -1)
{
    dfb::ErrorInfo info;
    info.kind = kind;
    info.rank = rank;
    info.from = from;
    info.generation = generation;
    info.message = "so it is";
    return info;
}

} // namespace

TEST_CASE("A rank that only noticed does not read like the culprit", "[error]")
{
    using Kind = dfb::ErrorKind;
    const auto text = [](Kind kind, int rank, int from, int generation = -1) {
        return infoOf(kind, rank, from, generation).describe();
    };
    // Errors for which `rank` is where it went wrong.
    CHECK(text(Kind::UserCode, 3, -1) == "dfb: exception in user code: rank 3: so it is");
    CHECK(text(Kind::UserCode, 3, 1) == "dfb: exception in user code: rank 3, in a message from rank 1: so it is");
    CHECK(text(Kind::Cancelled, 3, -1) == "dfb: frame cancelled: rank 3: so it is");
    CHECK(text(Kind::InvalidArgument, 3, -1) == "dfb: invalid argument: rank 3: so it is");
    CHECK(text(Kind::Transport, 3, -1) == "dfb: transport failure: rank 3: so it is");
    // Errors for which `rank` only noticed it.
    CHECK(text(Kind::TimedOut, 3, -1) == "dfb: timed out: noticed by rank 3: so it is");
    CHECK(text(Kind::TimedOut, 3, 1) == "dfb: timed out: noticed by rank 3, waiting for rank 1: so it is");
    CHECK(text(Kind::TimedOut, 3, 1, 2)
          == "dfb: timed out: noticed by rank 3, announced by rank 1, generation 2: so it is");
    CHECK(text(Kind::Transport, 3, 1) == "dfb: transport failure: noticed by rank 3, waiting for rank 1: so it is");
    CHECK(text(Kind::MalformedMessage, 3, 1)
          == "dfb: malformed message: noticed by rank 3, in a message from rank 1: so it is");
    for (const Kind kind : {Kind::TooManyInputs, Kind::DuplicateInput, Kind::UnannouncedInput, Kind::NegativeChildren})
        CHECK(text(kind, 3, 1) == std::string("dfb: ") + toString(kind) + ": noticed by rank 3, from rank 1: so it is");
    CHECK(text(Kind::Disagreement, -1, -1) == "dfb: ranks disagree: so it is");
}

TEST_CASE("All of an error travels", "[error]")
{
    dfb::ErrorInfo info = infoOf(dfb::ErrorKind::DuplicateInput, 3, 1, 2);
    info.frame = 4, info.tile = 5, info.pass = 6, info.source = 7, info.expected = 8, info.got = 9;
    dfb::detail::SmallBytes out;
    put(out, info);
    dfb::detail::ByteReader in(out);
    const dfb::ErrorInfo back = dfb::detail::getErrorInfo(in);
    in.end();
    CHECK(back.describe() == info.describe());
    CHECK(back.from == 1);
}

} // namespace error_cases
