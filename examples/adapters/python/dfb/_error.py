"""The one kind of exception that dfb raises."""


class Error(RuntimeError):
    """A call cannot be, a frame failed, or ranks cannot reach each other.

    A frame that fails raises it on all ranks, with the same text. Attributes that do not apply are None:

    kind        the error's name in docs/errors.md, such as "UserCode" (an exception in a function of yours), "Transport"
                (the object is of no further use: leave it) or "InvalidArgument" (a wrong argument)
    message     the detail in words; of an exception in a function of yours its type and text
    rank        where it went wrong, or who noticed
    tile, frame
    from_rank   where a wrong or missing input came from
    generation, source, expected, got

    On the rank whose function threw, __cause__ is that exception.
    """

    def __init__(self, text="", kind="", message="", rank=None, tile=None, frame=None, from_rank=None,
                 generation=None, source=None, expected=None, got=None):
        super().__init__(text, kind, message, rank, tile, frame, from_rank, generation, source, expected, got)
        self.kind = kind
        self.message = message
        self.rank = rank
        self.tile = tile
        self.frame = frame
        self.from_rank = from_rank
        self.generation = generation
        self.source = source
        self.expected = expected
        self.got = got

    def __str__(self):
        return str(self.args[0])


Error.__module__ = "dfb"
