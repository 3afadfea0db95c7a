// Inputs that an opaque input hides: owners do not wait for them, and ranks that have heard of it do not send them. In
// one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <array>
#include <atomic>
#include <chrono>
#include <functional>
#include <memory>
#include <string>
#include <thread>
#include <utility>

namespace frame_cases {

struct Hidden {
    using Fb = dfb::DistributedFrameBuffer<dfb::BasicOrderedBlend<16>, dfb::NoPixelOp, Transport>;

    static dfb::FrameBufferConfig config(bool depth)
    {
        dfb::FrameBufferConfig c;
        c.image.width = 90;
        c.image.height = 70;
        c.image.format = dfb::OutputFormat::RGBA32F;
        c.image.depth = depth;
        c.executor = std::make_shared<dfb::ThreadExecutor>(2);
        return c;
    }

    // The colour of brick `i` at a pixel. With `isOpaque`, the left part of brick 2 is opaque.
    static std::array<float, 4> colorOf(std::uint32_t i, int x, int y, bool isOpaque)
    {
        const float alpha = isOpaque && i == 2 && x < 55 ? 1.0f : 0.25f + 0.0625f * static_cast<float>((x + y) % 4);
        return {alpha * 0.125f * static_cast<float>(i), alpha * 0.25f, alpha * static_cast<float>(x % 3) / 4, alpha};
    }

    // 6 bricks, each over the whole image, rendered by OrderedLoop.
    static void renderAll(const Transport::Communicator& communicator, Result& result)
    {
        auto patient = config(false);
        patient.quiet = std::chrono::seconds(60); // who waits for a word that is not given waits so long
        Fb fb(communicator, patient);
        dfb::World mine;
        for (std::uint32_t i = 0; i < 6; ++i)
            if (static_cast<int>(i) % fb.size() == fb.rank())
                mine.add({i, {{0, 0, static_cast<float>(i)}, {90, 70, static_cast<float>(i + 1)}}});
        const dfb::SharedWorld world(fb, mine);
        std::vector<int> order(6);
        for (std::size_t place = 0; place < 6; ++place)
            order[world.bricks()[place].id] = static_cast<int>(place);
        dfb::RoundRobinBricks owner;
        dfb::OrderedLoop loop(fb, world, owner);
        std::atomic<int> rendered{0};
        bool isOpaque = true;
        std::uint64_t hashes[2] = {};
        const auto render = [&](const dfb::Brick& b, auto& tile) {
            ++rendered;
            tile.forEachPixel([&](int x, int y, float* rgba) {
                const auto c = colorOf(b.id, x, y, isOpaque);
                std::copy(c.begin(), c.end(), rgba);
            });
        };
        for (int frame = 0; frame < 8; ++frame) {
            rendered = 0;
            isOpaque = frame != 4 && frame != 5; // what was hidden shows, and is hidden again
            const auto start = std::chrono::steady_clock::now();
            loop.render(scene::FlatCamera(), order, render);
            result.expect(std::chrono::steady_clock::now() - start < std::chrono::seconds(30), "no word");
            const std::int64_t all = fb.allReduce({rendered}, Fb::Reduce::Sum)[0];
            // On a single rank, one worker at most renders a tile's brick while the other worker renders what hides it.
            const int tiles = fb.layout().tileCount();
            result.expect(all >= 3 * tiles && all <= 6 * tiles, std::to_string(all) + " tiles rendered");
            result.expect(isOpaque || all == 6 * tiles, "a tile that shows was left out");
            result.expect(!isOpaque || fb.size() > 1 || all < 6 * tiles,
                          "all tiles rendered, also those that are hidden");
            if (!fb.isDisplayRank())
                continue;
            std::size_t wrong = 0;
            for (int y = 0; y < 70; ++y)
                for (int x = 0; x < 90; ++x) {
                    std::vector<dfb::testing::Sample> samples;
                    for (std::uint32_t i = 0; i < 6; ++i)
                        samples.push_back({colorOf(i, x, y, isOpaque)});
                    const auto exact = dfb::testing::compositeInOrder(samples, {});
                    for (std::size_t c = 0; c < 4; ++c)
                        wrong += dfb::testing::ulpsBetween(
                                     fb.image().rgba32f()[4 * static_cast<std::size_t>(y * 90 + x) + c],
                                     dfb::testing::toFloat(exact.rgba[c]))
                                 > 1;
                }
            result.expect(wrong == 0, std::to_string(wrong) + " values are wrong");
            const std::uint64_t hash = dfb::testing::hashOf(fb.image().bytes(), fb.image().pixelCount() * 16);
            result.expect(hashes[isOpaque] == 0 || hashes[isOpaque] == hash, "another image");
            hashes[isOpaque] = hash;
            result.hash = hashes[0] * 31 + hashes[1];
        }
    }

