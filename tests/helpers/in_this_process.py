from typing import Any

from padforge.common.background import BackgroundProcess as BackgroundProcess  # before another takes its place


class InThisProcess:
    """Work of a `BackgroundProcess`, done here when its result is asked for: no process has to import all it needs."""

    def __init__(self, modules: object = ()) -> None: ...

    def __enter__(self) -> "InThisProcess":
        return self

    def __exit__(self, *_: object) -> None: ...

    def submit(self, work: Any, *arguments: Any) -> None:
        self.result = lambda: work(*arguments)
