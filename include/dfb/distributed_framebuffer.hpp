// DistributedFrameBuffer: tiles of many ranks become one image, each tile on its own: it goes to its owner as
// soon as it is set, the tile operation makes the finished tile when all its inputs have come, the pixel operation
// post-processes it, and it goes to the display rank (section 3 of the paper).
#pragma once

#include <dfb/comm/messaging.hpp>
#include <dfb/detail/final_gather.hpp>
#include <dfb/detail/float_environment.hpp>
#include <dfb/detail/frame_gate.hpp>
#include <dfb/detail/manifest.hpp>
#include <dfb/detail/outcome.hpp>
#include <dfb/detail/tile_table.hpp>
#include <dfb/detail/wire.hpp>
#include <dfb/frame.hpp>
#include <dfb/fwd.hpp>
#include <dfb/ops/pixel_ops.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <exception>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace dfb {

// One object per rank; construction and destruction are collective over the communicator. begin() and end() are called
// by one thread at a time.
template <class TileOp, class PixelOp, class Transport>
class DistributedFrameBuffer : private detail::MessageReceiver {
    static_assert(detail::checkTileOp<TileOp>());
    static_assert(detail::checkPixelOp<PixelOp>());
    static_assert(detail::checkTransport<Transport>());

public:
    using Config = FrameBufferConfig;
    using Communicator = typename Transport::Communicator;
    using Tile = dfb::Tile<TileOp::channels, detail::TileSizeOf<TileOp>::value>;
    using TileFrameData = typename detail::FrameDataOf<TileOp>::type;
    using PixelFrameData = typename detail::FrameDataOf<PixelOp>::type;

    // A frame that has begun. Leaving its scope without end() cancels it on all ranks.
    class Frame {
    public:
        Frame(Frame&& other) noexcept : fb_(std::exchange(other.fb_, nullptr)) {}
        Frame& operator=(Frame&&) = delete;
        ~Frame()
        {
            if (fb_)
                fb_->cancel();
        }

        std::int64_t number() const noexcept { return fb_->gate_.frame(); }

        // Makes `tile` this frame's tile of that index and pass: all pixels cleared, generation 0, no children, source
        // this rank, part 0. Throws InvalidArgument for an index or a pass that the frame does not have.
        void start(Tile& tile, int tileIndex, int pass = 0) const { fb_->startTile(tile, tileIndex, pass); }

        // Hands over a rendered tile; the active pixels leave for the owner at once, and `tile` can be used again.
        // From any thread. Waits for nothing. Throws InvalidArgument, with nothing sent, for a tile of another frame,
        // an index, region or pass that the frame does not have, a negative generation or number of children. What is
        // wrong with it as an input comes out of end(). In a frame that has failed: does nothing.
        void setTile(const Tile& tile) { fb_->setTile(tile); }

        // Only with FrameParams::declared: each rank says once which inputs it will send, in each pass, all of
        // generation 1 without children; it may say so after it sent some. A rank without any calls it with none.
        // An input that turns out empty must be sent all the same; it costs a header. Waits for nothing. Throws
        // InvalidArgument for a tile outside the image, or if no declaration is wanted (see declarationKey).
        void declare(const std::vector<TileInput>& inputs) { fb_->declare(inputs); }
        bool wantsDeclaration() const noexcept { return fb_->wantsDeclaration_; }

        // Whether the frame has failed on some rank: rendering on is of no use. From any thread.
        bool failed() const noexcept { return fb_->outcome_->failed(); }

        // Makes the frame fail on all ranks, with the text of this exception. From any thread.
        void abort(const std::exception_ptr& reason) { fb_->failWith(reason); }

        // Collective. Waits until all tiles of all ranks are finished and the image is complete on the display rank, or
        // the frame has failed. Throws FrameError, the same on every rank, or TransportError; in both cases the frame
        // is over, and after a FrameError the framebuffer can begin the next.
        FrameReport end() { return std::exchange(fb_, nullptr)->end(); }

    private:
        friend class DistributedFrameBuffer;
        explicit Frame(DistributedFrameBuffer* fb) : fb_(fb) {}
        DistributedFrameBuffer* fb_;
    };

