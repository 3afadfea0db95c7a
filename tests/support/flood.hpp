// Floods: frames in which every rank sends several inputs for every tile, to framebuffers with the smallest message
// pool. Used with ranks in one process and over MPI.
#pragma once

#include "random_scene.hpp"

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace flood {

// Adds up colours as inputs arrive and keeps no input. Colours are small whole numbers, so any order gives the same
// sum.
class Adder {
public:
    static constexpr int tileSize = 32;
    static constexpr dfb::ChannelMask channels = dfb::colorChannel;

    void newFrame(const dfb::TileInfo& info)
    {
        region_ = info.region;
        sum_.assign(static_cast<std::size_t>(4 * region_.width() * region_.height()), 0.0);
    }
    void add(dfb::Fragment&& fragment)
    {
        dfb::FragmentCursor cursor(fragment);
        for (int y = 0; y < region_.height(); ++y) {
            const dfb::FragmentRow row = cursor.next();
            const float* color = row.color;
            for (int s = 0; s < row.spanCount; ++s) {
                double* to = sum_.data() + 4 * (y * region_.width() + row.spans[s].x);
                for (int i = 0; i < 4 * row.spans[s].count; ++i)
                    to[i] += static_cast<double>(*color++);
            }
        }
    }
    void finish(dfb::FinishedTile& out)
    {
        for (int y = 0; y < region_.height(); ++y)
            out.setRow(y, sum_.data() + 4 * y * region_.width(), nullptr);
    }

private:
    dfb::Region region_;
    std::vector<double> sum_;
};
static_assert(dfb::is_tile_op_v<Adder>);
// The value of a channel at a pixel, in input `part` of rank `rank`.
inline int valueOf(int rank, int part, int x, int y, int channel)
{
    return 1 + (rank * 7 + part * 11 + x * 3 + y * 5 + channel) % 64;
}

template <class Tile>
inline void fillTile(Tile& tile, int rank, int part)
{
    for (int y = 0; y < tile.region.height(); ++y)
        for (int x = 0; x < tile.region.width(); ++x)
            for (int c = 0; c < 4; ++c)
                tile.pixel(x, y)[c] =
                    static_cast<float>(valueOf(rank, part, tile.region.x0 + x, tile.region.y0 + y, c));
}

// Number of values that are not the sum of all inputs.
inline std::size_t wrongSums(const dfb::Image& image, int ranks, int parts)
{
    const scene::Picture p(image, {});
    std::size_t wrong = image.empty(), i = 0;
    for (int y = 0; y < image.height(); ++y)
        for (int x = 0; x < image.width(); ++x)
            for (int c = 0; c < 4; ++c) {
                int sum = 0;
                for (int rank = 0; rank < ranks; ++rank)
                    for (int part = 0; part < parts; ++part)
                        sum += valueOf(rank, part, x, y, c);
                wrong += p.value(i++) != static_cast<float>(sum);
            }
    return wrong;
}
// A square image with `pixels` rows, in RGBA32F, and the smallest possible message pool.
inline dfb::FrameBufferConfig floodConfig(int pixels, std::shared_ptr<dfb::Executor> executor)
{
    dfb::FrameBufferConfig config;
    config.image.width = config.image.height = pixels;
    config.image.format = dfb::OutputFormat::RGBA32F;
    config.messages.poolBytes = 0;
    config.executor = std::move(executor);
    return config;
}
enum class From { Loop, Thread };

// Renders one frame in which every rank sends `parts` inputs for every tile. Calls `around(tile, send)` for each input,
// which must call `send`.
template <class Fb, class Around>
dfb::FrameReport floodFrame(Fb& fb, int parts, From from, const Around& around, int timeoutMs = 0)
{
    dfb::FrameConfig params;
    params.declared = true;
    params.timeout = std::chrono::milliseconds(timeoutMs);
    auto frame = fb.begin(params);
    std::vector<dfb::TileInput> inputs;
    for (int part = 0; part < parts; ++part)
        for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
            inputs.push_back({tile, static_cast<std::uint32_t>(fb.rank()), static_cast<std::uint16_t>(part)});
    frame.declare(inputs);
    const auto sendOne = [&](std::size_t i) {
        const auto tile = std::make_unique<typename Fb::Tile>();
        frame.start(*tile, inputs[i].tile);
        tile->generation = 1;
        tile->part = inputs[i].part;
        fillTile(*tile, fb.rank(), inputs[i].part);
        around(inputs[i].tile, [&] { frame.setTile(*tile); });
    };
    if (from == From::Loop)
        fb.executor().parallelFor(inputs.size(), sendOne);
    else
        for (std::size_t i = 0; i < inputs.size(); ++i)
            sendOne(i);
    return frame.end();
}
template <class Fb>
dfb::FrameReport floodFrame(Fb& fb, int parts, From from, int timeoutMs = 0)
{
    return floodFrame(
        fb, parts, from, [](int, const auto& send) { send(); }, timeoutMs);
}
struct NamedExecutor {
    std::string name;
    std::function<std::shared_ptr<dfb::Executor>()> make;
};

inline std::vector<NamedExecutor> executors()
{
    std::vector<NamedExecutor> all;
    for (const int workers : {1, 2}) {
        const std::string count = std::to_string(workers) + " workers, ";
        all.push_back({count + "threads", [workers] { return std::make_shared<dfb::ThreadExecutor>(workers); }});
#if defined(DFB_HAS_TBB)
        all.push_back({count + "oneTBB", [workers] { return std::make_shared<dfb::TbbExecutor>(workers); }});
#endif
    }
    return all;
}

} // namespace flood
