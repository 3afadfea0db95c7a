// The wall of tiles, and what this rank has on it.
#include "context.hpp"
#include "errors.hpp"

#include <algorithm>
#include <cstring>
#include <string>

namespace dfb_icet {

namespace {

int addTile(IceTContextStruct& context, const Tile& tile)
{
    requireNotDrawing(context);
    Settings& settings = context.settings;
    if (tile.viewport.empty())
        throw Error(ICET_INVALID_VALUE, "a tile without pixels");
    if (tile.displayRank < 0 || tile.displayRank >= context.size())
        throw Error(ICET_INVALID_VALUE, "display rank " + std::to_string(tile.displayRank) + " of "
                                            + std::to_string(context.size()) + " ranks");
    if (const int other = settings.tileOf(tile.displayRank); other >= 0)
        throw Error(ICET_INVALID_VALUE, "rank " + std::to_string(tile.displayRank) + " displays tile "
                                            + std::to_string(other) + " already");
    settings.tiles.push_back(tile);
    const auto [width, height] = settings.largestTile();
    settings.physicalWidth = width;
    settings.physicalHeight = height;
    return static_cast<int>(settings.tiles.size()) - 1;
}

template <class Number>
double numberAt(const unsigned char* at)
{
    Number number;
    std::memcpy(&number, at, sizeof number);
    return static_cast<double>(number);
}

// How to read a number of a type, and its size in bytes.
struct NumberType {
    double (*read)(const unsigned char*);
    std::size_t bytes;
};

NumberType numberType(IceTEnum type)
{
    switch (type) {
    case ICET_SHORT: return {numberAt<IceTShort>, sizeof(IceTShort)};
    case ICET_INT: return {numberAt<IceTInt>, sizeof(IceTInt)};
    case ICET_FLOAT: return {numberAt<IceTFloat>, sizeof(IceTFloat)};
    case ICET_DOUBLE: return {numberAt<IceTDouble>, sizeof(IceTDouble)};
    default: throw Error(ICET_INVALID_ENUM, "vertices of a type that is not known");
    }
}

} // namespace

extern "C" void icetResetTiles()
{
    inContext("icetResetTiles", [](IceTContextStruct& context) {
        requireNotDrawing(context);
        context.settings.tiles.clear();
        context.settings.physicalWidth = context.settings.physicalHeight = 0;
    });
}

extern "C" int icetAddTile(IceTInt x, IceTInt y, IceTSizeType width, IceTSizeType height, int displayRank)
{
    int index = -1;
    inContext("icetAddTile", [&](IceTContextStruct& context) {
        index = addTile(context, {viewport(x, y, width, height), displayRank});
    });
    return index;
}

extern "C" void icetPhysicalRenderSize(IceTInt width, IceTInt height)
{
    inContext("icetPhysicalRenderSize", [&](IceTContextStruct& context) {
        requireNotDrawing(context);
        const auto [mostWide, mostHigh] = context.settings.largestTile();
        if (width < mostWide || height < mostHigh)
            raiseWarning("icetPhysicalRenderSize", ICET_INVALID_VALUE, "it is smaller than a tile");
        context.settings.physicalWidth = width;
        context.settings.physicalHeight = height;
    });
}

extern "C" void icetBoundingVertices(IceTInt size, IceTEnum type, IceTSizeType stride, IceTSizeType count,
                                     const IceTVoid* pointer)
{
    inContext("icetBoundingVertices", [&](IceTContextStruct& context) {
        std::vector<std::array<double, 3>> vertices;
        if (count > 0) {
            const NumberType number = numberType(type);
            const std::size_t step =
                stride > 0 ? static_cast<std::size_t>(stride) : number.bytes * static_cast<std::size_t>(size);
            for (std::size_t i = 0; i < static_cast<std::size_t>(count); ++i) {
                const auto* at = static_cast<const unsigned char*>(pointer) + i * step;
                std::array<double, 3> vertex{};
                for (std::size_t c = 0; c < std::min<std::size_t>(3, static_cast<std::size_t>(size)); ++c)
                    vertex[c] =
                        number.read(at + c * number.bytes) / (size > 3 ? number.read(at + 3 * number.bytes) : 1);
                vertices.push_back(vertex);
            }
        }
        context.settings.vertices = std::move(vertices);
    });
}

extern "C" void icetBoundingBoxd(IceTDouble x0, IceTDouble x1, IceTDouble y0, IceTDouble y1, IceTDouble z0,
                                 IceTDouble z1)
{
    inContext("icetBoundingBoxd", [&](IceTContextStruct& context) {
        context.settings.vertices = {{x0, y0, z0}, {x0, y0, z1}, {x0, y1, z0}, {x0, y1, z1},
                                     {x1, y0, z0}, {x1, y0, z1}, {x1, y1, z0}, {x1, y1, z1}};
    });
}

extern "C" void icetBoundingBoxf(IceTFloat x0, IceTFloat x1, IceTFloat y0, IceTFloat y1, IceTFloat z0, IceTFloat z1)
{
    icetBoundingBoxd(x0, x1, y0, y1, z0, z1);
}

} // namespace dfb_icet
