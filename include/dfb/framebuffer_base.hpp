// FrameBufferBase and FrameBase: the members of a DistributedFrameBuffer and of its frames that do not depend on the
// types of operations, transport and tiles. They are no templates, so they are compiled once.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/compiled.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/engine.hpp>
#include <dfb/trace.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

class FrameBufferBase;

// A frame that has begun, without what depends on the type of its tiles: DistributedFrameBuffer::begin() returns a
// BasicFrame. If it is destroyed, or another frame assigned to it, without end(), the frame fails on all ranks, except
// that it may end well after isDone(). Both wait until all ranks know the result. Unless a member says otherwise, any
// thread may call it, it waits for nothing, and the index of a tile is not checked.
class FrameBase {
public:
    FrameBase(FrameBase&&) noexcept = default;

    // The number of the frame, as in FrameReport::frame.
    std::int64_t number() const noexcept { return number_; }

    // The owner of a tile, and the tiles that this rank owns, in this frame.
    int tileOwner(int tile) const noexcept { return engine_->ownerNow(tile); }
    const std::vector<int>& ownedTiles() const noexcept { return engine_->ownedNow(); }

    // True if hide() has told this rank that inputs of this generation cannot be seen: they need not be rendered, and
    // setTile() drops them. Always false unless the operation has opaqueHides().
    bool isHidden(int tileIndex, int generation) const { return engine_->isHidden(tileIndex, generation); }
    // Tells `rank` that inputs of this generation and higher ones cannot be seen. The tile operation drops those that
    // still come. Throws InvalidArgument if there is no such tile or rank, if `generation` is below 1, or if
    // opaqueHides(tileIndex) is false.
    void hide(int tileIndex, int generation, int rank) const
    {
        engine_->tell(rank, {tileIndex, generation, detail::HidingWord::Hides});
    }

    // Whether opaque inputs of that tile hide the inputs behind them in this frame.
    bool opaqueHides(int tileIndex) const { return engine_->opaqueHides(tileIndex); }
    // Tells `rank` that an input of this rank will probably hide the inputs of `rank` in `generation` and higher
    // ones. `rank` should wait before it renders them. This rank must then call hide() or, if they can be seen,
    // show(). If its own input is hidden as well, it calls hide(). Throws as hide().
    void mayHide(int tileIndex, int generation, int rank) const
    {
        engine_->tell(rank, {tileIndex, generation, detail::HidingWord::MayHide});
    }
    // Tells `rank`, after mayHide(), that its inputs can be seen. Throws as hide().
    void show(int tileIndex, int generation, int rank) const
    {
        engine_->tell(rank, {tileIndex, generation, detail::HidingWord::Shows});
    }
    // Whether mayHide() has told this rank that inputs of that generation may be hidden, and neither hide() nor show()
    // has followed.
    bool isUndecided(int tileIndex, int generation) const { return engine_->isUndecided(tileIndex, generation); }
    // Waits until heard() returns true or the frame has failed, and returns true. Returns false after
    // FrameBufferConfig::quiet: render without waiting then. heard() is called first, and again after each hide(),
    // mayHide() or show() of another rank. It may call isHidden(), isUndecided() and failed() only, as a lock is
    // held. Runs tasks of the executor meanwhile. One thread at a time may call it; with Progress::Caller, it must
    // be one that may call MPI. If the transport fails, it returns true or throws TransportError.
    bool waitForWord(detail::FunctionRef<bool()> heard) const { return engine_->waitForWord(heard); }

    // Declares inputs of generation 1, which must then come in each pass. One without pixels costs a header. One rank
    // declares each input; another one may send it. In a frame with FrameConfig::declared every rank must call this
    // once, with an empty list if it declares nothing; otherwise end() fails the frame. The call may come after the
    // first setTile(). Children of these inputs are not declared. A list equal to that of the last frame is not sent
    // again. Only one thread may call it. Throws InvalidArgument, with nothing declared, for a tile outside the image,
    // for a second call, and in a frame without FrameConfig::declared.
    void declare(const std::vector<TileInput>& inputs) { engine_->declare(inputs); }

    // Replaces FrameConfig::maxLayers for the inputs of this rank, if the renderer learns the number only after
    // begin(). Ranks may give different numbers. Call it before the first setTile(), on one thread.
    void expectLayers(int layers) { engine_->expectLayers(layers); }

