// DisplayWall: which pixels travel to which rank. 4 ranks, which are threads.
#include "board.hpp"
#include "catch.hpp"
#include "random_scene.hpp"

#include <future>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace wall_cases {

TEST_CASE("Rank 0 receives no pixel of the others' displays", "[wall]")
{
    const auto watched = std::make_shared<board::Board>();
    std::mutex mutex;
    std::map<int, std::size_t> pixelBytes; // by receiver
    watched->inspect = [&](int, int to, const board::MessageHeader& header, dfb::Buffer& message) {
        if (header.kind == dfb::detail::MessageKind::FinishedTiles
            || header.kind == dfb::detail::MessageKind::Fragment) {
            const std::lock_guard<std::mutex> lock(mutex);
            pixelBytes[to] += message.size();
        }
        return board::Board::What::Pass;
    };
    const dfb::WallLayout layout{2, 2, 64, 64, 0, 0, {0, 1, 2, 3}};
    board::runOn(watched, 4, [&](const board::BoardTransport::Communicator& communicator) {
        auto connection = dfb::connect<board::BoardTransport>(communicator);
        auto executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::RGBA8, executor);
        auto config = wall.frameBufferConfig();
        config.executor = executor;
        dfb::DistributedFrameBuffer<dfb::BasicImageParallel<32>, dfb::ToWall, board::BoardTransport> fb(
            connection, config, {&wall});
        const auto report = dfb::ImageParallelLoop(fb).render([](auto& tile) {
            const float rgba[4] = {0.5f, 0, 0, 1};
            tile.fill(rgba);
        });
        wall.finish(report.frame);
    });
    // Each rank owns 4 of 16 tiles of 4 KiB. It receives at most the 4 tiles of its display, if others own them.
    REQUIRE(pixelBytes.size() == 4);
    for (const auto& [rank, bytes] : pixelBytes) {
        INFO("rank " << rank);
        CHECK(bytes <= 4 * (4096 + 64));
    }
}

TEST_CASE("A ToWall without a wall fails the frame on every rank", "[wall]")
{
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        dfb::DistributedFrameBuffer<dfb::BasicImageParallel<32>, dfb::ToWall, dfb::InprocTransport> fb(communicator,
                                                                                                       {64, 64});
        texts[static_cast<std::size_t>(fb.rank())] =
            scene::outcomeOf([&] { dfb::ImageParallelLoop(fb).render([](auto&) {}); });
    });
    CHECK(texts[0] == texts[1]);
    CHECK(scene::has(texts[0], "FrameError: "));
    CHECK(scene::has(texts[0], "ToWall without a DisplayWall"));
}

TEST_CASE("A wall that is not finished for many frames drops the oldest, and says so", "[wall]")
{
    const dfb::WallLayout layout{1, 1, 32, 32, 0, 0, {1}};
    std::vector<std::string> dropped(2), kept(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto connection = dfb::connect<dfb::InprocTransport>(communicator);
        const auto executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::RGBA8, executor);
        dfb::DistributedFrameBuffer<dfb::BasicImageParallel<32>, dfb::ToWall, dfb::InprocTransport> fb(
            connection, wall.frameBufferConfig(), {&wall});
        for (int frame = 1; frame <= 17; ++frame)
            dfb::ImageParallelLoop(fb).render([](auto& tile) {
                const float rgba[4] = {0.5f, 0, 0, 1};
                tile.fill(rgba);
            });
        std::promise<void> isStored; // the part of the last frame, which the end of a frame does not wait for
        executor->submit([&] { isStored.set_value(); });
        isStored.get_future().wait();
        const auto me = static_cast<std::size_t>(fb.rank());
        dropped[me] = scene::outcomeOf([&] { wall.finish(1); });
        kept[me] = scene::outcomeOf([&] { wall.finish(2); });
    });
    for (const std::string& text : dropped)
        CHECK(scene::has(text, "rank 1 has dropped it, as parts of more than 16 frames came before finish()"));
    CHECK(kept == std::vector<std::string>(2, "fine"));
}

} // namespace wall_cases
