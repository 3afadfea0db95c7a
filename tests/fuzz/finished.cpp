// FinishedRecord and GatheredImage: pixels are written only within the tile that a record names, tiles of other owners
// and repeated tiles are refused, and a record that is written again is the same.
//
// An input: format, channels and flags; the length of a batch and the batch; the rest is a count of tiles.
#include "fuzz.hpp"

#include <dfb/gather/gathered_image.hpp>
#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif

#include <algorithm>
#include <array>
#include <memory>

namespace {

namespace d = dfb::detail;
using d::FinishedRecord;

constexpr int side = 8, width = 20, height = 13;
constexpr std::size_t mostBytes = 4096;
enum Flags : std::uint8_t { HasCodec = 1, MakeHeader = 2, Record = 4, Splits = 8, Shared = 16 };

std::shared_ptr<const dfb::Codec> codec()
{
#if defined(DFB_HAS_SNAPPY)
    static const auto snappy = std::make_shared<dfb::SnappyCodec>();
    return snappy;
#else
    return nullptr;
#endif
}

const dfb::TileLayout& layout()
{
    static const dfb::TileLayout whole(width, height, side);
    return whole;
}

dfb::OutputFormat formatOf(std::uint8_t byte)
{
    return std::array{dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8, dfb::OutputFormat::RGBA32F}[byte % 3];
}
dfb::ChannelMask channelsOf(std::uint8_t byte)
{
    return std::array<dfb::ChannelMask, 3>{0, dfb::depthChannel,
                                           dfb::depthChannel | dfb::imageAuxChannels}[byte / 4 % 3];
}

int ownerOf(int tile) { return tile % 2; }

// Planes that have exactly the size of a tile.
struct Pixels {
    Pixels(const FinishedRecord& record, const dfb::Region& region)
    {
        planes.stride = static_cast<std::size_t>(region.width());
        const std::size_t count = planes.stride * static_cast<std::size_t>(region.height());
        for (std::size_t c = 0; c < d::channelCount; ++c)
            if (record.pixelBytes(c) > 0) {
                memory[c] = fuzz::ExactBlocks::copyOf(std::string(record.pixelBytes(c) * count, '\xee'));
                planes.planes.at[c] = memory[c].data();
            }
    }
    bool operator==(const Pixels& o) const
    {
        for (std::size_t c = 0; c < d::channelCount; ++c)
            if (memory[c].size() != o.memory[c].size()
                || (!memory[c].empty() && std::memcmp(memory[c].data(), o.memory[c].data(), memory[c].size()) != 0))
                return false;
        return true;
    }
    std::array<dfb::Buffer, d::channelCount> memory;
    d::FinishedPlanes planes;
};

std::string recordOf(const FinishedRecord& record, int tile, const d::FinishedPlanes& planes, bool splits)
{
    static FinishedRecord::Plan plan;
    record.plan(tile, layout().region(tile), planes, splits, plan);
    dfb::Buffer bytes = fuzz::ExactBlocks::copyOf(std::string(plan.bytes, '\x55'));
    record.write(plan, bytes.data());
    return fuzz::textOf(bytes.data(), bytes.size());
}

// Returns whether the bytes are a record.
bool readOne(const FinishedRecord& record, const std::string& bytes, bool splits)
{
    const auto read = [&](const std::string& from, int& tile, std::unique_ptr<Pixels>& pixels) {
        const dfb::Buffer block = fuzz::ExactBlocks::copyOf(from);
        return record.read(block.data(), block.size(), layout(), [&](int to, const dfb::Region& region) {
            fuzz::require(to >= 0 && to < layout().tileCount() && region == layout().region(to),
                          "the tile is one of the image");
            tile = to;
            pixels = std::make_unique<Pixels>(record, region);
            return pixels->planes;
        });
    };
    int tile = -1, sameTile = -1;
    std::unique_ptr<Pixels> first, second;
    try {
        fuzz::require(read(bytes, tile, first) <= bytes.size(), "it does not read behind its end");
    } catch (const dfb::Error& e) {
        fuzz::require(e.info().kind == dfb::ErrorKind::MalformedMessage, "it is refused as malformed");
        return false;
    }
    const std::string again = recordOf(record, tile, first->planes, splits);
    fuzz::require(read(again, sameTile, second) == again.size() && sameTile == tile && *first == *second,
                  "a record comes back");
    return true;
}

// Returns whether the image was complete after the messages.
bool gather(dfb::OutputFormat format, dfb::ChannelMask channels, std::uint8_t flags, const std::string& batch,
            const std::string& done)
{
    const auto pool = dfb::MemoryPool::create(false);
    dfb::FrameBufferConfig config;
    config.image.format = format;
    config.messages.codec = flags & HasCodec ? codec() : nullptr;
    d::GatheredImage display(pool, layout(), config, channels, 0, 2, ownerOf, nullptr);
    if (flags & Shared) // other ranks write tiles into the image
        display.share([](const std::byte*) { return 0; });
    display.newFrame(1);
    auto& image = const_cast<dfb::Image&>(display.image());
    const std::size_t pixelBytes = dfb::bytesPerPixel(format);
    std::memset(image.bytes(), 0xa5, pixelBytes * image.pixelCount());

    std::string body = batch;
    if (flags & MakeHeader) {
        d::FinishedBatch h;
        h.rawBytes = batch.size();
        if (config.messages.codec) {
            body.resize(config.messages.codec->bound(batch.size()));
            body.resize(config.messages.codec->compress(fuzz::bytesOf(batch), batch.size(),
                                                        reinterpret_cast<std::byte*>(body.data())));
            h.codec = config.messages.codec->id();
        }
        body = fuzz::Output().put(h).text(body).bytes();
    }
    const auto give = [&](d::MessageKind kind, const std::string& bytes) {
        const auto header = d::MessageHeader::of(kind, 0, 1);
        try {
            display.receive(1, header, fuzz::ExactBlocks::copyOf(fuzz::Output().put(header).text(bytes).bytes()));
            return true;
        } catch (const dfb::Error& e) {
            fuzz::require(e.info().kind == dfb::ErrorKind::MalformedMessage
                              || e.info().kind == dfb::ErrorKind::DuplicateInput,
                          "it is refused as malformed or as a duplicate");
            return false;
        }
    };
    give(d::MessageKind::FinishedTiles, body);
    const bool counted = give(d::MessageKind::TilesDone, done);
    const bool isComplete = display.complete();
    fuzz::require(!isComplete || counted, "nothing is complete before the count has come");
    fuzz::require(!give(d::MessageKind::TilesDone, done), "a second count is refused");
    give(d::MessageKind::FinishedTiles, body);
    for (int tile = 0; tile < layout().tileCount(); tile += 2) { // the tiles of rank 0
        const dfb::Region r = layout().region(tile);
        for (int y = r.y0; y < r.y1; ++y) {
            const std::byte* row = image.bytes() + pixelBytes * static_cast<std::size_t>(y * width + r.x0);
            const std::size_t count = pixelBytes * static_cast<std::size_t>(r.width());
            fuzz::require(std::all_of(row, row + count, [](std::byte b) { return b == std::byte{0xa5}; }),
                          "nothing else of the image is touched");
        }
    }
    return isComplete;
}

// Returns whether the input was accepted.
bool take(fuzz::Input in)
{
    const auto what = in.take<std::uint8_t>(), flags = in.take<std::uint8_t>();
    const auto length = in.take<std::uint16_t>();
    const std::string batch = in.text(std::min<std::size_t>(length, mostBytes));
    if (flags & Record)
        return readOne(FinishedRecord(formatOf(what), channelsOf(what)), batch, flags & Splits);
    return gather(formatOf(what), channelsOf(what), flags, batch, in.rest());
}

} // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size)
{
    take(fuzz::Input(data, size));
    return 0;
}