    // The samples that a tile gets in this frame.
    TileSamples samples(int tileIndex) const { return engine_->samples(tileIndex); }

    // Hands out the jobs [0, count) to all ranks, each to one: returns the next job of this rank. -1 means that no jobs
    // are left, or that the frame or the transport has failed. `count` must be the same on all ranks and in all calls.
    // Call it within forEachWorker(). Waits for the rank that hands out the jobs if this rank has none left; it gets
    // several at once. If that takes longer than FrameConfig::timeout, the frame fails. Throws InvalidArgument for a
    // count below 0.
    std::int64_t nextJob(std::int64_t count) const { return engine_->nextJob(count); }

    // Calls body() once for each worker of the executor, on several at once, and waits for all calls. forEachTile()
    // of one tile within the body runs on the worker that calls it. If the body throws, the frame fails as guard()
    // says. Only the thread that began the frame may call it, and not from a task. Below MPI_THREAD_SERIALIZED only
    // this thread moves messages. If the executor runs a body() on it, as a TbbExecutor does, that body must go on
    // until nextJob() returns -1: else the others wait for ever.
    void forEachWorker(detail::FunctionRef<void()> body);

    // Adds `value` to the figure with this key. FrameReport::figures has the sum over all ranks. Use it for
    // measurements that all ranks must know, such as the cost of a brick. If the loop has a tile-brick owner that
    // plans, the loop adds figures, too, with the keys of MeasuredCostBricks::keyOf(). The figures are summed when
    // the frame ends: call it before this rank's end().
    void addFigure(std::uint64_t key, double value) const { engine_->addFigure(key, value); }

    // Notes that an input of that tile was simplified: a pixel of one pass may be off by up to `bound`, in units of
    // colour. See FrameReport::mergeErrorBound. Call it before this rank's end(). Throws InvalidArgument for a tile
    // outside the image.
    void noteMergeError(int tileIndex, double bound) const { engine_->noteMergeError(tileIndex, bound); }

    // Whether the frame has failed on some rank, as far as this rank knows. If so, stop rendering.
    bool failed() const noexcept { return engine_->failed(); }

    // Calls body(), which is a rendering loop of your own or a part of it. If body() throws, guard() passes the
    // exception to abort(), and end() throws a FrameError with its text on all ranks, including this one. So call
    // end() in any case. Returns false if there was an exception. Throws nothing.
    // `tile` is the tile that body() renders, if any: the error names it, and with FrameConfig::allowPartial the
    // frame goes on without it. Its index is read only after an exception, so body() may set it.
    bool guard(detail::FunctionRef<void()> body, const TileHeader& tile = {});

    // Makes the frame fail on all ranks, with the text of this exception. `tileIndex`: the tile that the exception
    // concerns, which the error names; or -1. With FrameConfig::allowPartial the frame goes on without that tile.
    // Does nothing after end().
    void abort(const std::exception_ptr& reason, int tileIndex = -1) { engine_->abort(number_, reason, tileIndex); }

    // Makes the frame fail on all ranks with ErrorKind::Cancelled, because nobody needs it any more. Call end() all
    // the same. Tiles that are set later are dropped. May be called during end(). Does nothing after it.
    void cancel() const
    {
        const Error reason(detail::errorInfo(ErrorKind::Cancelled, "the frame was cancelled"));
        engine_->abort(number_, std::make_exception_ptr(reason), -1);
    }

    // Ends the frame. Call it once. Collective. With several framebuffers call it in the same order on all ranks; once
    // isDone() or tryEnd() has been called for all of their frames on all ranks, any order will do. This rank's last
    // setTile() must have returned: an input that is not sent when all ranks are in end() counts as missing. Waits
    // until all tiles of all ranks are finished and the display rank has the image, or until the frame has failed. It
    // also fails if nothing is under way that could complete it (ErrorKind::MissingInput). Throws FrameError, the same
    // on every rank. With FrameConfig::allowPartial it returns instead, with FrameReport::failure set, unless ranks
    // disagree. Throws TransportError. In all these cases the frame is over. After a FrameError the next one may begin.
    // Throws InvalidArgument after the frame has ended, and on a thread that may not call MPI (see Progress), which
    // leaves the frame open.
    FrameReport end();

