"""Work in a child, with limits that this process must not have."""

import os
import resource
import signal
import sys
from collections.abc import Callable

from design.common.errors import InputError


def in_child(work: Callable[[], None], limit: int | None = None, user: int | None = None) -> tuple[int, str]:
    """Run `work` in a child that may write files of `limit` bytes at most, as `user`; its status and stderr."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        os.dup2(write, 2)
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115  not the file that pytest has in its place
        status = 70
        try:
            if user is not None and os.getuid() == 0:
                os.setgroups([])
                os.setgid(user)
                os.setuid(user)
            if limit is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            work()
            status = 0
        except InputError as error:
            os.write(2, f"{error}\n".encode())
            status = 2
        except OSError as error:
            os.write(2, f"{error}\n".encode())
            status = 3
        except BaseException as error:
            os.write(2, f"{type(error).__name__}: {error}\n".encode())
        finally:
            os._exit(status)
    os.close(write)
    with os.fdopen(read) as err:
        said = err.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), said
