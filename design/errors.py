"""The one exception a user meets."""


class InputError(ValueError):
    """The user's own mistake: a file, setting or argument that cannot be used.

    The message is one line that names the thing, the value got and what is
    allowed. The command line prints it without a traceback and exits 2.
    """