    // Whether end() would return without waiting for other ranks: the frame is complete everywhere, or has failed. For
    // programs that do something else meanwhile, such as a window: call it repeatedly, then end(). The first call
    // begins the end of the frame on this rank, so this rank's last setTile() must have returned. Moves messages if no
    // thread does, and keeps to FrameConfig::timeout. Waits for nothing. end() may still take a moment if the frame
    // timed out or is partial. Throws InvalidArgument as end() does.
    bool isDone()
    {
        requireOpen();
        return engine_->isDone();
    }

    // If isDone(), ends the frame and returns its report; otherwise returns nothing, at once. Waits no longer than
    // end() does after isDone(). Throws what end() throws.
    std::optional<FrameReport> tryEnd() { return isDone() ? std::optional<FrameReport>(end()) : std::nullopt; }

protected:
    FrameBase(FrameBufferBase& fb, detail::Engine& engine)
        : fb_(&fb), engine_(&engine), number_(engine.frame()), open_(&engine)
    {
    }
    FrameBase& operator=(FrameBase&&) noexcept = default; // a BasicFrame can be assigned to one of its type

    // A tile that each thread keeps for its next job. A job takes it, because the thread may be given another job while
    // a renderer waits inside this one.
    template <class WorkerTile>
    struct SpareTile {
        static std::unique_ptr<WorkerTile>& ofThread()
        {
            static thread_local std::unique_ptr<WorkerTile> tile;
            return tile;
        }
        static TileHeader* take() // start() clears it
        {
            std::unique_ptr<WorkerTile>& tile = ofThread();
            return tile ? tile.release() : new WorkerTile;
        }
        static void keep(TileHeader* tile) { ofThread().reset(static_cast<WorkerTile*>(tile)); }
    };

    // See BasicFrame::forEachTile(). `take` and `keep` are those of a SpareTile.
    void forEachJob(std::int64_t count, TileHeader* (*take)(), void (*keep)(TileHeader*),
                    detail::FunctionRef<void(std::int64_t, TileHeader&)> job);

    detail::Engine* engine() const noexcept { return engine_; }

private:
    void requireOpen() const;

    FrameBufferBase* fb_;
    detail::Engine* engine_;
    std::int64_t number_;
    std::unique_ptr<detail::Engine, detail::LeaveFrame> open_; // engine_, until this has ended or was moved from
};

// The members of a DistributedFrameBuffer that do not depend on its operations and its transport. A function that takes
// a FrameBufferBase& and a FrameBase& need not be a template.
class FrameBufferBase {
public:
    using Config = FrameBufferConfig;

    FrameBufferBase(const FrameBufferBase&) = delete;
    FrameBufferBase& operator=(const FrameBufferBase&) = delete;

    // These wait for nothing and throw nothing. Any thread, but not during resize(). config() has the values in use:
    // poolBytes is raised to its minimum, and a missing executor is filled in.
    int rank() const noexcept { return engine().rank(); }
    int size() const noexcept { return engine().size(); }
    bool isDisplayRank() const noexcept { return rank() == config().image.displayRank; }
    const Config& config() const noexcept { return engine().config(); }
    const TileLayout& layout() const noexcept { return engine().layout(); }
    // The owners by config().image.ownerMap. A frame can have other owners: see Frame::tileOwner().
    int tileOwner(int tile) const noexcept { return engine().tileOwner(tile); }
    const std::vector<int>& ownedTiles() const noexcept { return engine().ownedTiles(); }
    // For each rank the lowest rank that shares memory with it: ranks with the same number here are on one node. If the
    // transport knows no shared memory, all ranks count as being on one node.
    const std::vector<int>& nodeOf() const noexcept { return engine().nodeOf(); }
    Executor& executor() const noexcept { return *config().executor; }

    // On the display rank: the image of the last frame that ended well or partial. With config.framesInFlight = 1 it is
    // valid until the next begin(); with n frames in flight, until the n-th begin() after the one that began its frame.
    // Empty before the first frame, when it is no longer valid, and on other ranks. Only the thread that begins and
    // ends frames may call it.
    const Image& image() const noexcept { return lastEnded_->image(); }

    // Copies the display rank's image() to every rank, and returns it; an empty image if image() is empty there. The
    // bytes travel along a tree of the ranks. Every rank needs memory for several more images while it runs.
    // Collective. Call it while no frame is open; this is not checked. Waits and throws as allGather().
    Image imageOnAllRanks() { return lastEnded_->imageOnAllRanks(engine()); }

