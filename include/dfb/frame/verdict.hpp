// Verdict: the content of the reduction that ends each frame. It says whether any rank failed and which error all ranks
// report, and has the figures of the frame that are sums or maxima over the ranks. Agreement: the content of the
// reduction with which a framebuffer is made; it says whether all ranks have the same configuration.
#pragma once

#include <dfb/comm/byte_io.hpp>
#include <dfb/comm/mailbox.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/frame_terms.hpp>
#include <dfb/frame/operations.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cxxabi.h>
#include <exception>
#include <iterator>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// Makes a record of an exception. `where` fills in the fields that the exception does not set.
inline ErrorInfo errorInfoOf(const std::exception_ptr& reason, const ErrorInfo& where)
{
    ErrorInfo info;
    try {
        std::rethrow_exception(reason);
    } catch (const Error& e) {
        info = e.info();
    } catch (const std::exception& e) {
        info.kind = ErrorKind::UserCode;
        info.message = e.what();
    } catch (...) {
        info.kind = ErrorKind::UserCode;
        info.message = "an exception that is not a std::exception";
    }
    const auto fill = [](std::int64_t& to, std::int64_t from) { to = to < 0 ? from : to; };
    if (info.from < 0)
        info.from = where.from;
    fill(info.tile, where.tile);
    fill(info.pass, where.pass);
    fill(info.generation, where.generation);
    fill(info.source, where.source);
    if (!where.message.empty())
        info.message += (info.message.empty() ? "" : ", ") + where.message;
    return info;
}

// Whether an error says that something has not come.
inline bool isMissing(ErrorKind kind) noexcept
{
    return kind == ErrorKind::TimedOut || kind == ErrorKind::MissingInput;
}

struct Verdict {
    std::optional<ErrorInfo> error;
    FrameTerms terms;      // the parameters of begin(), which should be the same on all ranks
    std::string differing; // which of them differ, in words
    enum Sum {
        BytesSent,
        MessagesSent,
        TilesTouched,
        NonFinitePixels,
        LateMessages,
        RepeatedMessages,
        OrderUndefinedPixels,
        AlphaOutsidePixels, // outside [0, 1]
        CompressedLinks,
        InputsLeft,      // sent, less those that have come
        TilesEndedEarly, // finished before all their inputs had come
        sumCount
    };
    enum Maximum { PeakMemoryBytes, RenderNs, PeakInboxBytes, TotalNs, maximumCount };
    std::array<std::int64_t, sumCount> sums{};
    std::array<std::int64_t, maximumCount> maxima{};
    double wireErrorBound = 0;            // a maximum
    std::vector<Figure> tileErrors;       // by tile; each tile is of one rank
    std::vector<Figure> figures;          // by key; sums
    std::vector<Figure> mergeErrors;      // by tile; sums
    std::vector<std::int32_t> incomplete; // tiles of a partial frame that their owners have not finished

    SmallBytes bytes() const
    {
        ByteWriter out;
        out.put(static_cast<std::uint8_t>(error.has_value()));
        if (error)
            put(out, *error);
        out.put(terms);
        out.putText(differing);
        out.put(sums);
        out.put(maxima);
        out.put(wireErrorBound);
        for (const auto* list : {&tileErrors, &figures, &mergeErrors}) {
            out.put(static_cast<std::uint32_t>(list->size()));
            for (const Figure& figure : *list)
                out.put(figure);
        }
        out.put(static_cast<std::uint32_t>(incomplete.size()));
        for (const std::int32_t tile : incomplete)
            out.put(tile);
        return out.bytes();
    }

    static Verdict from(const SmallBytes& bytes)
    {
        ByteReader in(bytes);
        Verdict v;
        const auto failed = in.get<std::uint8_t>();
        in.require(failed <= 1);
        if (failed)
            v.error = getErrorInfo(in);
        v.terms = in.get<FrameTerms>();
        v.differing = in.getText();
        v.sums = in.get<decltype(v.sums)>();
        v.maxima = in.get<decltype(v.maxima)>();
        v.wireErrorBound = in.get<double>();
        for (auto* list : {&v.tileErrors, &v.figures, &v.mergeErrors})
            for (auto left = in.get<std::uint32_t>(); left > 0; --left) {
                const auto figure = in.get<Figure>();
                in.require(list->empty() || list->back().key < figure.key);
                list->push_back(figure);
            }
        for (auto left = in.get<std::uint32_t>(); left > 0; --left) {
            v.incomplete.push_back(in.get<std::int32_t>());
            in.require(v.incomplete.back() >= 0);
        }
        in.end();
        return v;
    }

