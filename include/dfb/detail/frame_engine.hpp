// FrameEngine: what DistributedFrameBuffer does behind its interface: it joins the tile pipeline, the messaging
// layer, the declarations and the verdict into frames.
#pragma once

#include <dfb/comm/compression_gains.hpp>
#include <dfb/comm/compression_trial.hpp>
#include <dfb/comm/mailbox.hpp>
#include <dfb/detail/engine.hpp>
#include <dfb/detail/frame_figures.hpp>
#include <dfb/detail/frame_gate.hpp>
#include <dfb/detail/hidden_tiles.hpp>
#include <dfb/detail/job_share.hpp>
#include <dfb/detail/manifest.hpp>
#include <dfb/detail/outcome.hpp>
#include <dfb/detail/quiescence.hpp>
#include <dfb/detail/tile_pipeline.hpp>
#include <dfb/frame.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <limits>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace dfb::detail {

// The members are those of DistributedFrameBuffer and its Frame; see there.
class FrameEngine final : public Engine, private MailboxOwner {
public:
    using Bytes = ReductionTable::Bytes;

    // `operations` must live as long as this; `slot`: which of config.framesInFlight engines this is.
    FrameEngine(std::shared_ptr<Connection> connection, FrameBufferConfig config, Operations& operations, int slot = 0)
        : pool_(connection->pool()), config_(std::move(config)), operations_(operations),
          gate_(slot + 1, std::max(1, config_.framesInFlight))
    {
        config_.messagePoolBytes =
            std::max(config_.messagePoolBytes, 4 * TilePipeline::largestMessage(traits(), config_));
        MailboxOwner& self = *this;
        mailbox_ = std::make_unique<Mailbox>(std::move(connection), config_.executor, config_.messagePoolBytes, self);
        outcome_ = std::make_unique<FrameOutcome>(*mailbox_, gate_, FrameVerdict);
        gains_.emplace(config_.codec ? size() : 0);
        mailbox_->start();
        Agreement mine;
        try {
            if (config_.displayRank < 0 || config_.displayRank >= size())
                throw InvalidArgument("the display rank is " + std::to_string(config_.displayRank) + " of "
                                      + std::to_string(size()));
            if (config_.framesInFlight < 1 || (config_.framesInFlight > 1 && traits().keepsState))
                throw InvalidArgument("there can not be " + std::to_string(config_.framesInFlight)
                                      + " frames in flight: 1 or more, and only 1 if the tile operation keeps state");
            if (config_.aux & ~(traits().channels & imageAuxChannels))
                throw InvalidArgument("the image is to have auxiliary channels (mask " + std::to_string(config_.aux)
                                      + ") that the inputs of this tile operation do not have");
            if (const int ms = mailbox_->connection().options().peerTimeoutMs; ms != 0 && ms < 100)
                throw InvalidArgument("a time-out for peers of " + std::to_string(ms) + " ms: 0, or 100 and more");
            if (config_.quietMs < 1)
                throw InvalidArgument("quietMs is " + std::to_string(config_.quietMs) + ": it must be 1 or more");
            checkWire();
            pipeline_ = std::make_unique<TilePipeline>(pool_, config_, operations_, rank(), size(), mailbox_->address(),
                                                       [this](Buffer&& message) { sendToDisplay(std::move(message)); });
            mine = Agreement::of(traits(), config_, mailbox_->connection().options().checksums, rank(),
                                 TilePipeline::travelling(traits(), config_), layout().tileCount(),
                                 [this](int tile) { return tileOwner(tile); });
        } catch (const InvalidArgument& e) {
            mine = {false, e.info().message, rank()};
        } catch (const OutOfMemory& e) {
            const bool several = config_.framesInFlight > 1;
            mine = {false,
                    e.what()
                        + (several ? "; there is one for each of " + std::to_string(config_.framesInFlight)
                                         + " frames in flight"
                                   : ""),
                    rank()};
        } catch (const std::exception& e) {
            // No memory, or out of the owner map: the others must not wait for this rank.
            mine = {false, e.what(), rank()};
        }
        const auto all = agree(*mailbox_, mine);
        if (!all.fine) {
            mailbox_->stop(); // what has come already is for this object, as long as it is whole
            outcome_.reset();
            mailbox_.reset(); // before the exception passes: all ranks throw it, so this end is in order
            all.refuse();
        }
        mailbox_->connection().setAlike();
        tellImagePlace();
    }

    FrameEngine(const FrameEngine&) = delete;
    FrameEngine& operator=(const FrameEngine&) = delete;
    ~FrameEngine() override { mailbox_->stop(); }

    int rank() const noexcept override { return mailbox_->rank(); }
    int size() const noexcept override { return mailbox_->size(); }
    const FrameBufferConfig& config() const noexcept override { return config_; }
    const TileLayout& layout() const noexcept override { return pipeline_->table().layout(); }
    int tileOwner(int tile) const noexcept override { return pipeline_->table().owner(tile); }
    const std::vector<int>& ownedTiles() const noexcept override { return pipeline_->table().owned(); }
    const Image& image() const noexcept override { return imageFrame() < 0 ? noImage_ : pipeline_->gather().image(); }
    std::int64_t imageFrame() const noexcept override { return pipeline_->gather().imageFrame(); }
    bool isComplete(int tile) const override { return pipeline_->gather().isComplete(tile); }
    std::int64_t frame() const noexcept override { return gate_.frame(); }
    bool failed() const noexcept override { return outcome_->failed(); }

