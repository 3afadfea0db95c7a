// Sort-last operations: the inputs of a tile are layers of one scene. AlphaBlend sorts them per pixel (Listing 4 of
// the paper), OrderedBlend is told their order, DepthComposite keeps the nearest.
#pragma once

#include <dfb/base/double_double.hpp>
#include <dfb/base/function_ref.hpp>
#include <dfb/blend/composite_row.hpp>
#include <dfb/compiled.hpp>
#include <dfb/tile_op.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

namespace detail {

// Sums over passes of composited pixels, and their mean.
class PixelSums {
public:
    // `wanted`: those of the auxiliary channels that are wanted.
    void reset(std::size_t pixels, ChannelMask wanted)
    {
        rgba_.assign(4 * pixels, 0.0);
        depth_.assign(pixels, std::numeric_limits<float>::infinity());
        aux_.reset(pixels, wanted);
    }

    // Adds a row, with its background, to pixels [first, first + width).
    void add(std::size_t first, const CompositeRow& row)
    {
        const auto sum = [](std::vector<double>& to, const std::vector<double>& from, std::size_t at) {
            for (std::size_t i = 0; !to.empty() && i < from.size(); ++i)
                to[at + i] += from[i];
        };
        sum(rgba_, row.rgba, 4 * first);
        sum(aux_.normal, row.aux.normal, 3 * first);
        sum(aux_.albedo, row.aux.albedo, 3 * first);
        sum(aux_.weight, row.aux.weight, first);
        for (std::size_t i = 0; i < row.depth.size(); ++i)
            depth_[first + i] = std::min(depth_[first + i], row.depth[i]);
        const auto nearest = [first](auto& to, const auto& from) { // the first of those that are equally near
            for (std::size_t i = 0; !to.empty() && i < from.size(); ++i)
                if (from[i].isThere() && (!to[first + i].isThere() || from[i].depth < to[first + i].depth))
                    to[first + i] = from[i];
        };
        nearest(aux_.position, row.aux.position);
        nearest(aux_.primitiveId, row.aux.primitiveId);
        nearest(aux_.instanceId, row.aux.instanceId);
    }

    // Adds `count` samples without an input to all pixels. The result is that of adding them one by one, as these sums
    // of equal floats are exact.
    void addBackground(std::int64_t count, const std::array<float, 4>& background)
    {
        for (std::size_t i = 0; count > 0 && i < rgba_.size(); ++i)
            rgba_[i] += static_cast<double>(count) * static_cast<double>(background[i % 4]);
    }

    const double* rgba(std::size_t pixel) const noexcept { return rgba_.data() + 4 * pixel; }

    // Writes pixels [first, first + out.width()), the mean of `count` passes, as row y. Returns what setRow() does.
    double write(FinishedTile& out, int y, std::size_t first, std::int64_t count)
    {
        const auto width = static_cast<std::size_t>(out.width());
        row_.resize(4 * width);
        for (std::size_t i = 0; i < row_.size(); ++i)
            row_[i] = rgba_[4 * first + i] / static_cast<double>(count);
        // Fills `to` with values valueOf(from, i), `each` for each pixel. Null if the channel is not wanted.
        const auto fill = [width](auto& to, const auto& from, std::size_t each, const auto& valueOf) {
            to.resize(from.empty() ? 0 : each * width);
            for (std::size_t i = 0; i < to.size(); ++i)
                to[i] = valueOf(from, i);
            return to.empty() ? nullptr : to.data();
        };
        const auto mean = [&](const std::vector<double>& from, std::size_t i) {
            const double weight = aux_.weight[first + i / 3];
            return weight > 0 ? static_cast<float>(from[3 * first + i] / weight) : 0.0f;
        };
        const auto positionAt = [first](const auto& from, std::size_t i) { return from[first + i / 3].at[i % 3]; };
        const auto idAt = [first](const auto& from, std::size_t i) { return from[first + i].id; };
        const AuxRow aux{fill(normal_, aux_.normal, 3, mean), fill(albedo_, aux_.albedo, 3, mean),
                         fill(position_, aux_.position, 3, positionAt), fill(primitiveId_, aux_.primitiveId, 1, idAt),
                         fill(instanceId_, aux_.instanceId, 1, idAt)};
        return out.setRow(y, row_.data(), depth_.data() + first, aux);
    }

private:
    std::vector<double> rgba_; // 4 a pixel
    std::vector<float> depth_; // the nearest
    AuxPixels aux_;
    std::vector<double> row_; // this and the rest: scratch of write()
    std::vector<float> normal_, albedo_, position_;
    std::vector<std::uint32_t> primitiveId_, instanceId_;
};

// FragmentStore: the base of the sort-last operations. It keeps the inputs of one tile until all of them are there.
// Then it composites them pass by pass over the background, and averages the passes, in double.
class FragmentStore {
public:
    void newFrame(const TileInfo& info)
    {
        info_ = info;
        tracked_ = static_cast<ChannelMask>((info.wanted & imageAuxChannels) | (channels_ & farChannel));
        fragments_.clear();
        undefinedPixels_ = 0;
    }

