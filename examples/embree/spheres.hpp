// Spheres: the atoms of a molecule, and the reader that makes them from XYZ files.
#pragma once

#include "elements.hpp"
#include "text.hpp"
#include "vec.hpp"

#include <cstdint>
#include <map>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace example {

struct Sphere {
    Vec3 center;
    float radius = 0;
    Vec3 color; // linear RGB
};

// For Loaders::fromFirst().
template <class Function>
void arraysOf(std::vector<Sphere>& spheres, const Function& function)
{
    function(spheres);
}

namespace detail {

// Reads the frames of an XYZ file one after the other.
class XyzReader {
public:
    XyzReader(std::string_view bytes, const std::string& name) : size_(bytes.size()), lines_(bytes), name_(name) {}

    // The lines of count and comment. False if there are no more frames; `number` is that of this one.
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
        readComment(lines_.next());
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
        std::map<std::string, std::uint64_t, std::less<>> unknown;
        for (std::uint64_t i = 0; i < count_; ++i) {
            std::string_view line = nextAtom(i), symbol;
            Vec3d at;
            bool ok = true;
            for (int column = 0; column < std::max(symbolColumn_ + 1, placeColumn_ + 3); ++column) {
                const std::string_view word = nextWord(line);
                ok = ok && !word.empty();
                if (column == symbolColumn_)
                    symbol = word;
                else if (column >= placeColumn_ && column < placeColumn_ + 3)
                    ok = ok && parseNumber(word, component(at, column - placeColumn_));
            }
            Sphere sphere;
            sphere.center = rounded(at);
            if (!ok || !isUsable(sphere.center))
                fail("expected 'element x y z' with finite numbers below 1e15");
            const int element = elementNumber(symbol);
            sphere.radius = atomRadius(element);
            sphere.color = atomColor(element);
            if (element == 0) {
                const auto found = unknown.find(symbol);
                ++(found != unknown.end() ? found : unknown.emplace(symbol, std::uint64_t{0}).first)->second;
            }
            spheres.push_back(sphere);
        }
        if (notes && !unknown.empty())
            notes->push_back(name_
                             + ": unknown elements, which are drawn with the radius of carbon: " + listOf(unknown));
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

    // Extended XYZ says in its comment what the columns are: Properties=name:type:count:...
    void readComment(std::string_view comment)
    {
        symbolColumn_ = 0;
        placeColumn_ = 1;
        const std::string_view key = "Properties=";
        const std::size_t at = comment.find(key);
        if (at == comment.npos)
            return;
        comment.remove_prefix(at + key.size());
        if (!comment.empty() && comment[0] == '"')
            comment.remove_prefix(1);
        comment = comment.substr(0, comment.find_first_of(" \t\""));
        symbolColumn_ = placeColumn_ = -1;
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
                fail("expected Properties=name:type:count:... in the comment");
            if (name == "species" && count == 1)
                symbolColumn_ = column;
            if (name == "pos" && count == 3)
                placeColumn_ = column;
            column += count;
        }
        if (symbolColumn_ < 0 || placeColumn_ < 0)
            fail("expected species:S:1 and pos:R:3 among the Properties in the comment");
    }

    static std::string listOf(const std::map<std::string, std::uint64_t, std::less<>>& symbols)
    {
        std::string text;
        std::size_t listed = 0;
        for (const auto& [symbol, count] : symbols) {
            if (listed == 6)
                return text + " and " + std::to_string(symbols.size() - listed) + " more";
            text += (listed++ == 0 ? "" : ", ") + symbol.substr(0, 20) + " (" + std::to_string(count) + ")";
        }
        return text;
    }

    std::size_t size_;
    TextLines lines_;
    std::string name_;
    std::uint64_t count_ = 0;                // of atoms in this frame
    int symbolColumn_ = 0, placeColumn_ = 1; // the latter is that of x
};

} // namespace detail

// Frames of a line with the count, a line of comment, and a line `element x y z` per sphere, in Angstrom; what else is
// in a line is skipped. Elements are symbols, in upper or lower case, or numbers. In extended XYZ the comment says
// which columns these are. Takes the frame of this number, from 1; 0: the first, and if there are more, `notes` says
// so. Throws std::runtime_error with `name`, what was expected and what was found. `notes` gets unknown elements, too,
// if not null.
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
        notes->push_back(name + ": the first of several frames; --xyz-frame takes another");
    return spheres;
}

} // namespace example
