// Owners of tiles that change from frame to frame: set by hand, or chosen by loops from the links between nodes. In one
// process and over MPI (everywhere.hpp).

#include <dfb/image_compositor.hpp>

#include "everywhere.hpp"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace frame_cases {

template <class Op>
using OpFrameBuffer = dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport>;

// Without shared memory, each rank counts as a node of its own.
inline dfb::NetworkConfig far()
{
    dfb::NetworkConfig network;
    network.sharedMemory = false;
    return network;
}

inline std::uint64_t hashOf(const dfb::Image& image)
{
    return dfb::testing::hashOf(image.rgba32f(), 16 * image.pixelCount());
}

// ---- owners set by hand

// Tiles move to other ranks and back, with and without a shared image, while the background changes as well.
struct Moving {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene scenes[] = {scene::makeScene(3, 11), scene::makeScene(2, 5)};
        for (const bool isFar : {false, true})
            for (const int inFlight : {1, 2}) {
                dfb::FrameBufferConfig config = configOf(scenes[0], 2);
                config.framesInFlight = inFlight;
                OpFrameBuffer<dfb::BasicAlphaBlend<16>> fb(communicator, config, isFar ? far() : dfb::NetworkConfig());
                const std::string name = std::string(isFar ? "far" : "near") + ", " + std::to_string(inFlight);
                result.expect(!isFar || fb.nodeOf()[static_cast<std::size_t>(fb.rank())] == fb.rank(),
                              name + ": memory is shared");
                std::uint64_t hashes[2] = {0, 0};
                for (std::uint64_t n = 0; n < 9; ++n) {
                    const std::size_t which = n / 2 % 2;
                    const scene::Scene& s = scenes[which];
                    const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
                    dfb::DataParallelLoop loop(fb, world);
                    dfb::FrameConfig params = paramsOf(s);
                    if (n % 3 != 0)
                        params.owners = scene::anyOwners(fb.layout(), fb.size(), n % 5);
                    const auto render = [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); };
                    auto frame = loop.start(scene::FlatCamera(), render, params);
                    for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                        result.expect(frame.tileOwner(tile)
                                          == (params.owners ? (*params.owners)[static_cast<std::size_t>(tile)]
                                                            : fb.tileOwner(tile)),
                                      name + ": the owner of a tile");
                    result.expect(static_cast<std::int64_t>(frame.ownedTiles().size())
                                      == std::count_if(frame.ownedTiles().begin(), frame.ownedTiles().end(),
                                                       [&](int tile) { return frame.tileOwner(tile) == fb.rank(); }),
                                  name + ": the tiles of a rank");
                    const dfb::FrameReport report = frame.end();
                    if (!fb.isDisplayRank())
                        continue;
                    const scene::Picture picture(fb.image(), report);
                    if (hashes[which] == 0)
                        result.expect(wrongValues(picture, referenceOf(s)) == 0, name + ": values");
                    result.expect(hashes[which] == 0 || hashes[which] == picture.hash(),
                                  name + ": another image in frame " + std::to_string(n));
                    hashes[which] = picture.hash();
                }
                result.expect(result.hash == 0 || result.hash == hashes[0], name + ": another image");
                result.hash = hashes[0];
            }
        return result;
    }
};

struct Wrong {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        scene::Scene s = scene::makeScene(3, 6);
        s.timeout = std::chrono::milliseconds(5000); // nothing waits for it
        OpFrameBuffer<dfb::BasicAlphaBlend<16>> fb(communicator, configOf(s, 1));
        const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
        dfb::DataParallelLoop loop(fb, world);
        const int tiles = fb.layout().tileCount();
        const auto frame = [&](dfb::TileOwners given) {
            dfb::FrameConfig params = paramsOf(s);
            params.owners = std::move(given);
            return scene::outcomeOf([&] {
                loop.render(
                    scene::FlatCamera(), [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); }, params);
            });
        };
        const auto expect = [&](const std::string& outcome, const std::string& text) {
            result.expect(scene::has(outcome, text), outcome);
        };
        const auto list = [](std::vector<int> all) { return std::make_shared<const std::vector<int>>(std::move(all)); };
        const auto tileCount = static_cast<std::size_t>(tiles);
        expect(frame(list({0})), "FrameConfig::owners has 1 tiles, the image " + std::to_string(tiles));
        expect(frame(list(std::vector<int>(tileCount, -1))), "FrameConfig::owners gives tile 0 to rank -1 of ");
        expect(frame(list(std::vector<int>(tileCount, fb.size()))), "FrameConfig::owners gives tile 0 to rank ");
        expect(frame(scene::anyOwners(fb.layout(), fb.size(), 3)), "fine");
        const std::string outcome = frame(list(std::vector<int>(tileCount, fb.rank() == 0 ? 0 : fb.size() - 1)));
        result.expect(fb.size() == 1 ? outcome == "fine"
                                     : scene::has(outcome, "FrameConfig::owners is one with hash")
                                           || scene::has(outcome, "tile of another owner"),
                      outcome);
        expect(frame(nullptr), "fine");

        OpFrameBuffer<dfb::Progressive<dfb::AlphaBlend>> keeping(communicator, configOf(s, 1));
        dfb::FrameConfig params;
        params.owners = scene::anyOwners(keeping.layout(), keeping.size(), 1);
        expect(scene::outcomeOf([&] { keeping.begin(params).end(); }), "a tile operation that keeps state");
        return result;
    }
};