    // Whether all tiles that it names are in the image.
    bool fits(int tileCount) const
    {
        const auto count = static_cast<std::uint64_t>(tileCount);
        return (tileErrors.empty() || tileErrors.back().key < count)
               && (mergeErrors.empty() || mergeErrors.back().key < count) && incomplete.size() <= count
               && std::all_of(incomplete.begin(), incomplete.end(), [=](auto tile) { return tile < tileCount; });
    }

    // Sets the figures of `report` that are the same on all ranks.
    void addTo(FrameReport& report) const
    {
        report.bytesSent = sums[BytesSent];
        report.messagesSent = sums[MessagesSent];
        report.tilesTouched = sums[TilesTouched];
        report.nonFinitePixels = sums[NonFinitePixels];
        report.lateMessages = sums[LateMessages];
        report.repeatedMessages = sums[RepeatedMessages];
        report.peakMemoryBytes = maxima[PeakMemoryBytes];
        report.renderMsMax = static_cast<double>(maxima[RenderNs]) / 1e6;
        report.peakInboxBytes = maxima[PeakInboxBytes];
        report.orderUndefinedPixels = sums[OrderUndefinedPixels];
        report.alphaOutsidePixels = sums[AlphaOutsidePixels];
        report.compressedLinks = sums[CompressedLinks];
        report.wireErrorBound = wireErrorBound;
        report.mergeErrorBound = 0;
        for (const Figure& f : mergeErrors)
            report.mergeErrorBound = std::max(report.mergeErrorBound, f.value);
        report.tileErrors.clear();
        for (const Figure& f : tileErrors)
            report.tileErrors.push_back({static_cast<int>(f.key), f.value});
        report.figures = figures;
        report.failure = error;
        report.tilesIncomplete = static_cast<std::int64_t>(incomplete.size());
    }

    // Merges two lists that are ordered by key, and adds the values of equal keys.
    static std::vector<Figure> merged(const std::vector<Figure>& a, const std::vector<Figure>& b)
    {
        std::vector<Figure> all;
        all.reserve(a.size() + b.size());
        std::merge(a.begin(), a.end(), b.begin(), b.end(), std::back_inserter(all),
                   [](const Figure& x, const Figure& y) { return x.key < y.key; });
        return summed(std::move(all));
    }
    // Adds the values of equal keys in a list that is ordered by key.
    static std::vector<Figure> summed(std::vector<Figure> all)
    {
        std::size_t count = 0;
        for (std::size_t i = 0; i < all.size(); ++i) {
            if (count > 0 && all[count - 1].key == all[i].key)
                all[count - 1].value += all[i].value;
            else
                all[count++] = all[i];
        }
        all.resize(count);
        return all;
    }

    // `what`: which parameters differ, or "" if only the hashes are known to differ.
    static ErrorInfo disagreement(const std::string& what = "")
    {
        ErrorInfo info;
        info.kind = ErrorKind::Disagreement;
        info.message = what.empty() ? "the frame was begun with different parameters"
                                    : what + ": it must be the same on all ranks";
        return info;
    }

    // The error of inputs that came when their tiles were finished: another input may have been taken in their place.
    // Nothing can be said if a tile was finished early, since its inputs may be late, too.
    std::optional<ErrorInfo> strayInputs() const
    {
        const std::int64_t count = sums[TilesEndedEarly] == 0 ? sums[InputsLeft] : 0;
        if (count == 0)
            return std::nullopt;
        ErrorInfo info;
        info.kind = ErrorKind::Disagreement;
        info.expected = 0;
        info.got = count;
        info.message = "more inputs were sent than had been announced: so many came when their tiles were finished";
        return info;
    }

    // How much an error says about why the frame failed: more is better.
    static int weight(const ErrorInfo& e)
    {
        if (e.kind == ErrorKind::Cancelled)
            return 0;
        if (e.kind == ErrorKind::Disagreement)
            return 5;
        return !isMissing(e.kind) ? 4 : e.tile >= 0 ? 3 : e.expected >= 0 ? 2 : 1;
    }

    // Picks the error that all ranks report: the one that says most; of equal ones one that says which rank is waited
    // for; then that of the lowest rank. Texts about missing inputs are joined.
    static ErrorInfo chosen(const ErrorInfo& a, const ErrorInfo& b)
    {
        constexpr std::size_t mostText = 2000;
        const auto order = [](const ErrorInfo& e) {
            const int w = weight(e);
            return std::make_tuple(-w, (w == 1 || w == 2) && e.from < 0, e.rank);
        };
        const bool second = order(b) < order(a);
        ErrorInfo info = second ? b : a;
        const ErrorInfo& other = second ? a : b;
        if (weight(a) == 3 && weight(b) == 3 && a.rank != b.rank && info.message.size() < mostText)
            info.message += printed("; on rank %d: %s", other.rank, other.message.c_str());
        return info;
    }

