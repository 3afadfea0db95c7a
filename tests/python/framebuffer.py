"""FrameBuffer: bricks rendered by a function, blended by the library or by a function, beside the reference."""
import pickle
import subprocess
import sys
import time
import unittest

import numpy as np

import dfb
from support import assert_exact, blended, error_of, nearest

WIDTH, HEIGHT, BRICKS = 200, 130, 5
CAMERA = dfb.PerspectiveCamera((0.5, 0.4, 7), (0, 0, 0), (0, 1, 0), 40)
BACKGROUND = (0.1, 0.2, 0.3, 1)


def bricks():
    """Boxes beside each other that cross the borders of tiles, one of them outside of the picture."""
    return [dfb.Brick(10 + i, (i - 2.5, -1, -0.5), (i - 1.5, 1, 0.5), data=0.2 + 0.15 * i) for i in range(BRICKS)] + [
        dfb.Brick(99, (500, 0, 0), (501, 1, 1), data=1)]


def draw(brick, tile):
    """A coloured box, half transparent, for which every ray is clipped by numpy."""
    origins, directions = CAMERA.rays(tile)
    with np.errstate(divide="ignore"):
        first, second = (np.asarray(corner, np.float32) - origins for corner in (brick.lower, brick.upper))
        first, second = first / directions, second / directions
    near, far = np.minimum(first, second).max(axis=2), np.maximum(first, second).min(axis=2)
    hit = (near < far) & (far > 0)
    alpha = np.where(hit, 1 - np.exp(-(far - near).clip(0)), 0)
    tile.rgba[...] = alpha[..., None] * np.array([brick.data, 1 - brick.data, 0.5, 1])
    tile.depth[hit] = near[hit]


class WholeTile:
    """The picture as one tile, for the reference."""

    def __init__(self, draw_brick, brick):
        self.rgba, self.depth = np.zeros((HEIGHT, WIDTH, 4), np.float32), np.full((HEIGHT, WIDTH), np.inf, np.float32)
        draw_brick(brick, self)


def expected_layers():
    """Each brick's pixels, rendered tile by tile by one rank without blending any."""
    layers = []
    for brick in bricks():
        with dfb.FrameBuffer(None, WIDTH, HEIGHT, "nearest", "rgba32f", depth=True) as fb:
            fb.render([brick], CAMERA, draw)
            layers.append((fb.image.copy(), fb.depth.copy()))
    return layers


def render(blend, ranks=3, function=draw, **options):
    def rank(comm):
        with dfb.FrameBuffer(comm, WIDTH, HEIGHT, blend, background=BACKGROUND, **options) as fb:
            report = fb.render(bricks()[comm.rank::comm.size], CAMERA, function)
            assert 0 < report.tiles_touched <= report.tiles_total == 12, report
            return fb.image, fb.depth

    return dfb.run_ranks(ranks, rank)[0]


def over(inputs):
    """The alpha blend in numpy, as a prototype of an operation."""
    order = np.argsort(np.stack([i.depth for i in inputs]), axis=0, kind="stable")
    layers = np.take_along_axis(np.stack([i.rgba for i in inputs]).astype(np.float64), order[..., None], axis=0)
    result = np.zeros(layers[0].shape)
    for layer in layers:
        result += (1 - result[..., 3:]) * layer
    return result, np.min([np.where(i.rgba[..., 3] > 0, i.depth, np.inf) for i in inputs], axis=0)


