// HiddenTiles: which inputs cannot be seen, and which wait for a message, in whatever order messages arrive.
#include "catch.hpp"

#include <dfb/frame/hidden_tiles.hpp>

namespace hidden_tiles_cases {

using dfb::detail::HiddenTiles;
using Word = dfb::detail::HidingWord;

TEST_CASE("The first generation that is hidden counts, until the next frame", "[hidden_tiles]")
{
    HiddenTiles tiles;
    tiles.newFrame(3);
    CHECK(tiles.from(1) > 65535);
    tiles.take({1, 5, Word::Hides});
    tiles.take({1, 3, Word::Hides});
    tiles.take({1, 4, Word::Hides});
    CHECK(tiles.from(1) == 3);
    CHECK(tiles.from(0) > 65535);
    tiles.newFrame(3);
    CHECK(tiles.from(1) > 65535);
}

TEST_CASE("An input waits for the word of those in front of it, and of no others", "[hidden_tiles]")
{
    HiddenTiles tiles;
    tiles.newFrame(2);
    CHECK_FALSE(tiles.isUndecided(0, 1));
    tiles.take({0, 2, Word::MayHide});
    tiles.take({0, 4, Word::MayHide});
    CHECK_FALSE(tiles.isUndecided(0, 1)); // it is in front of both
    CHECK(tiles.isUndecided(0, 2));
    CHECK(tiles.isUndecided(0, 4));
    CHECK_FALSE(tiles.isUndecided(1, 4)); // another tile
    tiles.take({0, 2, Word::Shows});
    CHECK_FALSE(tiles.isUndecided(0, 3));
    CHECK(tiles.isUndecided(0, 4));
    tiles.take({0, 3, Word::Hides}); // hidden by one that had not sent MayHide
    CHECK_FALSE(tiles.isUndecided(0, 4));
    CHECK(tiles.from(0) == 3);
    tiles.newFrame(2);
    CHECK_FALSE(tiles.isUndecided(0, 4));
}

TEST_CASE("A word that overtakes its announcement leaves nothing to wait for", "[hidden_tiles]")
{
    HiddenTiles tiles;
    tiles.newFrame(1);
    tiles.take({0, 1, Word::Shows});
    tiles.take({0, 1, Word::MayHide});
    CHECK_FALSE(tiles.isUndecided(0, 1));
    tiles.take({0, 1, Word::MayHide}); // so another message is awaited
    CHECK(tiles.isUndecided(0, 1));
}

} // namespace hidden_tiles_cases