    void begin(const FrameParams& params) override
    {
        if (frameOpen_)
            throw InvalidArgument("begin() while a frame is open: end() it first");
        if (params.passes < 1)
            throw InvalidArgument("a frame has at least 1 pass, not " + std::to_string(params.passes));
        if (params.maxLayers < 0)
            throw InvalidArgument("at most " + std::to_string(params.maxLayers) + " layers");
        checkSamples(params);
        if (params.timeoutMs < 0)
            throw InvalidArgument("a time-out of " + std::to_string(params.timeoutMs) + " ms");
        mailbox_->requireProgress();
        mailbox_->connection().throwIfFailed();
        params_ = params;
        terms_ = FrameTerms::of(params, rank());
        manifests_.newFrame(!lastFailed_); // if it did, some owners may have what was declared in it, and others not

        TileInfo info;
        info.rank = rank();
        info.frame = gate_.next();
        info.passes = params.passes;
        info.firstSample = firstSampleOf(params);
        info.accumulationId = params.accumulationId;
        info.wanted = TilePipeline::imageChannels(config_);
        info.background = params.background;
        std::exception_ptr userError; // of copying the data, or of the pixel operation's newFrame()
        try {
            pipeline_->newFrame(info, params.samples, params.maxLayers, codecFor(config_.displayRank) != nullptr);
        } catch (...) {
            userError = std::current_exception();
        }
        jobs_.newFrame();
        if (traits().opaqueHides)
            hidden_.newFrame(layout().tileCount());
        outcome_->newFrame();
        quiescence_.newFrame(std::chrono::milliseconds(config_.quietMs));
        ownTilesDone_ = endCalled_ = false;
        inputsSent_ = 0;
        bytesBefore_ = mailbox_->bytesSent();
        messagesBefore_ = mailbox_->messagesSent();
        renderNs_ = 0;
        figures_.newFrame();
        tilesLeft_ = countUnknown;
        std::vector<int> kept; // without samples, but the pixel operation wants to see all tiles
        for (const int tile : ownedTiles()) {
            const bool rendered = pipeline_->table().samples(tile).count > 0;
            if (!rendered && !traits().pixelOpIsPointwise)
                kept.push_back(tile);
            if (rendered && !params.declared)
                ++tilesLeft_;
        }
        tilesLeft_ += static_cast<std::int64_t>(kept.size());
        lastPoll_ = beginTime_ = Clock::now();
        frameOpen_ = true;
        mailbox_->newEpoch(info.frame);
        mailbox_->connection().expectMessages(true);
        auto& early = gate_.open();
        if (userError)
            failWhole(userError); // comes out of end(), on all ranks; nothing is made with half of the frame's data
        for (FrameGate::Message& message : early)
            incoming(message.source, message.header, std::move(message.bytes));
        early.clear(); // some may still be there, if the frame has failed
        failForDamage();
        for (const int tile : kept)
            if (gate_.enter(info.frame)) {
                submitFinish(tile);
                gate_.leave();
            }
        if (!params.declared)
            tilesLess(countUnknown);
    }

    TileHeader headerOf(int tile, int pass) const override { return pipeline_->headerOf(tile, pass); }
    ChannelMask sent() const noexcept override { return pipeline_->sent(); }

    void setTile(const InputPixels& tile) override
    {
        checkTile(tile, layout(), pipeline_->table().frameInfo(),
                  [this](int index) { return pipeline_->table().samples(index).count; });
        pipeline_->checkPlanes(tile);
        if (outcome_->failed() || isHidden(tile.tile, tile.generation))
            return;
        const int owner = tileOwner(tile.tile);
        const Codec* codec = codecFor(owner);
        Buffer message = pipeline_->encode(tile, codec);
        if (codec)
            gains_->add(owner, rawFragmentBytes(message), message.size());
        ++inputsSent_;
        if (owner != rank()) {
            mailbox_->sendWithCredit(owner, std::move(message));
            waitForRoom();
        } else if (gate_.enter(tile.frame)) {
            arrive(std::move(message), -1);
            gate_.leave();
        }
        pollNowAndThen();
    }

    // See Frame.
    bool isHidden(int tile, int generation) const override { return generation >= hidden_.from(tile); }
    bool opaqueHides(int tile) const override { return pipeline_->opaqueHides(tile); }
    void hide(int tile, int generation, int other) override
    {
        if (!pipeline_->opaqueHides(tile))
            throw InvalidArgument("hide() with a tile operation or a frame to which everything counts");
        if (other == rank())
            hidden_.hide(tile, generation);
        else
            sendBody(other, MessageKind::Hidden, HiddenTiles::Message{tile, generation});
    }

    void expectLayers(int layers) override { pipeline_->setLayers(layers); }
    TileSamples samples(int tile) const override { return pipeline_->table().samples(tile); }

    void addFigure(std::uint64_t key, double value) override { figures_.add(key, value); }
    void noteMergeError(int tile, double bound) override { figures_.addMergeError(tile, bound / samples(tile).count); }

    JobRange nextJobs(std::int64_t count) override
    {
        std::optional<JobRange> range = jobs_.take(count, rank(), size());
        askForJobs(count); // for the next time, while this one is worked on
        if (!range) {
            std::optional<Clock::time_point> deadline;
            if (params_.timeoutMs > 0)
                deadline = Clock::now() + std::chrono::milliseconds(params_.timeoutMs);
            if (!mailbox_->wait([this] { return jobs_.ready() || outcome_->failed(); }, deadline)) {
                ErrorInfo info;
                info.kind = ErrorKind::TimedOut;
                info.from = jobServer();
                info.message = "no word of rank " + std::to_string(jobServer()) + " on what there is to render";
                failWith(std::make_exception_ptr(Error(std::move(info))));
            }
            range = jobs_.take(count, rank(), size());
            askForJobs(count);
        }
        return range.value_or(JobRange{});
    }

    void waitForRoom()
    {
        const std::chrono::milliseconds limit(params_.timeoutMs);
        if (mailbox_->waitForRoom([this] { return outcome_->failed(); }, limit))
            return;
        ErrorInfo info;
        info.kind = ErrorKind::TimedOut;
        info.message = "no room for more tiles: " + mailbox_->flow().notTaken();
        failWith(std::make_exception_ptr(Error(std::move(info))));
    }

