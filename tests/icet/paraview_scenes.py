# pvbatch paraview_scenes.py FOLDER [SCENE...]
# Draws scenes that are composited in different ways: FOLDER/SCENE.png. FOLDER/times.txt says how long frames take, and
# how long compositing, and FOLDER/SCENE_input_RANK and SCENE_output have what was blended in two of them: with
# paraview_probe.so and its DFB_PROBE=FOLDER.
import glob
import os
import statistics
import sys
import time

from paraview.simple import *

folder = sys.argv[1]
wanted = sys.argv[2:]
paraview.simple._DisableFirstRenderCameraReset()


def make_view(size=(480, 360)):
    view = CreateRenderView()
    view.ViewSize = list(size)
    view.UseColorPaletteForBackground = 0
    view.Background = [0.2, 0.25, 0.35]
    view.OrientationAxesVisibility = 0
    view.UseFXAA = 0  # it finds other edges where two levels differ, and moves whole pixels
    view.CameraPosition = [40, 30, 55]
    view.CameraFocalPoint = [0, 0, 0]
    view.CameraViewUp = [0, 1, 0]
    view.CameraViewAngle = 32
    return view


def save(view, name, blended=False):
    """Writes the picture, and what has been blended for it."""
    if blended:
        open(folder + "/wanted", "w").close()
    Render(view)
    SaveScreenshot("%s/%s.png" % (folder, name), view, ImageResolution=view.ViewSize)
    if blended:
        os.remove(folder + "/wanted")
        for path in glob.glob(folder + "/input_*") + [folder + "/output"]:
            os.rename(path, "%s/%s_%s" % (folder, name, os.path.basename(path)))


def measure(view, name):
    """Appends how long a frame takes, and compositing it: quartile, median, quartile, in ms."""
    frames = []
    open(folder + "/times", "w").close()
    for turn in range(32):
        view.CameraPosition = [40, 30 + turn / 3, 55]
        started = time.perf_counter()
        Render(view)
        frames.append(1e3 * (time.perf_counter() - started))
    view.CameraPosition = [40, 30, 55]
    with open(folder + "/times") as file:
        compositing = [float(line) for line in file]
    with open(folder + "/times.txt", "a") as file:
        figures = statistics.quantiles(frames[2:]) + statistics.quantiles(compositing[2:])
        file.write("%s %.2f %.2f %.2f %.2f %.2f %.2f\n" % (name, *figures))


def show_surfaces(view, opacity=1):
    surface = Contour(Input=Wavelet(), ContourBy="RTData", Isosurfaces=[110.0, 160.0, 210.0])
    shown = Show(surface, view)
    ColorBy(shown, ("POINTS", "RTData"))
    shown.RescaleTransferFunctionToDataRange()
    shown.Opacity = opacity
    # Ranks keep the data that they have; its parts are boxes beside each other. ParaView 5.11 moves data by XML that
    # newer versions of expat refuse to read: then parts of the picture are missing, whatever composites.
    shown.UseDataPartitions = 1


def opaque():
    view = make_view()
    show_surfaces(view)
    measure(view, "opaque")
    save(view, "opaque")


def volume():
    view = make_view()
    shown = Show(Wavelet(), view)
    shown.SetRepresentationType("Volume")
    ColorBy(shown, ("POINTS", "RTData"))
    shown.RescaleTransferFunctionToDataRange()
    measure(view, "volume")
    save(view, "volume", blended=True)


def transparent():
    view = make_view()
    show_surfaces(view, 0.4)
    measure(view, "transparent")
    save(view, "transparent", blended=True)


def selection():
    view = make_view()
    show_surfaces(view)
    Render(view)
    SelectSurfaceCells(Rectangle=[200, 120, 300, 240], View=view)
    save(view, "selection")


def two_views():
    left, right = make_view((300, 200)), make_view((200, 260))
    show_surfaces(left)
    shown = Show(Wavelet(), right)
    shown.SetRepresentationType("Outline")
    show_surfaces(right, 0.5)
    for turn in range(3):
        left.CameraPosition = [40 - 10 * turn, 30, 55]
        Render(left)
        Render(right)
    save(left, "two_views_left")
    save(right, "two_views_right", blended=True)


def resize():
    view = make_view()
    show_surfaces(view)
    Render(view)
    for size in ((200, 150), (640, 200), (333, 271)):
        view.ViewSize = list(size)
        save(view, "resize_%dx%d" % size)


def one_rank():
    # A line is on one rank alone; the others have nothing to draw.
    view = make_view()
    line = Line(Point1=[-15, -8, 0], Point2=[15, 8, 0])
    Show(Tube(Input=line, Radius=3.0), view)
    save(view, "one_rank")


if os.path.exists(folder + "/times.txt"):
    os.remove(folder + "/times.txt")
for scene in (opaque, volume, transparent, selection, two_views, resize, one_rank):
    if not wanted or scene.__name__ in wanted:
        scene()
        for source in list(GetSources().values()):
            Delete(source)
