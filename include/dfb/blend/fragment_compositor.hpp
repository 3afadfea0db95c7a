// FragmentCompositor: walks the rows of a tile's fragments, and composites each run of pixels that the same fragments
// cover.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/blend/compositing.hpp>
#include <dfb/blend/in_place_kernels.hpp>
#include <dfb/fragment.hpp>
#include <dfb/wire/wire_kernels.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

DFB_NAMESPACE_BEGIN

// Composites the fragments of one tile and pass, row by row. Of equal depths the first fragment is in front: sort them
// by (source, part) first. One thread at a time may use it.
class FragmentCompositor {
public:
    // `begin` to `end` are iterators of pointers to fragments, which must outlive this. `isFirst`: this is the first
    // walk of the fragments, so it counts the faults of pixels.
    template <class Iterator>
    void start(BlendRule rule, Iterator begin, Iterator end, bool isFirst = true)
    {
        rule_ = rule;
        cursors_.clear();
        isFull_ = true;
        std::size_t made = 0;
        for (; begin != end; ++begin)
            if ((*begin)->isMadeByRow()) {
                if (made == rowPixels_.size())
                    rowPixels_.push_back(std::make_unique<detail::RowPixels>());
                cursors_.push_back(FragmentCursor(**begin, rowPixels_[made++].get(), isFirst));
            } else if (!(*begin)->empty()) {
                cursors_.push_back(FragmentCursor(**begin));
            }
    }

    void skipRows(int count)
    {
        for (FragmentCursor& cursor : cursors_)
            cursor.skip(count);
    }

    // Composites the next row of all fragments into `row`, which has been sized for the region's width. If
    // row.wantsGaps or row.wantsSingles is false, other pixels than those of runs() are undefined afterwards.
    void nextRow(CompositeRow& row)
    {
        runs_.clear();
        const bool wantsAux = !row.reach.empty() || !row.aux.normal.empty() || !row.aux.albedo.empty()
                              || !row.aux.position.empty() || !row.aux.primitiveId.empty()
                              || !row.aux.instanceId.empty();
        if (!wantsAux && compositeInPlace(row))
            return;
        const bool areAlike = takeRows(wantsAux);
        const int width = static_cast<int>(row.transmittance.size());
        if (active_.empty()) {
            clearGap(row, 0, width);
        } else if (areAlike && !wantsAux) {
            compositeSpans(row);
        } else {
            findEdges(width);
            const int pixels = edges_[edgeCount_ - 1] - edges_.front(), runs = static_cast<int>(edgeCount_ - 1);
            if (rule_ == BlendRule::InOrder && !wantsAux && row.rgbaLow.empty() && pixels < shortRun * runs)
                compositeLayers(row);
            else
                compositeRuns(row, wantsAux);
        }
    }

    // Keeps the nearest pixels of the next row of all fragments. All fragments must keep their bytes and have a depth.
    // Where there is no pixel, the depth is +infinity.
    void nextRow(detail::NearestBytes& row, int width)
    {
        row.reset(width);
        forEachByteSpan([&](const Span& span, const detail::ByteLayer& layer) {
            return detail::keepNearestBytes(row.depth.data() + span.x, row.bytes.data() + 4 * span.x, span.count,
                                            layer);
        });
    }

    // Blends the next row of all fragments into `levels`, which must be 0. There may be two fragments at most, and both
    // must keep their bytes.
    void nextRow(std::uint8_t* levels)
    {
        forEachByteSpan([&](const Span& span, const detail::ByteLayer& layer) {
            detail::blendLevels(levels + 4 * span.x, span.count, reinterpret_cast<const std::uint8_t*>(layer.bytes));
            return std::uint64_t{0};
        });
    }

    // A run of pixels that fragments cover.
    struct Run {
        int x = 0, count = 0;
        const float* color = nullptr; // not null: the colours of a single layer, which are not in the row
    };
    // The runs of the last row: in order, not overlapping. They include narrow gaps, and up to 3 empty pixels at either
    // end.
    const std::vector<Run>& runs() const noexcept { return runs_; }

private:
    static constexpr int narrowGap = 32;  // compositing a gap narrower than this costs less than a new run
    static constexpr int wideSingle = 16; // the same holds for a single layer, which could be taken as it is
    static constexpr int shortRun = 32;   // if runs are shorter on average, layers are blended one by one

