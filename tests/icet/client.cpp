// A client that links libdfb_icet in place of IceT. Checks the errors that it gets:
//   mpirun -n 3 test_icet_client errors      wrong calls, on one rank or on all
//   mpirun -n 3 test_icet_client moves       tiles that change their size and rank from frame to frame
//   mpirun -n 2 test_icet_client differs     ranks that have set different tiles
//   mpirun -n 3 test_icet_client absent      a rank that does not call (DFB_ICET_TIMEOUT=4); first: not even once
//   mpirun -n 3 test_icet_client stopped     a rank that hangs and continues later (DFB_ICET_TIMEOUT=4)
//   mpirun -n 3 test_icet_client killed      a rank that dies; prints "all were told", then the launcher may end the
//                                            job
//   mpirun -n 2 test_icet_client finalised   a context that outlives MPI
// The second word "multiple" initialises MPI at MPI_THREAD_MULTIPLE, otherwise at MPI_THREAD_SINGLE. Returns 0 if all
// is well.
#include <IceT.h>
#include <mpi.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <stdexcept>
#include <string>
#include <vector>

#include <sys/prctl.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

extern "C" {
IceTCommunicator icetCreateMPICommunicator(MPI_Comm comm);
void icetDestroyMPICommunicator(IceTCommunicator communicator);
void icetGLInitialize();
IceTBoolean icetGLIsInitialized();
}

namespace {

int rank = 0, ranks = 1, failures = 0;

void expect(bool isFine, const std::string& what)
{
    if (isFine)
        return;
    ++failures;
    std::fprintf(stderr, "icet client, rank %d of %d: %s\n", rank, ranks, what.c_str());
}

void expectError(IceTEnum type, const std::string& what)
{
    const IceTEnum error = icetGetError();
    expect(error == type, what + ": error " + std::to_string(error) + " instead of " + std::to_string(type));
}

constexpr IceTDouble identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
constexpr IceTFloat black[4] = {0, 0, 0, 0};

IceTContext makeContext()
{
    IceTCommunicator communicator = icetCreateMPICommunicator(MPI_COMM_WORLD);
    expect(communicator->Comm_rank(communicator) == rank && communicator->Comm_size(communicator) == ranks,
           "the communicator is another");
    IceTContext context = icetCreateContext(communicator);
    icetDestroyMPICommunicator(communicator);
    icetDiagnostics(ICET_DIAG_OFF);
    expect(!icetGetStrategyName(), "the name of no strategy");
    expectError(ICET_INVALID_ENUM, "the name of no strategy");
    icetStrategy(ICET_STRATEGY_REDUCE);
    return context;
}

// A picture whose columns from `rank` on have the rank's colour. Ranks with higher numbers are nearer.
struct Picture {
    Picture(int pictureWidth, int pictureHeight) : width(pictureWidth), height(pictureHeight)
    {
        for (int i = 0; i < width * height; ++i) {
            const bool isThere = i % width >= rank;
            colors.push_back(isThere ? 0xff000000u + static_cast<std::uint32_t>(rank) : 0);
            depths.push_back(isThere ? 0.5f - 0.1f * static_cast<float>(rank) : 1.0f);
        }
    }

    IceTImage composite() const
    {
        return icetCompositeImage(colors.data(), depths.data(), nullptr, identity, identity, black);
    }
    void check(IceTImage image, int display, const std::string& what) const
    {
        expectError(ICET_NO_ERROR, what);
        expect(icetImageIsNull(image) == (rank != display), what + ": an image on a wrong rank");
        if (icetImageIsNull(image))
            return;
        expect(icetImageGetWidth(image) == width && icetImageGetHeight(image) == height, what + ": the size");
        const auto* words = reinterpret_cast<const std::uint32_t*>(icetImageGetColorcub(image));
        for (int i = 0; i < width * height; ++i)
            if (words[i] != 0xff000000u + static_cast<std::uint32_t>(std::min(i % width, ranks - 1))) {
                expect(false, what + ": pixel " + std::to_string(i));
                return;
            }
    }

