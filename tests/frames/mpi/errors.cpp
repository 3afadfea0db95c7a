// Errors over MPI, on any number of ranks: the same error on every rank, no hang, and the next frame is right.
#include "catch.hpp"
#include "random_scene.hpp"
#include "ranks.hpp"

#include <algorithm>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace errors_cases {

namespace {

using scene::has;
using scene::Loop;
using scene::outcomeOf;
using scene::Scene;

// Renders a good frame and returns whether its image is right.
template <class Fb>
bool goodFrame(Fb& fb, const Scene& s)
{
    const auto report = scene::renderLoop(fb, s, Loop::Declared);
    return !fb.isDisplayRank() || scene::wrongValues(scene::Picture(fb.image(), report), scene::referenceOf(s)) == 0;
}

// The ranks that in turn make the mistake: the first, one in the middle, the last.
std::vector<int> culprits()
{
    const int size = sizeOf(MPI_COMM_WORLD);
    std::vector<int> ranks{0};
    for (const int rank : {size / 2, size - 1})
        if (rank != ranks.back())
            ranks.push_back(rank);
    return ranks;
}

} // namespace

TEST_CASE("An intercommunicator is refused", "[errors]")
{
    const int rank = rankIn(MPI_COMM_WORLD);
    if (sizeOf(MPI_COMM_WORLD) == 1)
        return;
    MPI_Comm group = MPI_COMM_NULL, both = MPI_COMM_NULL;
    MPI_Comm_split(MPI_COMM_WORLD, rank == 0 ? 0 : 1, rank, &group);
    MPI_Intercomm_create(group, 0, MPI_COMM_WORLD, rank == 0 ? 1 : 0, 0, &both);
    const std::string text = outcomeOf([&] { dfb::connect(both); });
    INFO(text);
    CHECK((has(text, "InvalidArgument") && has(text, "MPI_Intercomm_merge")));
    MPI_Comm_free(&both);
    MPI_Comm_free(&group);
}

TEST_CASE("Inputs that contradict the tree fail the frame on every rank, and are named", "[errors]")
{
    const Scene s = scene::makeScene(6);
    auto config = configOf(s);
    const int size = sizeOf(MPI_COMM_WORLD), owner = size - 1;
    config.image.ownerMap = [](int, const dfb::TileLayout&, int ranks) { return ranks - 1; };
    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>> fb(MPI_COMM_WORLD, config);
    struct Input {
        int generation;
        std::uint32_t source;
        int children;
    };
    struct Mistake {
        std::vector<Input> inputs;
        std::vector<std::string> parts;
    };
    const std::vector<Mistake> mistakes{
        {{{1, 50, 0}, {1, 51, 0}, {1, 52, 0}, {0, 9, 2}}, {"too many inputs", "generation 1", "expected 2, got 3"}},
        {{{1, 50, 0}, {1, 50, 0}, {0, 9, 2}}, {"duplicate input", "generation 1, source 50", "expected 1, got 2"}},
        {{{2, 50, 0}, {1, 51, 0}, {0, 9, 1}}, {"unannounced input", "generation 2, source 50", "expected 0, got 1"}}};
    for (const Mistake& mistake : mistakes)
        for (const int culprit : culprits()) {
            const std::string text = outcomeOf([&] {
                auto frame = fb.begin();
                const auto tile = std::make_unique<decltype(fb)::Tile>();
                // Only tile 5 gets inputs. The other tiles stay incomplete, so the frame does not end before the
                // mistake arrives.
                if (fb.rank() == culprit)
                    for (const Input& input : mistake.inputs) {
                        frame.start(*tile, 5);
                        tile->generation = input.generation;
                        tile->source = input.source;
                        tile->children = input.children;
                        frame.setTile(*tile);
                    }
                frame.end();
            });
            const bool same = sameEverywhere(text);
            const bool good = goodFrame(fb, s);
            INFO("rank " << culprit << ": " << text);
            CHECK(same);
            CHECK(has(text, "rank " + std::to_string(owner)));
            CHECK(has(text, "tile 5"));
            for (const std::string& part : mistake.parts)
                CHECK(has(text, part));
            CHECK(good);
        }
}

