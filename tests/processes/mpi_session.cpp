// MpiSession at the beginning and the end of MPI. One run for each case, as MPI can be initialised only once in a
// process:
//   mpirun -n 3 mpi_session multiple     mpirun -n 3 mpi_session funneled
//   mpirun -n 3 mpi_session highest      without a level: what the MPI library has, if that is a low one, too
//   mpirun -n 3 mpi_session lower        the MPI library has a lower thread level than is asked for
//   mpirun -n 3 mpi_session finalised    the user has finalised MPI
//   mpirun -n 1 mpi_session too_early    the same while there is a framebuffer: the process ends and says why
//   mpirun -n 1 mpi_session open_frame   a framebuffer is destroyed before a frame of it: so it does then
//   mpirun -n 3 mpi_session exception    rank 1 leaves with an exception: the job ends, with code 1
//   mpirun -n 3 mpi_session exception_frame   the same between two frames
//   mpirun -n 3 mpi_session give_up      rank 1 cannot go on, and the others neither: the same
// With a file as second argument, the last three append to it what each rank caught: a launcher may drop what a rank
// prints just before its job ends. They also append "stood still" if a rank did, so that others may not have waited for
// it. Returns 0 if all is well.
#include "undisturbed.hpp"

#include <dfb/dfb.hpp>

#include <chrono>
#include <cstdio>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>

namespace {

bool lowered = false;
int failures = 0;

void check(bool fine, const char* what, const std::string& text = "")
{
    if (fine)
        return;
    ++failures;
    std::fprintf(stderr, "mpi_session: %s: %s\n", what, text.c_str());
}

bool has(const std::string& text, const char* part) { return text.find(part) != std::string::npos; }

template <class Action>
std::string transportErrorOf(const Action& action)
{
    try {
        action();
    } catch (const dfb::TransportError& e) {
        return e.what();
    } catch (const std::exception& e) {
        return std::string("another exception: ") + e.what();
    }
    return "no exception";
}

bool isFinalized()
{
    int finalized = 0;
    MPI_Finalized(&finalized);
    return finalized != 0;
}

struct Counter : dfb::TransportHandler {
    int messages = 0;
    std::string failure;
    void receive(int, dfb::Buffer&&) override { ++messages; }
    void fail(const dfb::ErrorInfo& error) override { failure = error.describe(); }
    bool failed() const override { return !failure.empty(); }
};

// Every rank sends to every other, a small message and a large one.
void exchange(const dfb::MpiSession& mpi, dfb::Progress progress)
{
    const auto pool = dfb::MemoryPool::create();
    dfb::MpiTransport transport(mpi.communicator(), pool, progress);
    check(transport.mayPoll(), "mayPoll() in the main thread");
    bool elsewhere = false;
    std::thread([&] { elsewhere = transport.mayPoll(); }).join();
    check(elsewhere == (mpi.level() > MPI_THREAD_FUNNELED), "mayPoll() in another thread");
    Counter counter;
    transport.start(counter);
    for (int other = 0; other < mpi.size(); ++other)
        for (const std::size_t byteCount : {100, 1000000}) {
            dfb::Buffer message = pool->acquire(byteCount);
            std::fill_n(message.data(), byteCount, std::byte{1});
            if (other != mpi.rank())
                transport.send(other, std::move(message));
        }
    transport.stop(true);
    check(counter.messages == 2 * (mpi.size() - 1), "messages", std::to_string(counter.messages) + counter.failure);
}

void wholeLife(int& argc, char**& argv, int level)
{
    {
        dfb::MpiSession mpi(argc, argv, level);
        int itsLevel = -1, rank = -1, size = -1;
        MPI_Query_thread(&itsLevel);
        MPI_Comm_rank(MPI_COMM_WORLD, &rank);
        MPI_Comm_size(MPI_COMM_WORLD, &size);
        check(mpi.level() >= level && mpi.level() == itsLevel, "level", std::to_string(mpi.level()));
        check(mpi.rank() == rank && mpi.size() == size, "rank and size", std::to_string(mpi.rank()));
        check(mpi.communicator() == MPI_COMM_WORLD, "communicator");
        const std::string second = transportErrorOf([&] { dfb::MpiSession again(argc, argv); });
        check(has(second, "transport failure") && has(second, "already initialised"), "a second session", second);
        check(!isFinalized(), "the second session has finalised MPI");
        exchange(mpi, level == MPI_THREAD_MULTIPLE ? dfb::Progress::Thread : dfb::Progress::Caller);
    }
    check(isFinalized(), "MPI is not finalised");
    const std::string after = transportErrorOf([&] { dfb::MpiSession again(argc, argv); });
    check(has(after, "transport failure") && has(after, "finalised"), "a session after the end", after);
}

void append(const char* file, const std::string& line)
{
    if (std::FILE* out = file ? std::fopen(file, "a") : nullptr) {
        std::fputs(line.c_str(), out);
        std::fclose(out);
    }
}

void sayCaught(const std::exception& e, const char* file)
{
    const std::string line = std::string("caught: ") + e.what() + '\n';
    std::fputs(line.c_str(), stdout);
    std::fflush(stdout);
    append(file, line);
}

void emptyFrame(dfb::DistributedFrameBuffer<dfb::AlphaBlend>& fb)
{
    dfb::FrameConfig params;
    params.declared = true;
    auto frame = fb.begin(params);
    frame.declare({});
    frame.end();
}

void finaliseTooEarly(int& argc, char**& argv)
{
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), {64, 64});
    emptyFrame(fb);
    MPI_Finalize();
}

