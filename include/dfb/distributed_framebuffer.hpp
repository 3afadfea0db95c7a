// DistributedFrameBuffer: tiles of many ranks become one image, each tile on its own: it goes to its owner as
// soon as it is set, the tile operation makes the finished tile when all its inputs have come, the pixel operation
// post-processes it, and it goes to the display rank (section 3 of the paper).
#pragma once

#include <dfb/frame.hpp>
#include <dfb/frame/engine.hpp>
#include <dfb/fwd.hpp>
#include <dfb/pixel_op.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

namespace dfb {

// One object per rank; construction and destruction are collective over the communicator. begin() and end() are called
// by one thread at a time.
template <class TileOp, class PixelOp, class Transport>
class DistributedFrameBuffer {
    static_assert(detail::checkTileOp<TileOp>());
    static_assert(detail::checkPixelOp<PixelOp>());
    static_assert(detail::checkTransport<Transport>());

    using Engine = detail::Engine;
    using Operations = detail::OperationsOf<TileOp, PixelOp>;

public:
    using Config = FrameBufferConfig;
    using Communicator = typename Transport::Communicator;
    using Tile = dfb::Tile<TileOp::channels, detail::TileSizeOf<TileOp>::value>;
    using TileView = dfb::TileView<TileOp::channels, detail::TileSizeOf<TileOp>::value>;
    using TileFrameData = typename Operations::TileFrameData;
    using PixelFrameData = typename Operations::PixelFrameData;

    // A frame that has begun. Leaving its scope without end() cancels it on all ranks.
    class Frame {
    public:
        Frame(Frame&& other) noexcept
            : fb_(other.fb_), engine_(other.engine_), number_(other.number_),
              isOpen_(std::exchange(other.isOpen_, false))
        {
        }
        Frame& operator=(Frame&&) = delete;
        ~Frame()
        {
            if (isOpen_)
                engine_->leave();
        }

        std::int64_t number() const noexcept { return number_; }

        // Makes `tile` this frame's tile of that index and pass: all pixels cleared, generation 0, no children, source
        // this rank, part 0. Throws InvalidArgument for an index or a pass that the frame does not have.
        void start(Tile& tile, int tileIndex, int pass = 0) const
        {
            static_cast<TileHeader&>(tile) = engine_->headerOf(tileIndex, pass);
            tile.clear(engine_->sent());
        }
        // The same for a view, of nothing yet.
        void start(TileView& tile, int tileIndex, int pass = 0) const
        {
            const TileHeader header = engine_->headerOf(tileIndex, pass);
            tile = TileView();
            static_cast<TileHeader&>(tile) = header;
        }

        // Hands over a rendered tile; the active pixels leave for the owner at once, and `tile` can be used again.
        // From any thread. Waits only while this rank has more under way than messages.poolBytes, and meanwhile runs
        // tasks of the executor (with Progress::Caller it waits only on a thread that may poll). Throws
        // InvalidArgument, with nothing sent, for a tile of another frame, an index, region or pass that the frame does
        // not have, a negative generation or number of children. What is wrong with it as an input comes out of end().
        // In a frame that has failed: does nothing.
        void setTile(const Tile& tile) { engine_->setTile(tile); }
        // The same for pixels that lie elsewhere, and are not looked at any more when it returns. Throws
        // InvalidArgument, too, if a channel that has to travel is null.
        void setTile(const TileView& tile) { engine_->setTile(tile); }

        // What nobody can see need not be rendered, with an operation that says so (TileOp::opaqueHides()): true if an
        // opaque input of that tile, of a lower generation, is known to have been sent by this rank or another.
        // setTile() drops what is hidden. From any thread, as the next two.
        bool isHidden(int tileIndex, int generation) const { return engine_->isHidden(tileIndex, generation); }
        // Whether `tile`, which has been set, hides those of a higher generation: if so, let the ranks know that have
        // any.
        bool hidesRest(const Tile& tile) const { return engine_->opaqueHides(tile.tile) && tile.isOpaque(); }
        bool hidesRest(const TileView& tile) const { return engine_->opaqueHides(tile.tile) && tile.isOpaque(); }
        // Lets `rank` know that inputs from this generation on cannot be seen. What it has sent by then is dropped by
        // the owner, and counted as late if the frame is over. Throws InvalidArgument where everything counts.
        void hide(int tileIndex, int generation, int rank) const { engine_->hide(tileIndex, generation, rank); }

