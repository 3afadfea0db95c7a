// FinalGather: brings finished tiles to the display rank. The owner writes a tile straight into the image if it sees
// the image's memory, otherwise into a message of several tiles. Background tiles do not travel.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/gather/image_gate.hpp>
#include <dfb/image.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/tile_op.hpp>
#include <dfb/wire/finished_record.hpp>
#include <dfb/wire/fragment_message.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <new>
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// One object per rank and framebuffer. Any thread may call the members, except newFrame().
class FinalGather {
public:
    // Sends a message to the display rank. `raw`: its size before the codec; 0: there was no codec.
    using Send = std::function<void(Buffer&&, std::size_t raw)>;
    using OwnerOf = std::function<int(int tile)>;
    // Takes an exception of the codec or of the program's onTile. `tile`: that of onTile; -1 for the codec.
    using Fail = std::function<void(const std::exception_ptr&, int tile)>;

    // Where a finished tile goes.
    struct Place : FinishedPlanes {
        Buffer own;               // the memory of the planes, if they are to be sent
        ImageGate::Writer writer; // into the image of another rank
        // If the tile goes into the image, see BackgroundPixels; otherwise 0.
        std::int64_t imageEpoch = 0;
    };

    // `config` must live as long as this. `channels`: those of the image beside colour. `address`: that of the
    // framebuffer. `ownerOf(tile)`: the rank that finishes the tile. `send`: sends batches and the count of tiles to
    // the display rank. `fail`: fails the frame; no tile is lost by that.
    FinalGather(std::shared_ptr<MemoryPool> pool, const TileLayout& layout, const FrameBufferConfig& config,
                ChannelMask channels, std::uint32_t address, int rank, int rankCount, OwnerOf ownerOf, Send send,
                Fail fail)
        : pool_(std::move(pool)), layout_(layout), config_(config), channels_(channels), address_(address), rank_(rank),
          ownerOf_(std::move(ownerOf)), send_(std::move(send)), fail_(std::move(fail)),
          record_(config.image.format, channels), tilesOf_(static_cast<std::size_t>(rankCount))
    {
        findSenders();
        if (displays()) {
            image_ = Image(*pool_, layout_.width(), layout_.height(), config_.image.format, channels_);
            state_ = std::vector<std::atomic<TileState>>(static_cast<std::size_t>(layout_.tileCount()));
            invalidate();
        }
        if (!isDisplay() && enabled())
            for (int i = 0; i < 3; ++i) // as many as one worker and a thread that waits have at once
                spareBatches_.push_back(std::make_shared<Batch>());
    }

    // The image is valid only while imageFrame() >= 0; then imageFrame() is the frame that it shows.
    const Image& image() const noexcept { return image_; }
    std::int64_t imageFrame() const noexcept { return imageFrame_; }
    bool enabled() const noexcept { return config_.image.format != OutputFormat::None; }
    bool displays() const noexcept { return isDisplay() && enabled(); }

    // Call it before newFrame() if tiles have other owners than in the last frame.
    void findSenders()
    {
        for (TilesOf& its : tilesOf_)
            its.owned = 0;
        for (int tile = 0; tile < layout_.tileCount(); ++tile)
            ++tilesOf_[static_cast<std::size_t>(ownerOf_(tile))].owned;
        senderCount_ = 0;
        for (std::size_t r = 0; r < tilesOf_.size(); ++r)
            senderCount_ += isSender(r);
    }

    // `compresses`: whether the codec, if there is one, is used. `background`: the image's pixels where no tile is.
    void newFrame(std::int64_t frame, bool compresses, const std::array<float, 4>& background)
    {
        frame_ = frame;
        imageFrame_ = -1;
        imageEpoch_ += std::memcmp(&background, &lastBackground_, sizeof background) != 0;
        lastBackground_ = background;
        compresses_ = compresses && config_.messages.codec;
        batch_.reset();
        flushed_ = false;
        sent_ = {};
        placed_.clear();
        placedPixels_ = 0;
        ranksComplete_ = 0;
        hasLost_ = false;
        incomplete_.clear();
        for (TilesOf& its : tilesOf_) {
            its.received = {};
            its.announced.reset();
        }
        for (auto& s : state_)
            if (s == TileState::Received)
                s = TileState::Old;
        if (imageGate_)
            imageGate_->open(visit(frame));
    }

