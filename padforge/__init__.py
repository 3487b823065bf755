"""From an idea to a calibrated soft strain-sensor pad.

`padforge.design`, `padforge.fabricate` and `padforge.sense` are the three stages. What they export is here too, and is
loaded on first use: `padforge.search`, `padforge.build`, `padforge.calibrate`, and their settings.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from padforge.design import *  # noqa: F403  for completion in editors
    from padforge.fabricate import *  # noqa: F403
    from padforge.sense import *  # noqa: F403

STAGES = ("design", "fabricate", "sense")

# a checkout has the stages beside this package, a wheel has them inside it
if not (Path(__file__).parent / "design").is_dir():
    __path__.append(str(Path(__file__).parents[1]))  # noqa: F405


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    if name in STAGES:
        return import_module(f"padforge.{name}")
    for stage in STAGES:
        package = import_module(f"padforge.{stage}")
        if name in package.__all__:
            return getattr(package, name)
    raise AttributeError(f"module 'padforge' has no attribute {name!r}")


def __dir__() -> list[str]:
    packages = [import_module(f"padforge.{stage}") for stage in STAGES]
    return sorted({*globals(), *STAGES, *(name for package in packages for name in package.__all__)})
