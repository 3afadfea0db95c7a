// GatheredImage: the image on the display rank. It takes the finished tiles of all ranks, counts them, and knows which
// tiles show this frame.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/gather/image_gate.hpp>
#include <dfb/image.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/tile_op.hpp>
#include <dfb/wire/finished_record.hpp>

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
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// One object for each frame in flight, on the display rank. Any thread may call placeOf(), commit(), receive() and
// the const members; the others, one thread at a time.
class GatheredImage {
public:
    using OwnerOf = std::function<int(int tile)>;
    // Takes an exception of the program's onTile.
    using Fail = std::function<void(const std::exception_ptr&, int tile)>;

    // `config` must live as long as this. `channels`: those of the image beside colour. `address`: that of the
    // framebuffer. `ownerOf(tile)`: the rank that finishes the tile. `fail`: fails the frame; no tile is lost by that.
    GatheredImage(std::shared_ptr<MemoryPool> pool, const TileLayout& layout, const FrameBufferConfig& config,
                  ChannelMask channels, std::uint32_t address, int rankCount, OwnerOf ownerOf, Fail fail)
        : pool_(std::move(pool)), layout_(layout), config_(config), channels_(channels), address_(address),
          ownerOf_(std::move(ownerOf)), fail_(std::move(fail)), record_(config.image.format, channels),
          image_(newImage()), state_(static_cast<std::size_t>(layout_.tileCount())),
          tilesOf_(static_cast<std::size_t>(rankCount))
    {
        findSenders();
        invalidate();
    }

    // The image is valid only while frame() >= 0; then it shows that frame.
    const Image& image() const noexcept { return image_; }
    std::int64_t frame() const noexcept { return shownFrame_; }

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

    void newFrame(std::int64_t frame)
    {
        frame_ = frame;
        shownFrame_ = -1;
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
        if (gate_)
            gate_->open(ImageGate::visitOf(address_, frame));
    }

    // ---- other ranks that see the image

    // Makes the gate and returns where it and the image lie. `addressOf(block)`: where a block lies for other ranks,
    // or -1. Empty if they do not see all of the image.
    template <class AddressOf>
    std::optional<ImagePlaces> share(const AddressOf& addressOf)
    {
        gateMemory_ = pool_->acquireGate();
        const Planes planes = image_.planes();
        ImagePlaces places;
        places.gate = addressOf(gateMemory_.data());
        bool all = places.gate >= 0;
        for (std::size_t c = 0; c < channelCount; ++c) {
            places.planes[c] = planes.at[c] ? addressOf(planes.at[c]) : -1;
            all = all && (!planes.at[c] || places.planes[c] >= 0);
        }
        if (!all) {
            gateMemory_ = Buffer();
            return std::nullopt;
        }
        gate_ = reinterpret_cast<ImageGate*>(gateMemory_.data());
        return places;
    }

    // Called when the frame is over: makes sure that nobody writes into the image any more.
    void close()
    {
        if (!gate_ || gate_->close(std::chrono::seconds(1)))
            return;
        // A writer is still inside, or has died there. Leaves the memory to it, and goes on with a copy of the image.
        Image copy = newImage();
        const Planes from = image_.planes(), to = copy.planes();
        for (std::size_t c = 0; c < channelCount; ++c)
            if (to.at[c])
                std::memcpy(to.at[c], from.at[c], copy.pixelCount() * record_.pixelBytes(c));
        for (Buffer& plane : image_.release())
            pool_->lend(plane);
        pool_->lend(gateMemory_);
        gate_ = nullptr;
        image_ = std::move(copy);
    }

    // ---- finished tiles

    // Where a finished tile of this rank goes. Write it there, then call commit().
    FinishedPlanes placeOf(int tile) { return record_.inImage(image_.planes(), layout_.width(), layout_.region(tile)); }
    void commit(int tile)
    {
        state_[static_cast<std::size_t>(tile)] = TileState::Received;
        tellTile(tile);
    }

    // Whether receive() is for messages of this kind.
    static bool takes(MessageKind kind) { return kind == MessageKind::FinishedTiles || kind == MessageKind::TilesDone; }

