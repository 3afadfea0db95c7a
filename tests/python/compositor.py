"""ImageCompositor: each form of input, each way to blend, beside the reference."""
import itertools
import unittest

import numpy as np

import dfb
from support import HEIGHT, WIDTH, assert_exact, blended, in_order, nearest, pixels

RANKS = 3
BACKGROUND = (0.25, 0.125, 0.5, 0.75)


def padded(array):
    """The same values in rows with a gap."""
    room = np.full((array.shape[0], array.shape[1] + 7) + array.shape[2:], 199, array.dtype)
    room[:, :array.shape[1]] = array
    return room[:, :array.shape[1]]


def upside_down(array):
    """The same values, with the lowest row first in memory."""
    return np.ascontiguousarray(array[::-1])[::-1]


FORMS = {"plain": lambda a: a, "padded": padded, "upside down": upside_down,
         "both": lambda a: padded(np.ascontiguousarray(a[::-1]))[::-1]}


def composite(images, depths, places=None, blend="nearest", **options):
    """The picture and its depth, of one image for each rank."""
    settings = {name: options.pop(name) for name in ("output", "depth", "background", "display_rank") if name in options}

    def rank(comm):
        with dfb.ImageCompositor(comm, WIDTH, HEIGHT, blend, **settings) as compositor:
            report = compositor.composite(images[comm.rank], None if depths is None else depths[comm.rank],
                                          None if places is None else places[comm.rank], **options)
            assert report.frame == 1 and report.tiles_total == 4, report  # strips of 27 rows
            return compositor.image, compositor.depth

    results = dfb.run_ranks(len(images), rank)
    display = settings.get("display_rank", 0)
    assert all(r == (None, None) for i, r in enumerate(results) if i != display)
    return results[display]


