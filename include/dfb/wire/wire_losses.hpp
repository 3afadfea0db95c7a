// WireLosses: bounds how far the pixels of a tile may be off because inputs were rounded for sending, or because layers
// behind nearly opaque ones were left out. This is the bound of wire_format.hpp for the inputs that have come.
#pragma once

#include <dfb/fragment.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <mutex>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// Any thread may call the members, except newFrame().
class WireLosses {
public:
    // `minTransmittance`: that of TileInfo. `background`: the largest of its channels.
    void newFrame(int tileCount, float maxColor, double background, float minTransmittance)
    {
        maxColor_ = static_cast<double>(maxColor);
        background_ = background;
        minTransmittance_ = static_cast<double>(minTransmittance);
        tiles_.assign(static_cast<std::size_t>(tileCount), {});
    }

    void add(const Fragment& fragment, const WireCoder& coder)
    {
        if (fragment.empty())
            return;
        const WireFormat format = fragment.colorFormat();
        double beyond = 0; // the largest colour of this fragment, if it is out of range
        if ((format == WireFormat::Float32 || format == WireFormat::Bytes)
            && !coder.inRange(fragment.color(), static_cast<int>(fragment.storedPixels())))
            beyond = largestOf(fragment);
        const std::lock_guard<std::mutex> lock(mutex_);
        Tile& tile = tiles_[static_cast<std::size_t>(fragment.header().tile)];
        ++tile.layers[static_cast<std::size_t>(format)];
        tile.beyond += beyond;
    }

    // The bound for a tile that is finished.
    double boundOf(int index, int passes)
    {
        Tile tile;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            tile = tiles_[static_cast<std::size_t>(index)];
        }
        const double behind = std::max(maxColor_, background_) + tile.beyond;
        double bound = minTransmittance_ > 0 ? minTransmittance_ * std::max(behind, 1.0) : 0; // `behind` may be inf
        for (const WireFormat format : {WireFormat::Unorm8, WireFormat::Unorm16, WireFormat::Float16})
            if (const std::int64_t layers = tile.layers[static_cast<std::size_t>(format)]; layers > 0) {
                const double its = wireErrorBound(format, layers, maxColor_, behind);
                bound += format == WireFormat::Float16 ? its : its / passes; // the mean over the passes
            }
        return bound;
    }

private:
    struct Tile {
        std::array<std::int64_t, 5> layers{}; // by WireFormat, over all passes
        double beyond = 0;
    };

    // The largest absolute colour. Infinity if one is NaN, or if an alpha is not within [0, 1], as nothing then bounds
    // how much of the layers behind comes through.
    static double largestOf(const Fragment& fragment)
    {
        const float* rgba = fragment.color();
        double largest = 0;
        for (std::size_t i = 0; i < fragment.storedPixels(); ++i, rgba += 4) {
            if (!(rgba[3] >= 0.0f && rgba[3] <= 1.0f))
                return std::numeric_limits<double>::infinity();
            for (int c = 0; c < 3; ++c) {
                const double value = std::abs(static_cast<double>(rgba[c]));
                if (!(value <= largest))
                    largest = value == value ? value : std::numeric_limits<double>::infinity();
            }
        }
        return largest;
    }

    double maxColor_ = 1, background_ = 0, minTransmittance_ = 0;
    std::mutex mutex_;
    std::vector<Tile> tiles_; // under mutex_
};

} // namespace detail
DFB_NAMESPACE_END
