// An image of which one rank sends more than 2 GiB.
#pragma once

#include "random_scene.hpp"

#include <cstdint>
#include <cstdio>
#include <memory>
#include <string>

// Rank 1 owns all tiles of an image of 12288 x 12288 float pixels, and rank 0 displays it; other ranks have nothing.
// Compares the image value by value and returns what is wrong with it, or "". Takes 2.5 GiB.
template <class Transport>
std::string largeImage(const typename Transport::Communicator& communicator, bool sharedMemory)
{
    constexpr int side = 12288;
    const auto value = [](int x, int y, int c) { // of an opaque pixel, which reaches the image unchanged
        const auto h = static_cast<std::uint32_t>(y * side + x) * 0x9e3779b1u;
        return static_cast<float>((h >> (8 * c)) & 0xff) / 256.0f;
    };
    dfb::FrameBufferConfig config;
    config.image.width = config.image.height = side;
    config.image.format = dfb::OutputFormat::RGBA32F;
    config.executor = std::make_shared<dfb::ThreadExecutor>(1);
    config.image.ownerMap = [](int, const dfb::TileLayout&, int ranks) { return ranks > 1 ? 1 : 0; };
    dfb::NetworkConfig options;
    options.sharedMemory = sharedMemory;
    dfb::DistributedFrameBuffer<dfb::BasicImageParallel<256>, dfb::NoPixelOp, Transport> fb(communicator, config,
                                                                                            options);
    dfb::ImageParallelLoop loop(fb);
    dfb::FrameReport report;
    for (int frame = 0; frame < 2; ++frame) // a shared image is in use from the second frame on at the latest
        report = loop.render([&](auto& tile) {
            tile.forEachPixel([&](int x, int y, float* rgba, float&) {
                for (int c = 0; c < 3; ++c)
                    rgba[c] = value(x, y, c);
                rgba[3] = 1;
            });
        });
    constexpr std::uint64_t bytes = std::uint64_t{16} * side * side;
    std::printf("rank %d: %.0f ms a frame, %.3f GB sent in %lld messages, %.3f GB of memory\n", fb.rank(),
                report.totalMs, static_cast<double>(report.bytesSent) * 1e-9,
                static_cast<long long>(report.messagesSent), static_cast<double>(report.peakMemoryBytes) * 1e-9);
    if (!fb.isDisplayRank())
        return "";
    if (fb.size() > 1 && static_cast<std::uint64_t>(report.bytesSent) < bytes)
        return "only " + std::to_string(report.bytesSent) + " bytes were sent";
    if (fb.image().pixelCount() * 16 != bytes)
        return "the image has another size";
    std::uint64_t wrong = 0;
    const float* pixel = fb.image().rgba32f();
    for (int y = 0; y < side; ++y)
        for (int x = 0; x < side; ++x, pixel += 4)
            wrong += pixel[0] != value(x, y, 0) || pixel[1] != value(x, y, 1) || pixel[2] != value(x, y, 2)
                     || pixel[3] != 1.0f;
    return wrong == 0 ? "" : std::to_string(wrong) + " pixels are wrong";
}
