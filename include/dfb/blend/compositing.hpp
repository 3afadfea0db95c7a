// Compositing: pure functions on spans of pixels, for tile operations: over, sort-and-blend and nearest, all
// accumulated in double.
//
// All operations blend alike, so that the image does not depend on arrival order, threads or ranks. In each pixel
// layers are blended front to back in (depth, position in the list of layers): colour and alpha accumulate as `A += T *
// a`. The transmittance T is a variable of its own, updated by `T *= 1 - a`. Accuracy, for finite floats, alpha in [0,
// 1], non-negative colour and up to 65536 layers: the accumulated double has a relative error of at most 2^-36, so
// rounding it to float is within 1 ulp of exact. Where that does not tell which of two 8-bit levels is nearer, the row
// is composited again in twice the precision. Pixels are premultiplied: colour is added as it stands, also where alpha
// is 0.
#pragma once

#include <dfb/blend/blend_kernels.hpp>
#include <dfb/blend/composite_row.hpp>
#include <dfb/blend/sort_kernels.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

DFB_NAMESPACE_BEGIN

namespace detail {

// Blends colours that are `stride` floats apart under pixels of a row, in twice the precision. Returns false if the row
// has no low words, and leaves it as it is.
inline bool overExactly(CompositeRow& row, int x, int count, const float* color, int stride)
{
    const auto at = static_cast<std::size_t>(x);
    if (!row.rgbaLow.empty())
        blendExactly({row.rgba.data() + 4 * at, row.rgbaLow.data() + 4 * at, row.transmittance.data() + at,
                      row.transmittanceLow.data() + at},
                     count, color, stride);
    return !row.rgbaLow.empty();
}

} // namespace detail

// Composites `count` pixels of a layer under the pixels [x, x + count) of `row`.
inline void over(CompositeRow& row, int x, int count, const Layer& layer)
{
    const bool isDone = detail::overExactly(row, x, count, layer.color, 4);
    double* acc = row.rgba.data() + 4 * static_cast<std::size_t>(x);
    double* transmittance = row.transmittance.data() + x;
    const float* c = layer.color;
    for (int i = 0; !isDone && i < count; ++i, acc += 4, c += 4) {
        const double t = transmittance[i];
        acc[0] += t * static_cast<double>(c[0]);
        acc[1] += t * static_cast<double>(c[1]);
        acc[2] += t * static_cast<double>(c[2]);
        acc[3] += t * static_cast<double>(c[3]);
        transmittance[i] = t * (1.0 - static_cast<double>(c[3]));
    }
    if (layer.depth && row.wantsDepth)
        detail::takeNearestPlain(row.depth.data() + x, count, layer.color, layer.depth); // often one pixel
}

// Sets the transmittance of pixels in [x, x + count) to 0 where it is below minTransmittance: they count as opaque.
inline void closeOpaque(CompositeRow& row, int x, int count)
{
    double* t = row.transmittance.data() + x;
    for (int i = 0; row.minTransmittance > 0 && i < count; ++i)
        if (t[i] < row.minTransmittance)
            t[i] = 0;
}

