# pvpython paraview_wall_client.py PORT
# Draws on the wall of the pvserver at PORT, says so, and ends when it has been seen.
import sys

from paraview.simple import *

Connect("localhost", int(sys.argv[1]))
view = CreateRenderView()
layout = CreateLayout("wall")
AssignViewToLayout(view=view, layout=layout)
view.UseColorPaletteForBackground = 0
view.Background = [0.2, 0.25, 0.35]
view.OrientationAxesVisibility = 0
view.RemoteRenderThreshold = 0
view.CameraPosition = [40, 30, 55]
view.CameraFocalPoint = [0, 0, 0]
view.CameraViewAngle = 22
surface = Contour(Input=Wavelet(), ContourBy="RTData", Isosurfaces=[110.0, 160.0, 210.0])
shown = Show(surface, view)
ColorBy(shown, ("POINTS", "RTData"))
for turn in range(3):
    view.CameraPosition = [38 + turn, 30, 55]
    Render(view)
    layout.ShowViewsOnTileDisplay()  # without it no display shows anything
print("drawn", flush=True)
sys.stdin.readline()
Disconnect()
