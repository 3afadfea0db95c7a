// Wall: the implementation of DisplayWall. Parts of finished tiles go to the ranks that drive displays, which join them
// into pictures.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/comm/mailbox.hpp>
#include <dfb/exec.hpp>
#include <dfb/frame/agreement.hpp>
#include <dfb/image.hpp>
#include <dfb/pixel_op.hpp>
#include <dfb/tile_layout.hpp>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// The members are those of DisplayWall; see there.
class Wall final : private MailboxOwner {
public:
    Wall(std::shared_ptr<Connection> connection, const WallLayout& layout, OutputFormat format,
         std::shared_ptr<Executor> executor, std::size_t poolBytes)
        : layout_(layout), format_(format), pool_(connection->pool())
    {
        if (!executor)
            executor = makeThreads(*connection);
        const std::size_t largest = prefix + std::size_t{256} * 256 * bytesPerPixel(OutputFormat::RGBA32F);
        MailboxOwner& self = *this;
        mailbox_ = std::make_unique<Mailbox>(std::move(connection), std::move(executor),
                                             std::max(poolBytes, 4 * largest), self);
        mailbox_->start();
        agree(*mailbox_, [this] {
            checkLayout();
            takeMemory();
            return Agreement{true, describe(), mailbox_->rank()};
        });
    }
    ~Wall() { mailbox_->stop(); } // while mailbox_ is not null yet: its tasks use it

    void finish(std::int64_t frame, std::chrono::milliseconds timeout)
    {
        mailbox_->requireProgress();
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (frame <= last_)
                failArgument("frame %lld, after finish() of frame %lld: frames are finished in order, once, "
                             "and all those of a wall are of one framebuffer, before its resize()",
                             static_cast<long long>(frame), static_cast<long long>(last_));
            if (frame > lastPossible())
                failArgument("frame %lld, which no rank can have begun: was it one of this wall's framebuffer?",
                             static_cast<long long>(frame));
        }
        const Connection::Expecting expecting(mailbox_->connection());
        std::optional<std::chrono::steady_clock::time_point> deadline;
        if (timeout.count() > 0)
            deadline = std::chrono::steady_clock::now() + std::min(timeout, longestTimeout);
        mailbox_->enterEpoch(frame); // gives up if a neighbour has left: it does not tell what it has sent
        tellSent(frame);
        mailbox_->wait([&] { return isOver(frame); }, deadline);
        std::shared_ptr<Pictures> pictures; // kept: store() may drop them for those of later frames
        const std::optional<ErrorInfo> mine = whatIsMissing(frame, pictures);
        Bytes missing; // empty if nothing is missing
        if (mine)
            detail::put(missing, *mine);
        const Bytes all = mailbox_->reduce(missing, [](const Bytes& a, const Bytes& b) { return a.empty() ? b : a; });
        const std::lock_guard<std::mutex> lock(mutex_);
        if (all.empty()) {
            for (auto& [display, image] : shown_)
                std::swap(image, pictures->at(display).image);
            shownFrame_ = frame;
        }
        mailbox_->reductions().forget(SentPixels, frame);
        coming_.erase(coming_.begin(), coming_.upper_bound(frame)); // also parts of failed frames
        sent_.erase(sent_.begin(), sent_.upper_bound(frame));
        allSent_.erase(allSent_.begin(), allSent_.upper_bound(frame));
        last_ = frame;
        if (mine && mine->kind == ErrorKind::MalformedMessage && frame >= errorFrame_)
            error_.clear();
        if (ByteReader in(all); in.left() > 0)
            throw Error(getErrorInfo(in), mailbox_->connection().throwByAll());
    }

    const Image& image(int display) const
    {
        const auto found = shown_.find(display);
        if (found == shown_.end())
            failArgument("display %d is not driven by this rank", display);
        return found->second;
    }

    std::int64_t imageFrame() const noexcept { return shownFrame_; }

    void begin()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        ++newest_;
    }

    void put(const PixelTile& tile)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            newest_ = std::max(newest_, tile.frame);
        }
        const std::size_t pixelBytes = bytesPerPixel(format_);
        const auto tileWidth = static_cast<std::size_t>(tile.region.width());
        for (int d = 0; d < layout_.displayCount(); ++d) {
            const Region display = layout_.region(d), part = intersection(display, tile.region);
            if (part.empty())
                continue;
            const auto header = MessageHeader::of(MessageKind::FinishedTiles, mailbox_->address(), tile.frame);
            const PartHeader where{
                d, {part.x0 - display.x0, part.y0 - display.y0, part.x1 - display.x0, part.y1 - display.y0}};
            const auto width = static_cast<std::size_t>(part.width());
            Buffer message = pool_->acquire(prefix + width * static_cast<std::size_t>(part.height()) * pixelBytes);
            std::byte* out = storeAll(message.data(), header, where);
            for (int y = part.y0; y < part.y1; ++y, out += width * pixelBytes) {
                const std::size_t first = static_cast<std::size_t>(y - tile.region.y0) * tileWidth
                                          + static_cast<std::size_t>(part.x0 - tile.region.x0);
                convertPixels(tile.color + 4 * first, part.width(), format_, out);
            }
            mailbox_->send(layout_.ranks[static_cast<std::size_t>(d)], std::move(message));
            const std::lock_guard<std::mutex> lock(mutex_);
            countsOf(sent_, tile.frame)[static_cast<std::size_t>(d)] +=
                static_cast<std::int64_t>(part.width()) * part.height();
        }
    }

