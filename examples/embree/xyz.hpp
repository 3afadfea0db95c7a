// XYZ: the readers that make spheres from files of atoms.
#pragma once

#include "elements.hpp"
#include "file_share.hpp"
#include "spheres.hpp"
#include "text.hpp"

#include <algorithm>
#include <cstdint>
#include <limits>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace example {

namespace detail {

// The column of a line that has the element, and the first of the three that have the position.
struct XyzColumns {
    int symbol = 0, place = 1;

    XyzColumns() = default;
    // Extended XYZ says in its comment what the columns are: Properties=name:type:count:...
    explicit XyzColumns(std::string_view comment)
    {
        const std::string_view key = "Properties=";
        const std::size_t at = comment.find(key);
        if (at == comment.npos)
            return;
        comment.remove_prefix(at + key.size());
        if (!comment.empty() && comment[0] == '"')
            comment.remove_prefix(1);
        comment = comment.substr(0, comment.find_first_of(" \t\""));
        symbol = place = -1;
        for (int column = 0; !comment.empty();) {
            const auto part = [&comment] {
                const std::string_view front = comment.substr(0, comment.find(':'));
                comment.remove_prefix(std::min(front.size() + 1, comment.size()));
                return front;
            };
            const std::string_view name = part();
            part();
            int count = 0;
            if (!parseNumber(part(), count) || count < 1 || count > 1000 || column > 1000)
                throw std::runtime_error("expected Properties=name:type:count:... in the comment");
            if (name == "species" && count == 1)
                symbol = column;
            if (name == "pos" && count == 3)
                place = column;
            column += count;
        }
        if (symbol < 0 || place < 0)
            throw std::runtime_error("expected species:S:1 and pos:R:3 among the Properties in the comment");
    }

    // Returns false if the line is not that of an atom. Sets `word` to what the line calls the element.
    bool parse(std::string_view line, Sphere& sphere, std::string_view& word) const
    {
        Vec3d at;
        bool ok = true;
        for (int column = 0; column < std::max(symbol + 1, place + 3); ++column) {
            const std::string_view next = nextWord(line);
            ok = ok && !next.empty();
            if (column == symbol)
                word = next;
            else if (column >= place && column < place + 3)
                ok = ok && parseNumber(next, component(at, column - place));
        }
        sphere.center = toFloat(at);
        const int element = elementNumber(word);
        sphere.radius = atomRadius(element);
        sphere.color = atomColor(element);
        return ok && isUsable(sphere.center);
    }
};

// Counts the words of a file that name no element.
class UnknownElements {
public:
    void add(std::string_view word)
    {
        if (elementNumber(word) != 0)
            return;
        const auto found = counts_.find(word);
        ++(found != counts_.end() ? found : counts_.emplace(word, std::uint64_t{0}).first)->second;
    }
    // Collective: adds what the other ranks have.
    void gather(const Loaders& loaders)
    {
        const std::vector<char> text = loaders.gatherOf<char>([&] {
            std::string own;
            for (const auto& [word, count] : counts_)
                own += word + ' ' + std::to_string(count) + '\n';
            return std::vector<char>(own.begin(), own.end());
        });
        counts_.clear();
        for (TextLines lines(std::string_view(text.data(), text.size())); !lines.atEnd();) {
            std::string_view line = lines.next();
            const std::string word(nextWord(line));
            std::uint64_t count = 0;
            parseNumber(nextWord(line), count);
            counts_[word] += count;
        }
    }
    void note(const std::string& name, Notes* notes) const
    {
        if (notes && !counts_.empty())
            notes->push_back(name + ": unknown elements, which are drawn with the radius of carbon: " + list());
    }

private:
    std::string list() const
    {
        std::string text;
        std::size_t listed = 0;
        for (const auto& [symbol, count] : counts_) {
            if (listed == 6)
                return text + " and " + std::to_string(counts_.size() - listed) + " more";
            text += (listed++ == 0 ? "" : ", ") + symbol.substr(0, 20) + " (" + std::to_string(count) + ")";
        }
        return text;
    }