    // Collective. Throws InvalidArgument on every rank if the configuration is wrong on any or differs between ranks,
    // TransportError if the transport can not be used.
    DistributedFrameBuffer(const Communicator& communicator, Config config, PixelOp pixelOp = {})
        : pool_(MemoryPool::create()), config_(std::move(config)), pixelOp_(std::move(pixelOp))
    {
        if (!config_.executor)
            config_.executor = std::make_shared<ThreadExecutor>();
        detail::MessageReceiver& self = *this;
        messaging_ = std::make_unique<detail::Messaging<Transport>>(communicator, pool_, config_.progress,
                                                                    config_.executor, config_.id, self);
        outcome_ = std::make_unique<detail::FrameOutcome<Transport>>(*messaging_, gate_, FrameVerdict);
        detail::Agreement mine;
        try {
            setUp();
            mine = detail::Agreement::of(config_, Tile::size, Tile::channels, layout().tileCount(),
                                         [this](int tile) { return tileOwner(tile); });
        } catch (const InvalidArgument& e) {
            mine = {false, e.info().message};
        }
        const auto all = detail::Agreement::from(
            messaging_->reduce(OutsideFrames, reductionCount_++, mine.bytes(), detail::Agreement::combine));
        if (!all.fine)
            throw InvalidArgument(all.text);
    }

    DistributedFrameBuffer(const DistributedFrameBuffer&) = delete;
    DistributedFrameBuffer& operator=(const DistributedFrameBuffer&) = delete;

    // Collective. No frame may be open.
    ~DistributedFrameBuffer() = default;

    int rank() const noexcept { return messaging_->rank(); }
    int size() const noexcept { return messaging_->size(); }
    bool isDisplayRank() const noexcept { return rank() == config_.displayRank; }
    const Config& config() const noexcept { return config_; }
    const TileLayout& layout() const noexcept { return tiles_->layout(); }
    int tileOwner(int tile) const noexcept { return tiles_->owner(tile); }
    const std::vector<int>& ownedTiles() const noexcept { return tiles_->owned(); }
    Executor& executor() const noexcept { return *config_.executor; }

    // On the display rank: the image of the last frame that ended well; valid until the next begin(). Empty elsewhere.
    const Image& image() const noexcept { return gather_->image(); }

    // Begins a frame. Every rank calls it with the same parameters, at its own time: no rank waits for another. Throws
    // InvalidArgument, with nothing sent, if a frame is open or `params` can not be.
    Frame begin(const FrameParams& params = {}, const TileFrameData& tileData = {}, const PixelFrameData& pixelData = {})
    {
        if (frameOpen_)
            throw InvalidArgument("begin() while a frame is open: end() it first");
        if (params.passes < 1)
            throw InvalidArgument("a frame has at least 1 pass, not " + std::to_string(params.passes));
        if (params.declarationKey != 0 && !params.declared)
            throw InvalidArgument("a declarationKey without declared inputs");
        messaging_->throwIfFailed();
        const bool reuse = params.declared && params.declarationKey != 0 && params.declarationKey == lastKey_;
        params_ = params;
        lastKey_ = 0;
        wantsDeclaration_ = params.declared && !reuse;
        if (!reuse)
            manifests_.reset();

        TileInfo info;
        info.rank = rank();
        info.frame = gate_.frame() + 1;
        info.passes = params.passes;
        info.wantsDepth = config_.depth;
        info.background = params.background;
        tiles_->newFrame(info, tileData);
        gather_->newFrame(info.frame);
        if constexpr (detail::HasPixelNewFrame<PixelOp>::value)
            pixelOp_.newFrame(pixelData);
        else
            (void)pixelData;

        outcome_->newFrame();
        ownTilesDone_ = endCalled_ = false;
        bytesBefore_ = messaging_->bytesSent();
        messagesBefore_ = messaging_->messagesSent();
        nonFinite_ = renderNs_ = 0;
        // One more than there are tiles, until it is known how many there are.
        tilesLeft_ = 1 + (params.declared ? 0 : static_cast<std::int64_t>(ownedTiles().size()));
        beginTime_ = Clock::now();
        frameOpen_ = true;
        messaging_->expectMessages(true);
        for (auto& early : gate_.open())
            incoming(early.source, early.header, std::move(early.bytes));
        if (!params.declared)
            tileDone();
        else if (reuse)
            guarded([this] { applyDeclarations(); });
        return Frame(this);
    }

