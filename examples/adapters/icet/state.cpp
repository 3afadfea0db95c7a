// The client's settings that are single values, and queries.
#include "context.hpp"
#include "errors.hpp"

#include <cstdio>
#include <cstring>
#include <map>
#include <set>
#include <type_traits>

namespace dfb_icet {

namespace {

// The numbers of a state. A double holds all integers of IceT exactly.
using Values = std::vector<double>;

Values of(const Region& v) { return {double(v.x0), double(v.y0), double(v.width()), double(v.height())}; }

template <class Range, class Value>
Values each(const Range& range, const Value& value)
{
    Values all;
    for (const auto& element : range)
        for (const double number : Values(value(element)))
            all.push_back(number);
    return all;
}

template <class Range>
Values numbers(const Range& range)
{
    return each(range, [](const auto& number) { return Values{double(number)}; });
}

// The bytes of a colour, as they are in memory, as an integer.
double wordOf(const std::array<float, 4>& color)
{
    std::uint8_t bytes[4];
    std::transform(color.begin(), color.end(), bytes, levelOf);
    std::int32_t word = 0;
    std::memcpy(&word, bytes, sizeof word);
    return word;
}

Values placesOf(const std::vector<int>& order)
{
    Values places(order.size());
    for (std::size_t i = 0; i < order.size(); ++i)
        places[static_cast<std::size_t>(order[i])] = static_cast<double>(i);
    return places;
}

Values valuesOfTiles(const Settings& s, IceTEnum name)
{
    switch (name) {
    case ICET_NUM_TILES: return {double(s.tiles.size())};
    case ICET_TILE_VIEWPORTS: return each(s.tiles, [](const Tile& tile) { return of(tile.viewport); });
    case ICET_GLOBAL_VIEWPORT: return of(s.wall());
    case ICET_TILE_MAX_WIDTH: return {double(s.largestTile()[0])};
    case ICET_TILE_MAX_HEIGHT: return {double(s.largestTile()[1])};
    case ICET_DISPLAY_NODES: return each(s.tiles, [](const Tile& tile) { return Values{double(tile.displayRank)}; });
    default: return {};
    }
}

Values valuesOfSettings(const IceTContextStruct& c, IceTEnum name)
{
    const Settings& s = c.settings;
    if (name >= ICET_STATE_ENABLE_START && name < ICET_STATE_ENABLE_END)
        return {double(s.isEnabled(name))};
    switch (name) {
    case ICET_DIAGNOSTIC_LEVEL: return {double(s.diagnostics)};
    case ICET_RANK: return {double(c.rank())};
    case ICET_NUM_PROCESSES: return {double(c.size())};
    case ICET_PHYSICAL_RENDER_WIDTH: return {double(s.physicalWidth)};
    case ICET_PHYSICAL_RENDER_HEIGHT: return {double(s.physicalHeight)};
    case ICET_COLOR_FORMAT: return {double(s.colorFormat)};
    case ICET_DEPTH_FORMAT: return {double(s.depthFormat)};
    case ICET_TILE_DISPLAYED: return {double(s.tileOf(c.rank()))};
    case ICET_GEOMETRY_BOUNDS: return each(s.vertices, [](const auto& vertex) { return numbers(vertex); });
    case ICET_NUM_BOUNDING_VERTS: return {double(s.vertices.size())};
    case ICET_STRATEGY: return {double(s.strategy)};
    case ICET_SINGLE_IMAGE_STRATEGY: return {double(s.singleImageStrategy)};
    case ICET_COMPOSITE_MODE: return {double(s.mode)};
    case ICET_COMPOSITE_ORDER: return numbers(c.order);
    case ICET_PROCESS_ORDERS: return placesOf(c.order);
    case ICET_STRATEGY_SUPPORTS_ORDERING: return {1};
    case ICET_DATA_REPLICATION_GROUP: return numbers(c.replicas);
    case ICET_DATA_REPLICATION_GROUP_SIZE: return {double(c.replicas.size())};
    default: return valuesOfTiles(s, name);
    }
}

// The pixels that are valid in the last image: all of its tile.
Values validPixels(const IceTContextStruct& c)
{
    const int tile = c.frame.count > 0 ? c.settings.tileOf(c.rank()) : -1;
    const Region pixels = tile < 0 ? Region{} : c.settings.tiles[static_cast<std::size_t>(tile)].viewport;
    return {double(tile), double(pixels.width()) * pixels.height()};
}

Values valuesOfFrame(const IceTContextStruct& c, IceTEnum name)
{
    const Frame& f = c.frame;
    const bool blends = c.settings.mode == ICET_COMPOSITE_MODE_BLEND;
    const std::array<float, 4> drawn = blends ? std::array<float, 4>{} : f.background;
    switch (name) {
    case ICET_BACKGROUND_COLOR: return numbers(drawn);
    case ICET_BACKGROUND_COLOR_WORD: return {wordOf(drawn)};
    case ICET_TRUE_BACKGROUND_COLOR: return numbers(f.background);
    case ICET_TRUE_BACKGROUND_COLOR_WORD: return {wordOf(f.background)};
    case ICET_NEED_BACKGROUND_CORRECTION:
        return {double(blends && c.settings.isEnabled(ICET_CORRECT_COLORED_BACKGROUND)
                       && f.background != std::array<float, 4>{})};
    case ICET_FRAME_COUNT: return {double(f.count)};
    case ICET_IS_DRAWING_FRAME: return {double(c.isDrawing)};
    case ICET_PRE_RENDERED: return {double(f.isPreRendered)};
    case ICET_PROJECTION_MATRIX: return numbers(f.projection);
    case ICET_MODELVIEW_MATRIX: return numbers(f.modelview);
    case ICET_CONTAINED_VIEWPORT: return of(f.contained);
    case ICET_NEAR_DEPTH: return {f.nearest};
    case ICET_FAR_DEPTH: return {f.farthest};
    case ICET_NUM_CONTAINED_TILES: return {double(f.tiles.size())};
    case ICET_CONTAINED_TILES_LIST: return numbers(f.tiles);
    case ICET_VALID_PIXELS_TILE: return {validPixels(c)[0]};
    case ICET_VALID_PIXELS_OFFSET: return {0};
    case ICET_VALID_PIXELS_NUM: return {validPixels(c)[1]};
    case ICET_RENDER_TIME: return {f.renderSeconds};
    case ICET_COMPOSITE_TIME: return {f.totalSeconds - f.renderSeconds};
    case ICET_TOTAL_DRAW_TIME: return {f.totalSeconds};
    case ICET_BUFFER_READ_TIME:
    case ICET_BUFFER_WRITE_TIME:
    case ICET_COMPRESS_TIME:
    case ICET_INTERLACE_TIME:
    case ICET_BLEND_TIME:
    case ICET_COLLECT_TIME: return {0}; // all of it is in ICET_COMPOSITE_TIME
    case ICET_BYTES_SENT: return {double(f.bytesSent)};
    default: return {};
    }
}

// Whether a state is a list, which may be empty.
bool isList(IceTEnum name)
{
    static const std::set<IceTEnum> lists{ICET_TILE_VIEWPORTS, ICET_DISPLAY_NODES, ICET_GEOMETRY_BOUNDS,
                                          ICET_CONTAINED_TILES_LIST};
    return lists.count(name) > 0;
}

template <class Number>
void get(const char* function, IceTEnum name, Number* out)
{
    inContext(function, [&](IceTContextStruct& context) {
        Values values = valuesOfSettings(context, name);
        if (values.empty())
            values = valuesOfFrame(context, name);
        if (values.empty() && !isList(name)) {
            char text[60];
            std::snprintf(text, sizeof text, "there is no state 0x%x here", static_cast<unsigned>(name));
            throw Error(ICET_INVALID_ENUM, text);
        }
        for (std::size_t i = 0; i < values.size(); ++i)
            out[i] = static_cast<Number>(
                static_cast<std::conditional_t<std::is_integral_v<Number>, std::int64_t, double>>(values[i]));
    });
}

void set(const char* function, IceTEnum option, bool value)
{
    inContext(function, [&](IceTContextStruct& context) {
        if (option < ICET_STATE_ENABLE_START || option >= ICET_STATE_ENABLE_END)
            throw Error(ICET_INVALID_VALUE, "there is no such option");
        context.settings.enabled[option - ICET_STATE_ENABLE_START] = value;
    });
}

using Names = std::map<IceTEnum, const char*>;

const Names& strategies()
{
    static const Names names{{ICET_STRATEGY_DIRECT, "Direct"},
                             {ICET_STRATEGY_SEQUENTIAL, "Sequential"},
                             {ICET_STRATEGY_SPLIT, "Split"},
                             {ICET_STRATEGY_REDUCE, "Reduce"},
                             {ICET_STRATEGY_VTREE, "Virtual Tree"}};
    return names;
}

const Names& singleImageStrategies()
{
    static const Names names
    {
        {ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC, "Automatic"}, {ICET_SINGLE_IMAGE_STRATEGY_BSWAP, "Binary Swap"},
            {ICET_SINGLE_IMAGE_STRATEGY_TREE, "Binary Tree"}, {ICET_SINGLE_IMAGE_STRATEGY_RADIXK, "Radix-k"},
#if defined(ICET_SINGLE_IMAGE_STRATEGY_RADIXKR)
            {ICET_SINGLE_IMAGE_STRATEGY_RADIXKR, "Radix-kr"},
            {ICET_SINGLE_IMAGE_STRATEGY_BSWAP_FOLDING, "Folded Binary Swap"},
#endif
    };
    return names;
}

const char* nameOf(const char* function, IceTEnum Settings::*setting, const Names& names)
{
    const char* name = nullptr;
    inContext(function, [&](IceTContextStruct& context) {
        const auto found = names.find(context.settings.*setting);
        if (found == names.end())
            throw Error(ICET_INVALID_ENUM, "no strategy is set: call icetStrategy()");
        name = found->second;
    });
    return name;
}

// Sets one value, which must be one of `possible`.
template <class Possible>
void choose(const char* function, IceTEnum Settings::*setting, IceTEnum value, const Possible& possible)
{
    inContext(function, [&](IceTContextStruct& context) {
        requireNotDrawing(context);
        if (possible.count(value) == 0)
            throw Error(ICET_INVALID_ENUM, "there is no such value");
        context.settings.*setting = value;
    });
}

void sayThatStrategiesDoNothing()
{
    static bool isSaid = false;
    if (!isSaid)
        sayDebug("strategies have no effect: each part of a picture is composited by the rank that owns it");
    isSaid = true;
}

} // namespace

extern "C" {

void icetGetDoublev(IceTEnum name, IceTDouble* out) { get("icetGetDoublev", name, out); }
void icetGetFloatv(IceTEnum name, IceTFloat* out) { get("icetGetFloatv", name, out); }
void icetGetIntegerv(IceTEnum name, IceTInt* out) { get("icetGetIntegerv", name, out); }
void icetGetEnumv(IceTEnum name, IceTEnum* out) { get("icetGetEnumv", name, out); }
void icetGetBitFieldv(IceTEnum name, IceTBitField* out) { get("icetGetBitFieldv", name, out); }
void icetGetBooleanv(IceTEnum name, IceTBoolean* out) { get("icetGetBooleanv", name, out); }

void icetGetPointerv(IceTEnum name, IceTVoid** out)
{
    inContext("icetGetPointerv", [&](IceTContextStruct& context) {
        if (name != ICET_DRAW_FUNCTION)
            throw Error(ICET_INVALID_ENUM, "the only pointer here is ICET_DRAW_FUNCTION");
        *out = reinterpret_cast<IceTVoid*>(context.settings.draw);
    });
}

IceTBoolean icetIsEnabled(IceTEnum option)
{
    IceTBoolean isEnabled = ICET_FALSE;
    get("icetIsEnabled", option, &isEnabled);
    return isEnabled;
}

IceTDouble icetWallTime() { return MPI_Wtime(); }

const char* icetGetStrategyName() { return nameOf("icetGetStrategyName", &Settings::strategy, strategies()); }
const char* icetGetSingleImageStrategyName()
{
    return nameOf("icetGetSingleImageStrategyName", &Settings::singleImageStrategy, singleImageStrategies());
}

void icetEnable(IceTEnum option) { set("icetEnable", option, true); }
void icetDisable(IceTEnum option) { set("icetDisable", option, false); }

void icetSetColorFormat(IceTEnum format)
{
    choose(
        "icetSetColorFormat", &Settings::colorFormat, format, std::set<IceTEnum> {
            ICET_IMAGE_COLOR_NONE, ICET_IMAGE_COLOR_RGBA_UBYTE, ICET_IMAGE_COLOR_RGBA_FLOAT,
#if defined(ICET_IMAGE_COLOR_RGB_FLOAT)
                ICET_IMAGE_COLOR_RGB_FLOAT
#endif
        });
}
void icetSetDepthFormat(IceTEnum format)
{
    choose("icetSetDepthFormat", &Settings::depthFormat, format,
           std::set<IceTEnum>{ICET_IMAGE_DEPTH_NONE, ICET_IMAGE_DEPTH_FLOAT});
}
void icetCompositeMode(IceTEnum mode)
{
    choose("icetCompositeMode", &Settings::mode, mode,
           std::set<IceTEnum>{ICET_COMPOSITE_MODE_Z_BUFFER, ICET_COMPOSITE_MODE_BLEND});
}
void icetStrategy(IceTEnum strategy)
{
    choose("icetStrategy", &Settings::strategy, strategy, strategies());
    sayThatStrategiesDoNothing();
}
void icetSingleImageStrategy(IceTEnum strategy)
{
    choose("icetSingleImageStrategy", &Settings::singleImageStrategy, strategy, singleImageStrategies());
    sayThatStrategiesDoNothing();
}

void icetCompositeOrder(const IceTInt* ranks)
{
    inContext("icetCompositeOrder", [&](IceTContextStruct& context) {
        const auto size = static_cast<std::size_t>(context.size());
        std::vector<bool> isThere(size);
        for (std::size_t i = 0; i < size; ++i) {
            if (ranks[i] < 0 || ranks[i] >= context.size() || isThere[static_cast<std::size_t>(ranks[i])])
                throw Error(ICET_INVALID_VALUE, "each rank has to be in the order once");
            isThere[static_cast<std::size_t>(ranks[i])] = true;
        }
        context.order.assign(ranks, ranks + size);
    });
}

void icetDrawCallback(IceTDrawCallbackType callback)
{
    inContext("icetDrawCallback", [&](IceTContextStruct& context) { context.settings.draw = callback; });
}
}

} // namespace dfb_icet
