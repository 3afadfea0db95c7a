// The default look of a volume, from its histogram: the range of values to show, their colours and their opacity. It
// depends only on the whole volume, so it is the same on all ranks.
#pragma once

#include "color_maps.hpp"
#include "file_look.hpp"
#include "transfer_file.hpp"
#include "volume.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <vector>

namespace example {

// How many voxels there are of each value, in bins of equal width.
class Histogram {
public:
    // The bins begin at `lo`. Values beyond them are counted in the outermost bins.
    Histogram(float lo, float width, std::size_t bins) : lo_(lo), width_(width), counts_(bins) {}
    Histogram(float lo, float width, std::vector<std::uint64_t> counts)
        : lo_(lo), width_(width), counts_(std::move(counts))
    {
    }

    void add(float value)
    {
        const float at = (value - lo_) / width_;
        ++counts_[at > 0 ? std::min(static_cast<std::size_t>(std::min(at, 1e9f)), counts_.size() - 1) : 0];
    }
    const std::vector<std::uint64_t>& counts() const { return counts_; }
    float width() const { return width_; }
    float lowerEdge(std::size_t bin) const { return lo_ + width_ * static_cast<float>(bin); }

    std::uint64_t total(std::size_t from = 0) const
    {
        std::uint64_t sum = 0;
        for (std::size_t i = from; i < counts_.size(); ++i)
            sum += counts_[i];
        return sum;
    }
    // The bin that has the quantile `part` of the voxels in bin `from` and above.
    std::size_t quantileBin(double part, std::size_t from = 0) const
    {
        const double before = part * static_cast<double>(total(from));
        double sum = 0;
        for (std::size_t i = from; i < counts_.size(); ++i) {
            sum += static_cast<double>(counts_[i]);
            if (sum > before)
                return i;
        }
        return counts_.size() - 1;
    }
    // The value of that quantile, as if the voxels of a bin were spread evenly in it.
    float quantile(double part, std::size_t from = 0) const
    {
        const std::size_t bin = quantileBin(part, from);
        double before = part * static_cast<double>(total(from));
        for (std::size_t i = from; i < bin; ++i)
            before -= static_cast<double>(counts_[i]);
        const double inBin = static_cast<double>(std::max<std::uint64_t>(1, counts_[bin]));
        return lowerEdge(bin) + width_ * static_cast<float>(std::clamp(before / inBin, 0.0, 1.0));
    }

