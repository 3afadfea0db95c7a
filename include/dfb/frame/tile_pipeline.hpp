// TilePipeline: the way of a tile on this rank (Figure 2 of the paper): input, tile operation, pixel operation,
// conversion, display rank.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/base/levels.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/accumulation.hpp>
#include <dfb/frame/operations.hpp>
#include <dfb/frame/tile_table.hpp>
#include <dfb/frame/verdict.hpp>
#include <dfb/gather/gathered_image.hpp>
#include <dfb/gather/tile_sender.hpp>
#include <dfb/wire/fragment_message.hpp>
#include <dfb/wire/wire_losses.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <limits>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

class TilePipeline {
public:
    // `config` and `operations` must live as long as this. Throws InvalidArgument for an impossible configuration.
    TilePipeline(std::shared_ptr<MemoryPool> pool, const FrameBufferConfig& config, Operations& operations, int rank,
                 int rankCount, std::uint32_t address, TileSender::Send sendToDisplay, GatheredImage::Fail fail)
        : pool_(std::move(pool)), config_(config), address_(address), operations_(operations),
          table_(TileLayout(config.image.width, config.image.height, traits().tileWidth, traits().tileHeight),
                 config.image.ownerMap ? config.image.ownerMap : latticeOwner, rank, rankCount, operations)
    {
        if (config.image.format == OutputFormat::None)
            return;
        if (rank == config.image.displayRank)
            image_.emplace(
                pool_, table_.layout(), config, imageChannels(config), address, rankCount,
                [this](int tile) { return table_.owner(tile); }, std::move(fail));
        else
            sender_.emplace(pool_, table_.layout(), config, imageChannels(config), address, std::move(sendToDisplay),
                            [fail = std::move(fail)](const std::exception_ptr& reason) { fail(reason, -1); });
    }

    // Must be called before the first frame, with the same value on all ranks. `hasFarRanks`: whether there are two
    // ranks that share no memory.
    void setFarRanks(bool hasFarRanks)
    {
        budget_ = budgetOf(config_, hasFarRanks);
        coder_ = WireCoder(config_.precision, traits().activeByDepth, traits().readsInPlace && !isLossy());
    }

    // Returns the image's channels beside colour.
    static ChannelMask imageChannels(const FrameBufferConfig& config)
    {
        return static_cast<ChannelMask>(config.image.aux | (config.image.depth ? depthChannel : 0));
    }
    // Returns the channels of an input that are read: by the operation, the image, or the search for the nearest of
    // several passes, which gives position and ids (`comparesPasses`). `isOrdered`: the operation does without depth.
    static ChannelMask travelling(const OperationTraits& traits, const FrameBufferConfig& config,
                                  bool comparesPasses = true, bool isOrdered = false)
    {
        const bool comparesDepths =
            comparesPasses && (config.image.aux & (positionChannel | primitiveIdChannel | instanceIdChannel)) != 0;
        const int needed = traits.neededChannels & ~(isOrdered ? depthChannel : 0);
        return static_cast<ChannelMask>(traits.channels
                                        & (needed | imageChannels(config) | (comparesDepths ? depthChannel : 0)));
    }

    // The most bytes that one message with pixels can have.
    static std::size_t largestMessage(const OperationTraits& traits, const FrameBufferConfig& config)
    {
        const int width = traits.tileWidth, height = traits.tileHeight;
        return std::max(largestFragment(width, height, travelling(traits, config)),
                        largestBatch(FinishedRecord(config.image.format, imageChannels(config)),
                                     static_cast<std::size_t>(width) * static_cast<std::size_t>(height)));
    }

    TileTable& table() noexcept { return table_; }
    const TileTable& table() const noexcept { return table_; }
    // Null on other ranks than the display rank, and without an image.
    GatheredImage* image() noexcept { return image_ ? &*image_ : nullptr; }
    // Null on the display rank, and without an image.
    TileSender* sender() noexcept { return sender_ ? &*sender_ : nullptr; }

