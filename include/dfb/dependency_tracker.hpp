// DependencyTracker: the dependency tree of one tile and pass (section 3.1.1 of the paper). It knows which inputs have
// arrived and which are missing, and finds every contradiction between inputs.
//
// An input is a member of a generation and announces a number of children in the next. The sum of these numbers over
// generation g is the size of generation g + 1. Generation 0 has `rootCount` members. Inputs arrive in any order. The
// tree is complete when every announced input has arrived. One thread at a time may use it.
#pragma once

#include <dfb/error.hpp>
#include <dfb/tile.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

class DependencyTracker {
public:
    DependencyTracker() { reset(); }

    // Forgets everything and expects `rootCount` inputs of generation 0 (the paper's background tile is one).
    void reset(int rootCount = 1)
    {
        generations_.assign(2, {}); // most trees have two generations
        inputs_.clear();
        declared_.clear();
        hasDeclaration_ = false;
        current_ = 0;
        closed_ = false;
        generations_[0].expected = rootCount;
    }

    // An input of generation 1 that will come, and the rank that has said so; -1: not known.
    struct Declared {
        std::uint32_t source = 0;
        std::uint16_t part = 0;
        int rank = -1;
    };

    // Declares generation 1: it will have exactly these (source, part) pairs, each once. For frames with
    // FrameConfig::declared. Call it once, in place of arrive() for the input of generation 0. `Inputs`: a range of
    // Declared, or of structs with these members. Throws as arrive() does, also if an input that was not declared has
    // come already.
    template <class Inputs>
    void declare(const Inputs& inputs)
    {
        declared_.clear();
        for (const auto& input : inputs)
            declared_.push_back({1, input.source, input.part, input.rank, 0});
        std::sort(declared_.begin(), declared_.end(),
                  [](const Input& a, const Input& b) { return a == b ? a.rank < b.rank : a < b; });
        const auto twice = std::adjacent_find(declared_.begin(), declared_.end());
        if (twice != declared_.end())
            failTwice(1, twice->source, twice->part, twice->rank, (twice + 1)->rank);
        hasDeclaration_ = true;
        for (const Input& input : inputs_)
            if (input.generation == 1)
                checkDeclared(input);
        Generation& root = generations_[0];
        if (++root.arrived > root.expected)
            failAt(0, ErrorKind::TooManyInputs, root.expected, root.arrived);
        root.children += static_cast<std::int64_t>(declared_.size());
        advance();
    }

    // Takes note of one input. Throws Error, with generation, source, expected and got, for a negative number of
    // children, a duplicate (generation, source, part), more inputs than announced, and an input of a generation or
    // source that nobody announced. After a throw, call reset(). `rank`: the rank that sent it, if known, for the text
    // of errors.
    void arrive(int generationIndex, std::uint32_t source, std::uint16_t part, int children, int rank = -1)
    {
        const Input input{generationIndex, source, part, rank, children};
        if (generationIndex < 0)
            fail(ErrorKind::UnannouncedInput, 0, source, rank, 0, 0, "the generation is negative");
        if (generationIndex >= maxGenerations)
            fail(ErrorKind::UnannouncedInput, generationIndex, source, rank, maxGenerations, generationIndex,
                 detail::printed("a tree has at most %d generations", maxGenerations));
        if (children < 0)
            fail(ErrorKind::NegativeChildren, generationIndex, source, rank, -1, -1,
                 detail::printed("announced %d children", children));
        const auto place = std::lower_bound(inputs_.begin(), inputs_.end(), input);
        if (place != inputs_.end() && *place == input)
            failTwice(generationIndex, source, part, place->rank, rank);
        if (hasDeclaration_ && generationIndex == 1)
            checkDeclared(input);
        if (closed_ && generationIndex >= current_)
            fail(ErrorKind::UnannouncedInput, generationIndex, source, rank, 0, 1, "no parent announced it");
        const bool isNear = reach(static_cast<std::size_t>(generationIndex));
        inputs_.insert(place, input);
        if (!isNear)
            return; // it is counted when the tree gets there
        Generation& g = generations_[static_cast<std::size_t>(generationIndex)];
        ++g.arrived;
        g.children += children;
        if (generationIndex < current_ || (generationIndex == current_ && g.arrived > g.expected))
            fail(ErrorKind::TooManyInputs, generationIndex, source, rank, g.expected, g.arrived,
                 generationIndex == 0 ? "a pass of a tile has one input of generation 0: is `generation` set?"
                                      : "inputs of the generation before have announced fewer children");
        advance();
    }

    bool complete() const noexcept { return closed_; }
    int arrivedCount() const noexcept { return static_cast<int>(inputs_.size()); }

    // The inputs that the first incomplete generation still waits for.
    struct Missing {
        int generation = 0;
        std::int64_t expected = 0, got = 0;
        std::vector<Declared> inputs; // those that are known, because they were declared
        // Otherwise: the inputs that announced inputs of this generation, and the inputs of this generation that have
        // come.
        std::vector<Declared> announcers, arrived;

        std::string text() const
        {
            return detail::printed("generation %d has %lld of %lld inputs", generation, static_cast<long long>(got),
                                   static_cast<long long>(expected));
        }
    };