    void add(Fragment&& fragment)
    {
        if (fragment.empty())
            return;
        if (info_.order && info_.order->placeOf(fragment.header().source) < 0)
            failArgument("an input of source %u, which is not in the order of the frame", fragment.header().source);
        fragments_.push_back(std::move(fragment));
    }

    // Writes the mean of the passes.
    void finish(FinishedTile& out);

    void report(TileReport& report) const { report.orderUndefinedPixels = undefinedPixels_; }

    // For operations on top of this one: calls passDone(y, pass, row) for each row and pass, row by row. The row has
    // its background.
    void compositePasses(const FunctionRef<void(int, int, const CompositeRow&)>& passDone);

protected:
    // `channels`: of the operation.
    FragmentStore(BlendRule rule, ChannelMask channels) noexcept : rule_(rule), channels_(channels) {}

    const TileInfo& info() const noexcept { return info_; }

    // Forgets the inputs behind a generation.
    void removeBehind(int generation);

private:
    struct Scratch;

    static Scratch& scratch();
    Scratch& start();
    void finishRuns(FinishedTile& out);
    void finishBytes(FinishedTile& out);
    void finishLevels(FinishedTile& out);
    void roundExactly(FinishedTile& out, int y, double farthest);
    // All fragments, in the order of blending.
    void sort(std::vector<const Fragment*>& pointers) const;
    // Calls f(pass, begin, end) for each pass, with its fragments.
    template <class F>
    void forEachPass(const std::vector<const Fragment*>& sorted, const F& f) const
    {
        auto next = sorted.begin();
        for (int pass = 0; pass < info_.passes; ++pass) {
            const auto first = next;
            while (next != sorted.end() && (*next)->header().pass == pass)
                ++next;
            f(static_cast<std::size_t>(pass), first, next);
        }
    }

    BlendRule rule() const noexcept { return info_.order ? BlendRule::InOrder : rule_; }

    BlendRule rule_; // if the frame has no order
    ChannelMask channels_;
    TileInfo info_;
    ChannelMask tracked_ = 0;
    std::vector<Fragment> fragments_;
    std::int64_t undefinedPixels_ = 0; // in which inputs overlapped in depth
};

// The base of the sort-last operations.
template <BlendRule Rule, int TileSize, ChannelMask Channels>
class SortLast : public FragmentStore {
public:
    static constexpr int tileSize = TileSize;
    static constexpr ChannelMask channels = Channels;
    static constexpr ChannelMask neededChannels =
        Rule == BlendRule::InOrder ? colorChannel : Channels & (colorChannel | depthChannel);
    static constexpr BlendRule rule = Rule;
    static constexpr bool emptyIsBackground = true;
    static constexpr bool activeByDepth = Rule == BlendRule::Nearest;
    static constexpr bool readsInPlace = true;

    SortLast() noexcept : FragmentStore(Rule, Channels) {}
};

} // namespace detail

// Sorts the inputs of each pixel by (depth, source, part). Accepts any dependency tree (dependency_tracker.hpp). Empty
// inputs count in the tree and are not blended. Accuracy: see blend/compositing.hpp; the mean over n passes adds a
// relative error of at most n * 2^-53. With farChannel, it counts pixels in which inputs overlap in depth, since their
// order is undefined. Channels beside colour, depth and farChannel travel only if the image has them.
// FrameConfig::order replaces the sort, except with farChannel.
template <int TileSize = 64, ChannelMask Channels = colorChannel | depthChannel>
class BasicAlphaBlend : public detail::SortLast<BlendRule::SortByDepth, TileSize, Channels> {
    static_assert((Channels & depthChannel) != 0, "dfb: AlphaBlend sorts by depth");

public:
    static constexpr ChannelMask neededChannels = Channels & (colorChannel | depthChannel | farChannel);
    static constexpr bool takesOrder = (Channels & farChannel) == 0;
};