std::vector<std::pair<std::string, std::string>> fuzz::seeds()
{
    std::vector<std::pair<std::string, std::string>> all;
    const auto make = [](std::uint8_t what, int tile, bool splits, const auto& isBackground) {
        const FinishedRecord record(formatOf(what), channelsOf(what));
        const dfb::Region region = layout().region(tile);
        Pixels pixels(record, region);
        for (std::size_t c = 0; c < d::channelCount; ++c)
            for (std::size_t i = 0; i < pixels.memory[c].size(); ++i) {
                const int pixel = static_cast<int>(i / record.pixelBytes(c));
                const bool background = isBackground(pixel % region.width(), pixel / region.width());
                pixels.memory[c].data()[i] = static_cast<std::byte>(background ? 7 : 8 + i % 4);
            }
        return recordOf(record, tile, pixels.planes, splits);
    };
    const auto add = [&](const std::string& name, std::uint8_t what, std::uint8_t flags, const std::string& batch,
                         std::int32_t tiles, const std::string& placed = "", bool isGood = true,
                         std::int32_t batches = -1) {
        all.emplace_back(name, Output()
                                   .put(what)
                                   .put(flags)
                                   .put(static_cast<std::uint16_t>(batch.size()))
                                   .text(batch)
                                   .put(tiles)
                                   .put(batches < 0 ? std::int32_t{!batch.empty()} : batches)
                                   .text(placed)
                                   .bytes());
        require(take(Input(all.back().second)) == isGood, "what is good is taken, and nothing else");
    };
    const auto none = [](int, int) { return false; };
    const auto some = [](int x, int y) { return x < 3 || y % 3 == 1; };
    const auto most = [](int x, int y) { return x != 2 || y != 3; };
    const auto full = [](int, int) { return true; };
    add("dense", 0, Record, make(0, 5, false, none), 0);
    add("runs", 0, Record, make(0, 1, false, some), 0);
    add("one_pixel", 1, Record, make(1, 1, false, most), 0);
    add("background", 0, Record, make(0, 3, false, full), 0);
    add("split", 0, Record | Splits, make(0, 5, true, some), 0);
    add("floats", 2, Record, make(2, 5, false, most), 0);
    add("depth_split", 5, Record | Splits, make(5, 5, true, some), 0);
    add("all_channels", 8, Record, make(8, 5, false, most), 0);
    add("all_channels_dense", 9, Record | Splits, make(9, 5, true, none), 0);
    const std::string three = make(0, 1, false, most) + make(0, 3, false, some) + make(0, 5, false, none);
    add("batch", 0, MakeHeader, three, 3);
    add("batch_compressed", 0, MakeHeader | HasCodec, make(0, 1, true, some) + make(0, 5, true, most), 2);
    add("batch_of_another_owner", 0, MakeHeader, make(0, 1, false, most) + make(0, 2, false, most), 2, "", false);
    add("batch_twice_the_same", 0, MakeHeader, make(0, 1, false, most) + make(0, 1, false, most), 2, "", false);
    d::FinishedBatch h;
    h.rawBytes = three.size();
    add("batch_with_header", 0, 0, Output().put(h).text(three).bytes(), 3);
    const std::string placed = Output().put(std::int32_t{1}).put(std::int32_t{3}).bytes();
    add("count_of_placed", 0, MakeHeader | Shared, make(0, 5, false, some), 3, placed);
    add("count_of_placed_only", 0, MakeHeader | Shared, "", 2, placed, true, 1);
    add("batch_count_too_low", 0, MakeHeader, three, 3, "", false, 0);
    add("batch_count_too_high", 0, MakeHeader, three, 3, "", false, 2);
    add("tile_count_too_low", 0, MakeHeader, three, 2, "", false);
    add("count_of_placed_too_low", 0, MakeHeader | Shared, "", 1, placed, false);
    add("count_of_placed_where_none_can_be", 0, MakeHeader, "", 2, placed, false);
    return all;
}
