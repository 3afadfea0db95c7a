// The extension module dfb._dfb, on which the package dfb is built. Programs use the package's __init__.py.
#include "compositor.hpp"
#include "framebuffer.hpp"
#include "ranks.hpp"

#include <dfb/render/cameras.hpp>

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <cstddef>
#include <cstring>
#include <exception>
#include <memory>
#include <string>
#include <string_view>
#include <type_traits>

namespace py = pybind11;
using namespace py::literals;
using namespace dfb_python;

namespace {

using Three = std::array<float, 3>;

dfb::Vec3 vecOf(const Three& v) { return {v[0], v[1], v[2]}; }

// Converts a matrix from numpy's row-major order to columns, one after another.
std::array<float, 16> columnsOf(const py::object& matrix, const char* name)
{
    const auto rows = pixelsOf<float>(matrix, {0, 0, 4, 4}, 0, name);
    std::array<float, 16> columns{};
    for (py::ssize_t row = 0; row < 4; ++row)
        for (py::ssize_t column = 0; column < 4; ++column)
            columns[static_cast<std::size_t>(4 * column + row)] = rows.at(row, column);
    return columns;
}

dfb::MatrixCamera matrixCamera(const py::object& view, const py::object& projection)
{
    const auto v = columnsOf(view, "view"), p = columnsOf(projection, "projection");
    return dfb::MatrixCamera(v.data(), p.data());
}

template <class Camera>
py::tuple eyeOf(const Camera& camera)
{
    const dfb::Vec3 eye = camera.eye();
    return py::make_tuple(eye.x, eye.y, eye.z);
}

// Pickles a camera as its bytes: mpi4py then sends it to ranks that have the same build of this module.
template <class Camera>
auto pickled()
{
    static_assert(std::is_trivially_copyable_v<Camera>);
    return py::pickle(
        [](const Camera& camera) { return py::bytes(reinterpret_cast<const char*>(&camera), sizeof camera); },
        [](const py::bytes& state) {
            const std::string_view bytes = state;
            if (bytes.size() != sizeof(Camera))
                throw dfb::InvalidArgument("this camera was pickled by another version of dfb");
            alignas(Camera) std::byte copy[sizeof(Camera)];
            std::memcpy(copy, bytes.data(), bytes.size());
            return *reinterpret_cast<const Camera*>(copy);
        });
}

std::string reportText(const dfb::FrameReport& report)
{
    return dfb::detail::printed("<dfb.Report: frame %lld, %.1f ms, %.1f ms of it after the call of this rank's end, "
                                "%lld of %lld tiles with inputs, %lld bytes in %lld messages>",
                                static_cast<long long>(report.frame), report.totalMs, report.compositingOverheadMs,
                                static_cast<long long>(report.tilesTouched), static_cast<long long>(report.tilesTotal),
                                static_cast<long long>(report.bytesSent), static_cast<long long>(report.messagesSent));
}

void addReport(py::module_& module)
{
    py::class_<dfb::FrameReport>(module, "Report", "Figures of a finished frame: see dfb/frame.hpp.")
        .def("__repr__", &reportText)
        .def_readonly("frame", &dfb::FrameReport::frame, "The number of the frame, from 1.")
        .def_readonly("total_ms", &dfb::FrameReport::totalMs, "This rank's time for it, in ms.")
        .def_readonly("render_ms", &dfb::FrameReport::renderMs, "The part until this rank had rendered and sent.")
        .def_readonly("compositing_overhead_ms", &dfb::FrameReport::compositingOverheadMs, "The rest of it.")
        .def_readonly("render_ms_max", &dfb::FrameReport::renderMsMax, "The longest render_ms of a rank.")
        .def_readonly("threads", &dfb::FrameReport::threads, "Threads of this rank.")
        .def_readonly("bytes_sent", &dfb::FrameReport::bytesSent, "Sum over the ranks.")
        .def_readonly("messages_sent", &dfb::FrameReport::messagesSent, "Sum over the ranks.")
        .def_readonly("tiles_total", &dfb::FrameReport::tilesTotal, "Tiles of the image.")
        .def_readonly("tiles_touched", &dfb::FrameReport::tilesTouched, "Tiles that had an input.")
        .def_readonly("non_finite_pixels", &dfb::FrameReport::nonFinitePixels,
                      "Input pixels with an infinity or NaN, of all ranks.")
        .def_readonly("alpha_outside_pixels", &dfb::FrameReport::alphaOutsidePixels,
                      "Input pixels whose alpha is not within 0 and 1, of all ranks.")
        .def_readonly("order_undefined_pixels", &dfb::FrameReport::orderUndefinedPixels,
                      "Pixels whose inputs overlap in depth: no order is right.")
        .def_readonly("peak_inbox_bytes", &dfb::FrameReport::peakInboxBytes, "The most that a rank's inbox held.")
        .def_readonly("peak_memory_bytes", &dfb::FrameReport::peakMemoryBytes,
                      "The most message and image memory that a rank ever held.");
}

void addTiles(py::module_& module)
{
    py::class_<PythonTile>(module, "Tile", "The pixels that a renderer is asked for.")
        .def_readwrite("rgba", &PythonTile::rgba,
                       "Premultiplied linear colours, (height, width, 4) of float32: fill them. An array of uint8 in "
                       "their place has levels: 255 is 1.")
        .def_readwrite("depth", &PythonTile::depth, "Depths, (height, width) of float32, that grow away from the eye.")
        .def_readonly("x0", &PythonTile::x0, "The column of the picture that its first one is.")
        .def_readonly("y0", &PythonTile::y0, "The row of the picture that its first one is; 0 is on top.")
        .def_readonly("width", &PythonTile::width)
        .def_readonly("height", &PythonTile::height)
        .def_readonly("index", &PythonTile::index, "Its number, as in Error.tile.")
        .def_readonly("image_width", &PythonTile::imageWidth)
        .def_readonly("image_height", &PythonTile::imageHeight);
    py::class_<OperationInput>(module, "Input", "What one brick has in a tile.")
        .def_readonly("rgba", &OperationInput::rgba, "(height, width, 4) of float32; 0 where there is nothing.")
        .def_readonly("depth", &OperationInput::depth, "(height, width) of float32; infinity where there is nothing.")
        .def_readonly("source", &OperationInput::source, "The id of the brick.");
}

template <class Object, class ObjectSettings>
py::class_<Object> addCollective(py::module_& module, const char* name)
{
    return py::class_<Object>(module, name)
        .def(py::init([](const py::object& comm, const py::dict& settings) {
                 return std::make_unique<Object>(comm, ObjectSettings(settings));
             }),
             "comm"_a, "settings"_a)
        .def_property_readonly("rank", &Object::rank)
        .def_property_readonly("size", &Object::size)
        .def_property_readonly("width", &Object::width)
        .def_property_readonly("height", &Object::height)
        .def_property_readonly("display_rank", &Object::displayRank)
        .def_property_readonly("closed", &Object::isClosed)
        .def_property_readonly("image", &Object::image)
        .def_property_readonly("depth", &Object::depth)
        .def("image_on_all_ranks", &Object::imageOnAllRanks)
        .def("fail", &Object::fail, "why"_a)
        .def("resize", &Object::resize, "width"_a, "height"_a)
        .def("close", &Object::close)
        .def("leave", &Object::leave);
}

} // namespace