    // Whether this rank waits for no finished tile of other ranks.
    bool isImageComplete() const { return !image_ || image_->complete(); }
    // See TileSender.
    void flush()
    {
        if (sender_)
            sender_->flush();
    }

    // Takes the owners of the next frame; null: those of the owner map. Returns whether they differ from the last ones.
    bool setOwners(const TileOwners& owners)
    {
        const bool haveMoved = table_.setOwners(owners);
        if (haveMoved && image_)
            image_->findSenders();
        return haveMoved;
    }

    // No other member may be running. `params` must live until the next newFrame(). `compresses`: whether finished
    // tiles are compressed.
    void newFrame(std::int64_t frame, const FrameConfig& params, Accumulation::Start start, bool compresses)
    {
        const FloatEnvironment floatEnvironment; // keeps denormals of the background
        faults_.reset();
        promises_.clear();
        errors_.clear();
        orderUndefinedPixels_ = 0;
        if (!start.keeps)
            wireErrorBound_ = 0; // otherwise it stays, as a mean is no further off than its worst sample
        const SamplePlan& plan = params.samples;
        const bool hasPasses = plan ? std::any_of(plan->begin(), plan->end(), [](const auto& s) { return s.count > 1; })
                                    : params.passes > 1;
        TileInfo info;
        info.frame = frame;
        info.passes = params.passes;
        info.firstSample = start.firstSample;
        info.accumulationId = params.accumulationId;
        info.minTransmittance = config_.minTransmittance;
        info.wanted = imageChannels(config_);
        for (std::size_t c = 0; c < info.background.size(); ++c)
            info.background[c] = params.background[c] + 0.0f; // -0 becomes 0, as it does where something is blended
        const auto& last = table_.frameInfo().background;
        imageEpoch_ += std::memcmp(&info.background, &last, sizeof last) != 0;
        background_ = info.background;
        info.order = traits().takesOrder ? params.order.get() : nullptr;
        sent_ = travelling(traits(), config_, traits().keepsState || hasPasses, info.order != nullptr);
        backgroundIsFine_ = true;
        table_.newFrame(info, plan);
        if (image_)
            image_->newFrame(frame);
        if (sender_)
            sender_->newFrame(frame, compresses, !table_.owned().empty());
        losses_.newFrame(isLossy() ? table_.layout().tileCount() : 0, config_.precision.maxColor, largestBackground(),
                         config_.minTransmittance);
        setLayers(params.maxLayers);
    }

    ChannelMask sent() const noexcept { return sent_; } // of the inputs of this frame

    // Throws InvalidArgument if a tile does not fit this frame, or if it has a colour but lacks another channel that
    // must travel.
    void check(const InputPixels& tile) const
    {
        const TileInfo& frame = table_.frameInfo();
        const TileLayout& layout = table_.layout();
        std::string wrong;
        if (tile.frame != frame.frame)
            wrong =
                printed("a tile of frame %lld (prepare tiles with Frame::start)", static_cast<long long>(tile.frame));
        else if (tile.tile < 0 || tile.tile >= layout.tileCount())
            wrong = printed("outside the image, which has %d tiles", layout.tileCount());
        else if (tile.region != layout.region(tile.tile))
            wrong = "its region is not that of the tile";
        else if (const int passes = table_.samples(tile.tile).count; tile.pass < 0 || tile.pass >= passes)
            wrong = printed("the tile has %d passes", passes);
        else if (tile.generation < 0 || tile.generation >= DependencyTracker::maxGenerations)
            wrong = printed("the generation must be in [0, %d)", DependencyTracker::maxGenerations);
        else if (tile.children < 0)
            wrong = printed("it announces %d children", tile.children);
        if (!wrong.empty()) {
            ErrorInfo info = errorInfo(ErrorKind::InvalidArgument, std::move(wrong), frame.rank);
            info.frame = frame.frame;
            setPlace(info, tile);
            throw InvalidArgument(std::move(info));
        }
        const ConstPlanes& planes = tile.planes;
        if (!planes.at[Color])
            return;
        if (std::abs(tile.stride) < tile.valid.width())
            failArgument("a view of tile %d: its stride is %lld, its rows have %d pixels", tile.tile,
                         static_cast<long long>(tile.stride), tile.valid.width());
        for (std::size_t c = 0; c < channelCount; ++c)
            if (!planes.at[c] && hasChannel(sent_, c))
                failArgument("a view of tile %d without its %s, which is needed", tile.tile, channelNames[c]);
    }