    // Empty if nothing is missing.
    std::optional<Missing> missing() const
    {
        if (closed_)
            return std::nullopt;
        const Generation& g = generations_[static_cast<std::size_t>(current_)];
        Missing m{current_, g.expected, g.arrived, {}, {}, {}};
        if (hasDeclaration_ && current_ == 1) {
            for (const Input& input : declared_)
                if (!std::binary_search(inputs_.begin(), inputs_.end(), input))
                    m.inputs.push_back({input.source, input.part, input.rank});
            return m;
        }
        for (const Input& input : inputs_) {
            if (input.generation == current_ - 1 && input.children > 0)
                m.announcers.push_back({input.source, input.part, input.rank});
            else if (input.generation == current_)
                m.arrived.push_back({input.source, input.part, input.rank});
        }
        return m;
    }

    static constexpr int maxGenerations = 1 << 16;

private:
    struct Generation {
        std::int64_t expected = 0, arrived = 0, children = 0;
    };
    struct Input {
        int generation;
        std::uint32_t source;
        std::uint16_t part;
        int rank, children; // not part of its identity
        bool operator==(const Input& o) const
        {
            return generation == o.generation && source == o.source && part == o.part;
        }
        bool operator<(const Input& o) const
        {
            if (generation != o.generation)
                return generation < o.generation;
            return source != o.source ? source < o.source : part < o.part;
        }
    };

    // Makes sure that generations_ has a generation `place`, with the inputs of it that have come. Returns false if it
    // is too far ahead.
    bool reach(std::size_t place)
    {
        const std::size_t before = generations_.size();
        if (place >= before + mostAhead)
            return false;
        if (place < before)
            return true;
        generations_.resize((place / 8 + 1) * 8); // the same memory, whichever of these generations comes first
        for (auto input = firstFrom(static_cast<int>(before)); input != inputs_.end(); ++input) {
            const auto g = static_cast<std::size_t>(input->generation);
            if (g >= generations_.size())
                break;
            ++generations_[g].arrived;
            generations_[g].children += input->children;
        }
        return true;
    }

    // The first input of a generation, or, if it has none, of a later one.
    std::vector<Input>::const_iterator firstFrom(int generation) const
    {
        return std::lower_bound(inputs_.begin(), inputs_.end(), Input{generation, 0, 0, -1, 0});
    }

    // Steps over every complete generation. The next one expects the children that it announced.
    void advance()
    {
        while (!closed_) {
            const Generation done = generations_[static_cast<std::size_t>(current_)];
            if (done.arrived < done.expected)
                return;
            if (done.arrived > done.expected)
                failAt(current_, ErrorKind::TooManyInputs, done.expected, done.arrived);
            reach(static_cast<std::size_t>(++current_));
            generations_[static_cast<std::size_t>(current_)].expected = done.children;
            closed_ = done.children == 0;
            if (!closed_)
                continue;
            if (const auto next = firstFrom(current_); next != inputs_.end())
                failAt(next->generation, ErrorKind::UnannouncedInput, 0,
                       firstFrom(next->generation + 1) - firstFrom(next->generation));
        }
    }

    void checkDeclared(const Input& input) const
    {
        if (!std::binary_search(declared_.begin(), declared_.end(), input))
            fail(ErrorKind::UnannouncedInput, input.generation, input.source, input.rank, 0, 1,
                 detail::printed("its rank did not declare it, part %d", input.part));
    }

    // Names the first input of a generation, if the wrong one cannot be told from the others.
    [[noreturn]] void failAt(int generationIndex, ErrorKind kind, std::int64_t expected, std::int64_t got) const
    {
        const auto first = firstFrom(generationIndex);
        const bool isThere = first != inputs_.end();
        fail(kind, generationIndex, isThere ? first->source : 0, isThere ? first->rank : -1, expected, got, "");
    }

    // Fails because an input came twice: from these ranks, which may be equal; -1: not known.
    [[noreturn]] static void failTwice(int generation, std::uint32_t source, std::uint16_t part, int rank,
                                       int otherRank)
    {
        const int lower = std::min(rank, otherRank), higher = std::max(rank, otherRank);
        std::string text =
            detail::printed("source %u (the id of a brick, or the place of an image in an order)", source);
        if (part > 0)
            text += detail::printed(" part %d", part);
        if (lower < 0 || lower == higher)
            text += higher < 0 ? " comes twice" : detail::printed(" comes twice from rank %d", higher);
        else
            text +=
                detail::printed(" comes from rank %d and from rank %d: it may be that of one rank only", lower, higher);
        fail(ErrorKind::DuplicateInput, generation, source, higher, 1, 2, std::move(text));
    }

    [[noreturn]] static void fail(ErrorKind kind, int generationIndex, std::uint32_t source, int rank,
                                  std::int64_t expected, std::int64_t got, std::string message)
    {
        ErrorInfo info = detail::errorInfo(kind, std::move(message));
        info.from = rank;
        info.generation = generationIndex;
        info.source = source;
        info.expected = expected;
        info.got = got;
        throw Error(std::move(info));
    }

    // The most generations that one input may add, so that a wrong one cannot take all memory.
    static constexpr std::size_t mostAhead = 64;

    std::vector<Generation> generations_; // the first generations
    std::vector<Input> inputs_;           // sorted; may have later generations than generations_
    std::vector<Input> declared_;         // sorted
    bool hasDeclaration_ = false;
    int current_ = 0; // the first generation that is not complete
    bool closed_ = false;
};

DFB_NAMESPACE_END