    // By hand: rank 0 hides the input of the next rank, which waits until it is told and then sends nothing that
    // counts.
    static void byHand(const Transport::Communicator& communicator, Result& result)
    {
        Fb fb(communicator, config(false));
        const int other = 1 % fb.size();
        for (int round = 0; round < 3; ++round) {
            auto frame = fb.begin();
            const auto tile = std::make_unique<Fb::Tile>();
            for (const auto& [t, generation] : {std::pair{0, 0}, {-1, 1}, {fb.layout().tileCount(), 1}}) {
                const std::string text = scene::outcomeOf([&, t = t, g = generation] { frame.hide(t, g, fb.rank()); });
                result.expect(scene::has(text, "InvalidArgument"), "what is no input is hidden: " + text);
            }
            for (int t = 0; t < fb.layout().tileCount() && fb.rank() == 0; ++t) {
                result.expect(fb.size() == 1 || !frame.isHidden(t, 1), "a tile is hidden from the last frame");
                frame.start(*tile, t);
                tile->fill({0.5f, 0.25f, 0.125f, 1.0f});
                tile->children = 1;
                frame.setTile(*tile);
                result.expect(frame.hidesRest(*tile), "an opaque tile hides nothing");
                frame.hide(t, 1, other);
                tile->pixel(3, 3)[3] = 0.875f;
                result.expect(!frame.hidesRest(*tile), "a tile that is not opaque hides something");
            }
            for (int t = 0; t < fb.layout().tileCount() && fb.rank() == other; ++t) {
                const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(60);
                while (!frame.isHidden(t, 1) && std::chrono::steady_clock::now() < end)
                    std::this_thread::yield();
                result.expect(frame.isHidden(t, 1) && frame.isHidden(t, 7) && !frame.isHidden(t, 0), "no word");
                frame.start(*tile, t);
                tile->fill({1, 1, 1, 1});
                tile->generation = 1;
                tile->children = 5; // that would never come
                if (t % 2 == 0)
                    frame.setTile(*tile);
            }
            const dfb::FrameReport report = frame.end();
            result.expect(report.lateMessages == 0, "what is hidden was sent");
            for (std::size_t i = 0; fb.isDisplayRank() && i < fb.image().pixelCount(); ++i)
                result.expect(fb.image().rgba32f()[4 * i] == 0.5f, "another colour");
        }
    }

    // Rank 0 says that it may hide the inputs of the next rank. Then it hides them in some tiles and shows them in
    // others, or says nothing more; in that case the next rank waits no longer than config.quiet.
    static void waiting(const Transport::Communicator& communicator, Result& result)
    {
        auto c = config(false);
        c.quiet = std::chrono::milliseconds(20);
        Fb fb(communicator, c);
        const int other = 1 % fb.size(), tiles = fb.layout().tileCount();
        for (const bool isSilent : {false, true}) {
            auto frame = fb.begin();
            const auto tile = std::make_unique<Fb::Tile>();
            const auto set = [&](int t, int generation, float alpha) {
                frame.start(*tile, t);
                tile->fill({0.25f, 0.25f, 0.25f, alpha});
                tile->generation = generation;
                tile->children = generation == 0;
                frame.setTile(*tile);
            };
            if (fb.rank() == 0)
                for (int t = 0; t < tiles; ++t)
                    frame.mayHide(t, 1, other);
            for (int t = 0; t < tiles && fb.rank() == 0; ++t) {
                set(t, 0, t % 2 == 0 && !isSilent ? 1.0f : 0.5f);
                if (isSilent)
                    continue;
                if (frame.hidesRest(*tile))
                    frame.hide(t, 1, other);
                else
                    frame.show(t, 1, other);
            }
            // Waits on this rank's thread, for at most a minute.
            const auto wait = [&](const std::function<bool()>& done) {
                for (int tries = 0; tries < 3000 && !frame.waitForWord(done); ++tries) {
                }
                return done();
            };
            for (int t = 0; t < tiles && fb.rank() == other; ++t) {
                if (isSilent) {
                    result.expect(wait([&] { return frame.isUndecided(t, 1); }), "an input that waits for nothing");
                    result.expect(!frame.isUndecided(t, 0), "the front waits");
                    result.expect(!frame.waitForWord([&] { return !frame.isUndecided(t, 1); }), "word of nobody");
                    set(t, 1, 0.5f);
                } else if (t % 2 == 0) {
                    result.expect(wait([&] { return frame.isHidden(t, 1); }), "a tile that is hidden shows");
                } else {
                    result.expect(wait([&] { return !frame.isUndecided(t, 1); }), "no word");
                    result.expect(!frame.isHidden(t, 1), "a tile that shows is hidden");
                    set(t, 1, 0.5f);
                }
            }
            frame.end();
        }
    }

    // If the image has depths, hidden inputs count as well.
    static void withDepth(const Transport::Communicator& communicator, Result& result)
    {
        Fb fb(communicator, config(true));
        auto frame = fb.begin();
        const auto tile = std::make_unique<Fb::Tile>();
        for (const int t : fb.ownedTiles()) {
            frame.start(*tile, t);
            tile->fill({0.5f, 0.25f, 0.125f, 1.0f});
            frame.setTile(*tile);
            result.expect(!frame.hidesRest(*tile), "depths count for nothing");
        }
        result.expect(scene::has(scene::outcomeOf([&] { frame.hide(0, 1, 0); }), "InvalidArgument"),
                      "hide() with depths");
        frame.end();
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        renderAll(communicator, result);
        byHand(communicator, result);
        waiting(communicator, result);
        withDepth(communicator, result);
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("What an opaque tile hides need not be sent, and does not show", "[hidden]")
{
    everywhere<frame_cases::Hidden>();
}
