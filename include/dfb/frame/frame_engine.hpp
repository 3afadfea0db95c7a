// FrameEngine: the implementation of DistributedFrameBuffer. It joins the tile pipeline, the messaging layer, the
// declarations and the verdict into frames.
#pragma once

#include <dfb/comm/collectives.hpp>
#include <dfb/comm/compression.hpp>
#include <dfb/comm/mailbox.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/accumulation.hpp>
#include <dfb/frame/agreement.hpp>
#include <dfb/frame/declarations.hpp>
#include <dfb/frame/engine.hpp>
#include <dfb/frame/hidden_tiles.hpp>
#include <dfb/frame/job_share.hpp>
#include <dfb/frame/open_frame.hpp>
#include <dfb/frame/outcome.hpp>
#include <dfb/frame/tile_pipeline.hpp>
#include <dfb/frame/verdict.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// The members are those of DistributedFrameBuffer and its Frame; see there.
class FrameEngine final : public Engine, private MailboxOwner {
public:
    using Bytes = ReductionTable::Bytes;

    // `operations` must live as long as this; `slot`: which of config.framesInFlight engines this is.
    FrameEngine(std::shared_ptr<Connection> connection, FrameBufferConfig config, Operations& operations, int slot)
        : pool_(connection->pool()), config_(std::move(config)), operations_(operations),
          open_(slot + 1, std::max(1, config_.framesInFlight)),
          compression_(config_.messages.codec, config_.messages.compression, connection->size())
    {
        config_.messages.poolBytes =
            std::max(config_.messages.poolBytes, 4 * TilePipeline::largestMessage(traits(), config_));
        mailbox_ = std::make_unique<Mailbox>(std::move(connection), config_.executor, config_.messages.poolBytes,
                                             static_cast<MailboxOwner&>(*this), config_.trace.get());
        mailbox_->start();
        const auto all = agree(*mailbox_, [this] {
            checkConfig(config_, traits(), size(), mailbox_->connection().config().peerTimeout);
            try {
                makeParts();
            } catch (const OutOfMemory& e) {
                if (config_.framesInFlight == 1)
                    throw;
                failArgument("%s; there is one for each of %d frames in flight", e.what(), config_.framesInFlight);
            }
            const Connection& network = mailbox_->connection();
            Agreement::OnNode here{rank(), network.firstOnNode()};
            for (int other = 0; other < size(); ++other)
                here.hasFarRanks |= isFar(other);
            return Agreement::of(traits(), config_, network.config().checksums, here,
                                 TilePipeline::travelling(traits(), config_), pipeline_->table().ownersByMap());
        });
        nodeOf_.resize(static_cast<std::size_t>(size()));
        bool hasFarRanks = false;
        for (const Agreement::OnNode& its : all.nodes)
            if (its.rank < size()) {
                nodeOf_[static_cast<std::size_t>(its.rank)] = its.first;
                hasFarRanks = hasFarRanks || its.hasFarRanks != 0;
            }
        pipeline_->setFarRanks(hasFarRanks);
        tellImagePlace();
    }
    ~FrameEngine() override { mailbox_->stop(); } // while mailbox_ is not null yet: its tasks use it

    int rank() const noexcept override { return mailbox_->rank(); }
    int size() const noexcept override { return mailbox_->size(); }
    const FrameBufferConfig& config() const noexcept override { return config_; }
    const TileLayout& layout() const noexcept override { return pipeline_->table().layout(); }
    int tileOwner(int tile) const noexcept override
    {
        return pipeline_->table().ownersByMap()[static_cast<std::size_t>(tile)];
    }
    const std::vector<int>& ownedTiles() const noexcept override { return pipeline_->table().ownedByMap(); }
    int ownerNow(int tile) const noexcept override { return pipeline_->table().owner(tile); }
    const std::vector<int>& ownedNow() const noexcept override { return pipeline_->table().owned(); }
    const std::vector<int>& nodeOf() const noexcept override { return nodeOf_; }
    const Image& image() const noexcept override { return imageFrame() < 0 ? noImage_ : gathered()->image(); }
    std::int64_t imageFrame() const noexcept override { return gathered() ? gathered()->frame() : -1; }
    bool isComplete(int tile) const override { return gathered() && gathered()->isComplete(tile); }
    bool isOpen() const noexcept override { return open_.state() != FrameState::Closed; }
    std::int64_t frame() const noexcept override { return open_.number(); }
    bool failed() const noexcept override { return outcome_->failed(); }

