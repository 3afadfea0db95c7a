// Inputs that are read in the sender's memory (TileView::staysUntilEnd): image and report are those of copied inputs,
// bit for bit, also if pixels are NaN or out of range. A rank that breaks its promise is noticed. In one process and
// over MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <algorithm>
#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <limits>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace frame_cases {

namespace {

constexpr int inPlaceWidth = 83, inPlaceHeight = 59, spoiledTile = 8;

// One image per rank, with empty and faulty pixels, as floats or bytes, rows top-down or bottom-up.
class RankImage {
public:
    enum class Memory { Copied, Own, Shared };

    template <class FrameBuffer>
    RankImage(const FrameBuffer& fb, Memory memory, bool hasBytes, bool isBottomUp)
        : memory_(memory), hasBytes_(hasBytes), isBottomUp_(isBottomUp), own_(rows * stride * 20)
    {
        if (memory == Memory::Shared)
            shared_ = fb.sharedMemory(own_.size());
        std::byte* at = memory == Memory::Shared ? shared_.data() : own_.data();
        color_ = at;
        depth_ = reinterpret_cast<float*>(at + 16 * rows * stride);
        std::mt19937 random(static_cast<unsigned>(fb.rank() + 1));
        const float infinity = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
        for (std::size_t i = 0; i < rows * stride; ++i) {
            const auto kind = random() % 100;
            const float alpha = static_cast<float>(random() % 256) / 255;
            float rgba[4] = {0.5f * alpha, 0.25f * alpha, 0.125f * alpha, alpha};
            if (kind < 40 || (i / stride) % 7 == 3)
                std::fill_n(rgba, 4, 0.0f);
            else if (kind == 50 && !hasBytes)
                rgba[kind % 4] = nan;
            else if (kind == 51 && !hasBytes)
                rgba[3] = 1.5f;
            depth_[i] = kind == 60 ? nan : kind == 61 ? infinity : kind == 62 ? -0.0f : static_cast<float>(kind) / 64;
            for (std::size_t c = 0; c < 4; ++c)
                if (hasBytes)
                    color_[4 * i + c] = static_cast<std::byte>(static_cast<int>(255 * rgba[c]));
                else
                    std::memcpy(color_ + 16 * i + 4 * c, &rgba[c], 4);
        }
    }

    // Points the view of a tile to its pixels.
    template <class View>
    void place(View& view) const
    {
        const int row = isBottomUp_ ? inPlaceHeight - 1 - view.region.y0 : view.region.y0;
        const std::size_t first = static_cast<std::size_t>(row) * stride + static_cast<std::size_t>(view.region.x0);
        view.stride = isBottomUp_ ? -static_cast<std::ptrdiff_t>(stride) : static_cast<std::ptrdiff_t>(stride);
        if (hasBytes_)
            view.color8 = reinterpret_cast<const std::uint8_t*>(color_ + 4 * first);
        else
            view.color = reinterpret_cast<const float*>(color_ + 16 * first);
        view.depth = depth_ + first;
        view.valid = {5, 3, 77, 50};
        view.staysUntilEnd = memory_ != Memory::Copied;
    }
    void spoil() { color_[16 * (20 * stride + 40)] ^= std::byte{1}; } // in the valid part of spoiledTile

private:
    static constexpr std::size_t rows = inPlaceHeight, stride = inPlaceWidth + 4;
    Memory memory_;
    bool hasBytes_, isBottomUp_;
    std::vector<std::byte> own_;
    dfb::Buffer shared_;
    std::byte* color_ = nullptr;
    float* depth_ = nullptr;
};

using Memory = RankImage::Memory;

template <class TileOp, class FrameBuffer>
dfb::FrameReport frameOf(FrameBuffer& fb, const RankImage& image, int passes,
                         const std::function<void()>& beforeLastInput = nullptr)
{
    dfb::FrameConfig params;
    params.declared = true;
    params.passes = passes;
    params.background = {0.125f, 0.25f, 0.5f, 1};
    auto frame = fb.begin(params);
    std::vector<dfb::TileInput> inputs;
    for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
        inputs.push_back({tile, static_cast<std::uint32_t>(fb.rank()), 0});
    const auto lastSource = static_cast<std::uint32_t>(fb.size());
    if (beforeLastInput)
        inputs.push_back({spoiledTile, lastSource, 0});
    frame.declare(inputs);
    for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
        for (int pass = 0; pass < passes; ++pass) {
            typename FrameBuffer::TileView view;
            frame.start(view, tile, pass);
            view.generation = 1;
            image.place(view);
            frame.setTile(view);
        }
    if (beforeLastInput) { // its owner reads a tile only when it has all inputs, so nobody reads this one yet
        beforeLastInput();
        typename FrameBuffer::TileView view;
        frame.start(view, spoiledTile, 0);
        view.generation = 1;
        view.source = lastSource;
        image.place(view);
        frame.setTile(view);
    }
    return frame.end();
}

struct InPlace {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        runOp<dfb::BasicAlphaBlend<16>>(connection, "AlphaBlend", result);
        runOp<dfb::BasicDepthComposite<16>>(connection, "DepthComposite", result);
        return result;
    }