    void declare(const std::vector<TileInput>& inputs) override
    {
        if (!params_.declared)
            throw InvalidArgument("declare() in a frame that was not begun with declared inputs");
        if (manifests_.declared())
            throw InvalidArgument("declare() a second time in a frame");
        for (const TileInput& input : inputs)
            if (input.tile < 0 || input.tile >= layout().tileCount())
                throw InvalidArgument("declare() of tile " + std::to_string(input.tile) + " of an image of "
                                      + std::to_string(layout().tileCount()) + " tiles");
        if (outcome_->failed())
            return;
        const bool isWaiting = manifests_.declare(
            inputs, rank(), [this](int tile) { return tileOwner(tile); },
            [this](int owner, const Bytes& manifest) {
                mailbox_->send(owner, MessageKind::Manifest, gate_.frame(), manifest);
            });
        if (!isWaiting)
            enterAllDeclared();
    }

    void abort(const std::exception_ptr& reason, int tile) override
    {
        ErrorInfo where;
        where.tile = tile;
        failWith(reason, where);
    }

    bool poll() override
    {
        bool did = mailbox_->connection().poll();
        Executor& executor = mailbox_->executor();
        while (!executor.hasWorkers() && executor.help())
            did = true;
        return did;
    }

    // Where nobody else does, for a renderer that does not call poll(). What takes no time gets on quicker without.
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

    FrameReport end() override
    {
        if (params_.declared && !manifests_.declared() && !outcome_->failed()) {
            const auto reason = outcome_->reason(); // why declare() was not called, in a frame that may be partial
            failWhole(reason ? std::make_exception_ptr(Error(*reason))
                             : std::make_exception_ptr(
                                 InvalidArgument("end() of a frame with declared inputs without declare()")));
        }
        if (pipeline_->gather().displays())
            guarded([this] { pipeline_->finishBackground(); });
        const Verdict verdict = conclude();
        if (verdict.error && (!params_.allowPartial || verdict.error->kind == ErrorKind::Disagreement))
            throw FrameError(*verdict.error);
        const bool compressed = compresses();
        pipeline_->fillBackground();
        if (!verdict.error) {
            if (config_.codec)
                compressionTrial_.took(static_cast<double>(verdict.maxima[3]));
            gains_->endFrame();
            lastAccumulationId_ = params_.accumulationId;
            nextSample_ = params_.samples ? 0 : pipeline_->table().frameInfo().firstSample + params_.passes;
        }

        const double nsPerMs = 1e6;
        FrameReport report;
        report.frame = gate_.frame();
        report.totalMs = static_cast<double>(std::chrono::nanoseconds(Clock::now() - beginTime_).count()) / nsPerMs;
        report.renderMs = static_cast<double>(renderNs_) / nsPerMs;
        report.compositingOverheadMs = report.totalMs - report.renderMs;
        report.tilesTotal = layout().tileCount();
        report.wireColor = pipeline_->wireColor();
        report.compressed = compressed;
        report.threads = mailbox_->executor().concurrency();
        report.progress = mailbox_->connection().needsCaller() ? Progress::Caller : Progress::Thread;
        verdict.addTo(report);
        return report;
    }

    void cancel(std::int64_t frame) override
    {
        if (!gate_.enter(frame))
            return; // it is over
        failWith(std::make_exception_ptr(Error(cancelled("the frame was cancelled"))));
        gate_.leave();
    }

    // A frame that is left without end(), mostly while an exception passes.
    void leave() noexcept override
    {
        try {
            if (outcome_->failed())
                dropRest();
            else
                failWhole(std::make_exception_ptr(
                    Error(cancelled("the frame was left without end(). If by an exception: Frame::guard() around what "
                                    "throws tells all ranks its text"))));
            conclude();
        } catch (const TransportError&) {
            // begin() will say so.
        }
    }

    std::vector<std::int64_t> allReduce(const std::vector<std::int64_t>& values, Reduce how) override
    {
        return mailbox_->allReduce(values, [how](std::int64_t x, std::int64_t y) {
            if (how == Reduce::Sum)
                return static_cast<std::int64_t>(static_cast<std::uint64_t>(x) + static_cast<std::uint64_t>(y));
            return how == Reduce::Min ? std::min(x, y) : std::max(x, y);
        });
    }

    std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& own) override
    {
        ByteWriter out; // of each rank: which it is, the size, the bytes
        out.put(static_cast<std::int32_t>(rank()));
        out.put(static_cast<std::uint64_t>(own.size()));
        Bytes mine = out.bytes();
        mine.append(own.data(), own.data() + own.size());
        const Bytes all = mailbox_->reduce(std::move(mine), [](const Bytes& a, const Bytes& b) {
            Bytes both = a;
            both.append(b.begin(), b.end());
            return both;
        });
        std::vector<std::vector<std::byte>> result;
        ByteReader in(all);
        for (int from = 0; from < size(); ++from) { // in order, as they were combined
            const auto whose = in.get<std::int32_t>();
            const auto byteCount = in.get<std::uint64_t>();
            in.require(whose == from && byteCount <= in.left());
            result.emplace_back(static_cast<std::size_t>(byteCount));
            for (std::byte& byte : result.back())
                byte = in.get<std::byte>();
        }
        in.end();
        return result;
    }

