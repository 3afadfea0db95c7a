// The kernels of sorting layers by (depth, index), ascending: how far an order holds along a row, sorting four pixels
// at once, and keeping the nearest of pixels with 8 bits a channel. Each kernel exists in plain C++ and, for processors
// that have it, by hand for AVX2.
#pragma once

#include <dfb/base/cpu.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#if defined(DFB_HAS_AVX2_CLONES)
#include <immintrin.h>
#endif

DFB_NAMESPACE_BEGIN
namespace detail {

// ---- how far an order holds

// The depths of some layers, front to back.
struct OrderedDepths {
    static constexpr int mostLayers = 16;

    const float* depths[mostLayers];
    std::int32_t losesTies[mostLayers]; // -1 if equal depths of this layer and the next are out of order, else 0
    int layers = 0;
};

// The first pixel in [begin, end) where a layer does not come before the next; end if there is none.
inline int firstOutOfOrderPlain(const OrderedDepths& order, int begin, int end)
{
    constexpr int chunk = 16;
    for (int k = 0; k + 1 < order.layers; ++k) {
        const float *front = order.depths[k], *back = order.depths[k + 1];
        const bool winsTies = order.losesTies[k] == 0;
        int x = begin;
        for (; x + chunk <= end; x += chunk) {
            int wrong = 0;
            if (winsTies)
                for (int i = 0; i < chunk; ++i)
                    wrong |= !(front[x + i] <= back[x + i]);
            else
                for (int i = 0; i < chunk; ++i)
                    wrong |= !(front[x + i] < back[x + i]);
            if (wrong)
                break;
        }
        while (x < end && (winsTies ? front[x] <= back[x] : front[x] < back[x]))
            ++x;
        end = x;
    }
    return end;
}

#if defined(DFB_HAS_AVX2_CLONES)

// Compares all layers of eight pixels, then of the next eight, so that each depth is loaded once.
DFB_AVX2 inline int firstOutOfOrderAvx2(const OrderedDepths& order, int begin, int end)
{
    constexpr int chunk = 8;
    for (int x = begin; x < end; x += chunk) {
        const int count = std::min(chunk, end - x);
        const __m256i lanes = _mm256_cmpgt_epi32(_mm256_set1_epi32(count), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
        const auto* const* depths = order.depths;
        __m256 wrong = _mm256_setzero_ps();
        __m256 front = _mm256_maskload_ps(depths[0] + x, lanes);
        for (int k = 0; k + 1 < order.layers; ++k) {
            const __m256 back = _mm256_maskload_ps(depths[k + 1] + x, lanes);
            _mm_prefetch(reinterpret_cast<const char*>(depths[k + 1] + x + 128), _MM_HINT_T0); // rows to come
            // Without a branch: it would be unpredictable where depths are random.
            const __m256 losesTies = _mm256_castsi256_ps(_mm256_set1_epi32(order.losesTies[k]));
            wrong = _mm256_or_ps(wrong, _mm256_cmp_ps(front, back, _CMP_NLE_UQ));
            wrong = _mm256_or_ps(wrong, _mm256_and_ps(losesTies, _mm256_cmp_ps(front, back, _CMP_EQ_OQ)));
            front = back;
        }
        const int bits = _mm256_movemask_ps(_mm256_and_ps(wrong, _mm256_castsi256_ps(lanes)));
        if (bits != 0)
            return x + __builtin_ctz(static_cast<unsigned>(bits));
    }
    return end;
}

#endif

inline int firstOutOfOrder(const OrderedDepths& order, int begin, int end)
{
    return DFB_FASTEST(firstOutOfOrderPlain, firstOutOfOrderAvx2, order, begin, end);
}

// ---- sorting four pixels at once

// Batcher's odd-even merge sort (1968): the pairs of places to compare and exchange, in this order, whatever their
// values. It is the network for the next power of 2 without the places beyond the layers, which would hold the largest
// values.
class SortNetwork {
public:
    static constexpr int mostLayers = 128;
    struct Exchange {
        std::uint8_t low, high;
    };

    explicit SortNetwork(int layers) : layers_(layers)
    {
        for (int sorted = 1; sorted < layers; sorted *= 2)
            for (int step = sorted; step >= 1; step /= 2)
                for (int i = step % sorted; i + step < layers; ++i)
                    if ((i - step % sorted) / step % 2 == 0 && i / (2 * sorted) == (i + step) / (2 * sorted))
                        exchanges_.push_back({static_cast<std::uint8_t>(i), static_cast<std::uint8_t>(i + step)});
    }

    // This thread's network for so many layers, made when it is first needed.
    static const SortNetwork& of(int layers)
    {
        static thread_local std::array<std::vector<SortNetwork>, mostLayers + 1> made;
        auto& one = made[static_cast<std::size_t>(layers)];
        if (one.empty())
            one.push_back(SortNetwork(layers));
        return one.front();
    }

    int layers() const noexcept { return layers_; }
    auto begin() const noexcept { return exchanges_.begin(); }
    auto end() const noexcept { return exchanges_.end(); }

private:
    int layers_;
    std::vector<Exchange> exchanges_;
};

// [place][pixel]: which layer is in this place of the order, at each of four pixels.
using FourOrders = std::uint32_t[SortNetwork::mostLayers][4];

// Sorting moves one number for each layer: its depth as a double, whose last 29 bits are 0, with the layer's index in
// the last bits. That orders by depth, then index. In a negative number the index is complemented, as more bits make it
// less. Infinities are replaced by finite numbers, as an infinity with more bits would be a NaN. Both zeros become one
// number, which is less than all floats above 0. A NaN counts as +infinity.
constexpr double infinityKey = 0x1p200, zeroKey = 0x1p-200;
constexpr std::int64_t layerBits = SortNetwork::mostLayers - 1;

inline double sortKey(float depth, int layer)
{
    double key = static_cast<double>(depth);
    key = key == 0.0 ? zeroKey : key;
    key = key < infinityKey ? key : infinityKey;
    key = key > -infinityKey ? key : -infinityKey;
    std::int64_t bits = 0;
    std::memcpy(&bits, &key, sizeof bits);
    bits |= bits < 0 ? layerBits - layer : layer;
    std::memcpy(&key, &bits, sizeof key);
    return key;
}

inline std::uint32_t layerOf(double key)
{
    std::int64_t bits = 0;
    std::memcpy(&bits, &key, sizeof bits);
    return static_cast<std::uint32_t>((bits < 0 ? ~bits : bits) & layerBits);
}

// `depths`: for each layer of the network, the depth of the first of four pixels.
inline void sortFourPlain(const float* const* depths, const SortNetwork& network, FourOrders& orders)
{
    double keys[SortNetwork::mostLayers][4];
    for (int k = 0; k < network.layers(); ++k)
        for (int p = 0; p < 4; ++p)
            keys[k][p] = sortKey(depths[k][p], k);
    for (const SortNetwork::Exchange& e : network)
        for (int p = 0; p < 4; ++p) {
            const double a = keys[e.low][p], b = keys[e.high][p];
            keys[e.low][p] = a < b ? a : b;
            keys[e.high][p] = a < b ? b : a;
        }
    for (int k = 0; k < network.layers(); ++k)
        for (int p = 0; p < 4; ++p)
            orders[k][p] = layerOf(keys[k][p]);
}

#if defined(DFB_HAS_AVX2_CLONES)

DFB_AVX2 inline void sortFourAvx2(const float* const* depths, const SortNetwork& network, FourOrders& orders)
{
    alignas(32) double keys[SortNetwork::mostLayers][4];
    const __m256i zero = _mm256_setzero_si256(), all = _mm256_set1_epi64x(layerBits);
    const __m256d most = _mm256_set1_pd(infinityKey), least = _mm256_set1_pd(-infinityKey);
    const __m256d tiny = _mm256_set1_pd(zeroKey);
    for (int k = 0; k < network.layers(); ++k) {
        __m256d key = _mm256_cvtps_pd(_mm_loadu_ps(depths[k]));
        key = _mm256_blendv_pd(key, tiny, _mm256_cmp_pd(key, _mm256_setzero_pd(), _CMP_EQ_OQ));
        key = _mm256_max_pd(_mm256_min_pd(key, most), least); // if either is NaN, these return the second
        const __m256i isNegative = _mm256_cmpgt_epi64(zero, _mm256_castpd_si256(key));
        const __m256i layer = _mm256_xor_si256(_mm256_set1_epi64x(k), _mm256_and_si256(isNegative, all));
        _mm256_store_pd(keys[k], _mm256_or_pd(key, _mm256_castsi256_pd(layer)));
    }
    for (const SortNetwork::Exchange& e : network) {
        const __m256d a = _mm256_load_pd(keys[e.low]), b = _mm256_load_pd(keys[e.high]);
        _mm256_store_pd(keys[e.low], _mm256_min_pd(a, b));
        _mm256_store_pd(keys[e.high], _mm256_max_pd(a, b));
    }
    const __m256i lowWords = _mm256_setr_epi32(0, 2, 4, 6, 0, 2, 4, 6);
    for (int k = 0; k < network.layers(); ++k) {
        const __m256i key = _mm256_castpd_si256(_mm256_load_pd(keys[k]));
        const __m256i layer = _mm256_and_si256(_mm256_xor_si256(key, _mm256_cmpgt_epi64(zero, key)), all);
        _mm_storeu_si128(reinterpret_cast<__m128i*>(orders[k]),
                         _mm256_castsi256_si128(_mm256_permutevar8x32_epi32(layer, lowWords)));
    }
}

#endif

inline void sortFour(const float* const* depths, const SortNetwork& network, FourOrders& orders)
{
    DFB_FASTEST(sortFourPlain, sortFourAvx2, depths, network, orders);
}

// ---- the nearest

// A row in which the nearest pixels are kept. At first all depths are +infinity.
struct NearestBytes {
    std::vector<float> depth;
    std::vector<std::byte> bytes; // 4 a pixel

    void reset(int width)
    {
        depth.assign(static_cast<std::size_t>(width), std::numeric_limits<float>::infinity());
        bytes.resize(4 * depth.size());
    }
};

// Pixels of a layer, read where they lie.
struct ByteLayer {
    const std::byte* bytes;
    const float* depth;
    float depthLimit; // at this depth or beyond a pixel is empty
};

// Takes those pixels of a layer that are nearer than `depth`, with their bytes unchanged; a depth of -0 becomes 0.
// `depth` and `bytes` are those of the nearest pixels so far. Returns how many depths are NaN: these pixels are empty.
inline std::uint64_t keepBytesPlain(float* depth, std::byte* bytes, int count, const ByteLayer& layer)
{
    std::uint64_t nan = 0;
    for (int i = 0; i < count; ++i) {
        const float its = layer.depth[i];
        nan += its != its;
        if (its < depth[i] && its < layer.depthLimit) {
            depth[i] = its + 0.0f;
            std::memcpy(bytes + 4 * i, layer.bytes + 4 * i, 4);
        }
    }
    return nan;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline std::uint64_t keepBytesAvx2(float* depth, std::byte* bytes, int count, const ByteLayer& layer)
{
    const __m256 limit = _mm256_set1_ps(layer.depthLimit), zero = _mm256_setzero_ps();
    std::uint64_t nan = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        const __m256 its = _mm256_loadu_ps(layer.depth + i), nearest = _mm256_loadu_ps(depth + i);
        const __m256 isNearer =
            _mm256_and_ps(_mm256_cmp_ps(its, nearest, _CMP_LT_OQ), _mm256_cmp_ps(its, limit, _CMP_LT_OQ));
        _mm256_storeu_ps(depth + i, _mm256_blendv_ps(nearest, _mm256_add_ps(its, zero), isNearer));
        auto* to = reinterpret_cast<__m256i*>(bytes + 4 * i);
        const __m256i from = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(layer.bytes + 4 * i));
        _mm256_storeu_si256(to, _mm256_blendv_epi8(_mm256_loadu_si256(to), from, _mm256_castps_si256(isNearer)));
        for (int bits = _mm256_movemask_ps(_mm256_cmp_ps(its, its, _CMP_UNORD_Q)); bits != 0; bits &= bits - 1)
            ++nan;
    }
    const ByteLayer rest{layer.bytes + 4 * i, layer.depth + i, layer.depthLimit};
    return nan + keepBytesPlain(depth + i, bytes + 4 * i, count - i, rest);
}
#endif

inline std::uint64_t keepNearestBytes(float* depth, std::byte* bytes, int count, const ByteLayer& layer)
{
    return DFB_FASTEST(keepBytesPlain, keepBytesAvx2, depth, bytes, count, layer);
}

} // namespace detail
DFB_NAMESPACE_END
