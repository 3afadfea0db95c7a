// mpirun -n 2 mpi_failing_calls: if an MPI call fails on one rank or on all, all ranks get an error with MPI's message
// and the call's name. Returns 0 if all is well.
#include <dfb/dfb.hpp>

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <future>
#include <memory>
#include <mutex>
#include <new>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace {

int failures = 0;
std::atomic<const char*> failing{nullptr}; // the next call of this name fails

bool fails(const char* name)
{
    const char* wanted = failing;
    return wanted && std::string(wanted) == name && failing.compare_exchange_strong(wanted, nullptr);
}

constexpr int code = MPI_ERR_TRUNCATE;

void check(bool fine, const std::string& what, const std::string& text)
{
    if (fine)
        return;
    ++failures;
    std::fprintf(stderr, "mpi_failing_calls: %s: %s\n", what.c_str(), text.c_str());
}

// If it takes too long ends the job.
template <class Action>
std::string transportErrorOf(const std::string& what, const Action& action)
{
    std::promise<void> done;
    std::thread watch([&what, over = done.get_future()] {
        if (over.wait_for(std::chrono::seconds(10)) == std::future_status::ready)
            return;
        std::fprintf(stderr, "mpi_failing_calls: %s: a rank waits\n", what.c_str());
        MPI_Abort(MPI_COMM_WORLD, 3);
    });
    std::string text = "no exception";
    try {
        action();
    } catch (const dfb::TransportError& e) {
        text = e.what();
    } catch (const std::exception& e) {
        text = std::string("another exception: ") + e.what();
    }
    done.set_value();
    watch.join();
    return text;
}

// `peer`: whom the call was to reach, if the error says so.
std::string expected(const std::string& call, int peer = -1)
{
    char text[MPI_MAX_ERROR_STRING];
    int length = 0;
    PMPI_Error_string(code, text, &length);
    return call + (peer < 0 ? "" : " with rank " + std::to_string(peer)) + ": "
           + std::string(text, static_cast<std::size_t>(length));
}

bool has(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
const dfb::FrameBufferConfig config{64, 64};

} // namespace

// What the library's blocks come from.
void* operator new(std::size_t byteCount, std::align_val_t alignment)
{
    const auto multiple = static_cast<std::size_t>(alignment);
    void* block =
        fails("memory") ? nullptr : std::aligned_alloc(multiple, (byteCount + multiple - 1) / multiple * multiple);
    if (!block)
        throw std::bad_alloc();
    return block;
}
void operator delete(void* block, std::align_val_t) noexcept { std::free(block); }
void operator delete(void* block, std::size_t, std::align_val_t) noexcept { std::free(block); }

