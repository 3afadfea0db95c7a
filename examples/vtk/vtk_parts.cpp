// VTK renders, dfb composites. Each rank has a slab of a data set and renders it into a window of its own, off screen;
// the pixels that VTK gives become one picture: surfaces by their depth, or with --volume in visibility order.
//
//   mpirun -n 4 vtk_parts [--volume] [--check] [--output picture.ppm] [file.vti]
//
// --check: rank 0 also renders all slabs, one by one, and the whole data set, and compares.
#include "check.hpp"
#include "slab_renderer.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <string>
#include <vector>

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    bool isVolume = false, isChecked = false;
    std::string file, output = "vtk_parts.ppm";
    for (int i = 1; i < argc; ++i) {
        const std::string argument = argv[i];
        if (argument == "--volume")
            isVolume = true;
        else if (argument == "--check")
            isChecked = true;
        else if (argument == "--output" && i + 1 < argc)
            output = argv[++i];
        else if (argument.rfind("--", 0) != 0 && file.empty())
            file = argument;
        else {
            std::fprintf(stderr, "usage: vtk_parts [--volume] [--check] [--output picture.ppm] [file.vti]\n");
            return 2;
        }
    }

    example::Data data(file);
    const vtkSmartPointer<vtkImageData> mine = data.slab(mpi.rank(), mpi.size());
    double box[6], range[2], least[8], all[8];
    mine->GetBounds(box);
    mine->GetScalarRange(range);
    for (int axis = 0; axis < 3; ++axis)
        least[2 * axis] = box[2 * axis], least[2 * axis + 1] = -box[2 * axis + 1];
    least[6] = range[0], least[7] = -range[1];
    MPI_Allreduce(least, all, 8, MPI_DOUBLE, MPI_MIN, mpi.communicator());
    example::Renderer renderer(isVolume, {all[0], -all[1], all[2], -all[3], all[4], -all[5]}, {all[6], -all[7]});

    dfb::ImageCompositor compositor(mpi.communicator(), isVolume ? dfb::ImageBlend::InOrder : dfb::ImageBlend::Nearest,
                                    {example::width, example::height});
    const auto corner = [&](int side) {
        return dfb::Vec3{static_cast<float>(box[side]), static_cast<float>(box[2 + side]),
                         static_cast<float>(box[4 + side])};
    };
    const auto rank = static_cast<std::uint32_t>(mpi.rank());
    const dfb::SharedWorld world(compositor, dfb::World({{rank, {corner(0), corner(1)}}}));
    const std::vector<int> order = dfb::visibilityOrder(world, renderer.eye());
    const auto place = std::find(order.begin(), order.end(), mpi.rank()) - order.begin();

    const example::Pixels pixels = renderer.render(mine);
    dfb::InputImage image(pixels.colors.data(), isVolume ? nullptr : pixels.depths.data());
    image.bottomUp = true;
    image.farDepth = 1;
    compositor.composite(image, isVolume ? static_cast<int>(place) : -1);
    if (!compositor.isDisplayRank())
        return 0;
    dfb::writePpm(output, compositor.image());
    return isChecked && !example::isRight(compositor.image(), data, renderer, order, isVolume) ? 1 : 0;
} catch (const std::exception& e) {
    std::fprintf(stderr, "vtk_parts: %s\n", e.what());
    return 1;
}