        // Only with FrameConfig::declared: each rank says once in each frame which inputs of generation 1 it will send,
        // in each pass; children that these announce need no declaration; it may say so after it sent some. A rank
        // without any calls it with none. An input that turns out empty must be sent all the same; it costs a header.
        // A rank that declares what it declared last sends nothing for it, but for its part of a reduction; otherwise
        // it tells the owners that it touches or touched, as far as it is news to them. Waits for nothing. Throws
        // InvalidArgument, with nothing declared, for a tile outside the image, a second time in a frame, and in a
        // frame that was not begun so; without it, the frame fails in end().
        void declare(const std::vector<TileInput>& inputs) { engine_->declare(inputs); }

        // As FrameConfig::maxLayers, for who knows it only now; may differ between ranks. Before the first setTile().
        void expectLayers(int layers) { engine_->expectLayers(layers); }

        // How many samples a tile gets in this frame, and which.
        TileSamples samples(int tileIndex) const { return engine_->samples(tileIndex); }

        // A range of jobs for this rank out of [0, count), all of which every rank could do; over all ranks each comes
        // up once. Empty: there are no more, or the frame has failed. `count` must be the same on all ranks and calls;
        // only by the thread that began the frame, and not in a task: waits for the answer of another rank, which is
        // asked while the range before is worked on. Throws TransportError.
        JobRange nextJobs(std::int64_t count) const { return engine_->nextJobs(count); }

        // Adds to what FrameReport::figures has for this key, on all ranks. For what a renderer measures and all ranks
        // must know alike, such as the cost of a brick: it travels with the verdict. From any thread.
        void addFigure(std::uint64_t key, double value) const { engine_->addFigure(key, value); }

        // An input of that tile was simplified, which may have changed a pixel of one pass by `bound`; for
        // FrameReport::mergeErrorBound. From any thread.
        void noteMergeError(int tileIndex, double bound) const { engine_->noteMergeError(tileIndex, bound); }

        // Whether the frame has failed on some rank: rendering on is of no use. From any thread.
        bool failed() const noexcept { return engine_->failed(); }

        // Calls body(), as what a loop of your own does between begin() and end(), or one tile of it. An exception of
        // it goes to abort() and no further, so that end() throws FrameError with its text on all ranks, this one
        // included: whoever calls this calls end() as well, whatever becomes of it. False if there was one. From any
        // thread, on one rank or all; waits for no other rank. Without it an exception that ends the frame's scope
        // tells the other ranks only that the frame was left.
        template <class Body>
        bool guard(const Body& body)
        {
            return guardAbout(body, nullptr);
        }
        // The same for body() that renders `tile`: the error names it, and with FrameConfig::allowPartial the frame
        // goes on without it alone. Its number is looked at when there is an exception.
        template <class Body>
        bool guard(const Body& body, const TileHeader& tile)
        {
            return guardAbout(body, &tile);
        }

        // Calls job(i, tile) for each i in [0, count), on all workers of the executor and this thread, each with a tile
        // of its own: a Tile, or a TileView if that is asked for. The job calls start(tile, ...), renders, and calls
        // setTile(tile). Returns when all jobs have. An exception of a job makes the frame fail as guard() does; then
        // no other job begins. With allowPartial the frame goes on without the tile that it was about.
        template <class WorkerTile = Tile, class Job>
        void forEachTile(std::int64_t count, const Job& job)
        {
            guard([&] {
                fb_->executor().parallelFor(static_cast<std::size_t>(count), [&](std::size_t i) {
                    if (failed())
                        return;
                    // Each thread keeps one, out of which it is taken, as a renderer that waits inside a job may be
                    // given another job on the same thread.
                    static thread_local std::unique_ptr<WorkerTile> spare;
                    std::unique_ptr<WorkerTile> tile = std::move(spare);
                    if (!tile)
                        tile.reset(new WorkerTile); // start() clears it
                    tile->tile = -1;
                    guard([&] { job(static_cast<std::int64_t>(i), *tile); }, *tile);
                    spare = std::move(tile);
                });
            });
        }

        // Calls render(tile) for each of these tiles and each of its passes, with a tile that start() has made ready;
        // render(tile) calls setTile(tile). Threads and exceptions as above.
        template <class Render>
        void forEachTile(const std::vector<int>& tiles, const Render& render)
        {
            forEachTile(static_cast<std::int64_t>(tiles.size()), [&](std::int64_t i, Tile& tile) {
                const int index = tiles[static_cast<std::size_t>(i)];
                for (int pass = 0; pass < samples(index).count && !failed(); ++pass) {
                    start(tile, index, pass);
                    render(tile);
                }
            });
        }

