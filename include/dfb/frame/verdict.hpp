// Verdict: the content of the reduction that ends each frame: the error that all ranks report, if any, and the figures
// of the frame that are sums or maxima over the ranks. FrameTerms: the parameters of the frame that must be equal on
// all ranks.
#pragma once

#include <dfb/comm/heartbeat.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/agreement.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <iterator>
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
        if (!reason)
            failArgument("no exception: std::current_exception() has one in a handler only");
        std::rethrow_exception(reason);
    } catch (const Error& e) {
        info = e.info();
    } catch (const std::exception& e) {
        info = errorInfo(ErrorKind::UserCode, e.what());
    } catch (...) {
        info = errorInfo(ErrorKind::UserCode, "an exception that is not a std::exception");
    }
    const auto fill = [](auto& to, auto from) { to = to < 0 ? from : to; };
    fill(info.from, where.from);
    fill(info.tile, where.tile);
    fill(info.pass, where.pass);
    fill(info.generation, where.generation);
    fill(info.source, where.source);
    return info;
}

// Whether an error says that something has not come.
inline bool isMissing(ErrorKind kind) noexcept
{
    return kind == ErrorKind::TimedOut || kind == ErrorKind::MissingInput;
}

// The parts of a FrameConfig that must be equal on all ranks; lists as hashes. Travels byte for byte with each verdict.
struct FrameTerms {
    std::uint64_t samplesHash = 0; // 0: there is no plan
    std::int64_t sampleCount = 0;  // of all tiles in the plan
    std::uint64_t accumulationId = 0;
    std::uint64_t orderHash = 0;               // 0: there is no order
    std::uint64_t ownersHash = 0;              // 0: those of the owner map
    std::array<std::uint32_t, 4> background{}; // bits: so that a NaN equals itself
    std::int32_t passes = 1, maxLayers = 0, timeoutMs = 0;
    std::int32_t declared = 0, allowPartial = 0;
    std::int32_t rank = 0; // the lowest rank with these terms

    // Throws InvalidArgument.
    static void check(const FrameConfig& p, const OperationTraits& operations)
    {
        if (p.passes < 1)
            failArgument("a frame has at least 1 pass, not %d", p.passes);
        if (p.maxLayers < 0)
            failArgument("at most %d layers", p.maxLayers);
        if (p.owners && operations.keepsState)
            failArgument("owners of a frame's own, with a tile operation that keeps state");
        if (const long long ms = p.timeout.count(); ms < 0 || ms > longestTimeout.count())
            failArgument("a time-out of %lld ms", ms);
    }

    static FrameTerms of(const FrameConfig& p, int rank)
    {
        FrameTerms t;
        if (p.samples) {
            for (const TileSamples& its : *p.samples)
                t.sampleCount += its.count;
            t.samplesHash = fingerprint(*p.samples, [](const TileSamples& its) {
                return static_cast<std::uint64_t>(its.first) << 32 | static_cast<std::uint32_t>(its.count);
            });
        }
        t.accumulationId = p.accumulationId;
        if (p.order)
            t.orderHash = fingerprint(p.order->places(), [](const SourceOrder::Place& its) {
                return static_cast<std::uint64_t>(its.source) << 32 | static_cast<std::uint32_t>(its.place);
            });
        if (p.owners)
            t.ownersHash = fingerprint(*p.owners, [](int owner) { return owner; });
        std::memcpy(t.background.data(), p.background.data(), sizeof t.background);
        t.passes = p.passes;
        t.maxLayers = p.maxLayers;
        t.timeoutMs = static_cast<std::int32_t>(p.timeout.count());
        t.declared = p.declared;
        t.allowPartial = p.allowPartial;
        t.rank = rank;
        return t;
    }

    std::chrono::milliseconds timeout() const { return std::chrono::milliseconds(timeoutMs); } // 0: none

    // Which fields are not the same in both, with their values and ranks; "" if they are alike.
    std::string difference(const FrameTerms& o) const
    {
        FrameTerms its = o;
        its.rank = rank;
        if (std::memcmp(this, &its, sizeof its) == 0) // as nearly always
            return {};
        return Agreement::difference(text(), rank, o.text(), o.rank);
    }

private:
    std::string text() const
    {
        const auto hashText = [](std::uint64_t hash) {
            return hash == 0 ? "null" : printed("one with hash %llu", static_cast<unsigned long long>(hash));
        };
        std::array<float, 4> c{};
        std::memcpy(c.data(), background.data(), sizeof c);
        Agreement::Settings s;
        s.add("FrameConfig::background",
              printed("(%.9g, %.9g, %.9g, %.9g)", static_cast<double>(c[0]), static_cast<double>(c[1]),
                      static_cast<double>(c[2]), static_cast<double>(c[3])));
        s.add("FrameConfig::passes", passes);
        s.add("FrameConfig::samples",
              samplesHash == 0 ? "null" : printed("a plan of %lld samples", static_cast<long long>(sampleCount)));
        s.add("the hash of FrameConfig::samples", samplesHash);
        s.add("FrameConfig::maxLayers", maxLayers);
        s.add("FrameConfig::accumulationId", accumulationId);
        s.add("FrameConfig::order", hashText(orderHash));
        s.add("FrameConfig::owners", hashText(ownersHash));
        s.add("FrameConfig::declared", declared != 0);
        s.add("FrameConfig::timeout", printed("%lld ms", static_cast<long long>(timeoutMs)));
        s.add("FrameConfig::allowPartial", allowPartial != 0);
        return s.text();
    }
};
static_assert(std::has_unique_object_representations_v<FrameTerms>); // no byte of a verdict is undefined

