// Verified: a tile operation of the library that checks itself. It compares each finished tile, in all channels that
// the image has, with the reference for the decoded inputs of the tile. For tests, and for users who want proof; slow.
// Dithered values are not the rounded exact ones, and count as wrong, as do those that minTransmittance changes.
//
//   dfb::testing::Verification verification;      // one per rank
//   DistributedFrameBuffer<dfb::testing::Verified<dfb::AlphaBlend>> fb(...);
//   dfb::DataParallelLoop loop(fb, world);
//   loop.render(camera, renderBrick, params, &verification);
//   verification.report()                         // of colour: wrongBytes, ulps; of all else: wrongOthers
#pragma once

#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/error_report.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <mutex>
#include <utility>
#include <vector>

namespace dfb::testing {

// Row y of a channel of a finished tile, as it is stored; null if the channel is not wanted.
inline const std::byte* rowOf(const FinishedTile& out, std::size_t channel, int y)
{
    const std::byte* first = out.planes().at[channel];
    const std::size_t pixelBytes =
        channel == dfb::detail::Color ? bytesPerPixel(out.format()) : 4 * dfb::detail::channelWords[channel];
    return first ? first + static_cast<std::size_t>(y) * out.stride() * pixelBytes : nullptr;
}
inline const float* depthRowOf(const FinishedTile& out, int y)
{
    return dfb::detail::floatsOf(rowOf(out, dfb::detail::Depth, y));
}
inline AuxRow auxRowOf(const FinishedTile& out, int y)
{
    return {dfb::detail::floatsOf(rowOf(out, dfb::detail::Normal, y)),
            dfb::detail::floatsOf(rowOf(out, dfb::detail::Albedo, y)),
            dfb::detail::floatsOf(rowOf(out, dfb::detail::Position, y)),
            dfb::detail::idsOf(rowOf(out, dfb::detail::PrimitiveId, y)),
            dfb::detail::idsOf(rowOf(out, dfb::detail::InstanceId, y))};
}

// Collects the reports of all tiles. Any thread may call the members.
class Verification {
public:
    void add(const ErrorReport& tile)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        report_.add(tile);
    }
    ErrorReport report() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return report_;
    }

private:
    mutable std::mutex mutex_;
    ErrorReport report_; // under mutex_
};

// `Base`: an operation of sort_last.hpp or image_parallel.hpp.
template <class Base>
class Verified {
public:
    static constexpr int tileSize = Base::tileSize;
    static constexpr ChannelMask channels = Base::channels;
    static constexpr ChannelMask neededChannels = Base::neededChannels;
    static constexpr bool activeByDepth = Base::activeByDepth;
    using FrameData = Verification*; // null: nothing is checked

    void newFrame(const TileInfo& info, Verification* verification)
    {
        base_.newFrame(info);
        info_ = info;
        verification_ = verification;
        inputs_.clear();
    }

    void add(Fragment&& fragment)
    {
        if (verification_)
            keep(fragment);
        base_.add(std::move(fragment));
    }

    void finish(FinishedTile& out)
    {
        base_.finish(out);
        if (verification_)
            verification_->add(check(out));
        inputs_.clear();
    }

    void report(TileReport& report) const { base_.report(report); }

private:
    struct Input {
        int pass = 0, generation = 0;
        std::vector<std::pair<std::size_t, Sample>> samples; // by pixel
    };

    void keep(const Fragment& fragment)
    {
        const TileHeader& h = fragment.header();
        Input input;
        input.pass = h.pass;
        input.generation = h.generation;
        FragmentCursor cursor(fragment);
        const auto width = static_cast<std::size_t>(info_.region.width());
        for (int y = 0; y < info_.region.height(); ++y) {
            const FragmentRow row = cursor.next();
            std::size_t k = 0;
            for (int s = 0; s < row.spanCount; ++s)
                for (int i = 0; i < row.spans[s].count; ++i, ++k) {
                    Sample sample;
                    std::copy_n(row.color + 4 * k, 4, sample.rgba.begin());
                    sample.depth = row.depth ? row.depth[k] : 0.0f;
                    sample.source = h.source;
                    sample.part = h.part;
                    sample.aux = auxOf(row, k);
                    input.samples.emplace_back(
                        static_cast<std::size_t>(y) * width + static_cast<std::size_t>(row.spans[s].x + i), sample);
                }
        }
        inputs_.push_back(std::move(input));
    }

