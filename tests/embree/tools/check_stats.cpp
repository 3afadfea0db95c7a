// check_stats FILE RANKS BYTES
// Succeeds if the statistics of a run of dfb_render have RANKS ranks, if their times add up, and if no rank has read
// more than BYTES bytes of files.
#include <nlohmann/json.hpp>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <stdexcept>
#include <string>

namespace {

using nlohmann::json;

// Ranks take both times by a clock of ns, from which they are converted to double: a sum of some of them is exact to
// far less.
constexpr double exactMs = 1e-5;

void require(bool condition, const std::string& what)
{
    if (!condition)
        throw std::runtime_error(what);
}

void requireEqual(double a, double b, double tolerance, const std::string& what)
{
    require(std::abs(a - b) <= tolerance, what + ": " + std::to_string(a) + " and " + std::to_string(b));
}

// The times of `times`, a frame or the run: those of each rank, and those of the slowest.
void checkTimes(const json& times, std::size_t ranks, const std::string& where)
{
    const std::size_t slowest = times.at("slowest_rank").get<std::size_t>();
    require(slowest < ranks, where + ": there is no rank " + std::to_string(slowest));
    for (std::size_t rank = 0; rank < ranks; ++rank) {
        double sum = 0;
        for (const char* name : {"load_ms", "render_ms", "compositing_ms", "write_ms"}) {
            const std::string ofRanks = std::string(name) + "_of_ranks";
            if (!times.contains(name))
                continue; // a frame loads nothing
            require(times.at(ofRanks).size() == ranks, where + ": " + ofRanks + " has another number of ranks");
            const double value = times.at(ofRanks).at(rank).get<double>();
            require(value >= 0, where + ": " + ofRanks + " below 0");
            sum += value;
            if (rank == slowest)
                requireEqual(times.at(name).get<double>(), value, 0, where + ": " + name + " and that of the slowest");
        }
        requireEqual(times.at("total_ms_of_ranks").at(rank).get<double>(), sum, exactMs,
                     where + ": total and sum of rank " + std::to_string(rank));
        require(times.at("compositing_ms_of_ranks").at(rank) >= times.at("compositing_ms"),
                where + ": the slowest rank waits longer than another");
    }
    requireEqual(times.at("total_ms").get<double>(), times.at("total_ms_of_ranks").at(slowest).get<double>(), 0,
                 where + ": total and that of the slowest");
}

void check(const json& run, std::size_t ranks, double bytes)
{
    require(run.at("ranks").get<std::size_t>() == ranks, "another number of ranks");
    checkTimes(run, ranks, "run");
    const json& frames = run.at("frames");
    for (std::size_t i = 0; i < frames.size(); ++i)
        checkTimes(frames[i], ranks, "frame " + std::to_string(i));
    for (std::size_t rank = 0; rank < ranks; ++rank) {
        // All rendering and writing is that of a frame; there is more to wait for than the ends of frames.
        for (const char* name : {"render_ms_of_ranks", "write_ms_of_ranks", "compositing_ms_of_ranks"}) {
            double sum = 0;
            for (const json& frame : frames)
                sum += frame.at(name).at(rank).get<double>();
            const double all = run.at(name).at(rank).get<double>();
            if (std::string(name) == "compositing_ms_of_ranks")
                require(sum <= all + exactMs, "compositing of frames takes longer than all");
            else
                requireEqual(sum, all, exactMs, std::string(name) + " of the frames and of the run");
        }
        require(run.at("load_ms_of_ranks").at(rank) > 0, "nothing was loaded");
        require(run.at("render_ms_of_ranks").at(rank) > 0, "nothing was rendered");
        require(run.at("threads_of_ranks").at(rank) >= 1, "no threads");
        const double read = run.at("bytes_read_of_ranks").at(rank).get<double>();
        require(read <= bytes, "rank " + std::to_string(rank) + " has read " + std::to_string(read)
                                   + " bytes of at most " + std::to_string(bytes));
    }
    require(run.at("run_ms") <= run.at("total_ms_of_ranks").at(0), "the frames take longer than the run");
    if (run.at("options").contains("output")) // no file is written sooner
        require(run.at("write_ms_of_ranks").at(0).get<double>() > 0.01, "writing takes no time");
    require(run.at("scene").is_array() && !run.at("scene").empty(), "no scene");
    require(!run.at("version").get<std::string>().empty(), "no version");
}

} // namespace

int main(int argc, char** argv)
{
    try {
        if (argc != 4)
            throw std::runtime_error("usage: check_stats FILE RANKS BYTES");
        std::ifstream stream(argv[1]);
        const json run = json::parse(stream);
        check(run, static_cast<std::size_t>(std::atoi(argv[2])), std::atof(argv[3]));
        std::printf("total %.3f ms: load %.3f, render %.3f, compositing %.3f, write %.3f on rank %d of %s\n",
                    run.at("total_ms").get<double>(), run.at("load_ms").get<double>(),
                    run.at("render_ms").get<double>(), run.at("compositing_ms").get<double>(),
                    run.at("write_ms").get<double>(), run.at("slowest_rank").get<int>(), argv[2]);
        return 0;
    } catch (const std::exception& e) {
        std::fprintf(stderr, "check_stats: %s\n", e.what());
        return 1;
    }
}