    // The number of the frame that image() shows, as in FrameReport::frame; -1 if it is empty. Thread as above.
    std::int64_t imageFrame() const noexcept { return lastEnded_->imageFrame(); }

    // On the display rank: whether image() has that finished tile. After a frame that ended well it has all of them;
    // see FrameConfig::allowPartial. Thread as above.
    bool isComplete(int tile) const { return lastEnded_->isComplete(tile); }

    // For programs without a progress thread (Progress::Caller) or without workers (CallerExecutor); otherwise it has
    // nothing to do. Without a progress thread it moves messages, if this thread may call MPI (see Progress). Without
    // workers it runs waiting tasks. Returns whether there was anything to do. Call it now and then during long work
    // without setTile(), so that compositing goes on and other ranks need not wait. Not needed in the jobs of a loop.
    // Any thread. Waits for no other rank.
    bool poll() { return engine().poll(); }

    // Changes the size of the image, in pixels. Afterwards image() is empty, tile operations have lost what they kept,
    // and frames are numbered from 1 again. An older Frame must not be used any more, not even to cancel it.
    // Collective, outside frames. Waits for all ranks. Throws InvalidArgument, with nothing changed: on this rank if a
    // frame is open, on all ranks if the size is not 1 to 65536 or differs between ranks, or if memory is short. Throws
    // TransportError.
    void resize(int width, int height);

    // Returns memory for pixels that all ranks of the node can read: see TileView::staysUntilEnd. It is not cleared,
    // and aligned to 64 bytes. It is memory of this rank alone, whose pixels must be sent, if it has at most 1536
    // bytes, or if there is no (more) shared memory; a rank has 4 GiB of it. Any thread. Waits for nothing. Throws
    // OutOfMemory.
    Buffer sharedMemory(std::size_t byteCount) const { return connection_->pool()->acquire(byteCount); }

    using Reduce = dfb::Reduce;

    // Combines `values` element by element over all ranks, and returns the result on all. A sum that is too large wraps
    // around. For example, to tell all ranks whether each could load its data. Collective.
    // Call it while no frame is open; this is not checked. Waits for all ranks, without a time-out: if one does not
    // call it, the others wait until that rank destroys its framebuffer or is lost. Throws InvalidArgument on every
    // rank if the numbers of values differ or a rank makes another collective call. Throws TransportError.
    std::vector<std::int64_t> allReduce(const std::vector<std::int64_t>& values, Reduce how)
    {
        return engine().allReduce(values, how);
    }

    // Returns the bytes of each rank, by rank, on all ranks. `call` names this call in the error that is thrown if
    // ranks make different calls. The sizes may differ and may be 0. Each rank needs several times the memory for all
    // bytes. Collective, call it as allReduce(). Waits and throws as that; also throws std::bad_alloc on a rank that
    // lacks memory.
    std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& bytes, const char* call = "allGather()")
    {
        return engine().allGather(bytes, call);
    }

protected:
    // Calls makeOperations() config.framesInFlight times. Otherwise as DistributedFrameBuffer().
    FrameBufferBase(std::shared_ptr<Connection> connection, Config&& config,
                    detail::FunctionRef<std::unique_ptr<detail::Operations>()> makeOperations);
    ~FrameBufferBase();

    // See DistributedFrameBuffer::begin(). copyData(operations) copies the data of the frame.
    detail::Engine& beginNext(const FrameConfig& params, detail::FunctionRef<void(detail::Operations&)> copyData,
                              const std::exception_ptr& failure);

private:
    friend class FrameBase;

    detail::Engine& engine() noexcept { return *engines_.front(); }
    const detail::Engine& engine() const noexcept { return *engines_.front(); }
    void makeEngines(const Config& config);

    std::shared_ptr<Connection> connection_;
    // Each pair of one of these and one of engines_ has one frame at a time. The pairs take turns.
    std::vector<std::unique_ptr<detail::Operations>> operations_;
    std::vector<std::unique_ptr<detail::Engine>> engines_;
    std::size_t next_ = 0;
    detail::Engine* lastEnded_ = nullptr;
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE bool FrameBase::guard(detail::FunctionRef<void()> body, const TileHeader& tile)
{
    try {
        body();
        return true;
    } catch (...) {
        abort(std::current_exception(), tile.tile);
        return false;
    }
}

