"""A volume in bricks, rendered by numpy. Each rank has its own bricks of a field, and no other.

    mpirun -n 4 python3 -m mpi4py volume.py           with mpi4py
    python3 volume.py --threads 4                     ranks are threads
"""
import argparse

import numpy as np

import dfb

BRICKS, STEP = 3, 1 / 90  # bricks along each side of a cube from -1 to 1; length of a step along a ray
CAMERA = dfb.PerspectiveCamera(eye=(2.6, 1.9, 3.1), target=(0, -0.05, 0), fov_y=32)
LIGHT = np.array((0.2, 0.9, 0.35))


def density(p):
    """Of points: above 0 within the walls between two labyrinths (a gyroid), in a ball."""
    q = 7 * p
    wall = np.abs((np.sin(q) * np.cos(np.roll(q, -1, axis=-1))).sum(axis=-1))
    return np.clip(0.4 - wall, 0, 1) * np.clip(9 - 9 * np.square(p).sum(axis=-1), 0, 1)


def draw(brick, tile):
    """Marches along the rays of a tile through a brick, front to back."""
    origins, directions = (a.astype(np.float64) for a in CAMERA.rays(tile))
    first, second = ((np.array(corner) - origins) / directions for corner in (brick.lower, brick.upper))
    near, far = np.minimum(first, second).max(axis=2), np.maximum(first, second).min(axis=2)
    y, x = np.nonzero(near < far)  # the rays that meet the brick
    origins, directions, near, far = origins[y, x], directions[y, x], near[y, x], far[y, x]
    color, through = np.zeros((len(x), 3)), np.ones(len(x))  # through: the part of the light behind that is seen
    # Steps are at the same distances from the eye in all bricks, so that there are no seams.
    for step in range(int(near.min(initial=9) / STEP), int(far.max(initial=0) / STEP) + 1):
        t = (step + 0.5) * STEP
        points = origins + t * directions
        here = density(points) * ((t >= near) & (t < far))
        alpha = 1 - np.exp(-110 * STEP * here)
        lit = 0.3 + np.clip(3 * (here - density(points + 0.07 * LIGHT)), -0.22, 0.7)
        warm = np.clip(np.linalg.norm(points, axis=1) * 1.5 - 0.55, 0, 1)[:, None]
        color += (through * alpha * lit)[:, None] * (warm * (1, 0.55, 0.2) + (1 - warm) * (0.1, 0.5, 1.1))
        through *= 1 - alpha
    tile.rgba[y, x, :3], tile.rgba[y, x, 3] = color, 1 - through
    tile.depth[y, x] = near


def render(comm, size, name):
    edges = np.linspace(-1, 1, BRICKS + 1)
    cells = [(i, j, k) for i in range(BRICKS) for j in range(BRICKS) for k in range(BRICKS)]
    bricks = [dfb.Brick(id, lower=[edges[i] for i in cell], upper=[edges[i + 1] for i in cell])
              for id, cell in enumerate(cells) if id % comm.size == comm.rank]
    with dfb.FrameBuffer(comm, size, size, output="srgb8", background=(0.02, 0.025, 0.04, 1)) as fb:
        report = fb.render(bricks, CAMERA, draw)
        if fb.is_display_rank:
            with open(name, "wb") as file:
                file.write(b"P6 %d %d 255\n" % (size, size) + fb.image[..., :3].tobytes())
            print(report)


parser = argparse.ArgumentParser()
parser.add_argument("--threads", type=int, help="run this many ranks as threads, without MPI")
parser.add_argument("--size", type=int, default=480, help="width and height of the picture in pixels (480)")
parser.add_argument("picture", nargs="?", default="volume.ppm", help="file to write (volume.ppm)")
arguments = parser.parse_args()
if arguments.threads:
    dfb.run_ranks(arguments.threads, lambda comm: render(comm, arguments.size, arguments.picture))
else:
    from mpi4py import MPI
    render(MPI.COMM_WORLD, arguments.size, arguments.picture)