    // Makes an error name the place of an input.
    static void setPlace(ErrorInfo& info, const TileHeader& input)
    {
        info.tile = input.tile;
        info.pass = input.pass;
        info.generation = input.generation;
        info.source = input.source;
    }

    // Whether an opaque input of a tile hides those behind it.
    bool opaqueHides(int tile) const
    {
        TileInfo info = table_.frameInfo();
        info.passes = table_.samples(tile).count;
        return operations_.opaqueHides(info);
    }

    TileHeader headerOf(int index, int pass) const
    {
        const TileInfo& frame = table_.frameInfo();
        if (index < 0 || index >= table_.layout().tileCount())
            failArgument("tile %d of an image of %d tiles", index, table_.layout().tileCount());
        const TileSamples samples = table_.samples(index);
        if (pass < 0 || pass >= samples.count)
            failArgument("pass %d of a tile of %d", pass, samples.count);
        TileHeader header;
        header.frame = frame.frame;
        header.tile = index;
        header.region = table_.layout().region(index);
        header.pass = pass;
        header.sample = samples.first + pass;
        header.source = static_cast<std::uint32_t>(frame.rank);
        return header;
    }

    // Returns the message for a tile that has passed check(). `codec` may be null. `isFar`: whether it goes to a rank
    // that shares no memory with this one.
    Buffer encode(const InputPixels& tile, const Codec* codec, bool isFar)
    {
        const FloatEnvironment floatEnvironment;
        InputFaults faults;
        const WireFormat color = config_.precision.isHalfLevel && !isFar ? WireFormat::Float32 : wireColor_.load();
        Buffer message = encodeFragment(*pool_, tile, sent_, address_, codec, coder_, color, faults);
        faults_.add(faults);
        return message;
    }

    // Whether the owner of a tile may read its pixels where they lie, if it sees them.
    bool mayReadInPlace(const InputPixels& tile) const
    {
        return tile.staysUntilEnd && readsInPlace() && (sent_ & ~(colorChannel | depthChannel)) == 0
               && tile.planes.at[Color] && !tile.valid.empty();
    }

    // Returns the input for such a tile if this rank owns it.
    Fragment inputOf(const InputPixels& tile)
    {
        Fragment::Parts parts;
        parts.encoding = FragmentEncoding::InPlace;
        parts.channels = static_cast<ChannelMask>(sent_ | colorChannel);
        parts.colorFormat = tile.hasBytes ? WireFormat::Bytes : WireFormat::Float32;
        parts.inPlace = pixelsInPlace(tile, sent_, traits().activeByDepth);
        parts.faults = &faults_;
        TileHeader header = tile;
        header.sample = 0; // as in an input that comes in a message
        return Fragment(header, Buffer(), parts);
    }

    // Remembers the checksum of a tile whose pixels must stay as they are. Several threads may call it.
    void notePromise(const InputPixels& tile)
    {
        const std::uint32_t sum = checksumOf(tile);
        const std::lock_guard<std::mutex> lock(reportsMutex_);
        promises_.push_back({tile, sum});
    }

