// Which ranks of a node share processors, found from their CPU masks. Over MPI, on any number of ranks.
#include "catch.hpp"

#include "ranks.hpp"

#include <dfb/dfb.hpp>

#include <mpi.h>

#include <algorithm>
#include <memory>
#include <vector>

#if defined(__linux__)
#include <sched.h>

namespace processors_cases {

namespace {

std::vector<int> listOf(const cpu_set_t& mask)
{
    std::vector<int> list;
    for (int i = 0; i < CPU_SETSIZE; ++i)
        if (CPU_ISSET(static_cast<unsigned>(i), &mask))
            list.push_back(i);
    return list;
}

cpu_set_t maskOf(const std::vector<int>& processors)
{
    cpu_set_t mask;
    CPU_ZERO(&mask);
    for (const int i : processors)
        CPU_SET(static_cast<unsigned>(i), &mask);
    return mask;
}

int sharingRanks() { return dfb::MpiTransport(MPI_COMM_WORLD, dfb::MemoryPool::create(), {}).sharingRanks(); }

} // namespace

TEST_CASE("Ranks whose CPU masks meet divide the processors; those with masks of their own do not", "[processors]")
{
    const int rank = rankIn(MPI_COMM_WORLD), size = sizeOf(MPI_COMM_WORLD);
    cpu_set_t before;
    REQUIRE(sched_getaffinity(0, sizeof before, &before) == 0);
    // All ranks of these tests are on one node; a launcher may have bound them.
    std::vector<unsigned char> masks(static_cast<std::size_t>(size) * sizeof before);
    MPI_Allgather(&before, sizeof before, MPI_BYTE, masks.data(), sizeof before, MPI_BYTE, MPI_COMM_WORLD);
    std::vector<int> everybodys = listOf(before);
    for (int other = 0; other < size; ++other) {
        cpu_set_t its;
        std::copy_n(masks.data() + static_cast<std::size_t>(other) * sizeof its, sizeof its,
                    reinterpret_cast<unsigned char*>(&its));
        everybodys.erase(std::remove_if(everybodys.begin(), everybodys.end(),
                                        [&](int i) { return !CPU_ISSET(static_cast<unsigned>(i), &its); }),
                         everybodys.end());
    }
    if (everybodys.empty())
        return;
    const int processors = static_cast<int>(everybodys.size());

    const auto share = [&](const std::vector<int>& mine) {
        const cpu_set_t mask = maskOf(mine);
        CHECK(sched_setaffinity(0, sizeof mask, &mask) == 0);
    };
    share(everybodys);
    CHECK(sharingRanks() == size);
    {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = 20;
        dfb::DistributedFrameBuffer<dfb::BasicImageParallel<16>> fb(MPI_COMM_WORLD, config);
        const auto report = dfb::ImageParallelLoop(fb).render([](auto& tile) { tile.fill({0, 0, 0, 1}); });
        CHECK(report.threads == std::max(1, processors / size));
        CHECK(fb.executor().concurrency() == report.threads);
    }

    // Each rank has one processor, dealt out in turn. Ranks with the same processor share it.
    share({everybodys[static_cast<std::size_t>(rank % processors)]});
    int same = 0;
    for (int other = 0; other < size; ++other)
        same += other % processors == rank % processors;
    CHECK(sharingRanks() == same);

    // Rank 0 has all processors, each other rank has one. Rank 0 shares with all, the others only with rank 0 and with
    // ranks that have the same processor.
    share(rank == 0 ? everybodys : std::vector<int>{everybodys[static_cast<std::size_t>(rank % processors)]});
    same = 0;
    for (int other = 0; other < size; ++other)
        same += rank == 0 || other == 0 || other % processors == rank % processors;
    CHECK(sharingRanks() == same);
    CHECK(sched_setaffinity(0, sizeof before, &before) == 0);
}

} // namespace processors_cases

#endif
