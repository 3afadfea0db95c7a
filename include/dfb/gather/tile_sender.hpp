// TileSender: sends the finished tiles of an owner to the display rank. It writes a tile straight into the image if it
// sees the image's memory, otherwise into a message of several tiles. Background tiles do not travel.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/gather/image_gate.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/wire/finished_record.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// One object per rank and framebuffer, except on the display rank. Any thread may call the members, except newFrame().
class TileSender {
public:
    // Sends a message to the display rank. `raw`: its size before the codec; 0: there was no codec.
    using Send = std::function<void(Buffer&&, std::size_t raw)>;
    // Takes an exception of the codec.
    using Fail = std::function<void(const std::exception_ptr&)>;

    // Where a finished tile goes.
    struct Place : FinishedPlanes {
        Buffer own;               // the memory of the planes, if they are to be sent
        ImageGate::Writer writer; // into the image of another rank
    };

    // `config` must live as long as this. `channels`: those of the image beside colour. `address`: that of the
    // framebuffer. `send`: sends batches and the count of tiles. `fail`: fails the frame; no tile is lost by that.
    TileSender(std::shared_ptr<MemoryPool> pool, const TileLayout& layout, const FrameBufferConfig& config,
               ChannelMask channels, std::uint32_t address, Send send, Fail fail)
        : pool_(std::move(pool)), layout_(layout), config_(config), address_(address), send_(std::move(send)),
          fail_(std::move(fail)), record_(config.image.format, channels)
    {
        for (int i = 0; i < 3; ++i) // as many as one worker and a thread that waits have at once
            spareBatches_.push_back(std::make_shared<Batch>());
    }

    // `compresses`: whether messages are compressed; then there must be a codec. `hasTiles`: whether this rank owns
    // any.
    void newFrame(std::int64_t frame, bool compresses, bool hasTiles)
    {
        frame_ = frame;
        compresses_ = compresses;
        batch_.reset();
        flushed_ = !hasTiles; // then there is nothing to say
        sent_ = {};
        placed_.clear();
        placedPixels_ = 0;
    }

    // Takes the places that GatheredImage::share() has returned on rank `source`. `blockAt(place, byteCount)`: what
    // lies there, or null. Throws Error (MalformedMessage).
    template <class BlockAt>
    void receivePlaces(int source, const ImagePlaces& places, const BlockAt& blockAt)
    {
        if (source != config_.image.displayRank)
            failMalformed("a rank that displays nothing has an image", config_.image.displayRank, source);
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
        image_ = image;
    }

    // Bytes that this rank has written into the display rank's image in this frame.
    std::int64_t placedBytes() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return placedPixels_ * static_cast<std::int64_t>(record_.pixelBytes());
    }

    // Returns room for a finished tile. Write the tile there, then call commit().
    Place reserve(int tile)
    {
        const Region region = layout_.region(tile);
        if (const SharedImage image = sharedImage(); image.gate)
            if (auto writer = image.gate->enter(ImageGate::visitOf(address_, frame_)))
                return {record_.inImage(image.planes, layout_.width(), region), Buffer(), std::move(writer)};
        Place place;
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
                memory = pool_->acquire(std::max(usualBatchBytes, batchPrefix + plan.bytes));
            if (isFull)
                full = closeBatch();
            if (!batch_) {
                if (spareBatches_.empty())
                    spareBatches_.push_back(std::make_shared<Batch>());
                batch_ = std::move(spareBatches_.back());
                spareBatches_.pop_back();
                batch_->message = std::move(memory);
                batch_->used = batchPrefix;
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

private:
    // A message that is being filled.
    struct Batch {
        Buffer message;
        std::size_t used = 0;
        int writers = 0;
    };

    SharedImage sharedImage()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return image_;
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
        FinishedBatch h;
        h.rawBytes = batch->used - batchPrefix;
        Buffer message = std::move(batch->message);
        message.shrink(batch->used);
        *batch = Batch();
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            spareBatches_.push_back(std::move(batch));
        }
        if (compresses_) {
            try {
                Buffer packed = pool_->acquire(batchPrefix + config_.messages.codec->bound(h.rawBytes));
                const std::size_t bytes = config_.messages.codec->compress(message.data() + batchPrefix, h.rawBytes,
                                                                           packed.data() + batchPrefix);
                if (bytes < h.rawBytes) {
                    packed.shrink(batchPrefix + bytes);
                    message = std::move(packed);
                    h.codec = config_.messages.codec->id();
                }
            } catch (const OutOfMemory&) { // sent uncompressed: the batch has been counted
            } catch (...) {                // so is this one
                fail_(std::current_exception());
            }
        }
        storeAll(message.data(), MessageHeader::of(MessageKind::FinishedTiles, address_, frame_), h);
        send_(std::move(message), compresses_ ? batchPrefix + h.rawBytes : 0);
    }

    std::shared_ptr<MemoryPool> pool_;
    TileLayout layout_;
    const FrameBufferConfig& config_;
    std::uint32_t address_;
    Send send_;
    Fail fail_;
    const FinishedRecord record_;
    std::int64_t frame_ = 0;
    bool compresses_ = false;

    mutable std::mutex mutex_; // of all that follows
    std::shared_ptr<Batch> batch_;
    std::vector<std::shared_ptr<Batch>> spareBatches_;
    bool flushed_ = true; // until there is a frame
    FinishedCount sent_;
    SharedImage image_;                // of the display rank, if this one sees it
    std::vector<std::int32_t> placed_; // tiles that this rank has put there
    std::int64_t placedPixels_ = 0;
};

} // namespace detail
DFB_NAMESPACE_END
