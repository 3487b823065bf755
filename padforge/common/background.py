"""A process that works beside this one, on what is left idle of the cores."""

import logging
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from logging.handlers import QueueHandler
from multiprocessing.connection import Connection
from queue import SimpleQueue
from types import TracebackType
from typing import Any

from padforge.common.validation import Fault

PRIORITY = 19  # niceness of the process: it leaves the cores to what the user waits for


class BackgroundProcess:
    """A process of low priority for one piece of work, such as CAD, which holds the interpreter lock.

    It starts with the body of a `with` statement, imports modules until it has its work, and ends with the body.
    """

    def __init__(self, modules: Sequence[str] = ()) -> None:
        """Name the modules to import, which may be missing."""
        context = multiprocessing.get_context("spawn")  # a fork would copy locks that other threads hold
        self._pipe, self._remote = context.Pipe()
        self._process = context.Process(target=_serve, args=(self._remote, modules), daemon=True)
        self._is_working = False

    def __enter__(self) -> "BackgroundProcess":
        """Start the process."""
        self._process.start()
        self._remote.close()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """End the process; unfinished work removes its temporary files."""
        if self._is_working:
            self._process.terminate()
        else:
            self._process.kill()  # to release the memory of CAD piece by piece would take two seconds
        self._process.join()
        self._pipe.close()

    def submit(self, work: Callable[..., Any], *arguments: Any) -> None:
        """Begin the work, a function of a module; it is pickled with its arguments."""
        self._is_working = True
        self._pipe.send((work, arguments))

    def result(self) -> Any:
        """Wait for the result of the work, or raise its exception; log what the package of the work has logged.

        Raises:
            Fault: the process has been killed.
        """
        try:
            outcome, records = self._pipe.recv()
        except EOFError:
            raise Fault("a process that worked in the background was killed, perhaps for lack of memory") from None
        self._is_working = False
        for record in records:
            logging.getLogger(record.name).handle(record)
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome


def _serve(pipe: Connection, modules: Sequence[str]) -> None:
    """Import modules, and answer one piece of work by its result, or exception, and log records."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the other process, which then terminates this one
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit())
    if hasattr(os, "nice"):
        os.nice(PRIORITY)
    for module in modules:
        with suppress(ImportError):  # the work says so, if it needs it
            import_module(module)
    with suppress(EOFError, BrokenPipeError):  # the other process has ended
        work, arguments = pipe.recv()
        records: SimpleQueue[logging.LogRecord] = SimpleQueue()
        logger = logging.getLogger(work.__module__.rpartition(".")[0])
        logger.setLevel(logging.INFO)
        logger.addHandler(QueueHandler(records))  # type: ignore[arg-type]
        try:
            outcome = work(*arguments)
        except Exception as error:
            error.add_note(traceback.format_exc())
            outcome = error
        pipe.send((outcome, [records.get() for _ in range(records.qsize())]))
