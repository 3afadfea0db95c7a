// Sets of processors, and what each of several ranks gets of them.
#include "catch.hpp"

#include <dfb/base/processors.hpp>

namespace processors_cases {

TEST_CASE("Processors: their number, whether two sets meet, and what each of several ranks gets of them")
{
    dfb::Processors low, high, both;
    CHECK(low.count() == 0);
    for (const int i : {0, 2, 63}) {
        low.add(i);
        both.add(i);
    }
    for (const int i : {64, 66, 127, 1023}) { // the same bits of other words
        high.add(i);
        both.add(i);
    }
    low.add(2);
    CHECK(low.count() == 3);
    CHECK(high.count() == 4);
    CHECK(both.count() == 7);
    CHECK_FALSE(low.meets(high));
    CHECK(low.meets(low));
    CHECK(both.meets(high));
    CHECK(low.meets(both));
    CHECK(dfb::Processors::ofThisThread().count() >= 1);
    CHECK(dfb::threadShare(64, 1) == 64);
    CHECK(dfb::threadShare(64, 4) == 16);
    CHECK(dfb::threadShare(6, 4) == 1);
    CHECK(dfb::threadShare(2, 7) == 1);
    CHECK(dfb::threadShare(2, 0) == 2);
}

} // namespace processors_cases