        // Makes the frame fail on all ranks, with the text of this exception; with FrameConfig::allowPartial it goes on
        // without what the exception was about. `tileIndex`: the tile that it was about, if it was about one; the error
        // will name it. From any thread.
        void abort(const std::exception_ptr& reason, int tileIndex = -1) { engine_->abort(reason, tileIndex); }

        // Makes the frame fail on all ranks with ErrorKind::Cancelled: nobody needs it any more. end() is called all
        // the same; tiles that are set meanwhile are dropped, those that come late counted. From any thread, also
        // during end() or after it, when it does nothing.
        void cancel() const { engine_->cancel(number_); }

        // Collective; for several framebuffers, in the same order on all ranks. This rank's last setTile() must have
        // returned by then: what has not been sent when all ranks are in end() counts as missing. Waits until all tiles
        // of all ranks are finished and the image is complete on the display rank, or the frame has failed, as it does
        // when nothing is under way that could complete it (MissingInput). Throws FrameError, the same
        // on every rank, or TransportError; in both cases the frame is over, and after a FrameError the framebuffer can
        // begin the next. Throws InvalidArgument on a thread that may not call MPI (see Progress): the frame is still
        // open then.
        FrameReport end()
        {
            engine_->requireProgress();
            isOpen_ = false;
            const FrameReport report = engine_->end();
            fb_->lastEnded_ = engine_;
            return report;
        }

        // Whether end() would return without waiting for other ranks: the frame is complete everywhere, or has failed.
        // For programs that have something else to do meanwhile, such as a window: call it again and again, then end().
        // Waits for nobody. The first call begins the end of the frame on this rank, as end() does: this rank's last
        // setTile() must have returned. Moves messages where no thread does, and keeps FrameConfig::timeout. A frame
        // that timed out or is partial may still take a moment in end(). Throws InvalidArgument as end() does.
        bool isDone()
        {
            engine_->requireProgress();
            return engine_->isDone();
        }

        // end() if isDone(), otherwise nothing. Throws what end() throws.
        std::optional<FrameReport> tryEnd() { return isDone() ? std::optional<FrameReport>(end()) : std::nullopt; }

    private:
        template <class Body>
        bool guardAbout(const Body& body, const TileHeader* tile)
        {
            try {
                body();
                return true;
            } catch (...) {
                abort(std::current_exception(), tile ? tile->tile : -1);
                return false;
            }
        }

        friend class DistributedFrameBuffer;
        Frame(DistributedFrameBuffer* fb, Engine* engine) : fb_(fb), engine_(engine), number_(engine->frame()) {}
        DistributedFrameBuffer* fb_;
        Engine* engine_;
        std::int64_t number_;
        bool isOpen_ = true;
    };

    // Collective. Throws InvalidArgument on every rank if the configuration is wrong on any or differs between ranks,
    // TransportError if the transport cannot be used.
    DistributedFrameBuffer(const Communicator& communicator, Config config, PixelOp pixelOp = {})
        : DistributedFrameBuffer(communicator, std::move(config), NetworkConfig(), std::move(pixelOp))
    {
    }

    // The same with a network configuration, for the connection of this framebuffer alone.
    DistributedFrameBuffer(const Communicator& communicator, Config config, NetworkConfig network, PixelOp pixelOp = {})
        : DistributedFrameBuffer(connect<Transport>(communicator, std::move(network)), std::move(config),
                                 std::move(pixelOp))
    {
    }

    // The same over a connection that several framebuffers share; they are made in the same order on all ranks.
    DistributedFrameBuffer(std::shared_ptr<Connection> connection, Config config, PixelOp pixelOp = {})
        : connection_(std::move(connection))
    {
        if (!config.executor)
            config.executor = detail::makeThreads(*connection_);
        for (int slot = 0; slot < std::max(1, config.framesInFlight); ++slot)
            operations_.push_back(std::make_unique<Operations>(pixelOp));
        try {
            makeEngines(config);
        } catch (const InvalidArgument&) {
            // All ranks throw it: the connection's end is in order, so it must not come while an exception passes.
            connection_.reset();
            throw;
        }
    }

    DistributedFrameBuffer(const DistributedFrameBuffer&) = delete;
    DistributedFrameBuffer& operator=(const DistributedFrameBuffer&) = delete;

    // Collective. No frame may be open.
    ~DistributedFrameBuffer() = default;

    int rank() const noexcept { return engine().rank(); }
    int size() const noexcept { return engine().size(); }
    bool isDisplayRank() const noexcept { return rank() == config().image.displayRank; }
    const Config& config() const noexcept { return engine().config(); }
    const TileLayout& layout() const noexcept { return engine().layout(); }
    int tileOwner(int tile) const noexcept { return engine().tileOwner(tile); }
    const std::vector<int>& ownedTiles() const noexcept { return engine().ownedTiles(); }
    Executor& executor() const noexcept { return *config().executor; }