    void begin(const FrameConfig& params, FunctionRef<void()> copyData) override
    {
        if (isOpen())
            failArgument("begin() while frame %lld is open: end() it first (framesInFlight is %d)",
                         static_cast<long long>(frame()), config_.framesInFlight);
        FrameTerms::check(params, traits());
        const bool lastFailed = outcome_->lastFailed();
        const auto start =
            accumulation_.begin(params, traits(), layout().tileCount(), config_.framesInFlight, lastFailed);
        mailbox_->requireProgress();
        mailbox_->connection().throwIfFailed();
        const bool haveMoved = pipeline_->setOwners(params.owners);
        params_ = params;
        if (!start.keeps)
            mergeErrorBound_ = 0;
        declarations_.newFrame(!lastFailed, haveMoved); // after a failed frame, owners may know of different ones

        std::exception_ptr userError; // thrown by copying the data, or by the pixel operation's newFrame()
        try {
            pipeline_->newFrame(open_.next(), params_, start, codecFor(config_.image.displayRank) != nullptr);
            copyData();
        } catch (...) {
            userError = std::current_exception();
        }
        jobs_->newFrame();
        if (traits().opaqueHides)
            hiding_->newFrame();
        outcome_->newFrame(FrameTerms::of(params, rank()));
        inputsSent_ = 0;
        renderNs_ = -1;
        areInputsClosed_ = false;
        {
            const std::lock_guard<std::mutex> lock(figuresMutex_);
            figures_.clear();
            mergeErrors_.clear();
        }
        lastPoll_ = beginTime_ = Clock::now();
        mailbox_->newEpoch(open_.next());
        mailbox_->connection().expectMessages(true);
        open(userError);
    }

    TileHeader headerOf(int tile, int pass) const override { return pipeline_->headerOf(tile, pass); }
    ChannelMask sent() const noexcept override { return pipeline_->sent(); }

    void setTile(const InputPixels& tile) override
    {
        const TraceSpan span(config_.trace.get(), TraceEvent::Kind::SetTile, tile.frame, tile.tile);
        pipeline_->check(tile);
        if (!isOpen() || outcome_->failed() || isHidden(tile.tile, tile.generation))
            return;
        const int owner = ownerNow(tile.tile);
        const bool isInPlace = pipeline_->mayReadInPlace(tile);
        if (isInPlace && mailbox_->connection().config().checksums)
            pipeline_->notePromise(tile);
        if (owner != rank()) {
            Buffer message = isInPlace ? encodePlace(tile, owner) : Buffer();
            mailbox_->send(owner, message.empty() ? encode(tile, owner) : std::move(message));
            ++inputsSent_;
            if (!mailbox_->waitForRoom([this] { return outcome_->failed(); }, params_.timeout))
                outcome_->fail(
                    errorInfo(ErrorKind::TimedOut, "no room for more tiles: " + mailbox_->flow().notTaken()));
        } else if (const auto inside = open_.enter(tile.frame)) {
            if (isInPlace)
                arrive([&] { return pipeline_->inputOf(tile); }, rank(), true);
            else
                arrive(encode(tile, owner), rank());
            ++inputsSent_;
        }
        pollNowAndThen();
    }

    // See Frame.
    bool isHidden(int tile, int generation) const override { return hiding_->isHidden(tile, generation); }
    bool opaqueHides(int tile) const override { return pipeline_->opaqueHides(tile); }
    bool isUndecided(int tile, int generation) const override { return hiding_->isUndecided(tile, generation); }
    void tell(int other, const HidingWord& word) override { hiding_->tell(other, word); }
    bool waitForWord(FunctionRef<bool()> heard) override { return hiding_->wait(heard, config_.quiet); }

    void expectLayers(int layers) override { pipeline_->setLayers(layers); }
    TileSamples samples(int tile) const override { return pipeline_->table().samples(tile); }

