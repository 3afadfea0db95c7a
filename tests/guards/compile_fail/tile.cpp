#include <dfb/tile.hpp>

#if defined(CASE_TOO_SMALL) // expect: dfb: the tile size must be 8 to 256 pixels
template struct dfb::Tile<dfb::colorChannel, 7>;
#elif defined(CASE_NO_COLOR) // expect: dfb: a tile has at least the colour channel
template struct dfb::Tile<dfb::depthChannel, 64>;
#else
template struct dfb::Tile<dfb::colorChannel, 8>;
#endif