    int width, height;
    std::vector<std::uint32_t> colors;
    std::vector<float> depths;
};

void expectGoodFrame(const std::string& what)
{
    const Picture picture(40, 30);
    picture.check(picture.composite(), 0, "a frame after " + what);
}

// ---- what is tried

void tryWithoutContext()
{
    expect(icetGetContext() == nullptr, "there is a context");
    expect(icetAddTile(0, 0, 4, 4, 0) == -1, "a tile without a context");
    expectError(ICET_INVALID_OPERATION, "a tile without a context");
    IceTCommunicatorStruct own{};
    own.Duplicate = [](IceTCommunicator self) { return self; };
    expect(icetCreateContext(&own) == nullptr, "a context of a client's own communicator");
    expectError(ICET_INVALID_OPERATION, "a client's own communicator");
    expect(icetCreateContext(nullptr) == nullptr, "a context of no communicator");
    expectError(ICET_INVALID_VALUE, "no communicator");
    IceTCommunicator none = icetCreateMPICommunicator(MPI_COMM_NULL); // as on ranks outside of a part of the job
    expect(none == nullptr, "a communicator of MPI_COMM_NULL");
    icetDestroyMPICommunicator(none);
    expectError(ICET_NO_ERROR, "MPI_COMM_NULL");
}

void trySettings()
{
    expect(!icetGLIsInitialized(), "GL before icetGLInitialize()");
    icetGLInitialize();
    expect(icetGLIsInitialized(), "no GL after icetGLInitialize()");
    expect(icetAddTile(0, 0, 0, 4, 0) == -1, "a tile without pixels");
    expectError(ICET_INVALID_VALUE, "a tile without pixels");
    expect(icetAddTile(0, 0, 4, 4, ranks) == -1, "a tile of a rank that is not there");
    expectError(ICET_INVALID_VALUE, "a tile of a rank that is not there");
    expect(icetAddTile(0, 0, 40, 30, 0) == 0, "the first tile");
    expect(icetAddTile(4, 0, 4, 4, 0) == -1, "a second tile of a rank");
    expectError(ICET_INVALID_VALUE, "a second tile of a rank");
    icetPhysicalRenderSize(3, 3);
    expectError(ICET_INVALID_VALUE, "a render size below that of a tile");
    icetPhysicalRenderSize(40, 30);
    for (const auto& [set, value] : std::vector<std::pair<void (*)(IceTEnum), IceTEnum>>{{icetStrategy, 7},
                                                                                         {icetSingleImageStrategy, 7},
                                                                                         {icetCompositeMode, 7},
                                                                                         {icetSetColorFormat, 7},
                                                                                         {icetSetDepthFormat, 7}}) {
        set(value);
        expectError(ICET_INVALID_ENUM, "an unknown value");
    }
    icetEnable(7);
    expectError(ICET_INVALID_VALUE, "an unknown option");
    icetDisable(7);
    expectError(ICET_INVALID_VALUE, "an unknown option");
    for (const bool isOn : {true, false}) {
        (isOn ? icetEnable : icetDisable)(ICET_ORDERED_COMPOSITE);
        IceTBoolean state = !isOn;
        icetGetBooleanv(ICET_ORDERED_COMPOSITE, &state);
        expect(state == isOn, "an option that was set");
    }
    expect(icetGetStrategyName() == std::string("Reduce"), "the name of a strategy");
    const std::vector<IceTInt> twice{rank, rank}, self{rank}, none{ranks};
    icetDataReplicationGroup(2, twice.data());
    expectError(ICET_INVALID_VALUE, "a group that has a rank twice");
    icetDataReplicationGroup(1, none.data());
    expectError(ICET_INVALID_VALUE, "a group without this rank");
    icetDataReplicationGroup(1, self.data());
    const double before = icetWallTime();
    expect(icetWallTime() >= before, "a clock that goes forward");
    IceTVoid* pointer = nullptr;
    icetGetPointerv(7, &pointer);
    expectError(ICET_INVALID_ENUM, "an unknown pointer");
    expect(icetImageIsNull(icetImageNull()), "an image that is null");
    IceTInt value = 0;
    icetGetIntegerv(0x7f, &value);
    expectError(ICET_INVALID_ENUM, "an unknown state");
    const std::vector<IceTInt> zeros(static_cast<std::size_t>(ranks), 0);
    icetCompositeOrder(zeros.data());
    expectError(ranks == 1 ? ICET_NO_ERROR : ICET_INVALID_VALUE, "an order that has a rank twice");
    icetBoundingVertices(3, ICET_POINTER, 0, 1, &value);
    expectError(ICET_INVALID_ENUM, "vertices of an unknown type");
    icetEnable(7);
    icetPhysicalRenderSize(3, 3);
    expectError(ICET_INVALID_VALUE, "the error before a warning");
    expectError(ICET_NO_ERROR, "an error that was read");
    icetPhysicalRenderSize(40, 30);
    icetGetError();
}

// The bounds are a box that covers the left half of the wall.
void tryBounds()
{
    icetBoundingBoxf(-1, 0, -1, 1, 0, 0);
    const Picture picture(40, 30);
    const IceTImage image = picture.composite();
    IceTInt contained[4] = {-1, -1, -1, -1};
    icetGetIntegerv(ICET_CONTAINED_VIEWPORT, contained);
    expect(contained[0] == 0 && contained[1] == 0 && contained[2] == 20 && contained[3] == 30, "the pixels of a box");
    if (rank == 0) {
        const auto* words = reinterpret_cast<const std::uint32_t*>(icetImageGetColorcub(image));
        for (int i = 0; i < 40 * 30; ++i)
            expect((words[i] == 0) == (i % 40 >= 20), "pixel " + std::to_string(i) + " of a box");
    }
    icetBoundingVertices(0, ICET_VOID, 0, 0, nullptr);
    expectGoodFrame("one with bounds");
}

void expectFailure(IceTImage image, const std::string& what)
{
    expect(icetImageIsNull(image), what + ": an image");
    expect(icetGetError() != ICET_NO_ERROR, what + ": no error");
    expectGoodFrame(what);
}

bool throwsNow = false, recursNow = false;

void draw(const IceTDouble*, const IceTDouble*, const IceTFloat*, const IceTInt*, IceTImage image)
{
    if (throwsNow)
        throw std::runtime_error("no mesh here");
    if (recursNow) {
        expect(icetImageIsNull(icetDrawFrame(identity, identity, black)), "a frame within a frame");
        expectError(ICET_INVALID_OPERATION, "a frame within a frame");
        icetSetColorFormat(ICET_IMAGE_COLOR_RGBA_FLOAT);
        expectError(ICET_INVALID_OPERATION, "a format within a frame");
        icetResetTiles();
        expectError(ICET_INVALID_OPERATION, "no tiles within a frame");
        expect(icetAddTile(0, 0, 4, 4, ranks - 1) == -1, "a tile within a frame");
        expectError(ICET_INVALID_OPERATION, "a tile within a frame");
        icetPhysicalRenderSize(400, 300);
        expectError(ICET_INVALID_OPERATION, "a render size within a frame");
        icetCopyState(icetGetContext(), icetGetContext());
        expectError(ICET_INVALID_OPERATION, "a copied state within a frame");
        icetDestroyContext(icetGetContext());
        expectError(ICET_INVALID_OPERATION, "the end of a context within a frame");
        expect(!icetCreateContext(nullptr), "a context within a frame");
        expectError(ICET_INVALID_OPERATION, "a context within a frame");
    }
    const Picture picture(40, 30);
    std::copy(picture.colors.begin(), picture.colors.end(), icetImageGetColorui(image));
    std::copy(picture.depths.begin(), picture.depths.end(), icetImageGetDepthf(image));
}

// Copies of an image of floats in other formats. Its first pixel is 0.5 in all channels.
void tryCopies(IceTImage image, int channels)
{
    const auto count = static_cast<std::size_t>(icetImageGetNumPixels(image));
    std::vector<float> rgba(4 * count);
    icetImageCopyColorf(image, rgba.data(), ICET_IMAGE_COLOR_RGBA_FLOAT);
    expectError(ICET_NO_ERROR, "a copy as RGBA");
    expect(rgba[0] == 0.5f && rgba[2] == 0.5f && rgba[3] == (channels == 3 ? 1.0f : 0.5f), "a copy as RGBA");
    std::vector<IceTUByte> bytes(4 * count);
    icetImageCopyColorub(image, bytes.data(), ICET_IMAGE_COLOR_RGBA_UBYTE);
    expectError(ICET_NO_ERROR, "a copy as bytes");
    expect(bytes[0] == 127 && bytes[2] == 127 && bytes[3] == (channels == 3 ? 255 : 127), "a copy as bytes");
#if defined(ICET_IMAGE_COLOR_RGB_FLOAT)
    std::vector<float> rgb(3 * count);
    icetImageCopyColorf(image, rgb.data(), ICET_IMAGE_COLOR_RGB_FLOAT);
    expectError(ICET_NO_ERROR, "a copy as RGB");
    expect(rgb[0] == 0.5f && rgb[2] == 0.5f, "a copy as RGB");
#endif
}

// The client may render less than a tile: the rest of the tile stays empty.
void trySmallRender()
{
#if defined(ICET_IMAGE_COLOR_RGB_FLOAT)
    const IceTEnum format = ICET_IMAGE_COLOR_RGB_FLOAT;
    constexpr int channels = 3;
#else
    const IceTEnum format = ICET_IMAGE_COLOR_RGBA_FLOAT;
    constexpr int channels = 4;
#endif
    icetSetColorFormat(format);
    icetPhysicalRenderSize(8, 4);
    expectError(ICET_INVALID_VALUE, "a render size below that of the tile"); // a warning
    icetDrawCallback([](const IceTDouble*, const IceTDouble*, const IceTFloat*, const IceTInt* read, IceTImage image) {
        expect(read[0] == 0 && read[1] == 0 && read[2] == 8 && read[3] == 4, "what is read of a small render");
        expect(icetImageGetWidth(image) == 8 && icetImageGetHeight(image) == 4, "the size of a small render");
        std::fill_n(icetImageGetColorf(image), channels * 8 * 4, 0.5f);
        std::fill_n(icetImageGetDepthf(image), 8 * 4, 0.5f);
    });
    const IceTImage image = icetDrawFrame(identity, identity, black);
    expectError(ICET_NO_ERROR, "a small render");
    expect(icetImageIsNull(image) == (rank != 0), "an image of a small render");
    if (rank == 0)
        for (int i = 0; i < 40 * 30; ++i)
            expect(icetImageGetColorf(image)[channels * i] == (i % 40 < 8 && i / 40 < 4 ? 0.5f : 0.0f),
                   "pixel " + std::to_string(i) + " of a small render");
    if (rank == 0)
        tryCopies(image, channels);
    icetDrawCallback([](const IceTDouble*, const IceTDouble*, const IceTFloat*, const IceTInt*, IceTImage) {
        expect(false, "a render that shows nothing");
    });
    icetBoundingBoxf(0.5f, 1, -1, 1, 0, 0);
    expect(icetImageIsNull(icetDrawFrame(identity, identity, black)) == (rank != 0), "a picture of nothing");
    expectError(ICET_NO_ERROR, "a picture of nothing");
    icetBoundingVertices(0, ICET_VOID, 0, 0, nullptr);
    icetDrawCallback(draw);
    icetPhysicalRenderSize(40, 30);
    icetSetColorFormat(ICET_IMAGE_COLOR_RGBA_UBYTE);
    expectGoodFrame("a small render");
}

void tryFrames()
{
    const Picture picture(40, 30);
    const bool isLast = rank == ranks - 1;
    expectGoodFrame("nothing");
    icetSetDepthFormat(ICET_IMAGE_DEPTH_NONE);
    IceTImage image = picture.composite();
    icetSetDepthFormat(ICET_IMAGE_DEPTH_FLOAT);
    expectFailure(image, "nearest without depth");
    expectFailure(icetCompositeImage(picture.colors.data(), isLast ? nullptr : picture.depths.data(), nullptr, identity,
                                     identity, black),
                  "no depths on one rank");
    expectFailure(icetCompositeImage(isLast ? nullptr : picture.colors.data(), picture.depths.data(), nullptr, identity,
                                     identity, black),
                  "no colors on one rank");
    icetDrawCallback(isLast ? nullptr : draw);
    expectFailure(icetDrawFrame(identity, identity, black), "nothing to draw on one rank");
    icetDrawCallback(draw);
    throwsNow = isLast;
    expectFailure(icetDrawFrame(identity, identity, black), "an exception on one rank");
    throwsNow = false;
    recursNow = true;
    picture.check(icetDrawFrame(identity, identity, black), 0, "calls that fail in the draw callback");
    recursNow = false;
    image = icetDrawFrame(identity, identity, black);
    if (rank == 0) {
        expect(!icetImageGetColorf(image), "bytes as floats");
        expectError(ICET_INVALID_OPERATION, "bytes as floats");
        expect(!icetImageGetDepthf(image), "depth of a picture without");
        expectError(ICET_INVALID_OPERATION, "depth of a picture without");
        icetImageCopyColorub(image, nullptr, ICET_IMAGE_COLOR_RGBA_FLOAT);
        expectError(ICET_INVALID_ENUM, "a copy in a format of another type");
    } else {
        expect(icetImageGetWidth(image) == 0 && icetImageGetColorFormat(image) == ICET_IMAGE_COLOR_NONE, "no image");
        expect(!icetImageGetColorui(image), "colors of no image");
        expectError(ICET_INVALID_OPERATION, "colors of no image");
    }
    icetCompositeMode(ICET_COMPOSITE_MODE_BLEND);
    image = picture.composite();
    expectError(ICET_INVALID_VALUE, "depth where colors are blended"); // a warning
    expect(icetImageIsNull(image) == (rank != 0), "a blended picture");
    icetCompositeMode(ICET_COMPOSITE_MODE_Z_BUFFER);
    trySmallRender();
    icetResetTiles();
    expect(icetImageIsNull(picture.composite()), "a picture without tiles");
    expectError(ICET_NO_ERROR, "a picture without tiles");
}

void tryErrors()
{
    tryWithoutContext();
    IceTContext context = makeContext();
    trySettings();
    tryBounds();
    tryFrames();
    IceTContext other = makeContext();
    icetCopyState(other, context);
    IceTInt strategy = 0;
    icetGetIntegerv(ICET_STRATEGY, &strategy);
    expect(strategy == static_cast<IceTInt>(ICET_STRATEGY_REDUCE), "a copied state");
    icetDestroyContext(context);
    expect(icetGetContext() == other, "another context than the destroyed one is not current any more");
    icetDestroyContext(other);
    expect(icetGetContext() == nullptr, "a destroyed context is current");
    for (void (*call)(IceTContext) : {icetSetContext, icetDestroyContext}) {
        call(context);
        expectError(ICET_INVALID_VALUE, "a context that was destroyed");
    }
    icetCopyState(context, other);
    expectError(ICET_INVALID_VALUE, "contexts that were destroyed");
}

void tryMoves()
{
    IceTContext context = makeContext();
    for (int frame = 0; frame < 60; ++frame) {
        const int width = 20 + frame % 17 * 11, height = 30 + frame % 5, display = frame % ranks;
        icetResetTiles();
        icetAddTile(0, 0, width, height, display);
        const Picture picture(width, height);
        picture.check(picture.composite(), display, "frame " + std::to_string(frame));
    }
    icetDestroyContext(context);
}

void tryDifferences()
{
    IceTContext context = makeContext();
    icetAddTile(0, 0, 40, 30 + rank, 0);
    const Picture picture(40, 30 + rank);
    expect(icetImageIsNull(picture.composite()), "a picture of different tiles");
    expectError(ICET_INVALID_VALUE, "different tiles");
    icetResetTiles();
    icetAddTile(0, 0, 40, 30, 0);
    expectGoodFrame("different tiles");
    icetDestroyContext(context);
}

// `isFirst`: the missing frame is the first one.
void tryAbsence(bool isFirst)
{
    IceTContext context = makeContext();
    icetAddTile(0, 0, 40, 30, 0);
    if (!isFirst)
        expectGoodFrame("nothing");
    if (rank < ranks - 1) {
        const auto before = std::chrono::steady_clock::now();
        expect(icetImageIsNull(Picture(40, 30).composite()), "a picture without one rank");
        expectError(ICET_INVALID_OPERATION, "a rank that does not call");
        expect(std::chrono::steady_clock::now() - before < std::chrono::seconds(25), "it takes long");
    }
    icetDestroyContext(context);
}

// The other ranks get their error in time, whether the lost rank comes back or not. `launched` is the process that the
// launcher started.
void tryLoss(int signal, int launched)
{
    IceTContext context = makeContext();
    icetAddTile(0, 0, 40, 30, 0);
    expectGoodFrame("nothing");
    const int victim = ranks - 1;
    int process = signal == SIGKILL ? launched : getpid();
    MPI_Bcast(&process, 1, MPI_INT, victim, MPI_COMM_WORLD);
    MPI_Comm others;
    MPI_Comm_split(MPI_COMM_WORLD, rank == victim ? MPI_UNDEFINED : 0, rank, &others);
    if (rank == victim) {
        raise(signal); // what follows is for a rank that comes back
    } else {
        const auto before = std::chrono::steady_clock::now();
        expect(icetImageIsNull(Picture(40, 30).composite()), "a picture without the lost rank");
        expectError(ICET_INVALID_OPERATION, "a lost rank");
        expect(std::chrono::steady_clock::now() - before < std::chrono::seconds(25), "it takes long");
        MPI_Barrier(others);
    }
    if (signal == SIGKILL) { // MPI can no longer be finalised in order
        if (rank == 0) {
            int all = failures, own = failures;
            MPI_Reduce(&own, &all, 1, MPI_INT, MPI_SUM, 0, others);
            std::printf(all == 0 ? "all were told\n" : "not all were told\n");
            std::fflush(stdout);
            kill(process, SIGKILL);
        } else {
            MPI_Reduce(&failures, nullptr, 1, MPI_INT, MPI_SUM, 0, others);
        }
        pause(); // until the launcher ends the job
    }
    if (rank == victim)
        MPI_Send(&process, 1, MPI_INT, 0, 0, MPI_COMM_WORLD);
    if (rank == 0) { // again and again until the rank answers, as it may not have stopped yet
        for (int isThere = 0; !isThere;) {
            kill(process, SIGCONT);
            usleep(10000);
            MPI_Iprobe(victim, 0, MPI_COMM_WORLD, &isThere, MPI_STATUS_IGNORE);
        }
        MPI_Recv(&process, 1, MPI_INT, victim, 0, MPI_COMM_WORLD, MPI_STATUS_IGNORE);
    }
    expect(icetImageIsNull(Picture(40, 30).composite()), "a picture in a context that has failed");
    expectError(ICET_INVALID_OPERATION, "a context that has failed");
    icetDestroyContext(context);
    makeContext();
    icetAddTile(0, 0, 40, 30, 0);
    expectGoodFrame("a lost rank, in a new context,");
    icetDestroyContext(icetGetContext());
}

void tryFinalised()
{
    IceTContext context = makeContext();
    icetAddTile(0, 0, 40, 30, 0);
    makeContext(); // and forgotten
    icetSetContext(context);
    expectGoodFrame("nothing");
    MPI_Finalize();
    expect(icetImageIsNull(Picture(40, 30).composite()), "a picture without MPI");
    expectError(ICET_INVALID_OPERATION, "a picture without MPI");
    icetDestroyContext(context);
    expect(icetGetContext() == nullptr, "a destroyed context is current");
}

} // namespace