DFB_COMPILED_ONCE FrameReport FrameBase::end()
{
    requireOpen();
    const FrameReport report = open_.release()->end();
    fb_->lastEnded_ = engine_;
    return report;
}

DFB_COMPILED_ONCE void FrameBase::forEachJob(std::int64_t count, TileHeader* (*take)(), void (*keep)(TileHeader*),
                                             detail::FunctionRef<void(std::int64_t, TileHeader&)> job)
{
    guard([&] {
        const auto jobs = static_cast<std::size_t>(std::max<std::int64_t>(count, 0));
        engine_->parallelFor(jobs, [&](std::size_t i) {
            if (failed())
                return;
            TileHeader* const tile = take();
            tile->tile = -1;
            {
                detail::TraceSpan span(fb_->config().trace.get(), TraceEvent::Kind::Tile, number_);
                guard([&] { job(static_cast<std::int64_t>(i), *tile); }, *tile);
                if (span.event())
                    span.event()->tile = tile->tile;
            }
            keep(tile);
        });
    });
}

DFB_COMPILED_ONCE void FrameBase::forEachWorker(detail::FunctionRef<void()> body)
{
    const int workers = engine_->config().executor->concurrency();
    guard([&] { engine_->parallelFor(static_cast<std::size_t>(workers), [&](std::size_t) { guard(body); }); });
}

DFB_COMPILED_ONCE void FrameBase::requireOpen() const
{
    if (!open_)
        detail::failArgument("frame %lld has ended, or its Frame was moved from", static_cast<long long>(number_));
    engine_->requireProgress();
}

DFB_COMPILED_ONCE
FrameBufferBase::FrameBufferBase(std::shared_ptr<Connection> connection, Config&& config,
                                 detail::FunctionRef<std::unique_ptr<detail::Operations>()> makeOperations)
    : connection_(std::move(connection))
{
    if (!config.executor)
        config.executor = detail::makeThreads(*connection_);
    connection_->giveUpIfThrows([&] {
        for (int slot = 0; slot < std::max(1, config.framesInFlight); ++slot)
            operations_.push_back(makeOperations());
    });
    makeEngines(config);
}

DFB_COMPILED_ONCE FrameBufferBase::~FrameBufferBase()
{
    for (const auto& engine : engines_)
        if (engine->isOpen()) { // its Frame would use the destroyed framebuffer
            std::fputs("dfb: a framebuffer is destroyed before a Frame of it: end() the frame first\n", stderr);
            std::abort();
        }
}

DFB_COMPILED_ONCE void FrameBufferBase::makeEngines(const Config& config)
{
    std::vector<std::unique_ptr<detail::Engine>> engines;
    std::vector<detail::Engine*> together;
    connection_->giveUpWithoutMemory([&] {
        for (std::size_t slot = 0; slot < operations_.size(); ++slot)
            engines.push_back(detail::makeEngine(connection_, config, *operations_[slot], static_cast<int>(slot)));
        for (const auto& engine : engines)
            together.push_back(engine.get());
        for (detail::Engine* engine : together)
            engine->setTogether(together);
    });
    engines_ = std::move(engines);
    next_ = 0;
    lastEnded_ = engines_.front().get();
}

DFB_COMPILED_ONCE detail::Engine& FrameBufferBase::beginNext(const FrameConfig& params,
                                                             detail::FunctionRef<void(detail::Operations&)> copyData,
                                                             const std::exception_ptr& failure)
{
    detail::Engine& engine = *engines_[next_];
    engine.begin(params, [&] {
        copyData(*operations_[next_]); // also in a frame that fails: a wall counts frames
        if (failure)
            std::rethrow_exception(failure);
    });
    next_ = (next_ + 1) % engines_.size();
    return engine;
}

DFB_COMPILED_ONCE void FrameBufferBase::resize(int width, int height)
{
    for (const auto& engine : engines_)
        if (engine->isOpen())
            detail::failArgument("resize() while a frame is open: end() it first");
    connection_->giveUpWithoutMemory([&] {
        Config config = this->config();
        config.image.width = width;
        config.image.height = height;
        engine().allGather({}, "resize()"); // the new engines do not hear of other calls
        makeEngines(config);
    });
}
#endif

DFB_NAMESPACE_END

#if DFB_HAS_BODIES
#include <dfb/frame/frame_engine.hpp>
#endif