struct Verdict {
    std::optional<ErrorInfo> error;
    bool hasNotBegun = false; // a rank could not make its parameters, so they may differ for that reason
    FrameTerms terms;         // the parameters of begin(), which should be the same on all ranks
    std::string differing;    // which of them differ, in words
    struct Sums : FrameSums {
        std::int64_t inputsLeft = 0;      // inputs sent, less inputs that have come
        std::int64_t tilesEndedEarly = 0; // finished before all their inputs had come
    };
    enum Maximum { PeakMemoryBytes, RenderNs, PeakInboxBytes, TotalNs, maximumCount };
    Sums sums;
    std::array<std::int64_t, maximumCount> maxima{};
    double wireErrorBound = 0;            // a maximum
    std::vector<Figure> tileErrors;       // by tile; each tile is of one rank
    std::vector<Figure> figures;          // by key; sums
    std::vector<Figure> mergeErrors;      // by tile; sums
    std::vector<std::int32_t> incomplete; // tiles of a partial frame that their owners have not finished

    SmallBytes bytes() const
    {
        SmallBytes out;
        out.put(static_cast<std::uint8_t>(error ? 1 + hasNotBegun : 0));
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
        return out;
    }

    static Verdict from(const SmallBytes& bytes)
    {
        ByteReader in(bytes);
        Verdict v;
        const auto failed = in.get<std::uint8_t>();
        in.require(failed <= 2);
        if (failed)
            v.error = getErrorInfo(in);
        v.hasNotBegun = failed == 2;
        v.terms = in.get<FrameTerms>();
        v.differing = in.getText();
        v.sums = in.get<Sums>();
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

    // Sets the figures of a new report that are the same on all ranks.
    void addTo(FrameReport& report) const
    {
        static_cast<FrameSums&>(report) = sums;
        report.peakMemoryBytes = maxima[PeakMemoryBytes];
        report.renderMsMax = static_cast<double>(maxima[RenderNs]) / 1e6;
        report.peakInboxBytes = maxima[PeakInboxBytes];
        report.wireErrorBound = wireErrorBound;
        for (const Figure& f : mergeErrors)
            report.mergeErrorBound = std::max(report.mergeErrorBound, f.value);
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
    // Sorts by key, then value, and adds up equal keys: so sums do not depend on the order in which threads added
    // values.
    static std::vector<Figure> sortedSums(std::vector<Figure> figures)
    {
        const auto isLess = [](double a, double b) { return std::isnan(b) ? !std::isnan(a) : a < b; }; // NaN is last
        std::sort(figures.begin(), figures.end(), [&](const Figure& a, const Figure& b) {
            return a.key != b.key ? a.key < b.key : isLess(a.value, b.value);
        });
        return summed(std::move(figures));
    }

    // `what`: which parameters differ, or "" if that is not known.
    static ErrorInfo disagreement(const std::string& what = "")
    {
        return errorInfo(ErrorKind::Disagreement, what.empty() ? "the frame was begun with different parameters"
                                                               : what + ": it must be the same on all ranks");
    }

    // Returns an error if inputs came after their tiles had been finished: others may have been taken in their place.
    // Returns none if a tile was finished before all its inputs had come, since these inputs may come late, too.
    std::optional<ErrorInfo> strayInputs() const
    {
        const std::int64_t count = sums.tilesEndedEarly == 0 ? sums.inputsLeft : 0;
        if (count == 0)
            return std::nullopt;
        ErrorInfo info = errorInfo(ErrorKind::Disagreement, "more inputs were sent than had been announced: some came "
                                                            "after their tiles were finished");
        info.expected = 0;
        info.got = count;
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

    // Picks the error that all ranks report: the one with the greatest weight(); of equal ones, one that names a rank
    // that is waited for; then that of the lowest rank. Joins the texts about missing inputs.
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
        a.hasNotBegun = a.hasNotBegun || b.hasNotBegun;
        if (a.differing.empty())
            a.differing = !b.differing.empty() ? b.differing : a.terms.difference(b.terms);
        // Other errors follow from different parameters. But if a camera throws on one rank, its FrameConfig::order is
        // missing for that reason. Then there is no partial image, either.
        const bool isCause = a.error && (a.hasNotBegun || a.error->kind == ErrorKind::UserCode);
        const bool isCombined = a.error && a.error->kind == ErrorKind::Disagreement && a.error->rank < 0;
        if (!a.differing.empty() && !isCombined && (!isCause || a.terms.allowPartial != 0)) {
            if (isCause)
                a.differing += printed("; rank %d: %s", a.error->rank, a.error->message.c_str());
            a.error = disagreement(a.differing);
        }
        using Words = std::array<std::uint64_t, sizeof(Sums) / 8>;
        auto sums = loadAs<Words>(reinterpret_cast<const std::byte*>(&a.sums));
        const auto more = loadAs<Words>(reinterpret_cast<const std::byte*>(&b.sums));
        for (std::size_t i = 0; i < sums.size(); ++i)
            sums[i] += more[i];
        a.sums = loadAs<Sums>(reinterpret_cast<const std::byte*>(sums.data()));
        for (std::size_t i = 0; i < a.maxima.size(); ++i)
            a.maxima[i] = std::max(a.maxima[i], b.maxima[i]);
        a.wireErrorBound = std::max(a.wireErrorBound, b.wireErrorBound);
        a.tileErrors = merged(a.tileErrors, b.tileErrors);
        a.figures = merged(a.figures, b.figures);
        a.mergeErrors = merged(a.mergeErrors, b.mergeErrors);
        a.incomplete.insert(a.incomplete.end(), b.incomplete.begin(), b.incomplete.end()); // each tile has one owner
        if (!a.differing.empty()) // or several, if ranks disagree about owners; then there is no partial image
            a.incomplete.clear();
        return a.bytes();
    }
};

} // namespace detail
DFB_NAMESPACE_END