private:
    struct PartHeader {
        std::int32_t display = 0;
        Region region; // in the display
        std::int32_t reserved = 0;
    };
    static constexpr std::size_t prefix = sizeof(MessageHeader) + sizeof(PartHeader);

    // How many frames other ranks may be ahead of this one: those in flight, and some that have failed. Messages of
    // later frames are refused, as each frame takes memory for its pictures.
    static constexpr std::int64_t framesAhead = 16;
    static constexpr std::size_t framesKept = 16;

    enum Scope : std::uint32_t { SentPixels = Mailbox::ownScope + 1 }; // of reductions

    struct Picture {
        Image image;
        std::int64_t pixelsLeft = 0;
        std::vector<std::uint64_t> covered{}; // a bit for each pixel; each row begins with a new word
    };
    using Pictures = std::map<int, Picture>; // by display
    using Bytes = ReductionTable::Bytes;

    std::string describe() const
    {
        Agreement::Settings settings;
        settings.add("the wall's columns x rows", printed("%dx%d", layout_.columns, layout_.rows));
        settings.add("the size of its displays", printed("%dx%d", layout_.displayWidth, layout_.displayHeight));
        settings.add("the size of its bezels", printed("%dx%d", layout_.bezelX, layout_.bezelY));
        settings.add("its format", nameOf(format_));
        std::string ranks;
        for (const int rank : layout_.ranks)
            ranks += printed(ranks.empty() ? "%d" : ", %d", rank);
        settings.add("the list of its displays' ranks", '{' + ranks + '}');
        settings.add("its poolBytes", mailbox_->flow().poolBytes());
        settings.add("checksums", mailbox_->connection().config().checksums);
        return settings.text();
    }

    // Throws InvalidArgument.
    void checkLayout() const
    {
        const auto isTooLarge = [](int count, int size, int bezel) {
            constexpr std::int64_t most = TileLayout::maxImageSize;
            return std::max({count, size, bezel}) > most || std::int64_t{count} * (size + bezel) - bezel > most;
        };
        if (isTooLarge(layout_.columns, layout_.displayWidth, layout_.bezelX)
            || isTooLarge(layout_.rows, layout_.displayHeight, layout_.bezelY) || layout_.columns < 1
            || layout_.rows < 1 || std::int64_t{layout_.columns} * layout_.rows > std::numeric_limits<int>::max()
            || layout_.displayWidth < 1 || layout_.displayHeight < 1 || layout_.bezelX < 0 || layout_.bezelY < 0
            || format_ == OutputFormat::None)
            failArgument("a wall of %dx%d displays of %dx%d, bezels of %dx%d, format %s: cannot be", layout_.columns,
                         layout_.rows, layout_.displayWidth, layout_.displayHeight, layout_.bezelX, layout_.bezelY,
                         nameOf(format_));
        if (layout_.ranks.size() != static_cast<std::size_t>(layout_.displayCount()))
            failArgument("a wall of %d displays names %zu ranks", layout_.displayCount(), layout_.ranks.size());
        for (const int rank : layout_.ranks)
            if (rank < 0 || rank >= mailbox_->size())
                failArgument("a display of the wall is driven by rank %d of %d", rank, mailbox_->size());
    }

    // Makes the displays of this rank, with nothing to show. Takes memory for the images that each of them will have,
    // and leaves it in the pool.
    void takeMemory()
    {
        std::vector<Image> images;
        for (int d = 0; d < layout_.displayCount(); ++d)
            if (layout_.ranks[static_cast<std::size_t>(d)] == mailbox_->rank()) {
                shown_.emplace(d, Image());
                for (int i = 0; i < 2; ++i)
                    images.push_back(makeImage());
            }
    }

    void incoming(int source, const MessageHeader& header, Buffer&& message) override
    {
        if (source != mailbox_->rank() && mailbox_->needsCredit(header.kind))
            mailbox_->consumed(source, message.size());
        try {
            if (mailbox_->receiveCredit(source, header, message))
                return;
            const bool isReduction = header.kind == MessageKind::ReduceUp || header.kind == MessageKind::ReduceDown;
            if (header.kind == MessageKind::FinishedTiles)
                store(header.number, message);
            else if (isReduction && mailbox_->scopeOf(message) == SentPixels)
                receiveSent(source, header, message);
            else
                failMalformed("a message of a kind that no wall gets", -1, static_cast<std::int64_t>(header.kind));
        } catch (const Error& e) {
            if (header.kind != MessageKind::FinishedTiles)
                throw; // it may have been one that finish() waits for
            refuse(source, e.info(), header.number);
        }
    }

    void undecodable(const ErrorInfo& error) override
    {
        mailbox_->keepDamage(error); // finish() may be waiting for it
        refuse(error.from, error, 0);
    }

    // Notes that a part of a frame is missing. It is not known of which one: finish() fails for all that have begun.
    // `frame`: the frame that the message names.
    void refuse(int source, const ErrorInfo& error, std::int64_t frame)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            error_ = error.message + printed(", in a message from rank %d to the wall", source);
            errorFrame_ = std::max({errorFrame_, newest_, coming_.empty() ? 0 : coming_.rbegin()->first,
                                    frame <= lastPossible() ? frame : 0});
        }
        mailbox_->notify();
    }

    void store(std::int64_t frame, const Buffer& message)
    {
        if (message.size() < prefix)
            failMalformed("a part of a display is too short");
        const auto where = loadAs<PartHeader>(message.data() + sizeof(MessageHeader));
        const Region whole{0, 0, layout_.displayWidth, layout_.displayHeight}, part = where.region;
        if (shown_.count(where.display) == 0 || part.empty() || intersection(whole, part) != part)
            failMalformed("a part of a display that this rank does not drive, or outside of it");
        const std::size_t pixelBytes = bytesPerPixel(format_),
                          rowBytes = static_cast<std::size_t>(part.width()) * pixelBytes;
        if (message.size() != prefix + rowBytes * static_cast<std::size_t>(part.height()))
            failMalformed("a part of a display has the wrong size");
        std::shared_ptr<Pictures> pictures; // shared, as finish() may drop those of a failed frame
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (frame <= std::max(last_, dropped_))
                return;
            if (frame > lastPossible())
                failMalformed("a part of a display's frame that no rank can have begun", lastPossible(), frame);
            pictures = picturesOf(frame);
            cover(pictures->at(where.display), part);
            for (; coming_.size() > framesKept; coming_.erase(coming_.begin()))
                dropped_ = coming_.begin()->first;
        }
        Picture& picture = pictures->at(where.display);
        const std::size_t stride = static_cast<std::size_t>(layout_.displayWidth) * pixelBytes;
        std::byte* to = picture.image.bytes() + static_cast<std::size_t>(part.y0) * stride
                        + static_cast<std::size_t>(part.x0) * pixelBytes;
        const std::byte* in = message.data() + prefix;
        for (int y = part.y0; y < part.y1; ++y, in += rowBytes, to += stride)
            std::memcpy(to, in, rowBytes);
        bool complete = false;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            picture.pixelsLeft -= static_cast<std::int64_t>(part.width()) * part.height();
            complete = picture.pixelsLeft == 0;
        }
        if (complete)
            mailbox_->notify();
    }

    // Takes note that these pixels have come, and must not come again; under mutex_.
    void cover(Picture& picture, const Region& part) const
    {
        std::uint64_t twice = 0;
        for (int y = part.y0; y < part.y1; ++y)
            forEachWord(part.x0, part.x1, [&](std::size_t word, std::uint64_t pixels) {
                std::uint64_t& covered = picture.covered[static_cast<std::size_t>(y) * wordsPerRow() + word];
                twice |= covered & pixels;
                covered |= pixels;
            });
        if (twice != 0)
            failMalformed("a part of a display overlaps another");
    }
    Image makeImage() const { return Image(*pool_, layout_.displayWidth, layout_.displayHeight, format_, 0); }
    std::int64_t pixelsOfDisplay() const { return std::int64_t{layout_.displayWidth} * layout_.displayHeight; }
    std::size_t wordsPerRow() const { return (static_cast<std::size_t>(layout_.displayWidth) + 63) / 64; }

    // Under mutex_.
    std::int64_t lastPossible() const { return std::max(last_, newest_) + framesAhead; }

    // The pictures of all displays of this rank; under mutex_.
    std::shared_ptr<Pictures> picturesOf(std::int64_t frame)
    {
        if (const auto found = coming_.find(frame); found != coming_.end())
            return found->second;
        auto pictures = std::make_shared<Pictures>();
        for (const auto& [d, shown] : shown_)
            pictures->emplace(d, Picture{makeImage(), pixelsOfDisplay(),
                                         std::vector<std::uint64_t>(static_cast<std::size_t>(layout_.displayHeight)
                                                                    * wordsPerRow())});
        return coming_.emplace(frame, std::move(pictures)).first->second;
    }

    // ---- how many pixels of a frame all ranks have sent to each display

    using Counts = std::vector<std::int64_t>; // of pixels, by display

    // Under mutex_.
    Counts& countsOf(std::map<std::int64_t, Counts>& frames, std::int64_t frame) const
    {
        Counts& counts = frames[frame];
        counts.resize(static_cast<std::size_t>(layout_.displayCount()));
        return counts;
    }

    // Called when this rank has sent all of its frame: tells the other ranks how much that was. Waits for nothing.
    void tellSent(std::int64_t frame)
    {
        Counts mine;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            mine = countsOf(sent_, frame);
        }
        const auto* first = reinterpret_cast<const std::byte*>(mine.data());
        mailbox_->reductions().enter(
            {SentPixels, frame}, Bytes(first, first + mine.size() * sizeof mine[0]),
            [](const Bytes& a, const Bytes& b) { // of equal length, see receiveSent()
                ByteReader x(a), y(b);
                Bytes sums;
                while (x.left() > 0)
                    sums.put(x.get<std::uint64_t>() + y.get<std::uint64_t>());
                return sums;
            },
            [this, frame](const Bytes& all) {
                {
                    const std::lock_guard<std::mutex> lock(mutex_);
                    if (frame <= last_)
                        return;
                    std::copy(all.begin(), all.end(), reinterpret_cast<std::byte*>(countsOf(allSent_, frame).data()));
                }
                mailbox_->notify();
            });
    }

    void receiveSent(int source, const MessageHeader& header, const Buffer& message)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (header.number > lastPossible())
                failMalformed("word of a frame that no rank can have begun", lastPossible(), header.number);
        }
        if (mailbox_->bytesOf(message).size()
            != static_cast<std::size_t>(layout_.displayCount()) * sizeof(std::int64_t))
            failMalformed("word of what was sent to other displays than there are");
        mailbox_->receiveReduction(source, header, message);
    }

    // Under mutex_: how many pixels have not come to a display of this rank, and whether no more will come. They
    // allocate nothing: a rank without memory must not throw while others wait for it.
    std::int64_t pixelsLeft(std::int64_t frame, int display) const
    {
        const auto found = coming_.find(frame);
        return found == coming_.end() ? pixelsOfDisplay() : found->second->at(display).pixelsLeft;
    }
    bool hasAllSent(std::int64_t frame, int display) const
    {
        const auto found = allSent_.find(frame);
        return found != allSent_.end()
               && found->second[static_cast<std::size_t>(display)] == pixelsOfDisplay() - pixelsLeft(frame, display);
    }

    // Whether no display of this rank has to wait any longer, or a part was lost.
    bool isOver(std::int64_t frame)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return !error_.empty() || frame <= dropped_
               || std::all_of(shown_.begin(), shown_.end(), [&](const auto& shown) {
                      return pixelsLeft(frame, shown.first) == 0 || hasAllSent(frame, shown.first);
                  });
    }

    // Sets `pictures` to those that have come.
    std::optional<ErrorInfo> whatIsMissing(std::int64_t frame, std::shared_ptr<Pictures>& pictures)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (const auto found = coming_.find(frame); found != coming_.end())
            pictures = found->second;
        ErrorInfo info = errorInfo(ErrorKind::MalformedMessage, error_);
        info.frame = frame;
        if (!error_.empty())
            return info;
        if (frame <= dropped_) {
            info.kind = ErrorKind::MissingInput;
            info.message = printed("rank %d has dropped it, as parts of more than %zu frames came before finish()",
                                   mailbox_->rank(), framesKept);
            return info;
        }
        info.kind = ErrorKind::TimedOut;
        for (const auto& [display, image] : shown_)
            if (const std::int64_t left = pixelsLeft(frame, display); left > 0) {
                const bool isUnsent = hasAllSent(frame, display);
                info.kind = isUnsent ? ErrorKind::MissingInput : info.kind;
                info.message +=
                    printed("%sdisplay %d of rank %d misses %lld pixels%s", info.message.empty() ? "" : ", ", display,
                            mailbox_->rank(), static_cast<long long>(left), isUnsent ? " that no rank has sent" : "");
            }
        return info.message.empty() ? std::nullopt : std::optional<ErrorInfo>(std::move(info));
    }

    WallLayout layout_;
    OutputFormat format_;
    std::shared_ptr<MemoryPool> pool_;
    std::map<int, Image> shown_; // of this rank's displays; only finish() changes it and shownFrame_
    std::int64_t shownFrame_ = -1;

    std::mutex mutex_;
    std::map<std::int64_t, std::shared_ptr<Pictures>> coming_; // by frame; under mutex_, except the pixels
    std::map<std::int64_t, Counts> sent_, allSent_;            // by frame; under mutex_
    std::int64_t last_ = 0;                                    // the last finished frame; under mutex_
    std::int64_t dropped_ = 0;    // the newest frame dropped for want of room; under mutex_
    std::int64_t newest_ = 0;     // the newest frame that this rank has begun; under mutex_
    std::string error_;           // under mutex_
    std::int64_t errorFrame_ = 0; // the last frame that error_ may be about; under mutex_

    std::unique_ptr<Mailbox> mailbox_; // last: its tasks use the others
};

} // namespace detail
DFB_NAMESPACE_END
