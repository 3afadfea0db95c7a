// RunConfig: converts the options to what the library takes: the framebuffer's configuration, the world, the wall.
#pragma once

#include "options.hpp"
#include "rank_scene.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <memory>
#include <stdexcept>

namespace example {

// The tiles have all channels that the renderer can fill. Channels that no image has are not sent.
inline constexpr dfb::ChannelMask tileChannels = dfb::allChannels & ~dfb::farChannel;
using BlendOp = dfb::BasicAlphaBlend<64, tileChannels>;
using SingleOp = dfb::BasicImageParallel<64, tileChannels>;

// Which tile operation the options ask for.
enum class Compositing {
    Single,         // every rank has the whole scene, so a tile has one input
    SingleVerified, // which checks itself
    SingleAdaptive, // of which tiles have different numbers of samples
    Sort,
    SortVerified,
    SortAdaptive,
    Order,
    Nearest,
    Deep
};

inline Compositing compositingOf(const Options& o)
{
    if (o.isDeep())
        return Compositing::Deep;
    if (o.mode == Mode::Image && (o.verify || o.blend == Blending::Sort))
        return o.verify         ? Compositing::SingleVerified
               : o.adaptive > 0 ? Compositing::SingleAdaptive
                                : Compositing::Single;
    if (o.verify)
        return Compositing::SortVerified;
    if (o.blend != Blending::Sort)
        return o.blend == Blending::Order ? Compositing::Order : Compositing::Nearest;
    return o.adaptive > 0 ? Compositing::SortAdaptive : Compositing::Sort;
}

inline bool isSingle(Compositing how)
{
    return how == Compositing::Single || how == Compositing::SingleVerified || how == Compositing::SingleAdaptive;
}

inline bool isAdaptive(Compositing how)
{
    return how == Compositing::SingleAdaptive || how == Compositing::SortAdaptive;
}

// Whether the image needs floats: unless all that is written has 8 bits per channel. Those are too inexact to divide by
// alpha, which a PNG with alpha needs.
inline bool wantsFloat(const Options& o)
{
    return !o.stats.empty() || !o.alpha.empty() || (!o.output.empty() && !o.background) || endingOf(o.output) == ".pfm"
           || o.isExr() || o.pngBits == 16;
}

inline dfb::FrameBufferConfig configOf(const Options& o, int threads)
{
    const auto format = wantsFloat(o) ? dfb::OutputFormat::RGBA32F
                        : !o.output.empty() || !o.depth.empty() || !o.aux.empty() || o.verify || o.live
                            ? dfb::OutputFormat::SRGBA8
                            : dfb::OutputFormat::None;
    dfb::FrameBufferConfig config(o.width, o.height, format);
    config.image.dither = o.dither;
    const dfb::ChannelMask layers = o.isExr() ? o.layers : dfb::ChannelMask{0};
    config.image.depth = !o.depth.empty() || (layers & dfb::depthChannel) != 0;
    config.precision = o.errorBudget > 0 ? dfb::Precision(dfb::ErrorBudget{o.errorBudget}) : dfb::Precision(o.wire);
    config.minTransmittance = o.minTransmittance;
    config.framesInFlight = std::min(o.inFlight, o.frames);
    config.image.aux =
        o.aux.empty() ? static_cast<dfb::ChannelMask>(layers & dfb::imageAuxChannels) : dfb::imageAuxChannels;
    switch (o.ownerMap) {
    case OwnerMap::Auto: break;
    case OwnerMap::Lattice: config.image.ownerMap = dfb::latticeOwner; break;
    case OwnerMap::Linear: config.image.ownerMap = dfb::linearOwner; break;
    case OwnerMap::Hash: config.image.ownerMap = dfb::hashOwner; break;
    }
    if (o.compression == Compression::Auto)
        config.messages.compression = dfb::CompressionMode::Auto;
    if (o.compression != Compression::None) {
#if defined(DFB_HAS_SNAPPY)
        config.messages.codec = std::make_shared<dfb::SnappyCodec>();
#else
        throw std::runtime_error("this dfb_render was built without Snappy");
#endif
    }
#if defined(DFB_HAS_TBB)
    config.executor = std::make_shared<dfb::TbbExecutor>(threads);
#else
    config.executor = std::make_shared<dfb::ThreadExecutor>(threads);
#endif
    return config;
}

inline dfb::NetworkConfig networkOf(const Options& o)
{
    dfb::NetworkConfig options;
    options.sharedMemory = o.sharedMemory;
    options.peerTimeout = std::chrono::seconds(o.peerTimeout);
    return options;
}

inline dfb::World worldOf(const RankScene& scene)
{
    dfb::World world;
    for (const std::uint32_t id : scene.brickIds)
        world.add({id, {scene.bounds[id].lo, scene.bounds[id].hi}});
    return world;
}

// Layout of the wall that the options ask for; the image size is that of all displays and what the bezels hide.
inline dfb::WallLayout wallOf(const Options& o, int rankCount)
{
    dfb::WallLayout layout;
    layout.columns = o.wallColumns;
    layout.rows = o.wallRows;
    layout.bezelX = layout.bezelY = o.bezel;
    layout.displayWidth = (o.width - (o.wallColumns - 1) * o.bezel) / o.wallColumns;
    layout.displayHeight = (o.height - (o.wallRows - 1) * o.bezel) / o.wallRows;
    for (int d = 0; d < layout.displayCount(); ++d)
        layout.ranks.push_back(d % rankCount);
    return layout;
}

} // namespace example
