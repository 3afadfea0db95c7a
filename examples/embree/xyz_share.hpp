// The shares of an XYZ file that ranks read together, each some of the lines.
#pragma once

#include "xyz.hpp"

namespace example {

namespace detail {

class XyzShares {
public:
    explicit XyzShares(const std::string& path, const Loaders& loaders) : path_(path), loaders_(loaders) {}

    // Reads frame number `wanted`, from 1; returns nothing if that fails. Sets `isOneOfMore` if another frame follows.
    std::optional<SphereShare> read(int wanted, bool& isOneOfMore, UnknownElements& unknown)
    {
        std::uint64_t lines = 0;
        if (!loaders_.isOnAll([&] {
                size_ = fileSize(path_);
                bytes_ = readLinesOfShare(path_, 0, size_, loaders_);
                lines = countLines(bytes_);
                return true;
            }))
            return std::nullopt;
        begins_ = loaders_.beginsOf(lines);
        next_ = begins_[static_cast<std::size_t>(loaders_.rank())];
        left_ = TextLines(bytes_);
        std::uint64_t at = 0;
        std::optional<SphereShare> share;
        for (int number = 1; number <= wanted + 1; ++number) {
            const Header header = headerAt(at, number == 1);
            if (header.line == none && share)
                return share; // there is no other frame
            if (header.line == none || header.count == 0 || header.count > size_ / 8
                || (number <= wanted && header.count + 2 > begins_.back() - header.line))
                return std::nullopt;
            XyzColumns columns;
            if (!columnsAt(header.line + 1, columns))
                return std::nullopt;
            at = header.line + 2 + header.count;
            if (number == wanted) {
                share.emplace();
                if (!loaders_.isOnAll([&] { return parse(header, columns, *share, unknown); }))
                    return std::nullopt;
                share->first = loaders_.beginsOf(share->spheres.size())[static_cast<std::size_t>(loaders_.rank())];
            }
        }
        isOneOfMore = true;
        return share;
    }

private:
    static constexpr std::uint64_t none = std::numeric_limits<std::uint64_t>::max();

    // A line with the number of atoms. A count of 0: the line has no number.
    struct Header {
        std::uint64_t line = none, count = 0;
    };

    // Skips this rank's lines before that line.
    void goTo(std::uint64_t line)
    {
        for (; next_ < line && !left_.atEnd(); ++next_)
            left_.next();
    }

    // Collective: the header on that line, or on the first line after it that is not empty.
    Header headerAt(std::uint64_t at, bool isThere)
    {
        const std::vector<Header> found = loaders_.gatherOf<Header>([&] {
            goTo(at);
            std::uint64_t line = next_;
            for (TextLines lines = left_; !lines.atEnd(); ++line) {
                std::string_view text = lines.next();
                const std::string_view word = nextWord(text);
                if (word.empty() && !isThere)
                    continue;
                Header header{line, 0};
                if (!parseNumber(word, header.count) || !nextWord(text).empty())
                    header.count = 0;
                return std::vector<Header>{header};
            }
            return std::vector<Header>{Header()};
        });
        Header first;
        for (const Header& header : found)
            if (header.line < first.line)
                first = header;
        return first;
    }

    // Collective: takes the columns from the comment on that line. Returns false if it is wrong.
    bool columnsAt(std::uint64_t at, XyzColumns& columns)
    {
        const std::vector<XyzColumns> found = loaders_.gatherOf<XyzColumns>([&] {
            goTo(at);
            std::vector<XyzColumns> own;
            if (next_ == at && !left_.atEnd()) {
                own.emplace_back();
                try {
                    TextLines lines = left_;
                    own.back() = XyzColumns(lines.next());
                } catch (const std::runtime_error&) { // the reader of the whole file reports it
                    own.back().symbol = -1;
                }
            }
            return own;
        });
        columns = found.empty() ? XyzColumns() : found.front();
        return columns.symbol >= 0;
    }

    // This rank's atoms of a frame.
    bool parse(const Header& header, const XyzColumns& columns, SphereShare& share, UnknownElements& unknown)
    {
        goTo(header.line + 2);
        for (const std::uint64_t end = header.line + 2 + header.count; next_ < end && !left_.atEnd(); ++next_) {
            Sphere sphere;
            std::string_view word;
            if (!columns.parse(left_.next(), sphere, word))
                return false;
            unknown.add(word);
            share.spheres.push_back(sphere);
        }
        return true;
    }

    std::string path_;
    const Loaders& loaders_;
    std::uint64_t size_ = 0;
    std::string bytes_;
    std::vector<std::uint64_t> begins_;              // number of each rank's first line
    TextLines left_ = TextLines(std::string_view()); // of this rank's lines
    std::uint64_t next_ = 0;                         // number of the first of these
};

} // namespace detail

// Collective: the same as parseXyz(), but each rank reads a share of the lines. Returns nothing, on all ranks, if
// anything is wrong; parseXyz() of the whole file then says what.
inline std::optional<SphereShare> readXyzShare(const std::string& path, int frame, const Loaders& loaders, Notes* notes)
{
    bool isOneOfMore = false;
    detail::UnknownElements unknown;
    std::optional<SphereShare> share = detail::XyzShares(path, loaders).read(std::max(1, frame), isOneOfMore, unknown);
    if (!share)
        return share;
    unknown.gather(loaders);
    unknown.note(path, notes);
    if (isOneOfMore && frame == 0 && notes)
        notes->push_back(path + detail::severalFrames);
    return share;
}

} // namespace example
