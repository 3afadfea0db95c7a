// CompressionMode: the image is the same, and all ranks make the same tries and choices. Errors of codecs. Ranks are
// threads.
#include "catch.hpp"
#include "random_scene.hpp"

#include <dfb/comm/snappy_codec.hpp>
#include <dfb/dfb.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <vector>

TEST_CASE("Frames with and without compression take turns until all ranks have chosen", "[compression]")
{
    const scene::Scene s = scene::makeScene(5, 8);
    constexpr int ranks = 3, frames = 40;
    std::vector<std::vector<bool>> compressed(ranks);
    std::vector<std::uint64_t> hashes;
    std::vector<std::int64_t> bytes(2, 0);
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        auto config = scene::configOf(s);
        config.messages.codec = std::make_shared<dfb::SnappyCodec>();
        config.messages.compression = dfb::CompressionMode::Auto;
        using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, dfb::InprocTransport>;
        Fb fb(communicator, config);
        for (int frame = 0; frame < frames; ++frame) {
            const auto report = scene::renderLoop(fb, s, scene::Loop::Declared);
            compressed[static_cast<std::size_t>(fb.rank())].push_back(report.compressed);
            if (fb.isDisplayRank()) {
                hashes.push_back(scene::Picture(fb.image(), report).hash());
                if (frame > 0)
                    bytes[report.compressed] = report.bytesSent;
            }
        }
    });
    for (const std::vector<bool>& ofRank : compressed)
        CHECK(ofRank == compressed.front());
    const std::vector<bool> first(compressed.front().begin(), compressed.front().begin() + 10);
    CHECK(first == std::vector<bool>{false, true, false, true, false, true, false, true, false, true});
    CHECK(std::count(hashes.begin(), hashes.end(), hashes.front()) == frames);
    CHECK(bytes[1] < bytes[0]);
}

namespace {

// A codec that counts its calls. On some ranks it never gains anything.
class CountingCodec final : public dfb::Codec {
public:
    explicit CountingCodec(bool gains) : gains_(gains) {}
    std::uint8_t id() const noexcept override { return snappy_.id(); }
    std::size_t bound(std::size_t byteCount) const override { return snappy_.bound(byteCount); }
    std::size_t compress(const std::byte* in, std::size_t byteCount, std::byte* out) const override
    {
        ++calls;
        const std::size_t bytes = snappy_.compress(in, byteCount, out);
        return gains_ ? bytes : byteCount;
    }
    bool decompress(const std::byte* in, std::size_t byteCount, std::byte* out, std::size_t rawByteCount) const override
    {
        return snappy_.decompress(in, byteCount, out, rawByteCount);
    }
    mutable std::atomic<int> calls{0};

private:
    dfb::SnappyCodec snappy_;
    bool gains_;
};

} // namespace

TEST_CASE("A rank for which nothing is gained gets its messages as they are", "[compression]")
{
    const scene::Scene s = scene::makeScene(4, 8);
    std::vector<int> calls(2), firstCalls(2);
    std::vector<std::int64_t> links;
    std::size_t wrong = 0;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto config = scene::configOf(s);
        const auto rank = static_cast<std::size_t>(communicator.rank());
        const auto codec = std::make_shared<CountingCodec>(rank == 1);
        config.messages.codec = codec;
        config.messages.compression = dfb::CompressionMode::Auto;
        using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, dfb::InprocTransport>;
        Fb fb(communicator, config);
        for (int frame = 0; frame < 10; ++frame) { // those with odd numbers are with the codec
            const auto report = scene::renderLoop(fb, s, scene::Loop::Listing3);
            if (fb.isDisplayRank()) {
                links.push_back(report.compressed ? report.compressedLinks : -1);
                wrong += scene::wrongValues(scene::Picture(fb.image(), report), scene::referenceOf(s));
            }
            if (frame == 1)
                firstCalls[rank] = codec->calls;
        }
        calls[rank] = codec->calls;
    });
    CHECK((firstCalls[0] > 0 && calls[0] == firstCalls[0]));
    CHECK(calls[1] == 5 * firstCalls[1]);
    CHECK(links == std::vector<std::int64_t>{-1, 1, -1, 1, -1, 1, -1, 1, -1, 1});
    CHECK(wrong == 0);
}

namespace {

// A codec that fails if it is told to.
class FailingCodec final : public dfb::Codec {
public:
    enum class At { Nothing, Bound, Compress, Decompress };

