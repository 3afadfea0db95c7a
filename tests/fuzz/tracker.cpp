// Compares DependencyTracker with a model that looks at all inputs anew each time. The tracker must be complete exactly
// if the model is, and must give an error exactly if the inputs cannot be part of any tree.
//
// An input: how many roots, then a byte for what comes next, and what belongs to it.
#include "fuzz.hpp"

#include <dfb/dependency_tracker.hpp>

#include <algorithm>
#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <tuple>
#include <utility>
#include <vector>

namespace {

using Names = std::vector<dfb::DependencyTracker::Declared>;

// All inputs so far. `State::contradicts` says that no tree can have them.
class Model {
public:
    explicit Model(int rootCount) : rootCount_(rootCount) {}

    // Returns false if the input is invalid by itself.
    bool arrive(int generation, std::uint32_t source, std::uint16_t part, int children)
    {
        if (generation < 0 || generation >= dfb::DependencyTracker::maxGenerations || children < 0
            || !inputs_.emplace(generation, source, part).second)
            return false;
        arrived_[generation] += 1;
        children_[generation] += children;
        return true;
    }
    bool declare(const Names& names)
    {
        declared_.emplace();
        for (const auto& name : names)
            declared_->emplace(name.source, name.part);
        arrived_[0] += 1;
        children_[0] += static_cast<std::int64_t>(names.size());
        return declared_->size() == names.size();
    }

    struct State {
        bool contradicts = false, complete = false;
        int generation = 0; // the first incomplete one
        std::int64_t expected = 0, got = 0;
    };
    State state() const
    {
        State s;
        for (const auto& [generation, source, part] : inputs_)
            s.contradicts = s.contradicts || (declared_ && generation == 1 && declared_->count({source, part}) == 0);
        std::int64_t expected = rootCount_;
        for (int generation = 0;; ++generation) {
            s.generation = generation;
            s.expected = expected;
            s.got = of(arrived_, generation);
            if (generation > 0 && expected == 0) { // the tree ends here
                s.complete = true;
                s.contradicts = s.contradicts || (!arrived_.empty() && arrived_.rbegin()->first >= generation);
                return s;
            }
            if (s.got != expected) {
                s.contradicts = s.contradicts || s.got > expected;
                return s;
            }
            expected = of(children_, generation);
        }
    }

private:
    static std::int64_t of(const std::map<int, std::int64_t>& map, int generation)
    {
        const auto found = map.find(generation);
        return found == map.end() ? 0 : found->second;
    }

    int rootCount_;
    std::set<std::tuple<int, std::uint32_t, std::uint16_t>> inputs_;
    std::map<int, std::int64_t> arrived_, children_; // by generation
    std::optional<std::set<std::pair<std::uint32_t, std::uint16_t>>> declared_;
};

enum What : std::uint8_t { Arrive, ArriveWide, Declare, Reset, whats };

} // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size)
{
    fuzz::Input in(data, size);
    int roots = 1 + in.take<std::uint8_t>() % 3;
    dfb::DependencyTracker tracker;
    tracker.reset(roots);
    Model model(roots);
    bool declared = false;
    int count = 0;
    for (int step = 0; step < 300 && in.left() > 0; ++step) {
        const auto what = in.take<std::uint8_t>() % whats;
        bool canBe = true;
        std::optional<dfb::ErrorInfo> error;
        Names names;
        int generation = 0, children = 0;
        std::uint32_t source = 0;
        std::uint16_t part = 0;
        if (what == Arrive) { // small numbers, so that inputs collide
            const auto a = in.take<std::uint8_t>(), b = in.take<std::uint8_t>();
            generation = a % 5;
            children = a / 5 % 4;
            source = b % 8;
            part = static_cast<std::uint16_t>(b / 8 % 2);
        } else if (what == ArriveWide) {
            generation = in.take<std::int32_t>();
            source = in.take<std::uint32_t>();
            part = in.take<std::uint16_t>();
            children = in.take<std::int32_t>();
        } else if (what == Declare) {
            if (std::exchange(declared, true))
                continue; // its contract allows only one call
            for (int left = in.take<std::uint8_t>() % 8; left > 0; --left) {
                const auto b = in.take<std::uint8_t>();
                names.push_back({b % 8u, static_cast<std::uint16_t>(b / 8 % 2)});
            }
        } else {
            roots = 1 + in.take<std::uint8_t>() % 3;
            tracker.reset(roots);
            model = Model(roots);
            declared = false;
            count = 0;
            continue;
        }
        try {
            if (what == Declare) {
                canBe = model.declare(names);
                tracker.declare(names);
            } else {
                canBe = model.arrive(generation, source, part, children);
                ++count;
                tracker.arrive(generation, source, part, children);
            }
        } catch (const dfb::Error& e) {
            error = e.info();
        }
        const Model::State state = model.state();
        fuzz::require(error.has_value() == (!canBe || state.contradicts), "an error exactly when no tree can have it");
        if (error) {
            using Kind = dfb::ErrorKind;
            fuzz::require(error->kind == Kind::TooManyInputs || error->kind == Kind::DuplicateInput
                              || error->kind == Kind::UnannouncedInput || error->kind == Kind::NegativeChildren,
                          "the error is of a tree");
            roots = 1; // an error ends its use until reset()
            tracker.reset(roots);
            model = Model(roots);
            declared = false;
            count = 0;
            continue;
        }
        fuzz::require(tracker.complete() == state.complete, "complete exactly when the model says so");
        fuzz::require(tracker.arrivedCount() == count, "all that came is counted");
        const auto missing = tracker.missing();
        fuzz::require(missing.has_value() != state.complete, "something is missing unless it is complete");
        if (missing)
            fuzz::require(missing->generation == state.generation && missing->expected == state.expected
                              && missing->got == state.got,
                          "what is missing is what the model misses");
    }
    return 0;
}