    // Calls f(span, layer) for each span of the next row of all fragments, which must keep their bytes. f returns how
    // many depths are NaN.
    template <class F>
    void forEachByteSpan(const F& f)
    {
        ByteRow r;
        for (FragmentCursor& cursor : cursors_) {
            if (!cursor.nextBytes(r))
                continue;
            detail::ByteLayer layer{r.bytes, r.depth, r.depthLimit};
            std::uint64_t nan = 0;
            for (const Span* span = r.spans; span != r.spans + r.spanCount; ++span) {
                nan += f(*span, layer);
                layer.bytes += 4 * static_cast<std::ptrdiff_t>(span->count);
                layer.depth += layer.depth ? span->count : 0;
            }
            cursor.countNanDepths(nan);
            cursor.advance(r);
        }
    }

    static void clearGap(CompositeRow& row, int begin, int end, bool isBetweenRuns = false)
    {
        if (row.wantsGaps || (isBetweenRuns && end - begin < narrowGap))
            row.clear(begin, end - begin);
    }

    // Sets active_ to the next row of each fragment that has pixels there. Returns true if there is only one, or if
    // each is a single span, the same in all.
    bool takeRows(bool wantsAux)
    {
        bool isOneRun = true;
        active_.resize(cursors_.size()); // filled in place: copying values that were just written is slow
        std::size_t rows = 0;
        for (FragmentCursor& cursor : cursors_) {
            FragmentRow& r = active_[rows];
            if (!cursor.next(r))
                continue;
            ++rows;
            if (wantsAux)
                r.aux = cursor.aux();
            cursor.advance(r);
            const Span &a = *r.spans, &b = *active_.front().spans;
            isOneRun = isOneRun && r.spanCount == 1 && a.x == b.x && a.count == b.count;
        }
        active_.resize(rows);
        return isOneRun || rows == 1;
    }

    // Composites the next row if all inputs lie in place and cover the same pixels: then each colour is read once, and
    // not copied. Returns false if the row must be composited otherwise.
    bool compositeInPlace(CompositeRow& row)
    {
        const bool isBlended = rule_ == BlendRule::SortByDepth || rule_ == BlendRule::InOrder;
        if (!isBlended || row.wantsDepth || !row.rgbaLow.empty() || !detail::cpuHasAvx2())
            return false;
        if (!findInPlace() || !(row.minTransmittance > 0 ? blendInPlace<true>(row) : blendInPlace<false>(row)))
            return false;
        const Span span = rows_.front().span;
        clearGap(row, 0, span.x);
        clearGap(row, span.x + span.count, static_cast<int>(row.transmittance.size()));
        skipRows(1);
        return true;
    }

    // Blends rows_, with AVX2 or AVX-512. Returns false if `row` is undefined afterwards.
    template <bool HasLeast>
    bool blendInPlace([[maybe_unused]] CompositeRow& row)
    {
#if defined(DFB_HAS_AVX2_CLONES)
        const Span span = rows_.front().span;
        const int x = span.x, count = span.count, layers = static_cast<int>(cursors_.size());
        double* const rgba = row.rgba.data() + 4 * x;
        double* const transmittance = row.transmittance.data() + x;
        const bool isTold = rule_ == BlendRule::InOrder || !detail::haveDepths(layers_);
        if (isFull_ && haveOneOrder(count, isTold)) {
            for (std::size_t k = 0; k < order_.size(); ++k)
                ordered_[k] = rows_[static_cast<std::size_t>(order_[k])];
            const auto blend =
                detail::cpuHasAvx512() ? detail::blendFullRowsAvx512<HasLeast> : detail::blendFullRowsAvx2<HasLeast>;
            if (blend(ordered_.data(), layers, row.minTransmittance, rgba, transmittance)) {
                joinRun(x, count);
                return true;
            }
        }
        isFull_ = false;
        const auto blend = isTold                        ? detail::blendSparseRowsAvx2<HasLeast>
                           : layers > detail::rowsAtOnce ? detail::sortSparseRowsAvx2<HasLeast, 16>
                                                         : detail::sortSparseRowsAvx2<HasLeast, 1>;
        bool isGood = true;
        for (int begin = 0; begin < count; begin += 256)
            detail::forEachRun(blend(rows_.data(), layers, begin, row.minTransmittance, rgba, transmittance, isGood),
                               [&](int at, int fours) {
                                   const int first = begin + 4 * at;
                                   joinRun(x + first, std::min(4 * fours, count - first));
                               });
        if (!isGood)
            runs_.clear();
        return isGood;
#else
        return false;
#endif
    }

