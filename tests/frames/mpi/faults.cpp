// Frames over MPI, on any number of ranks, with a transport that reorders, delays, repeats, loses and damages messages.
// Each frame must end in the right image or in an error of dfb.
#include "fault_frames.hpp"
#include "catch.hpp"
#include "ranks.hpp"

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <thread>
#include <vector>

namespace faults_cases {

namespace {

// Gathers the texts of all ranks without waiting inside MPI.
std::vector<std::string> gathered(const std::string& mine)
{
    constexpr int length = 1024;
    std::vector<char> all(static_cast<std::size_t>(sizeOf(MPI_COMM_WORLD)) * length), own(length);
    mine.copy(own.data(), length - 1);
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Iallgather(own.data(), length, MPI_CHAR, all.data(), length, MPI_CHAR, MPI_COMM_WORLD, &request);
    for (int done = 0; MPI_Test(&request, &done, MPI_STATUS_IGNORE), !done;)
        std::this_thread::sleep_for(std::chrono::microseconds(200));
    std::vector<std::string> texts;
    for (std::size_t i = 0; i < all.size(); i += length)
        texts.emplace_back(&all[i]);
    return texts;
}

} // namespace

TEST_CASE("Disturbed frames over MPI end in the right image or in an error of dfb", "[faults]")
{
    int frames = 0, right = 0, failed = 0;
    const auto counts = std::make_shared<dfb::testing::FaultCounts>();
    // A communicator that is not shut down in order is not freed, and MPI has only one or two thousand.
    for (std::uint64_t seed = 500; seed < 580; ++seed) {
        scene::FaultGroup group = scene::faultGroup(seed);
        group.faults.counts = counts;
        if (group.op != scene::FaultGroup::Op::Sorted)
            continue; // the other operations are tested without MPI
        const auto expected = scene::referenceOf(group.scene);
        constexpr int most = 6;
        const scene::Limit limit("seed " + std::to_string(seed));
        const auto mine = scene::faultFrames<dfb::MpiTransport>(MPI_COMM_WORLD, group, expected, most);
        for (std::size_t frame = 0; frame < most; ++frame) {
            const bool ran = frame < mine.size();
            const std::string text = !ran ? "not run" : mine[frame].wrong > 0 ? "wrong" : mine[frame].text;
            std::vector<scene::FaultEnding> ranks;
            bool allRight = true, anyError = false;
            for (const std::string& ending : gathered(text)) {
                allRight = allRight && ending == "fine";
                anyError = anyError || scene::has(ending, "Error: ");
                if (ending != "not run")
                    ranks.push_back({ending, ending == "wrong" ? std::size_t{1} : 0});
            }
            if (ranks.empty())
                break;
            INFO("seed " << seed << ", frame " << frame + 1);
            CHECK(scene::verdictOn(ranks, group.harmless) == "");
            ++frames;
            right += allRight;
            failed += anyError;
        }
    }
    std::int64_t lethal = 0, harmless = 0;
    for (const std::string& count : gathered(std::to_string(counts->dropped + counts->corrupted)))
        lethal += std::stoll(count);
    for (const std::string& count : gathered(std::to_string(counts->reordered + counts->delayed + counts->duplicated)))
        harmless += std::stoll(count);
    INFO(right << " of " << frames << " right, " << failed << " failed; " << lethal << " messages lost or damaged, "
               << harmless << " disturbed otherwise");
    CHECK(10 * right >= 3 * frames);
    if (sizeOf(MPI_COMM_WORLD) > 1) {
        CHECK(failed > 0);
        CHECK(lethal > 0);
        CHECK(harmless > 100);
    }
}

} // namespace faults_cases