    // The first bin above the background; 0 if there is no background. Background is a distinct peak at the most
    // frequent value; it ends at the knee of the curve after the peak (triangle method of Zack, Rogers and Latt, 1977).
    std::size_t endOfBackground() const
    {
        std::vector<double> smooth(counts_.size());
        for (std::size_t i = 0; i < smooth.size(); ++i)
            for (std::size_t k = i > 0 ? i - 1 : 0; k <= std::min(i + 1, smooth.size() - 1); ++k)
                smooth[i] += static_cast<double>(counts_[k]) / 3;
        const auto highest = std::max_element(smooth.begin(), smooth.end());
        const std::size_t peak = static_cast<std::size_t>(highest - smooth.begin()), last = quantileBin(0.9999);
        if (*highest * static_cast<double>(smooth.size()) < 4 * static_cast<double>(total()) || last <= peak + 1)
            return 0;
        std::size_t knee = peak + 1;
        double least = 2;
        for (std::size_t i = peak + 1; i < last; ++i) {
            const double away = static_cast<double>(i - peak) / static_cast<double>(last - peak) + smooth[i] / *highest;
            if (away < least) {
                least = away;
                knee = i;
            }
        }
        return knee;
    }

private:
    float lo_, width_;
    std::vector<std::uint64_t> counts_;
};

namespace detail {

// The values of this rank's share of some rows of a volume, which lie on a lattice; up to 512 voxels of each row.
struct LatticeRows {
    std::size_t length = 0; // of a row
    int stride = 1;         // from one of its voxels to the next
    std::vector<float> values;
};

// Collective. Throws std::runtime_error, the same on all ranks.
inline LatticeRows readLattice(const VolumeSource& source, const Loaders& loaders)
{
    const VolumeInfo& info = source.info;
    const std::size_t size = voxelBytes(info.type);
    LatticeRows lattice;
    lattice.stride = 1 + (info.dims[0] - 1) / 512;
    lattice.length = static_cast<std::size_t>(1 + (info.dims[0] - 1) / lattice.stride);
    const auto rows = [&info](std::size_t axis) {
        return static_cast<std::uint64_t>(1 + (info.dims[axis] - 1) / latticeStride(info, axis));
    };
    loaders.gatherOf<char>([&] {
        std::vector<std::byte> row(static_cast<std::size_t>(info.dims[0]) * size);
        const BoxReader read = source.open();
        const auto [begin, end] = loaders.shareOf(rows(1) * rows(2));
        for (std::uint64_t i = begin; i < end; ++i) {
            const int y = static_cast<int>(i % rows(1)) * latticeStride(info, 1),
                      z = static_cast<int>(i / rows(1)) * latticeStride(info, 2);
            read({0, y, z}, {info.dims[0], y + 1, z + 1}, row.data());
            for (std::size_t x = 0; x < lattice.length; ++x)
                lattice.values.push_back(
                    voxelValue(info.type, row.data() + x * static_cast<std::size_t>(lattice.stride) * size));
        }
        return std::vector<char>();
    });
    return lattice;
}

inline bool isInteger(VoxelType type) { return type != VoxelType::Float32; }

inline Histogram countedOver(const VolumeSource& source, const LatticeRows& lattice, float lo, float hi,
                             const Loaders& loaders)
{
    const bool isWhole = isInteger(source.info.type);
    // For integers, each bin holds equally many of them.
    const float most = 2048, width = isWhole ? std::max(1.0f, std::ceil((hi - lo + 1) / most)) : (hi - lo) / most;
    const std::size_t bins =
        static_cast<std::size_t>(std::clamp(std::ceil((hi - lo) / width) + isWhole, 1.0f, most + 1));
    // The counts of all ranks, one rank after the other.
    const std::vector<std::uint64_t> ofRanks = loaders.gatherOf<std::uint64_t>([&] {
        Histogram mine(lo, width, bins);
        for (const float value : lattice.values)
            mine.add(value);
        return mine.counts();
    });
    std::vector<std::uint64_t> sums(bins);
    for (std::size_t i = 0; i < ofRanks.size(); ++i)
        sums[i % bins] += ofRanks[i];
    return Histogram(lo, width, std::move(sums));
}

// Collective. If the values of nearly all voxels are close together, the histogram covers only these.
inline Histogram histogramOf(const VolumeSource& source, const LatticeRows& lattice, const Loaders& loaders)
{
    Histogram histogram = countedOver(source, lattice, source.info.least, source.info.maximum, loaders);
    for (int again = 0; again < 2; ++again) {
        const std::size_t first = histogram.quantileBin(0.0001), last = histogram.quantileBin(0.9999),
                          bins = histogram.counts().size();
        const float lo = histogram.lowerEdge(first), hi = histogram.lowerEdge(last + 1);
        if (bins < 512 || last - first >= bins / 16 || (isInteger(source.info.type) && histogram.width() <= 1)
            || !(lo + (hi - lo) / 2048 > lo))
            break;
        histogram = countedOver(source, lattice, lo, hi, loaders);
    }
    return histogram;
}

// Collective: the sum of `density` along a row, in 1/256 of the largest extent, averaged over the rows that have a
// density; 0 if none has.
template <class Density>
double meanDepth(const VolumeSource& source, const LatticeRows& lattice, const Loaders& loaders, const Density& density)
{
    const Index3& dims = source.info.dims;
    const Vec3 size{static_cast<float>(dims[0]) * source.info.spacing.x,
                    static_cast<float>(dims[1]) * source.info.spacing.y,
                    static_cast<float>(dims[2]) * source.info.spacing.z};
    const double length =
        256.0 * lattice.stride * static_cast<double>(source.info.spacing.x / std::max({size.x, size.y, size.z}));
    const double unit = 1 << 20; // sums of integers do not depend on their order
    std::int64_t sum = 0, rows = 0;
    for (const std::int64_t part : loaders.gatherOf<std::int64_t>([&] {
             std::vector<std::int64_t> depths;
             for (std::size_t first = 0; first < lattice.values.size(); first += lattice.length) {
                 double depth = 0;
                 for (std::size_t x = 0; x < lattice.length; ++x)
                     depth += length * static_cast<double>(density(lattice.values[first + x]));
                 if (depth > 0.25)
                     depths.push_back(static_cast<std::int64_t>(unit * depth));
             }
             return depths;
         })) {
        sum += part;
        ++rows;
    }
    return rows > 0 ? static_cast<double>(sum) / unit / static_cast<double>(rows) : 0;
}

// The density of a normalised value, relative to the densest. `noise`: the part of the range that is background; for a
// diverging map, the part of each half, from the middle.
inline float densityOf(float value, bool isDiverging, float noise)
{
    const float least = std::max(noise, 0.01f); // so that the least values are transparent
    const float far = ((isDiverging ? std::fabs(2 * value - 1) : value) - least) / (1 - least);
    const float v = std::clamp(far, 0.0f, 1.0f);
    return v * std::sqrt(v);
}

// Transfer points with the colours of a map, and opacities for that thickness.
inline TransferPoints pointsOf(const ColorMap& map, double thickness, float opacity, float noise = 0)
{
    TransferPoints colors;
    for (std::size_t i = 0; i < map.colors.size(); ++i) {
        const Vec3 c = colorOf(map.colors[i]);
        colors.push_back({static_cast<float>(i) / static_cast<float>(map.colors.size() - 1), c.x, c.y, c.z, 0});
    }
    TransferPoints points = linearPoints(colors);
    for (TransferPoint& p : points) {
        const double density = static_cast<double>(densityOf(p.value, map.isDiverging, noise));
        p.opacity = opacity * static_cast<float>(std::min(0.95, 1 - std::exp(-thickness * density)));
    }
    return points;
}

} // namespace detail

struct ShownRange {
    float lo = 0, hi = 1;
    float noise = 0; // of a diverging map, as for densityOf()
    bool isTomography = false;
};

namespace detail {

// Scanners store unsigned values 1024 above Hounsfield units.
inline float hounsfieldShift(const VolumeInfo& info) { return info.least < 0 ? 0.0f : 1024.0f; }

// Whether values look like those of a body in a scanner for computed tomography: whole numbers of more than 8 bits,
// with much air and much that is nearly water, little between them, some bone, and nothing far above.
inline bool looksLikeTomography(const VolumeInfo& info, const Histogram& histogram)
{
    if (!isInteger(info.type) || info.type == VoxelType::UInt8)
        return false;
    const float shift = hounsfieldShift(info);
    const auto part = [&](float from, float to) {
        double sum = 0;
        for (std::size_t i = 0; i < histogram.counts().size(); ++i)
            if (const float middle = histogram.lowerEdge(i) + 0.5f * histogram.width();
                middle >= from + shift && middle < to + shift)
                sum += static_cast<double>(histogram.counts()[i]);
        return sum / static_cast<double>(std::max<std::uint64_t>(1, histogram.total()));
    };
    const float infinite = std::numeric_limits<float>::infinity();
    return info.maximum - shift < 4096 && part(-infinite, -850) > 0.1 && part(-150, 200) > 0.1
           && part(200, infinite) > 0.002 && part(-700, -250) < 0.5 * part(-150, 200);
}

} // namespace detail

// Collective: the range to show by default. It begins at the end of the background and leaves out the upper 0.2 % of
// the voxels above that; without a background it leaves out 1 % at each end. For a diverging map and values on both
// sides of zero it is symmetric about zero. None if all voxels have the same value.
inline std::optional<ShownRange> shownRange(const VolumeSource& source, const FileLook& choice, bool isDiverging,
                                            const detail::LatticeRows& lattice, const Loaders& loaders)
{
    if (!(source.info.least < source.info.maximum))
        return std::nullopt;
    const Histogram histogram = detail::histogramOf(source, lattice, loaders);
    if (histogram.quantileBin(0) == histogram.quantileBin(1 - 1e-12))
        return std::nullopt;
    const std::size_t start = histogram.endOfBackground();
    std::array<float, 2> ends{start > 0 ? histogram.lowerEdge(start) : histogram.quantile(0.01),
                              histogram.quantile(start > 0 ? 0.998 : 0.99, start)};
    if (isDiverging) {
        ends = {histogram.quantile(0.002), histogram.quantile(0.998)};
        const float far = std::max(-ends[0], ends[1]);
        if (ends[0] < 0 && ends[1] > 0)
            ends = {-far, far};
    }
    for (std::size_t i = 0; choice.range && i < 2; ++i) {
        const RangeEnd& end = (*choice.range)[i];
        ends[i] = end.isPercent ? histogram.quantile(static_cast<double>(end.value) / 100) : end.value;
    }
    ShownRange range{ends[0], ends[1], 0, detail::looksLikeTomography(source.info, histogram)};
    if (!(range.hi > range.lo))
        range.hi = range.lo + std::max(histogram.width(), 1e-6f * std::fabs(range.lo));
    const float half = 0.5f * (range.hi - range.lo);
    if (isDiverging && start > 0)
        range.noise = std::clamp(1.5f * (histogram.lowerEdge(start) - range.lo - half) / half, 0.0f, 0.9f);
    return range;
}

// Collective: the look that `choice` asks for; what it leaves open comes from the histogram. Throws std::runtime_error,
// the same on all ranks.
inline VolumeLook lookOf(const VolumeSource& source, const FileLook& choice, const Loaders& loaders)
{
    const VolumeInfo& info = source.info;
    VolumeLook look = source.look;
    const float opacity = choice.opacity.value_or(1);
    const ColorMap* map = nullptr;
    const TissuePreset* preset = nullptr;
    const std::string name = choice.transfer == "auto" ? "" : choice.transfer;
    const bool isFree = name.empty() && !choice.range && choice.isovalues.empty() && !choice.color;
    for (const ColorMap& m : colorMaps())
        if (m.name == (name.empty() ? "ember" : name))
            map = &m;
    for (const TissuePreset& p : tissuePresets())
        if (p.name == name)
            preset = &p;
    const detail::LatticeRows lattice = detail::readLattice(source, loaders);
    const auto range = shownRange(source, choice, map && map->isDiverging, lattice, loaders);
    if (!range && isFree) // there is nothing to choose by
        return look;
    if (range) {
        look.lo = range->lo;
        look.hi = range->hi;
    } else if (choice.range && !(*choice.range)[0].isPercent && !(*choice.range)[1].isPercent) {
        look.lo = (*choice.range)[0].value;
        look.hi = (*choice.range)[1].value;
    }
    if (isFree && range && range->isTomography) {
        map = nullptr;
        preset = &tissuePresets().back();
    }
    look.isTomography = range && range->isTomography;
    const float noise = range ? range->noise : 0;
    if (map) {
        const double depth = detail::meanDepth(source, lattice, loaders, [&](float value) {
            return detail::densityOf((value - look.lo) * look.scale(), map->isDiverging, noise);
        });
        // So that e^-2.5 of the light is left on the way through all that is visible.
        look.points = detail::pointsOf(*map, depth > 0 ? std::clamp(2.5 / depth, 0.004, 3.0) : 1.0, opacity, noise);
        if (choice.color && name.empty())
            for (TransferPoint& p : look.points)
                p = {p.value, choice.color->x, choice.color->y, choice.color->z, p.opacity};
    } else if (preset) {
        look.points.clear();
        for (const TissuePoint& p : preset->points) {
            const Vec3 c = detail::colorOf(p.color);
            look.points.push_back({(p.hounsfield - leastHounsfield) / (greatestHounsfield - leastHounsfield), c.x, c.y,
                                   c.z, opacity * p.opacity});
        }
        look.points = detail::linearPoints(look.points);
        // 8-bit values have no known unit, so they keep the range from above.
        const float shift = detail::hounsfieldShift(info);
        if (!choice.range && info.type != VoxelType::UInt8) {
            look.lo = leastHounsfield + shift;
            look.hi = greatestHounsfield + shift;
        }
    } else {
        const std::vector<char> text = loaders.gatherOf<char>([&] {
            const std::string all = loaders.rank() == 0 ? readFile(choice.transfer) : std::string();
            return std::vector<char>(all.begin(), all.end());
        });
        const TransferFile file = parseTransfer(std::string(text.begin(), text.end()), choice.transfer);
        look.points = detail::linearPoints(file.points);
        for (TransferPoint& p : look.points)
            p.opacity *= opacity;
        if (!choice.range && !file.range.empty()) {
            look.lo = file.range[0];
            look.hi = file.range[1];
        }
    }
    if (!(look.scale() > 0 && std::isnormal(look.scale()) && std::isfinite(info.maximum - look.lo)
          && std::isfinite(info.least - look.lo))) // denormal numbers count as 0 while rendering
        throw std::runtime_error(source.name + ": the range from " + textOf(look.lo) + " to " + textOf(look.hi)
                                 + " is too small or too large to tell values apart");
    look.isovalues = choice.isovalues;
    look.isoOpacity = choice.opacity;
    for (const float value : look.isovalues) {
        const TransferPoint p = at(look.points, (value - look.lo) * look.scale());
        look.isoColors.push_back(choice.color                 ? *choice.color
                                 : look.isovalues.size() == 1 ? Vec3{0.72f, 0.62f, 0.48f}
                                                              : Vec3{p.r, p.g, p.b});
    }
    if (!look.isovalues.empty() && choice.transfer.empty())
        for (TransferPoint& p : look.points)
            p.opacity = 0;
    float most = 0;
    for (const TransferPoint& p : look.points)
        most = std::max(most, p.opacity);
    look.standsOutFrom = 0.1f * most;
    return look;
}

} // namespace example