    static SmallBytes combine(const SmallBytes& first, const SmallBytes& second)
    {
        Verdict a = from(first);
        const Verdict b = from(second);
        if (b.error)
            a.error = a.error ? chosen(*a.error, *b.error) : *b.error;
        if (a.differing.empty())
            a.differing = !b.differing.empty() ? b.differing : a.terms.difference(b.terms);
        if (!a.differing.empty())
            a.error = disagreement(a.differing); // other errors follow from it
        for (std::size_t i = 0; i < a.sums.size(); ++i)
            a.sums[i] = static_cast<std::int64_t>(static_cast<std::uint64_t>(a.sums[i])
                                                  + static_cast<std::uint64_t>(b.sums[i]));
        for (std::size_t i = 0; i < a.maxima.size(); ++i)
            a.maxima[i] = std::max(a.maxima[i], b.maxima[i]);
        a.wireErrorBound = std::max(a.wireErrorBound, b.wireErrorBound);
        a.tileErrors = merged(a.tileErrors, b.tileErrors);
        a.figures = merged(a.figures, b.figures);
        a.mergeErrors = merged(a.mergeErrors, b.mergeErrors);
        for (const std::int32_t tile : b.incomplete) // each tile has one owner
            a.incomplete.push_back(tile);
        return a.bytes();
    }
};

// The configuration of one rank, or its error. Combined: whether all are right and equal.
struct Agreement {
    bool fine = true;
    std::string text; // of Settings; or the error
    int rank = 0;     // the lowest rank that has it; -1 if two ranks differ

    // Names and values, a line each.
    class Settings {
    public:
        void add(const char* name, const char* value) { text_ += printed("%s%c%s\n", name, separator, value); }
        void add(const char* name, const std::string& value) { add(name, value.c_str()); }
        template <class Value>
        void add(const char* name, Value value)
        {
            if constexpr (std::is_same_v<Value, bool>)
                add(name, value ? "true" : "false");
            else if constexpr (std::is_floating_point_v<Value>)
                add(name, digitsOf(value));
            else if constexpr (std::is_unsigned_v<Value>)
                add(name, printed("%llu", static_cast<unsigned long long>(value)));
            else
                add(name, printed("%lld", static_cast<long long>(value)));
        }
        const std::string& text() const noexcept { return text_; }

    private:
        std::string text_;
    };

    // `checksums`: see NetworkConfig; `sent`: those of the tile operation's channels that travel; `ownerOf(tile)`:
    // the owner map's answers.
    template <class OwnerOf>
    static Agreement of(const OperationTraits& operations, const FrameBufferConfig& c, bool checksums, int rank,
                        ChannelMask sent, int tileCount, const OwnerOf& ownerOf)
    {
        Fingerprint owners;
        for (int tile = 0; tile < tileCount; ++tile)
            owners.add(static_cast<std::uint64_t>(ownerOf(tile)));
        Settings s;
        s.add("the version of dfb", printed("%d.%d", DFB_VERSION_MAJOR, DFB_VERSION_MINOR));
        s.add("width", c.image.width);
        s.add("height", c.image.height);
        s.add(tileOperation, operations.tileOp);
        s.add(pixelOperation, operations.pixelOp);
        s.add("the size of tiles", printed("%dx%d", operations.tileWidth, operations.tileHeight));
        s.add("the mask of channels", operations.channels);
        s.add("the mask of channels that travel", sent);
        s.add("format", nameOf(c.image.format));
        s.add("depth", c.image.depth);
        s.add("aux", c.image.aux);
        s.add("dither", c.image.dither);
        s.add("displayRank", c.image.displayRank);
        s.add("framesInFlight", c.framesInFlight);
        s.add(ownerMap, owners.value());
        s.add("the id of messages.codec", c.messages.codec ? c.messages.codec->id() : 0);
        s.add("messages.compression", c.messages.compression == CompressionMode::Auto ? "Auto" : "Always");
        s.add("precision.color", nameOf(c.precision.color));
        s.add("precision.budget", c.precision.budget);
        s.add("precision.isHalfLevel", c.precision.isHalfLevel);
        s.add("precision.maxColor", c.precision.maxColor);
        s.add("minTransmittance", c.minTransmittance);
        s.add("messages.poolBytes", c.messages.poolBytes);
        s.add("checksums", checksums);
        return {true, s.text(), rank};
    }

