"""dfb: images that many ranks render become one.

ImageCompositor makes one picture of images that are rendered already, FrameBuffer of bricks of data that a function of
yours renders tile by tile. Ranks are processes of MPI (a communicator of mpi4py), threads of this process (run_ranks), or
one (None).

Construction, composite(), render(), fail(), resize(), image_on_all_ranks() and close() are collective: all ranks call them, in
the same order. They release the GIL while they wait. What goes wrong in one of them on one rank raises Error on all.
An object takes one call at a time.
"""

import atexit
import itertools
import operator
import sys
import warnings

from . import _dfb
from ._dfb import Input, MatrixCamera, PerspectiveCamera, Report, ThreadCommunicator, Tile
from ._error import Error

__all__ = ["Brick", "Error", "FrameBuffer", "ImageCompositor", "Input", "MatrixCamera", "PerspectiveCamera", "Report",
           "ThreadCommunicator", "Tile", "has_mpi", "run_ranks"]
__version__ = _dfb.version

has_mpi = _dfb.has_mpi
"""Whether this module can work with communicators of mpi4py."""

# Objects that are not closed yet, with their communicators, in the order in which all ranks make them. They are kept
# here because their end is collective, so it must not depend on Python's garbage collector.
_open = {}
_numbers = itertools.count()


def _end_all(is_its, leaves):
    """Ends what is still open of the communicators for which is_its(communicator) holds, also if an end raises."""
    errors = []
    for number, (impl, comm) in sorted(_open.items()):
        if not is_its(comm):
            continue
        del _open[number]
        try:
            impl.leave() if leaves else impl.close()
        except Error as error:
            errors.append(error)
    if errors:
        raise errors[0]


# If an exception has ended the program, perhaps on this rank only, sys.last_type is set.
atexit.register(lambda: _end_all(lambda comm: True, hasattr(sys, "last_type")))


def run_ranks(count, function):
    """Call function(comm) on `count` threads, one for each rank, and return the results by rank.

    comm is a ThreadCommunicator. No MPI is needed. Waits for all. If a function raises, ranks that wait for it get an Error
    of the kind "Transport", and its exception is raised here. Objects that a function leaves open are closed at its end.
    """
    thrown = []

    def rank(comm):
        leaves = True
        try:
            result = function(comm)
            leaves = False
            return result
        except BaseException as error:
            thrown.append(error)
            raise
        finally:
            _end_all(lambda other: other is comm, leaves)

    try:
        return _dfb.run_ranks(count, rank)
    except BaseException:
        if not thrown:
            raise
    try:
        # The first exception, but not a Transport error, if there is another: it only says that some other rank has
        # left.
        raise min(thrown, key=lambda error: isinstance(error, Error) and error.kind == "Transport")
    finally:
        thrown.clear()


def _refuse(message):
    raise Error("dfb: invalid argument: " + message, "InvalidArgument", message)


def _ranks_of(comm):
    """What the extension takes for a communicator."""
    if comm is None or isinstance(comm, ThreadCommunicator):
        return comm
    mpi = sys.modules.get("mpi4py.MPI")
    if mpi is None or not isinstance(comm, mpi.Comm):
        _refuse(f"comm is {comm!r}: it must be a communicator of mpi4py, one of dfb.run_ranks(), or None for one rank")
    if not has_mpi:
        _refuse("this module was built without MPI: build it with the MPI of mpi4py, which is "
                + mpi.Get_library_version().strip())
    theirs, bytes_of_theirs = mpi.Get_library_version(), mpi._sizeof(mpi.Comm)
    if bytes_of_theirs != _dfb.mpi_handle_bytes or theirs != _dfb.mpi_library():
        _refuse(f"mpi4py and dfb were built with different MPI libraries: {theirs.splitlines()[0].split(',')[0]}, whose "
                f"handles have {bytes_of_theirs} bytes, and {_dfb.mpi_headers}, whose handles have "
                f"{_dfb.mpi_handle_bytes} bytes. Build dfb with the compiler of mpi4py's MPI (-DMPI_CXX_COMPILER=...)")
    return mpi._addressof(comm)