    static AuxSample auxOf(const FragmentRow& row, std::size_t k)
    {
        AuxSample aux;
        const auto three = [k](const float* from, std::array<float, 3>& to) {
            if (from)
                std::copy_n(from + 3 * k, 3, to.begin());
        };
        three(row.normal(), aux.normal);
        three(row.albedo(), aux.albedo);
        three(row.position(), aux.position);
        if (row.primitiveId())
            aux.primitiveId = row.primitiveId()[k];
        if (row.instanceId())
            aux.instanceId = row.instanceId()[k];
        return aux;
    }

    ErrorReport check(const FinishedTile& out)
    {
        const auto width = static_cast<std::size_t>(out.width()), height = static_cast<std::size_t>(out.height());
        const auto passes = static_cast<std::size_t>(info_.passes);
        std::sort(inputs_.begin(), inputs_.end(),
                  [](const Input& a, const Input& b) { return a.generation < b.generation; });
        std::vector<std::vector<Sample>> samples(passes * width * height);
        for (const Input& input : inputs_)
            for (const auto& [pixel, sample] : input.samples)
                samples[static_cast<std::size_t>(input.pass) * width * height + pixel].push_back(sample);
        ErrorReport report;
        for (std::size_t y = 0; y < height; ++y)
            for (std::size_t x = 0; x < width; ++x) {
                std::vector<Pixel> pixels;
                for (std::size_t pass = 0; pass < passes; ++pass)
                    pixels.push_back(exactOf(samples[(pass * height + y) * width + x]));
                const Pixel exact = mean(pixels);
                addPixel(report, out, static_cast<int>(y), x, exact);
                addOthers(report, out, static_cast<int>(y), x, exact);
            }
        return report;
    }

    Pixel exactOf(const std::vector<Sample>& samples) const
    {
        switch (Base::rule) {
        case BlendRule::SortByDepth: return composite(samples, info_.background);
        case BlendRule::Nearest: return nearest(samples, info_.background);
        case BlendRule::InOrder: break;
        }
        return compositeInOrder(samples, info_.background);
    }

    static void addPixel(ErrorReport& report, const FinishedTile& out, int y, std::size_t x, const Pixel& exact)
    {
        const std::byte* row = rowOf(out, dfb::detail::Color, y);
        for (std::size_t c = 0; row && c < 4; ++c) {
            if (out.format() == OutputFormat::RGBA32F) {
                float value = 0;
                std::memcpy(&value, row + sizeof value * (4 * x + c), sizeof value);
                report.add(value, exact.rgba[c]);
            } else {
                report.addByte(static_cast<std::uint8_t>(row[4 * x + c]), out.format() == OutputFormat::SRGBA8 && c < 3
                                                                              ? toSrgb8(exact.rgba[c])
                                                                              : toUnorm8(exact.rgba[c]));
            }
        }
    }

    static void addOthers(ErrorReport& report, const FinishedTile& out, int y, std::size_t x, const Pixel& exact)
    {
        const AuxRow row = auxRowOf(out, y);
        if (const float* depth = depthRowOf(out, y))
            report.addOther(depth[x] != exact.depth);
        for (std::size_t c = 0; c < 3; ++c) {
            if (row.normal)
                report.addOther(isWrongMean(row.normal[3 * x + c], exact.normal[c], exact));
            if (row.albedo)
                report.addOther(isWrongMean(row.albedo[3 * x + c], exact.albedo[c], exact));
            if (row.position)
                report.addOther(ulpsBetween(row.position[3 * x + c], exact.position.value[c]) != 0);
        }
        if (row.primitiveId)
            report.addOther(row.primitiveId[x] != exact.primitiveId.value);
        if (row.instanceId)
            report.addOther(row.instanceId[x] != exact.instanceId.value);
    }

    Base base_;
    TileInfo info_;
    Verification* verification_ = nullptr;
    std::vector<Input> inputs_;
};

} // namespace dfb::testing