    std::map<std::string, std::uint64_t, std::less<>> counts_;
};

inline constexpr const char* severalFrames = ": the first of several frames; --xyz-frame takes another";

// Reads the frames of an XYZ file one after the other.
class XyzReader {
public:
    XyzReader(std::string_view bytes, const std::string& name) : size_(bytes.size()), lines_(bytes), name_(name) {}

    // Reads the lines of count and comment of frame `number`. Returns false if there are no more frames.
    bool beginFrame(int number)
    {
        std::string_view line, word;
        do {
            if (number > 1 && lines_.atEnd())
                return false;
            line = lines_.next();
            word = nextWord(line);
        } while (number > 1 && word.empty());
        count_ = 0;
        if (!parseNumber(word, count_) || !nextWord(line).empty() || count_ == 0)
            fail(number == 1 ? "expected the number of atoms, 1 or more"
                             : "expected the end, or the number of atoms of another frame");
        if (count_ > size_ / 8) // the shortest line is "C 0 0 0\n"
            fail("it says " + std::to_string(count_) + " atoms, more than a file of " + std::to_string(size_)
                 + " bytes can hold");
        try {
            columns_ = XyzColumns(lines_.next());
        } catch (const std::runtime_error& wrong) {
            fail(wrong.what());
        }
        return true;
    }

    void skipAtoms()
    {
        for (std::uint64_t i = 0; i < count_; ++i)
            nextAtom(i);
    }

    std::vector<Sphere> readAtoms(Notes* notes)
    {
        std::vector<Sphere> spheres;
        spheres.reserve(static_cast<std::size_t>(count_));
        UnknownElements unknown;
        for (std::uint64_t i = 0; i < count_; ++i) {
            Sphere sphere;
            std::string_view word;
            if (!columns_.parse(nextAtom(i), sphere, word))
                fail("expected 'element x y z' with finite numbers below 1e15");
            unknown.add(word);
            spheres.push_back(sphere);
        }
        unknown.note(name_, notes);
        return spheres;
    }

private:
    [[noreturn]] void fail(const std::string& why) const
    {
        throw std::runtime_error(name_ + ": line " + std::to_string(lines_.number()) + ": " + why);
    }

    std::string_view nextAtom(std::uint64_t before)
    {
        if (lines_.atEnd())
            fail("it ends early: expected " + std::to_string(count_) + " atoms, got " + std::to_string(before));
        return lines_.next();
    }

    std::size_t size_;
    TextLines lines_;
    std::string name_;
    std::uint64_t count_ = 0; // of atoms in this frame
    XyzColumns columns_;
};

} // namespace detail

// Reads frames. Each has a line with the count, a line of comment, and a line `element x y z` per sphere, in Angstrom;
// anything else in a line is skipped. Elements are symbols, in upper or lower case, or numbers. In extended XYZ the
// comment says which columns these are. Takes the frame of this number, from 1; 0: the first, and if there are more,
// `notes` says so. Throws std::runtime_error with `name`, what was expected and what was found. `notes` gets unknown
// elements, too, if not null.
inline std::vector<Sphere> parseXyz(std::string_view bytes, const std::string& name, int frame = 0,
                                    Notes* notes = nullptr)
{
    detail::XyzReader reader(bytes, name);
    const int wanted = std::max(1, frame);
    reader.beginFrame(1);
    for (int number = 1; number < wanted; ++number) {
        reader.skipAtoms();
        if (!reader.beginFrame(number + 1))
            throw std::runtime_error(name + ": expected a frame " + std::to_string(wanted) + ", got "
                                     + std::to_string(number) + (number == 1 ? " frame" : " frames"));
    }
    std::vector<Sphere> spheres = reader.readAtoms(notes);
    if (reader.beginFrame(wanted + 1) && frame == 0 && notes)
        notes->push_back(name + detail::severalFrames);
    return spheres;
}

} // namespace example