void leaveFrameOpen(int& argc, char**& argv)
{
    dfb::MpiSession mpi(argc, argv);
    std::optional<dfb::DistributedFrameBuffer<dfb::AlphaBlend>> fb(std::in_place, mpi.communicator(),
                                                                   dfb::FrameBufferConfig{64, 64});
    auto frame = fb->begin();
    fb.reset();
}

// Between two frames: the other ranks wait for this one in the second.
void leaveFrameBuffer(int& argc, char**& argv)
{
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), {64, 64});
    emptyFrame(fb);
    if (mpi.rank() == 1 % mpi.size())
        throw std::runtime_error("rank 1 leaves");
    emptyFrame(fb);
    std::fprintf(stderr, "mpi_session: the job goes on without rank 1\n");
}

void leaveWithException(int& argc, char**& argv)
{
    dfb::MpiSession mpi(argc, argv);
    if (mpi.rank() == 1 % mpi.size())
        throw std::runtime_error("rank 1 leaves");
    std::this_thread::sleep_for(std::chrono::seconds(60));
    std::fprintf(stderr, "mpi_session: the job goes on without rank 1\n");
}

// Nobody's exception leaves the life of the session.
void giveUp(int& argc, char**& argv, const char* file)
{
    dfb::MpiSession mpi(argc, argv);
    try {
        dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), {64, 64});
        emptyFrame(fb);
        if (mpi.rank() == 1 % mpi.size())
            throw std::runtime_error("rank 1 leaves");
        emptyFrame(fb);
        std::fprintf(stderr, "mpi_session: the job goes on without rank 1\n");
    } catch (const std::exception& e) {
        mpi.giveUp();
        sayCaught(e, file);
    }
}

} // namespace

extern "C" int MPI_Init_thread(int* argc, char*** argv, int required, int* provided)
{
    return PMPI_Init_thread(argc, argv, lowered ? MPI_THREAD_FUNNELED : required, provided);
}

int main(int argc, char** argv)
{
    const std::string what = argc > 1 ? argv[1] : "multiple";
    const char* file = argc > 2 ? argv[2] : nullptr;
    if (file) {
        // Static, so that it also measures while an exit waits half a second for the other ranks.
        static const StandStill standStill([file](StandStill::Clock::duration longest) {
            if (longest >= std::chrono::milliseconds(100))
                append(file, "stood still\n");
        });
    }
    if (what == "multiple" || what == "funneled") {
        wholeLife(argc, argv, what == "multiple" ? MPI_THREAD_MULTIPLE : MPI_THREAD_FUNNELED);
    } else if (what == "highest") {
        lowered = true;
        dfb::MpiSession mpi(argc, argv);
        check(mpi.level() == MPI_THREAD_FUNNELED, "level", std::to_string(mpi.level()));
        dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), {64, 64});
        emptyFrame(fb);
    } else if (what == "lower") {
        lowered = true;
        const std::string text = transportErrorOf([&] { dfb::MpiSession mpi(argc, argv, MPI_THREAD_MULTIPLE); });
        check(has(text, "MPI_THREAD_FUNNELED at most") && has(text, "MPI_THREAD_MULTIPLE was"), "the error", text);
        check(isFinalized(), "MPI is not finalised");
    } else if (what == "finalised") {
        dfb::MpiSession mpi(argc, argv);
        MPI_Finalize();
    } else if (what == "too_early") {
        finaliseTooEarly(argc, argv);
    } else if (what == "open_frame") {
        leaveFrameOpen(argc, argv);
    } else if (what == "exception" || what == "exception_frame") {
        try {
            (what == "exception" ? leaveWithException : leaveFrameBuffer)(argc, argv);
        } catch (const std::exception& e) {
            check(!isFinalized(), "MPI is finalised");
            sayCaught(e, file);
        }
    } else if (what == "give_up") {
        giveUp(argc, argv, file);
        check(!isFinalized(), "MPI is finalised");
    } else {
        check(false, "no such run", what);
    }
    return failures;
}