// ---- owners chosen by links

// Boxes beside and behind each other, which a camera circles.
struct ByLinks {
    static std::vector<dfb::Brick> boxes()
    {
        std::vector<dfb::Brick> all;
        for (int z = 0; z < 3; ++z)
            for (int y = 0; y < 2; ++y)
                for (int x = 0; x < 2; ++x) {
                    const auto at = [](int v) { return static_cast<float>(v); };
                    all.push_back({static_cast<std::uint32_t>(all.size()),
                                   {{at(x), at(y), at(z)}, {at(x) + 1, at(y) + 1, at(z) + 1}}});
                }
        return all;
    }

    enum class Way { Data, Mixed, Everywhere, InOrder };

    // Returns the hashes of the images on the display rank, an empty list elsewhere. `bytes`: sent in all frames.
    template <Way way>
    static std::vector<std::uint64_t> render(const Transport::Communicator& communicator, bool byLinks,
                                             std::int64_t& bytes)
    {
        using Op = std::conditional_t<way == Way::InOrder, dfb::BasicOrderedBlend<16>, dfb::BasicAlphaBlend<16>>;
        dfb::FrameBufferConfig config(256, 192, dfb::OutputFormat::RGBA32F);
        config.executor = std::make_shared<dfb::ThreadExecutor>(2);
        if (!byLinks)
            config.image.ownerMap = dfb::latticeOwner;
        OpFrameBuffer<Op> fb(communicator, config, far());
        dfb::World mine;
        const std::vector<dfb::Brick> all = boxes();
        for (std::size_t i = 0; i < all.size(); ++i) {
            const std::size_t rank = i * static_cast<std::size_t>(fb.size()) / all.size();
            if (static_cast<int>(rank) == fb.rank() || way == Way::Everywhere
                || (way == Way::Mixed && static_cast<int>(rank + 1) % fb.size() == fb.rank()))
                mine.add(all[i]);
        }
        const dfb::SharedWorld world(fb, mine);
        dfb::RoundRobinBricks owner;
        dfb::DataParallelLoop data(fb, mine, world);
        dfb::MixedParallelLoop mixed(fb, world, owner);
        dfb::OrderedLoop ordered(fb, world, owner);
        std::vector<std::uint64_t> hashes;
        bytes = 0;
        for (int n = 0; n < 4; ++n) {
            const dfb::Vec3 eye{4.0f * static_cast<float>(n) - 5, 2, 7};
            const dfb::PerspectiveCamera camera(eye, {1, 1, 1.5f}, {0, 1, 0}, 28);
            const auto shade = [&](const dfb::Brick& b, auto& tile) {
                const dfb::Region pixels = camera.project(b.bounds, 256, 192).region();
                tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                    if (!pixels.contains(x, y) || (x + y) % 7 == 0)
                        return;
                    rgba[3] = 0.25f;
                    rgba[b.id % 3] = 0.25f;
                    depth = static_cast<float>(b.id);
                });
            };
            const auto report = [&] {
                if constexpr (way == Way::Data)
                    return data.render(camera, shade);
                else if constexpr (way != Way::InOrder)
                    return mixed.render(camera, shade);
                else
                    return ordered.render(camera, dfb::visibilityOrder(world, eye), shade);
            }();
            bytes += report.bytesSent;
            if (fb.isDisplayRank())
                hashes.push_back(hashOf(fb.image()));
        }
        return hashes;
    }

    template <Way way>
    static void compare(const Transport::Communicator& communicator, Result& result, const std::string& name)
    {
        std::int64_t lattice = 0, byLinks = 0;
        const auto expected = render<way>(communicator, false, lattice);
        const auto got = render<way>(communicator, true, byLinks);
        result.expect(expected == got, name + ": another image");
        if (!got.empty())
            result.hash = scene::mix(result.hash ^ got.back());
        // `bytes` is the same on all ranks. A single rank sends nothing.
        result.expect(lattice == 0 || 10 * byLinks < 8 * lattice,
                      name + ": " + std::to_string(byLinks) + " bytes, " + std::to_string(lattice) + " by the lattice");
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        compare<Way::Data>(communicator, result, "data-parallel");
        compare<Way::Mixed>(communicator, result, "mixed");
        compare<Way::Everywhere>(communicator, result, "bricks that all ranks hold");
        compare<Way::InOrder>(communicator, result, "in order");
        return result;
    }
};

// In a frame of a part of the image, the tile-brick owner is asked about the tiles of that part only.
struct PartOfImage {
    struct Owner {
        const std::vector<dfb::TileSamples>* samples = nullptr;
        bool isRight = true;