// Blends the auxiliary channels that `row` has. Call it before over(), since it needs the transmittance in front of
// this layer. `aux`: the planes at the first pixel. `anyAlpha`: pixels with alpha 0 give position and ids as well.
inline void overAux(CompositeRow& row, int x, int count, const Layer& layer, const detail::ConstPlanes& aux,
                    bool anyAlpha = false)
{
    const auto counts = [&](int i) { return anyAlpha || layer.color[4 * i + 3] > 0.0f; };
    const auto first = static_cast<std::size_t>(x);
    const auto blend = [&](std::vector<double>& to, const std::byte* plane) {
        if (to.empty() || !plane)
            return;
        const float* from = detail::floatsOf(plane);
        double* out = to.data() + 3 * first;
        for (int i = 0; i < 3 * count; ++i)
            out[i] += row.transmittance[first + static_cast<std::size_t>(i / 3)] * static_cast<double>(from[i]);
    };
    blend(row.aux.normal, aux.at[detail::Normal]);
    blend(row.aux.albedo, aux.at[detail::Albedo]);
    const auto depthOf = [&](int i) { return layer.depth ? layer.depth[i] : 0.0f; };
    if (!row.aux.position.empty() && aux.at[detail::Position]) {
        const float* from = detail::floatsOf(aux.at[detail::Position]);
        FrontPosition* to = row.aux.position.data() + first;
        for (int i = 0; i < count; ++i)
            if (!to[i].isThere() && counts(i))
                to[i] = {{from[3 * i], from[3 * i + 1], from[3 * i + 2]}, depthOf(i)};
    }
    const auto takeIds = [&](std::vector<FrontId>& ids, const std::byte* plane) {
        if (ids.empty() || !plane)
            return;
        const std::uint32_t* from = detail::idsOf(plane);
        FrontId* to = ids.data() + first;
        for (int i = 0; i < count; ++i)
            if (!to[i].isThere() && from[i] != noId && counts(i))
                to[i] = {from[i], depthOf(i)};
    };
    takeIds(row.aux.primitiveId, aux.at[detail::PrimitiveId]);
    takeIds(row.aux.instanceId, aux.at[detail::InstanceId]);
    if (row.reach.empty() || !aux.at[detail::Far] || !layer.depth)
        return;
    const float* farDepth = detail::floatsOf(aux.at[detail::Far]);
    for (int i = 0; i < count; ++i) {
        if (!(layer.color[4 * i + 3] > 0.0f))
            continue;
        float& reach = row.reach[first + static_cast<std::size_t>(i)];
        if (layer.depth[i] < reach)
            row.isUndefined[first + static_cast<std::size_t>(i)] = 1;
        reach = std::max({reach, layer.depth[i], farDepth[i]});
    }
}

// Composites a constant premultiplied RGBA colour under pixels [begin, begin + count). This is the background: call it
// after all layers.
inline void overBackground(CompositeRow& row, int begin, int count, const float* rgba)
{
    const auto first = static_cast<std::size_t>(begin), end = first + static_cast<std::size_t>(count);
    for (std::size_t x = first; x < end && !row.aux.weight.empty(); ++x)
        row.aux.weight[x] = row.rgba[4 * x + 3];
    if (rgba[0] == 0.0f && rgba[1] == 0.0f && rgba[2] == 0.0f && rgba[3] == 0.0f)
        return;
    if (!detail::overExactly(row, begin, count, rgba, 0))
        detail::blendConstant(row.rgba.data() + 4 * first, row.transmittance.data() + first, count, rgba);
}

