# python3 paraview_compare.py FOLDER
# Compares the pictures in FOLDER/icet with those in FOLDER/dfb, and what was blended with the exact result; prints a
# table of each. Exits with 1 if they differ by more than they may.
import glob
import os
import sys

import numpy
from PIL import Image

FOLDER = sys.argv[1]
PICTURES = ("opaque selection two_views_left one_rank resize_200x150 resize_640x200 resize_333x271 wall_left wall_right "
            "volume transparent two_views_right").split()

# Opaque pictures have to be equal. IceT blends 8-bit levels step by step and drops fractions: with three ranks colours
# and alphas may be two levels too low, while dfb is off by half a level at most. ParaView blends both onto its
# background, 89 levels at most, and rounds: pictures differ by 2 + 2 * 89 / 255 + 1 levels at most.
BLENDED = "volume transparent two_views_right".split()
MOST = 3

failures = []


def check(name, holds, text):
    if not holds:
        failures.append("%s: %s" % (name, text))


def read(path):
    return numpy.asarray(Image.open(path).convert("RGB")).astype(int)


def read_dump(path):
    """Returns the place of the rank and its image, with zeros where it does not count."""
    with open(path, "rb") as file:
        place, width, height, x, y, part_width, part_height = numpy.frombuffer(file.read(28), numpy.int32)
        pixels = numpy.frombuffer(file.read(), numpy.uint8).reshape(height, width, 4).astype(numpy.int64)
    if part_width > 0:
        part = numpy.zeros_like(pixels)
        part[y:y + part_height, x:x + part_width] = pixels[y:y + part_height, x:x + part_width]
        pixels = part
    return place, pixels


def exact(inputs):
    """Blends images front to back; levels as float64, whose error is far below a level."""
    seen = numpy.zeros(inputs[0].shape)
    through = numpy.ones(inputs[0].shape[:2] + (1,))
    for pixels in inputs:
        seen += through * pixels
        through = through * (255 - pixels[..., 3:]) / 255
    return seen


def compare_pictures():
    print("%-18s %8s %8s %8s %8s" % ("picture", "pixels", "differ", "largest", "mean"))
    for name in PICTURES:
        paths = ["%s/%s/%s.png" % (FOLDER, side, name) for side in ("icet", "dfb")]
        if not all(os.path.exists(path) for path in paths):
            check(name, False, "there are not both pictures")
            continue
        icet, dfb = (read(path) for path in paths)
        check(name, icet.shape == dfb.shape, "pictures are not of the same size")
        check(name, icet.max(axis=(0, 1)).tolist() != icet.min(axis=(0, 1)).tolist(), "the picture is empty")
        if icet.shape != dfb.shape:
            continue
        off = abs(dfb - icet)
        print("%-18s %8d %8d %8d %8.4f" % (name, off[..., 0].size, (off.max(axis=2) > 0).sum(), off.max(), off.mean()))
        if name in BLENDED:
            check(name, off.max() <= MOST, "blended pictures differ by too much")
        else:
            check(name, off.max() == 0, "pictures without blending differ")


def compare_blending():
    print("\n%-18s %8s %8s   %s" % ("blended", "pixels", "wrong", "levels from exact"))
    for name in BLENDED:
        dumps = {side: sorted(glob.glob("%s/%s/%s_input_*" % (FOLDER, side, name))) for side in ("icet", "dfb")}
        inputs = {side: [pixels for _, pixels in sorted(map(read_dump, dumps[side]), key=lambda dump: dump[0])]
                  for side in dumps}
        same = len(inputs["icet"]) == len(inputs["dfb"]) > 1 and all(map(numpy.array_equal, *inputs.values()))
        check(name, same, "IceT and dfb were not given the same images")
        for side in inputs:
            _, output = read_dump("%s/%s/%s_output" % (FOLDER, side, name))
            off = output - exact(inputs[side])
            wrong = (abs(off) > 0.5 + 1e-9).any(axis=2)
            print("%-18s %8d %8d   %+.2f to %+.2f, mean %+.3f where anything is" % (
                name + " " + side, wrong.size, wrong.sum(), off.min(), off.max(), off[output[..., 3] > 0].mean()))
            if side == "dfb":
                check(name, not wrong.any(), "dfb is off by more than half a level")


def print_times():
    print("\n%-18s %-28s %-28s" % ("ms: quartile, median, quartile", "a frame", "compositing it"))
    for name in "opaque volume transparent".split():
        for side in ("icet", "dfb"):
            with open("%s/%s/times.txt" % (FOLDER, side)) as file:
                figures = next((line.split()[1:] for line in file if line.split()[0] == name), None)
            check(name, figures, "%s was not timed" % side)
            print("%-30s %8s %8s %8s   %8s %8s %8s" % (name + " " + side, *(figures or 6 * "?")))


compare_pictures()
compare_blending()
print_times()
for failure in failures:
    print("paraview_compare.py: " + failure, file=sys.stderr)
sys.exit(1 if failures else 0)
