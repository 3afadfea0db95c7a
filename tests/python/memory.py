"""Arrays of the image: no copies, never without their memory, and none of the arguments is copied."""
import gc
import unittest

import numpy as np

import dfb
from support import HEIGHT, WIDTH, assert_exact, error_of, nearest, pixels

CAMERA = dfb.PerspectiveCamera((0, 0, 7), (0, 0, 0))


def address(array):
    return array.__array_interface__["data"][0]


def fill(value):
    def draw(_, tile):
        tile.rgba[...] = value
        tile.depth[...] = value
    return draw


EVERYWHERE = dfb.Brick(0, (-50, -50, -50), (50, 50, 50))


class Memory(unittest.TestCase):
    def test_views(self):
        """The image is where the library has it, read-only, and the next picture is written there."""
        rgba, depth = pixels(0)
        with dfb.ImageCompositor(None, WIDTH, HEIGHT, depth=True) as compositor:
            compositor.composite(rgba, depth)
            image, depths = compositor.image, compositor.depth
            self.assertEqual(address(image), address(compositor.image))
            self.assertFalse(image.flags.owndata or image.flags.writeable or depths.flags.writeable)
            with self.assertRaises(ValueError):
                image[0, 0, 0] = 1
            with self.assertRaises(ValueError):
                image.flags.writeable = True
            kept = image.copy()
            compositor.composite(*pixels(1))
            self.assertEqual(address(image), address(compositor.image))
            assert_exact(image, nearest(*zip(pixels(1)))[0])
            assert_exact(kept, nearest([rgba], [depth])[0])

    def test_views_outlive_the_object(self):
        rgba, depth = pixels(0)
        expected = nearest([rgba], [depth])[0]

        def rank(comm):
            with dfb.ImageCompositor(comm, WIDTH, HEIGHT, depth=True, output="rgba32f") as compositor:
                compositor.composite(rgba if comm.rank == 0 else None, depth if comm.rank == 0 else None)
                image, depths = compositor.image, compositor.depth
            return None if image is None else (image, image[5:9, ::2], memoryview(depths))

        image, part, depths = dfb.run_ranks(3, rank)[0]
        del rank
        gc.collect()
        noise = [np.random.default_rng(i).random((HEIGHT, WIDTH, 4)) for i in range(50)]  # takes what was given back
        assert_exact(image, expected)
        del image
        gc.collect()
        noise += [np.full((HEIGHT, WIDTH, 4), 7.0) for _ in range(50)]
        assert_exact(part, expected[5:9, ::2])
        np.testing.assert_array_equal(np.asarray(depths), depth)

    def test_views_of_a_framebuffer(self):
        with dfb.FrameBuffer(None, WIDTH, HEIGHT, output="rgba32f", depth=True) as fb:
            fb.render([EVERYWHERE], CAMERA, fill(1))
            image = fb.image
            fb.render([EVERYWHERE], CAMERA, fill(0.5))
            self.assertEqual(address(image), address(fb.image))
            self.assertTrue((image == 0.5).all())
            with self.assertRaises(BufferError):
                fb.resize(10, 10)
        self.assertTrue((image == 0.5).all())

    def test_resize_with_views(self):
        """Is refused on all ranks, as long as there is any array; nothing has changed then."""
        images, depths = zip(*(pixels(r) for r in range(3)))
        expected = nearest(images, depths)[0]

        def rank(comm):
            with dfb.ImageCompositor(comm, WIDTH, HEIGHT, depth=True) as compositor:
                compositor.composite(images[comm.rank], depths[comm.rank])
                for take in (lambda: compositor.image, lambda: compositor.depth, lambda: memoryview(compositor.image),
                             lambda: compositor.image[3:, 1]):
                    if comm.rank == 0:
                        view = take()
                        gc.collect()
                        with self.assertRaisesRegex(BufferError, "arrays of the image") as caught:
                            compositor.resize(40, 30)
                        self.assertIsInstance(caught.exception.__cause__, dfb.Error)
                        del caught, view
                    else:
                        error = error_of(lambda: compositor.resize(40, 30))
                        self.assertEqual((error.kind, error.rank), ("InvalidArgument", 0))
                        self.assertIn("arrays of the image", str(error))
                    self.assertEqual((compositor.width, compositor.height), (WIDTH, HEIGHT))
                    if comm.rank == 0:
                        assert_exact(compositor.image, expected)
                compositor.resize(40, 30)
                self.assertEqual((compositor.width, compositor.height), (40, 30))
                self.assertIsNone(compositor.image)
                compositor.composite(np.ascontiguousarray(images[comm.rank][:30, :40]),
                                     np.ascontiguousarray(depths[comm.rank][:30, :40]))
                if comm.rank == 0:
                    assert_exact(compositor.image, expected[:30, :40])

        dfb.run_ranks(3, rank)

    def test_a_failed_picture(self):
        """There is no image after it; arrays of earlier ones still have their memory."""
        rgba, depth = pixels(0)
        with dfb.ImageCompositor(None, WIDTH, HEIGHT) as compositor:
            compositor.composite(rgba, depth)
            image = compositor.image
            error_of(lambda: compositor.fail("no"))
            self.assertIsNone(compositor.image)
            image.sum()
            compositor.composite(*pixels(2))
            assert_exact(image, nearest(*zip(pixels(2)))[0])

    def test_copies_on_all_ranks(self):
        rgba, depth = pixels(0)

        def rank(comm):
            with dfb.ImageCompositor(comm, WIDTH, HEIGHT, depth=True) as compositor:
                compositor.composite(rgba if comm.rank else None, depth if comm.rank else None)
                copies = compositor.image_on_all_ranks()
                compositor.resize(20, 10)  # they are nobody else's
                for copy in copies:
                    copy += 0  # may be written to
                return copies

        for image, depths in dfb.run_ranks(3, rank):
            assert_exact(image, nearest([rgba], [depth])[0])
            np.testing.assert_array_equal(depths, depth)

    def test_arguments_are_released(self):
        """No reference to what a call was given stays."""
        import sys
        rgba, depth = pixels(0)
        brick, draw = dfb.Brick(0, (-1, -1, -1), (1, 1, 1)), fill(1)
        kept = rgba, depth, brick, draw, CAMERA
        with dfb.ImageCompositor(None, WIDTH, HEIGHT) as compositor, dfb.FrameBuffer(None, WIDTH, HEIGHT) as fb:
            before = [sys.getrefcount(thing) for thing in kept]
            for _ in range(20):
                compositor.composite(rgba, depth)
                error_of(lambda: compositor.composite(rgba[..., :3], depth))
                fb.render([brick], CAMERA, draw)
                fb.image
            gc.collect()
            self.assertEqual([sys.getrefcount(thing) for thing in kept], before)

    def test_an_operation_is_released(self):
        import weakref

        def operation(inputs):
            raise ValueError("no")

        alive = weakref.ref(operation)
        with dfb.FrameBuffer(None, WIDTH, HEIGHT, operation) as fb:
            error_of(lambda: fb.render([EVERYWHERE], CAMERA, fill(1)))
        del operation, fb
        gc.collect()
        self.assertIsNone(alive())

    def test_an_operation_that_refers_to_its_framebuffer_is_released(self):
        import weakref

        class Owner:
            def mix(self, inputs):
                return inputs[0].rgba

        owner = Owner()
        owner.fb = dfb.FrameBuffer(None, WIDTH, HEIGHT, owner.mix)
        owner.fb.render([EVERYWHERE], CAMERA, fill(1))
        owner.fb.close()
        alive = weakref.ref(owner)
        del owner
        gc.collect()
        self.assertIsNone(alive())

    def test_a_failed_frame_keeps_nothing_of_its_renderer(self):
        import weakref

        class Local:
            pass

        seen = []

        def draw(brick, tile):
            local = Local()
            seen.append(weakref.ref(local))
            raise ValueError("no")

        for operation in ("alpha", lambda inputs: inputs[0].rgba):
            with dfb.FrameBuffer(None, WIDTH, HEIGHT, operation) as fb:
                error_of(lambda: fb.render([EVERYWHERE], CAMERA, draw))
                gc.collect()
                self.assertTrue(seen and all(local() is None for local in seen))


if __name__ == "__main__":
    unittest.main()