    enum class Reduce : std::uint8_t { Sum, Min, Max };

    // Collective, outside frames: combines `values` element by element over all ranks; the result is the same everywhere.
    // For a user's own figures, or to agree on whether all ranks could load their data. Throws InvalidArgument on every
    // rank if their numbers of values differ.
    std::vector<std::int64_t> allReduce(const std::vector<std::int64_t>& values, Reduce how)
    {
        detail::ByteWriter out;
        for (std::int64_t v : values)
            out.put(v);
        const Bytes result =
            messaging_->reduce(OutsideFrames, reductionCount_++, out.take(), [how](const Bytes& a, const Bytes& b) {
                return ReductionTable::combineElements(a, b, [how](std::int64_t x, std::int64_t y) {
                    return how == Reduce::Sum ? x + y : how == Reduce::Min ? std::min(x, y) : std::max(x, y);
                });
            });
        if (result.size() != values.size() * sizeof(std::int64_t))
            throw InvalidArgument("allReduce() was called with different numbers of values on different ranks");
        std::vector<std::int64_t> reduced(values.size());
        detail::ByteReader in(result);
        for (std::int64_t& v : reduced)
            v = in.get<std::int64_t>();
        return reduced;
    }

private:
    using Clock = std::chrono::steady_clock;
    using Bytes = ReductionTable::Bytes;
    using MessageKind = detail::MessageKind;
    enum Scope : std::uint32_t { OutsideFrames, AllDeclared, FrameVerdict };

    static constexpr bool hasPixelOp = !std::is_same_v<PixelOp, NoPixelOp>;

    void setUp()
    {
        if (config_.displayRank < 0 || config_.displayRank >= size())
            throw InvalidArgument("the display rank is " + std::to_string(config_.displayRank) + " of "
                                  + std::to_string(size()));
        const TileLayout layout(config_.width, config_.height, Tile::size);
        tiles_ = std::make_unique<detail::TileTable<TileOp>>(layout, config_.ownerMap ? config_.ownerMap : latticeOwner,
                                                             rank(), size());
        gather_ = std::make_unique<detail::FinalGather>(
            pool_, layout, detail::GatherSettings{config_.format, config_.depth, config_.id, config_.codec},
            isDisplayRank(), size() - 1,
            [this](Buffer&& message) { messaging_->send(config_.displayRank, std::move(message)); });
        wantedChannels_ = static_cast<ChannelMask>(detail::NeededChannelsOf<TileOp>::value
                                                   | (config_.depth ? depthChannel : 0));
    }

    // ---- messages

    void incoming(int source, const detail::MessageHeader& header, Buffer&& message) override
    {
        if (!gate_.enter(source, header, message))
            return;
        guarded([&] { handle(source, header.kind, std::move(message)); }, "in a message from rank " + std::to_string(source));
        gate_.leave();
    }

    void malformed(int source, const std::exception_ptr& error) override
    {
        ErrorInfo where;
        where.message = "in a message from rank " + std::to_string(source);
        failWith(error, where);
    }

    void transportFailed() override { outcome_->setFailed(); }

    void handle(int source, MessageKind kind, Buffer&& message)
    {
        if (kind == MessageKind::Abort) {
            outcome_->setFailed();
            tryVote();
            return;
        }
        if (outcome_->failed())
            return;
        switch (kind) {
        case MessageKind::Fragment: arrive(std::move(message)); break;
        case MessageKind::Manifest:
            if (!wantsDeclaration_) {
                ErrorInfo info;
                info.kind = ErrorKind::Disagreement;
                info.message = "the sender declares its inputs, this rank expects no declaration";
                throw Error(std::move(info));
            }
            manifests_.receive(detail::ByteReader(message.data() + sizeof(detail::MessageHeader),
                                                  message.size() - sizeof(detail::MessageHeader)),
                               [this](int tile) { return tiles_->isMine(tile); });
            messaging_->send(source, MessageKind::ManifestAck, gate_.frame());
            break;
        case MessageKind::ManifestAck:
            if (manifests_.acknowledged())
                enterAllDeclared();
            break;
        case MessageKind::FinishedTiles:
            gather_->receiveTiles(std::move(message));
            tryVote();
            break;
        case MessageKind::TilesDone:
            gather_->receiveDone(message);
            tryVote();
            break;
        default: break;
        }
    }

