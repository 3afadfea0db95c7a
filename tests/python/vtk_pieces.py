"""VTK renders a slab of a data set on each rank; the picture of all is that of VTK alone, bit for bit.

    mpirun -n 4 python3 -m mpi4py vtk_pieces.py [picture.ppm]
"""
import sys

import numpy as np
import vtk
from mpi4py import MPI
from vtk.util.numpy_support import vtk_to_numpy

import dfb

WIDTH, HEIGHT, HALF = 640, 480, 40
comm = MPI.COMM_WORLD


def slab(index, count):
    """Points of a part of VTK's wavelet; neighbours share a plane of them."""
    wavelet = vtk.vtkRTAnalyticSource()
    wavelet.SetWholeExtent(-HALF, HALF, -HALF, HALF, -HALF, HALF)
    extent = [-HALF, HALF, -HALF, HALF, -HALF + 2 * HALF * index // count, -HALF + 2 * HALF * (index + 1) // count]
    wavelet.UpdateExtent(extent)
    image = vtk.vtkImageData()
    image.DeepCopy(wavelet.GetOutput())
    image.Crop(extent)
    return image


def render(image):
    """Premultiplied colours and depths, the lowest row first; depth 1 where there is nothing."""
    contour = vtk.vtkSynchronizedTemplates3D()
    contour.SetInputData(image)
    contour.ComputeNormalsOff()  # they would need points of the neighbours
    for i, level in enumerate((130, 180, 230)):
        contour.SetValue(i, level)
    mapper = vtk.vtkOpenGLPolyDataMapper()
    mapper.SetInputConnection(contour.GetOutputPort())
    mapper.SetScalarRange(100, 260)
    mapper.SetVBOShiftScaleMethod(0)  # vertices as they are: VTK would move them by the middle of the slab, and round
    actor = vtk.vtkActor()
    actor.SetMapper(mapper)
    actor.GetProperty().SetInterpolationToFlat()
    renderer = vtk.vtkRenderer()
    renderer.SetBackground(0, 0, 0)
    renderer.SetBackgroundAlpha(0)
    renderer.AddActor(actor)
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetAlphaBitPlanes(1)
    window.SetSize(WIDTH, HEIGHT)
    window.AddRenderer(renderer)
    whole = (-HALF, HALF) * 3
    renderer.GetActiveCamera().SetPosition(1.2, 0.9, 1.6)
    renderer.ResetCamera(whole)
    renderer.ResetCameraClippingRange(whole)  # depths of all ranks are on one scale
    window.Render()
    colors, depths = vtk.vtkUnsignedCharArray(), vtk.vtkFloatArray()
    window.GetRGBACharPixelData(0, 0, WIDTH - 1, HEIGHT - 1, 0, colors)
    window.GetZbufferData(0, 0, WIDTH - 1, HEIGHT - 1, depths)
    return (vtk_to_numpy(colors).reshape(HEIGHT, WIDTH, 4).copy(), vtk_to_numpy(depths).reshape(HEIGHT, WIDTH).copy())


with dfb.ImageCompositor(comm, WIDTH, HEIGHT, depth=True) as compositor:
    report = compositor.composite(*render(slab(comm.rank, comm.size)), bottom_up=True, far_depth=1)
    if compositor.is_display_rank:
        rgba, depth = (a[::-1] for a in render(slab(0, 1)))
        assert 0.2 < (depth < 1).mean() < 1, (depth < 1).mean()
        differing = (compositor.image != rgba).any(axis=2) & (depth < 1)
        there = depth < 1
        print(f"{comm.size} ranks: {differing.sum()} of {there.sum()} pixels differ from VTK alone, {report}")
        assert not differing.any()
        np.testing.assert_array_equal(compositor.depth[there], depth[there])
        assert np.isinf(compositor.depth[~there]).all() and not compositor.image[~there].any()
        if len(sys.argv) > 1:
            with open(sys.argv[1], "wb") as file:
                file.write(b"P6 %d %d 255\n" % (WIDTH, HEIGHT) + compositor.image[..., :3].tobytes())
print(f"rank {comm.rank}: done", flush=True)
