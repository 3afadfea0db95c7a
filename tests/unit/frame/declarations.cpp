// Declarations: what ranks tell owners of their inputs, and what owners know from that.
#include "catch.hpp"

#include <dfb/error.hpp>
#include <dfb/frame/declarations.hpp>

#include <cstddef>
#include <cstdint>
#include <set>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

namespace declarations_cases {

namespace {

using Inputs = std::vector<dfb::TileInput>;
using Known = std::set<std::tuple<int, std::uint32_t, int, int>>; // tile, source, part, rank

constexpr int ranks = 3;
int ownerOf(int tile, int shift = 0) { return (tile + shift) % ranks; }

// All ranks at once. Messages arrive immediately.
struct Ranks {
    dfb::detail::Declarations of[ranks];
    std::vector<std::pair<int, int>> sent; // from, to
    int shift = 0, lastShift = 0;          // of the owners

    // Returns what each owner knows in the end. Ranks from `declaring` on declare nothing, so the frame fails.
    std::vector<Known> frame(const std::vector<Inputs>& inputs, bool lastHolds = true, int declaring = ranks)
    {
        sent.clear();
        for (auto& exchange : of)
            exchange.newFrame(lastHolds, shift != lastShift);
        lastShift = shift;
        for (int rank = 0; rank < declaring; ++rank) {
            std::vector<int> owners;
            const bool isWaiting = of[rank].declare(
                inputs[static_cast<std::size_t>(rank)], rank, [&](int tile) { return ownerOf(tile, shift); },
                [&](int owner, const auto& bytes) {
                    sent.emplace_back(rank, owner);
                    owners.push_back(owner);
                    of[owner].receive(rank, dfb::detail::ByteReader(bytes),
                                      [&](int tile) { return ownerOf(tile, shift) == owner; });
                });
            CHECK(isWaiting == !owners.empty());
            CHECK(of[rank].declared());
            for (std::size_t i = 0; i < owners.size(); ++i)
                CHECK(of[rank].acknowledged(owners[i]) == (i + 1 == owners.size()));
        }
        std::vector<Known> known(ranks);
        for (int rank = 0; rank < ranks && declaring == ranks; ++rank) {
            of[rank].complete();
            for (const auto& input : of[rank].expected()) {
                const bool isNew = known[static_cast<std::size_t>(rank)]
                                       .emplace(input.tile, input.source, input.part, input.rank)
                                       .second;
                CHECK(isNew);
            }
        }
        return known;
    }
};

std::vector<Known> expectedOf(const std::vector<Inputs>& inputs, int shift = 0)
{
    std::vector<Known> known(ranks);
    for (int rank = 0; rank < ranks; ++rank)
        for (const auto& input : inputs[static_cast<std::size_t>(rank)])
            known[static_cast<std::size_t>(ownerOf(input.tile, shift))].emplace(input.tile, input.source, input.part,
                                                                                rank);
    return known;
}

using Sent = std::vector<std::pair<int, int>>;

} // namespace

TEST_CASE("Owners know what was declared, and only what they do not know yet is sent", "[declarations]")
{
    Ranks all;
    std::vector<Inputs> inputs{{{0, 7, 0}, {1, 7, 0}, {5, 7, 1}}, {{1, 8, 0}}, {}};
    CHECK(all.frame(inputs) == expectedOf(inputs));
    CHECK(all.sent == Sent{{0, 1}, {0, 2}});
    CHECK(all.frame(inputs) == expectedOf(inputs));
    CHECK(all.sent.empty());
    inputs[0] = {{5, 7, 1}, {1, 7, 0}, {0, 7, 0}}; // in another order
    CHECK(all.frame(inputs) == expectedOf(inputs));
    CHECK(all.sent.empty());
    inputs[0][0].source = 9; // for one owner
    CHECK(all.frame(inputs) == expectedOf(inputs));
    CHECK(all.sent == Sent{{0, 2}});
    inputs[0].erase(inputs[0].begin()); // that owner gets no more inputs
    CHECK(all.frame(inputs) == expectedOf(inputs));
    CHECK(all.sent == Sent{{0, 2}});
    inputs[2] = {{0, 8, 0}, {1, 8, 0}, {4, 8, 0}, {2, 8, 0}}; // inputs move from one rank to another
    inputs[1].clear();
    CHECK(all.frame(inputs) == expectedOf(inputs));
    CHECK(all.sent == Sent{{2, 0}, {2, 1}}); // and to itself
    inputs = {{}, {}, {}};
    CHECK(all.frame(inputs) == expectedOf(inputs));
    CHECK(all.sent == Sent{{0, 1}, {2, 0}, {2, 1}});
}

TEST_CASE("If tiles have moved, their new owners are told, and the old ones that nothing comes", "[declarations]")
{
    Ranks all;
    const std::vector<Inputs> inputs{{{0, 7, 0}, {1, 7, 0}}, {{1, 8, 0}}, {}};
    all.frame(inputs);
    all.shift = 1;
    CHECK(all.frame(inputs) == expectedOf(inputs, 1));
    CHECK(all.sent == Sent{{0, 1}, {0, 2}, {1, 2}});
    CHECK(all.frame(inputs) == expectedOf(inputs, 1));
    CHECK(all.sent.empty());
    all.shift = 2;
    all.frame(inputs, true, 0); // no rank declares anything
    CHECK(all.frame(inputs) == expectedOf(inputs, 2));
    CHECK(all.sent == Sent{{0, 1}, {0, 2}, {1, 0}, {1, 2}});
    all.shift = 0;
    CHECK(all.frame({{}, {}, {}}) == std::vector<Known>(ranks));
    CHECK(all.sent == Sent{{0, 2}, {1, 0}});
}

TEST_CASE("After a frame that failed everything is declared anew", "[declarations]")
{
    Ranks all;
    std::vector<Inputs> inputs{{{1, 7, 0}}, {{2, 8, 0}}, {{0, 9, 0}}};
    all.frame(inputs);
    std::vector<Inputs> others{{{1, 17, 0}}, {{2, 18, 0}}, {{0, 19, 0}}};
    all.frame(others, true, 2); // two ranks have told owners, not all of which took it
    CHECK(all.frame(others, false) == expectedOf(others));
    CHECK(all.sent == Sent{{0, 1}, {1, 2}, {2, 0}});
    CHECK(all.frame(others) == expectedOf(others));
    CHECK(all.sent.empty());
}

TEST_CASE("Manifests and answers that cannot be are refused", "[declarations]")
{
    dfb::detail::Declarations owner;
    owner.newFrame(true, false);
    const auto outcome = [](const auto& call) -> std::string {
        try {
            call();
        } catch (const dfb::Error& e) {
            return e.what();
        }
        return "fine";
    };
    const auto receive = [&](int tile) {
        dfb::detail::SmallBytes manifest;
        manifest.put(static_cast<std::int32_t>(tile));
        manifest.put(std::uint32_t{7});
        manifest.put(std::uint16_t{0});
        return outcome(
            [&] { owner.receive(1, dfb::detail::ByteReader(manifest), [](int t) { return ownerOf(t) == 0; }); });
    };
    CHECK(receive(4).find("tile of another owner") != std::string::npos);
    CHECK(receive(3) == "fine");
    CHECK(outcome([&] { owner.acknowledged(1); }).find("not sent") != std::string::npos);
    owner.complete();
    CHECK(receive(3).find("after all ranks have declared") != std::string::npos);
}

} // namespace declarations_cases