    // ---- tiles

    void startTile(Tile& tile, int index, int pass) const
    {
        if (index < 0 || index >= layout().tileCount())
            throw InvalidArgument("tile " + std::to_string(index) + " of an image of " + std::to_string(layout().tileCount())
                                  + " tiles");
        if (pass < 0 || pass >= params_.passes)
            throw InvalidArgument("pass " + std::to_string(pass) + " of a frame of " + std::to_string(params_.passes));
        static_cast<TileHeader&>(tile) = {gate_.frame(), index, layout().region(index), pass, 0, 0,
                                          static_cast<std::uint32_t>(rank()), 0};
        tile.clear();
    }

    void setTile(const Tile& tile)
    {
        detail::checkTile(tile, layout(), tiles_->frameInfo());
        if (outcome_->failed())
            return;
        const detail::FloatEnvironment floatEnvironment;
        const bool local = tiles_->isMine(tile.tile);
        std::uint64_t nonFinite = 0;
        Buffer message = detail::encodeFragment(*pool_, tile, wantedChannels_, config_.id,
                                                local ? nullptr : config_.codec.get(), nonFinite);
        if (nonFinite)
            nonFinite_ += static_cast<std::int64_t>(nonFinite);
        if (!local) {
            messaging_->send(tileOwner(tile.tile), std::move(message));
        } else if (gate_.enter(tile.frame)) {
            guarded([&] { arrive(std::move(message)); });
            gate_.leave();
        }
    }

    void arrive(Buffer&& message)
    {
        Fragment fragment = detail::decodeFragment(*pool_, std::move(message), layout(), params_.passes, config_.codec.get());
        const TileHeader h = fragment.header();
        try {
            if (!tiles_->isMine(h.tile))
                detail::failMalformed("an input for a tile of another owner");
            if (tiles_->arrive(std::move(fragment)))
                submitFinish(h.tile);
        } catch (...) {
            ErrorInfo where;
            where.tile = h.tile;
            where.pass = h.pass;
            where.generation = h.generation;
            where.source = h.source;
            failWith(std::current_exception(), where);
        }
    }

    void submitFinish(int tile)
    {
        gate_.enter(gate_.frame()); // we are inside, so it is open
        messaging_->submit([this, tile] {
            if (!outcome_->failed()) {
                try {
                    finish(tile);
                    tileDone();
                } catch (...) {
                    ErrorInfo where;
                    where.tile = tile;
                    failWith(std::current_exception(), where);
                }
            }
            gate_.leave();
        });
    }

    void finish(int tile)
    {
        const detail::FloatEnvironment floatEnvironment;
        const Region region = layout().region(tile);
        if constexpr (!hasPixelOp) {
            auto place = gather_->reserve(tile);
            FinishedTile out(region, config_.format, place.color, place.colorStride, place.depth, place.depthStride);
            tiles_->finish(tile, out);
            gather_->commit(tile, std::move(place));
        } else {
            const auto width = static_cast<std::size_t>(region.width()), height = static_cast<std::size_t>(region.height());
            Buffer color = pool_->acquire(width * height * 4 * sizeof(float));
            Buffer depth = config_.depth ? pool_->acquire(width * height * sizeof(float)) : Buffer();
            auto* depthData = reinterpret_cast<float*>(depth.data());
            FinishedTile out(region, OutputFormat::RGBA32F, color.data(), width * 4 * sizeof(float), depthData, width);
            tiles_->finish(tile, out);
            PixelTile pixels{tile, region, reinterpret_cast<float*>(color.data()), depthData};
            std::as_const(pixelOp_).process(pixels);
            auto place = gather_->reserve(tile);
            for (std::size_t y = 0; y < height && place.color; ++y) {
                detail::convertPixels(pixels.color + 4 * width * y, region.width(), config_.format,
                                      place.color + y * place.colorStride);
                if (place.depth)
                    std::copy_n(depthData + y * width, width, place.depth + y * place.depthStride);
            }
            gather_->commit(tile, std::move(place));
        }
    }

