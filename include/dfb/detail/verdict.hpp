// Verdict: what the one reduction per frame carries: whether any rank failed, and which error all ranks report;
// and the figures of the frame that are sums or maxima over the ranks. Agreement: the same for what a framebuffer is
// made with.
#pragma once

#include <dfb/comm/byte_io.hpp>
#include <dfb/frame.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <cxxabi.h>
#include <exception>
#include <iterator>
#include <memory>
#include <optional>
#include <string>
#include <type_traits>
#include <typeinfo>
#include <utility>
#include <vector>

namespace dfb::detail {

// An exception as a record; `where` fills in what the exception does not say.
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
    if (info.kind == ErrorKind::InvalidArgument)
        info.kind = ErrorKind::UserCode; // of a call within a renderer or an op
    const auto fill = [](std::int64_t& to, std::int64_t from) { to = to < 0 ? from : to; };
    fill(info.tile, where.tile);
    fill(info.pass, where.pass);
    fill(info.generation, where.generation);
    fill(info.source, where.source);
    if (!where.message.empty())
        info.message += (info.message.empty() ? "" : ", ") + where.message;
    return info;
}

// FNV-1a over 64-bit words.
class Fingerprint {
public:
    void add(std::uint64_t v) noexcept { value_ = (value_ ^ v) * 1099511628211u; }
    std::uint64_t value() const noexcept { return value_; }

private:
    std::uint64_t value_ = 1469598103934665603u;
};

inline std::uint64_t fingerprintOf(const FrameParams& p)
{
    Fingerprint f;
    for (float channel : p.background) {
        std::uint32_t bits = 0;
        std::memcpy(&bits, &channel, sizeof bits);
        f.add(bits);
    }
    f.add(static_cast<std::uint64_t>(p.passes));
    if (p.samples)
        for (const TileSamples& t : *p.samples)
            f.add(static_cast<std::uint64_t>(t.first) << 32 | static_cast<std::uint32_t>(t.count));
    f.add(static_cast<std::uint64_t>(p.maxLayers));
    f.add(p.accumulationId);
    f.add(p.declared);
    f.add(static_cast<std::uint64_t>(p.timeoutMs));
    f.add(p.allowPartial);
    return f.value();
}

struct Verdict {
    std::optional<ErrorInfo> error;
    std::uint64_t paramsHash = 0; // of what begin() was given; the same on all ranks
    // Bytes, messages, tiles touched, non-finite pixels, late messages, repeated messages, pixels of undefined order,
    // pixels with alpha outside [0, 1], compressed links, inputs that were sent without those that have come, tiles
    // that needed no more although more was to come.
    std::array<std::int64_t, 11> sums{};
    // Peak memory in bytes, rendering in ns, peak of the inbox in bytes, ns from begin() until all is done here.
    std::array<std::int64_t, 4> maxima{};
    double wireErrorBound = 0;            // a maximum
    std::vector<Figure> tileErrors;       // by tile; no two ranks have the same
    std::vector<Figure> figures;          // by key; sums
    std::vector<Figure> mergeErrors;      // by tile; sums
    std::vector<std::int32_t> incomplete; // tiles that their owners have not finished, of a frame that may be partial

