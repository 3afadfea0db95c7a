// Compositing: the pure functions on spans of pixels that tile operations are made of: over, and
// sort-and-blend, both accumulated in double.
//
// The fold (one for all ops, so that arrival order, threads and ranks can not show): per pixel, front to back
// in (depth, position in the list of layers), colour and alpha accumulate as A += T * a, and T *= 1 - a is
// carried by itself. For colour and alpha that are finite floats, alpha in [0, 1], colour non-negative, and up
// to 65536 layers the accumulated double is within 2^-36 (relative) of the exact sum, so rounding it to float is
// within 1 ulp of exact. Pixels are premultiplied: colour is added as it stands, also where alpha is 0.
#pragma once

#include <dfb/fragment.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

namespace dfb {

// One row of pixels being composited: `width` pixels.
struct CompositeRow {
    std::vector<double> rgba;          // 4 * width, premultiplied
    std::vector<double> transmittance; // width
    std::vector<float> depth;          // width: of the nearest layer with alpha > 0, else +infinity

    void reset(int width)
    {
        rgba.assign(4 * static_cast<std::size_t>(width), 0.0);
        transmittance.assign(static_cast<std::size_t>(width), 1.0);
        depth.assign(static_cast<std::size_t>(width), std::numeric_limits<float>::infinity());
    }
};

// A run of pixels of one layer; depth may be null, which counts as equal depth everywhere.
struct Layer {
    const float* color = nullptr;
    const float* depth = nullptr;
};

// Composites `count` pixels of a layer under what is already in `row` at pixels [x, x + count).
inline void over(CompositeRow& row, int x, int count, const Layer& layer)
{
    double* acc = row.rgba.data() + 4 * static_cast<std::size_t>(x);
    double* transmittance = row.transmittance.data() + x;
    const float* c = layer.color;
    for (int i = 0; i < count; ++i, acc += 4, c += 4) {
        const double t = transmittance[i];
        acc[0] += t * static_cast<double>(c[0]);
        acc[1] += t * static_cast<double>(c[1]);
        acc[2] += t * static_cast<double>(c[2]);
        acc[3] += t * static_cast<double>(c[3]);
        transmittance[i] = t * (1.0 - static_cast<double>(c[3]));
    }
    if (layer.depth) {
        float* nearest = row.depth.data() + x;
        for (int i = 0; i < count; ++i)
            if (layer.color[4 * i + 3] > 0.0f && layer.depth[i] < nearest[i])
                nearest[i] = layer.depth[i];
    }
}

// Composites a constant premultiplied colour under a whole row (the background).
inline void overConstant(CompositeRow& row, const float (&rgba)[4])
{
    const std::size_t width = row.transmittance.size();
    for (std::size_t x = 0; x < width; ++x)
        for (std::size_t c = 0; c < 4; ++c)
            row.rgba[4 * x + c] += row.transmittance[x] * static_cast<double>(rgba[c]);
}

namespace detail {

// The order of layers is constant over most neighbouring pixels. Returns the first pixel in [begin, end) where
// layer `front` does not come before layer `back`; `frontWinsTies` tells how equal depths are decided.
inline int firstOutOfOrder(const float* front, const float* back, bool frontWinsTies, int begin, int end)
{
    constexpr int chunk = 16;
    int x = begin;
    for (; x + chunk <= end; x += chunk) {
        int wrong = 0;
        if (frontWinsTies)
            for (int k = 0; k < chunk; ++k)
                wrong |= !(front[x + k] <= back[x + k]);
        else
            for (int k = 0; k < chunk; ++k)
                wrong |= !(front[x + k] < back[x + k]);
        if (wrong)
            break;
    }
    for (; x < end; ++x)
        if (!(frontWinsTies ? front[x] <= back[x] : front[x] < back[x]))
            return x;
    return end;
}

} // namespace detail

// Sorts and blends: composites `count` pixels of several layers under `row` at [x, x + count), each pixel front to
// back by (depth, index in `layers`). NaN in a depth must have been replaced (the wire does: farthest). A layer
// without depth makes all depths count as equal. `order` is scratch space.
inline void sortAndBlend(CompositeRow& row, int x, int count, const std::vector<Layer>& layers, std::vector<int>& order)
{
    const std::size_t n = layers.size();
    auto blend = [&](int begin, int end) {
        for (int layer : order) {
            const Layer& l = layers[static_cast<std::size_t>(layer)];
            over(row, x + begin, end - begin,
                 {l.color + 4 * static_cast<std::ptrdiff_t>(begin), l.depth ? l.depth + begin : nullptr});
        }
    };
    order.resize(n);
    for (std::size_t i = 0; i < n; ++i)
        order[i] = static_cast<int>(i);
    const bool sorted =
        n > 1 && std::all_of(layers.begin(), layers.end(), [](const Layer& l) { return l.depth != nullptr; });
    if (!sorted) {
        blend(0, count);
        return;
    }
    for (int begin = 0; begin < count;) {
        // Insertion sort: the order of the last pixel is nearly always nearly right.
        for (std::size_t i = 1; i < n; ++i) {
            const int layer = order[i];
            const float depth = layers[static_cast<std::size_t>(layer)].depth[begin];
            std::size_t j = i;
            for (; j > 0; --j) {
                const int before = order[j - 1];
                const float beforeDepth = layers[static_cast<std::size_t>(before)].depth[begin];
                if (beforeDepth < depth || (beforeDepth == depth && before < layer))
                    break;
                order[j] = before;
            }
            order[j] = layer;
        }
        int end = count;
        for (std::size_t i = 1; i < n && end > begin + 1; ++i)
            end = detail::firstOutOfOrder(layers[static_cast<std::size_t>(order[i - 1])].depth,
                                          layers[static_cast<std::size_t>(order[i])].depth, order[i - 1] < order[i],
                                          begin + 1, end);
        blend(begin, end);
        begin = end;
    }
}

// Composites the fragments of one tile and pass, row by row. The fragments' order decides between equal depths:
// sort them by (source, part) first.
class FragmentCompositor {
public:
    // `begin` to `end` are iterators of pointers to fragments, which must outlive this.
    template <class Iterator>
    void start(Iterator begin, Iterator end)
    {
        cursors_.clear();
        for (; begin != end; ++begin)
            if (!(*begin)->empty())
                cursors_.emplace_back(**begin);
    }