def _of_impl(name, doc):
    return property(operator.attrgetter("_impl." + name), doc=doc)


class _Collective:
    """What both classes have."""

    def __init__(self, make, comm, settings):
        self._number = next(_numbers)
        self._impl = make(_ranks_of(comm), settings)
        _open[self._number] = self._impl, comm

    rank = _of_impl("rank", "This rank.")
    size = _of_impl("size", "How many ranks there are.")
    width = _of_impl("width", "The picture's width in pixels.")
    height = _of_impl("height", "The picture's height in pixels.")
    closed = _of_impl("closed", "Whether close() has been called.")

    @property
    def is_display_rank(self):
        """Whether this rank gets the picture."""
        return self._impl.rank == self._impl.display_rank

    @property
    def image(self):
        """The last picture, on the display rank: (height, width, 4), row 0 on top, premultiplied RGBA.

        None on other ranks, before the first picture, and after one that failed. uint8, or float32 with output="rgba32f".
        It is the library's own memory, and read-only: the next picture is written there, so take image.copy() to keep
        one. The memory stays as long as an array of it does, also after close(). While there is one, resize() raises
        BufferError.
        """
        return self._impl.image

    @property
    def depth(self):
        """The depths of image, (height, width) of float32, infinity where nothing is. None without depth=True; else as
        image."""
        return self._impl.depth

    def image_on_all_ranks(self):
        """Return a copy of the display rank's image and depth on all ranks, as a tuple; None for what there is not.

        Collective.
        """
        return self._impl.image_on_all_ranks()

    def fail(self, why):
        """Raise Error on all ranks, on a rank that cannot make its part of the picture, in place of the call that would.

        why is an exception or a text. Collective with the calls of the other ranks.
        """
        cause = why if isinstance(why, BaseException) else None
        if cause:
            why = f"{type(why).__name__}: {why}"
        try:  # the name of a file may have characters that cannot be encoded
            self._impl.fail(str(why).encode(errors="backslashreplace").decode())
        except Error as error:
            raise error from cause

    def resize(self, width, height):
        """Change the size of the picture. image is None then.

        Collective. Raises BufferError on a rank that still has arrays of the image, and Error on the others; the size then
        stays as it is.
        """
        self._impl.resize(width, height)

    def close(self):
        """End the object. Collective. Arrays of the image stay as they are. Does nothing the second time.

        `with` does so too; if an exception leaves its block, no other rank is waited for, and those that wait for this
        one get an Error of the kind "Transport".
        """
        self._impl.close()
        _open.pop(self._number, None)

    def __enter__(self):
        return self

    def __exit__(self, kind, value, trace):
        if kind is None:
            self.close()
        else:
            self._impl.leave()
            _open.pop(self._number, None)

    def __del__(self):
        if self.__dict__.get("_number") in _open:
            warnings.warn(f"{type(self).__name__} was not closed: it stays until its ranks end", ResourceWarning,
                          stacklevel=2)


