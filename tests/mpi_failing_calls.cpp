// mpirun -n 2 mpi_failing_calls: what MPI says of a call that fails comes out of the library, with the call's name.
// Returns 0 if all is well.
#include <dfb/dfb.hpp>

#include <atomic>
#include <cstdio>
#include <memory>
#include <string>

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

std::string expected(const std::string& call)
{
    char text[MPI_MAX_ERROR_STRING];
    int length = 0;
    PMPI_Error_string(code, text, &length);
    return call + ": " + std::string(text, static_cast<std::size_t>(length));
}

bool has(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
const dfb::FrameBufferConfig config{64, 64};

} // namespace

#define DFB_FAILING(name, parameters, arguments) \
    extern "C" int name parameters { return fails(#name) ? code : P##name arguments; }
DFB_FAILING(MPI_Comm_idup, (MPI_Comm a, MPI_Comm* b, MPI_Request* c), (a, b, c))
DFB_FAILING(MPI_Comm_set_errhandler, (MPI_Comm a, MPI_Errhandler b), (a, b))
DFB_FAILING(MPI_Comm_get_attr, (MPI_Comm a, int b, void* c, int* d), (a, b, c, d))
DFB_FAILING(MPI_Get_processor_name, (char* a, int* b), (a, b))
DFB_FAILING(MPI_Iallgather,
            (const void* a, int b, MPI_Datatype c, void* d, int e, MPI_Datatype f, MPI_Comm g, MPI_Request* h),
            (a, b, c, d, e, f, g, h))
DFB_FAILING(MPI_Irecv, (void* a, int b, MPI_Datatype c, int d, int e, MPI_Comm f, MPI_Request* g),
            (a, b, c, d, e, f, g))
DFB_FAILING(MPI_Isend, (const void* a, int b, MPI_Datatype c, int d, int e, MPI_Comm f, MPI_Request* g),
            (a, b, c, d, e, f, g))
DFB_FAILING(MPI_Testsome, (int a, MPI_Request* b, int* c, int* d, MPI_Status* e), (a, b, c, d, e))
DFB_FAILING(MPI_Get_count, (const MPI_Status* a, MPI_Datatype b, int* c), (a, b, c))

int main(int argc, char** argv)
{
    const dfb::MpiSession mpi(argc, argv);
    for (const char* call : {"MPI_Comm_idup", "MPI_Comm_set_errhandler", "MPI_Comm_get_attr", "MPI_Get_processor_name",
                             "MPI_Iallgather", "MPI_Irecv"}) {
        failing = call;
        const std::string text = transportErrorOf([&] { FrameBuffer fb(mpi.communicator(), config); });
        check(has(text, "transport failure") && has(text, expected(call)), std::string("made with a failing ") + call,
              text);
        failing = nullptr;
    }
    for (const char* call : {"MPI_Isend", "MPI_Irecv", "MPI_Testsome", "MPI_Get_count"}) {
        const std::string text = transportErrorOf([&] {
            FrameBuffer fb(mpi.communicator(), config);
            for (int i = 0; i < 2; ++i) {
                dfb::FrameParams params;
                params.declared = true;
                auto frame = fb.begin(params);
                frame.declare({});
                if (mpi.rank() == 0)
                    failing = call; // the other rank is told
                frame.end();
            }
        });
        check(has(text, "transport failure: rank 0") && has(text, expected(call)),
              std::string("a frame with a failing ") + call, text);
        failing = nullptr;
    }
    return failures;
}