    // On the display rank: the image of the last frame that ended well or partial. It is there until that frame's
    // memory is needed again: until as many begin() after the frame's own as there may be frames in flight. After that,
    // and before the first such frame, it is empty, as it always is elsewhere. By the thread that begins and ends
    // frames, as the next two.
    const Image& image() const noexcept { return lastEnded_->image(); }

    // Collective, outside frames. Returns a copy of the display rank's image() on every rank; empty if that is. For
    // programs in which every rank shows or stores the image. Waits for all ranks; the bytes of the image go along a
    // tree of the ranks. Throws OutOfMemory, TransportError.
    Image imageOnAllRanks() { return lastEnded_->imageOnAllRanks(); }

    // Which frame image() is of, as in FrameReport::frame; -1 if it is empty.
    std::int64_t imageFrame() const noexcept { return lastEnded_->imageFrame(); }

    // On the display rank: whether image() has that tile. It has all of a frame that ended well, see
    // FrameConfig::allowPartial.
    bool isComplete(int tile) const { return lastEnded_->isComplete(tile); }

    // With Progress::Caller, moves messages, unless on a thread that may not be in MPI; with an executor that has no
    // workers, runs the tasks that wait. True if there was anything. Call it now and then while rendering what takes
    // long (setTile() does it, too), so that compositing goes on meanwhile, and no other rank waits in vain for what
    // this one has to say. Otherwise there is no need to. Waits for nothing.
    bool poll() { return engine().poll(); }

    // Begins a frame. Every rank calls it with the same parameters, at its own time: no rank waits for another. Throws
    // InvalidArgument, with nothing sent, if config.framesInFlight frames are open or `params` cannot be. Frames begin
    // and end in the same order on all ranks, and with several in flight also each begin() before or after the same
    // end(): setTile() may wait for room that a rank makes only when it has begun that frame, too. The oldest must end
    // before one too many begins.
    Frame begin(const FrameConfig& params = {}, const TileFrameData& tileData = {},
                const PixelFrameData& pixelData = {})
    {
        Engine& engine = *engines_[next_];
        operations_[next_]->offer(tileData, pixelData);
        engine.begin(params);
        next_ = (next_ + 1) % engines_.size();
        return Frame(this, &engine);
    }

    // Collective, outside frames. Images have this size from now on; image() is empty until the next frame has ended.
    // Operations begin anew, and frames are numbered from 1 again. Throws InvalidArgument, with nothing changed: on
    // this rank if a frame is open, on all ranks if the size cannot be or differs.
    void resize(int width, int height)
    {
        for (const auto& engine : engines_)
            if (engine->isOpen())
                detail::failArgument("resize() while a frame is open: end() it first");
        Config config = this->config();
        config.image.width = width;
        config.image.height = height;
        makeEngines(config);
    }

    using Reduce = dfb::Reduce;

    // Collective, outside frames: combines `values` element by element over all ranks; the result is the same
    // everywhere; a sum that is too large wraps around. For a user's own figures, or to agree on whether all ranks
    // could load their data. Throws InvalidArgument on every rank if their numbers of values differ.
    std::vector<std::int64_t> allReduce(const std::vector<std::int64_t>& values, Reduce how)
    {
        return engine().allReduce(values, how);
    }

    // Collective, outside frames: the bytes of each rank, by rank, on all ranks.
    std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& bytes)
    {
        return engine().allGather(bytes);
    }

private:
    Engine& engine() noexcept { return *engines_.front(); }
    const Engine& engine() const noexcept { return *engines_.front(); }

    void makeEngines(const Config& config)
    {
        std::vector<std::unique_ptr<Engine>> engines;
        try {
            for (std::size_t slot = 0; slot < operations_.size(); ++slot)
                engines.push_back(detail::makeEngine(connection_, config, *operations_[slot], static_cast<int>(slot)));
        } catch (...) {
            engines.clear(); // in order, before the exception passes
            throw;
        }
        engines_ = std::move(engines);
        next_ = 0;
        lastEnded_ = engines_.front().get();
    }

    std::shared_ptr<Connection> connection_;
    // Each pair has one frame at a time; they take turns.
    std::vector<std::unique_ptr<Operations>> operations_;
    std::vector<std::unique_ptr<Engine>> engines_;
    std::size_t next_ = 0;
    Engine* lastEnded_ = nullptr;
};

} // namespace dfb

#if DFB_HAS_BODIES
#include <dfb/frame/frame_engine.hpp>
#endif
