#include <dfb/tile.hpp>

using Small = dfb::Tile<dfb::colorChannel, 8>;

#if defined(CASE_TOO_SMALL) // expect: dfb: the tile size must be 8 to 256 pixels
template struct dfb::Tile<dfb::colorChannel, 7>;
#elif defined(CASE_NO_COLOR) // expect: dfb: a tile has at least the colour channel
template struct dfb::Tile<dfb::depthChannel, 64>;
#elif defined(CASE_BY_VALUE) // expect: Tile<1, 8>
void fill(Small& tile) { [](auto t) { t.clear(); }(tile); }
#else
void fill(Small& tile) { [](auto& t) { t.clear(); }(tile); }
Small copy(const Small& tile)
{
    Small other(tile);
    return other;
}
#endif