    std::uint8_t id() const noexcept override { return snappy_.id(); }
    std::size_t bound(std::size_t byteCount) const override
    {
        failIf(At::Bound);
        return snappy_.bound(byteCount);
    }
    std::size_t compress(const std::byte* in, std::size_t byteCount, std::byte* out) const override
    {
        failIf(At::Compress);
        return snappy_.compress(in, byteCount, out);
    }
    bool decompress(const std::byte* in, std::size_t byteCount, std::byte* out, std::size_t rawByteCount) const override
    {
        failIf(At::Decompress);
        return snappy_.decompress(in, byteCount, out, rawByteCount);
    }
    std::atomic<At> at{At::Nothing};

private:
    void failIf(At here) const
    {
        if (at == here)
            throw std::runtime_error("this codec cannot");
    }
    dfb::SnappyCodec snappy_;
};

// The errors of two ranks in a frame in which the codec of one of them fails for finished tiles, and whether the next
// frame is right. Each rank renders the tiles that it owns, so no input travels.
struct FailedFrame {
    std::vector<dfb::ErrorInfo> errors = std::vector<dfb::ErrorInfo>(2);
    std::int64_t incomplete = -1;
    int complete = 0;
    std::size_t wrongAfter = 1;
};
FailedFrame frameWithFailing(FailingCodec::At at, int culprit, bool allowPartial, std::chrono::milliseconds timeout)
{
    FailedFrame result;
    scene::Scene s = scene::makeScene(1);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto config = scene::configOf(s);
        config.quiet = std::chrono::milliseconds(20);
        const auto codec = std::make_shared<FailingCodec>();
        config.messages.codec = codec;
        dfb::NetworkConfig network;
        network.sharedMemory = false; // finished tiles travel
        using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, dfb::InprocTransport>;
        Fb fb(communicator, config, network);
        scene::Scene mine = s;
        mine.allowPartial = allowPartial;
        mine.timeout = timeout;
        codec->at = fb.rank() == culprit ? at : FailingCodec::At::Nothing;
        auto& error = result.errors[static_cast<std::size_t>(fb.rank())];
        try {
            const auto report = scene::renderLoop(fb, mine, scene::Loop::ImageOwned);
            error = report.failure.value_or(dfb::ErrorInfo());
            if (fb.isDisplayRank()) {
                result.incomplete = report.tilesIncomplete;
                for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                    result.complete += fb.isComplete(tile);
            }
        } catch (const dfb::FrameError& e) {
            error = e.info();
        }
        codec->at = FailingCodec::At::Nothing;
        const auto report = scene::renderLoop(fb, s, scene::Loop::ImageOwned);
        if (fb.isDisplayRank())
            result.wrongAfter = scene::wrongValues(scene::Picture(fb.image(), report), scene::referenceOf(s));
    });
    return result;
}

} // namespace

TEST_CASE("A codec that cannot compress finished tiles fails the frame; a partial one loses no tile", "[compression]")
{
    constexpr int tiles = 7 * 4;
    for (const auto at : {FailingCodec::At::Bound, FailingCodec::At::Compress})
        for (const bool allowPartial : {false, true}) {
            INFO("at " << static_cast<int>(at) << (allowPartial ? ", partial" : ""));
            const FailedFrame frame = frameWithFailing(at, 1, allowPartial, std::chrono::seconds(2));
            for (const dfb::ErrorInfo& error : frame.errors) {
                CHECK(error.kind == dfb::ErrorKind::UserCode);
                CHECK(error.message == "this codec cannot");
                CHECK(error.rank == 1);
                CHECK(error.tile == -1);
            }
            CHECK(frame.incomplete == (allowPartial ? 0 : -1));
            CHECK(frame.complete == (allowPartial ? tiles : 0));
            CHECK(frame.wrongAfter == 0);
        }
}

TEST_CASE("Finished tiles that cannot be decompressed are lost to a partial frame, which ends", "[compression]")
{
    const FailedFrame frame = frameWithFailing(FailingCodec::At::Decompress, 0, true, std::chrono::milliseconds(0));
    for (const dfb::ErrorInfo& error : frame.errors) {
        CHECK(error.message == "this codec cannot");
        CHECK(error.rank == 0);
    }
    CHECK(frame.incomplete == 14); // the tiles of the other rank
    CHECK(frame.complete == 14);
    CHECK(frame.wrongAfter == 0);
}