    // ---- an image that other ranks see

    // On the display rank: makes the gate and returns where it and the image lie. `placeOf(block)`: where a block lies
    // for other ranks, or -1. Empty if they do not see all of the image.
    template <class PlaceOf>
    std::optional<ImagePlaces> shareImage(const PlaceOf& placeOf)
    {
        if (image_.empty())
            return std::nullopt;
        gateMemory_ = pool_->acquireGate();
        const Planes planes = image_.planes();
        ImagePlaces places;
        places.gate = placeOf(gateMemory_.data());
        bool all = places.gate >= 0;
        for (std::size_t c = 0; c < channelCount; ++c) {
            places.planes[c] = planes.at[c] ? placeOf(planes.at[c]) : -1;
            all = all && (!planes.at[c] || places.planes[c] >= 0);
        }
        if (!all) {
            gateMemory_ = Buffer();
            return std::nullopt;
        }
        imageGate_ = reinterpret_cast<ImageGate*>(gateMemory_.data());
        return places;
    }

    // On another rank: takes the places that shareImage() has returned on rank `source`. `blockAt(place, byteCount)`:
    // what lies there, or null. Throws Error (MalformedMessage).
    template <class BlockAt>
    void receivePlaces(int source, const ImagePlaces& places, const BlockAt& blockAt)
    {
        if (source != config_.image.displayRank)
            failMalformed("a rank that displays nothing has an image", config_.image.displayRank, source);
        if (isDisplay() || !enabled())
            return;
        SharedImage image;
        image.gate = reinterpret_cast<ImageGate*>(blockAt(places.gate, sizeof(ImageGate)));
        bool all = image.gate != nullptr;
        const std::size_t pixels =
            static_cast<std::size_t>(layout_.width()) * static_cast<std::size_t>(layout_.height());
        for (std::size_t c = 0; c < channelCount; ++c)
            if (const std::size_t bytes = record_.pixelBytes(c); bytes > 0) {
                image.planes.at[c] = blockAt(places.planes[c], pixels * bytes);
                all = all && image.planes.at[c];
            }
        if (!all)
            failMalformed("the image is not where the display rank says");
        const std::lock_guard<std::mutex> lock(mutex_);
        remote_ = image;
    }