// Blends inputs in the order of their generation, front to back. Use it if one order of the bricks is right for all
// pixels of a tile. It sorts nothing, and no depth travels unless the image has it. The tree is a list: each input
// announces one child, the last none. OrderedLoop sends an empty input of generation 0 for a tile that no brick covers.
// Declared inputs of one generation are blended by (source, part).
//
// If a tile has one pass, and the image colour alone, the tile does not wait for inputs behind an opaque one, nor blend
// them.
template <int TileSize = 64, ChannelMask Channels = colorChannel | depthChannel>
class BasicOrderedBlend : public detail::SortLast<BlendRule::InOrder, TileSize, Channels> {
public:
    static bool opaqueHides(const TileInfo& info)
    {
        return info.passes == 1 && (info.wanted & ~colorChannel) == 0 && (Channels & farChannel) == 0;
    }

    void newFrame(const TileInfo& info)
    {
        Base::newFrame(info);
        generations_.clear();
        opaque_ = none;
    }

    void add(Fragment&& fragment)
    {
        if (fragment.header().children > 1)
            detail::failArgument("inputs in order form a list: at most 1 child each, not %d",
                                 fragment.header().children);
        const int generation = fragment.header().generation;
        const bool hides = opaqueHides(Base::info());
        // The dependency tracker finds this error at the end. But a tile in which an input hides others may be finished
        // before that. Several declared inputs may be of generation 1: then generation 0 never comes.
        if (hides && generation != 1 && has(generation))
            detail::failArgument("inputs in order form a list: there cannot be two of generation %d", generation);
        generations_.push_back(generation);
        if (generation > opaque_)
            return;
        if (hides && fragment.isOpaque()) {
            opaque_ = generation;
            Base::removeBehind(generation);
        }
        Base::add(std::move(fragment));
    }

    // Whether an opaque input and all inputs in front of it have come.
    bool isComplete() const
    {
        return opaque_ == 0
               || (opaque_ != none && has(0) && std::count_if(generations_.begin(), generations_.end(), [this](int g) {
                                                    return g < opaque_;
                                                }) == opaque_);
    }

private:
    using Base = detail::SortLast<BlendRule::InOrder, TileSize, Channels>;

    bool has(int generation) const
    {
        return std::find(generations_.begin(), generations_.end(), generation) != generations_.end();
    }

    static constexpr int none = std::numeric_limits<int>::max();
    std::vector<int> generations_; // of all inputs that have come
    int opaque_ = none;            // the first generation with an opaque input
};

// Keeps the nearest input of each pixel, by (depth, source, part); for opaque geometry. A pixel is active if its depth
// is below +infinity, even if it is black or transparent. Otherwise it is empty, whatever its colour. The nearest input
// is laid over the background by its alpha; inputs behind it are not blended. Depth, position and ids are those of the
// nearest input. Accepts any tree.
template <int TileSize = 64, ChannelMask Channels = colorChannel | depthChannel>
class BasicDepthComposite : public detail::SortLast<BlendRule::Nearest, TileSize, Channels> {
    static_assert((Channels & depthChannel) != 0, "dfb: DepthComposite compares depths");
};

// BasicAlphaBlend, with tiles of 64 x 64 pixels.
using AlphaBlend = BasicAlphaBlend<>;
// BasicOrderedBlend, with tiles of 64 x 64 pixels.
using OrderedBlend = BasicOrderedBlend<>;
// BasicDepthComposite, with tiles of 64 x 64 pixels.
using DepthComposite = BasicDepthComposite<>;
static_assert(is_tile_op_v<AlphaBlend> && is_tile_op_v<OrderedBlend> && is_tile_op_v<DepthComposite>);

DFB_NAMESPACE_END

#if DFB_HAS_BODIES
#include <dfb/blend/fragment_compositor.hpp>