    // Sets rows_ and layers_ for all inputs. Returns false if they do not cover the same pixels.
    bool findInPlace()
    {
        if (cursors_.size() < 2 || cursors_.size() > rows_.size())
            return false;
        layers_.resize(cursors_.size());
        for (std::size_t k = 0; k < cursors_.size(); ++k) {
            if (!cursors_[k].findInPlace(rows_[k]))
                return false;
            const Span &span = rows_[k].span, &first = rows_.front().span;
            if (span.x != first.x || span.count != first.count || span.count < 4)
                return false;
            layers_[k] = {detail::floatsOf(rows_[k].first.color), rows_[k].first.depth, nullptr};
        }
        return true;
    }

    // Sets order_ to the order of layers_. Returns false if the order changes within their `count` pixels, or a depth
    // is NaN. `isTold`: the order is that of the inputs.
    bool haveOneOrder(int count, bool isTold)
    {
        if (isTold || order_.size() != layers_.size())
            detail::resetOrder(order_, layers_.size());
        if (isTold || detail::firstOutOfOrder(layers_, order_, 0, count) == count)
            return true;
        // Sorts copies: no sort can cope with a NaN, or with a depth that another process changes meanwhile.
        float depths[detail::mostInPlace];
        firsts_.resize(layers_.size());
        for (std::size_t k = 0; k < firsts_.size(); ++k) {
            depths[k] = detail::canonicalDepth(layers_[k].depth[0]);
            firsts_[k].depth = &depths[k];
        }
        detail::sortAt(0, firsts_, order_);
        return detail::firstOutOfOrder(layers_, order_, 0, count) == count;
    }

    // Composites active_, if takeRows() has returned true.
    void compositeSpans(CompositeRow& row)
    {
        layers_.resize(active_.size());
        for (std::size_t k = 0; k < layers_.size(); ++k)
            layers_[k] = {active_[k].color, active_[k].depth, nullptr};
        const FragmentRow& first = active_.front();
        int end = 0;
        for (const Span* span = first.spans; span != first.spans + first.spanCount; ++span) {
            clearGap(row, end, span->x, end > 0);
            addRun(row, span->x, span->count);
            layers_.front() = layers_.front().from(span->count); // if there is another span, it is the only layer
            end = span->x + span->count;
        }
        clearGap(row, end, static_cast<int>(row.transmittance.size()));
    }

    // For fragments in order: blends one fragment after the other, each under those before. This begins a run for each
    // span; compositeRuns() begins one at every edge of a span.
    void compositeLayers(CompositeRow& row)
    {
        const int width = static_cast<int>(row.transmittance.size());
        findRuns(width);
        int end = 0;
        for (const Run& run : runs_) {
            clearGap(row, end, run.x);
            row.clear(run.x, run.count);
            end = run.x + run.count;
        }
        clearGap(row, end, width);
        detail::BlendGroup group;
        group.isFirst = false;
        group.layers = 1;
        group.minTransmittance = row.minTransmittance;
        for (const FragmentRow& r : active_) {
            Layer layer{r.color, r.depth, nullptr};
            for (const Span* span = r.spans; span != r.spans + r.spanCount; ++span) {
                group.colors[0] = layer.color;
                detail::blendGroup(row.rgba.data() + 4 * span->x, row.transmittance.data() + span->x, span->count,
                                   group);
                if (row.wantsDepth && layer.depth)
                    detail::takeNearest(row.depth.data() + span->x, span->count, layer.color, layer.depth);
                layer = layer.from(span->count);
            }
        }
    }

    // Sets runs_ to the pixels that any fragment covers, including narrow gaps between them.
    void findRuns(int width)
    {
        std::vector<std::uint64_t>& isCovered = marks_;
        isCovered.assign(static_cast<std::size_t>(width / 64 + 1), 0);
        for (const FragmentRow& r : active_)
            for (const Span* span = r.spans; span != r.spans + r.spanCount; ++span)
                detail::forEachWord(span->x, span->x + span->count,
                                    [&](std::size_t word, std::uint64_t bits) { isCovered[word] |= bits; });
        for (std::size_t word = 0; word < isCovered.size(); ++word)
            detail::forEachRun(isCovered[word],
                               [&](int at, int count) { joinRun(static_cast<int>(64 * word) + at, count); });
    }

