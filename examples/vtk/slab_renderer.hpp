// Data and Renderer: VTK reads a slab of a data set, and renders it in a window of its own.
#pragma once

#include <dfb/dfb.hpp>

#include <vtkActor.h>
#include <vtkCamera.h>
#include <vtkColorTransferFunction.h>
#include <vtkGPUVolumeRayCastMapper.h>
#include <vtkImageData.h>
#include <vtkInformation.h>
#include <vtkNew.h>
#include <vtkOpenGLPolyDataMapper.h>
#include <vtkOpenGLVertexBufferObject.h>
#include <vtkPiecewiseFunction.h>
#include <vtkProperty.h>
#include <vtkRTAnalyticSource.h>
#include <vtkRenderWindow.h>
#include <vtkRenderer.h>
#include <vtkSmartPointer.h>
#include <vtkStreamingDemandDrivenPipeline.h>
#include <vtkSynchronizedTemplates3D.h>
#include <vtkVolume.h>
#include <vtkVolumeProperty.h>
#include <vtkXMLImageDataReader.h>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace example {

inline constexpr int width = 640, height = 480;
inline constexpr auto pixelCount = static_cast<std::size_t>(width) * height;

struct Pixels {
    std::vector<std::uint8_t> colors = std::vector<std::uint8_t>(4 * pixelCount); // premultiplied RGBA
    std::vector<float> depths = std::vector<float>(pixelCount);                   // 1: nothing there
};

class Data {
public:
    explicit Data(const std::string& file)
    {
        if (!file.empty()) {
            vtkNew<vtkXMLImageDataReader> reader;
            reader->SetFileName(file.c_str());
            source_ = reader;
        } else {
            vtkNew<vtkRTAnalyticSource> wavelet;
            wavelet->SetWholeExtent(-40, 40, -40, 40, -40, 40);
            source_ = wavelet;
        }
    }

    // Points of slab `index` of `count`; neighbours share a plane of them. Throws std::runtime_error if there are not
    // as many layers, or if the file cannot be read.
    vtkSmartPointer<vtkImageData> slab(int index, int count)
    {
        std::array<int, 6> extent{};
        source_->UpdateInformation();
        source_->GetOutputInformation(0)->Get(vtkStreamingDemandDrivenPipeline::WHOLE_EXTENT(), extent.data());
        const int first = extent[4], cells = extent[5] - extent[4];
        if (cells < count)
            throw std::runtime_error("the data set has " + std::to_string(std::max(cells, 0)) + " layers for "
                                     + std::to_string(count) + " slabs");
        extent[4] = first + cells * index / count;
        extent[5] = first + cells * (index + 1) / count;
        source_->UpdateExtent(extent.data());
        auto image = vtkSmartPointer<vtkImageData>::New();
        image->DeepCopy(vtkImageData::SafeDownCast(source_->GetOutputDataObject(0)));
        image->Crop(extent.data()); // readers may give more
        return image;
    }

private:
    vtkSmartPointer<vtkAlgorithm> source_;
};

// A window with a camera on the whole data set, whose values are in [range[0], range[1]].
class Renderer {
public:
    Renderer(bool isVolume, const double (&bounds)[6], const double (&range)[2]) : isVolume_(isVolume)
    {
        const auto level = [&](double t) { return range[0] + t * (range[1] - range[0]); };
        const double colors[3][4] = {{0.35, 0.2, 0.3, 0.8}, {0.6, 0.9, 0.9, 0.85}, {0.85, 0.8, 0.15, 0.1}};
        for (const auto& [t, red, green, blue] : colors) {
            levels_.push_back(level(t));
            colors_->AddRGBPoint(level(t), red, green, blue);
        }
        opacities_->AddPoint(level(0.3), 0);
        opacities_->AddPoint(level(1), 0.35);
        window_->SetOffScreenRendering(1);
        window_->SetSize(width, height);
        window_->SetMultiSamples(0); // or edges are blended with what is behind them in this window
        window_->SetAlphaBitPlanes(1);
        window_->AddRenderer(renderer_);
        renderer_->SetBackground(0, 0, 0);
        renderer_->SetBackgroundAlpha(0);
        vtkCamera* camera = renderer_->GetActiveCamera();
        camera->SetPosition(1.2, 0.9, 1.6);
        camera->SetFocalPoint(0, 0, 0);
        renderer_->ResetCamera(bounds);
        renderer_->ResetCameraClippingRange(bounds); // depths of all ranks are on one scale
    }

    dfb::Vec3 eye()
    {
        double position[3];
        renderer_->GetActiveCamera()->GetPosition(position);
        return {static_cast<float>(position[0]), static_cast<float>(position[1]), static_cast<float>(position[2])};
    }

    Pixels render(vtkImageData* image)
    {
        renderer_->RemoveAllViewProps();
        if (isVolume_)
            addVolume(image);
        else
            addSurfaces(image);
        window_->Render();
        Pixels pixels;
        const std::unique_ptr<std::uint8_t[]> colors(
            window_->GetRGBACharPixelData(0, 0, width - 1, height - 1, 0 /* of the back buffer */));
        const std::unique_ptr<float[]> depths(window_->GetZbufferData(0, 0, width - 1, height - 1));
        std::copy_n(colors.get(), pixels.colors.size(), pixels.colors.begin());
        std::copy_n(depths.get(), pixels.depths.size(), pixels.depths.begin());
        return pixels;
    }

private:
    void addSurfaces(vtkImageData* image)
    {
        vtkNew<vtkSynchronizedTemplates3D> contour;
        contour->SetInputData(image);
        contour->ComputeNormalsOff(); // they would need points of the neighbours
        for (std::size_t i = 0; i < levels_.size(); ++i)
            contour->SetValue(static_cast<int>(i), levels_[i]);
        vtkNew<vtkOpenGLPolyDataMapper> mapper;
        mapper->SetInputConnection(contour->GetOutputPort());
        mapper->SetLookupTable(colors_);
        // Vertices as they are: VTK would move them by the middle of the slab, and round.
        mapper->SetVBOShiftScaleMethod(vtkOpenGLVertexBufferObject::DISABLE_SHIFT_SCALE);
        vtkNew<vtkActor> actor;
        actor->SetMapper(mapper);
        actor->GetProperty()->SetInterpolationToFlat();
        renderer_->AddActor(actor);
    }

    void addVolume(vtkImageData* image)
    {
        vtkNew<vtkGPUVolumeRayCastMapper> mapper;
        mapper->SetInputData(image);
        mapper->SetAutoAdjustSampleDistances(0);
        mapper->SetSampleDistance(static_cast<float>(0.25 * image->GetSpacing()[0]));
        vtkNew<vtkVolume> volume;
        volume->SetMapper(mapper);
        volume->GetProperty()->SetColor(colors_);
        volume->GetProperty()->SetScalarOpacity(opacities_);
        volume->GetProperty()->SetScalarOpacityUnitDistance(4 * image->GetSpacing()[0]);
        volume->GetProperty()->SetInterpolationTypeToLinear();
        renderer_->AddVolume(volume);
    }

    bool isVolume_;
    std::vector<double> levels_;
    vtkNew<vtkColorTransferFunction> colors_;
    vtkNew<vtkPiecewiseFunction> opacities_;
    vtkNew<vtkRenderer> renderer_;
    vtkNew<vtkRenderWindow> window_;
};

} // namespace example