    void addFigure(std::uint64_t key, double value) override
    {
        const std::lock_guard<std::mutex> lock(figuresMutex_);
        figures_.push_back({key, value});
    }
    void noteMergeError(int tile, double bound) override
    {
        if (tile < 0 || tile >= layout().tileCount())
            failArgument("noteMergeError() for tile %d of an image of %d tiles", tile, layout().tileCount());
        const std::lock_guard<std::mutex> lock(figuresMutex_);
        mergeErrors_.push_back({static_cast<std::uint64_t>(tile), bound / std::max(samples(tile).count, 1)});
    }

    std::int64_t nextJob(std::int64_t count) override
    {
        if (count < 0)
            failArgument("nextJob() of %lld jobs", static_cast<long long>(count));
        return jobs_->next(count, params_.timeout);
    }

    void declare(const std::vector<TileInput>& inputs) override
    {
        if (!params_.declared)
            failArgument("declare() in a frame that was not begun with declared inputs");
        if (declarations_.declared())
            failArgument("declare() a second time in a frame");
        for (const TileInput& input : inputs)
            if (input.tile < 0 || input.tile >= layout().tileCount())
                failArgument("declare() of tile %d of an image of %d tiles", input.tile, layout().tileCount());
        if (outcome_->failed())
            return;
        const bool isWaiting = declarations_.declare(
            inputs, rank(), [this](int tile) { return ownerNow(tile); },
            [this](int owner, const Bytes& manifest) {
                mailbox_->send(owner, MessageKind::Manifest, open_.number(), manifest);
            });
        if (!isWaiting)
            enterAllDeclared();
    }

    void abort(std::int64_t frame, const std::exception_ptr& reason, int tile) override
    {
        const auto inside = open_.enter(frame);
        if (!inside || !failTile(reason, tile) || failed() || !params_.allowPartial || tile < 0
            || tile >= layout().tileCount())
            return; // the frame is over, or fails, or waits for what this rank may still send
        outcome_->guarded([&] {
            if (ownerNow(tile) == rank())
                loseTile(tile);
            else
                mailbox_->sendBody(ownerNow(tile), MessageKind::TileLost, frame, std::int32_t{tile});
        });
    }

    bool poll() override
    {
        bool did = mailbox_->connection().poll();
        Executor& executor = mailbox_->executor();
        while (!executor.hasWorkers() && executor.help()) {
            did = true;
            mailbox_->connection().poll(); // other ranks may wait for messages that this one has queued
        }
        polled();
        return did;
    }

    void parallelFor(std::size_t count, FunctionRef<void(std::size_t)> body) override
    {
        std::function<void()> meanwhile;
        if (mailbox_->connection().needsCaller() && mailbox_->connection().mayPoll())
            meanwhile = [this] {
                try {
                    poll();
                } catch (...) {
                    abort(frame(), std::current_exception(), -1);
                }
            };
        mailbox_->executor().parallelFor(count, body, meanwhile);
    }

    // For a renderer that does not call poll(): polls if no other thread moves messages, or none runs tasks. Does so at
    // most once in a millisecond, as a poll takes time.
    void pollNowAndThen()
    {
        if (!mailbox_->connection().needsCaller() && mailbox_->executor().hasWorkers())
            return;
        const auto now = Clock::now();
        if (now - lastPoll_.load() < std::chrono::milliseconds(1))
            return;
        lastPoll_ = now;
        poll();
    }

    void requireProgress() const override { mailbox_->requireProgress(); }

    void closeInputs() override
    {
        if (std::exchange(areInputsClosed_, true))
            return;
        // In a frame that may be partial, the failure says why declare() was not called.
        if (params_.declared && !declarations_.declared() && !outcome_->failed())
            outcome_->failWhole(open_.reason().value_or(
                errorInfo(ErrorKind::InvalidArgument, "end() of a frame with declared inputs without declare()")));
        if (gathered())
            outcome_->guarded([this] { pipeline_->finishBackground(); });
        outcome_->closeInputs();
    }

    // The part of end() that waits for no other rank. Only the first call in a frame does anything.
    void beginEnd()
    {
        if (renderNs_ >= 0)
            return;
        renderNs_ = std::chrono::nanoseconds(Clock::now() - beginTime_).count();
        closeInputs();
        outcome_->beginEnd();
    }