    // Composites the row between each two edges. Call findEdges() first.
    void compositeRuns(CompositeRow& row, bool wantsAux)
    {
        clearGap(row, 0, edges_.front());
        clearGap(row, edges_[edgeCount_ - 1], static_cast<int>(row.transmittance.size()));
        for (std::size_t e = 0; e + 1 < edgeCount_; ++e) {
            const int x0 = edges_[e], x1 = edges_[e + 1];
            layers_.clear();
            aux_.resize(wantsAux ? active_.size() : 0); // before anybody points into it
            for (FragmentRow& r : active_) {
                while (r.spanCount > 0 && r.spans->x + r.spans->count <= x0) {
                    r.color += 4 * static_cast<std::ptrdiff_t>(r.spans->count);
                    if (r.depth)
                        r.depth += r.spans->count;
                    if (wantsAux)
                        r.aux.advance(r.spans->count);
                    ++r.spans;
                    --r.spanCount;
                }
                if (r.spanCount > 0 && r.spans->x <= x0) {
                    const int offset = x0 - r.spans->x;
                    layers_.emplace_back() = Layer{r.color, r.depth, nullptr}.from(offset);
                    if (wantsAux) {
                        aux_[layers_.size() - 1] = r.aux.from(static_cast<std::size_t>(offset));
                        layers_.back().aux = &aux_[layers_.size() - 1];
                    }
                }
            }
            if (layers_.empty())
                clearGap(row, x0, x1, true);
            else
                addRun(row, x0, x1 - x0);
        }
    }

    // Composites layers_, which have `count` pixels each, by the rule, and adds the run.
    void addRun(CompositeRow& row, int x, int count)
    {
        if (!row.wantsSingles && layers_.size() == 1 && count >= wideSingle) {
            runs_.emplace_back() = {x, count, layers_.front().color};
            return;
        }
        switch (rule_) {
        case BlendRule::SortByDepth: sortAndBlend(row, x, count, layers_, order_); break;
        case BlendRule::InOrder: blendInOrder(row, x, count, layers_, order_); break;
        case BlendRule::Nearest: keepNearest(row, x, count, layers_); break;
        }
        joinRun(x, count);
    }

    // Adds pixels of the row to runs(): to the last run if the gap before them is narrow.
    void joinRun(int x, int count)
    {
        if (!runs_.empty() && !runs_.back().color && x - (runs_.back().x + runs_.back().count) < narrowGap)
            runs_.back().count = x + count - runs_.back().x;
        else
            runs_.emplace_back() = {x, count, nullptr};
    }

    // Finds the places where spans begin or end: between two neighbouring ones the set of layers is constant.
    void findEdges(int width)
    {
        marks_.assign(static_cast<std::size_t>(width / 64 + 1), 0);
        const auto mark = [this](int x) { marks_[static_cast<std::size_t>(x / 64)] |= std::uint64_t{1} << x % 64; };
        for (const FragmentRow& r : active_)
            for (int i = 0; i < r.spanCount; ++i) {
                mark(r.spans[i].x);
                mark(r.spans[i].x + r.spans[i].count);
            }
        edges_.resize(std::max(edges_.size(), static_cast<std::size_t>(width + 1))); // filled below
        int* next = edges_.data();
        for (std::size_t word = 0; word < marks_.size(); ++word)
            for (std::uint64_t bits = marks_[word]; bits != 0; bits &= bits - 1)
                *next++ = static_cast<int>(64 * word) + detail::zerosBelow(bits);
        edgeCount_ = static_cast<std::size_t>(next - edges_.data());
    }

    BlendRule rule_ = BlendRule::SortByDepth;
    std::array<detail::RowInPlace, detail::mostInPlace> rows_;    // of all inputs
    std::array<detail::RowInPlace, detail::mostInPlace> ordered_; // the same in blending order
    bool isFull_ = false;                                         // rows in place had one order and no gaps so far
    std::vector<FragmentCursor> cursors_;
    std::vector<std::unique_ptr<detail::RowPixels>> rowPixels_; // of the cursors that need scratch memory
    std::vector<FragmentRow> active_;
    std::vector<detail::ConstPlanes> aux_; // of layers_
    std::vector<std::uint64_t> marks_;     // a bit for each pixel of a row
    std::vector<int> edges_;               // only the first edgeCount_ are valid
    std::size_t edgeCount_ = 0;
    std::vector<Run> runs_; // elements are assigned, not pushed: copying values that were just written is slow
    std::vector<Layer> layers_, firsts_;
    std::vector<int> order_;
};

DFB_NAMESPACE_END