PYBIND11_MODULE(_dfb, module)
{
    py::register_exception_translator([](std::exception_ptr thrown) {
        try {
            if (thrown)
                std::rethrow_exception(thrown);
        } catch (const dfb::Error& error) {
            setError(error);
        }
    });

    if (py::dtype::of<float>().itemsize() != sizeof(float))
        throw py::import_error("dfb was built with a pybind11 that does not understand numpy 2: build it with pybind11 "
                               "2.12 or later, or install numpy<2");
    module.attr("version") = DFB_VERSION;
#if defined(DFB_HAS_MPI)
    module.attr("has_mpi") = true;
    module.attr("mpi_handle_bytes") = sizeof(MPI_Comm);
    module.attr("mpi_headers") = mpiHeaders();
    module.def("mpi_library", &mpiLibrary);
#else
    module.attr("has_mpi") = false;
#endif

    py::class_<dfb::InprocCommunicator>(module, "ThreadCommunicator",
                                        "One rank of a group of threads; run_ranks() makes them.")
        .def_property_readonly("rank", &dfb::InprocCommunicator::rank, "This rank, from 0.")
        .def_property_readonly("size", &dfb::InprocCommunicator::size, "How many ranks there are.");
    module.def("run_ranks", &runRanks, "count"_a, "function"_a);

    addReport(module);
    addTiles(module);
    py::class_<dfb::PerspectiveCamera>(module, "PerspectiveCamera", "A pinhole that looks from `eye` to `target`.")
        .def(py::init([](const Three& eye, const Three& target, const Three& up, float fovY) {
                 return dfb::PerspectiveCamera(vecOf(eye), vecOf(target), vecOf(up), fovY);
             }),
             "eye"_a, "target"_a, "up"_a = Three{0, 1, 0}, "fov_y"_a = 45.0f,
             "fov_y: the vertical angle of view in degrees. Raises Error if no camera can be so.")
        .def(pickled<dfb::PerspectiveCamera>())
        .def_property_readonly("eye", &eyeOf<dfb::PerspectiveCamera>, "Where all rays begin.")
        .def(
            "rays", &raysOf<dfb::PerspectiveCamera>, "tile"_a,
            "Returns origins and unit directions, (height, width, 3) of float32, of the rays through a tile's pixels.");
    py::class_<dfb::MatrixCamera>(module, "MatrixCamera",
                                  "A camera of 4x4 matrices: perspective, off-axis or orthographic.")
        .def(py::init(&matrixCamera), "view"_a, "projection"_a,
             "Matrices that are multiplied by a column, as in `projection @ view @ point`, with OpenGL's clip "
             "coordinates. Of OpenGL's or VTK's memory: the former lies in columns and has to be transposed, the "
             "latter lies in rows. Raises Error if they make no image.")
        .def(pickled<dfb::MatrixCamera>())
        .def_property_readonly("orthographic", &dfb::MatrixCamera::isOrthographic,
                               "Whether all rays have one direction.")
        .def_property_readonly("eye", &eyeOf<dfb::MatrixCamera>, "Where all rays begin; of no use if orthographic.")
        .def(
            "rays", &raysOf<dfb::MatrixCamera>, "tile"_a,
            "Returns origins and unit directions, (height, width, 3) of float32, of the rays through a tile's pixels.");

    addCollective<Compositor, CompositorSettings>(module, "Compositor")
        .def("composite", &Compositor::composite, "rgba"_a, "depth"_a, "options"_a)
        .def("place", &Compositor::place, "lower"_a, "upper"_a, "eye"_a);
    addCollective<FrameBuffer, FrameBufferSettings>(module, "FrameBuffer")
        .def("render", &FrameBuffer::render, "bricks"_a, "camera"_a, "draw"_a);

    for (const char* name : {"ThreadCommunicator", "Report", "Tile", "Input", "PerspectiveCamera", "MatrixCamera"})
        module.attr(name).attr("__module__") = "dfb";
}