        int operator()(const dfb::SharedBrick& brick, int tile, int /*pass*/)
        {
            isRight = isRight && (!samples || (*samples)[static_cast<std::size_t>(tile)].count > 0);
            return brick.ranks[static_cast<std::size_t>(tile) % brick.ranks.size()];
        }
    };

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        OpFrameBuffer<dfb::BasicAlphaBlend<16>> fb(communicator, {100, 80, dfb::OutputFormat::RGBA32F}, far());
        const dfb::World mine({{7, {{-1, -1, 0}, {1, 1, 1}}}}); // all ranks have it
        const dfb::SharedWorld world(fb, mine);
        Owner owner;
        dfb::MixedParallelLoop loop(fb, world, owner);
        const dfb::PerspectiveCamera camera({0, 0, 7}, {0, 0, 0}, {0, 1, 0}, 28);
        const auto fill = [](const dfb::Brick&, auto& tile) { tile.fill({0.25f, 0.5f, 0.125f, 0.5f}, 1); };
        loop.render(camera, fill);
        const auto hash = [&] { return fb.isDisplayRank() ? hashOf(fb.image()) : 0; };
        const std::uint64_t whole = hash();
        dfb::FrameConfig part;
        part.samples = dfb::samplesIn(fb.layout(), {20, 20, 60, 40});
        owner.samples = part.samples.get();
        const std::string outcome = scene::outcomeOf([&] { loop.render(camera, fill, part); });
        result.expect(outcome == "fine" && owner.isRight, "tiles without samples: " + outcome);
        result.expect(whole == hash(), "another image");
        return result;
    }
};

// Finished images that move: the owners follow from where the images of the last picture were.
struct Pictures {
    static constexpr int width = 400, height = 300;

    // Returns the hashes of the pictures. `bytes`: sent in all pictures from the second on.
    static std::vector<std::uint64_t> render(const Transport::Communicator& communicator, bool isFar, bool byLinks,
                                             Result& result, std::int64_t& bytes)
    {
        dfb::FrameBufferConfig config(width, height, dfb::OutputFormat::RGBA32F);
        config.executor = std::make_shared<dfb::ThreadExecutor>(2);
        if (!byLinks)
            config.image.ownerMap = dfb::latticeOwner;
        dfb::ImageCompositor compositor(dfb::connect<Transport>(communicator, isFar ? far() : dfb::NetworkConfig()),
                                        dfb::ImageBlend::InOrder, config);
        std::vector<std::uint64_t> hashes;
        bytes = 0;
        std::vector<float> pixels(4 * width * height);
        for (int n = 0; n < 6; ++n) {
            const int rank = compositor.rank(), x = 40 * rank % 250 + 10 * n, y = 60 * rank % 170 + 5 * n;
            for (std::size_t i = 0; i < pixels.size(); ++i)
                pixels[i] = 0.25f + static_cast<float>(scene::mix(i + static_cast<std::uint64_t>(rank)) % 64) / 256;
            dfb::InputImage image(pixels.data());
            image.valid = {x, y, x + 120, y + 110};
            if (n == 3) { // one rank fails, and the others go on
                const std::string outcome = scene::outcomeOf([&] {
                    if (rank == 0)
                        compositor.startFailed(std::make_exception_ptr(std::runtime_error("no picture")));
                    else
                        compositor.start(image, rank);
                    compositor.end();
                });
                result.expect(scene::has(outcome, "no picture"), outcome);
                continue;
            }
            if (n == 4 && rank == 0)
                image = dfb::InputImage(); // nothing to show
            const dfb::FrameReport report = compositor.composite(image, rank);
            result.expect(report.figures.empty(), "figures that nobody has asked for");
            bytes += n > 0 ? report.bytesSent : 0;
            if (compositor.isDisplayRank())
                hashes.push_back(hashOf(compositor.image()));
        }
        return hashes;
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        std::int64_t near = 0, lattice = 0, byLinks = 0;
        const auto expected = render(communicator, false, true, result, near);
        result.expect(expected == render(communicator, true, false, result, lattice), "lattice");
        result.expect(expected == render(communicator, true, true, result, byLinks), "by links");
        result.expect(lattice == 0 || 10 * byLinks < 9 * lattice,
                      std::to_string(byLinks) + " bytes, " + std::to_string(lattice) + " by the lattice");
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("Tiles may belong to other ranks in each frame, and the image is the same", "[owners]")
{
    everywhere<frame_cases::Moving>();
}

TEST_CASE("Owners of a frame that cannot be, or differ between ranks, are an error", "[owners]")
{
    everywhere<frame_cases::Wrong>();
}

TEST_CASE("Finished images on several nodes are sent to owners near them", "[owners]")
{
    everywhere<frame_cases::Pictures>();
}

TEST_CASE("A tile-brick owner is not asked about tiles that are not rendered", "[owners]")
{
    everywhere<frame_cases::PartOfImage>();
}

TEST_CASE("Owners by the links of nodes send fewer bytes for the same image", "[owners]")
{
    everywhere<frame_cases::ByLinks>();
}
