// Many framebuffers and frames, one after the other: sizes, bricks, loops and communicators change, some frames are
// cancelled; memory does not grow, and no thread, file descriptor or communicator is left behind.
#include "../inproc/scene.hpp"
#include "catch.hpp"
#include "ranks.hpp"

#include <array>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <memory>
#include <string>
#include <vector>

// Sanitizers keep memory that was freed, to find who uses it.
#if defined(__SANITIZE_ADDRESS__)
#define SOAK_WITHOUT_MEMORY
#elif defined(__has_feature)
#if __has_feature(address_sanitizer)
#define SOAK_WITHOUT_MEMORY
#endif
#endif

namespace {

using scene::mix;

// Of this process.
struct Holdings {
    long threads = 0, files = 0;
    double megabytes = 0; // resident

    static Holdings now()
    {
        const auto count = [](const char* path) {
            long entries = 0;
            std::error_code error;
            for (const auto& entry : std::filesystem::directory_iterator(path, error)) {
                (void)entry;
                ++entries;
            }
            return entries;
        };
        Holdings h;
        h.threads = count("/proc/self/task");
        h.files = count("/proc/self/fd");
        long pages = 0, resident = 0;
        std::ifstream("/proc/self/statm") >> pages >> resident;
        h.megabytes = static_cast<double>(resident) * 4096 / (1 << 20);
        return h;
    }
};

// One framebuffer on a part of the ranks, and `frames` frames; what is wrong with them, or nothing.
std::string live(MPI_Comm communicator, std::uint64_t seed, int frames)
{
    const std::uint64_t h = mix(seed);
    const scene::Scene first = scene::makeScene(1 + static_cast<int>(h % 6), seed, 9 + static_cast<int>(h >> 8 & 63),
                                                5 + static_cast<int>(h >> 16 & 63));
    auto config = configOf(first, 1 + static_cast<int>(h >> 24 & 1));
    config.displayRank = static_cast<int>(h >> 32 & 255) % sizeOf(communicator);
    config.gather = (h >> 40) % 2 ? dfb::GatherMode::AtEnd : dfb::GatherMode::Batches;
    config.sharedMemory = (h >> 41) % 4 != 0;
    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>> fb(communicator, config);
    std::string wrong;
    for (int frame = 0; frame < frames; ++frame) {
        scene::Scene s = first; // other bricks, and seen from elsewhere
        s.bricks = scene::makeScene(1 + frame % 7, seed + static_cast<std::uint64_t>(frame), s.width, s.height).bricks;
        if (frame % 9 == 4) {
            auto open = fb.begin(paramsOf(s));
            if (fb.rank() == frame % fb.size())
                open.cancel();
            const std::string outcome = scene::outcomeOf([&] { open.end(); });
            if (!scene::has(outcome, "cancelled"))
                wrong += "frame " + std::to_string(frame) + ": " + outcome + "\n";
            continue;
        }
        const auto report =
            scene::renderLoop(fb, s, frame % 3 ? scene::Loop::Declared : scene::Loop::Listing3, frame % 4);
        if (fb.isDisplayRank() && frame % 16 == 1
            && wrongValues(scene::Picture(fb.image(), report), referenceOf(s)) > 0)
            wrong += "frame " + std::to_string(frame) + " is wrong\n";
    }
    return wrong;
}

// Framebuffers on parts of the ranks, until there have been so many frames.
void soak(int frames)
{
    constexpr int each = 20, warmUp = 25;
    Holdings before;
    for (int round = 0; round < frames / each; ++round) {
        const std::uint64_t h = mix(static_cast<std::uint64_t>(round));
        const int size = sizeOf(MPI_COMM_WORLD), rank = rankIn(MPI_COMM_WORLD);
        const int border = 1 + static_cast<int>(h % static_cast<std::uint64_t>(size));
        MPI_Comm part = MPI_COMM_NULL;
        MPI_Comm_split(MPI_COMM_WORLD, rank < border, rank, &part);
        INFO("round " << round << ", ranks " << (rank < border ? 0 : border) << " and up");
        REQUIRE(live(part, static_cast<std::uint64_t>(2 * round + (rank < border)), each) == "");
        MPI_Comm_free(&part);
        if (round == warmUp)
            before = Holdings::now();
    }
    const Holdings after = Holdings::now();
    CAPTURE(before.megabytes, after.megabytes);
    CHECK(after.threads == before.threads);
    CHECK(after.files == before.files);
#if !defined(SOAK_WITHOUT_MEMORY)
    CHECK(after.megabytes < 1.1 * before.megabytes + 16); // the largest of all framebuffers may come late
#endif
}

} // namespace

TEST_CASE("Framebuffers come and go on parts of the ranks, and leave nothing behind", "[soak]") { soak(800); }

TEST_CASE("20,000 frames leave nothing behind", "[soak][.stress]") { soak(20000); }
