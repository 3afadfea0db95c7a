"""The package on communicators of mpi4py: mpirun -n N python3 -m mpi4py mpi.py CASE."""
import sys

import numpy as np
from mpi4py import MPI

import dfb
from framebuffer import CAMERA, WIDTH as FB_WIDTH, HEIGHT as FB_HEIGHT, bricks, draw, expected_layers, over
from support import HEIGHT, WIDTH, assert_exact, blended, error_of, in_order, nearest, pixels

comm = MPI.COMM_WORLD
RANK, SIZE = comm.rank, comm.size


def pictures():
    """All ways to blend beside the reference, on a duplicate of the world and on a part of it."""
    for kind in (np.uint8, np.float32):
        images, depths = zip(*(pixels(r, kind) for r in range(SIZE)))
        with dfb.ImageCompositor(comm.Dup(), WIDTH, HEIGHT, "depth", "rgba32f", depth=True) as compositor:
            assert (compositor.rank, compositor.size) == (RANK, SIZE)
            for _ in range(3):
                compositor.composite(images[RANK][::-1], depths[RANK][::-1], bottom_up=True)
            assert (compositor.image is None) == (RANK != 0)
            if RANK == 0:
                expected, depth = blended(images, depths)
                assert_exact(compositor.image, expected)
                np.testing.assert_array_equal(compositor.depth, depth)
        with dfb.ImageCompositor(comm, WIDTH, HEIGHT, "order", display_rank=SIZE - 1) as compositor:
            compositor.composite(images[RANK], order=(RANK + 1) % SIZE)
            if RANK == SIZE - 1:
                assert_exact(compositor.image, in_order(images, [(r + 1) % SIZE for r in range(SIZE)]))
        half = comm.Split(RANK % 2, -RANK)
        with dfb.ImageCompositor(half, WIDTH, HEIGHT) as compositor:
            compositor.composite(images[RANK], depths[RANK])
            members = [r for r in reversed(range(SIZE)) if r % 2 == RANK % 2]
            for image, depth in [compositor.image_on_all_ranks()]:
                assert depth is None
                assert_exact(image, nearest([images[r] for r in members], [depths[r] for r in members])[0])


def frames():
    images, depths = zip(*expected_layers()) if RANK == 0 else ((), ())
    for blend in ("alpha", over, "nearest"):
        with dfb.FrameBuffer(comm, FB_WIDTH, FB_HEIGHT, blend, "rgba32f") as fb:
            for _ in range(3):
                fb.render(bricks()[RANK::SIZE], CAMERA, draw)
            if RANK == 0:
                assert_exact(fb.image, (nearest if blend == "nearest" else blended)(images, depths)[0])


def errors():
    """An exception on the last rank comes out on all, with the same text; then all goes on."""
    def failing(brick, tile):
        if RANK == SIZE - 1:
            raise ValueError("no such data")
        draw(brick, tile)

    with dfb.FrameBuffer(comm, FB_WIDTH, FB_HEIGHT) as fb:
        error = error_of(lambda: fb.render(bricks()[RANK::SIZE][:1], CAMERA, failing))
        assert (error.kind, error.rank, error.message) == ("UserCode", SIZE - 1, "ValueError: no such data"), error
        assert error.tile is not None
        assert isinstance(error.__cause__, ValueError) == (RANK == SIZE - 1)
        assert len(set(comm.allgather(str(error)))) == 1
        fb.render(bricks()[RANK::SIZE], CAMERA, draw)
    with dfb.ImageCompositor(comm, WIDTH, HEIGHT) as compositor:
        rgba, depth = pixels(RANK)
        error = error_of(lambda: compositor.composite(rgba, None if RANK == SIZE - 1 else depth))
        assert error.rank == SIZE - 1 and "without depth" in str(error), error
        compositor.composite(rgba, depth)
        image = compositor.image
        if RANK == 0:
            try:
                compositor.resize(9, 9)
                raise AssertionError("resize() with an array of the image")
            except BufferError:
                pass
        else:
            assert "arrays of the image" in str(error_of(lambda: compositor.resize(9, 9)))
        compositor.composite(rgba, depth)
    if RANK == 0:
        assert_exact(image, nearest(*zip(*(pixels(r) for r in range(SIZE))))[0])
    error = error_of(lambda: dfb.ImageCompositor(comm, WIDTH if RANK else 0, HEIGHT))
    assert (error.kind, error.rank) == ("InvalidArgument", 0), error
    return image  # which lives longer than MPI


def owners():
    """Between nodes, tiles belong to ranks near their pixels once a picture has shown where these are."""
    import resource
    # Ranks that share no memory count as nodes of their own, and they share none if files must be shorter than 4 GiB.
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**30, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    images = [np.random.default_rng(r).integers(0, 256, (256, 128, 4)).astype(np.uint8) for r in range(SIZE)]
    with dfb.ImageCompositor(comm, 128 * SIZE, 256, "order") as compositor:
        def bytes_of_picture():
            return compositor.composite(images[RANK], order=RANK, origin=(128 * RANK, 0)).bytes_sent

        for width in (128 * SIZE, 128 * SIZE + 64):
            compositor.resize(width, 256)
            first, second = bytes_of_picture(), bytes_of_picture()
            assert SIZE == 1 or second < 0.8 * first, (first, second)
            if RANK == 0:
                assert_exact(compositor.image[:, :128 * SIZE], np.concatenate(images, axis=1) / 255)


def left_open():
    """Objects that nobody closes end with the program."""
    compositor = dfb.ImageCompositor(comm, WIDTH, HEIGHT)
    compositor.composite(*pixels(RANK))
    dfb.FrameBuffer(comm, 8, 8)


def leaves():
    """The last rank leaves by an exception; the others hear of it and do not wait. The job ends with an error."""
    with dfb.ImageCompositor(comm, WIDTH, HEIGHT) as compositor:
        compositor.composite(*pixels(RANK))
        comm.Barrier()  # or a rank may hear of it in this call
        if RANK == SIZE - 1:
            raise KeyError("lost")
        error = error_of(lambda: compositor.composite(*pixels(RANK)))
        print(f"heard: {error.kind} of rank {error.rank}", flush=True)
        raise error


def other_mpi():
    """The module was built with another MPI than mpi4py."""
    print(error_of(lambda: dfb.ImageCompositor(comm, WIDTH, HEIGHT)))


kept = globals()[sys.argv[1]]()
print(f"rank {RANK}: done", flush=True)
