"""Arms and boards by their names: those of padforge, and those of any installed package, found by entry points.

`padforge.arms` names functions of the settings of `[rig]` that give an `Arm`; `padforge.boards` functions of these
settings and of the inputs to read, in the order of the fibres, that give a `Converter`.
"""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, Literal

from padforge.design.common.validation import InputError

Group = Literal["padforge.arms", "padforge.boards"]


def device_names(group: Group) -> list[str]:
    """Names of all arms or boards that are installed."""
    return sorted({point.name for point in entry_points(group=group)})


def device(group: Group, name: str) -> Callable[..., Any]:
    """The function that makes an arm or a board.

    Raises:
        InputError: none has that name, or its package cannot be imported.
    """
    found = [point for point in entry_points(group=group) if point.name == name]
    if not found:
        allowed = ", ".join(device_names(group)) or "none: padforge is not installed, run pip install ."
        raise InputError(f"{group.removeprefix('padforge.')}: got {name!r}, allowed are {allowed}")
    try:
        return found[0].load()
    except Exception as error:  # a package of somebody else may fail in any way
        raise InputError(f"{name}: {found[0].value} cannot be loaded ({type(error).__name__}: {error})") from error