    // One tile less to wait for; or the count of tiles is now complete.
    void tileDone()
    {
        if (--tilesLeft_ != 0)
            return;
        gather_->flush();
        ownTilesDone_ = true;
        tryVote();
    }

    // ---- what is expected, by manifest

    void declare(const std::vector<TileInput>& inputs)
    {
        if (!wantsDeclaration_ || manifests_.declared())
            throw InvalidArgument(!params_.declared ? "declare() in a frame that was not begun with declared inputs"
                                                    : "declare() a second time, or where the last frame's holds");
        for (const TileInput& input : inputs)
            if (input.tile < 0 || input.tile >= layout().tileCount())
                throw InvalidArgument("declare() of tile " + std::to_string(input.tile) + " of an image of "
                                      + std::to_string(layout().tileCount()) + " tiles");
        if (outcome_->failed())
            return;
        const auto manifests = manifests_.split(inputs, rank(), [this](int tile) { return tileOwner(tile); });
        for (const auto& [owner, bytes] : manifests)
            messaging_->send(owner, MessageKind::Manifest, gate_.frame(), bytes);
        if (manifests.empty())
            enterAllDeclared();
    }

    void enterAllDeclared()
    {
        messaging_->reductions().enter({AllDeclared, gate_.frame()}, {}, [](const Bytes& a, const Bytes&) { return a; },
                                       [this, frame = gate_.frame()](const Bytes&) {
                                           if (!gate_.enter(frame))
                                               return;
                                           guarded([this] { applyDeclarations(); });
                                           gate_.leave();
                                       });
    }

    // Every manifest is here: now it is known what each owned tile waits for.
    void applyDeclarations()
    {
        if (outcome_->failed())
            return;
        const auto& expected = manifests_.expected();
        const int stranger = tiles_->firstUndeclared(expected);
        if (stranger >= 0) {
            ErrorInfo info;
            info.kind = ErrorKind::UnannouncedInput;
            info.tile = stranger;
            info.message = "an input came for a tile for which none was declared";
            throw Error(std::move(info));
        }
        const auto declareTile = [&](int tile, const detail::ManifestExchange::Inputs& inputs) {
            ++tilesLeft_;
            try {
                if (tiles_->declare(tile, inputs))
                    submitFinish(tile);
            } catch (...) {
                ErrorInfo where;
                where.tile = tile;
                failWith(std::current_exception(), where);
            }
        };
        for (const auto& [tile, inputs] : expected)
            declareTile(tile, inputs);
        // A pixel operation that is not pointwise sees background tiles too.
        if constexpr (!detail::IsPointwise<PixelOp>::value)
            for (int tile : ownedTiles())
                if (!expected.count(tile))
                    declareTile(tile, {});
        tileDone();
    }

    // ---- failure, verdict, end

    // Runs `body`; what it throws makes the frame fail.
    template <class Body>
    void guarded(const Body& body, std::string place = {})
    {
        try {
            body();
        } catch (...) {
            ErrorInfo where;
            where.message = std::move(place);
            failWith(std::current_exception(), where);
        }
    }

    void failWith(const std::exception_ptr& reason, const ErrorInfo& where = {})
    {
        outcome_->fail(reason, where);
        tryVote();
    }

    // Enters the frame's verdict when all is done here, or the frame has failed somewhere.
    void tryVote()
    {
        outcome_->vote([this] { return endCalled_ && ownTilesDone_ && gather_->complete(); },
                       [this] {
                           detail::Verdict v;
                           v.paramsHash = detail::fingerprintOf(params_);
                           v.sums = {messaging_->bytesSent() - bytesBefore_, messaging_->messagesSent() - messagesBefore_,
                                     ownTilesDone_ ? tiles_->touchedCount() : 0, nonFinite_, gate_.takeLateCount()};
                           v.maxima = {static_cast<std::int64_t>(pool_->peakBytes()), renderNs_};
                           return v;
                       });
    }

