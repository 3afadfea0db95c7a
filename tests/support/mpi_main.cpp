// Runs the tests on every rank. Rank 0 prints everything; the others leave out the lines that passing runs print. Each
// line begins with the number of its rank. The exit code is the largest of all ranks.
#include "run_tests.hpp"

#include <mpi.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <iostream>
#include <streambuf>
#include <string>
#include <thread>

namespace {

// Passes each line on at once, so that none is lost in a crash or a hang. Ranks other than 0 drop what passing runs
// print.
class RankOutput : public std::streambuf {
public:
    explicit RankOutput(int rank) : rank_(rank) {}

private:
    int_type overflow(int_type c) override
    {
        if (c == traits_type::eof())
            return traits_type::not_eof(c);
        line_ += traits_type::to_char_type(c);
        if (line_.back() == '\n') {
            if (rank_ == 0 || !isRoutine())
                std::fputs(("[rank " + std::to_string(rank_) + "] " + line_).c_str(), stdout);
            std::fflush(stdout);
            line_.clear();
        }
        return c;
    }

    bool isRoutine() const
    {
        for (const char* start : {"\n", "====", "All tests passed", "test cases:", "assertions:", "Randomness seeded",
                                  "Filters:"})
            if (line_.compare(0, std::char_traits<char>::length(start), start) == 0)
                return true;
        return false;
    }

    int rank_;
    std::string line_;
};

// Sleeps while it waits, as some MPI libraries would spin, and there may be more ranks than cores.
int largest(int value)
{
    int result = value, done = 0;
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Iallreduce(&value, &result, 1, MPI_INT, MPI_MAX, MPI_COMM_WORLD, &request);
    while (MPI_Test(&request, &done, MPI_STATUS_IGNORE), !done)
        std::this_thread::sleep_for(std::chrono::milliseconds(1));
    return result;
}

} // namespace

int main(int argc, char** argv)
{
    int level = 0, rank = 0;
    MPI_Init_thread(&argc, &argv, MPI_THREAD_MULTIPLE, &level);
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    if (level < MPI_THREAD_MULTIPLE) {
        std::fprintf(stderr, "the tests need an MPI library with MPI_THREAD_MULTIPLE\n");
        MPI_Abort(MPI_COMM_WORLD, 1);
    }
    RankOutput output(rank);
    std::streambuf* before = std::cout.rdbuf(&output);
    const int failed = runTests(argc, argv);
    std::cout.rdbuf(before);
    const int result = largest(std::min(failed, 255));
    MPI_Finalize();
    return result;
}
