"""Compares pictures of vtk_parts with what VTK alone renders of the whole data set.

    xvfb-run python3 compare.py surfaces|volume data.vti|- PICTURE.ppm...

Surfaces must be equal. In a volume VTK's rays start anew in each part, with samples elsewhere, which moves steps in the
data by some levels of 255; a wrong order of the parts makes tens. -: VTK's wavelet.
"""
import sys

import numpy as np
import vtk
from vtk.util.numpy_support import vtk_to_numpy

WIDTH, HEIGHT = 640, 480


def load(path):
    if path == "-":
        source = vtk.vtkRTAnalyticSource()
        source.SetWholeExtent(-40, 40, -40, 40, -40, 40)
    else:
        source = vtk.vtkXMLImageDataReader()
        source.SetFileName(path)
    source.Update()
    return source.GetOutput()


def render(data, is_volume):
    """The picture of examples/vtk/vtk_parts.cpp, from the top row on."""
    low, high = data.GetScalarRange()
    level = lambda t: low + t * (high - low)
    colors = vtk.vtkColorTransferFunction()
    for t, *rgb in (0.35, 0.2, 0.3, 0.8), (0.6, 0.9, 0.9, 0.85), (0.85, 0.8, 0.15, 0.1):
        colors.AddRGBPoint(level(t), *rgb)
    renderer = vtk.vtkRenderer()
    if is_volume:
        mapper = vtk.vtkGPUVolumeRayCastMapper()
        mapper.SetInputData(data)
        mapper.SetAutoAdjustSampleDistances(0)
        mapper.SetSampleDistance(0.25 * data.GetSpacing()[0])
        opacities = vtk.vtkPiecewiseFunction()
        opacities.AddPoint(level(0.3), 0)
        opacities.AddPoint(level(1), 0.35)
        prop = vtk.vtkVolume()
        look = prop.GetProperty()
        look.SetColor(colors)
        look.SetScalarOpacity(opacities)
        look.SetScalarOpacityUnitDistance(4 * data.GetSpacing()[0])
        look.SetInterpolationTypeToLinear()
    else:
        contour = vtk.vtkSynchronizedTemplates3D()
        contour.SetInputData(data)
        contour.GenerateValues(3, level(0.35), level(0.85))
        contour.ComputeNormalsOff()
        mapper = vtk.vtkOpenGLPolyDataMapper()
        mapper.SetInputConnection(contour.GetOutputPort())
        mapper.SetLookupTable(colors)
        mapper.SetVBOShiftScaleMethod(0)
        prop = vtk.vtkActor()
        prop.GetProperty().SetInterpolationToFlat()
    prop.SetMapper(mapper)
    renderer.AddViewProp(prop)
    renderer.SetBackgroundAlpha(0)
    renderer.GetActiveCamera().SetPosition(1.2, 0.9, 1.6)
    renderer.ResetCamera(data.GetBounds())
    renderer.ResetCameraClippingRange(data.GetBounds())
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetSize(WIDTH, HEIGHT)
    window.SetMultiSamples(0)
    window.SetAlphaBitPlanes(1)
    window.AddRenderer(renderer)
    window.Render()
    rgba = vtk.vtkUnsignedCharArray()
    window.GetRGBACharPixelData(0, 0, WIDTH - 1, HEIGHT - 1, 0, rgba)
    return vtk_to_numpy(rgba).reshape(HEIGHT, WIDTH, 4)[::-1, :, :3].astype(int)


is_volume, allowed = {"surfaces": (False, 0), "volume": (True, 16)}[sys.argv[1]]
whole = render(load(sys.argv[2]), is_volume)
is_right = (whole.max(axis=2) > 0).mean() > 0.05
for path in sys.argv[3:]:
    with open(path, "rb") as file:
        assert file.read(15).split() == [b"P6", b"640", b"480", b"255"], path
        picture = np.frombuffer(file.read(), np.uint8).reshape(HEIGHT, WIDTH, 3)
    largest = abs(picture - whole).max()
    is_right &= largest <= allowed
    print(f"{path}: off by {largest} levels from VTK's own picture, {allowed} are allowed")
sys.exit(0 if is_right else 1)
