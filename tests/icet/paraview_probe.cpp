// Preloaded before IceT or libdfb_icet, whichever composites. Appends to $DFB_PROBE/times how long each frame takes
// from the moment when the last rank has rendered until rank 0 has the picture. This leaves out the time for which
// ranks wait for slower ranks to render, which does not depend on the compositor. All ranks must be on one machine, as
// their clocks are compared. While the file $DFB_PROBE/wanted exists, it also writes the inputs of each blended frame
// to input_RANK beside that file, and the result to output; the files of the last frame stay.
//
//   mpirun -n 3 env DFB_PROBE=FOLDER LD_PRELOAD="paraview_probe.so libdfb_icet.so" pvbatch movie.py
#include <IceT.h>

#include <dlfcn.h>
#include <mpi.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <string>

namespace {

// The function of this name in the next library in search order.
template <class Function>
Function* behind(const char* name, Function*)
{
    return reinterpret_cast<Function*>(dlsym(RTLD_NEXT, name));
}
#define DFB_BEHIND(function) behind(#function, &function)

struct Call {
    IceTDrawCallbackType draw = nullptr;
    IceTInt order[64] = {};
    double renderedMs = 0; // time at which this rank had rendered
} call;

double msNow()
{
    return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

IceTInt state(IceTEnum name)
{
    static const auto get = DFB_BEHIND(icetGetIntegerv);
    IceTInt value = 0;
    get(name, &value);
    return value;
}

std::FILE* open(const std::string& name, const char* how)
{
    const char* folder = std::getenv("DFB_PROBE");
    return folder ? std::fopen((folder + ("/" + name)).c_str(), how) : nullptr;
}

// Writes the place of the rank, its size, the valid part (x, y, width, height), and 8-bit RGBA.
void write(const std::string& name, IceTImage image, IceTInt place, const IceTInt* part)
{
    static const auto width = DFB_BEHIND(icetImageGetWidth), height = DFB_BEHIND(icetImageGetHeight);
    static const auto format = DFB_BEHIND(icetImageGetColorFormat);
    static const auto color = DFB_BEHIND(icetImageGetColorcub);
    if (state(ICET_COMPOSITE_MODE) != ICET_COMPOSITE_MODE_BLEND || format(image) != ICET_IMAGE_COLOR_RGBA_UBYTE)
        return;
    if (std::FILE* wanted = open("wanted", "r"))
        std::fclose(wanted);
    else
        return;
    if (std::FILE* file = open(name, "wb")) {
        const IceTInt header[7] = {place, width(image), height(image), part[0], part[1], part[2], part[3]};
        std::fwrite(header, sizeof header, 1, file);
        std::fwrite(color(image), 4, static_cast<std::size_t>(header[1]) * static_cast<std::size_t>(header[2]), file);
        std::fclose(file);
    }
}

void draw(const IceTDouble* projection, const IceTDouble* modelview, const IceTFloat* background,
          const IceTInt* readback, IceTImage result)
{
    call.draw(projection, modelview, background, readback, result);
    const IceTInt rank = state(ICET_RANK), ranks = state(ICET_NUM_PROCESSES);
    IceTInt place = 0;
    while (place < ranks && call.order[place] != rank)
        ++place;
    write("input_" + std::to_string(rank), result, place, readback);
    call.renderedMs = msNow();
}

} // namespace

extern "C" void icetDrawCallback(IceTDrawCallbackType function)
{
    call.draw = function;
    DFB_BEHIND(icetDrawCallback)(function ? draw : nullptr);
}

extern "C" void icetCompositeOrder(const IceTInt* order)
{
    for (IceTInt i = 0; i < state(ICET_NUM_PROCESSES) && i < 64; ++i)
        call.order[i] = order[i];
    DFB_BEHIND(icetCompositeOrder)(order);
}

extern "C" IceTImage icetDrawFrame(const IceTDouble* projection, const IceTDouble* modelview,
                                   const IceTFloat* background)
{
    static const auto drawFrame = DFB_BEHIND(icetDrawFrame);
    static const auto isNull = DFB_BEHIND(icetImageIsNull);
    call.renderedMs = msNow(); // for ranks that have nothing to render
    const IceTImage image = drawFrame(projection, modelview, background);
    const double endMs = msNow();
    double lastMs = 0;
    MPI_Reduce(&call.renderedMs, &lastMs, 1, MPI_DOUBLE, MPI_MAX, 0, MPI_COMM_WORLD);
    if (state(ICET_RANK) == 0) {
        const IceTInt all[4] = {0, 0, 0, 0};
        if (!isNull(image))
            write("output", image, 0, all);
        if (std::FILE* file = open("times", "a")) {
            std::fprintf(file, "%.3f\n", endMs - lastMs);
            std::fclose(file);
        }
    }
    return image;
}