    // Returns the input that a message has. Throws Error (MalformedMessage).
    Fragment inputOf(Buffer&& message, const SharedBytes& sharedBytes)
    {
        const FloatEnvironment floatEnvironment;
        return decodeFragment(
            *pool_, std::move(message), table_.layout(), [this](int tile) { return table_.samples(tile).count; },
            config_.messages.codec.get(), coder_, sharedBytes, &faults_);
    }

    // Takes an input of rank `from`. See TileTable::arrive().
    void arrive(Fragment&& fragment, int from, TileTable::Arrival& arrival)
    {
        if (!table_.isMine(fragment.header().tile))
            failMalformed("an input for a tile of another owner");
        if (const auto mine = static_cast<ChannelMask>(sent_ | colorChannel); fragment.channels() != mine)
            failMalformed("an input with other channels than this rank's", mine, fragment.channels());
        if (fragment.colorFormat() != WireFormat::Float32 && fragment.colorFormat() != WireFormat::Bytes
            && fragment.colorFormat() != config_.precision.color && budget_ == 0)
            failMalformed("a colour in another format than this rank's",
                          static_cast<std::int64_t>(config_.precision.color),
                          static_cast<std::int64_t>(fragment.colorFormat()));
        if (fragment.encoding() == FragmentEncoding::InPlace && !readsInPlace())
            failMalformed("an input in place, which this rank does not read");
        if (isLossy())
            losses_.add(fragment, coder_);
        const FloatEnvironment floatEnvironment; // the operation may compute
        table_.arrive(std::move(fragment), from, arrival);
    }

    // Runs both operations on a complete tile and hands it on.
    void finish(int tile)
    {
        if (table_.isSpoilt(tile))
            return; // the reason has been reported
        // Nothing is sent: the display rank knows how the background looks.
        if (traits().emptyIsBackground && traits().pixelOpIsPointwise && !table_.hasPixels(tile)) {
            table_.setFinished(tile);
            return;
        }
        const FloatEnvironment floatEnvironment;
        if (traits().hasPixelOp ? finishThroughPixelOp(tile) : finishIntoPlace(tile))
            table_.setFinished(tile);
        const TileReport report = table_.report(tile);
        const double bound = isLossy() ? losses_.boundOf(tile, std::max(1, table_.samples(tile).count)) : 0;
        if (report.error < 0 && report.orderUndefinedPixels == 0 && bound == 0)
            return;
        const std::lock_guard<std::mutex> lock(reportsMutex_);
        if (report.error >= 0)
            errors_.push_back({static_cast<std::uint64_t>(tile), report.error});
        orderUndefinedPixels_ += report.orderUndefinedPixels;
        wireErrorBound_ = std::max(wireErrorBound_, bound);
    }

    // Picks the colour format of what is encoded from now on. `maxLayers`: the most inputs that any pixel has in a
    // pass; 0: not known.
    void setLayers(int maxLayers)
    {
        const double largest = largestBackground();
        WireFormat color = config_.precision.color;
        if (budget_ > 0) {
            const auto maxColor = static_cast<double>(config_.precision.maxColor);
            const double left =
                budget_ - static_cast<double>(config_.minTransmittance) * std::max({1.0, maxColor, largest});
            color = cheapestWithin(left, maxLayers, maxColor, largest);
        }
        wireColor_ = color;
    }
    WireFormat wireColor() const noexcept { return wireColor_; }

    // Runs the pixel operation on the background. Throws its exceptions.
    void finishBackground()
    {
        if (!traits().pixelOpIsPointwise)
            return;
        const FloatEnvironment floatEnvironment;
        const float depth = std::numeric_limits<float>::infinity();
        PixelTile pixel;
        pixel.frame = table_.frameInfo().frame;
        pixel.region = {0, 0, 1, 1};
        pixel.color = background_.data();
        pixel.depth = config_.image.depth ? &depth : nullptr;
        backgroundIsFine_ = false; // if it throws
        operations_.process(pixel);
        backgroundIsFine_ = true;
    }

