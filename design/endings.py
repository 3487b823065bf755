"""How a command ends: a user's own mistake is one line on stderr and exit 2, whatever raised it."""

import os
import signal
import sys
from contextlib import suppress
from io import TextIOWrapper

import click

from .errors import Fault, InputError

INTERRUPTED = 130


def run_to_end(command: click.Command, name: str) -> int:
    """Run a command line on the arguments of this process; its exit code, with one line on stderr where it failed."""
    _prepare()
    try:
        _require_words(sys.argv[1:])
        return command.main(standalone_mode=False, prog_name=name) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        return 2
    except (click.exceptions.Abort, KeyboardInterrupt):
        return _fail(name, "interrupted; what was finished is kept", INTERRUPTED)
    except click.ClickException as error:
        return _fail(name, error.format_message(), 2)
    except InputError as error:
        return _fail(name, str(error), 2)
    except Fault as fault:
        return _fail(name, str(fault), fault.exit_code)
    except OSError as error:
        return _fail(name, f"{error.filename}: {error.strerror}" if error.filename else str(error), 2)
    except MemoryError as error:
        return _fail(name, f"this takes more memory than there is ({error or 'no more is given'})", 2)


def _prepare() -> None:
    """Let names that are no text be printed, and an end from outside clear up as Ctrl-C does."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    for ending in {"SIGTERM", "SIGHUP"} & set(dir(signal)):
        number = getattr(signal, ending)
        if signal.getsignal(number) is signal.SIG_DFL:  # else it is ignored, as under nohup
            signal.signal(number, signal.default_int_handler)


def _require_words(words: list[str]) -> None:
    """Refuse what no shell can hand over, but a caller from Python can: such names would trip whatever opens them."""
    for word in words:
        try:
            odd = b"\0" in os.fsencode(word)
        except UnicodeEncodeError:
            odd = True
        if odd:
            raise InputError(f"{word!r}: holds characters that no argument can have")


def _fail(name: str, message: str, code: int) -> int:
    with suppress(OSError):  # of a disk that is full: the exit code says the same
        print(f"{name}: {' '.join(message.split())}", file=sys.stderr)
    return code