    SmallBytes bytes() const
    {
        ByteWriter out;
        out.put(static_cast<std::uint8_t>(error.has_value()));
        if (error)
            put(out, *error);
        out.put(paramsHash);
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
        v.paramsHash = in.get<std::uint64_t>();
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

    // Whether what it says of tiles is of tiles that there are.
    bool fits(int tileCount) const
    {
        const auto count = static_cast<std::uint64_t>(tileCount);
        return (tileErrors.empty() || tileErrors.back().key < count)
               && (mergeErrors.empty() || mergeErrors.back().key < count) && incomplete.size() <= count
               && std::all_of(incomplete.begin(), incomplete.end(), [=](auto tile) { return tile < tileCount; });
    }

    // What is the same on all ranks.
    void addTo(FrameReport& report) const
    {
        report.bytesSent = sums[0];
        report.messagesSent = sums[1];
        report.tilesTouched = sums[2];
        report.nonFinitePixels = sums[3];
        report.lateMessages = sums[4];
        report.repeatedMessages = sums[5];
        report.peakMemoryBytes = maxima[0];
        report.renderMsMax = static_cast<double>(maxima[1]) / 1e6;
        report.peakInboxBytes = maxima[2];
        report.orderUndefinedPixels = sums[6];
        report.alphaOutsidePixels = sums[7];
        report.compressedLinks = sums[8];
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

    // Two lists by key become one; values of the same key are added.
    static std::vector<Figure> merged(const std::vector<Figure>& a, const std::vector<Figure>& b)
    {
        std::vector<Figure> all;
        all.reserve(a.size() + b.size());
        std::merge(a.begin(), a.end(), b.begin(), b.end(), std::back_inserter(all),
                   [](const Figure& x, const Figure& y) { return x.key < y.key; });
        return summed(std::move(all));
    }
    // The same of one list that is ordered by key.
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

    static ErrorInfo disagreement()
    {
        ErrorInfo info;
        info.kind = ErrorKind::Disagreement;
        info.message = "the frame was begun with different parameters (background, passes, samples, maxLayers, "
                       "accumulationId, declared, timeoutMs, allowPartial)";
        return info;
    }

    // An input that its owner did not wait for, and that came too late, may have had its place taken by another. What
    // comes to a tile that needs no more may be too late as well: then nothing can be said.
    std::optional<ErrorInfo> strayInputs() const
    {
        const std::int64_t count = sums[10] == 0 ? sums[9] : 0;
        if (count == 0)
            return std::nullopt;
        ErrorInfo info;
        info.kind = ErrorKind::Disagreement;
        info.expected = 0;
        info.got = count;
        info.message = "more inputs were sent than had been announced: so many came when their tiles were finished";
        return info;
    }

    // How much an error says about why the frame failed.
    static int weight(const ErrorInfo& e)
    {
        if (e.kind == ErrorKind::Cancelled)
            return 0;
        if (e.kind == ErrorKind::Disagreement)
            return 5;
        return e.kind != ErrorKind::TimedOut ? 4 : e.tile >= 0 ? 3 : e.expected >= 0 ? 2 : 1;
    }

    // Of several errors, one that says most, and the one of the lowest rank; of what is missing, all.
    static ErrorInfo chosen(const ErrorInfo& a, const ErrorInfo& b)
    {
        constexpr std::size_t mostText = 2000;
        const bool second = weight(a) != weight(b) ? weight(b) > weight(a) : b.rank < a.rank;
        ErrorInfo info = second ? b : a;
        const ErrorInfo& other = second ? a : b;
        if (weight(a) == 3 && weight(b) == 3 && a.rank != b.rank && info.message.size() < mostText)
            info.message += "; on rank " + std::to_string(other.rank) + ": " + other.message;
        return info;
    }

    static SmallBytes combine(const SmallBytes& first, const SmallBytes& second)
    {
        Verdict a = from(first);
        const Verdict b = from(second);
        if (b.error)
            a.error = a.error ? chosen(*a.error, *b.error) : *b.error;
        if (a.paramsHash != b.paramsHash)
            a.error = disagreement(); // whatever else came of it
        for (std::size_t i = 0; i < a.sums.size(); ++i)
            a.sums[i] = static_cast<std::int64_t>(static_cast<std::uint64_t>(a.sums[i])
                                                  + static_cast<std::uint64_t>(b.sums[i]));
        for (std::size_t i = 0; i < a.maxima.size(); ++i)
            a.maxima[i] = std::max(a.maxima[i], b.maxima[i]);
        a.wireErrorBound = std::max(a.wireErrorBound, b.wireErrorBound);
        a.tileErrors = merged(a.tileErrors, b.tileErrors);
        a.figures = merged(a.figures, b.figures);
        a.mergeErrors = merged(a.mergeErrors, b.mergeErrors);
        a.incomplete.insert(a.incomplete.end(), b.incomplete.begin(), b.incomplete.end()); // each tile has one owner
        return a.bytes();
    }
};

// What one rank was made with, or what was wrong with it; combined, whether all are fine and alike.
struct Agreement {
    bool fine = true;
    std::string text; // items parted by commas, or what is wrong
    int rank = 0;     // whose; the lowest of those that are alike

    // `checksums`: see MessengerOptions; `tileSize`: of the tile operation; `sent`: those of its channels that travel;
    // `ownerOf(tile)`: the owner map's answers.
    template <class TileOp, class PixelOp, class OwnerOf>
    static Agreement of(const FrameBufferConfig& c, bool checksums, int rank, int tileSize, ChannelMask sent,
                        int tileCount, const OwnerOf& ownerOf)
    {
        Fingerprint owners;
        for (int tile = 0; tile < tileCount; ++tile)
            owners.add(static_cast<std::uint64_t>(ownerOf(tile)));
        const auto text = [](auto value) {
            if constexpr (!std::is_floating_point_v<decltype(value)>)
                return std::to_string(value);
            char digits[40]; // all of them
            std::snprintf(digits, sizeof digits, "%.17g", static_cast<double>(value));
            return std::string(digits);
        };
        return {true,
                "version " + text(DFB_VERSION_MAJOR) + '.' + text(DFB_VERSION_MINOR) + ", size " + text(c.width) + 'x'
                    + text(c.height) + ", tiles of " + text(tileSize) + ", channels " + text(TileOp::channels)
                    + ", sent channels " + text(sent) + ", format " + text(static_cast<int>(c.format)) + ", depth "
                    + text(c.depth) + ", aux " + text(c.aux) + ", display rank " + text(c.displayRank)
                    + ", frames in flight " + text(c.framesInFlight) + ", codec " + text(c.codec ? c.codec->id() : 0)
                    + ", compression " + text(static_cast<int>(c.compression)) + ", gather "
                    + text(static_cast<int>(c.gather)) + ", wire colour " + nameOf(c.wire.color) + ", error budget "
                    + text(c.wire.budget) + ", largest colour " + text(c.wire.maxColor) + ", least transmittance "
                    + text(c.minTransmittance) + ", checksums " + text(checksums) + ", message pool "
                    + text(c.messagePoolBytes) + ", owner map " + text(owners.value()) + ", dither " + text(c.dither)
                    + ", " + tileOperation + typeid(TileOp).name() + ", " + pixelOperation + typeid(PixelOp).name(),
                rank};
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
        return Agreement{false,
                         "ranks " + std::to_string(a.rank) + " and " + std::to_string(b.rank)
                             + " were configured differently: " + difference(a.text, b.text),
                         a.rank}
            .bytes();
    }

private:
    static constexpr const char* tileOperation = "tile operation ";
    static constexpr const char* pixelOperation = "pixel operation ";

    // Types are compared by the names that all compilers have for them, and shown as they are written.
    static std::string readable(const std::string& item)
    {
        for (const std::string start : {tileOperation, pixelOperation}) {
            if (item.compare(0, start.size(), start) != 0)
                continue;
            const std::unique_ptr<char, decltype(&std::free)> name(
                abi::__cxa_demangle(item.c_str() + start.size(), nullptr, nullptr, nullptr), &std::free);
            if (name)
                return start + name.get();
        }
        return item;
    }

    // The items that are not the same in both; all, if they have not the same items.
    static std::string difference(const std::string& a, const std::string& b)
    {
        const std::vector<std::string> as = itemsOf(a), bs = itemsOf(b);
        std::string differing;
        for (std::size_t i = 0; i < as.size() && as.size() == bs.size(); ++i)
            if (as[i] != bs[i])
                differing += (differing.empty() ? "[" : ", [") + readable(as[i]) + "] and [" + readable(bs[i]) + "]";
        return differing.empty() ? "[" + a + "] and [" + b + "]" : differing;
    }
    static std::vector<std::string> itemsOf(const std::string& text)
    {
        std::vector<std::string> items;
        for (std::size_t at = 0, end = 0; end != std::string::npos; at = end + 2) {
            end = text.find(", ", at);
            items.push_back(text.substr(at, end == std::string::npos ? end : end - at));
        }
        return items;
    }
};

} // namespace dfb::detail