    // On the display rank, when all tiles are there: fills in those that nobody touched.
    void fillBackground()
    {
        const FloatEnvironment floatEnvironment;
        if (image_)
            image_->fillBackground(background_, [this](int tile) { return table_.samples(tile).count == 0; });
    }

    // Called when the frame has ended without these tiles; see GatheredImage.
    void setIncomplete(std::vector<std::int32_t>& tiles)
    {
        if (!image_)
            return;
        image_->setIncomplete(tiles, [this](int tile, bool isOwnerLost) {
            const bool hasSamples = table_.samples(tile).count > 0; // without, it keeps its pixels
            return isOwnerLost ? hasSamples || !traits().pixelOpIsPointwise : hasSamples && !backgroundIsFine_;
        });
    }

    // The frame has failed: no pixel of the image is certain. A rank with other owners than the rest may have written
    // anywhere.
    void invalidateImage()
    {
        ++imageEpoch_;
        if (image_)
            image_->invalidate();
    }

    // Adds the counts of this frame's inputs and of this rank's tiles. Adds an error if pixels have changed since
    // notePromise() and there is no other error.
    void addTo(Verdict& verdict)
    {
        const TileInfo& frame = table_.frameInfo();
        verdict.sums.bytesSent = sender_ ? sender_->placedBytes() : 0;
        verdict.sums.nonFinitePixels = faults_.nonFinite;
        verdict.sums.alphaOutsidePixels = faults_.alphaOutside;
        verdict.sums.tilesEndedEarly = table_.endedEarlyCount();
        const std::lock_guard<std::mutex> lock(reportsMutex_);
        verdict.sums.orderUndefinedPixels = orderUndefinedPixels_;
        verdict.wireErrorBound = wireErrorBound_;
        verdict.tileErrors = Verdict::sortedSums(errors_);
        for (const Promise& promise : promises_)
            if (!verdict.error && checksumOf(promise.tile) != promise.checksum) {
                verdict.error = errorInfo(ErrorKind::InvalidArgument,
                                          "its pixels were to stay until the end of the frame "
                                          "(TileView::staysUntilEnd), and have changed",
                                          frame.rank);
                verdict.error->frame = frame.frame;
                verdict.error->tile = promise.tile.tile;
            }
    }

private:
    const OperationTraits& traits() const noexcept { return operations_.traits(); }

    // The tile operation writes straight to where the tile belongs. Returns false if the frame is over.
    bool finishIntoPlace(int tile)
    {
        const Region region = table_.layout().region(tile);
        BackgroundPixels& background = table_.backgroundPixels(tile);
        auto place = reserve(tile);
        const bool isInImage = place.planes.at[Color] && place.own.empty();
        background.newFrame(region.width(), region.height(), isInImage ? imageEpoch_ : 0);
        FinishedTile out(region, config_.image.format, place.planes, place.stride, config_.image.dither, &background);
        if (isInImage)
            out.storePastCache();
        table_.finish(tile, out);
        storesAreDone();
        return commit(tile, std::move(place), out.writtenPixels());
    }