class ImageCompositor(_Collective):
    """Makes one picture of images that the ranks have rendered already.

    comm          a communicator of mpi4py, one of run_ranks(), or None for one rank
    width, height the picture, in pixels
    blend         "nearest": of each pixel the one with the least depth; "depth": each pixel blended front to back by
                  depth; "order": images blended front to back in an order of the ranks
    output        of the picture: "rgba8"; "srgb8", 8 bits through the sRGB curve; "rgba32f"
    depth         whether the picture has depth
    background    premultiplied linear RGBA behind everything
    display_rank  the rank that gets the picture
    threads       of this rank; None: its share of the processors
    timeout       a picture fails if it is not complete so many seconds after the first rank waits for it. If a rank
                  does not answer at all, the object is lost after twice that time. None: no limit. Other calls, such
                  as resize(), have no limit

    All ranks give the same, but threads. Collective. Raises Error on all ranks.
    """

    def __init__(self, comm, width, height, blend="nearest", output="rgba8", depth=False, background=(0, 0, 0, 0),
                 display_rank=0, threads=None, timeout=None):
        super().__init__(_dfb.Compositor, comm,
                         {"width": width, "height": height, "blend": blend, "output": output, "depth": depth,
                          "background": background, "display_rank": display_rank, "threads": threads,
                          "timeout": timeout})

    def composite(self, rgba, depth=None, order=None, bottom_up=False, *, origin=None, far_depth=None,
                  straight_alpha=False, bgra=False):
        """Make a picture of the images of all ranks, and return its Report.

        rgba            premultiplied RGBA, (height, width, 4) of uint8 or float32, read in place; None: this rank has
                        nothing. Rows may have gaps of whole pixels, or be upside down (rgba[::-1]); their pixels
                        lie one after another. Levels of uint8 count as level / 255, rounded to float32
        depth           (height, width) of float32, which grows away from the eye; needed unless blend="order" without
                        depth. Copied if its rows lie differently from those of rgba, else read in place
        order           this rank's place, 0 in front, a different one on each rank: needed with blend="order" and
                        rgba, else ignored. place() finds it
        bottom_up       the first row is the lowest, as OpenGL has it
        origin          (x, y): where the first pixel is in the picture, if rgba is a part of it; y counts from the
                        first row
        far_depth       a pixel at this depth or beyond is empty; 1 in OpenGL. None: infinity
        straight_alpha  colours are not multiplied by alpha yet
        bgra            blue comes first

        Collective. Do not change the arrays before it returns.
        """
        return self._impl.composite(rgba, depth, {"order": order, "bottom_up": bottom_up, "origin": origin,
                                                  "far_depth": far_depth, "straight_alpha": straight_alpha,
                                                  "bgra": bgra})

    def place(self, lower, upper, eye):
        """Return this rank's place from front to back, for the `order` of composite().

        lower, upper  corners of the box that holds this rank's data
        eye           where the camera is, the same on all ranks

        Collective. Raises Error on all ranks if boxes overlap, or if there is no order: three boxes can each be in front
        of the next.
        """
        return self._impl.place(lower, upper, eye)


class Brick:
    """A box of data that overlaps no other. Any object with these attributes will do.

    id            the same number on no other brick of any rank, 0 to 2**32 - 1
    lower, upper  its corners, three floats each
    data          whatever your function needs
    """

    def __init__(self, id, lower, upper, data=None):
        self.id = id
        self.lower = lower
        self.upper = upper
        self.data = data

    def __repr__(self):
        return f"dfb.Brick({self.id!r}, {self.lower!r}, {self.upper!r})"


class FrameBuffer(_Collective):
    """Makes one picture of bricks of data that the ranks render tile by tile.

    blend  "alpha": inputs blended front to back by depth, pixel by pixel; "nearest": the one with the least depth; or a
           function of yours, for prototypes: function(inputs) returns rgba, or (rgba, depth). inputs is a list of
           Input, those that have pixels in a tile, by source. It returns arrays (height, width, 4), premultiplied and
           linear, and (height, width). The background comes behind it. It is called on the rank that owns the tile,
           for one tile at a time. All ranks must give the same one, which cannot be checked.

    The other arguments are those of ImageCompositor. Collective. Raises Error on all ranks.
    """

    def __init__(self, comm, width, height, blend="alpha", output="rgba8", depth=False, background=(0, 0, 0, 0),
                 display_rank=0, threads=None, timeout=None):
        super().__init__(_dfb.FrameBuffer, comm,
                         {"width": width, "height": height, "blend": blend, "output": output, "depth": depth,
                          "background": background, "display_rank": display_rank, "threads": threads,
                          "timeout": timeout})

    def render(self, bricks, camera, function):
        """Render a picture, and return its Report.

        bricks    this rank's: Brick or alike; there may be none
        camera    a PerspectiveCamera or a MatrixCamera, the same on all ranks
        function  function(brick, tile) fills tile.rgba and tile.depth (see Tile) as far as rays are within the brick;
                  pixels that it leaves as they are have nothing. It is called for each brick and each tile that the
                  brick may be seen in, by threads of the library, one at a time

        Collective. An exception of the function raises Error on all ranks.
        """
        return self._impl.render(bricks, camera, function)