    template <class TileOp>
    static void runOp(const std::shared_ptr<dfb::Connection>& connection, const std::string& op, Result& result)
    {
        for (const bool toBytes : {true, false}) {
            dfb::FrameBufferConfig config(inPlaceWidth, inPlaceHeight,
                                          toBytes ? dfb::OutputFormat::SRGBA8 : dfb::OutputFormat::RGBA32F, !toBytes);
            config.quiet = std::chrono::minutes(1); // a rank that looks for messages under way sends some
            config.executor = std::make_shared<dfb::ThreadExecutor>(2);
            dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, Transport> fb(connection, config);
            for (const bool hasBytes : {false, true})
                for (const bool isBottomUp : {false, true})
                    for (const int passes : {1, 3}) {
                        const std::string name = op + (hasBytes ? ", bytes" : ", floats") + (toBytes ? " to bytes" : "")
                                                 + (isBottomUp ? ", bottom-up, " : ", ") + std::to_string(passes);
                        const Shown copied = show<TileOp>(fb, Memory::Copied, hasBytes, isBottomUp, passes);
                        result.expect(copied.report.nonFinitePixels > 0, name + ": no faults");
                        for (const Memory memory : {Memory::Own, Memory::Shared}) {
                            const Shown shown = show<TileOp>(fb, memory, hasBytes, isBottomUp, passes);
                            const std::string where = name + (memory == Memory::Own ? ", own" : ", shared");
                            result.expect(shown.bytes == copied.bytes, where + ": another image");
                            result.expect(shown.report.nonFinitePixels == copied.report.nonFinitePixels
                                              && shown.report.alphaOutsidePixels == copied.report.alphaOutsidePixels,
                                          where + ": other faults: " + std::to_string(shown.report.nonFinitePixels)
                                              + " for " + std::to_string(copied.report.nonFinitePixels));
                            result.expect(shown.report.bytesSent <= copied.report.bytesSent, where + ": more bytes");
                        }
                    }
        }
    }

    struct Shown {
        std::vector<std::byte> bytes;
        dfb::FrameReport report;
    };
    template <class TileOp, class FrameBuffer>
    static Shown show(FrameBuffer& fb, Memory memory, bool hasBytes, bool isBottomUp, int passes)
    {
        const RankImage image(fb, memory, hasBytes, isBottomUp);
        Shown shown;
        shown.report = frameOf<TileOp>(fb, image, passes);
        fb.image().forEachPlane([&](const std::byte* bytes, std::size_t count) {
            shown.bytes.insert(shown.bytes.end(), bytes, bytes + count);
        });
        return shown;
    }
};

// With checksums: if a rank changes pixels that it promised to leave alone, the frame fails on all ranks with an error
// that names the tile, and the next frame is good.
struct BrokenPromise {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        dfb::NetworkConfig network;
        network.checksums = true;
        dfb::FrameBufferConfig config(inPlaceWidth, inPlaceHeight);
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        using TileOp = dfb::BasicAlphaBlend<16>;
        dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, Transport> fb(communicator, config, network);
        for (const Memory memory : {Memory::Own, Memory::Shared}) {
            RankImage image(fb, memory, false, false);
            const std::string text = scene::outcomeOf([&] {
                if (fb.rank() == fb.size() - 1)
                    frameOf<TileOp>(fb, image, 1, [&] { image.spoil(); });
                else
                    frameOf<TileOp>(fb, image, 1);
            });
            const std::string rank = "rank " + std::to_string(fb.size() - 1);
            result.expect(text.find("FrameError") != std::string::npos
                              && text.find("staysUntilEnd") != std::string::npos && text.find(rank) != std::string::npos
                              && text.find("tile 8") != std::string::npos,
                          "not noticed: " + text);
            result.expect(scene::outcomeOf([&] { frameOf<TileOp>(fb, image, 1); }) == "fine", "the next frame fails");
        }
        return result;
    }
};

// An operation that does not say readsInPlace gets copies, whatever the renderer promises.
struct Copies {
    class Op : public dfb::BasicAlphaBlend<16> {
    public:
        static constexpr bool readsInPlace = false;
        void add(dfb::Fragment&& fragment)
        {
            isCopied_ = isCopied_ && (fragment.empty() || fragment.color() != nullptr);
            dfb::BasicAlphaBlend<16>::add(std::move(fragment));
        }
        void finish(dfb::FinishedTile& out)
        {
            if (!isCopied_)
                throw std::runtime_error("an input without colours");
            dfb::BasicAlphaBlend<16>::finish(out);
        }

    private:
        bool isCopied_ = true;
    };

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        dfb::FrameBufferConfig config(inPlaceWidth, inPlaceHeight);
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport> fb(communicator, config);
        const RankImage image(fb, Memory::Own, false, false);
        const std::string text = scene::outcomeOf([&] { frameOf<Op>(fb, image, 1); });
        result.expect(text == "fine", text);
        return result;
    }
};

} // namespace

TEST_CASE("Inputs that are read where they lie give the image of copied ones, bit for bit", "[in_place]")
{
    everywhere<InPlace>();
}

TEST_CASE("With checksums, pixels that change before the frame has ended are noticed", "[in_place]")
{
    everywhere<BrokenPromise>();
}

TEST_CASE("An operation that does not read in place gets copies", "[in_place]") { everywhere<Copies>(); }

} // namespace frame_cases
