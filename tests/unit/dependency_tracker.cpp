// DependencyTracker: every order in which the inputs of small trees can arrive, and every way in which a tree can be
// wrong.
#include "catch.hpp"

#include <dfb/dependency_tracker.hpp>

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <optional>
#include <random>
#include <string>
#include <tuple>
#include <vector>

#include <sys/resource.h>

namespace dependency_tracker_cases {

namespace {

struct Input {
    int generation;
    std::uint32_t source;
    std::uint16_t part;
    int children;
};
using Tree = std::vector<Input>;
using Names = std::vector<dfb::DependencyTracker::Declared>;

struct Shape {
    const char* name;
    int rootCount;
    Tree inputs;
};

const std::vector<Shape>& shapes()
{
    static const std::vector<Shape> all{
        {"a root alone", 1, {{0, 9, 0, 0}}},
        {"1 + 1", 1, {{0, 9, 0, 1}, {1, 0, 0, 0}}},
        {"1 + 3", 1, {{0, 9, 0, 3}, {1, 0, 0, 0}, {1, 1, 0, 0}, {1, 2, 0, 0}}},
        {"1 + 6, two parts a source",
         1,
         {{0, 9, 0, 6}, {1, 0, 0, 0}, {1, 0, 1, 0}, {1, 1, 0, 0}, {1, 1, 1, 0}, {1, 2, 0, 0}, {1, 2, 1, 0}}},
        {"two roots, one of which announces all",
         2,
         {{0, 8, 0, 0}, {0, 9, 0, 3}, {1, 0, 0, 0}, {1, 1, 0, 0}, {1, 2, 0, 0}}},
        {"a chain of 6", 1, {{0, 0, 0, 1}, {1, 0, 0, 1}, {2, 0, 0, 1}, {3, 0, 0, 1}, {4, 0, 0, 1}, {5, 0, 0, 0}}},
        {"a list by generation, other sources", 1, {{0, 9, 0, 1}, {1, 3, 0, 1}, {2, 1, 0, 1}, {3, 2, 0, 0}}},
        {"uneven",
         1,
         {{0, 9, 0, 2}, {1, 0, 0, 3}, {1, 1, 0, 0}, {2, 0, 0, 0}, {2, 1, 0, 1}, {2, 2, 0, 0}, {3, 5, 0, 0}}},
        {"wide in the middle", 1, {{0, 9, 0, 1}, {1, 0, 0, 3}, {2, 1, 0, 0}, {2, 2, 0, 1}, {2, 3, 0, 0}, {3, 4, 0, 0}}},
        // A generation's announcements count together: 1 announces nothing itself, and 0 announces 1's children, too.
        {"children announced by another's parent",
         1,
         {{0, 9, 0, 2}, {1, 0, 0, 4}, {1, 1, 0, 0}, {2, 0, 0, 0}, {2, 0, 1, 0}, {2, 1, 0, 0}, {2, 1, 1, 0}}},
    };
    return all;
}

// Calls f(order) for all orders of 0 .. count - 1.
template <class F>
void forAllOrders(std::size_t count, const F& f)
{
    std::vector<std::size_t> order(count);
    std::iota(order.begin(), order.end(), std::size_t{0});
    do
        f(order);
    while (std::next_permutation(order.begin(), order.end()));
}

void arrive(dfb::DependencyTracker& tracker, const Input& i)
{
    tracker.arrive(i.generation, i.source, i.part, i.children);
}

// The error of the first arrival that throws, if any. `complete` is the tracker's state after the last arrival.
struct Run {
    std::optional<dfb::ErrorInfo> error;
    std::size_t arrivals = 0; // arrivals that did not throw
    bool complete = false;
};

Run run(const Tree& tree, const std::vector<std::size_t>& order)
{
    Run result;
    dfb::DependencyTracker tracker;
    for (std::size_t i : order) {
        try {
            arrive(tracker, tree[i]);
        } catch (const dfb::Error& e) {
            result.error = e.info();
            return result;
        }
        ++result.arrivals;
        result.complete = tracker.complete();
    }
    return result;
}

// The peak memory of this process.
long peakKiB()
{
    rusage usage{};
    getrusage(RUSAGE_SELF, &usage);
    return usage.ru_maxrss;
}

} // namespace

TEST_CASE("A tree is complete at its last arrival and not before, in every order", "[tracker]")
{
    for (const Shape& shape : shapes()) {
        INFO(shape.name);
        std::size_t orders = 0, wrong = 0;
        dfb::DependencyTracker tracker;
        forAllOrders(shape.inputs.size(), [&](const std::vector<std::size_t>& order) {
            ++orders;
            tracker.reset(shape.rootCount); // reused, as the framebuffer does
            bool fine = !tracker.complete() && tracker.missing() && tracker.arrivedCount() == 0;
            for (std::size_t k = 0; k < order.size(); ++k) {
                arrive(tracker, shape.inputs[order[k]]);
                const bool last = k + 1 == order.size();
                fine = fine && tracker.complete() == last && !tracker.missing() == last
                       && tracker.arrivedCount() == static_cast<int>(k + 1);
            }
            wrong += fine ? 0 : 1;
        });
        std::size_t expected = 1;
        for (std::size_t n = 2; n <= shape.inputs.size(); ++n)
            expected *= n;
        CHECK(orders == expected);
        CHECK(wrong == 0);
    }
}

TEST_CASE("A tree with one input missing stays incomplete and says where", "[tracker]")
{
    for (const Shape& shape : shapes())
        for (std::size_t absent = 0; absent < shape.inputs.size(); ++absent) {
            const Input& gone = shape.inputs[absent];
            std::size_t wrong = 0;
            std::string example;
            forAllOrders(shape.inputs.size(), [&](const std::vector<std::size_t>& order) {
                if (order.back() != absent)
                    return;
                dfb::DependencyTracker tracker;
                tracker.reset(shape.rootCount);
                bool early = false;
                for (std::size_t k = 0; k + 1 < order.size(); ++k) {
                    arrive(tracker, shape.inputs[order[k]]);
                    early = early || tracker.complete();
                }
                const std::string text = tracker.missing() ? tracker.missing()->text() : "";
                const std::string generation = "generation " + std::to_string(gone.generation) + " has ";
                if (early || text.compare(0, generation.size(), generation) != 0) {
                    ++wrong;
                    example = text;
                }
            });
            INFO(shape.name << ", without input " << absent << ": " << example);
            CHECK(wrong == 0);
        }
    dfb::DependencyTracker tracker;
    tracker.arrive(0, 7, 0, 3);
    tracker.arrive(1, 4, 0, 0);
    REQUIRE(tracker.missing());
    CHECK(tracker.missing()->text() == "generation 1 has 1 of 3 inputs");
    CHECK(tracker.missing()->inputs.empty());
}

TEST_CASE("One leaf too many is an error in every order", "[tracker]")
{
    for (const Shape& shape : shapes()) {
        if (shape.rootCount != 1)
            continue;
        int leaves = 0;
        for (const Input& i : shape.inputs)
            leaves = std::max(leaves, i.generation);
        Tree tree = shape.inputs;
        const auto expected =
            std::count_if(tree.begin(), tree.end(), [&](const Input& i) { return i.generation == leaves; });
        tree.push_back({leaves, 77, 3, 0});
        std::size_t wrong = 0;
        std::string example;
        forAllOrders(tree.size(), [&](const std::vector<std::size_t>& order) {
            const Run r = run(tree, order);
            const bool isLeaf =
                r.error && std::any_of(tree.begin(), tree.end(), [&](const Input& i) {
                    return i.generation == leaves && static_cast<std::int64_t>(i.source) == r.error->source;
                });
            // Which input is the surplus one cannot be told, but it is one of that generation.
            if (!isLeaf || r.error->kind != dfb::ErrorKind::TooManyInputs || r.error->generation != leaves
                || r.error->expected != expected || r.error->got != expected + 1) {
                ++wrong;
                example = r.error ? r.error->describe() : "no error";
            }
        });
        INFO(shape.name << ": " << example);
        CHECK(wrong == 0);
    }
}

TEST_CASE("One inner input too many never passes unnoticed", "[tracker]")
{
    for (const Shape& shape : shapes()) {
        if (shape.rootCount != 1 || shape.inputs.size() > 6)
            continue;
        for (int children : {0, 1, 2})
            for (int generation = 0; generation < 3; ++generation) {
                Tree tree = shape.inputs;
                tree.push_back({generation, 77, 0, children});
                // With its announced children this would be another valid tree if its generation had room for it, but
                // it has not.
                std::size_t unnoticed = 0;
                forAllOrders(tree.size(), [&](const std::vector<std::size_t>& order) {
                    const Run r = run(tree, order);
                    // Only counts decide: there is an error, or, if the surplus input announced more, the tree waits
                    // for them.
                    const bool noticed = r.error ? r.error->kind == dfb::ErrorKind::TooManyInputs
                                                       || r.error->kind == dfb::ErrorKind::UnannouncedInput
                                                 : !r.complete;
                    unnoticed += noticed ? 0 : 1;
                });
                INFO(shape.name << ", one more in generation " << generation << " with " << children << " children");
                CHECK(unnoticed == 0);
            }
    }
}

TEST_CASE("A duplicate is an error in every order, also after completion", "[tracker]")
{
    for (const Shape& shape : shapes()) {
        if (shape.inputs.size() > 6 || shape.rootCount != 1)
            continue;
        for (std::size_t twice = 0; twice < shape.inputs.size(); ++twice) {
            Tree tree = shape.inputs;
            tree.push_back(tree[twice]);
            const Input& culprit = tree[twice];
            std::size_t wrong = 0;
            std::string example;
            forAllOrders(tree.size(), [&](const std::vector<std::size_t>& order) {
                const Run r = run(tree, order);
                if (!r.error || r.error->kind != dfb::ErrorKind::DuplicateInput
                    || r.error->generation != culprit.generation || r.error->source != culprit.source
                    || r.error->expected != 1 || r.error->got != 2) {
                    ++wrong;
                    example = r.error ? r.error->describe() : "no error";
                }
            });
            INFO(shape.name << ", input " << twice << " twice: " << example);
            CHECK(wrong == 0);
        }
    }
}

TEST_CASE("An input of a generation that nobody announced is an error in every order", "[tracker]")
{
    for (const Shape& shape : shapes()) {
        if (shape.inputs.size() > 6 || shape.rootCount != 1)
            continue;
        int leaves = 0;
        for (const Input& i : shape.inputs)
            leaves = std::max(leaves, i.generation);
        for (int beyond : {1, 2, 5}) {
            Tree tree = shape.inputs;
            tree.push_back({leaves + beyond, 42, 1, 0});
            std::size_t wrong = 0;
            std::string example;
            forAllOrders(tree.size(), [&](const std::vector<std::size_t>& order) {
                const Run r = run(tree, order);
                if (!r.error || r.error->kind != dfb::ErrorKind::UnannouncedInput
                    || r.error->generation != leaves + beyond || r.error->source != 42 || r.error->expected != 0
                    || r.error->got != 1 || r.arrivals + 1 != tree.size()) {
                    ++wrong;
                    example = r.error ? r.error->describe() : "no error";
                }
            });
            INFO(shape.name << ", " << beyond << " beyond: " << example);
            CHECK(wrong == 0);
        }
    }
}

TEST_CASE("Negative children and impossible generations are errors at once", "[tracker]")
{
    const auto errorOf = [](int generation, int children) {
        dfb::DependencyTracker tracker;
        try {
            tracker.arrive(generation, 5, 2, children);
        } catch (const dfb::Error& e) {
            return e.info();
        }
        return dfb::ErrorInfo{};
    };
    const dfb::ErrorInfo negative = errorOf(3, -4);
    CHECK(negative.kind == dfb::ErrorKind::NegativeChildren);
    CHECK(negative.generation == 3);
    CHECK(negative.source == 5);
    CHECK(negative.message.find("-4") != std::string::npos);
    CHECK(errorOf(-1, 0).kind == dfb::ErrorKind::UnannouncedInput);
    const dfb::ErrorInfo far = errorOf(dfb::DependencyTracker::maxGenerations, 0);
    CHECK(far.kind == dfb::ErrorKind::UnannouncedInput);
    CHECK(far.expected == dfb::DependencyTracker::maxGenerations);
    CHECK(far.got == dfb::DependencyTracker::maxGenerations);
    CHECK(far.source == 5);

    // Sums of children above 32 bits do not wrap around.
    dfb::DependencyTracker tracker;
    tracker.arrive(0, 0, 0, 2);
    tracker.arrive(1, 0, 0, 2147483647);
    tracker.arrive(1, 1, 0, 2147483647);
    CHECK_FALSE(tracker.complete());
    REQUIRE(tracker.missing());
    CHECK(tracker.missing()->text() == "generation 2 has 0 of 4294967294 inputs");
}

TEST_CASE("Generations may come in any order, however far from each other", "[tracker]")
{
    constexpr int count = 3000;
    std::vector<int> order(count);
    std::iota(order.begin(), order.end(), 0);
    const auto fine = [&](bool isClosed) {
        dfb::DependencyTracker tracker;
        for (int run = 0; run < 2; ++run) { // reused, as the framebuffer does
            tracker.reset();
            for (std::size_t i = 0; i < order.size(); ++i) {
                if (tracker.complete())
                    return false;
                tracker.arrive(order[i], static_cast<std::uint32_t>(i), 0, order[i] + 1 < count);
            }
            if (tracker.complete() != isClosed)
                return false;
        }
        return true;
    };
    CHECK(fine(true));
    std::reverse(order.begin(), order.end());
    CHECK(fine(true));
    std::mt19937 random(1);
    for (int i = 0; i < 20; ++i) {
        std::shuffle(order.begin(), order.end(), random);
        CHECK(fine(true));
    }
    order.erase(std::find(order.begin(), order.end(), count / 2));
    CHECK(fine(false));
}

TEST_CASE("An input that is far from all others takes no memory for those between", "[tracker]")
{
    constexpr int last = dfb::DependencyTracker::maxGenerations - 1;
    std::vector<dfb::DependencyTracker> trackers(100);
    const long before = peakKiB();
    for (auto& tracker : trackers)
        tracker.arrive(last, 7, 0, 1);
    CHECK(peakKiB() - before < 50000); // a third of what they would take otherwise
    for (auto& tracker : trackers) {
        try {
            tracker.arrive(0, 1, 0, 0);
            FAIL("nobody announced it");
        } catch (const dfb::Error& e) {
            CHECK(e.info().kind == dfb::ErrorKind::UnannouncedInput);
            CHECK(e.info().source == 7);
            CHECK(e.info().generation == last);
            CHECK(e.info().got == 1);
        }
    }
}

TEST_CASE("Declared inputs: any order of declaration and arrivals completes at the last", "[tracker]")
{
    const Names declared{{3, 0, 5}, {1, 0}, {1, 1}, {8, 0}};
    // Number 4 is the declaration.
    std::size_t wrong = 0;
    forAllOrders(5, [&](const std::vector<std::size_t>& order) {
        dfb::DependencyTracker tracker;
        bool fine = true;
        for (std::size_t k = 0; k < order.size(); ++k) {
            if (order[k] == 4)
                tracker.declare(declared);
            else
                tracker.arrive(1, declared[order[k]].source, declared[order[k]].part, 0);
            fine = fine && tracker.complete() == (k + 1 == order.size());
        }
        wrong += fine ? 0 : 1;
    });
    CHECK(wrong == 0);

    dfb::DependencyTracker nothing;
    nothing.declare(Names{});
    CHECK(nothing.complete());

    dfb::DependencyTracker tracker;
    tracker.declare(declared);
    tracker.arrive(1, 1, 1, 0);
    const auto missing = tracker.missing();
    REQUIRE(missing);
    CHECK(missing->text() == "generation 1 has 1 of 4 inputs");
    std::vector<std::tuple<std::uint32_t, std::uint16_t, int>> absent;
    for (const auto& input : missing->inputs)
        absent.emplace_back(input.source, input.part, input.rank);
    CHECK(absent == decltype(absent){{1, 0, -1}, {3, 0, 5}, {8, 0, -1}});
}

TEST_CASE("Declared inputs: what was not declared, declared twice, or comes twice", "[tracker]")
{
    const Names declared{{1, 0}, {2, 0}};
    // All orders of the declaration (0), the two declared inputs (1, 2) and the culprit (3).
    const auto errors = [&](const Input& culprit) {
        std::vector<dfb::ErrorInfo> result;
        forAllOrders(4, [&](const std::vector<std::size_t>& order) {
            dfb::DependencyTracker tracker;
            try {
                for (std::size_t step : order) {
                    if (step == 0)
                        tracker.declare(declared);
                    else if (step < 3)
                        tracker.arrive(1, declared[step - 1].source, declared[step - 1].part, 0);
                    else
                        arrive(tracker, culprit);
                }
            } catch (const dfb::Error& e) {
                result.push_back(e.info());
            }
        });
        return result;
    };
    const auto allAre = [&](const Input& culprit, dfb::ErrorKind kind, std::int64_t expected, std::int64_t got) {
        const auto found = errors(culprit);
        const bool all = std::all_of(found.begin(), found.end(), [&](const dfb::ErrorInfo& e) {
            UNSCOPED_INFO(e.describe());
            return e.kind == kind && e.generation == culprit.generation && e.expected == expected && e.got == got
                   && e.source == culprit.source;
        });
        return found.size() == 24 && all;
    };
    CHECK(allAre({1, 7, 0, 0}, dfb::ErrorKind::UnannouncedInput, 0, 1)); // a source that nobody declared
    CHECK(allAre({1, 2, 1, 0}, dfb::ErrorKind::UnannouncedInput, 0, 1)); // a part that nobody declared
    CHECK(allAre({1, 2, 0, 0}, dfb::ErrorKind::DuplicateInput, 1, 2));
    CHECK(allAre({2, 2, 0, 0}, dfb::ErrorKind::UnannouncedInput, 0, 1)); // a generation that nobody announced
    // The declaration is the root. If a second root comes first it closes the tree, and the next input is blamed.
    const auto roots = errors({0, 2, 0, 0});
    CHECK(roots.size() == 24);
    CHECK(std::all_of(roots.begin(), roots.end(), [](const dfb::ErrorInfo& e) {
        return (e.kind == dfb::ErrorKind::TooManyInputs && e.generation == 0 && e.expected == 1 && e.got == 2)
               || (e.kind == dfb::ErrorKind::UnannouncedInput && e.generation == 1);
    }));
    dfb::DependencyTracker rootFirst;
    rootFirst.arrive(0, 2, 0, 0);
    CHECK_THROWS_AS(rootFirst.declare(Names{}), dfb::Error);

    dfb::DependencyTracker tracker;
    try {
        tracker.declare(Names{{4, 0, 2}, {5, 0, 2}, {4, 0, 1}});
        FAIL("declared twice");
    } catch (const dfb::Error& e) {
        CHECK(e.info().kind == dfb::ErrorKind::DuplicateInput);
        CHECK(e.info().source == 4);
        CHECK(e.info().generation == 1);
        CHECK(e.info().expected == 1);
        CHECK(e.info().got == 2);
        CHECK(e.info().message.find("comes from rank 1 and from rank 2") != std::string::npos);
    }
}

TEST_CASE("What is missing of a tree that nobody declared: who announced it, and who has come", "[tracker]")
{
    dfb::DependencyTracker tracker;
    tracker.arrive(1, 4, 0, 2, 1);
    tracker.arrive(0, 7, 0, 2, 5);
    REQUIRE(tracker.missing());
    REQUIRE(tracker.missing()->announcers.size() == 1);
    CHECK(tracker.missing()->announcers[0].source == 7);
    CHECK(tracker.missing()->announcers[0].rank == 5);
    REQUIRE(tracker.missing()->arrived.size() == 1);
    CHECK(tracker.missing()->arrived[0].source == 4);
    CHECK(tracker.missing()->arrived[0].rank == 1);
    tracker.arrive(1, 3, 0, 0, 2); // announces nothing
    REQUIRE(tracker.missing());
    CHECK(tracker.missing()->generation == 2);
    REQUIRE(tracker.missing()->announcers.size() == 1);
    CHECK(tracker.missing()->announcers[0].source == 4);
    CHECK(tracker.missing()->arrived.empty());
}

TEST_CASE("An input that comes twice: from which ranks", "[tracker]")
{
    const auto textOf = [](int first, int second) {
        dfb::DependencyTracker tracker;
        tracker.arrive(1, 7, 2, 0, first);
        try {
            tracker.arrive(1, 7, 2, 0, second);
        } catch (const dfb::Error& e) {
            CHECK(e.info().kind == dfb::ErrorKind::DuplicateInput);
            CHECK(e.info().from == std::max(first, second));
            return e.info().message;
        }
        return std::string("nothing");
    };
    const std::string source = "source 7 (the id of a brick, or the place of an image in an order) part 2";
    const std::string two = source + " comes from rank 1 and from rank 4: it may be that of one rank only";
    CHECK(textOf(1, 4) == two);
    CHECK(textOf(4, 1) == two); // whichever came first
    CHECK(textOf(4, 4) == source + " comes twice from rank 4");
    CHECK(textOf(-1, -1) == source + " comes twice");
}

} // namespace dependency_tracker_cases