    // Waits for the verdict and closes the frame, also when it throws TransportError.
    detail::Verdict conclude()
    {
        renderNs_ = std::chrono::nanoseconds(Clock::now() - beginTime_).count();
        endCalled_ = true;
        std::exception_ptr transportError;
        detail::Verdict verdict;
        try {
            tryVote();
            verdict = outcome_->wait();
        } catch (const TransportError&) {
            transportError = std::current_exception();
        }
        gate_.close();
        messaging_->reductions().forget(AllDeclared, gate_.frame());
        messaging_->expectMessages(false);
        frameOpen_ = false;
        if (transportError || verdict.error)
            gather_->invalidate();
        if (transportError)
            std::rethrow_exception(transportError);
        return verdict;
    }

    FrameReport end()
    {
        if (wantsDeclaration_ && !manifests_.declared() && !outcome_->failed())
            guarded([] { throw InvalidArgument("end() of a frame with declared inputs without declare()"); });
        const detail::Verdict verdict = conclude();
        if (verdict.error)
            throw FrameError(*verdict.error);
        gather_->fillBackground(finishedBackground());
        lastKey_ = params_.declarationKey;

        const double nsPerMs = 1e6;
        FrameReport report;
        report.frame = gate_.frame();
        report.totalMs = static_cast<double>(std::chrono::nanoseconds(Clock::now() - beginTime_).count()) / nsPerMs;
        report.renderMs = static_cast<double>(renderNs_) / nsPerMs;
        report.compositingOverheadMs = report.totalMs - report.renderMs;
        report.renderMsMax = static_cast<double>(verdict.maxima[1]) / nsPerMs;
        report.bytesSent = verdict.sums[0];
        report.messagesSent = verdict.sums[1];
        report.tilesTotal = layout().tileCount();
        report.tilesTouched = verdict.sums[2];
        report.nonFinitePixels = verdict.sums[3];
        report.lateMessages = verdict.sums[4];
        report.peakMemoryBytes = verdict.maxima[0];
        return report;
    }

    // A frame that is left without end(), mostly while an exception passes.
    void cancel() noexcept
    {
        ErrorInfo info;
        info.kind = ErrorKind::Cancelled;
        info.message = "the frame was left without end()";
        try {
            failWith(std::make_exception_ptr(Error(std::move(info))));
            conclude();
        } catch (const TransportError&) {
            // begin() will say so.
        }
    }

    // The background as the pixel operation leaves it.
    std::array<float, 4> finishedBackground() const
    {
        std::array<float, 4> rgba = params_.background;
        if constexpr (hasPixelOp && detail::IsPointwise<PixelOp>::value) {
            const float depth = std::numeric_limits<float>::infinity();
            PixelTile pixel{0, {0, 0, 1, 1}, rgba.data(), config_.depth ? &depth : nullptr};
            pixelOp_.process(pixel);
        }
        return rgba;
    }

    std::shared_ptr<MemoryPool> pool_;
    Config config_;
    PixelOp pixelOp_;
    std::unique_ptr<detail::TileTable<TileOp>> tiles_;
    std::unique_ptr<detail::FinalGather> gather_;
    detail::ManifestExchange manifests_;
    ChannelMask wantedChannels_ = 0;
    std::int64_t reductionCount_ = 0;

    // The frame.
    detail::FrameGate gate_;
    std::unique_ptr<detail::FrameOutcome<Transport>> outcome_;
    FrameParams params_;
    std::uint64_t lastKey_ = 0; // of the declaration that the last frame went by
    bool frameOpen_ = false;
    std::atomic<bool> wantsDeclaration_{false};
    std::atomic<std::int64_t> tilesLeft_{0};
    std::atomic<bool> ownTilesDone_{false}, endCalled_{false};
    std::atomic<std::int64_t> nonFinite_{0}, renderNs_{0};
    std::int64_t bytesBefore_ = 0, messagesBefore_ = 0;
    Clock::time_point beginTime_;

    std::unique_ptr<detail::Messaging<Transport>> messaging_; // last: its tasks use the others
};

} // namespace dfb