std::vector<std::pair<std::string, std::string>> fuzz::seeds()
{
    const auto arrive = [](int generation, int children, int source, int part = 0) {
        return Output()
            .put(Arrive)
            .put(static_cast<std::uint8_t>(generation + 5 * children))
            .put(static_cast<std::uint8_t>(source + 8 * part))
            .bytes();
    };
    const auto wide = [](std::int32_t generation, std::uint32_t source, std::uint16_t part, std::int32_t children) {
        return Output().put(ArriveWide).put(generation).put(source).put(part).put(children).bytes();
    };
    const auto declare = [](const std::vector<std::uint8_t>& names) {
        Output out;
        out.put(Declare).put(static_cast<std::uint8_t>(names.size()));
        for (const std::uint8_t name : names)
            out.put(name);
        return out.bytes();
    };
    const std::string one(1, '\0'), two(1, '\1');
    return {{"root_alone", one + arrive(0, 0, 3)},
            {"root_and_children", one + arrive(0, 2, 3) + arrive(1, 0, 1) + arrive(1, 0, 2)},
            {"children_first", one + arrive(1, 0, 1) + arrive(2, 0, 5) + arrive(1, 1, 2) + arrive(0, 2, 3)},
            {"two_roots", two + arrive(0, 0, 3) + arrive(0, 1, 4) + arrive(1, 0, 1)},
            {"too_many", one + arrive(1, 0, 1) + arrive(1, 0, 2) + arrive(1, 0, 3) + arrive(0, 2, 3)},
            {"twice", one + arrive(1, 0, 1) + arrive(1, 0, 1)},
            {"after_the_end", one + arrive(0, 0, 3) + arrive(1, 0, 1)},
            {"declared", one + declare({1, 9, 2}) + arrive(1, 0, 1) + arrive(1, 0, 1, 1) + arrive(1, 0, 2)},
            {"declared_late", one + arrive(1, 1, 1) + arrive(2, 0, 6) + declare({1})},
            {"not_declared", one + arrive(1, 0, 4) + declare({1, 2})},
            {"declared_twice", one + declare({1, 1})},
            {"declared_nothing", one + declare({})},
            {"last_generation", one + wide(65535, 7, 0, 0) + wide(65536, 7, 0, 0)},
            {"negative", one + wide(0, 7, 0, -1) + wide(-1, 7, 0, 0)},
            {"many_children", one + wide(0, 7, 0, 2) + wide(1, 7, 0, 2147483647) + wide(1, 8, 0, 2147483647)},
            {"chain", one + arrive(0, 1, 0) + arrive(1, 1, 1) + arrive(2, 1, 2) + arrive(3, 1, 3) + arrive(4, 0, 4)},
            {"again", one + arrive(0, 0, 3) + std::string("\3\0", 2) + arrive(0, 1, 3) + arrive(1, 0, 3)}};
}