#define DFB_FAILING(name, parameters, arguments) \
    extern "C" int name parameters { return fails(#name) ? code : P##name arguments; }
DFB_FAILING(MPI_Comm_idup, (MPI_Comm a, MPI_Comm* b, MPI_Request* c), (a, b, c))
DFB_FAILING(MPI_Comm_set_errhandler, (MPI_Comm a, MPI_Errhandler b), (a, b))
DFB_FAILING(MPI_Comm_get_attr, (MPI_Comm a, int b, void* c, int* d), (a, b, c, d))
DFB_FAILING(MPI_Get_processor_name, (char* a, int* b), (a, b))
DFB_FAILING(MPI_Iallgather,
            (const void* a, int b, MPI_Datatype c, void* d, int e, MPI_Datatype f, MPI_Comm g, MPI_Request* h),
            (a, b, c, d, e, f, g, h))
DFB_FAILING(MPI_Ialltoall,
            (const void* a, int b, MPI_Datatype c, void* d, int e, MPI_Datatype f, MPI_Comm g, MPI_Request* h),
            (a, b, c, d, e, f, g, h))
DFB_FAILING(MPI_Iallreduce, (const void* a, void* b, int c, MPI_Datatype d, MPI_Op e, MPI_Comm f, MPI_Request* g),
            (a, b, c, d, e, f, g))
DFB_FAILING(MPI_Irecv, (void* a, int b, MPI_Datatype c, int d, int e, MPI_Comm f, MPI_Request* g),
            (a, b, c, d, e, f, g))

std::mutex mutex;
std::set<MPI_Request> sends; // that are under way

extern "C" int MPI_Isend(const void* a, int b, MPI_Datatype c, int d, int e, MPI_Comm f, MPI_Request* request)
{
    if (fails("MPI_Isend"))
        return code;
    const std::lock_guard<std::mutex> lock(mutex);
    const int result = PMPI_Isend(a, b, c, d, e, f, request);
    sends.insert(*request);
    return result;
}

// "a send": of one that was under way its status says so.
extern "C" int MPI_Testsome(int count, MPI_Request* requests, int* outCount, int* indices, MPI_Status* statuses)
{
    if (fails("MPI_Testsome"))
        return code;
    const std::lock_guard<std::mutex> lock(mutex);
    const std::vector<MPI_Request> before(requests, requests + count);
    int result = PMPI_Testsome(count, requests, outCount, indices, statuses);
    for (int i = 0; result == MPI_SUCCESS && i < *outCount; ++i)
        if (sends.erase(before[static_cast<std::size_t>(indices[i])]) > 0 && fails("a send")) {
            for (int k = 0; k < *outCount; ++k)
                statuses[k].MPI_ERROR = k == i ? code : MPI_SUCCESS;
            result = MPI_ERR_IN_STATUS;
        }
    return result;
}

DFB_FAILING(MPI_Get_count, (const MPI_Status* a, MPI_Datatype b, int* c), (a, b, c))

int main(int argc, char** argv)
{
    const dfb::MpiSession mpi(argc, argv);
    const auto make = [&](const char* call, bool everywhere, bool shared = true) {
        const std::string what =
            std::string("made with a failing ") + call + (everywhere ? " on all ranks" : " on the last rank");
        const int last = mpi.size() - 1;
        if (everywhere || mpi.rank() == last)
            failing = call;
        const std::string text = transportErrorOf(what, [&] {
            dfb::NetworkConfig options;
            options.sharedMemory = shared;
            FrameBuffer fb(mpi.communicator(), config, options);
        });
        failing = nullptr;
        return std::make_pair(what, text);
    };
    // Without them the ranks cannot say anything to each other.
    for (const char* call : {"MPI_Comm_idup", "MPI_Iallgather", "MPI_Ialltoall", "MPI_Iallreduce"}) {
        const auto [what, text] = make(call, true);
        check(has(text, "transport failure: rank ") && has(text, expected(call)), what, text);
    }
    for (const bool everywhere : {false, true}) {
        const std::string who = "transport failure: rank " + std::to_string(everywhere ? 0 : mpi.size() - 1) + ": ";
        for (const char* call :
             {"MPI_Comm_set_errhandler", "MPI_Comm_get_attr", "MPI_Get_processor_name", "MPI_Irecv"}) {
            const auto [what, text] = make(call, everywhere);
            check(has(text, who + expected(call)), what, text);
        }
        const auto [what, text] = make("memory", everywhere, false);
        check(has(text, who + "no memory for "), what, text);
    }
    struct Failing {
        const char* what;
        const char* call;
        bool namesPeer;
    };
    for (const Failing& f : {Failing{"MPI_Irecv", "MPI_Irecv", false},
                             {"MPI_Testsome", "MPI_Testsome", false},
                             {"MPI_Get_count", "MPI_Get_count", false},
                             {"MPI_Isend", "MPI_Isend", true},
                             {"a send", "MPI_Testsome", true}}) {
        const std::string what = std::string("a frame with a failing ") + f.what;
        const std::string text = transportErrorOf(what, [&] {
            FrameBuffer fb(mpi.communicator(), config);
            for (int i = 0; i < 2; ++i) {
                dfb::FrameConfig params;
                params.declared = true;
                auto frame = fb.begin(params);
                frame.declare({});
                if (i == 0 && mpi.rank() == 0) // once, else the message that tells the others could fail, too
                    failing = f.what;
                frame.end();
            }
        });
        failing = nullptr;
        bool says = !f.namesPeer && has(text, expected(f.call));
        for (int peer = 1; f.namesPeer && peer < mpi.size(); ++peer)
            says = says || has(text, expected(f.call, peer));
        check(has(text, "transport failure: rank 0") && says, what, text);
    }
    return failures;
}