int main(int count, char** words)
{
    const std::string what = count > 1 ? words[1] : "";
    const bool isMultiple = count > 2 && words[2] == std::string("multiple");
    // Launchers end a job as soon as a process dies. So the rank is a child of the process that the launcher started.
    const int launched = getpid();
    if (what == "killed") {
        int status = 0;
        if (const pid_t child = fork(); child != 0) {
            waitpid(child, &status, 0);
            return pause();
        }
        prctl(PR_SET_PDEATHSIG, SIGKILL);
    }
    int level = 0;
    MPI_Init_thread(&count, &words, isMultiple ? MPI_THREAD_MULTIPLE : MPI_THREAD_SINGLE, &level);
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    MPI_Comm_size(MPI_COMM_WORLD, &ranks);
    if (what == "errors")
        tryErrors();
    else if (what == "moves")
        tryMoves();
    else if (what == "differs")
        tryDifferences();
    else if (what == "absent")
        tryAbsence(false);
    else if (what == "first")
        tryAbsence(true);
    else if (what == "stopped")
        tryLoss(SIGSTOP, launched);
    else if (what == "killed")
        tryLoss(SIGKILL, launched);
    else if (what == "finalised")
        tryFinalised();
    else
        expect(false, "what is to be tried?");
    if (what != "finalised")
        MPI_Finalize();
    return failures == 0 ? 0 : 1;
}
