"""padforge: the front door. `import padforge` hands out all there is; the command line chains the stages.

`padforge.design`, `padforge.fabricate` and `padforge.sense` are the packages, and whatever these three hand out is here
as well: `padforge.search`, `padforge.build`, `padforge.calibrate`, with the settings they take.
"""

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any

import design
import fabricate
import sense

from .commands import cli, main
from .report import write_report

if TYPE_CHECKING:
    from design import *  # noqa: F403  what an editor completes `padforge.` with
    from fabricate import *  # noqa: F403
    from sense import *  # noqa: F403

__all__ = ["cli", "main", "write_report"]

PACKAGES = {"design": design, "fabricate": fabricate, "sense": sense}


def __getattr__(name: str) -> Any:
    for package in PACKAGES.values():
        if name in package.__all__:
            return getattr(package, name)
    raise AttributeError(f"module 'padforge' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *(name for package in PACKAGES.values() for name in package.__all__)})


class _Packages(MetaPathFinder, Loader):
    """Finds `padforge.design.pad` where it lies, in `design.pad`: one module by two names, not two modules."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """What makes an alias, for the names of the packages and all below."""
        top, _, name = fullname.partition(".")
        return ModuleSpec(fullname, self) if top == "padforge" and name.partition(".")[0] in PACKAGES else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module itself; its own specification is kept for `exec_module`."""
        module = import_module(spec.name.removeprefix("padforge."))
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing but what importing by another name has changed: it ran when it was imported."""
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


sys.meta_path.insert(0, _Packages())