TEST_CASE("A wrong or differing configuration is refused on every rank", "[errors]")
{
    const Scene s = scene::makeScene(3);
    const std::vector<std::function<void(dfb::FrameBufferConfig&)>> changes{
        [](dfb::FrameBufferConfig& c) { c.image.width = 0; },
        [](dfb::FrameBufferConfig& c) { c.image.displayRank = sizeOf(MPI_COMM_WORLD); },
        [](dfb::FrameBufferConfig& c) { c.image.height += sizeOf(MPI_COMM_WORLD) > 1 ? rankIn(MPI_COMM_WORLD) : 70000; },
        [](dfb::FrameBufferConfig& c) {
            c.image.width = rankIn(MPI_COMM_WORLD) == sizeOf(MPI_COMM_WORLD) - 1 ? -1 : c.image.width;
        }};
    for (const auto& change : changes) {
        auto config = configOf(s);
        change(config);
        const std::string text =
            outcomeOf([&] { dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>> fb(MPI_COMM_WORLD, config); });
        const bool same = sameEverywhere(text);
        INFO(text);
        CHECK(same);
        CHECK(has(text, "InvalidArgument"));
    }
    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>> fb(MPI_COMM_WORLD, configOf(s));
    CHECK(goodFrame(fb, s));
}

TEST_CASE("A tile that cannot be right is refused at once", "[errors]")
{
    const Scene s = scene::makeScene(3);
    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>> fb(MPI_COMM_WORLD, configOf(s));
    std::vector<std::string> texts;
    {
        auto frame = fb.begin(scene::paramsOf(s));
        const auto tile = std::make_unique<decltype(fb)::Tile>();
        const auto tryTile = [&](const std::function<void(dfb::TileHeader&)>& change) {
            frame.start(*tile, 3);
            change(*tile);
            texts.push_back(outcomeOf([&] { frame.setTile(*tile); }));
        };
        tryTile([](dfb::TileHeader& t) { t.frame -= 1; });
        tryTile([](dfb::TileHeader& t) { t.region.y1 += 1; });
        tryTile([](dfb::TileHeader& t) { t.tile = 28; });
        tryTile([](dfb::TileHeader& t) { t.children = -1; });
        for (int index : fb.ownedTiles()) {
            frame.start(*tile, index);
            frame.setTile(*tile);
        }
        frame.end();
    }
    for (const std::string& text : texts)
        CHECK(has(text, "InvalidArgument"));
    CHECK(goodFrame(fb, s));
}

TEST_CASE("A rank that is built for other tiles or operations is refused on every rank", "[mpi]")
{
    using Blend = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>>;
    using Smaller = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<8>>;
    using Nearest = dfb::DistributedFrameBuffer<dfb::BasicDepthComposite<16>>;
    const int rank = rankIn(MPI_COMM_WORLD), size = sizeOf(MPI_COMM_WORLD);
    if (size == 1)
        return;
    const auto config = scene::configOf(scene::makeScene(1));
    for (int odd = 0; odd < size; odd += std::max(1, size - 1))
        for (const bool smaller : {true, false}) {
            const std::string text = outcomeOf([&] {
                if (rank != odd)
                    Blend fb(MPI_COMM_WORLD, config);
                else if (smaller)
                    Smaller fb(MPI_COMM_WORLD, config);
                else
                    Nearest fb(MPI_COMM_WORLD, config);
            });
            INFO("rank " << odd << ": " << text);
            CHECK(sameEverywhere(text));
            CHECK(has(text, "InvalidArgument"));
            CHECK(has(text, smaller ? "the size of tiles is " : "dfb::BasicDepthComposite<16"));
        }
    Blend fb(MPI_COMM_WORLD, config); // nothing is left of those
}

} // namespace errors_cases