    // Takes a message of another rank. Throws Error (MalformedMessage), OutOfMemory, and what the codec throws.
    void receive(int source, const MessageHeader& header, Buffer&& message)
    {
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
    // Whether a message could not be taken. It does not come again.
    bool hasLost() const noexcept { return hasLost_; }

    // Whether all tiles of the other ranks are in the image.
    bool complete() const { return ranksComplete_ == senderCount_; }

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
            const FinishedPlanes place = placeOf(tile);
            FinishedTile out(region, config_.image.format, place.planes, place.stride, config_.image.dither);
            for (int y = 0; y < region.height(); ++y)
                out.setRow(y, row_.data(), nullptr);
            s = TileState::Background;
        }
        shownFrame_ = frame_;
    }

    // Called when the frame is over without these tiles. Adds those that have not been received and for which
    // `lost(tile, isOwnerLost)` is true; isOwnerLost: not all finished tiles of the tile's owner have come. Then
    // isComplete() is false for all of them.
    template <class Lost>
    void setIncomplete(std::vector<std::int32_t>& tiles, const Lost& lost)
    {
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
        return shownFrame_ >= 0 && !std::binary_search(incomplete_.begin(), incomplete_.end(), tile);
    }

    // The frame has failed: no pixel of the image is certain. A rank with other owners than the rest may have written
    // anywhere.
    void invalidate()
    {
        for (auto& s : state_)
            s = TileState::Undefined;
    }

private:
    static_assert(sizeof(ImageGate) <= MemoryPool::smallestShared);

    struct TilesOf {
        FinishedCount received;
        std::optional<FinishedCount> announced;
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
    void addReceived(TilesOf& its, const FinishedCount& here)
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

    Image newImage() const { return Image(*pool_, layout_.width(), layout_.height(), config_.image.format, channels_); }

    void receiveTiles(int source, Buffer&& message)
    {
        if (message.size() < batchPrefix)
            failMalformed("a batch of tiles is too short");
        const auto h = loadAs<FinishedBatch>(message.data() + sizeof(MessageHeader));
        const std::byte* in = message.data() + batchPrefix;
        std::size_t left = message.size() - batchPrefix;
        if (h.codec == 0 && h.rawBytes != left)
            failMalformed("a batch of tiles has the wrong size", static_cast<std::int64_t>(h.rawBytes),
                          static_cast<std::int64_t>(left));
        Buffer raw;
        if (h.codec != 0) {
            if (!config_.messages.codec || config_.messages.codec->id() != h.codec)
                failMalformed("compressed by a codec that this rank does not have");
            const std::size_t pixels =
                static_cast<std::size_t>(layout_.tileWidth()) * static_cast<std::size_t>(layout_.tileHeight());
            if (h.rawBytes > largestBatch(record_, pixels))
                failMalformed("a batch of tiles is too large");
            raw = pool_->acquire(h.rawBytes);
            if (!config_.messages.codec->decompress(in, left, raw.data(), h.rawBytes))
                failMalformed("a batch of tiles does not decompress to its size");
            in = raw.data();
            left = h.rawBytes;
        }
        FinishedCount here{0, 1};
        while (left > 0) {
            int tile = -1;
            const std::size_t bytes = record_.read(in, left, layout_, [&](int its, const Region&) {
                tile = its;
                take(tile, source);
                return placeOf(tile);
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
        if (bytes < sizeof(FinishedCount) || (bytes - sizeof(FinishedCount)) % sizeof(std::int32_t) != 0)
            failMalformed("a count of tiles has the wrong size");
        const auto count = loadAs<FinishedCount>(in);
        FinishedCount placed;
        for (std::size_t at = sizeof count; at < bytes; at += sizeof(std::int32_t), ++placed.tiles) {
            const auto tile = loadAs<std::int32_t>(in + at);
            if (tile < 0 || tile >= layout_.tileCount() || !gate_)
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

    std::shared_ptr<MemoryPool> pool_;
    TileLayout layout_;
    const FrameBufferConfig& config_;
    ChannelMask channels_;
    std::uint32_t address_;
    OwnerOf ownerOf_;
    Fail fail_;
    const FinishedRecord record_;
    std::int64_t frame_ = 0, shownFrame_ = -1;

    Image image_;
    Buffer gateMemory_;
    ImageGate* gate_ = nullptr;                 // in gateMemory_, if other ranks see the image
    std::array<float, 4> background_{};         // where the state says so
    std::vector<float> row_;                    // of background, as wide as a tile
    std::vector<std::atomic<TileState>> state_; // of each tile
    std::vector<std::int32_t> incomplete_;      // of the last frame
    mutable std::mutex mutex_;
    std::vector<TilesOf> tilesOf_; // of each rank; under mutex_
    int senderCount_ = 0;
    std::atomic<int> ranksComplete_{0}; // of those that send
    std::atomic<bool> hasLost_{false};
};

} // namespace detail
DFB_NAMESPACE_END