namespace detail {

// Composites pixels [begin, end) of the layers, in this order, into the row. Pixel i of a layer is pixel x + i of the
// row, here and below.
inline void blendColors(CompositeRow& row, int x, int begin, int end, const std::vector<Layer>& layers,
                        const std::vector<int>& order)
{
    double* rgba = row.rgba.data() + 4 * static_cast<std::ptrdiff_t>(x + begin);
    double* transmittance = row.transmittance.data() + x + begin;
    const auto colorOf = [&](std::size_t k) { return layers[static_cast<std::size_t>(order[k])].from(begin).color; };
    if (order.size() == 1) {
        takeLayer(rgba, transmittance, end - begin, colorOf(0), row.minTransmittance);
        return;
    }
    BlendGroup group;
    group.minTransmittance = row.minTransmittance;
    for (std::size_t k = 0; k < order.size();) {
        for (group.layers = 0; k < order.size() && group.layers < BlendGroup::mostLayers; ++k)
            group.colors[group.layers++] = colorOf(k);
        if (!blendGroup(rgba, transmittance, end - begin, group))
            break;
        group.isFirst = false;
    }
}

// Sets the depths of pixels [begin, end) to the nearest ones, if depth is wanted.
inline void takeDepths(CompositeRow& row, int x, int begin, int end, const std::vector<Layer>& layers)
{
    if (!row.wantsDepth)
        return;
    float* nearest = row.depth.data() + x + begin;
    std::fill_n(nearest, end - begin, std::numeric_limits<float>::infinity());
    for (const Layer& layer : layers) // of equal depths, such as 0 and -0, that of the first
        if (const Layer l = layer.from(begin); l.depth)
            takeNearest(nearest, end - begin, l.color, l.depth);
}

// Blends all channels that the row has.
inline void blendFully(CompositeRow& row, int x, int begin, int end, const std::vector<Layer>& layers,
                       const std::vector<int>& order)
{
    row.clear(x + begin, end - begin);
    for (const int layer : order) {
        const Layer l = layers[static_cast<std::size_t>(layer)].from(begin);
        if (l.aux)
            overAux(row, x + begin, end - begin, l, l.aux->from(static_cast<std::size_t>(begin)));
        over(row, x + begin, end - begin, l);
        closeOpaque(row, x + begin, end - begin);
    }
}

inline void blend(CompositeRow& row, int x, int begin, int end, const std::vector<Layer>& layers,
                  const std::vector<int>& order)
{
    if (layers.front().aux || !row.rgbaLow.empty())
        blendFully(row, x, begin, end, layers, order);
    else
        blendColors(row, x, begin, end, layers, order), takeDepths(row, x, begin, end, layers);
}

// The first pixel in [begin, end) where the order of the layers is not that of their depths; end if there is none.
inline int firstOutOfOrder(const std::vector<Layer>& layers, const std::vector<int>& order, int begin, int end)
{
    OrderedDepths some;
    for (std::size_t first = 0; first + 1 < order.size() && begin < end; first += OrderedDepths::mostLayers - 1) {
        const std::size_t count = std::min<std::size_t>(OrderedDepths::mostLayers, order.size() - first);
        for (std::size_t k = 0; k < count; ++k) {
            some.depths[k] = layers[static_cast<std::size_t>(order[first + k])].depth;
            some.losesTies[k] = first + k + 1 < order.size() && order[first + k] > order[first + k + 1] ? -1 : 0;
        }
        some.layers = static_cast<int>(count);
        end = firstOutOfOrder(some, begin, end);
    }
    return end;
}

// Sorts `order` by the layers' (depth, index) at a pixel.
inline void sortAt(int pixel, const std::vector<Layer>& layers, std::vector<int>& order)
{
    const auto depthOf = [&](int layer) { return layers[static_cast<std::size_t>(layer)].depth[pixel]; };
    // Insertion sort, as the order of the last pixel usually needs few changes. After too many moves std::sort() takes
    // over.
    std::size_t movesLeft = 8 * order.size();
    for (std::size_t i = 1; i < order.size(); ++i) {
        if (movesLeft < i) {
            std::sort(order.begin(), order.end(), [&](int a, int b) {
                const float depthOfA = depthOf(a), depthOfB = depthOf(b);
                return depthOfA != depthOfB ? depthOfA < depthOfB : a < b;
            });
            return;
        }
        const int layer = order[i];
        const float depth = depthOf(layer);
        std::size_t j = i;
        for (; j > 0; --j) {
            const int before = order[j - 1];
            const float beforeDepth = depthOf(before);
            if (beforeDepth < depth || (beforeDepth == depth && before < layer))
                break;
            order[j] = before;
        }
        order[j] = layer;
        movesLeft -= i - j;
    }
}

// Sorts and blends four pixels, each with an order of its own. `order` becomes that of the last pixel. For up to
// SortNetwork::mostLayers layers.
inline void sortAndBlendFour(CompositeRow& row, int x, int begin, const std::vector<Layer>& layers,
                             std::vector<int>& order)
{
    const float *colors[SortNetwork::mostLayers], *depths[SortNetwork::mostLayers];
    for (std::size_t k = 0; k < layers.size(); ++k) {
        const Layer l = layers[k].from(begin);
        colors[k] = l.color;
        depths[k] = l.depth;
    }
    const int count = static_cast<int>(layers.size());
    FourOrders orders;
    sortFour(depths, SortNetwork::of(count), orders);
    blendFour(row.rgba.data() + 4 * static_cast<std::ptrdiff_t>(x + begin), row.transmittance.data() + x + begin,
              colors, orders, count, row.minTransmittance);
    takeDepths(row, x, begin, begin + 4, layers);
    for (std::size_t k = 0; k < order.size(); ++k)
        order[k] = static_cast<int>(orders[k][3]);
}

// Whether all layers have a depth, so that they can be sorted.
inline bool haveDepths(const std::vector<Layer>& layers)
{
    return std::all_of(layers.begin(), layers.end(), [](const Layer& l) { return l.depth != nullptr; });
}

// Layers 0, 1, 2 and so on.
inline void resetOrder(std::vector<int>& order, std::size_t count)
{
    order.resize(count);
    std::iota(order.begin(), order.end(), 0);
}

// keepNearest() for layers of colour and depth alone.
inline void keepNearestPlain(CompositeRow& row, int x, int count, const std::vector<Layer>& layers)
{
    const auto first = static_cast<std::size_t>(x);
    for (int i = 0; i < count; ++i) {
        const float* color = layers.front().color;
        float depth = layers.front().depth[i];
        for (std::size_t k = 1; k < layers.size(); ++k) {
            const bool isNearer = layers[k].depth[i] < depth;
            color = isNearer ? layers[k].color : color;
            depth = isNearer ? layers[k].depth[i] : depth;
        }
        const std::size_t at = first + static_cast<std::size_t>(i);
        for (std::size_t c = 0; c < 4; ++c)
            row.rgba[4 * at + c] = 0.0 + static_cast<double>(color[4 * static_cast<std::size_t>(i) + c]); // -0 is 0
        row.transmittance[at] = 1.0 - row.rgba[4 * at + 3];
        if (row.wantsDepth)
            row.depth[at] = depth;
    }
}

} // namespace detail

