// Collective calls that ranks make over a mailbox: allReduce() and allGather(). Each is one reduction, whose parts name
// the call, so that ranks with different calls learn of it.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/comm/mailbox.hpp>
#include <dfb/comm/message.hpp>

#include <cstddef>
#include <cstdint>
#include <functional>
#include <string>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// Begins this rank's part of a call, with the rank and the call's name. A combined part has the lowest rank; or -1
// and a text, if the ranks have made different calls.
inline SmallBytes partOf(const Mailbox& mailbox, const std::string& call)
{
    SmallBytes out;
    out.put(static_cast<std::int32_t>(mailbox.rank()));
    out.putText(call);
    return out;
}

// Reduces the ranks' parts of a call. `combine(a, b, out)` combines the bytes after the call's name in two parts;
// `read` gets these bytes in the combined part of all ranks. Throws InvalidArgument if the ranks have made
// different calls.
inline void reduceParts(Mailbox& mailbox, SmallBytes&& mine,
                        std::function<void(ByteReader&, ByteReader&, SmallBytes&)> combine,
                        FunctionRef<void(ByteReader&)> read)
{
    const SmallBytes all =
        mailbox.reduce(std::move(mine), [combine = std::move(combine)](const SmallBytes& a, const SmallBytes& b) {
            ByteReader as(a), bs(b);
            const auto rankA = as.get<std::int32_t>(), rankB = bs.get<std::int32_t>();
            if (rankA < 0 || rankB < 0)
                return rankA < 0 ? a : b;
            const std::string callA = as.getText(), callB = bs.getText();
            SmallBytes out;
            if (callA == callB) {
                out.put(rankA);
                out.putText(callA);
                combine(as, bs, out);
            } else {
                out.put(std::int32_t{-1});
                out.putText(printed("rank %d calls %s, rank %d %s: all ranks must make the same calls", rankA,
                                    callA.c_str(), rankB, callB.c_str()));
            }
            return out;
        });
    ByteReader in(all);
    const auto first = in.get<std::int32_t>();
    std::string call = in.getText();
    if (first < 0) {
        mailbox.connection().throwIfFailed(); // after a time-out, ranks make different calls
        throw InvalidArgument(errorInfo(ErrorKind::InvalidArgument, std::move(call)),
                              mailbox.connection().throwByAll());
    }
    read(in);
    in.end();
}

// Combines `values` element by element over all ranks. `how`: the operation's name. Collective. Waits and throws as
// Mailbox::reduce(), and InvalidArgument on all ranks if they make different calls.
template <class Operation>
std::vector<std::int64_t> allReduce(Mailbox& mailbox, const std::vector<std::int64_t>& values, const char* how,
                                    Operation operation)
{
    SmallBytes mine;
    std::vector<std::int64_t> reduced;
    mailbox.makePart([&] {
        mine = partOf(mailbox, printed("allReduce() of %zu values to their %s", values.size(), how));
        for (const std::int64_t value : values)
            mine.put(value);
        reduced.resize(values.size());
    });
    const auto combine = [operation](ByteReader& a, ByteReader& b, SmallBytes& out) {
        while (a.left() > 0) {
            const auto x = a.get<std::int64_t>(), y = b.get<std::int64_t>();
            out.put(operation(x, y));
        }
    };
    reduceParts(mailbox, std::move(mine), combine, [&](ByteReader& in) {
        for (std::int64_t& value : reduced)
            value = in.get<std::int64_t>();
    });
    return reduced;
}

// Returns the bytes of each rank, indexed by rank; their sizes may differ. Collective. Waits and throws as
// allReduce().
inline std::vector<std::vector<std::byte>> allGather(Mailbox& mailbox, const std::vector<std::byte>& own,
                                                     const char* call)
{
    SmallBytes mine; // the call; then, for each rank: its number, the size, the bytes
    mailbox.makePart([&] {
        mine = partOf(mailbox, call);
        mine.put(static_cast<std::int32_t>(mailbox.rank()));
        mine.put(static_cast<std::uint64_t>(own.size()));
        mine.append(own.data(), own.data() + own.size());
    });
    const auto combine = [](ByteReader& a, ByteReader& b, SmallBytes& out) {
        a.copyTo(out);
        b.copyTo(out);
    };
    std::vector<std::vector<std::byte>> result;
    reduceParts(mailbox, std::move(mine), combine, [&](ByteReader& in) {
        for (int from = 0; from < mailbox.size(); ++from) { // they were combined in this order
            const auto whose = in.get<std::int32_t>();
            const auto byteCount = in.get<std::uint64_t>();
            in.require(whose == from && byteCount <= in.left());
            result.emplace_back(static_cast<std::size_t>(byteCount));
            in.getBytes(result.back().data(), result.back().size());
        }
    });
    return result;
}

} // namespace detail
DFB_NAMESPACE_END