    void tryVote() override
    {
        if (isOpen())
            outcome_->tryVote();
    }
    void setTogether(std::vector<Engine*> engines) override { together_ = std::move(engines); }

    bool isDone() override
    {
        try {
            beginEnd();
            poll();
            return outcome_->isConcluded();
        } catch (const TransportError&) {
            return true; // end() throws it
        }
    }

    FrameReport end() override
    {
        beginEnd();
        EndOfFrame ending{*this};
        const Verdict verdict = outcome_->conclude();
        if (verdict.error && !outcome_->isPartial(verdict))
            throw FrameError(*verdict.error, mailbox_->connection().throwByAll());
        const bool compressed = compression_.isOn();
        pipeline_->fillBackground();
        if (!verdict.error) {
            compression_.endFrame(static_cast<double>(verdict.maxima[Verdict::TotalNs]));
            accumulation_.ended(params_, pipeline_->table().frameInfo().firstSample);
        }

        using Ms = std::chrono::duration<double, std::milli>;
        FrameReport report;
        report.frame = open_.number();
        ending.time = Clock::now();
        report.totalMs = Ms(ending.time - beginTime_).count();
        report.renderMs = Ms(std::chrono::nanoseconds(renderNs_)).count();
        report.compositingOverheadMs = report.totalMs - report.renderMs;
        report.tilesTotal = layout().tileCount();
        report.wireColor = pipeline_->wireColor();
        report.compressed = compressed;
        report.threads = mailbox_->executor().concurrency();
        const Connection& connection = mailbox_->connection();
        report.progress = connection.hasOnlyCallers() ? Progress::Caller : Progress::Thread;
        verdict.addTo(report);
        // Like wireErrorBound, it also bounds what the image keeps from earlier frames.
        report.mergeErrorBound = mergeErrorBound_ = std::max(mergeErrorBound_, report.mergeErrorBound);
        return report;
    }

    // Ends a frame that is left without end(), mostly while an exception passes.
    void leave() noexcept override
    {
        try {
            if (!outcome_->failed()) // has no effect if closeInputs() has let this rank vote
                outcome_->guarded([&] {
                    outcome_->failWhole(errorInfo(ErrorKind::Cancelled,
                                                  "the frame was left without end(). If by an exception: "
                                                  "Frame::guard() around what throws tells all ranks its text"));
                });
            end();
        } catch (...) {
            // A FrameError with the reason given to failWhole(), or a TransportError, which the next begin() throws.
        }
    }

    std::vector<std::int64_t> allReduce(const std::vector<std::int64_t>& values, Reduce how) override
    {
        static const char* const names[] = {"sum", "minimum", "maximum"};
        return detail::allReduce(
            *mailbox_, values, names[static_cast<std::size_t>(how)], [how](std::int64_t x, std::int64_t y) {
                if (how == Reduce::Sum)
                    return static_cast<std::int64_t>(static_cast<std::uint64_t>(x) + static_cast<std::uint64_t>(y));
                return how == Reduce::Min ? std::min(x, y) : std::max(x, y);
            });
    }

    Image imageOnAllRanks(Engine& gatherer) override
    {
        std::vector<std::byte> mine;
        mailbox_->makePart([&] {
            image().forEachPlane(
                [&](const std::byte* bytes, std::size_t count) { mine.insert(mine.end(), bytes, bytes + count); });
        });
        const auto all = gatherer.allGather(mine, "imageOnAllRanks()");
        const std::vector<std::byte>& displayed = all[static_cast<std::size_t>(config_.image.displayRank)];
        if (displayed.empty())
            return {};
        Image copy(*pool_, layout().width(), layout().height(), config_.image.format,
                   TilePipeline::imageChannels(config_));
        ByteReader in(displayed.data(), displayed.size());
        copy.forEachPlane([&](std::byte* bytes, std::size_t count) { in.getBytes(bytes, count); });
        in.end();
        return copy;
    }

    std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& own, const char* call) override
    {
        return detail::allGather(*mailbox_, own, call);
    }