// Composites `count` pixels of the layers into `row` at [x, x + count), in the order of `layers`, whatever their depth.
// `order` is scratch space. There must be at least one layer, here and below.
inline void blendInOrder(CompositeRow& row, int x, int count, const std::vector<Layer>& layers, std::vector<int>& order)
{
    detail::resetOrder(order, layers.size());
    detail::blend(row, x, 0, count, layers, order);
}

// Sorts and blends: composites `count` pixels of several layers into `row` at [x, x + count), each pixel front to back
// by (depth, index in `layers`). No depth may be NaN (the wire replaces NaN by +infinity). If any layer has no depth,
// all depths count as equal. `order` is scratch space, either empty or as the last call left it: sorting starts from
// that order, and is fast if it fits.
inline void sortAndBlend(CompositeRow& row, int x, int count, const std::vector<Layer>& layers, std::vector<int>& order)
{
    if (layers.size() == 1 || !detail::haveDepths(layers)) {
        blendInOrder(row, x, count, layers, order);
        return;
    }
    if (order.size() != layers.size())
        detail::resetOrder(order, layers.size());
    detail::sortAt(0, layers, order); // else the result for infinite inputs would depend on the old order
    const bool inFours = count >= 4 && layers.size() <= static_cast<std::size_t>(detail::SortNetwork::mostLayers)
                         && !layers.front().aux && row.rgbaLow.empty();
    // The order is constant over most neighbouring pixels. Where it is not, four pixels are sorted at once.
    for (int begin = 0; begin < count;) {
        int end = detail::firstOutOfOrder(layers, order, begin, count);
        if (inFours && end < count && end < begin + 4) {
            begin = std::min(begin, count - 4);
            detail::sortAndBlendFour(row, x, begin, layers, order);
            begin += 4;
            continue;
        }
        if (end == begin) {
            detail::sortAt(begin, layers, order);
            end = detail::firstOutOfOrder(layers, order, begin + 1, count);
        }
        detail::blend(row, x, begin, end, layers, order);
        begin = end;
    }
}

// For each of `count` pixels, keeps the nearest layer, by (depth, index in `layers`), and puts it into `row` at [x, x +
// count). For opaque inputs. Pixels with alpha 0 count, too, also for depth, position and ids.
inline void keepNearest(CompositeRow& row, int x, int count, const std::vector<Layer>& layers)
{
    const auto isPlain = [](const Layer& layer) { return layer.depth && !layer.aux; };
    if (row.rgbaLow.empty() && std::all_of(layers.begin(), layers.end(), isPlain)) {
        detail::keepNearestPlain(row, x, count, layers);
        return;
    }
    row.clear(x, count);
    for (int i = 0; i < count; ++i) {
        const Layer* nearest = layers.data();
        for (const Layer& layer : layers)
            if (layer.depth && layer.depth[i] < nearest->depth[i])
                nearest = &layer;
        const Layer l = nearest->from(i);
        if (l.aux)
            overAux(row, x + i, 1, l, l.aux->from(static_cast<std::size_t>(i)), true);
        over(row, x + i, 1, l);
        if (row.wantsDepth && l.depth)
            row.depth[static_cast<std::size_t>(x + i)] = *l.depth;
    }
}

DFB_NAMESPACE_END