    // The exception for a result that is not fine.
    [[noreturn]] void refuse() const
    {
        ErrorInfo info;
        info.rank = rank;
        info.message = text;
        throw InvalidArgument(std::move(info));
    }

    SmallBytes bytes() const
    {
        ByteWriter out;
        out.put(static_cast<std::uint8_t>(fine));
        out.put(static_cast<std::int32_t>(rank));
        out.putText(text);
        return out.bytes();
    }

    static Agreement from(const SmallBytes& bytes)
    {
        ByteReader in(bytes);
        Agreement a;
        const auto fine = in.get<std::uint8_t>();
        in.require(fine <= 1);
        a.fine = fine != 0;
        a.rank = in.get<std::int32_t>();
        a.text = in.getText();
        in.end();
        return a;
    }

    static SmallBytes combine(const SmallBytes& first, const SmallBytes& second)
    {
        const Agreement a = from(first), b = from(second);
        if (!a.fine || (b.fine && a.text == b.text))
            return first;
        if (!b.fine)
            return second;
        return Agreement{false, difference(a, b), -1}.bytes();
    }

private:
    static constexpr const char* tileOperation = "the tile operation";
    static constexpr const char* pixelOperation = "the pixel operation";
    static constexpr const char* ownerMap = "the hash of ownerMap"; // differs with the size, too
    static constexpr char separator = '=';

    // The fewest digits that give this value back.
    template <class Value>
    static std::string digitsOf(Value value)
    {
        char digits[40];
        const int most = std::numeric_limits<Value>::max_digits10;
        for (int count = 1; count <= most; ++count) {
            std::snprintf(digits, sizeof digits, "%.*g", count, static_cast<double>(value));
            if (static_cast<Value>(std::strtod(digits, nullptr)) == value)
                break;
        }
        return digits;
    }

    // Types are compared by their mangled names, and shown as a program writes them: demangled, without the namespace
    // of the version.
    static std::string readable(const std::string& name, const std::string& value)
    {
        if (name != tileOperation && name != pixelOperation)
            return value;
        const std::unique_ptr<char, decltype(&std::free)> written(
            abi::__cxa_demangle(value.c_str(), nullptr, nullptr, nullptr), &std::free);
        std::string text = written ? written.get() : value;
        const std::string version = printed("v%d_%d::", DFB_VERSION_MAJOR, DFB_VERSION_MINOR);
        for (std::size_t at; (at = text.find(version)) != std::string::npos;)
            text.erase(at, version.size());
        return text;
    }

    // Which settings differ, in words.
    static std::string difference(const Agreement& a, const Agreement& b)
    {
        const auto as = settingsOf(a.text), bs = settingsOf(b.text);
        const std::string ranks[] = {printed(" on rank %d", a.rank), printed(" on rank %d", b.rank)};
        std::string differing;
        for (std::size_t i = 0; i < as.size() && as.size() == bs.size(); ++i)
            if (const auto& [name, value] = as[i]; as[i] != bs[i] && (name != ownerMap || differing.empty()))
                differing += (differing.empty() ? "" : "; ") + name + " is " + readable(name, value) + ranks[0]
                             + " and " + readable(name, bs[i].second) + ranks[1];
        if (differing.empty())
            differing = "the settings" + ranks[0] + " are not those" + ranks[1];
        return differing + ": it must be the same on all ranks";
    }
    static std::vector<std::pair<std::string, std::string>> settingsOf(const std::string& text)
    {
        std::vector<std::pair<std::string, std::string>> settings;
        for (std::size_t at = 0; at < text.size();) {
            const std::size_t end = std::min(text.find('\n', at), text.size());
            const std::string line = text.substr(at, end - at);
            const std::size_t middle = std::min(line.find(separator), line.size());
            settings.push_back({line.substr(0, middle), line.substr(std::min(middle + 1, line.size()))});
            at = end + 1;
        }
        return settings;
    }
};

// Finds out whether all ranks have the same configuration, and returns it, or the error. Collective. If something is
// wrong, no rank returns before all know it: the first to throw may destroy the connection, and a rank that has not
// heard the reason by then would report another error.
inline Agreement agree(Mailbox& mailbox, const Agreement& mine)
{
    const auto all = Agreement::from(mailbox.reduce(mine.bytes(), Agreement::combine));
    if (!all.fine) {
        try {
            mailbox.reduce({}, [](const SmallBytes& a, const SmallBytes&) { return a; });
        } catch (const TransportError&) {
            // One rank has left already, so all know.
        }
    }
    return all;
}

} // namespace detail
DFB_NAMESPACE_END
