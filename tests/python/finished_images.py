"""examples/finished_images.cpp in Python: the same picture, bit for bit. finished_images.py PICTURE: that of the example."""
import sys

import numpy as np

import dfb

WIDTH, HEIGHT, BALLS, RANKS = 640, 480, 4, 3
f = np.float32


def render(numbers):
    """Pixels and depths of these balls as the example has them: in float32, step by step."""
    pixels, depths = np.zeros((HEIGHT, WIDTH, 4), np.uint8), np.ones((HEIGHT, WIDTH), f)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(f)
    for number in numbers:
        radius, distance = f(110), f(300) + f(40) * f(number % 3)
        dx = (x - (f(190) + f(85) * f(number % 4))) / radius
        dy = (y - (f(200) + f(60) * f(number % 2))) / radius
        square = dx * dx + dy * dy
        towards = np.sqrt(np.maximum(f(1) - square, f(0)))
        depth = (distance - radius * towards) / f(600)
        shown = (square < 1) & (depth < depths)
        light = f(0.25) + f(0.75) * np.maximum(f(0), f(0.5) * dy - f(0.4) * dx + f(0.75) * towards)
        for c in range(3):
            pixels[shown, c] = (f(255 if (number + c) % 3 == 0 else 110) * light)[shown].astype(np.uint8)
        pixels[shown, 3] = 255
        depths[shown] = depth[shown]
    return pixels, depths


def rank(comm):
    with dfb.ImageCompositor(comm, WIDTH, HEIGHT, background=(0.1, 0.1, 0.12, 1)) as compositor:
        compositor.composite(*render(range(comm.rank, BALLS, comm.size)), bottom_up=True, far_depth=1)
        return compositor.image


image = dfb.run_ranks(RANKS, rank)[0]
with open(sys.argv[1], "rb") as file:
    expected = file.read()
pixels = np.frombuffer(expected[-3 * WIDTH * HEIGHT:], np.uint8).reshape(HEIGHT, WIDTH, 3)
differing = (image[..., :3] != pixels).any(axis=2).sum()
print(f"{differing} of {WIDTH * HEIGHT} pixels differ from the picture of the C++ program")
sys.exit(int(differing > 0))