    // Bytes that this rank has written into another rank's image in this frame.
    std::int64_t placedBytes() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return placedPixels_ * static_cast<std::int64_t>(record_.pixelBytes());
    }

    // Called when the frame is over: makes sure that nobody writes into the image any more.
    void closeImage()
    {
        if (!imageGate_ || imageGate_->close(std::chrono::seconds(1)))
            return;
        // A writer is still inside, or has died there. Leaves the memory to it, and goes on with a copy of the image.
        Image copy(*pool_, layout_.width(), layout_.height(), config_.image.format, channels_);
        const Planes from = image_.planes(), to = copy.planes();
        for (std::size_t c = 0; c < channelCount; ++c)
            if (to.at[c])
                std::memcpy(to.at[c], from.at[c], copy.pixelCount() * record_.pixelBytes(c));
        for (Buffer& plane : image_.release())
            pool_->lend(plane);
        pool_->lend(gateMemory_);
        imageGate_ = nullptr;
        image_ = std::move(copy);
        ++imageEpoch_;
    }

    // The most bytes that a message to the display rank can have.
    static std::size_t largestMessage(std::size_t tilePixels, OutputFormat format, ChannelMask channels)
    {
        return std::max(batchBytes, prefix + FinishedRecord(format, channels).mostBytes(tilePixels));
    }

    // Returns room for a finished tile. Write the tile there, then call commit().
    Place reserve(int tile)
    {
        Place place;
        if (!enabled())
            return place;
        const Region region = layout_.region(tile);
        if (isDisplay())
            return inImage(image_.planes(), region);
        if (SharedImage image = remote(); image.gate)
            if (auto writer = image.gate->enter(visit(frame_))) {
                place = inImage(image.planes, region);
                place.writer = std::move(writer);
                return place;
            }
        place.stride = static_cast<std::size_t>(region.width());
        const std::size_t pixels = place.stride * static_cast<std::size_t>(region.height());
        place.own = pool_->acquire(pixels * record_.pixelBytes());
        place.planes = record_.planesAt(place.own.data(), pixels);
        return place;
    }

    // `writtenPixels`: how many pixels of the tile were written; the others are in the image already. Returns false if
    // the tile comes too late, after flush().
    bool commit(int tile, Place&& place, std::int64_t writtenPixels)
    {
        if (!enabled())
            return true;
        if (isDisplay()) {
            state_[static_cast<std::size_t>(tile)] = TileState::Received;
            tellTile(tile);
            return true;
        }
        if (place.writer) {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (flushed_)
                return false;
            placed_.push_back(tile);
            placedPixels_ += writtenPixels;
            ++sent_.tiles;
            return true; // the writer leaves when `place` is destroyed
        }
        static thread_local FinishedRecord::Plan plan;
        record_.plan(tile, layout_.region(tile), place, compresses_, plan);
        std::shared_ptr<Batch> batch, full;
        std::byte* record = nullptr;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (flushed_)
                return false;
            const bool isFull = batch_ && batch_->used + plan.bytes > batch_->message.size();
            Buffer memory; // first, as it may throw
            if (!batch_ || isFull)
                memory = pool_->acquire(std::max(batchBytes, prefix + plan.bytes));
            if (isFull)
                full = closeBatch();
            if (!batch_) {
                if (spareBatches_.empty())
                    spareBatches_.push_back(std::make_shared<Batch>());
                batch_ = std::move(spareBatches_.back());
                spareBatches_.pop_back();
                batch_->message = std::move(memory);
                batch_->used = prefix;
                ++sent_.batches;
            }
            batch = batch_;
            record = batch->message.data() + batch->used;
            batch->used += plan.bytes;
            ++batch->writers;
            ++sent_.tiles;
        }
        record_.write(plan, record); // before any call of the codec, which may run other work on this thread
        if (full)
            sendBatch(std::move(full));
        bool isLast = false;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            isLast = --batch->writers == 0 && batch != batch_;
        }
        if (isLast)
            sendBatch(std::move(batch));
        return true;
    }

    // Call it when all tiles of this rank are committed, or when no other tile counts any more. Sends the last batch,
    // and the number of tiles. Only the first call does anything.
    void flush()
    {
        if (!enabled() || !isSender(static_cast<std::size_t>(rank_)))
            return;
        std::shared_ptr<Batch> last;
        Buffer done;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (flushed_)
                return;
            const auto header = MessageHeader::of(MessageKind::TilesDone, address_, frame_);
            done = pool_->acquire(sizeof header + sizeof sent_ + sizeof(std::int32_t) * placed_.size()); // may throw
            std::byte* const tiles = storeAll(done.data(), header, sent_);
            std::copy(placed_.begin(), placed_.end(), reinterpret_cast<std::int32_t*>(tiles));
            flushed_ = true;
            if (batch_)
                last = closeBatch();
        }
        if (last)
            sendBatch(std::move(last));
        send_(std::move(done), 0);
    }

    static bool isFinishedTile(MessageKind kind)
    {
        return kind == MessageKind::FinishedTiles || kind == MessageKind::TilesDone;
    }

    // On the display rank: takes one of these messages. Throws Error (MalformedMessage), OutOfMemory, and what the
    // codec throws.
    void receive(int source, const MessageHeader& header, Buffer&& message)
    {
        if (!displays())
            failMalformed("a finished tile was sent to a rank that displays nothing");
        try {
            if (header.kind == MessageKind::FinishedTiles)
                receiveTiles(source, std::move(message));
            else
                receiveDone(source, message);
        } catch (...) {
            hasLost_ = true;
            throw;
        }
    }
    // Whether some of these messages could not be taken. They do not come again.
    bool hasLost() const noexcept { return hasLost_; }

    // Whether all tiles of the other ranks are in the image.
    bool complete() const { return !displays() || ranksComplete_ == senderCount_; }

    // Names the ranks whose tiles have not come; `expected` and `got` count ranks.
    ErrorInfo missing() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        ErrorInfo info;
        for (std::size_t r = 0; r < tilesOf_.size(); ++r) {
            if (!isMissing(r))
                continue;
            const TilesOf& its = tilesOf_[r];
            info.message += info.message.empty() ? "finished tiles have not come from rank " : ", rank ";
            info.message += its.announced ? printed("%zu (%d of %d)", r, its.received.tiles, its.announced->tiles)
                                          : printed("%zu (%d of all)", r, its.received.tiles);
            if (info.from < 0)
                info.from = static_cast<int>(r);
        }
        info.expected = senderCount_;
        info.got = ranksComplete_;
        return info;
    }

    // Fills the tiles that have not come with the background colour `rgba`, as it is to be stored. Leaves alone tiles
    // that already show this background, and tiles of an earlier frame for which `kept(tile)` is true. After that the
    // image is this frame's.
    template <class Kept>
    void fillBackground(const std::array<float, 4>& rgba, const Kept& kept)
    {
        if (image_.empty())
            return;
        const bool same = std::memcmp(&rgba, &background_, sizeof rgba) == 0;
        row_.resize(4 * static_cast<std::size_t>(layout_.tileSize())); // may throw: nothing has changed yet
        for (std::size_t i = 0; i < row_.size(); ++i)
            row_[i] = rgba[i % 4];
        background_ = rgba;
        for (int tile = 0; tile < layout_.tileCount(); ++tile) {
            auto& s = state_[static_cast<std::size_t>(tile)];
            if (s == TileState::Received || (s == TileState::Background && same))
                continue;
            if (s != TileState::Undefined && kept(tile)) {
                s = TileState::Old; // if it was background, then of another colour
                continue;
            }
            const Region region = layout_.region(tile);
            const Place place = inImage(image_.planes(), region);
            FinishedTile out(region, config_.image.format, place.planes, place.stride, config_.image.dither);
            for (int y = 0; y < region.height(); ++y)
                out.setRow(y, row_.data(), nullptr);
            s = TileState::Background;
        }
        imageFrame_ = frame_;
    }

    // Called when the frame is over without these tiles. On the display rank, adds those that have not been received
    // and for which `lost(tile, isOwnerLost)` is true; isOwnerLost: not all finished tiles of the tile's owner have
    // come. Then isComplete() is false for all of them.
    template <class Lost>
    void setIncomplete(std::vector<std::int32_t>& tiles, const Lost& lost)
    {
        if (!displays())
            return;
        const std::lock_guard<std::mutex> lock(mutex_);
        for (int tile = 0; tile < layout_.tileCount(); ++tile)
            if (state_[static_cast<std::size_t>(tile)] != TileState::Received
                && lost(tile, isMissing(static_cast<std::size_t>(ownerOf_(tile)))))
                tiles.push_back(tile);
        std::sort(tiles.begin(), tiles.end()); // an owner may have said so already
        tiles.erase(std::unique(tiles.begin(), tiles.end()), tiles.end());
        for (const std::int32_t tile : tiles)
            state_[static_cast<std::size_t>(tile)] = TileState::Undefined;
        incomplete_ = tiles;
    }
    bool isComplete(int tile) const
    {
        return imageFrame_ >= 0 && !std::binary_search(incomplete_.begin(), incomplete_.end(), tile);
    }

    // The frame has failed: no pixel of the image is certain. A rank with other owners than the rest may have written
    // anywhere.
    void invalidate()
    {
        ++imageEpoch_;
        for (auto& s : state_)
            s = TileState::Undefined;
    }

