// VTK renders, dfb composites. Each rank reads its part of a data set and renders it into a window of its own, off
// screen. dfb makes one picture of the pixels of all windows: surfaces by their depth, a volume in visibility order.
//
//   mpirun -n 4 vtk_parts surfaces|volume picture.ppm [data.vti]        without data it draws VTK's wavelet
#include <dfb/dfb.hpp>

#include <vtkActor.h>
#include <vtkCamera.h>
#include <vtkColorTransferFunction.h>
#include <vtkFloatArray.h>
#include <vtkGPUVolumeRayCastMapper.h>
#include <vtkImageData.h>
#include <vtkNew.h>
#include <vtkOpenGLPolyDataMapper.h>
#include <vtkOpenGLVertexBufferObject.h>
#include <vtkPiecewiseFunction.h>
#include <vtkProperty.h>
#include <vtkRTAnalyticSource.h>
#include <vtkRenderWindow.h>
#include <vtkRenderer.h>
#include <vtkSynchronizedTemplates3D.h>
#include <vtkUnsignedCharArray.h>
#include <vtkVolume.h>
#include <vtkVolumeProperty.h>
#include <vtkXMLImageDataReader.h>

#include <algorithm>
#include <cstdio>
#include <exception>
#include <stdexcept>
#include <string>

namespace {

constexpr int width = 640, height = 480;

void addSurfaces(vtkRenderer* renderer, vtkImageData* part, vtkColorTransferFunction* colors, double low, double high)
{
    vtkNew<vtkSynchronizedTemplates3D> contour;
    contour->SetInputData(part);
    contour->GenerateValues(3, low, high);
    contour->ComputeNormalsOff(); // they would need points of the neighbours
    vtkNew<vtkOpenGLPolyDataMapper> mapper;
    mapper->SetInputConnection(contour->GetOutputPort());
    mapper->SetLookupTable(colors);
    // Keeps vertices as they are. Otherwise VTK would shift them by the middle of the part, and round.
    mapper->SetVBOShiftScaleMethod(vtkOpenGLVertexBufferObject::DISABLE_SHIFT_SCALE);
    vtkNew<vtkActor> actor;
    actor->SetMapper(mapper);
    actor->GetProperty()->SetInterpolationToFlat();
    renderer->AddActor(actor);
}

void addVolume(vtkRenderer* renderer, vtkImageData* part, vtkColorTransferFunction* colors, double low, double high)
{
    vtkNew<vtkGPUVolumeRayCastMapper> mapper;
    mapper->SetInputData(part);
    mapper->SetAutoAdjustSampleDistances(0);
    mapper->SetSampleDistance(static_cast<float>(0.25 * part->GetSpacing()[0]));
    vtkNew<vtkPiecewiseFunction> opacities;
    opacities->AddPoint(low, 0);
    opacities->AddPoint(high, 0.35);
    vtkNew<vtkVolume> volume;
    volume->SetMapper(mapper);
    volume->GetProperty()->SetColor(colors);
    volume->GetProperty()->SetScalarOpacity(opacities);
    volume->GetProperty()->SetScalarOpacityUnitDistance(4 * part->GetSpacing()[0]);
    volume->GetProperty()->SetInterpolationTypeToLinear();
    renderer->AddVolume(volume);
}

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    const std::string what = argc == 3 || argc == 4 ? argv[1] : "";
    if (what != "surfaces" && what != "volume") {
        std::fprintf(stderr, "usage: vtk_parts surfaces|volume picture.ppm [data.vti]\n");
        return 2;
    }
    const bool isVolume = what == "volume";

    // VTK cuts the data into a box of cells for each rank; neighbours share the points between them.
    vtkNew<vtkRTAnalyticSource> wavelet;
    wavelet->SetWholeExtent(-40, 40, -40, 40, -40, 40);
    vtkNew<vtkXMLImageDataReader> reader;
    reader->SetFileName(argv[argc - 1]);
    vtkAlgorithm* const source = argc == 4 ? static_cast<vtkAlgorithm*>(reader) : wavelet;
    source->UpdatePiece(mpi.rank(), mpi.size(), 0);
    auto* const part = vtkImageData::SafeDownCast(source->GetOutputDataObject(0));
    if (part->GetNumberOfCells() == 0)
        throw std::runtime_error("there are no cells for rank " + std::to_string(mpi.rank()));

    // All ranks have a camera on the whole data set, and colours for the range of all its values.
    double box[6], range[2];
    part->GetBounds(box);
    part->GetScalarRange(range);
    double all[8] = {box[0], -box[1], box[2], -box[3], box[4], -box[5], range[0], -range[1]};
    MPI_Allreduce(MPI_IN_PLACE, all, 8, MPI_DOUBLE, MPI_MIN, mpi.communicator());
    const double whole[6] = {all[0], -all[1], all[2], -all[3], all[4], -all[5]};
    const auto level = [&](double t) { return all[6] + t * (-all[7] - all[6]); };
    vtkNew<vtkColorTransferFunction> colors;
    colors->AddRGBPoint(level(0.35), 0.2, 0.3, 0.8);
    colors->AddRGBPoint(level(0.6), 0.9, 0.9, 0.85);
    colors->AddRGBPoint(level(0.85), 0.8, 0.15, 0.1);

    vtkNew<vtkRenderer> renderer;
    if (isVolume)
        addVolume(renderer, part, colors, level(0.3), level(1));
    else
        addSurfaces(renderer, part, colors, level(0.35), level(0.85));
    renderer->SetBackgroundAlpha(0);
    renderer->GetActiveCamera()->SetPosition(1.2, 0.9, 1.6);
    renderer->ResetCamera(whole);
    renderer->ResetCameraClippingRange(whole); // depths of all ranks are on one scale
    vtkNew<vtkRenderWindow> window;
    window->SetOffScreenRendering(1);
    window->SetSize(width, height);
    window->SetMultiSamples(0); // otherwise edges are blended with what is behind them in this window
    window->SetAlphaBitPlanes(1);
    window->AddRenderer(renderer);
    window->Render();
    vtkNew<vtkUnsignedCharArray> rgba; // premultiplied
    vtkNew<vtkFloatArray> depths;      // 1: nothing there
    window->GetRGBACharPixelData(0, 0, width - 1, height - 1, 0 /* of the back buffer */, rgba);
    window->GetZbufferData(0, 0, width - 1, height - 1, depths);

    dfb::ImageCompositor compositor(mpi.communicator(), isVolume ? dfb::ImageBlend::InOrder : dfb::ImageBlend::Nearest,
                                    {width, height});
    int place = -1; // of this rank from front to back; surfaces need none
    if (isVolume) {
        const dfb::Box3 bounds{dfb::toFloat({box[0], box[2], box[4]}), dfb::toFloat({box[1], box[3], box[5]})};
        const dfb::SharedWorld world(compositor, dfb::World({{unsigned(mpi.rank()), bounds}}));
        const double* eye = renderer->GetActiveCamera()->GetPosition();
        const auto order = dfb::visibilityOrder(world, dfb::toFloat({eye[0], eye[1], eye[2]}));
        place = static_cast<int>(std::find(order.begin(), order.end(), mpi.rank()) - order.begin());
    }
    dfb::InputImage image(rgba->GetPointer(0), isVolume ? nullptr : depths->GetPointer(0));
    image.bottomUp = true;
    image.farDepth = 1;
    compositor.composite(image, place);
    if (compositor.isDisplayRank())
        dfb::writePpm(argv[2], compositor.image());
} catch (const std::exception& e) {
    std::fprintf(stderr, "vtk_parts: %s\n", e.what());
    return 1;
}
