// FinishedRecord: tiles come out as they went in, take little more than their pixels that are not background, and
// malformed records are refused.
#include "brief.hpp"
#include "catch.hpp"

#include <dfb/wire/finished_record.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <random>
#include <vector>

namespace finished_record_cases {

namespace {

namespace d = dfb::detail;
using d::FinishedRecord;

constexpr int side = 32, width = 70, height = 45; // the tiles at the border are 6 by 13
const dfb::TileLayout layout(width, height, side);

// The planes of an image or of a tile.
struct Pixels {
    Pixels(const FinishedRecord& record, std::size_t count, std::size_t stride)
    {
        planes.stride = stride;
        for (std::size_t c = 0; c < d::channelCount; ++c) {
            memory[c].assign(record.pixelBytes(c) * count, std::byte{0xee});
            planes.planes.at[c] = memory[c].empty() ? nullptr : memory[c].data();
        }
    }
    std::vector<std::byte> memory[d::channelCount];
    d::FinishedPlanes planes;
};

// A tile whose pixels have different values; those for which `isBackground(x, y)` holds are all equal.
template <class IsBackground>
Pixels makeTile(const FinishedRecord& record, const dfb::Region& region, const IsBackground& isBackground)
{
    const auto tileWidth = static_cast<std::size_t>(region.width());
    Pixels tile(record, tileWidth * static_cast<std::size_t>(region.height()), tileWidth);
    for (std::size_t c = 0; c < d::channelCount; ++c)
        for (std::size_t i = 0; i < tile.memory[c].size(); ++i) {
            const std::size_t pixel = i / record.pixelBytes(c);
            const bool background =
                isBackground(static_cast<int>(pixel % tileWidth), static_cast<int>(pixel / tileWidth));
            tile.memory[c][i] = static_cast<std::byte>(background ? 40 + c : 41 + (i * 7 + pixel) % 200);
        }
    return tile;
}

std::vector<std::byte> recordOf(const FinishedRecord& record, int tile, const Pixels& pixels, bool splits)
{
    static FinishedRecord::Plan plan; // is used again, as there
    record.plan(tile, layout.region(tile), pixels.planes, splits, plan);
    std::vector<std::byte> bytes(plan.bytes, std::byte{0x55});
    record.write(plan, bytes.data());
    return bytes;
}

// Whether the tile arrives in the image and nothing else is changed.
bool arrives(const FinishedRecord& record, int tile, const Pixels& pixels, const std::vector<std::byte>& bytes)
{
    Pixels image(record, static_cast<std::size_t>(width) * height, width);
    Pixels expected = image;
    const dfb::Region region = layout.region(tile);
    const std::size_t first = static_cast<std::size_t>(region.y0) * width + static_cast<std::size_t>(region.x0);
    for (std::size_t c = 0; c < d::channelCount; ++c) {
        const std::size_t each = record.pixelBytes(c), row = each * static_cast<std::size_t>(region.width());
        for (std::size_t y = 0; each > 0 && y < static_cast<std::size_t>(region.height()); ++y)
            std::copy_n(pixels.memory[c].data() + row * y, row, expected.memory[c].data() + each * (first + y * width));
    }
    const std::size_t read = record.read(bytes.data(), bytes.size(), layout, [&](int to, const dfb::Region& r) {
        CHECK((to == tile && r == region));
        d::FinishedPlanes place = image.planes;
        for (std::size_t c = 0; c < d::channelCount; ++c)
            if (place.planes.at[c])
                place.planes.at[c] += record.pixelBytes(c) * first;
        return place;
    });
    bool same = read == bytes.size();
    for (std::size_t c = 0; c < d::channelCount; ++c)
        same = same && image.memory[c] == expected.memory[c];
    return same;
}

const dfb::ChannelMask channelSets[] = {0, dfb::depthChannel, dfb::depthChannel | dfb::imageAuxChannels};

} // namespace

TEST_CASE("A finished tile arrives as it was, and its background does not travel", "[gather]")
{
    for (const dfb::OutputFormat format : {dfb::OutputFormat::RGBA8, dfb::OutputFormat::RGBA32F})
        for (const dfb::ChannelMask channels : channelSets)
            for (const bool splits : {false, true})
                for (const int tile : {0, 1, layout.tileCount() - 1}) {
                    const FinishedRecord record(format, channels);
                    const dfb::Region region = layout.region(tile);
                    const std::size_t most =
                        record.mostBytes(static_cast<std::size_t>(region.width() * region.height()));
                    std::size_t each = 0;
                    for (std::size_t c = 0; c < d::channelCount; ++c)
                        each += record.pixelBytes(c);
                    const auto bytesWith = [&](const auto& isBackground) {
                        const Pixels pixels = makeTile(record, region, isBackground);
                        const auto bytes = recordOf(record, tile, pixels, splits);
                        CHECK(arrives(record, tile, pixels, bytes));
                        return bytes.size();
                    };
                    // The record has only the header, the pixel and the counts of the rows.
                    CHECK(bytesWith([](int, int) { return true; })
                          <= 16 + each + 2 * static_cast<std::size_t>(region.height()) + 15);
                    CHECK(bytesWith([](int, int) { return false; }) > most * 9 / 10); // some are alike by chance
                    CHECK(bytesWith([](int, int) { return false; }) <= most);
                    // One different pixel adds little.
                    CHECK(bytesWith([](int x, int y) { return x != 3 || y != 5; })
                          <= 16 + 2 * each + 4 + 2 * static_cast<std::size_t>(region.height()) + 15);
                    CHECK(bytesWith([](int x, int) { return x < 4; }) < most);
                    CHECK(bytesWith([](int x, int y) { return (x + y) % 2 == 0; }) <= most);
                }
}

TEST_CASE("Finished tiles that are malformed are refused or stay within their tile", "[gather]")
{
    std::mt19937 random(3);
    int refused = 0, taken = 0;
    for (const dfb::ChannelMask channels : channelSets)
        for (const bool splits : {false, true}) {
            const FinishedRecord record(dfb::OutputFormat::RGBA8, channels);
            const Pixels pixels =
                makeTile(record, layout.region(1), [](int x, int y) { return x < 9 || y % 5 == 2 || x % 7 == 3; });
            const auto right = recordOf(record, 1, pixels, splits);
            for (int round = 0; round < repeats(3000); ++round) {
                auto bytes = right;
                if (round % 3 == 0)
                    bytes.resize(random() % bytes.size());
                for (auto flips = round % 3 == 0 ? 0 : 1 + random() % 3; flips > 0; --flips) {
                    const std::size_t tail = 120 + std::size_t{32} * 2, which = random() % 2; // the header, the table
                    bytes[which ? random() % 16 : bytes.size() - 1 - random() % std::min(tail, bytes.size())] =
                        static_cast<std::byte>(random());
                }
                // The target has exactly the size of the named tile, so that AddressSanitizer finds writes beyond it.
                try {
                    Pixels target(record, 1, 1);
                    record.read(bytes.data(), bytes.size(), layout, [&](int tile, const dfb::Region& r) {
                        REQUIRE((tile >= 0 && tile < layout.tileCount() && r == layout.region(tile)));
                        target = Pixels(record, static_cast<std::size_t>(r.width() * r.height()),
                                        static_cast<std::size_t>(r.width()));
                        for (std::size_t c = 0; c < d::channelCount; ++c)
                            target.planes.planes.at[c] = target.memory[c].empty() ? nullptr : target.memory[c].data();
                        return target.planes;
                    });
                    ++taken;
                } catch (const dfb::Error& e) {
                    CHECK(e.info().kind == dfb::ErrorKind::MalformedMessage);
                    ++refused;
                }
            }
        }
    CHECK(refused > repeats(9000)); // those that were cut, at least, and most others
    CHECK(taken > repeats(100));    // a changed padding or pixel harms nobody
}

} // namespace finished_record_cases
