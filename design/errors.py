"""The exceptions a user meets: each is one line, without a traceback."""


class InputError(ValueError):
    """The user's own mistake: a file, setting or argument that cannot be used.

    The message is one line that names the thing, the value got and what is
    allowed. The command line prints it without a traceback and exits 2.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(" ".join(str(message).splitlines()))  # names of files and keys may hold line ends


class Fault(Exception):  # noqa: N818  of things outside the program, not an error of it
    """Something outside went wrong that the user has to look at, such as a robot that was stopped.

    Attributes:
        exit_code: what the command line ends with.
    """

    exit_code = 1