private:
    static_assert(sizeof(ImageGate) <= MemoryPool::smallestShared);
    // See ImageGate.
    std::int64_t visit(std::int64_t frame) const noexcept
    {
        return static_cast<std::int64_t>(std::uint64_t{address_} << 32 | static_cast<std::uint32_t>(frame));
    }

    // Counts of a rank's tiles and messages to the display rank. Tiles that it has put into the image itself count too.
    struct SentCount {
        std::int32_t tiles = 0, batches = 0;
    };

    struct TilesOf {
        SentCount received;
        std::optional<SentCount> announced;
        std::int32_t owned = 0; // the most that there can be
        bool isComplete() const
        {
            return announced && received.tiles == announced->tiles && received.batches == announced->batches;
        }
    };

    // Whether a rank has finished tiles for the display rank.
    bool isSender(std::size_t r) const
    {
        return static_cast<int>(r) != config_.image.displayRank && tilesOf_[r].owned > 0;
    }
    // Under mutex_.
    bool isMissing(std::size_t r) const { return isSender(r) && !tilesOf_[r].isComplete(); }

    // Adds the tiles and messages that have come now; under mutex_. With a rank's last message its tiles must be as
    // many as it has announced, so that a wrong count never ends a frame too early. Throws Error (MalformedMessage).
    void addReceived(TilesOf& its, const SentCount& here)
    {
        its.received.tiles += here.tiles;
        its.received.batches += here.batches;
        if (!its.announced)
            return;
        if (its.received.tiles > its.announced->tiles || its.received.batches > its.announced->batches)
            failMalformed("more finished tiles than were counted", its.announced->tiles, its.received.tiles);
        if (its.received.batches < its.announced->batches)
            return;
        if (its.received.tiles < its.announced->tiles)
            failMalformed("fewer finished tiles than were counted", its.announced->tiles, its.received.tiles);
        ++ranksComplete_;
    }

    enum class TileState : std::uint8_t { Undefined, Background, Old, Received };
    // A message that is being filled.
    struct Batch {
        Buffer message;
        std::size_t used = 0;
        int writers = 0;
    };
    struct BatchHeader {
        std::uint64_t rawBytes = 0, codec = 0; // no codec: 0
    };
    static constexpr std::size_t prefix = sizeof(MessageHeader) + sizeof(BatchHeader);
    static constexpr std::size_t batchBytes = std::size_t{256} << 10;

    bool isDisplay() const noexcept { return rank_ == config_.image.displayRank; }
    // `planes`: those of the whole image.
    Place inImage(const Planes& planes, const Region& region) const
    {
        Place place;
        place.imageEpoch = imageEpoch_;
        place.stride = static_cast<std::size_t>(layout_.width());
        const std::size_t first =
            static_cast<std::size_t>(region.y0) * place.stride + static_cast<std::size_t>(region.x0);
        for (std::size_t c = 0; c < channelCount; ++c)
            if (planes.at[c])
                place.planes.at[c] = planes.at[c] + first * record_.pixelBytes(c);
        return place;
    }

    SharedImage remote()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return remote_;
    }

    void receiveTiles(int source, Buffer&& message)
    {
        if (message.size() < prefix)
            failMalformed("a batch of tiles is too short");
        const auto h = loadAs<BatchHeader>(message.data() + sizeof(MessageHeader));
        const std::byte* in = message.data() + prefix;
        std::size_t left = message.size() - prefix;
        if (h.codec == 0 && h.rawBytes != left)
            failMalformed("a batch of tiles has the wrong size", static_cast<std::int64_t>(h.rawBytes),
                          static_cast<std::int64_t>(left));
        Buffer raw;
        if (h.codec != 0) {
            if (!config_.messages.codec || config_.messages.codec->id() != h.codec)
                failMalformed("compressed by a codec that this rank does not have");
            const std::size_t pixels =
                static_cast<std::size_t>(layout_.tileWidth()) * static_cast<std::size_t>(layout_.tileHeight());
            if (h.rawBytes > largestMessage(pixels, config_.image.format, channels_))
                failMalformed("a batch of tiles is too large");
            raw = pool_->acquire(h.rawBytes);
            if (!config_.messages.codec->decompress(in, left, raw.data(), h.rawBytes))
                failMalformed("a batch of tiles does not decompress to its size");
            in = raw.data();
            left = h.rawBytes;
        }
        SentCount here{0, 1};
        while (left > 0) {
            int tile = -1;
            const std::size_t bytes = record_.read(in, left, layout_, [&](int its, const Region& region) {
                tile = its;
                take(tile, source);
                return inImage(image_.planes(), region);
            });
            tellTile(tile);
            in += bytes;
            left -= bytes;
            ++here.tiles;
        }
        const std::lock_guard<std::mutex> lock(mutex_);
        addReceived(tilesOf_[static_cast<std::size_t>(source)], here);
    }

    void receiveDone(int source, const Buffer& message)
    {
        const std::byte* in = message.data() + sizeof(MessageHeader);
        const std::size_t bytes = message.size() - std::min(message.size(), sizeof(MessageHeader));
        if (bytes < sizeof(SentCount) || (bytes - sizeof(SentCount)) % sizeof(std::int32_t) != 0)
            failMalformed("a count of tiles has the wrong size");
        const auto count = loadAs<SentCount>(in);
        SentCount placed;
        for (std::size_t at = sizeof count; at < bytes; at += sizeof(std::int32_t), ++placed.tiles) {
            const auto tile = loadAs<std::int32_t>(in + at);
            if (tile < 0 || tile >= layout_.tileCount() || !imageGate_)
                failMalformed("a finished tile outside the image", layout_.tileCount() - 1, tile);
            take(tile, source);
            tellTile(tile);
        }
        const std::lock_guard<std::mutex> lock(mutex_);
        TilesOf& its = tilesOf_[static_cast<std::size_t>(source)];
        if (!isSender(static_cast<std::size_t>(source)) || its.announced || count.tiles < 0 || count.tiles > its.owned
            || count.batches < 0 || count.batches > count.tiles)
            failMalformed("a count of tiles that cannot be", its.owned, count.tiles);
        its.announced = count;
        addReceived(its, placed);
    }

    // Takes note that a tile has come.
    void take(int tile, int source)
    {
        if (const int owner = ownerOf_(tile); owner != source)
            failMalformed("a finished tile of another owner", owner, source);
        if (state_[static_cast<std::size_t>(tile)].exchange(TileState::Received) == TileState::Received) {
            ErrorInfo info = errorInfo(ErrorKind::DuplicateInput, "a finished tile came twice");
            info.tile = tile;
            throw Error(std::move(info));
        }
    }

    void tellTile(int tile) const
    {
        if (!config_.onTile)
            return;
        try {
            config_.onTile(tile, layout_.region(tile), image_);
        } catch (...) {
            fail_(std::current_exception(), tile); // other tiles of the same message are still to be counted
        }
    }

    // Under mutex_. Returns the batch to be sent, or null if somebody still writes to it: the last writer sends it.
    std::shared_ptr<Batch> closeBatch()
    {
        std::shared_ptr<Batch> closed = std::move(batch_);
        return closed->writers == 0 ? std::move(closed) : nullptr;
    }

    // Nobody else may use the batch any more.
    void sendBatch(std::shared_ptr<Batch> batch)
    {
        BatchHeader h;
        h.rawBytes = batch->used - prefix;
        Buffer message = std::move(batch->message);
        message.shrink(batch->used);
        *batch = Batch();
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            spareBatches_.push_back(std::move(batch));
        }
        if (compresses_) {
            try {
                Buffer packed = pool_->acquire(prefix + config_.messages.codec->bound(h.rawBytes));
                const std::size_t bytes =
                    config_.messages.codec->compress(message.data() + prefix, h.rawBytes, packed.data() + prefix);
                if (bytes < h.rawBytes) {
                    packed.shrink(prefix + bytes);
                    message = std::move(packed);
                    h.codec = config_.messages.codec->id();
                }
            } catch (const OutOfMemory&) { // sent uncompressed: the batch has been counted
            } catch (...) {                // so is this one
                fail_(std::current_exception(), -1);
            }
        }
        storeAll(message.data(), MessageHeader::of(MessageKind::FinishedTiles, address_, frame_), h);
        send_(std::move(message), compresses_ ? prefix + h.rawBytes : 0);
    }

    std::shared_ptr<MemoryPool> pool_;
    TileLayout layout_;
    const FrameBufferConfig& config_;
    ChannelMask channels_;
    std::uint32_t address_;
    int rank_;
    OwnerOf ownerOf_;
    Send send_;
    Fail fail_;
    const FinishedRecord record_;
    std::int64_t frame_ = 0, imageFrame_ = -1, imageEpoch_ = 1;
    bool compresses_ = false;

    mutable std::mutex mutex_;
    std::shared_ptr<Batch> batch_; // under mutex_, as is all down to placedPixels_
    std::vector<std::shared_ptr<Batch>> spareBatches_;
    bool flushed_ = false;
    SentCount sent_;
    SharedImage remote_;               // of the display rank, if this one sees it
    std::vector<std::int32_t> placed_; // tiles that this rank has put there
    std::int64_t placedPixels_ = 0;

    Image image_;
    Buffer gateMemory_;
    ImageGate* imageGate_ = nullptr; // in gateMemory_, if other ranks see the image
    std::array<float, 4> background_{}, lastBackground_{};
    std::vector<float> row_;                    // of background, as wide as a tile
    std::vector<std::atomic<TileState>> state_; // on the display rank
    std::vector<std::int32_t> incomplete_;      // of the last frame
    std::vector<TilesOf> tilesOf_;              // per rank; on the display rank under mutex_
    int senderCount_ = 0;
    std::atomic<int> ranksComplete_{0}; // of those that send
    std::atomic<bool> hasLost_{false};
};

} // namespace detail
DFB_NAMESPACE_END