    // Composites the next row of all fragments under `row`, which has been reset to the region's width.
    void nextRow(CompositeRow& row)
    {
        active_.clear();
        edges_.clear();
        for (FragmentCursor& cursor : cursors_) {
            const FragmentRow r = cursor.next();
            if (r.spanCount == 0)
                continue;
            active_.push_back(r);
            for (int i = 0; i < r.spanCount; ++i) {
                edges_.push_back(r.spans[i].x);
                edges_.push_back(r.spans[i].x + r.spans[i].count);
            }
        }
        // Between two neighbouring edges the set of layers is constant.
        std::sort(edges_.begin(), edges_.end());
        edges_.erase(std::unique(edges_.begin(), edges_.end()), edges_.end());
        for (std::size_t e = 0; e + 1 < edges_.size(); ++e) {
            const int x0 = edges_[e], x1 = edges_[e + 1];
            layers_.clear();
            for (FragmentRow& r : active_) {
                while (r.spanCount > 0 && r.spans->x + r.spans->count <= x0) {
                    r.color += 4 * static_cast<std::ptrdiff_t>(r.spans->count);
                    if (r.depth)
                        r.depth += r.spans->count;
                    ++r.spans;
                    --r.spanCount;
                }
                if (r.spanCount > 0 && r.spans->x <= x0) {
                    const int offset = x0 - r.spans->x;
                    layers_.push_back(
                        {r.color + 4 * static_cast<std::ptrdiff_t>(offset), r.depth ? r.depth + offset : nullptr});
                }
            }
            if (!layers_.empty())
                sortAndBlend(row, x0, x1 - x0, layers_, order_);
        }
    }

private:
    std::vector<FragmentCursor> cursors_;
    std::vector<FragmentRow> active_;
    std::vector<int> edges_;
    std::vector<Layer> layers_;
    std::vector<int> order_;
};

} // namespace dfb