private:
    const OperationTraits& traits() const noexcept { return operations_.traits(); }
    GatheredImage* gathered() const noexcept { return pipeline_->image(); }

    using Clock = std::chrono::steady_clock;

    // See Compression.
    const Codec* codecFor(int other) const
    {
        return other == rank() ? nullptr : compression_.codecFor(other, mailbox_->connection().isSeenBy(other));
    }

    // Adds the frame to the trace when it has ended, however it ends.
    struct EndOfFrame {
        const FrameEngine& engine;
        Clock::time_point time{}; // of the end; if not set, the time of destruction

        ~EndOfFrame()
        {
            if (!engine.config_.trace)
                return;
            const Clock::time_point begin = engine.beginTime_,
                                    rendered = begin + std::chrono::nanoseconds(engine.renderNs_),
                                    end = time == Clock::time_point() ? Clock::now() : time;
            const auto add = [&](TraceEvent::Kind kind, Clock::time_point from, Clock::time_point to) {
                engine.config_.trace->add({kind, 0, from, to, engine.open_.number()});
            };
            add(TraceEvent::Kind::Frame, begin, end);
            add(TraceEvent::Kind::Render, begin, rendered);
            add(TraceEvent::Kind::End, rendered, end);
        }
    };

    // Lets messages of the frame in.
    void open(const std::exception_ptr& userError)
    {
        // A pixel operation that is not pointwise wants to see tiles without samples, too.
        const auto isKept = [this](int tile) { return !traits().pixelOpIsPointwise && samples(tile).count == 0; };
        const auto& tiles = ownedNow();
        const auto expected = std::count_if(tiles.begin(), tiles.end(), [&](int tile) {
            return isKept(tile) || (!params_.declared && samples(tile).count > 0);
        });
        std::optional<ErrorInfo> failure; // end() throws it on all ranks, and nothing is made with half of the data
        if (userError)
            failure = errorInfoOf(userError, {});
        auto& early = outcome_->open(std::move(failure));
        open_.expectTiles(expected);
        for (Arrival& a : early)
            incoming(a.source, a.header, std::move(a.message));
        early.clear(); // if the frame has failed, some have not been taken
        failForDamage();
        outcome_->guarded([&] {
            const auto inside = open_.enter(open_.number());
            for (const int tile : tiles)
                if (isKept(tile))
                    submitFinish(tile);
            if (!params_.declared && open_.expectNoMore())
                allFinished();
        });
    }

    // ---- messages

    void incoming(int source, const MessageHeader& header, Buffer&& message) override
    {
        const std::size_t byteCount = message.size();
        const bool hasCredit = source != rank() && mailbox_->needsCredit(header.kind);
        const OpenFrame::Entry entry = open_.enter(source, header, message);
        if (entry == OpenFrame::Entry::Kept)
            return;
        if (entry != OpenFrame::Entry::Inside) {
            if (hasCredit)
                mailbox_->flow().discarded(byteCount);
            if (entry == OpenFrame::Entry::Absurd) {
                ErrorInfo info =
                    errorInfo(ErrorKind::MalformedMessage, "a message of a frame that no rank can have begun");
                info.from = source;
                info.expected = open_.next();
                info.got = header.number;
                undecodable(info);
            }
            return;
        }
        const OpenFrame::Inside inside(&open_);
        if (hasCredit)
            mailbox_->consumed(source, byteCount);
        mailbox_->countTaken(source, header, message);
        ErrorInfo where;
        where.from = source;
        outcome_->guarded([&] { handle(source, header, std::move(message)); }, where);
    }

    // The display rank tells the ranks that see its memory where its image lies, so that they put finished tiles there
    // themselves. A rank that gets this message only after its first frame goes on sending its tiles.
    void tellImagePlace()
    {
        if (!gathered())
            return;
        Connection& connection = mailbox_->connection();
        std::optional<ImagePlaces> places;
        for (int other = 0; other < size(); ++other) {
            if (!connection.isSeenBy(other))
                continue;
            if (!places)
                places = gathered()->share([&](const std::byte* block) { return connection.placeOf(block); });
            if (!places)
                return;
            mailbox_->sendBody(other, MessageKind::ImagePlace, open_.next(), *places);
        }
    }

    // It is not known which frame the message was for. If no frame is open, or this rank has all that it needs for the
    // open one, the next frame lacks the message.
    void undecodable(const ErrorInfo& error) override
    {
        mailbox_->keepDamage(error);                         // first: begin() opens the frame and then looks for damage
        if (const auto inside = open_.enter(open_.number())) // held to the end: the next begin() waits for it
            failForDamage();
    }

    // Returns what FrameOutcome::fail() does.
    bool failTile(const std::exception_ptr& reason, int tile)
    {
        ErrorInfo where;
        where.tile = tile;
        return outcome_->fail(errorInfoOf(reason, where));
    }

    void failForDamage()
    {
        if (const auto damage = mailbox_->takeDamage(); damage && !outcome_->fail(*damage))
            mailbox_->keepDamage(*damage);
    }

    // Passes a message to the object that handles its kind.
    void handle(int source, const MessageHeader& header, Buffer&& message)
    {
        if (mailbox_->receiveCredit(source, header, message))
            return outcome_->tryVote(); // the vote may have waited for this credit
        switch (header.kind) {
        case MessageKind::Abort: return outcome_->receiveAbort(header, message);
        case MessageKind::ReduceUp:
        case MessageKind::ReduceDown: return outcome_->receiveReduction(source, header, message);
        case MessageKind::ImagePlace:
            if (!pipeline_->sender())
                failMalformed("the place of an image for a rank that sends no tiles");
            return pipeline_->sender()->receivePlaces(
                source, bodyOf<ImagePlaces>(message), [&](std::int32_t place, std::size_t byteCount) {
                    return mailbox_->connection().blockAt(source, place, byteCount);
                });
        case MessageKind::FinishedTiles:
        case MessageKind::TilesDone:
            if (outcome_->failed() && !params_.allowPartial)
                return;
            if (!gathered())
                failMalformed("a finished tile was sent to a rank that displays nothing");
            gathered()->receive(source, header, std::move(message));
            return outcome_->tryVote();
        case MessageKind::Fragment:
        case MessageKind::Manifest:
        case MessageKind::ManifestAck:
        case MessageKind::Hidden:
        case MessageKind::TileLost:
        case MessageKind::JobRequest:
        case MessageKind::Jobs:
            if (!outcome_->failed())
                handleInput(source, header, std::move(message));
            return;
        case MessageKind::CreditRequest:
        case MessageKind::Credit:
        case MessageKind::Failure:
        case MessageKind::Ping:
        case MessageKind::Pong:
        case MessageKind::Leaving:
        case MessageKind::End: failMalformed("a message that is not for a frame", -1, std::int64_t(header.kind));
        }
    }

    // As handle(), for messages about inputs and jobs.
    void handleInput(int source, const MessageHeader& header, Buffer&& message)
    {
        const MessageKind kind = header.kind;
        if (kind == MessageKind::Fragment) {
            arrive(std::move(message), source);
        } else if (kind == MessageKind::Hidden) {
            hiding_->receive(message);
        } else if (kind == MessageKind::TileLost) {
            const auto tile = bodyOf<std::int32_t>(message);
            if (!params_.allowPartial || !pipeline_->table().isMine(tile))
                failMalformed("a lost tile of another owner, or in a frame that cannot be partial", rank(), tile);
            loseTile(tile);
        } else if (kind == MessageKind::Manifest) {
            if (!params_.declared)
                throw Error(errorInfo(ErrorKind::Disagreement,
                                      "the sender declares its inputs, this rank expects no declaration"));
            declarations_.receive(source, ByteReader(message.data() + sizeof header, message.size() - sizeof header),
                                  [this](int tile) { return pipeline_->table().isMine(tile); });
            mailbox_->send(source, MessageKind::ManifestAck, open_.number());
        } else if (kind == MessageKind::ManifestAck) {
            if (declarations_.acknowledged(source))
                enterAllDeclared();
        } else {
            jobs_->receive(source, header, message);
        }
    }

    // ---- tiles

    // Whether a rank shares no memory with this one. Both ranks give the same answer.
    bool isFar(int other) const { return other != rank() && !mailbox_->connection().sharesMemoryWith(other); }

    Buffer encode(const InputPixels& tile, int owner)
    {
        const Codec* codec = codecFor(owner);
        Buffer message = pipeline_->encode(tile, codec, isFar(owner));
        if (codec)
            compression_.sent(owner, rawFragmentBytes(message), message.size());
        return message;
    }

    // The message that tells the owner where the pixels lie. Empty if it does not see them.
    Buffer encodePlace(const InputPixels& tile, int owner)
    {
        const Connection& connection = mailbox_->connection();
        const auto offsetOf = [&](const std::byte* address) { return connection.offsetOf(address); };
        return connection.isSeenBy(owner)
                   ? encodeInPlace(*pool_, tile, pipeline_->sent() | colorChannel, mailbox_->address(), offsetOf)
                   : Buffer();
    }

    // Takes the message with an input from rank `source`.
    void arrive(Buffer&& message, int source)
    {
        const auto sharedBytes = [this, source](std::int64_t offset, std::int64_t byteCount) {
            return mailbox_->connection().bytesAt(source, offset, byteCount);
        };
        const bool isInPlace = saysInPlace(message);
        arrive([&] { return pipeline_->inputOf(std::move(message), sharedBytes); }, source, isInPlace);
    }

    // Takes the input from rank `source`, which make() returns.
    template <class Make>
    void arrive(const Make& make, int source, bool isInPlace)
    {
        if (!open_.beginReading(isInPlace))
            return;
        ErrorInfo where;
        where.from = source == rank() ? -1 : source; // whose message it is
        TileTable::Arrival arrival;
        {
            TraceSpan span(config_.trace.get(), TraceEvent::Kind::Input, open_.number());
            const auto take = [&] {
                Fragment input = make();
                TilePipeline::setPlace(where, input.header());
                pipeline_->arrive(std::move(input), source, arrival);
            };
            outcome_->guarded(take, where);
            if (TraceEvent* event = span.event()) {
                event->tile = static_cast<std::int32_t>(where.tile);
                event->peer = where.from;
            }
        }
        if (arrival.spoilt) {
            pipeline_->table().saidWhy();
            outcome_->tryVote();
        }
        if (arrival.ready)
            outcome_->guarded([&] { submitFinish(static_cast<int>(where.tile)); }, where);
        endReading();
    }

    // A renderer has failed in a tile of this rank, and has said why.
    void loseTile(int tile)
    {
        if (pipeline_->table().lose(tile))
            submitFinish(tile);
    }

    void endReading()
    {
        if (open_.endReading())
            outcome_->tryVote();
    }

    void submitFinish(int tile)
    {
        OpenFrame::Inside inside = open_.enterAgain(); // we are inside already
        mailbox_->submitWork(tile);
        static_cast<void>(inside.release()); // work() leaves
    }

    // Finishes a complete tile.
    void work(int tile) override
    {
        const OpenFrame::Inside inside(&open_);
        ErrorInfo where;
        where.tile = tile;
        if (open_.beginReading()) {
            const auto finish = [&] {
                const TraceSpan span(config_.trace.get(), TraceEvent::Kind::Finish, open_.number(), tile);
                pipeline_->finish(tile);
            };
            const bool finished = outcome_->guarded(finish, where);
            if ((finished || params_.allowPartial) && open_.tileFinished())
                outcome_->guarded([&] { allFinished(); }, where);
            endReading();
        }
    }

    // Called when the last of this rank's tiles has been finished.
    void allFinished()
    {
        pipeline_->flush();
        open_.setTilesFinished();
        outcome_->tryVote();
    }

    // ---- inputs that are expected, by manifest

    void enterAllDeclared()
    {
        mailbox_->reductions().enter(
            {FrameOutcome::AllDeclared, open_.number()}, {}, [](const Bytes& a, const Bytes&) { return a; },
            [this, frame = open_.number()](const Bytes&) {
                if (const auto inside = open_.enter(frame))
                    applyDeclarations();
            });
    }

    // Every manifest is here, so the inputs of each owned tile are known.
    void applyDeclarations()
    {
        declarations_.complete();
        if (outcome_->failed())
            return;
        ErrorInfo where;
        const bool declared = outcome_->guarded(
            [&] {
                pipeline_->table().declare(
                    declarations_.expected(), where, [this](int) { open_.expectTiles(1); },
                    [this](int tile) { submitFinish(tile); });
            },
            where);
        if ((declared || params_.allowPartial) && open_.expectNoMore())
            outcome_->guarded([&] { allFinished(); });
    }

    // ---- the end

    // Adds this rank's counts of the frame to the verdict, and an error if its renderer has broken a promise.
    void addFigures(Verdict& v)
    {
        pipeline_->addTo(v);
        v.sums.bytesSent += mailbox_->bytesSent();
        v.sums.messagesSent = mailbox_->messagesSent();
        v.sums.tilesTouched = pipeline_->table().touchedCount();
        v.sums.lateMessages = open_.takeLateCount();
        v.sums.repeatedMessages = mailbox_->connection().takeDuplicates();
        v.sums.compressedLinks = compression_.links();
        v.sums.inputsLeft = inputsSent_ - pipeline_->table().arrivedCount();
        v.maxima[Verdict::PeakMemoryBytes] = static_cast<std::int64_t>(pool_->peakBytes());
        v.maxima[Verdict::PeakInboxBytes] = static_cast<std::int64_t>(mailbox_->flow().peakInboxBytes());
        v.maxima[Verdict::TotalNs] = std::chrono::nanoseconds(Clock::now() - beginTime_).count();
        v.maxima[Verdict::RenderNs] = renderNs_ < 0 ? v.maxima[Verdict::TotalNs] : renderNs_.load();
        const std::lock_guard<std::mutex> lock(figuresMutex_);
        v.figures = Verdict::sortedSums(figures_);
        v.mergeErrors = Verdict::sortedSums(mergeErrors_);
    }

    void polled() override
    {
        for (Engine* engine : together_)
            engine->tryVote();
    }

    void makeParts()
    {
        const auto sendToDisplay = [this](Buffer&& message, std::size_t raw) {
            if (raw > 0)
                compression_.sent(config_.image.displayRank, raw, message.size());
            // The display rank waits for it.
            mailbox_->makePart([&] { mailbox_->send(config_.image.displayRank, std::move(message)); });
        };
        pipeline_ = std::make_unique<TilePipeline>(
            pool_, config_, operations_, rank(), size(), mailbox_->address(), sendToDisplay,
            [this](const std::exception_ptr& reason, int tile) { failTile(reason, tile); });
        outcome_ = std::make_unique<FrameOutcome>(*mailbox_, open_, *pipeline_, declarations_, config_.quiet,
                                                  [this](Verdict& verdict) { addFigures(verdict); });
        hiding_.emplace(*mailbox_, open_, *outcome_, *pipeline_);
        // The rank after the display rank hands out jobs, as the display rank has enough to do.
        jobs_.emplace(*mailbox_, open_, *outcome_, (config_.image.displayRank + 1) % size());
    }

    std::shared_ptr<MemoryPool> pool_;
    FrameBufferConfig config_;
    Operations& operations_;
    std::unique_ptr<TilePipeline> pipeline_;
    const Image noImage_;
    std::vector<int> nodeOf_;
    std::vector<Engine*> together_{this};
    Declarations declarations_;

    // The frame.
    OpenFrame open_;
    std::unique_ptr<FrameOutcome> outcome_;
    std::optional<JobExchange> jobs_;
    std::optional<HidingExchange> hiding_;
    FrameConfig params_;
    Accumulation accumulation_;
    double mergeErrorBound_ = 0; // of this frame and those that it continues
    std::mutex figuresMutex_;
    std::vector<Figure> figures_, mergeErrors_; // of this rank, by key and by tile; under figuresMutex_
    Compression compression_;
    std::atomic<std::int64_t> inputsSent_{0}; // by this rank
    std::atomic<std::int64_t> renderNs_{-1};  // from begin() until end(); -1: not there yet
    bool areInputsClosed_ = false;            // see closeInputs()
    Clock::time_point beginTime_;
    std::atomic<Clock::time_point> lastPoll_{}; // by pollNowAndThen()

    std::unique_ptr<Mailbox> mailbox_; // the last member, as its tasks use the others
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE std::unique_ptr<Engine> makeEngine(std::shared_ptr<Connection> connection, FrameBufferConfig config,
                                                     Operations& operations, int slot)
{
    return std::make_unique<FrameEngine>(std::move(connection), std::move(config), operations, slot);
}
#endif

} // namespace detail
DFB_NAMESPACE_END