private:
    const OperationTraits& traits() const noexcept { return operations_.traits(); }

    using Clock = std::chrono::steady_clock;
    enum Scope : std::uint32_t { AllDeclared = Mailbox::ownScope + 1, FrameVerdict, Quiet = Mailbox::quietScope };

    // Added to the number of tiles to wait for as long as it is not known: finishing one is then never the last.
    static constexpr std::int64_t countUnknown = std::int64_t{1} << 40;

    // So long end() waits between two looks at what nobody tells it.
    static constexpr std::chrono::milliseconds untilAsked{2000};

    bool compresses() const
    {
        return config_.codec && (config_.compression == CompressionMode::Always || compressionTrial_.compresses());
    }

    // What messages with pixels to that rank are compressed with in this frame, or null.
    const Codec* codecFor(int other) const
    {
        if (other == rank() || !compresses())
            return nullptr;
        const bool isLeftOut = config_.compression == CompressionMode::Auto
                               && (mailbox_->connection().isSeenBy(other) || !gains_->isWorthwhile(other));
        return isLeftOut ? nullptr : config_.codec.get();
    }

    // ---- messages

    void incoming(int source, const MessageHeader& header, Buffer&& message) override
    {
        const std::size_t byteCount = message.size();
        const bool hasCredit = source != rank() && mailbox_->needsCredit(header.kind);
        switch (gate_.enter(source, header, message)) {
        case FrameGate::Entry::Kept: return;
        case FrameGate::Entry::Late:
            if (hasCredit)
                mailbox_->flow().discarded(byteCount);
            return;
        case FrameGate::Entry::Absurd: {
            if (hasCredit)
                mailbox_->flow().discarded(byteCount);
            ErrorInfo info;
            info.kind = ErrorKind::MalformedMessage;
            info.expected = gate_.next();
            info.got = header.number;
            info.message = "a message of a frame that no rank can have begun";
            undecodable(source, info);
            return;
        }
        case FrameGate::Entry::Inside: break;
        }
        if (hasCredit)
            mailbox_->flow().consumed(source, byteCount);
        mailbox_->countTaken(source, header, message);
        guarded([&] { handle(source, header, std::move(message)); }, {}, source);
        gate_.leave();
    }

    // By the rank after the display rank, which has enough to do.
    int jobServer() const { return (config_.displayRank + 1) % size(); }

    void askForJobs(std::int64_t count)
    {
        if (!jobs_.shouldAsk())
            return;
        const JobRequest request{count, config_.executor->concurrency(), 0};
        if (jobServer() == rank())
            guarded([&] { jobs_.receive(jobs_.give(request, size())); });
        else
            sendBody(jobServer(), MessageKind::JobRequest, request);
    }

    template <class Body>
    void sendBody(int to, MessageKind kind, const Body& body)
    {
        const auto* first = reinterpret_cast<const std::byte*>(&body);
        mailbox_->send(to, kind, gate_.frame(), Bytes(first, first + sizeof body));
    }

    void sendToDisplay(Buffer&& message)
    {
        if (mailbox_->needsCredit(loadAs<MessageHeader>(message.data()).kind)) {
            if (const std::size_t raw = FinalGather::rawBytesOf(message); raw > 0)
                gains_->add(config_.displayRank, raw, message.size());
            mailbox_->sendWithCredit(config_.displayRank, std::move(message));
        } else
            mailbox_->send(config_.displayRank, std::move(message));
    }

    // To the ranks that see the memory of the display rank: they put finished tiles into its image themselves. Who has
    // not heard of it by the end of the first frame goes on sending tiles.
    void tellImagePlace()
    {
        if (rank() != config_.displayRank)
            return;
        Connection& connection = mailbox_->connection();
        std::vector<int> seers;
        for (int other = 0; other < size(); ++other)
            if (connection.isSeenBy(other))
                seers.push_back(other);
        if (seers.empty())
            return;
        const auto places =
            pipeline_->gather().shareImage([&](const std::byte* block) { return connection.placeOf(block); });
        if (!places)
            return;
        const auto* first = reinterpret_cast<const std::byte*>(&*places);
        for (const int other : seers)
            mailbox_->send(other, MessageKind::ImagePlace, gate_.next(), Bytes(first, first + sizeof *places));
    }

    // Nobody knows which frame it was for: if none is open, or this rank has all that it needs for the one that is, the
    // next one can not do without it.
    void undecodable(int source, const ErrorInfo& error) override
    {
        mailbox_->keepDamage(source, error); // first: begin() opens the gate and then looks
        if (!gate_.enterAny())
            return;
        failForDamage();
        gate_.leave(); // not before: the next begin() waits for it
    }

    void failForDamage()
    {
        const auto damage = mailbox_->takeDamage();
        if (damage && !failWith(std::make_exception_ptr(Error(damage->second)), messageFrom(damage->first)))
            mailbox_->keepDamage(damage->first, damage->second);
    }

    static ErrorInfo messageFrom(int source)
    {
        ErrorInfo where;
        where.from = source;
        return where;
    }

    void handle(int source, const MessageHeader& header, Buffer&& message)
    {
        const MessageKind kind = header.kind;
        if (kind == MessageKind::Abort) {
            ByteReader body(message.data() + sizeof header, message.size() - sizeof header);
            const ErrorInfo info = getErrorInfo(body);
            body.end();
            failElsewhere(info);
            return;
        }
        if (kind == MessageKind::CreditRequest) {
            mailbox_->flow().requested(source, bodyAs<FlowControl::Request>(message));
            return;
        }
        if (kind == MessageKind::Credit) {
            mailbox_->flow().credited(source, bodyAs<FlowControl::Credit>(message));
            return;
        }
        if (kind == MessageKind::ReduceUp || kind == MessageKind::ReduceDown) {
            receiveReduction(source, header, message);
            return;
        }
        if (kind == MessageKind::ImagePlace) {
            if (source != config_.displayRank)
                failMalformed("a rank that displays nothing has an image", config_.displayRank, source);
            pipeline_->gather().useImage(bodyAs<ImagePlaces>(message), [&](std::int32_t place, std::size_t byteCount) {
                return mailbox_->connection().blockAt(source, place, byteCount);
            });
            return;
        }
        if (outcome_->failed() && !(params_.allowPartial && isFinishedTile(kind)))
            return;
        switch (kind) {
        case MessageKind::Fragment: arrive(std::move(message), source); break;
        case MessageKind::Manifest:
            if (!params_.declared) {
                ErrorInfo info;
                info.kind = ErrorKind::Disagreement;
                info.message = "the sender declares its inputs, this rank expects no declaration";
                throw Error(std::move(info));
            }
            manifests_.receive(
                source, ByteReader(message.data() + sizeof(MessageHeader), message.size() - sizeof(MessageHeader)),
                [this](int tile) { return pipeline_->table().isMine(tile); });
            mailbox_->send(source, MessageKind::ManifestAck, gate_.frame());
            break;
        case MessageKind::ManifestAck:
            if (manifests_.acknowledged(source))
                enterAllDeclared();
            break;
        case MessageKind::JobRequest: {
            if (rank() != jobServer())
                failMalformed("a request for jobs to a rank that hands out none", jobServer(), rank());
            sendBody(source, MessageKind::Jobs, jobs_.give(bodyAs<JobRequest>(message), size()));
            break;
        }
        case MessageKind::Hidden: {
            const auto body = bodyAs<HiddenTiles::Message>(message);
            if (body.tile < 0 || body.tile >= layout().tileCount() || body.generation < 1
                || !pipeline_->opaqueHides(body.tile))
                failMalformed("word of hidden inputs of a tile that has none", layout().tileCount() - 1, body.tile);
            hidden_.hide(body.tile, body.generation);
            return;
        }
        case MessageKind::Jobs:
            if (source != jobServer())
                failMalformed("jobs from a rank that hands out none", jobServer(), source);
            jobs_.receive(bodyAs<JobRange>(message));
            mailbox_->notify();
            break;
        case MessageKind::FinishedTiles:
            pipeline_->gather().receiveTiles(source, std::move(message));
            tryVote();
            break;
        case MessageKind::TilesDone:
            pipeline_->gather().receiveDone(source, message);
            tryVote();
            break;
        default: break;
        }
    }

    static bool isFinishedTile(MessageKind kind)
    {
        return kind == MessageKind::FinishedTiles || kind == MessageKind::TilesDone;
    }

    template <class Body>
    static Body bodyAs(const Buffer& message)
    {
        if (message.size() != sizeof(MessageHeader) + sizeof(Body))
            failMalformed("wrong message size", sizeof(MessageHeader) + sizeof(Body),
                          static_cast<std::int64_t>(message.size()));
        return loadAs<Body>(message.data() + sizeof(MessageHeader));
    }

    // Ranks that were given different parameters may wait for different things, so that none of them would ever be
    // done: a partial result from below in the tree shows it, as it was sent without waiting for this rank.
    void receiveReduction(int source, const MessageHeader& header, const Buffer& message)
    {
        const std::uint32_t scope = mailbox_->keyOf(header, message).scope;
        const bool isUp = header.kind == MessageKind::ReduceUp;
        bool differs = false;
        try {
            if (scope == FrameVerdict) {
                const Verdict verdict = Verdict::from(mailbox_->bytesOf(message));
                if (!verdict.fits(layout().tileCount()))
                    failMalformed("a verdict on tiles that there are not", layout().tileCount() - 1);
                differs = isUp && !verdict.terms.difference(terms_).empty();
            } else if (scope == AllDeclared) {
                if (!mailbox_->bytesOf(message).empty())
                    failMalformed("a declaration's reduction that carries something");
                differs = isUp && !params_.declared;
            } else if (scope == Quiet) {
                differs = !Round::from(mailbox_->bytesOf(message)).terms.difference(terms_).empty();
            } else {
                failMalformed("a reduction of a kind that there is not", FrameVerdict, scope);
            }
            if (differs)
                failWith(std::make_exception_ptr(Error(Verdict::disagreement())));
            mailbox_->receiveReduction(source, header, message);
        } catch (const Error& e) {
            // Without this message there would never be a result.
            mailbox_->giveUp(source, e.info());
        }
    }

    // ---- tiles

    // `where` says what is known of the place.
    // `source`: -1 if it is this rank's own.
    void arrive(Buffer&& message, int source)
    {
        ErrorInfo where;
        TileTable::Arrival arrival;
        guarded([&] { pipeline_->arrive(std::move(message), source >= 0 ? source : rank(), where, arrival); }, where,
                source);
        if (arrival.spoilt) {
            pipeline_->table().saidWhy();
            tryVote();
        }
        if (arrival.ready)
            guarded([&] { submitFinish(static_cast<int>(where.tile)); }, where);
    }

    void submitFinish(int tile)
    {
        gate_.enterAgain(); // we are inside
        mailbox_->submitWork(tile);
    }

    // A tile that is complete.
    void work(int tile) override
    {
        ErrorInfo where;
        where.tile = tile;
        if (!outcome_->failed()) {
            const bool finished = guarded([&] { pipeline_->finish(tile); }, where);
            if (finished || params_.allowPartial)
                guarded([&] { tilesLess(1); }, where);
        }
        gate_.leave();
    }

    // So many tiles less to wait for.
    void tilesLess(std::int64_t count)
    {
        if ((tilesLeft_ -= count) != 0)
            return;
        pipeline_->gather().flush();
        ownTilesDone_ = true;
        tryVote();
    }

    // ---- what is expected, by manifest

    void enterAllDeclared()
    {
        mailbox_->reductions().enter(
            {AllDeclared, gate_.frame()}, {}, [](const Bytes& a, const Bytes&) { return a; },
            [this, frame = gate_.frame()](const Bytes&) {
                if (!gate_.enter(frame))
                    return;
                applyDeclarations();
                gate_.leave();
            });
    }

    // Every manifest is here: now it is known what each owned tile waits for.
    void applyDeclarations()
    {
        manifests_.complete();
        if (outcome_->failed())
            return;
        // A pixel operation that is not pointwise sees background tiles too.
        const bool all = !traits().pixelOpIsPointwise;
        ErrorInfo where;
        const bool declared = guarded(
            [&] {
                pipeline_->table().declare(
                    manifests_.expected(), all, where, [this](int) { ++tilesLeft_; },
                    [this](int tile) { submitFinish(tile); });
            },
            where);
        if (declared || params_.allowPartial)
            guarded([&] { tilesLess(countUnknown); });
    }

    // ---- failure, verdict, end

    // Runs `body`; what it throws makes the frame fail. `where` says what is known of the place by then, `source` whose
    // message it was about, or -1. False if it did throw.
    template <class Body>
    bool guarded(const Body& body, const ErrorInfo& where = {}, int source = -1)
    {
        try {
            body();
            return true;
        } catch (...) {
            ErrorInfo place = where;
            place.from = source;
            failWith(std::current_exception(), place);
            return false;
        }
    }

    static ErrorInfo cancelled(const char* text)
    {
        ErrorInfo info;
        info.kind = ErrorKind::Cancelled;
        info.message = text;
        return info;
    }

    // Whether a frame that may be partial goes on without what this was about.
    bool isBearable(const std::exception_ptr& reason) const
    {
        const ErrorKind kind = errorInfoOf(reason, {}).kind;
        return params_.allowPartial && !isMissing(kind) && kind != ErrorKind::Cancelled
               && kind != ErrorKind::Disagreement
               && (kind != ErrorKind::MalformedMessage || params_.timeoutMs > 0); // what it said would be waited for
    }

    // False if this rank has voted.
    bool failWith(const std::exception_ptr& reason, const ErrorInfo& where = {})
    {
        if (!isBearable(reason))
            return failWhole(reason, where);
        const bool inTime = outcome_->note(reason, where);
        if (!inTime && !outcome_->failed())
            gate_.countLate(); // the verdict will not say it
        return inTime;
    }

    // The same where the frame can not go on, whether or not it may be partial.
    bool failWhole(const std::exception_ptr& reason, const ErrorInfo& where = {})
    {
        const bool inTime = outcome_->fail(reason, where);
        if (!inTime)
            gate_.countLate(); // too late to matter to this frame
        dropRest();
        tryVote();
        return inTime;
    }

    // The frame has failed: what has not left matters no more, unless what is finished is wanted.
    void dropRest()
    {
        mailbox_->flow().drop([this](const Buffer& message) {
            return params_.allowPartial && isFinishedTile(loadAs<MessageHeader>(message.data()).kind);
        });
        if (params_.allowPartial && !ownTilesDone_)
            pipeline_->gather().flush();
    }

    void failElsewhere(const ErrorInfo& info)
    {
        std::optional<ErrorInfo> mine;
        if (isMissing(info.kind) && !outcome_->failed())
            mine = missing(info.kind); // this rank's part of what is missing
        ErrorInfo copy = info;
        if (isMissing(info.kind))
            copy.tile = copy.expected = -1; // it must not pass for the list of the rank that it came from
        outcome_->failElsewhere(mine && Verdict::weight(*mine) > Verdict::weight(copy) ? *mine : copy);
        dropRest();
        tryVote();
    }

    // What this rank waits for, if it does; `kind`: how that is known to be missing.
    std::optional<ErrorInfo> missing(ErrorKind kind)
    {
        std::optional<ErrorInfo> info;
        if (!ownTilesDone_ && params_.declared && tilesLeft_ >= countUnknown / 2) {
            info.emplace();
            info->message = "not all ranks have declared their inputs";
            info->expected = size();
            addWaitedFor(*info, "no word from", {AllDeclared, gate_.frame()});
        } else if (!ownTilesDone_) {
            info = pipeline_->table().missing(params_.declared);
            if (!info) {
                info.emplace();
                info->message = "tiles that have all their inputs are still being finished";
            }
        } else if (!pipeline_->gather().complete()) {
            info.emplace();
            info->message = pipeline_->gather().missing();
            info->from = pipeline_->gather().firstMissing();
            info->expected = pipeline_->gather().senderCount();
            info->got = pipeline_->gather().ranksDone();
        } else {
            info.emplace();
            addWaitedFor(*info, "no verdict from", outcome_->key());
        }
        if (info) {
            info->kind = kind;
            info->rank = rank();
            info->frame = gate_.frame();
            if (const std::string lost = mailbox_->connection().lost(); kind == ErrorKind::TimedOut && !lost.empty())
                info->message += (info->message.empty() ? "" : "; ") + lost;
        }
        return info;
    }

    // Says whose part of a reduction this rank waits for, and in `from`, if there is only one that it can be.
    void addWaitedFor(ErrorInfo& info, const char* what, const ReductionKey& key)
    {
        const auto missing = mailbox_->reductions().missing(key);
        std::string text;
        for (const auto& part : missing) {
            text += (text.empty() ? std::string(what) + " rank " : ", rank ") + std::to_string(part.rank);
            if (part.rank < rank())
                text += ", through which the result comes";
            else if (part.last > part.rank)
                text += " or another up to " + std::to_string(part.last) + ", whose part comes with that one's";
        }
        if (missing.size() == 1 && missing.front().rank > rank() && missing.front().last == missing.front().rank)
            info.from = missing.front().rank;
        if (!text.empty())
            info.message += (info.message.empty() ? "" : ", ") + text;
    }

    // This rank waits for nothing but the others.
    bool isDone() const
    {
        return endCalled_ && ownTilesDone_ && pipeline_->table().isSaid() && pipeline_->gather().complete();
    }

    // Enters the frame's verdict when all is done here, or the frame has failed somewhere.
    void tryVote()
    {
        outcome_->vote(
            [this] {
                return isDone(); // or the frame has failed
            },
            [this] { return mayVote(); },
            [this] {
                Verdict v;
                const std::int64_t repeated = mailbox_->connection().duplicates();
                v.terms = terms_;
                const auto reports = pipeline_->reports();
                v.sums = {mailbox_->bytesSent() - bytesBefore_ + pipeline_->gather().placedBytes(),
                          mailbox_->messagesSent() - messagesBefore_,
                          ownTilesDone_ ? pipeline_->table().touchedCount() : 0,
                          pipeline_->nonFinitePixels(),
                          gate_.takeLateCount(),
                          repeated - repeatedBefore_,
                          reports.orderUndefinedPixels,
                          pipeline_->alphaOutsidePixels(),
                          gains_->links(),
                          inputsSent_ - pipeline_->table().arrivedCount(),
                          pipeline_->table().endedEarlyCount()};
                v.wireErrorBound = reports.wireErrorBound;
                v.tileErrors = FrameFigures::of(reports.errors);
                figures_.addTo(v);
                if (params_.allowPartial)
                    v.incomplete = pipeline_->table().unfinished(params_.declared);
                repeatedBefore_ = repeated;
                v.maxima = {static_cast<std::int64_t>(pool_->peakBytes()), renderNs_,
                            static_cast<std::int64_t>(mailbox_->flow().peakInboxBytes()),
                            std::chrono::nanoseconds(Clock::now() - beginTime_).count()};
                return v;
            });
    }

    // Where only end() moves messages, all that others have sent must have been taken before any rank may leave: who
    // polls no more takes nothing, and its sender would wait in end() for it to go.
    bool mayVote() const
    {
        Connection& connection = mailbox_->connection();
        return !connection.needsCaller() || (mailbox_->flow().allSent() && connection.quiet());
    }

    void polled() override
    {
        if (frameOpen_)
            tryVote();
    }

    void checkWire() const
    {
        const WirePrecision& w = config_.wire;
        if (!(w.budget >= 0) || !(w.maxColor >= 1e-30f && w.maxColor <= 1e30f))
            throw InvalidArgument("an error budget of " + std::to_string(w.budget) + ", colours up to "
                                  + std::to_string(w.maxColor));
        if (!(config_.minTransmittance >= 0 && config_.minTransmittance < 1))
            throw InvalidArgument("a least transmittance of " + std::to_string(config_.minTransmittance));
    }

    // Whether what the last frame left behind is of use.
    bool accumulates(const FrameParams& params) const
    {
        return traits().keepsState && !lastFailed_ && params.accumulationId == lastAccumulationId_;
    }

    // Without a plan: of each tile.
    int firstSampleOf(const FrameParams& params) const
    {
        return !params.samples && accumulates(params) ? nextSample_ : 0;
    }

    // Throws InvalidArgument for samples that this framebuffer can not take.
    void checkSamples(const FrameParams& params) const
    {
        if (!params.samples) {
            if (params.passes > std::numeric_limits<int>::max() - firstSampleOf(params))
                throw InvalidArgument("a tile can not have " + std::to_string(params.passes) + " samples from "
                                      + std::to_string(firstSampleOf(params)) + " on: take another accumulationId");
            return;
        }
        if (params.samples->size() != static_cast<std::size_t>(layout().tileCount()))
            throw InvalidArgument("a plan of the samples of " + std::to_string(params.samples->size())
                                  + " tiles for an image of " + std::to_string(layout().tileCount()));
        for (const TileSamples& t : *params.samples) {
            if (t.first < 0 || t.count < 0 || t.count > std::numeric_limits<int>::max() - t.first)
                throw InvalidArgument("a tile can not have " + std::to_string(t.count) + " samples from "
                                      + std::to_string(t.first) + " on");
            if (!traits().keepsState && (t.count == 0 || t.first > 0))
                throw InvalidArgument("this tile operation keeps nothing over frames: each tile needs samples, from 0");
            if ((t.first > 0 || t.count == 0) && !accumulates(params))
                throw InvalidArgument("what was accumulated is of no use, as the last frame failed or had another "
                                      "accumulationId: begin again with sample 0 of each tile");
        }
    }

    // Waits for the verdict and closes the frame, also when it throws TransportError.
    Verdict conclude()
    {
        renderNs_ = std::chrono::nanoseconds(Clock::now() - beginTime_).count();
        endCalled_ = true;
        nextLook_ = Clock::now() + quiescence_.interval();
        std::exception_ptr transportError;
        Verdict verdict;
        try {
            tryVote();
            verdict = params_.timeoutMs > 0 ? waitInTime() : waitWithoutLimit();
            if (!verdict.error)
                verdict.error = verdict.strayInputs();
            if (verdict.error && verdict.error->frame < 0) // found where verdicts were combined
                verdict.error->frame = gate_.frame();
            if (verdict.error && params_.allowPartial
                && verdict.error->kind != ErrorKind::Disagreement) // not from ranks that send none
                waitForFinishedTiles();
        } catch (const TransportError&) {
            transportError = std::current_exception();
        }
        gate_.close([this] { return mailbox_->executor().help(); });
        mailbox_->reductions().forget(AllDeclared, gate_.frame());
        mailbox_->reductions().forget(Quiet, gate_.frame());
        mailbox_->connection().expectMessages(false);
        frameOpen_ = false;
        lastFailed_ = transportError || verdict.error;
        pipeline_->gather().closeImage();
        const bool isPartial = !transportError && verdict.error && verdict.error->kind != ErrorKind::Disagreement;
        if (isPartial && params_.allowPartial)
            pipeline_->setIncomplete(verdict.incomplete);
        else if (lastFailed_)
            pipeline_->gather().invalidate();
        if (transportError)
            std::rethrow_exception(transportError);
        return verdict;
    }

    // The verdict, or a frame that fails for what is missing, or, if even that can not be agreed on, TransportError.
    Verdict waitInTime()
    {
        const auto limit = std::chrono::milliseconds(params_.timeoutMs);
        const auto start = Clock::now();
        if (const Verdict* verdict = waitAndLook(start + limit))
            return *verdict;
        if (const auto what = missing(ErrorKind::TimedOut); what && !outcome_->failed())
            failWith(std::make_exception_ptr(Error(*what)));
        if (const Verdict* verdict = outcome_->wait(start + 2 * limit))
            return *verdict;
        giveUpVerdict(2 * limit);
    }

    // The verdict, however long others render. Only where a damaged message was noticed, which may have been part of
    // the verdict, is it waited for no longer than for a rank of which nothing is heard.
    Verdict waitWithoutLimit()
    {
        const auto limit = std::chrono::milliseconds(mailbox_->connection().options().peerTimeoutMs);
        const auto step = limit.count() > 0 ? std::min(limit, untilAsked) : untilAsked;
        std::optional<Clock::time_point> deadline;
        for (;;) {
            if (const Verdict* verdict = waitAndLook(Clock::now() + step))
                return *verdict;
            if (!deadline && limit.count() > 0 && outcome_->isDamaged())
                deadline = Clock::now() + limit;
            if (deadline && Clock::now() >= *deadline)
                giveUpVerdict(limit);
        }
    }

    // The verdict; null if it has not come by then. Meanwhile this rank looks, now and then, whether anything is under
    // way.
    const Verdict* waitAndLook(Clock::time_point deadline)
    {
        for (;;) {
            if (const Verdict* verdict = outcome_->wait(std::min(deadline, nextLook_)))
                return verdict;
            const auto now = Clock::now();
            if (now >= nextLook_) {
                nextLook_ = now + quiescence_.interval();
                look();
            }
            if (now >= deadline)
                return nullptr;
        }
    }

    // What travels in a round of quiescence_. Ranks that were given different parameters may wait for each other for
    // ever: therefore it carries what they were given, and shows the difference on its way up the tree, as soon as two
    // of them are in end(); see receiveReduction().
    struct Round {
        FrameTerms terms;
        Quiescence::Report report;

        Bytes bytes() const
        {
            ByteWriter out;
            out.put(terms);
            out.put(report);
            return out.bytes();
        }
        static Round from(const Bytes& bytes)
        {
            ByteReader in(bytes);
            Round round;
            round.terms = in.get<FrameTerms>();
            round.report = in.get<Quiescence::Report>();
            in.end();
            return round;
        }
        static Bytes combine(const Bytes& first, const Bytes& second)
        {
            const Round a = from(first), b = from(second);
            return Round{a.terms, Quiescence::sum(a.report, b.report)}.bytes();
        }
    };

    // Enters a round, if this rank rests, and the last one has come to its end. By the thread that is in end().
    void look()
    {
        tryVote();
        const auto counts = mailbox_->countsAtRest();
        if (!counts || !quiescence_.mayEnter())
            return;
        const auto isWaiting = [this] { return !isDone() && !outcome_->failed(); };
        const Round mine{terms_, {*counts, isWaiting() ? 1u : 0u}};
        quiescence_.enter();
        mailbox_->reductions().enter({Quiet, gate_.frame()}, mine.bytes(), Round::combine,
                                     [this, isWaiting](const Bytes& all) {
                                         if (!quiescence_.endRound(Round::from(all).report) || !isWaiting())
                                             return;
                                         if (const auto what = missing(ErrorKind::MissingInput))
                                             failWith(std::make_exception_ptr(Error(*what)));
                                     });
    }

    // Of a frame that failed and may be partial: those that other ranks have finished may still be on their way.
    void waitForFinishedTiles()
    {
        const auto areThere = [this] { return pipeline_->gather().complete() && mailbox_->flow().allSent(); };
        if (params_.timeoutMs == 0) // but what could not be read does not come again
            mailbox_->wait([&] { return areThere() || outcome_->isDamaged(); });
        mailbox_->wait(areThere,
                       Clock::now()
                           + (params_.timeoutMs > 0 ? std::chrono::milliseconds(params_.timeoutMs) : untilAsked));
    }

    [[noreturn]] void giveUpVerdict(std::chrono::milliseconds after)
    {
        ErrorInfo info;
        info.kind = ErrorKind::Transport;
        info.rank = rank();
        info.frame = gate_.frame();
        info.message = "no verdict after " + std::to_string(after.count()) + " ms";
        addWaitedFor(info, "no verdict from", outcome_->key());
        if (const std::string lost = mailbox_->connection().lost(); !lost.empty())
            info.message += "; " + lost;
        mailbox_->connection().giveUp(info);
        throw TransportError(std::move(info));
    }

    std::shared_ptr<MemoryPool> pool_;
    FrameBufferConfig config_;
    Operations& operations_;
    std::unique_ptr<TilePipeline> pipeline_;
    const Image noImage_;
    ManifestExchange manifests_;
    JobShare jobs_;
    HiddenTiles hidden_;
    Quiescence quiescence_;
    Clock::time_point nextLook_; // at it; of the thread that is in end()

    // The frame.
    FrameGate gate_;
    std::unique_ptr<FrameOutcome> outcome_;
    FrameParams params_;
    FrameTerms terms_; // of params_
    std::uint64_t lastAccumulationId_ = 0;
    int nextSample_ = 0; // of each tile, if the next frame has no plan and accumulates
    bool frameOpen_ = false, lastFailed_ = false;
    FrameFigures figures_;
    CompressionTrial compressionTrial_;
    std::optional<CompressionGains> gains_; // per rank that this one sends to
    std::atomic<std::int64_t> tilesLeft_{0};
    std::atomic<std::int64_t> inputsSent_{0}; // by this rank
    std::atomic<bool> ownTilesDone_{false}, endCalled_{false};
    std::atomic<std::int64_t> renderNs_{0};
    std::int64_t bytesBefore_ = 0, messagesBefore_ = 0, repeatedBefore_ = 0;
    Clock::time_point beginTime_;
    std::atomic<Clock::time_point> lastPoll_{}; // by pollNowAndThen()

    std::unique_ptr<Mailbox> mailbox_; // last: its tasks use the others
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE std::shared_ptr<Executor> makeThreads(const Connection& connection)
{
    return std::make_shared<ThreadExecutor>(connection.threadShare());
}

DFB_COMPILED_ONCE std::unique_ptr<Engine> makeEngine(std::shared_ptr<Connection> connection, FrameBufferConfig config,
                                                     Operations& operations, int slot)
{
    return std::make_unique<FrameEngine>(std::move(connection), std::move(config), operations, slot);
}
#endif

} // namespace dfb::detail