    // The tile operation writes floats, the pixel operation changes them, then they are converted. Returns false if the
    // frame is over.
    bool finishThroughPixelOp(int tile)
    {
        const Region region = table_.layout().region(tile);
        const auto width = static_cast<std::size_t>(region.width()), height = static_cast<std::size_t>(region.height());
        const auto channels = static_cast<ChannelMask>(colorChannel | imageChannels(config_));
        const PlaneFormat format(channels, sizeof(float));
        Buffer floats = pool_->acquire(width * height * format.pixelBytes());
        const Planes planes = format.planesAt(floats.data(), width * height);
        FinishedTile floatTile(region, OutputFormat::RGBA32F, planes, width);
        table_.finish(tile, floatTile);
        PixelTile pixels;
        pixels.frame = table_.frameInfo().frame;
        pixels.tile = tile;
        pixels.region = region;
        pixels.color = floatsOf(planes.at[Color]);
        pixels.depth = floatsOf(planes.at[Depth]);
        const auto auxOf = [](const Planes& p) {
            return AuxRow{floatsOf(p.at[Normal]), floatsOf(p.at[Albedo]), floatsOf(p.at[Position]),
                          idsOf(p.at[PrimitiveId]), idsOf(p.at[InstanceId])};
        };
        pixels.aux = auxOf(planes);
        operations_.process(pixels);
        auto place = reserve(tile);
        FinishedTile out(region, config_.image.format, place.planes, place.stride, config_.image.dither);
        for (int y = 0; y < region.height(); ++y) {
            const Planes row = planes.from(width * static_cast<std::size_t>(y));
            out.setRow(y, floatsOf(row.at[Color]), floatsOf(row.at[Depth]), auxOf(row));
        }
        return commit(tile, std::move(place), out.writtenPixels());
    }

    // Returns where a finished tile goes: into the image, or into a block that commit() sends. Null without an image.
    TileSender::Place reserve(int tile)
    {
        if (image_)
            return {image_->placeOf(tile), {}, {}};
        return sender_ ? sender_->reserve(tile) : TileSender::Place();
    }

    // See TileSender.
    bool commit(int tile, TileSender::Place&& place, std::int64_t writtenPixels)
    {
        if (image_)
            image_->commit(tile);
        return !sender_ || sender_->commit(tile, std::move(place), writtenPixels);
    }

    bool readsInPlace() const { return traits().readsInPlace && !traits().keepsState && !isLossy(); }

    bool isLossy() const noexcept
    {
        return config_.precision.color != WireFormat::Float32 || budget_ > 0 || config_.minTransmittance > 0;
    }

    // The error that colours may get on the way; 0: none, or it is not set by a budget.
    static double budgetOf(const FrameBufferConfig& config, bool hasFarRanks)
    {
        if (!config.precision.isHalfLevel)
            return config.precision.budget;
        const double level = 1.0 / 255, steepest = 12.92; // steepest: of the sRGB curve
        const bool isBytes = config.image.format == OutputFormat::RGBA8 || config.image.format == OutputFormat::SRGBA8;
        if (!hasFarRanks || !isBytes)
            return 0;
        return 0.5 * level / (config.image.format == OutputFormat::SRGBA8 ? steepest : 1);
    }
    double largestBackground() const
    {
        double largest = 0;
        for (const float channel : table_.frameInfo().background)
            largest = std::max(largest, std::abs(static_cast<double>(channel)));
        return largest;
    }

    std::shared_ptr<MemoryPool> pool_;
    const FrameBufferConfig& config_;
    std::uint32_t address_; // of the framebuffer
    Operations& operations_;
    double budget_ = 0; // of the error of colours, see budgetOf()
    TileTable table_;
    std::optional<GatheredImage> image_;
    std::optional<TileSender> sender_;
    std::int64_t imageEpoch_ = 1;       // see BackgroundPixels
    ChannelMask sent_ = 0;              // of the inputs of this frame
    std::array<float, 4> background_{}; // of the frame; after finishBackground() as the pixel operation makes it
    bool backgroundIsFine_ = true;      // see finishBackground()
    WireCoder coder_;
    std::atomic<WireFormat> wireColor_{WireFormat::Float32};
    WireLosses losses_;
    FaultCounts faults_;
    struct Promise {
        InputPixels tile;
        std::uint32_t checksum;
    };
    std::mutex reportsMutex_;
    // Under reportsMutex_:
    std::vector<Promise> promises_; // see notePromise()
    std::vector<Figure> errors_;    // by tile, as operations report them
    std::int64_t orderUndefinedPixels_ = 0;
    double wireErrorBound_ = 0;
};

} // namespace detail
DFB_NAMESPACE_END
