// TileTable: an operation that has thrown is not used again in that frame, whatever arrives when.
#include "catch.hpp"

#include <dfb/buffer.hpp>
#include <dfb/frame/declarations.hpp>
#include <dfb/frame/tile_table.hpp>
#include <dfb/image.hpp>

#include <algorithm>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace tile_table_cases {

namespace {

enum Fault { None, InNewFrame, InAdd };

// A stage that throws for the last tile, in the first call of one kind, and counts the calls after that.
struct Stage final : dfb::detail::TileStage {
    Stage(Fault at, int& callsAfter) : fault(at), after(callsAfter) {}

    void pass(Fault call)
    {
        after += hasThrown;
        if (tile == 1 && fault == call && !hasThrown) {
            hasThrown = true;
            throw std::runtime_error("the operation fails");
        }
    }
    void newFrame(const dfb::TileInfo& info) override
    {
        tile = info.tile;
        hasThrown = false;
        pass(InNewFrame);
    }
    void add(dfb::Fragment&&) override { pass(InAdd); }
    bool isComplete() const override { return false; }
    void finish(dfb::FinishedTile&) override { pass(None); }
    dfb::TileReport report() const override { return {}; }

    Fault fault;
    int& after;
    int tile = -1;
    bool hasThrown = false;
};

struct Operations final : dfb::detail::Operations {
    explicit Operations(Fault at, const dfb::detail::OperationTraits& traits = {})
        : dfb::detail::Operations(traits), fault(at)
    {
    }
    std::unique_ptr<dfb::detail::TileStage> makeTile() const override
    {
        ++made;
        return std::make_unique<Stage>(fault, after);
    }
    bool opaqueHides(const dfb::TileInfo&) const override { return false; }
    void process(dfb::PixelTile&) const override {}

    Fault fault;
    mutable int after = 0, made = 0;
};

// When both inputs of the last tile arrive.
enum Time { BeforeDeclare, WhileDeclaring, AfterDeclare, Between, Times };

struct Seen {
    int thrown = 0, ready = 0; // of the last tile
};

// A frame of two tiles; two inputs come for the last one.
Seen frame(dfb::detail::TileTable& table, std::int64_t number, Time time)
{
    Seen seen;
    const auto arrive = [&](std::uint32_t source) {
        dfb::TileHeader header;
        header.frame = number;
        header.tile = 1;
        header.region = table.layout().region(1);
        header.generation = 1;
        header.source = source;
        dfb::detail::TileTable::Arrival arrival;
        try {
            table.arrive(dfb::Fragment(header, dfb::Buffer(), {}), 0, arrival);
        } catch (const std::runtime_error&) {
            ++seen.thrown;
            CHECK(arrival.spoilt);
            table.saidWhy();
        }
        seen.ready += arrival.ready;
    };
    dfb::TileInfo info;
    info.frame = number;
    table.newFrame(info, nullptr);
    dfb::detail::ExpectedInputs expected;
    expected.replace({0}, {{{0, 0, 0}, 0}, {{1, 0, 0}, 0}, {{1, 1, 0}, 0}});
    if (time == BeforeDeclare || time == Between)
        arrive(0);
    if (time == BeforeDeclare)
        arrive(1);
    dfb::ErrorInfo where;
    try {
        table.declare(
            expected, where,
            [&](int tile) {
                if (tile == 0 && time == WhileDeclaring) { // the last tile is not counted yet
                    arrive(0);
                    arrive(1);
                }
            },
            [&](int tile) { seen.ready += tile == 1; });
    } catch (const std::runtime_error&) {
        ++seen.thrown;
        CHECK(where.tile == 1);
    }
    if (time == AfterDeclare)
        arrive(0);
    if (time == AfterDeclare || time == Between)
        arrive(1);
    return seen;
}

} // namespace

TEST_CASE("An operation that has thrown gets no more inputs, and its tile ends once", "[tile_table]")
{
    for (const Fault fault : {InNewFrame, InAdd, None})
        for (int time = BeforeDeclare; time < Times; ++time) {
            CAPTURE(static_cast<int>(fault), time);
            Operations operations(fault);
            const dfb::TileLayout layout(128, 64, 64);
            dfb::detail::TileTable table(
                layout, [](int, const dfb::TileLayout&, int) { return 0; }, 0, 1, operations);
            for (int number = 0; number < 2; ++number) { // the slot is used again in the next frame
                const Seen seen = frame(table, number, static_cast<Time>(time));
                CHECK(seen.thrown == (fault == None ? 0 : 1));
                CHECK(seen.ready == 1);
                CHECK(operations.after == 0);
                CHECK(table.isSpoilt(1) == (fault != None));
                CHECK(table.isSaid());
            }
        }
}

TEST_CASE("The operations of tiles that move away are used for those that come", "[tile_table]")
{
    dfb::detail::OperationTraits traits;
    traits.pixelOpIsPointwise = false; // so tiles without inputs are ready, too
    Operations operations(None, traits);
    const dfb::TileLayout layout(256, 64, 64);
    dfb::detail::TileTable table(
        layout, [](int tile, const dfb::TileLayout&, int) { return tile / 2; }, 0, 2, operations);
    const auto moved = std::make_shared<const std::vector<int>>(std::vector<int>{1, 0, 0, 1});
    const auto same = std::make_shared<const std::vector<int>>(std::vector<int>{1, 0, 0, 1});
    std::int64_t number = 0;
    const auto frame = [&](const dfb::TileOwners& owners, const std::vector<int>& owned) {
        const bool haveMoved = table.setOwners(owners);
        dfb::TileInfo info;
        info.frame = number++;
        table.newFrame(info, nullptr);
        CHECK(table.owned() == owned);
        CHECK(table.ownedByMap() == std::vector<int>{0, 1});
        for (int tile = 0; tile < 4; ++tile)
            CHECK(table.isMine(tile) == (std::find(owned.begin(), owned.end(), tile) != owned.end()));
        dfb::detail::ExpectedInputs expected;
        dfb::ErrorInfo where;
        int ready = 0;
        table.declare(
            expected, where, [](int) {}, [&](int) { ++ready; });
        CHECK(ready == 2);
        return haveMoved;
    };
    CHECK(!frame(nullptr, {0, 1}));
    CHECK(frame(moved, {1, 2}));
    CHECK(!frame(moved, {1, 2}));
    CHECK(!frame(same, {1, 2}));
    CHECK(frame(nullptr, {0, 1}));
    CHECK(operations.made == 2);
}

TEST_CASE("The text about missing inputs stays short, however many there are", "[tile_table]")
{
    Operations operations(None);
    const dfb::TileLayout layout(128, 64, 64);
    dfb::detail::TileTable table(
        layout, [](int, const dfb::TileLayout&, int) { return 0; }, 0, 1, operations);
    table.newFrame({}, nullptr);
    std::vector<dfb::detail::ExpectedInput> inputs;
    for (std::uint32_t source = 0; source < 1000; ++source)
        inputs.push_back({{0, source, 0}, 0});
    dfb::detail::ExpectedInputs expected;
    expected.replace({0}, std::move(inputs));
    dfb::ErrorInfo where;
    table.declare(
        expected, where, [](int) {}, [](int) {});
    const dfb::ErrorInfo missing = table.missing();
    CHECK(missing.tile == 0);
    CHECK(missing.expected == 1000);
    CHECK(missing.message.find(" and 992 more") != std::string::npos);
    CHECK(missing.message.size() < 300);
}

} // namespace tile_table_cases
