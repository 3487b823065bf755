"""Listening for other programs: on this machine, and on others' behalf only for who knows a token."""

import errno
import secrets
import socket
import socketserver
from collections.abc import Callable
from typing import TypeVar

from design.common.errors import InputError

HOST = "127.0.0.1"
"""Only this machine is served, unless another address is asked for: then whoever asks must know a token."""
LEAST_TOKEN, MOST_TOKEN = 16, 256
"""Characters of a token."""
POLL_S = 0.05
"""A server looks so often whether it is to end."""

Server = TypeVar("Server", bound=socketserver.BaseServer)


def refuse_open(host: str, token: str) -> None:
    """Raise InputError where other machines could listen and no token, or one that can be guessed, keeps them out."""
    if token and not (LEAST_TOKEN <= len(token) <= MOST_TOKEN and token.isascii() and token.isprintable()):
        raise InputError(
            f"token has {len(token)} characters, allowed are {LEAST_TOKEN} to {MOST_TOKEN}, those of plain text"
        )
    if host not in (HOST, "localhost") and not token:
        raise InputError(
            f"host is {host!r}, which other machines reach: whoever knows a token may listen, and nobody else; "
            f"give one, such as --token {secrets.token_urlsafe(LEAST_TOKEN)}"
        )


def listening(begin: Callable[[], Server], host: str, port: int, option: str) -> Server:
    """The server that `begin` makes.

    Raises:
        InputError: the port is taken or not for this user, or the host is no address of this machine.
    """
    try:
        return begin()
    except (OSError, UnicodeError) as error:
        number = error.errno if isinstance(error, OSError) else None
        if number in (errno.EADDRINUSE, errno.EACCES):
            reason = "another program uses it" if number == errno.EADDRINUSE else "this user may not use it"
            raise InputError(f"port {port} of {host}: {reason}; choose another with {option}, or 0 for any") from error
        if number == errno.EADDRNOTAVAIL or isinstance(error, (socket.gaierror, UnicodeError)):
            raise InputError(f"host is {host!r}, expected an address of this machine ({error})") from error
        raise