class FrameBuffer(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.layers = expected_layers()
        cls.images, cls.depths = zip(*cls.layers)
        assert all(image.any() for image in cls.images[:BRICKS]) and not cls.images[BRICKS].any()

    def test_alpha(self):
        expected, depth = blended(self.images, self.depths, BACKGROUND)
        for ranks in (1, 2, 4):
            with self.subTest(ranks=ranks):
                image, image_depth = render("alpha", ranks, output="rgba32f", depth=True)
                assert_exact(image, expected)
                np.testing.assert_array_equal(image_depth, depth)
        assert_exact(render("alpha")[0], expected)

    def test_nearest(self):
        image, _ = render("nearest", output="rgba32f")
        assert_exact(image, nearest(self.images, self.depths, BACKGROUND)[0])

    def test_operation(self):
        """An operation in numpy gives what the library's does, also its depth."""
        image, depth = render(over, output="rgba32f", depth=True)
        expected, expected_depth = blended(self.images, self.depths, BACKGROUND)
        assert_exact(image, expected)
        np.testing.assert_array_equal(depth, expected_depth)
        image, depth = render(lambda inputs: over(inputs)[0], depth=True)
        assert_exact(image, expected)
        self.assertTrue(np.isinf(depth).all())

    def test_one_at_a_time(self):
        """No two calls of the functions are under way at once, also while one lets other threads have the GIL."""
        inside, most = [], []

        def alone(function):
            def call(*arguments):
                inside.append(None)
                most.append(len(inside))
                time.sleep(0.001)
                result = function(*arguments)
                inside.pop()
                return result
            return call

        render(alone(over), 1, alone(draw), threads=4)
        self.assertGreater(len(most), 12)
        self.assertEqual(max(most), 1)

    def test_fork(self):
        """A process that is forked off ends without a call of the objects of the first one."""
        program = """
import os, sys, dfb
with dfb.FrameBuffer(None, 64, 64) as left:
    kept = dfb.FrameBuffer(None, 64, 64)
    child = os.fork()
    if child == 0:
        sys.exit(0)
    sys.exit(os.waitpid(child, 0)[1] != 0)
"""
        self.assertEqual(subprocess.run([sys.executable, "-c", program], timeout=60).returncode, 0)

    def test_inputs_of_an_operation(self):
        seen = []

        def last(inputs):
            seen.append([i.source for i in inputs])
            shapes = {(i.rgba.shape[:2], i.depth.shape, i.rgba.dtype.name, i.depth.dtype.name) for i in inputs}
            assert len(shapes) == 1, shapes
            assert all(np.isinf(i.depth[~i.rgba.any(axis=2)]).all() for i in inputs)
            return inputs[-1].rgba

        image, _ = render(last, output="rgba32f")
        self.assertTrue(all(sources == sorted(sources) and sources for sources in seen), seen)
        self.assertTrue(any(len(sources) > 1 for sources in seen))
        self.assertNotIn(99, sum(seen, []))
        self.assertLessEqual(len(seen), 12)

    def test_bytes(self):
        """Colours of uint8 are levels, as those of images are."""
        def gray(brick, tile):
            tile.rgba = np.full((tile.height, tile.width, 4), 51, np.uint8)

        everywhere = dfb.Brick(1, (-50, -50, -50), (50, 50, 50))
        with dfb.FrameBuffer(None, WIDTH, HEIGHT) as fb:
            fb.render([everywhere], CAMERA, gray)
            np.testing.assert_array_equal(fb.image, 51)

    def test_tiles(self):
        """They lie where they say, and may be replaced."""
        tiles = []

        def rows_and_columns(brick, tile):
            tiles.append((tile.index, tile.x0, tile.y0, tile.width, tile.height))
            assert (tile.image_width, tile.image_height) == (WIDTH, HEIGHT)
            assert not tile.rgba.any() and np.isinf(tile.depth).all()
            y, x = np.mgrid[tile.y0:tile.y0 + tile.height, tile.x0:tile.x0 + tile.width]
            tile.rgba = np.stack([x, y, x + y, np.ones_like(x)], axis=2)  # integers
            tile.depth = np.ones(x.shape)  # float64

        everywhere = dfb.Brick(1, (-50, -50, -50), (50, 50, 50))
        with dfb.FrameBuffer(None, WIDTH, HEIGHT, output="rgba32f") as fb:
            fb.render([everywhere], CAMERA, rows_and_columns)
            y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
            np.testing.assert_array_equal(fb.image[..., 0], x)
            np.testing.assert_array_equal(fb.image[..., 1], y)
        self.assertEqual(sorted(tiles)[0], (0, 0, 0, 64, 64))
        self.assertEqual(sorted(tiles)[-1], (11, 192, 128, 8, 2))
        self.assertEqual(len(tiles), 12)

    def test_cameras(self):
        """Matrices, orthographic and perspective, in rows; and cameras that have been sent to another process."""
        def coverage(brick, tile):
            tile.rgba[...] = 1
            tile.depth[...] = 1

        orthographic = dfb.MatrixCamera(np.eye(4), np.diag([0.5, 1, -0.1, 1]))
        self.assertTrue(orthographic.orthographic)
        view = np.eye(4)
        view[:3, 3] = 0, 0, -7
        projection = np.array([[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, -1.1, -0.2], [0, 0, -1, 0]])
        perspective = dfb.MatrixCamera(view, projection)
        np.testing.assert_allclose(perspective.eye, (0, 0, 7), atol=1e-6)
        self.assertEqual(CAMERA.eye, (0.5, np.float32(0.4), 7))
        rays = []

        def keep(camera):
            def function(brick, tile):
                coverage(brick, tile)
                rays.append((camera.rays(tile), tile.x0, tile.y0))
                np.testing.assert_array_equal(pickle.loads(pickle.dumps(camera)).rays(tile), camera.rays(tile))
            return function

        self.assertEqual(pickle.loads(pickle.dumps(CAMERA)).eye, CAMERA.eye)
        empty = dfb.PerspectiveCamera.__new__(dfb.PerspectiveCamera)
        self.assertRegex(str(error_of(lambda: empty.__setstate__(b"old"))), "another version of dfb")
        for camera in (orthographic, perspective):
            rays.clear()
            with dfb.FrameBuffer(None, WIDTH, HEIGHT) as fb:
                report = fb.render([dfb.Brick(1, (0.1, 0.1, -0.1), (0.2, 0.2, 0.1))], camera, keep(camera))
                self.assertTrue(0 < report.tiles_touched <= 4, report)
            (origins, directions), x0, y0 = rays[0]
            self.assertEqual((origins.shape, directions.shape), (directions.shape, (64, 64, 3)))
            np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1, atol=1e-6)
            column, row = 2 * (x0 + 3.5) / WIDTH - 1, 1 - 2 * (y0 + 1.5) / HEIGHT
            if camera is orthographic:
                np.testing.assert_allclose(directions[1, 3], (0, 0, -1), atol=1e-6)
                np.testing.assert_allclose(origins[1, 3, :2], (2 * column, row), atol=1e-5)
            else:
                np.testing.assert_allclose(origins[1, 3], (0, 0, 7), atol=1e-6)
                way = directions[1, 3]
                np.testing.assert_allclose(way[:2] / -way[2], (column, row / 2), atol=1e-5)

    def test_many_frames_of_many_ranks(self):
        """The GIL goes round: ranks, workers and operations all want it."""
        def rank(comm):
            with dfb.FrameBuffer(comm, WIDTH, HEIGHT, over, threads=2) as fb:
                sums = []
                for _ in range(5):
                    fb.render(bricks()[comm.rank::comm.size], CAMERA, draw)
                    sums.append(None if fb.image is None else int(fb.image.sum()))
                self.assertEqual(len(set(sums)), 1)

        dfb.run_ranks(4, rank)


if __name__ == "__main__":
    unittest.main()