class Compositor(unittest.TestCase):
    def test_forms(self):
        for kind, output, (name, form) in itertools.product((np.uint8, np.float32), ("rgba8", "rgba32f"), FORMS.items()):
            images, depths = zip(*(pixels(rank, kind) for rank in range(RANKS)))
            with self.subTest(kind=kind, output=output, form=name):
                given = [form(i) for i in images]
                image, depth = composite(given, [form(d) for d in depths], blend="depth", output=output, depth=True,
                                         background=BACKGROUND)
                expected, nearest_depth = blended(images, depths, BACKGROUND)
                assert_exact(image, expected)
                np.testing.assert_array_equal(depth, nearest_depth)
                # Depths that lie otherwise than colours
                image, _ = composite(given, depths, blend="depth", output=output, background=BACKGROUND)
                assert_exact(image, expected)

    def test_nearest(self):
        for kind, opaque in itertools.product((np.uint8, np.float32), (True, False)):
            images, depths = zip(*(pixels(rank, kind, opaque) for rank in range(RANKS)))
            with self.subTest(kind=kind, opaque=opaque):
                image, depth = composite(images, depths, depth=True, background=BACKGROUND)
                expected, nearest_depth = nearest(images, depths, BACKGROUND)
                assert_exact(image, expected)
                np.testing.assert_array_equal(depth, nearest_depth)

    def test_place(self):
        """From front to back, also seen from behind; wrong boxes on one rank are an error on all."""
        def rank(comm):
            with dfb.ImageCompositor(comm, 8, 8, "order") as compositor:
                left = (1, 2, 0)[comm.rank]
                box = (left, 0, 0), (left + 1, 1, 1)
                places = [compositor.place(*box, eye) for eye in ((-5, 0, 0), (9.5, 0.5, 0.5), np.array([1.5, 0, 9]))]
                wrong = []
                for lower, upper in (("red", box[1]) if comm.rank == 1 else box, box[::-1] if comm.rank == 2 else box,
                                     ((0, 0, 0), (1, 1, 1))):
                    try:
                        compositor.place(lower, upper, (0, 0, 9))
                    except dfb.Error as error:
                        wrong.append((error.kind, error.rank, str(error)))
                return places, wrong

        results = dfb.run_ranks(3, rank)
        self.assertEqual([places[0] for places, _ in results], [1, 2, 0])
        self.assertEqual([places[1] for places, _ in results], [1, 0, 2])
        self.assertEqual([places[2] for places, _ in results], [0, 1, 2])
        for _, wrong in results:
            self.assertEqual([(kind, number) for kind, number, _ in wrong[:2]],
                             [("InvalidArgument", 1), ("InvalidArgument", 2)])
            self.assertIn("lower is 'red': it must be three floats", wrong[0][2])
            self.assertIn("are not a box", wrong[1][2])
            self.assertIn("overlap", wrong[2][2])

    def test_order(self):
        for kind in (np.uint8, np.float32):
            images = [pixels(rank, kind)[0] for rank in range(RANKS)]
            with self.subTest(kind=kind):
                image, depth = composite(images, None, places=(2, 0, 1), blend="order", output="rgba32f")
                assert_exact(image, in_order(images, (2, 0, 1)))
                self.assertIsNone(depth)

    def test_bottom_up(self):
        images, depths = zip(*(pixels(rank) for rank in range(RANKS)))
        expected, _ = blended(images, depths)
        image, _ = composite([np.ascontiguousarray(i[::-1]) for i in images],
                             [np.ascontiguousarray(d[::-1]) for d in depths], blend="depth", bottom_up=True)
        assert_exact(image, expected)
        # Twice upside down: the first row is the lowest, and the last in memory.
        image, _ = composite([i[::-1] for i in images], [d[::-1] for d in depths], blend="depth", bottom_up=True)
        assert_exact(image, expected)

    def test_bgra_and_straight_alpha(self):
        images, depths = zip(*(pixels(rank, np.float32) for rank in range(RANKS)))
        straight = [np.concatenate([np.divide(i[..., :3], i[..., 3:], out=np.zeros_like(i[..., :3]), where=i[..., 3:] > 0),
                                    i[..., 3:]], axis=2) for i in images]
        again = [np.concatenate([s[..., :3] * s[..., 3:], s[..., 3:]], axis=2) for s in straight]
        image, _ = composite([np.ascontiguousarray(s[..., [2, 1, 0, 3]]) for s in straight], depths, blend="depth",
                             output="rgba32f", bgra=True, straight_alpha=True)
        assert_exact(image, blended(again, depths)[0])

    def test_far_depth(self):
        images, depths = zip(*(pixels(rank, opaque=True) for rank in range(RANKS)))
        images = [np.where(np.isinf(d)[..., None], 99, i).astype(np.uint8) for i, d in zip(images, depths)]
        image, _ = composite(images, [np.where(np.isinf(d), np.float32(1), d) for d in depths], far_depth=1)
        assert_exact(image, nearest(images, depths)[0])

    def test_parts(self):
        """Each rank has a part of the picture, some of it outside."""
        origins = ((10, 20), (-30, 60), (100, -50))
        for flip in (False, True):
            images, depths, given = [], [], []
            for rank, (x, y) in enumerate(origins):
                rgba, depth = pixels(rank)
                whole, far = np.zeros_like(rgba), np.full_like(depth, np.inf)
                ys, xs = np.mgrid[0:HEIGHT, 0:WIDTH]
                inside = (xs + x >= 0) & (xs + x < WIDTH) & (ys + y >= 0) & (ys + y < HEIGHT)
                whole[ys[inside] + y, xs[inside] + x] = rgba[inside]
                far[ys[inside] + y, xs[inside] + x] = depth[inside]
                images.append(whole), depths.append(far)
                given.append((upside_down(rgba), upside_down(depth)) if flip else (rgba, depth))

            def rank(comm):
                with dfb.ImageCompositor(comm, WIDTH, HEIGHT, "depth") as compositor:
                    compositor.composite(*given[comm.rank], origin=origins[comm.rank])
                    return compositor.image

            with self.subTest(flip=flip):
                assert_exact(dfb.run_ranks(RANKS, rank)[0], blended(images, depths)[0])

    def test_ranks_with_nothing(self):
        rgba, depth = pixels(1)
        image, _ = composite([None, rgba, np.zeros((HEIGHT, WIDTH, 4), np.uint8)],
                             [None, depth, np.full((HEIGHT, WIDTH), np.inf, np.float32)])
        assert_exact(image, nearest([rgba], [depth])[0])
        image, _ = composite([None, rgba], None, places=(None, 0), blend="order")
        assert_exact(image, in_order([rgba], (0,)))

    def test_display_rank_and_all_ranks(self):
        images, depths = zip(*(pixels(rank) for rank in range(RANKS)))
        expected, _ = nearest(images, depths)
        assert_exact(composite(images, depths, display_rank=2)[0], expected)

        def rank(comm):
            with dfb.ImageCompositor(comm, WIDTH, HEIGHT, depth=True, display_rank=1) as compositor:
                self.assertEqual(compositor.is_display_rank, comm.rank == 1)
                self.assertEqual(compositor.image_on_all_ranks(), (None, None))
                compositor.composite(images[comm.rank], depths[comm.rank])
                return compositor.image_on_all_ranks()

        for image, depth in dfb.run_ranks(RANKS, rank):
            assert_exact(image, expected)
            np.testing.assert_array_equal(depth, np.min(depths, axis=0))

    def test_srgb(self):
        rgba = np.zeros((HEIGHT, WIDTH, 4), np.float32)
        rgba[..., 0] = rgba[..., 1] = np.linspace(0, 1, WIDTH)
        rgba[..., 3] = 1
        image, _ = composite([rgba], [np.ones((HEIGHT, WIDTH), np.float32)], output="srgb8")
        linear = rgba[..., 0].astype(np.float64)
        curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        assert np.abs(image[..., 0] - 255 * curve).max() < 0.5 + 1e-6

    def test_one_rank_without_a_communicator(self):
        rgba, depth = pixels(0)
        with dfb.ImageCompositor(None, WIDTH, HEIGHT, threads=1) as compositor:
            self.assertEqual((compositor.rank, compositor.size, compositor.width, compositor.height),
                             (0, 1, WIDTH, HEIGHT))
            self.assertIsNone(compositor.image)
            report = compositor.composite(rgba, depth)
            self.assertEqual(report.threads, 1)
            self.assertEqual(report.order_undefined_pixels, 0)
            self.assertGreater(report.total_ms, 0)
            self.assertIn("frame 1", repr(report))
            assert_exact(compositor.image, nearest([rgba], [depth])[0])
            compositor.resize(40, 30)
            self.assertIsNone(compositor.image)
            compositor.composite(np.ascontiguousarray(rgba[:30, :40]), np.ascontiguousarray(depth[:30, :40]))
            assert_exact(compositor.image, nearest([rgba[:30, :40]], [depth[:30, :40]])[0])


if __name__ == "__main__":
    unittest.main()