DFB_NAMESPACE_BEGIN
namespace detail {

struct FragmentStore::Scratch {
    std::vector<const Fragment*> pointers; // in the order of blending, pass by pass
    std::vector<FragmentCompositor> compositors;
    CompositeRow row;
    std::vector<std::uint8_t> isUndefined;
    NearestBytes nearest;
    std::vector<std::uint8_t> levels; // of a row
    // For roundExactly().
    std::vector<DoubleDouble> exactSum;
    CompositeRow exactRow;
    FragmentCompositor exactCompositor;
};

// One object per thread, so that a frame after the first allocates nothing.
DFB_COMPILED_ONCE FragmentStore::Scratch& FragmentStore::scratch()
{
    static thread_local Scratch ofThread;
    return ofThread;
}

DFB_COMPILED_ONCE void FragmentStore::removeBehind(int generation)
{
    fragments_.erase(std::remove_if(fragments_.begin(), fragments_.end(),
                                    [&](const Fragment& f) { return f.header().generation > generation; }),
                     fragments_.end());
}

DFB_COMPILED_ONCE void FragmentStore::compositePasses(const FunctionRef<void(int, int, const CompositeRow&)>& passDone)
{
    Scratch& scratch = start();
    const std::size_t passes = static_cast<std::size_t>(info_.passes);
    const int width = info_.region.width();
    const bool tracksOrder = (tracked_ & farChannel) != 0;
    scratch.isUndefined.resize(tracksOrder ? static_cast<std::size_t>(width) : 0);
    for (int y = 0; y < info_.region.height(); ++y) {
        std::fill(scratch.isUndefined.begin(), scratch.isUndefined.end(), std::uint8_t{0});
        for (std::size_t pass = 0; pass < passes; ++pass) {
            if (tracked_ != 0) // in colour and depth nothing stays from the last row
                scratch.row.resize(width, tracked_);
            scratch.compositors[pass].nextRow(scratch.row);
            overBackground(scratch.row, 0, width, info_.background.data());
            for (std::size_t x = 0; x < scratch.isUndefined.size(); ++x)
                scratch.isUndefined[x] |= scratch.row.isUndefined[x];
            passDone(y, static_cast<int>(pass), std::as_const(scratch.row));
        }
        undefinedPixels_ += std::count(scratch.isUndefined.begin(), scratch.isUndefined.end(), 1);
    }
    fragments_.clear();
}

DFB_COMPILED_ONCE void FragmentStore::finish(FinishedTile& out)
{
    static thread_local PixelSums sums;
    const int last = info_.passes - 1;
    if (last == 0 && tracked_ == 0 && !out.isDithered()) {
        const bool isNearest = rule() == BlendRule::Nearest;
        const auto isOfBytes = [&](const Fragment& f) { return f.keepsBytes() && (f.hasDepth() || !isNearest); };
        const bool areOfBytes = std::all_of(fragments_.begin(), fragments_.end(), isOfBytes);
        const bool hasExactLevels = rule() == BlendRule::InOrder && fragments_.size() <= 2
                                    && (info_.wanted & depthChannel) == 0 && out.format() == OutputFormat::RGBA8
                                    && info_.background == std::array<float, 4>{} && info_.minTransmittance == 0.0f;
        if (areOfBytes && isNearest)
            finishBytes(out);
        else if (areOfBytes && hasExactLevels) // integers are enough
            finishLevels(out);
        else
            finishRuns(out);
        fragments_.clear();
        return;
    }
    const bool direct = last == 0 && (tracked_ & imageAuxChannels) == 0;
    const auto passDone = [&](int y, int pass, const CompositeRow& row) {
        if (direct) {
            roundExactly(out, y, out.setRow(y, row.rgba.data(), row.depth.data()));
            return;
        }
        if (pass == 0)
            sums.reset(static_cast<std::size_t>(out.width()), tracked_);
        sums.add(0, row);
        if (pass == last)
            roundExactly(out, y, sums.write(out, y, 0, info_.passes));
    };
    compositePasses(passDone);
}

DFB_COMPILED_ONCE void FragmentStore::sort(std::vector<const Fragment*>& pointers) const
{
    pointers.clear();
    for (const Fragment& fragment : fragments_)
        pointers.push_back(&fragment);
    const auto keyOf = [this](const TileHeader& h) -> std::array<std::int64_t, 4> {
        if (info_.order)
            return {h.pass, info_.order->placeOf(h.source), h.part, h.generation};
        if (rule_ == BlendRule::InOrder)
            return {h.pass, h.generation, h.source, h.part};
        return {h.pass, h.source, h.part, h.generation};
    };
    std::sort(pointers.begin(), pointers.end(),
              [&](const Fragment* a, const Fragment* b) { return keyOf(a->header()) < keyOf(b->header()); });
}

// Brings a compositor for each pass to the first row of its fragments.
DFB_COMPILED_ONCE FragmentStore::Scratch& FragmentStore::start()
{
    Scratch& scratch = FragmentStore::scratch();
    sort(scratch.pointers);
    scratch.compositors.resize(std::max(scratch.compositors.size(), static_cast<std::size_t>(info_.passes)));
    forEachPass(scratch.pointers,
                [&](std::size_t pass, auto begin, auto end) { scratch.compositors[pass].start(rule(), begin, end); });
    scratch.row.wantsDepth = (info_.wanted & depthChannel) != 0;
    scratch.row.wantsGaps = scratch.row.wantsSingles = true;
    scratch.row.minTransmittance = static_cast<double>(info_.minTransmittance);
    scratch.row.resize(info_.region.width(), tracked_);
    return scratch;
}

// A pixel of the background as the image stores it.
inline std::array<std::byte, 16> storedBackground(const FinishedTile& out, const std::array<float, 4>& background)
{
    std::array<std::byte, 16> stored{};
    convertPixels(background.data(), 1, out.format(), stored.data());
    return stored;
}

// Calls f(x, count) for each run of up to 64 pixels of row y whose bits are set in bitsOf(x, count), and fills in the
// background between them.
template <class BitsOf, class F>
void forEachRunOfRow(FinishedTile& out, int y, const std::array<std::byte, 16>& background, const BitsOf& bitsOf,
                     const F& f)
{
    int end = 0;
    for (int x0 = 0; x0 < out.width(); x0 += 64)
        forEachRun(bitsOf(x0, std::min(64, out.width() - x0)), [&](int at, int count) {
            const int x = x0 + at;
            out.fillPixels(end, y, x - end, background.data());
            end = x + count;
            f(x, count);
        });
    out.fillPixels(end, y, out.width() - end, background.data());
}

// For one pass, and no more channels than colour and depth. Pixels without an input are not composited.
DFB_COMPILED_ONCE void FragmentStore::finishRuns(FinishedTile& out)
{
    Scratch& scratch = start();
    CompositeRow& row = scratch.row;
    row.wantsGaps = false;
    row.wantsSingles = row.wantsDepth || info_.background != std::array<float, 4>{}; // else they are output as they are
    const auto background = storedBackground(out, info_.background);
    for (int y = 0; y < out.height(); ++y) {
        scratch.compositors.front().nextRow(row);
        int x = 0;
        double farthest = 0;
        for (const auto& run : scratch.compositors.front().runs()) {
            out.fillPixels(x, y, run.x - x, background.data());
            x = run.x + run.count;
            if (run.color) {
                out.setPixels(run.x, y, run.count, run.color);
                continue;
            }
            overBackground(row, run.x, run.count, info_.background.data());
            farthest = std::max(farthest, out.setPixels(run.x, y, run.count, row.rgba.data() + 4 * run.x,
                                                        row.depth.data() + (row.wantsDepth ? run.x : 0)));
        }
        out.fillPixels(x, y, out.width() - x, background.data());
        roundExactly(out, y, farthest);
    }
}

// Finishes a tile of DepthComposite whose inputs have 8 bits a channel. Where no background shows through, an RGBA8
// image gets their pixels as they are.
DFB_COMPILED_ONCE void FragmentStore::finishBytes(FinishedTile& out)
{
    Scratch& scratch = start();
    CompositeRow& row = scratch.row;
    const bool isBlack = info_.background == std::array<float, 4>{};
    const auto background = storedBackground(out, info_.background);
    for (int y = 0; y < out.height(); ++y) {
        scratch.compositors.front().nextRow(scratch.nearest, out.width());
        const float* depth = scratch.nearest.depth.data();
        double farthest = 0;
        const auto bitsOf = [&](int x, int count) {
            return depthBits(depth + x, count, std::numeric_limits<float>::infinity()).active;
        };
        forEachRunOfRow(out, y, background, bitsOf, [&](int x, int count) {
            const std::byte* bytes = scratch.nearest.bytes.data() + 4 * x;
            if (out.format() == OutputFormat::RGBA8 && (isBlack || isOpaque(bytes, true, count, 1, 0))) {
                out.setStored(x, y, count, bytes, depth + x);
                return;
            }
            float rgba[4 * 64];
            bytesToFloats(bytes, static_cast<std::size_t>(count), rgba);
            row.clear(x, count);
            over(row, x, count, Layer{rgba, nullptr, nullptr});
            overBackground(row, x, count, info_.background.data());
            farthest = std::max(farthest, out.setPixels(x, y, count, row.rgba.data() + 4 * x, depth + x));
        });
        roundExactly(out, y, farthest);
    }
}

// Blends up to two inputs of 8 bits a channel over an empty background to 8 bits. Integers are exact for that.
DFB_COMPILED_ONCE void FragmentStore::finishLevels(FinishedTile& out)
{
    Scratch& scratch = start();
    const auto background = storedBackground(out, info_.background);
    for (int y = 0; y < out.height(); ++y) {
        scratch.levels.assign(4 * static_cast<std::size_t>(out.width()), 0);
        scratch.compositors.front().nextRow(scratch.levels.data());
        const auto* levels = reinterpret_cast<const std::byte*>(scratch.levels.data());
        forEachRunOfRow(
            out, y, background, [&](int x, int count) { return activeByteBits(levels + 4 * x, count); },
            [&](int x, int count) { out.setStored(x, y, count, levels + 4 * x, nullptr); });
    }
}

// Rounds a row again, in twice the precision, where double does not tell which 8-bit level is nearer. Does nothing with
// a minTransmittance: in another precision a pixel could end at another layer. `farthest`: the result of setRow() or
// setPixels(). Call it after start().
DFB_COMPILED_ONCE void FragmentStore::roundExactly(FinishedTile& out, int y, double farthest)
{
    // 3 roundings for each layer and pass.
    const double layers = static_cast<double>(fragments_.size()) + info_.passes;
    if (info_.minTransmittance > 0 || farthest < 0.5 - 255 * 0x1p-53 * (4 * layers + 8) || fragments_.empty())
        return;
    Scratch& scratch = FragmentStore::scratch();
    CompositeRow& row = scratch.exactRow;
    std::vector<DoubleDouble>& sum = scratch.exactSum; // over the passes, if there are several
    sum.assign(info_.passes > 1 ? 4 * static_cast<std::size_t>(out.width()) : 0, {});
    forEachPass(scratch.pointers, [&](std::size_t, auto begin, auto end) {
        scratch.exactCompositor.start(rule(), begin, end, false);
        scratch.exactCompositor.skipRows(y);
        row.resize(out.width(), 0, true);
        scratch.exactCompositor.nextRow(row);
        overBackground(row, 0, out.width(), info_.background.data());
        for (std::size_t i = 0; i < sum.size(); ++i)
            sum[i] = sum[i] + DoubleDouble{row.rgba[i], row.rgbaLow[i]};
    });
    const int step = out.isDithered() ? 4 : 1; // with dithering, only alpha is rounded again
    for (int i = step - 1; i < 4 * out.width(); i += step) {
        const auto at = static_cast<std::size_t>(i);
        const DoubleDouble value = sum.empty() ? DoubleDouble{row.rgba[at], row.rgbaLow[at]} : sum[at] / info_.passes;
        if (!std::isfinite(value.high)) // twice the precision makes NaN of infinities
            continue;
        // A tie is between two neighbours. Where huge values cancel, double is nearly always off by more, also in rows
        // without a tie.
        const int level = out.format() == OutputFormat::SRGBA8 && i % 4 < 3 ? toSrgb8(value) : toUnorm8(value);
        if (std::abs(level - out.level(y, i)) <= 1)
            out.setLevel(y, i, static_cast<std::uint8_t>(level));
    }
}

} // namespace detail
DFB_NAMESPACE_END
#endif
