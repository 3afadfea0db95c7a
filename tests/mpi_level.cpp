// What the constructor says of MPI that is not initialised, of a thread level that is too low, and of MPI that is over; and
// that Progress::Caller works from MPI_THREAD_FUNNELED on. MPI can be initialised once a process:
//   mpirun -n 2 mpi_level single|funneled|serialized
// Returns 0 if all is well.
#include <dfb/dfb.hpp>

#include <mpi.h>

#include <cstdio>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

namespace {

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicImageParallel<16>>;

int failures = 0;

void check(bool fine, const char* what, const std::string& text)
{
    if (fine)
        return;
    ++failures;
    std::fprintf(stderr, "mpi_level: %s: %s\n", what, text.c_str());
}

bool has(const std::string& text, const char* part) { return text.find(part) != std::string::npos; }

dfb::FrameBufferConfig configWith(dfb::Progress progress)
{
    dfb::FrameBufferConfig config;
    config.width = 50;
    config.height = 40;
    config.progress = progress;
    config.executor = std::make_shared<dfb::ThreadExecutor>(2);
    return config;
}

std::string transportErrorOf(dfb::Progress progress)
{
    try {
        FrameBuffer fb(MPI_COMM_WORLD, configWith(progress));
    } catch (const dfb::TransportError& e) {
        return e.what();
    } catch (const std::exception& e) {
        return std::string("another exception: ") + e.what();
    }
    return "no exception";
}

} // namespace

int main(int argc, char** argv)
{
    const std::string argument = argc > 1 ? argv[1] : "";
    const bool single = argument == "single";
    for (const auto progress : {dfb::Progress::Thread, dfb::Progress::Caller}) {
        const std::string text = transportErrorOf(progress);
        check(has(text, "transport failure") && has(text, "not initialised"), "before MPI_Init", text);
    }

    const int wanted = single                     ? MPI_THREAD_SINGLE
                       : argument == "serialized" ? MPI_THREAD_SERIALIZED
                                                  : MPI_THREAD_FUNNELED;
    const char* name = single                     ? "MPI_THREAD_SINGLE"
                       : argument == "serialized" ? "MPI_THREAD_SERIALIZED"
                                                  : "MPI_THREAD_FUNNELED";
    int level = 0;
    MPI_Init_thread(&argc, &argv, wanted, &level);
    if (level != wanted) {
        std::printf("mpi_level: this MPI gives another level than asked for: nothing to test\n");
        MPI_Finalize();
        return failures;
    }
    const std::string thread = transportErrorOf(dfb::Progress::Thread);
    check(has(thread, "transport failure") && has(thread, name)
              && has(thread, "MPI_THREAD_MULTIPLE"),
          "Progress::Thread", thread);
    if (single) {
        const std::string caller = transportErrorOf(dfb::Progress::Caller);
        check(has(caller, "transport failure") && has(caller, "MPI_THREAD_SINGLE") && has(caller, "MPI_THREAD_FUNNELED"),
              "Progress::Caller", caller);
    } else {
        try {
            auto config = configWith(dfb::Progress::Caller);
            config.messagePoolBytes = 1; // so that workers have to wait in setTile(), and may have to poll
            config.ownerMap = [](int, const dfb::TileLayout&, int ranks) { return ranks - 1; };
            FrameBuffer fb(MPI_COMM_WORLD, config);
            std::vector<int> mine;
            for (int tile = fb.rank(); tile < fb.layout().tileCount(); tile += fb.size())
                mine.push_back(tile);
            for (int frame = 0; frame < 3; ++frame) {
                dfb::renderImageParallel(fb, mine, [&](auto& tile) {
                    tile.fill({0, frame * 0.2f, tile.tile % 6 * 0.2f, 1});
                    fb.poll();
                });
                if (!fb.isDisplayRank())
                    continue;
                int wrong = 0;
                for (int y = 0; y < 40; ++y)
                    for (int x = 0; x < 50; ++x) {
                        const std::uint8_t* p = fb.image().rgba8() + 4 * (50 * y + x);
                        wrong += p[1] != 51 * frame || p[2] != fb.layout().tileAt(x / 16, y / 16) % 6 * 51 || p[3] != 255;
                    }
                check(wrong == 0, "pixels that are wrong", std::to_string(wrong));
            }
        } catch (const std::exception& e) {
            check(false, "Progress::Caller", e.what());
        }
    }

    MPI_Finalize();
    const std::string after = transportErrorOf(dfb::Progress::Caller);
    check(has(after, "finalised"), "after MPI_Finalize", after);
    return failures;
}
