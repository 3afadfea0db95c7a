"""What goes wrong on one rank comes out on all, as dfb.Error; and nothing hangs."""
import pickle
import threading
import traceback
import unittest
import warnings

import numpy as np

import dfb
from support import HEIGHT, WIDTH, assert_exact, error_of, nearest, pixels

RANKS = 3
CAMERA = dfb.PerspectiveCamera((0, 0, 7), (0, 0, 0))


def brick(rank):
    return dfb.Brick(rank, (rank - 1.5, -1, -1), (rank - 0.5, 1, 1))


def fill(_, tile):
    tile.rgba[...] = 1
    tile.depth[...] = 1


def errors_of(make, call, again=lambda thing, rank: None):
    """The dfb.Error of each rank in call(thing, rank); then again() must work."""
    def rank(comm):
        with make(comm) as thing:
            error = error_of(lambda: call(thing, comm.rank))
            again(thing, comm.rank)
            return error

    return dfb.run_ranks(RANKS, rank)


def framebuffer(comm, **options):
    return dfb.FrameBuffer(comm, WIDTH, HEIGHT, **options)


def compositor(comm, **options):
    return dfb.ImageCompositor(comm, WIDTH, HEIGHT, **options)


class Errors(unittest.TestCase):
    def test_renderer_throws_on_one_rank(self):
        class Unreadable(Exception):
            pass

        def failing(thing, rank):
            def draw(brick, tile):
                if rank == 1 and tile.x0 == 64:
                    raise Unreadable("no such file")
                fill(brick, tile)
            thing.render([brick(rank)], CAMERA, draw)

        def again(thing, rank):
            self.assertIsNone(thing.image)
            thing.render([brick(rank)], CAMERA, fill)
            self.assertEqual(thing.image is not None, rank == 0)

        errors = errors_of(framebuffer, failing, again)
        for error in errors:
            self.assertEqual((error.kind, error.rank, error.frame), ("UserCode", 1, 1))
            self.assertIn(error.tile, (1, 4))
            self.assertEqual(error.message, "Unreadable: no such file")
            self.assertIn("rank 1", str(error))
            self.assertIn("Unreadable: no such file", str(error))
            self.assertIsNone(error.generation)
        self.assertEqual(len({str(e) for e in errors}), 1)
        self.assertIsInstance(errors[1].__cause__, Unreadable)
        self.assertEqual(errors[1].__cause__.__traceback__.tb_frame.f_code.co_name, "draw")
        self.assertIsNone(errors[0].__cause__)
        again = pickle.loads(pickle.dumps(errors[0]))
        self.assertEqual((str(again), again.rank, again.tile), (str(errors[0]), 1, errors[0].tile))

    def test_exception_without_a_text(self):
        class Mute(Exception):
            def __str__(self):
                raise ValueError("no words")

        def draw(_, tile):
            raise Mute

        error = errors_of(framebuffer, lambda thing, rank: thing.render([brick(rank)], CAMERA, draw))[0]
        self.assertEqual(error.message, "Mute")

    def test_what_ends_a_program_is_no_error(self):
        for ending in (KeyboardInterrupt, SystemExit):
            def body(comm):
                def draw(thing, tile):
                    if comm.rank == 1:
                        raise ending
                    fill(thing, tile)
                with framebuffer(comm) as fb:
                    try:
                        fb.render([brick(comm.rank)], CAMERA, draw)
                    except BaseException as error:
                        return error
            errors = dfb.run_ranks(2, body)
            self.assertIs(type(errors[1]), ending)
            self.assertEqual((type(errors[0]), errors[0].message), (dfb.Error, ending.__name__))

    def test_operation_throws_on_one_rank(self):
        def failing(inputs):
            if inputs[0].source == 1:
                return 1 / 0
            return inputs[0].rgba

        errors = errors_of(lambda comm: framebuffer(comm, blend=failing),
                           lambda thing, rank: thing.render([brick(1)] if rank == 0 else [], CAMERA, fill))
        self.assertEqual(len({str(e) for e in errors}), 1)
        self.assertEqual(errors[0].kind, "UserCode")
        self.assertEqual(errors[0].message, "ZeroDivisionError: division by zero")
        self.assertIsInstance(errors[errors[0].rank].__cause__, ZeroDivisionError)
        self.assertIsNotNone(errors[0].tile)

    def test_what_callbacks_may_give(self):
        def tile_of(**values):
            def draw(_, tile):
                for name, value in values.items():
                    setattr(tile, name, value)
            return lambda thing, rank: thing.render([brick(rank)], CAMERA, draw)

        for values, text in (({"rgba": np.zeros((64, 4))}, r"tile.rgba is \(64, 4\): it must be an array \(\d+, \d+, 4\)"),
                             ({"depth": None}, r"tile.depth is None: it must be an array"), ({"rgba": "red"}, "tile.rgba is 'red'"),
                             ({"rgba": [np.ones(4), {}]}, "tile.rgba is a list"),
                             ({"rgba": np.ma.masked_array(np.ones(4))}, "tile.rgba is a masked array")):
            with self.subTest(text=text):
                self.assertRegex(str(errors_of(framebuffer, tile_of(**values))[2]), text)
        error = errors_of(framebuffer, lambda thing, rank: thing.render(
            [brick(rank)], CAMERA, lambda _, tile: (tile.rgba, tile.depth)))[1]
        self.assertIn("the renderer returned a tuple: it fills tile.rgba and tile.depth, and returns None", str(error))
        for result, text in ((None, "the operation's rgba is None"), ((1, 2, 3), "a tuple of 3"),
                             (np.zeros((3, 3, 4)), r"the operation's rgba is \(3, 3, 4\)")):
            with self.subTest(text=text):
                error = errors_of(lambda comm: framebuffer(comm, blend=lambda inputs: result),
                                  lambda thing, rank: thing.render([brick(rank)], CAMERA, fill))[1]
                self.assertRegex(str(error), text)

    def test_wrong_images_on_one_rank(self):
        rgba, depth = pixels(0)
        read_in_columns = np.asfortranarray(rgba)
        cases = [
            (dict(rgba=rgba), "without depth"),
            (dict(rgba=[[1]]), "rgba is a list: it must be an array of numpy"),
            (dict(rgba=rgba[0]), "rgba has the shape"),
            (dict(rgba=rgba[..., :3], depth=depth), r"rgba is \(93, 150, 3\) of dtype\('uint8'\)"),
            (dict(rgba=rgba.astype(float), depth=depth), "float64.*uint8 or float32"),
            (dict(rgba=rgba.astype(">f4"), depth=depth), "it must be .* of uint8 or float32"),
            (dict(rgba=rgba[1:], depth=depth[1:]), "rgba has 150x92 pixels, the picture 150x93: give origin"),
            (dict(rgba=read_in_columns, depth=depth), "numpy.ascontiguousarray.rgba."),
            (dict(rgba=np.broadcast_to(rgba[:1], rgba.shape), depth=depth), "the rows of rgba overlap"),
            (dict(rgba=rgba, depth=depth.astype(float)), "depth is .*float64"),
            (dict(rgba=rgba, depth=depth[1:]), r"depth is \(92, 150\)"),
            (dict(rgba=rgba, depth=depth.T), r"depth is \(150, 93\)"),
            (dict(rgba=None, depth=depth), "depth without rgba"),
            (dict(rgba=rgba, depth=depth, origin=5), "origin is 5: it must be two ints"),
            (dict(rgba=rgba, depth=depth, origin=(2**30, 0)), "farther outside"),
            (dict(rgba=rgba, depth=depth, bottom_up="yes"), "bottom_up is 'yes': it must be a bool"),
            (dict(rgba=rgba, depth=depth, order="front"), "order is 'front': it must be an int of 32 bits or None"),
            (dict(rgba=rgba, depth=depth, order=np.float32(1)), "order is 1.0: it must be an int"),
            (dict(rgba=rgba, depth=depth, order=2**31), "order is 2147483648: it must be an int of 32 bits"),
            (dict(rgba=rgba, depth=depth, origin=(0, np.float32(0))), "origin is .*: it must be two ints"),
            (dict(rgba=np.ma.masked_array(rgba), depth=depth), "rgba is a masked array: give its filled.0."),
            (dict(rgba=rgba, depth=depth, far_depth=float("nan")), "far_depth is not a number"),
        ]

        def again(thing, rank):
            thing.composite(*pixels(rank))
            if rank == 0:
                assert_exact(thing.image, nearest(*zip(*(pixels(r) for r in range(RANKS))))[0])

        for arguments, text in cases:
            with self.subTest(text=text):
                errors = errors_of(compositor, lambda thing, rank: thing.composite(
                    **(arguments if rank == 1 else dict(rgba=rgba, depth=depth))), again)
                self.assertRegex(str(errors[2]), text)
                self.assertEqual({(str(e), e.rank) for e in errors}, {(str(errors[2]), 1)})
        errors = errors_of(lambda comm: compositor(comm, blend="order"),
                           lambda thing, rank: thing.composite(rgba, order=3 if rank == 1 else rank))
        self.assertRegex(str(errors[0]), "place 3 in an order of 3 ranks")
        errors = errors_of(lambda comm: compositor(comm, blend="order"),
                           lambda thing, rank: thing.composite(rgba, order=None if rank == 1 else rank))
        self.assertEqual({"order is None" in str(e) and e.rank for e in errors}, {1})

    def test_wrong_scenes_on_one_rank(self):
        class Bare:
            id = 4

        good = [brick(2)], CAMERA, fill
        cases = [(([dfb.Brick(1, (0, 0), (1, 1, 1))], CAMERA, fill), "brick.lower is .0, 0.: it must be three floats"),
                 (([dfb.Brick(1, (0, 0, 0), (-1, 1, 1))], CAMERA, fill), "the bounds of brick 1 are not a box"),
                 (([dfb.Brick(-1, (0, 0, 0), (1, 1, 1))], CAMERA, fill), "brick.id is -1"),
                 (([dfb.Brick(np.float32(1.9), (0, 0, 0), (1, 1, 1))], CAMERA, fill), "brick.id is 1.9"),
                 (([dfb.Brick(5, (0, 0, 0), (1, 1, 1))] * 2, CAMERA, fill), "brick 5 was added twice"),
                 (([Bare()], CAMERA, fill), "AttributeError: .*has no attribute 'lower'"),
                 ((brick(1), CAMERA, fill), "bricks is a Brick: it must be a list"),
                 (([brick(1)], "camera", fill), "the camera is 'camera'"),
                 (([brick(1)], CAMERA, 5), "the renderer is 5")]
        for arguments, text in cases:
            with self.subTest(text=text):
                errors = errors_of(framebuffer,
                                   lambda thing, rank: thing.render(*(arguments if rank == 1 else good if rank == 2 else
                                                                      ([], CAMERA, fill))),
                                   lambda thing, rank: thing.render([brick(rank)], CAMERA, fill))
                self.assertRegex(str(errors[0]), text)
                self.assertEqual({(str(e), e.rank) for e in errors}, {(str(errors[0]), 1)})

    def test_fail(self):
        rgba, depth = pixels(0)
        errors = errors_of(compositor, lambda thing, rank: thing.fail(OSError("disk is gone")) if rank == 2
                           else thing.composite(rgba, depth))
        self.assertEqual({(e.message, e.rank) for e in errors}, {("OSError: disk is gone", 2)})
        self.assertEqual([type(e.__cause__) for e in errors].count(OSError), 1)
        errors = errors_of(framebuffer, lambda thing, rank: thing.fail("no data") if rank == 2
                           else thing.render([brick(rank)], CAMERA, fill))
        self.assertEqual({(e.message, e.rank) for e in errors}, {("no data", 2)})
        errors = errors_of(compositor, lambda thing, rank: thing.fail(OSError("no \udcff")) if rank == 2
                           else thing.composite(rgba, depth))
        self.assertEqual({(e.message, e.rank) for e in errors}, {("OSError: no \\udcff", 2)})

    def test_constructors(self):
        for arguments, text in ((dict(width=0), "0x93"), (dict(width="wide"), "width is 'wide': it must be an int"),
                                (dict(blend="mix"), "blend is 'mix'"), (dict(output="png"), "output is 'png'"),
                                (dict(background=(1, 2)), "background is .1, 2.: it must be four floats"),
                                (dict(width=np.float32(8.7)), "width is 8.7"), (dict(width=np.array(8.7)), "width is array.8.7."), (dict(threads=0), "threads is 0"), (dict(timeout=-1), "timeout is -1"),
                                (dict(display_rank=7), "7"), (dict(depth=5), "depth is 5: it must be a bool")):
            for kind in (dfb.ImageCompositor, dfb.FrameBuffer):
                def rank(comm):
                    return error_of(lambda: kind(comm, **{"width": WIDTH, "height": HEIGHT,
                                                          **(arguments if comm.rank == 1 else {})}))

                with self.subTest(text=text, kind=kind):
                    errors = dfb.run_ranks(RANKS, rank)
                    self.assertEqual({e.kind for e in errors}, {"InvalidArgument"})
                    self.assertEqual(len({str(e) for e in errors}), 1)
                    self.assertIn(text.split()[0], str(errors[0]))
                    if "display" not in str(arguments):
                        self.assertRegex(str(errors[0]), text)
                        self.assertEqual(errors[0].rank, 1)
        # Ranks that differ
        errors = dfb.run_ranks(2, lambda comm: error_of(lambda: dfb.FrameBuffer(comm, 8, 8, ("alpha", "nearest")[comm.rank])))
        self.assertIn("the tile operation is blend::alpha on rank 0 and blend::nearest on rank 1", str(errors[0]))
        for comm in ("world", 5):
            self.assertRegex(str(error_of(lambda: dfb.FrameBuffer(comm, 8, 8))), f"comm is {comm!r}: it must be a")
        self.assertRegex(str(error_of(lambda: dfb.PerspectiveCamera((0, 0, 0), (0, 0, 0)))), "looks nowhere")
        self.assertRegex(str(error_of(lambda: dfb.MatrixCamera(np.zeros((4, 4)), np.eye(4)))), "singular")
        self.assertRegex(str(error_of(lambda: dfb.MatrixCamera(np.eye(3), np.eye(4)))), r"view is \(3, 3\)")
        self.assertRegex(str(error_of(lambda: dfb.run_ranks(0, print))), "number of ranks is 0")

    def test_an_object_that_cannot_end_does_not_keep_others_open(self):
        class Busy:
            def close(self):
                raise dfb.Error("busy")

        dfb._open[-1] = Busy(), None  # before all others
        other = dfb.ImageCompositor(None, 8, 8)
        self.assertEqual(str(error_of(lambda: dfb._end_all(lambda comm: comm is None, False))), "busy")
        self.assertTrue(other.closed)

    def test_wrong_sizes(self):
        for size, text in ((("wide", 5), "the new size is 'wide' x 5: it must be two ints"), ((0, 5), "0x5"),
                           ((2.5, 5), "the new size is 2.5 x 5"),
                           ((np.float32(2.5), 5), "the new size is 2.5 x 5")):
            def again(thing, rank):
                self.assertEqual((thing.width, thing.height), (WIDTH, HEIGHT))
                thing.composite(*pixels(rank))
                self.assertEqual(thing.image is not None, rank == 0)
                thing.resize(20, 10)
                self.assertEqual((thing.width, thing.height), (20, 10))

            with self.subTest(size=size):
                errors = errors_of(compositor, lambda thing, rank: thing.resize(*(size if rank == 1 else (20, 10))), again)
                self.assertEqual({(e.kind, e.rank, str(e)) for e in errors}, {("InvalidArgument", 1, str(errors[0]))})
                self.assertIn(text, str(errors[0]))
                of_framebuffer = errors_of(framebuffer, lambda thing, rank: thing.resize(*(size if rank == 1 else (20, 10))),
                                           lambda thing, rank: thing.resize(20, 10))
                self.assertEqual({str(e) for e in of_framebuffer}, {str(errors[0])})

    def test_all_hear_why_before_a_rank_leaves(self):
        def refused(comm):
            with compositor(comm) as thing:
                thing.resize("wide" if comm.rank == 1 else 20, 10)

        for _ in range(20):  # now this one, now that one leaves first
            errors = dfb.run_ranks(RANKS, lambda comm: error_of(lambda: refused(comm)))
            self.assertEqual({(e.kind, e.rank) for e in errors}, {("InvalidArgument", 1)})

    def test_a_rank_leaves(self):
        """run_ranks() raises the exception of a rank, also if others have come to their end first, as they heard of it."""
        seen = []
        together = threading.Barrier(RANKS, timeout=20)

        def waiting(comm):
            with compositor(comm) as thing:
                thing.composite(*pixels(comm.rank))
                together.wait()  # or a rank may hear of it in this call
                if comm.rank == 1:
                    raise KeyError("lost")
                error = error_of(lambda: thing.composite(*pixels(comm.rank)))
                seen.append((error.kind, error.rank))
                raise error

        def rank(comm):
            try:
                waiting(comm)
            finally:
                together.wait()

        for _ in range(10):  # now this one, now that one comes first
            seen.clear()
            try:
                dfb.run_ranks(RANKS, rank)
            except KeyError as error:
                self.assertEqual(error.args, ("lost",))
                frames = [frame.f_code.co_name for frame, _ in traceback.walk_tb(error.__traceback__)]
                self.assertEqual(frames[-1], "waiting")
            else:
                self.fail("no KeyError")
            self.assertEqual(seen, [("Transport", 1)] * 2)
        self.assertEqual(dfb.run_ranks(2, lambda comm: (comm.rank, comm.size)), [(0, 2), (1, 2)])

    def test_an_exception_leaves_with(self):
        """It ends the waiting of the others at once, although the rank goes on and no time-out has passed."""
        together = threading.Barrier(RANKS, timeout=20)

        def rank(comm):
            try:
                with compositor(comm, timeout=20) as thing:
                    together.wait()  # or a rank may hear of it while it makes its own
                    if comm.rank == 1:
                        raise KeyError("lost")
                    return error_of(lambda: thing.composite(*pixels(comm.rank)))
            except KeyError:
                return None

        errors = dfb.run_ranks(RANKS, rank)
        self.assertIsNone(errors[1])
        for error in (errors[0], errors[2]):
            self.assertEqual((error.kind, error.rank), ("Transport", 1))
            self.assertIn("an exception has ended its", str(error))

    def test_closed_and_busy(self):
        thing = compositor(None)
        self.assertFalse(thing.closed)
        thing.close()
        thing.close()
        self.assertTrue(thing.closed)
        for call in (lambda: thing.composite(None), lambda: thing.image, lambda: thing.resize(5, 5), lambda: thing.rank):
            self.assertRegex(str(error_of(call)), "this object is closed")

        with framebuffer(None) as fb:
            inside = []

            def draw(brick, tile):
                for call in (lambda: fb.render([], CAMERA, fill), lambda: fb.image, fb.close):
                    inside.append(str(error_of(call)))

            fb.render([brick(0)], CAMERA, draw)
            self.assertEqual(set(inside), {"dfb: invalid argument: another call of this object has not returned yet"})
            self.assertIn(fb._number, dfb._open)  # it is still to be ended

    def test_waiting_releases_the_gil(self):
        """A rank waits in composite() for one that waits for a third thread of Python."""
        go = threading.Event()
        entered = threading.Event()

        def opener():
            entered.wait()
            go.set()

        def rank(comm):
            with compositor(comm) as thing:
                if comm.rank == 0:
                    entered.set()
                else:
                    go.wait()
                thing.composite(*pixels(comm.rank))

        thread = threading.Thread(target=opener)
        thread.start()
        dfb.run_ranks(2, rank)
        thread.join()

    def test_timeout(self):
        """A rank that does not come is waited for twice the time-out; the connection is of no use then."""
        late = threading.Event()

        def rank(comm):
            with compositor(comm, timeout=0.2) as thing:
                if comm.rank == 1:
                    late.wait()
                error = error_of(lambda: thing.composite(*pixels(comm.rank)))
                late.set()
                return error.kind

        self.assertEqual(dfb.run_ranks(2, rank), ["Transport"] * 2)

    def test_what_is_left_open(self):
        """Objects that Python collects end with their ranks, not in the garbage collector."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            compositor(None)
        self.assertIn("ImageCompositor was not closed", str(caught[0].message))
        self.assertEqual(len(dfb._open), 1)  # it ends with the program
        dfb.run_ranks(3, lambda comm: compositor(comm).composite(*pixels(comm.rank)))
        self.assertEqual(len(dfb._open), 1)


if __name__ == "__main__":
    unittest.main(warnings="ignore")
