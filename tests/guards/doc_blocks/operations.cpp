// The operations in docs/ keep the contract, and do what the text says.
#include "Brightest.hpp"
#include "Gamma.hpp"
#include "SortAndBlend.hpp"
#include "Strongest.hpp"
#include "context.hpp"

namespace {

int failures = 0;

void check(bool isRight, const char* what, const std::string& text = "")
{
    if (!isRight) {
        std::fprintf(stderr, "%s %s\n", what, text.c_str());
        ++failures;
    }
}

} // namespace

int main()
{
    static_assert(dfb::is_tile_op_v<doc::SortAndBlend> && dfb::is_tile_op_v<doc::Brightest> && dfb::is_tile_op_v<doc::Strongest>);
    static_assert(dfb::is_pixel_op_v<doc::Gamma>);
    const std::string blending = dfb::testing::checkTileOp<doc::SortAndBlend>();
    check(blending.empty(), "SortAndBlend:", blending);
    const std::string brightest = dfb::testing::checkTileOp<doc::Brightest>();
    check(brightest.empty(), "Brightest:", brightest);
    const std::string strongest = dfb::testing::checkTileOp<doc::Strongest>();
    check(strongest.empty(), "Strongest:", strongest);

    // "gives the same image": of random layers, some with equal depths, with a background.
    for (std::uint64_t seed = 1; seed <= 4; ++seed) {
        dfb::testing::TileInputs<64> in;
        in.passes = 2;
        in.background = {0.25f, 0.5f, 0.125f, 0.75f};
        std::uint64_t state = seed;
        const auto number = [&] {
            state = state * 6364136223846793005u + 1442695040888963407u;
            return static_cast<float>(state >> 40) * 0x1p-24f;
        };
        for (int pass = 0; pass < in.passes; ++pass)
            for (std::uint32_t source = 0; source < 6; ++source)
                in.add(pass, source).forEachPixel([&](int, int, float* rgba, float& depth) {
                    rgba[3] = number();
                    for (int c = 0; c < 3; ++c)
                        rgba[c] = rgba[3] * number();
                    depth = std::floor(8 * number());
                });
        const auto format = dfb::OutputFormat::RGBA8;
        const auto ours = dfb::testing::runTileOp<doc::SortAndBlend>(in, in.order(), format, false);
        const auto library = dfb::testing::runTileOp<dfb::AlphaBlend>(in, in.order(), format, false);
        check(!ours.color.empty() && ours.color == library.color, "SortAndBlend differs from AlphaBlend");
    }

    float color[8] = {0.25f, 0.5f, 1, 0.5f, 0, 0.0625f, 0.75f, 1};
    dfb::PixelTile tile;
    tile.region = {0, 0, 2, 1};
    tile.color = color;
    doc::Gamma gamma;
    gamma.newFrame({0.5f});
    gamma.process(tile);
    check(color[0] == 0.5f && color[2] == 1 && color[3] == 0.5f && color[5] == 0.25f && color[7] == 1, "Gamma");
    return failures;
}
