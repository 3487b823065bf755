"""Hostile calls: public functions and methods, with an argument or two that are of another type or value."""

import inspect
import sys
import warnings
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from padforge import design, fabricate, sense
from padforge.design import InputError
from padforge.design.common.validation import Fault, short_repr
from padforge.report import write_report
from padforge.sense.health.health_model import DETECTED

from .texts import Rng, pick
from .values import ODD, spoiled

CALLBACKS = {"progress", "on_progress", "executor", "checkpoints"}
"""Parameters that are left alone: what is called back may raise what it likes."""


@cache
def sound() -> dict[str, Any]:
    """Arguments that suit, by the name of a parameter, of the files in the current folder."""
    pad = design.Morphology.load("pad/morphology.json")
    recording = sense.open_recording("pad/recording")
    search = design.SearchSettings(knots=1, starts=1, steps=2, max_failures=1)
    found = {
        "pad": pad,
        "knots": pad.knots,
        "presses": np.array([[1.0, 1.0], [1.5, 2.0]]),
        "places": np.array([[1.0, 2.0]]),
        "positions_mm": np.array([[1.0, 2.0]]),
        "positions": np.array([[1.0, 2.0]]),
        "parameters": np.ones((3, 8)),
        "contact": design.Contact(),
        "rules": design.RulesSettings(enforce=False),
        "settings": fabricate.FabricationSettings(),
        "search": search,
        "twin": design.Twin.load("pad/twin.json"),
        "recording": recording,
        "localizer": sense.LocalizerModel.load(Path("pad")),
        "model": sense.HealthModel.load(Path("pad")),
        "health": sense.HealthModel.load(Path("pad"), DETECTED),
        "options": sense.LocalizerSettings(members=1, hidden=8, layers=1, epochs=2, batch=64, max_failures=2),
        "rig": sense.RigSettings(presses=4, readings_per_press=8),
        "readings": recording.readings,
        "times_s": recording.times_s,
        "down_command": recording.down_command,
        "up_command": recording.up_command,
        "presses_mm": recording.presses_mm,
        "rng": np.random.default_rng(0),
        "layout": pad.layout,
        "size": design.PadSettings(grid=2),
        "path": "new.json",
        "out": "new",
        "folder": "pad",
        "formats": ("svg",),
        "fibres": 4,
        "channels": 4,
        "rate_hz": 13.3,
        "width": 5,
        "lam": 2.0,
        "times": 2,
        "depths_mm": np.array([0.1, 4.0]),
        "tables": {"contact": {"radius": 0.5}},
        "held_back": (0, 1),
        "document": pad.to_dict(),
        "levels": (0, 1),
        "tolerance": 1e-2,
        "provenance": {},
        "source": {"a": 1},
        "unit_mm": 11.25,
        "n_failed": 1,
    }
    return found | {f"{name} of {where}": value for (where, name), value in _elsewhere(found).items()}


def _elsewhere(found: dict[str, Any]) -> dict[tuple[str, str], Any]:
    """Arguments that suit where a name means something else than elsewhere."""
    return {
        ("padforge.design.search", "pad"): design.PadSettings(grid=1),
        ("padforge.design.search", "search"): found["search"],
        ("padforge.design.search", "contact"): found["contact"],
        ("padforge.fabricate.check_mesh", "path"): "pad/mould.stl",
        ("padforge.design.Morphology.load", "path"): "pad/morphology.json",
        ("padforge.design.Twin.load", "path"): "pad/twin.json",
        ("padforge.sense.open_recording", "path"): "pad/recording",
        ("padforge.sense.Recording.open", "path"): Path("pad/recording"),
        ("padforge.sense.import_csv", "path"): "presses.csv",
        ("padforge.sense.import_hdf5", "path"): "presses.h5",
        ("padforge.sense.import_mat", "path"): "pad.mat",
        ("padforge.sense.import_bag", "path"): Path("presses.mcap"),
        ("padforge.sense.export_csv", "path"): "new.csv",
        ("padforge.sense.export_hdf5", "path"): "new.h5",
        ("padforge.sense.export_bag", "path"): Path("new.mcap"),
        ("padforge.sense.export_lerobot", "path"): Path("new"),
        ("padforge.sense.export_bag", "annotations"): None,
        ("padforge.sense.export_lerobot", "annotations"): None,
        ("padforge.design.Spec.load", "path"): Path("pad.toml"),
        ("padforge.design.Spec.section", "model"): design.Contact,
        ("padforge.design.Spec.stated", "model"): design.Contact,
        ("padforge.sense.HealthModel.load", "folder"): Path("pad"),
        ("padforge.sense.LocalizerModel.load", "folder"): Path("pad"),
        ("padforge.sense.Localizer.load", "folder"): Path("pad"),
    }


_OF_CLASS = {"Morphology": "pad", "Twin": "twin", "Recording": "recording", "LocalizerModel": "localizer"}
_OF_CLASS |= {"HealthModel": "health"}
"""Sound arguments that are of a class, whose methods are called as well."""


@cache
def functions() -> dict[str, Callable[..., Any]]:
    """All that the packages hand out and that can be called, by name; records that check nothing are not among them."""
    found: dict[str, Callable[..., Any]] = {"padforge.report.write_report": write_report}
    made = {
        "PressDetector": lambda: sense.PressDetector(4),
        "RunningMedian": lambda: sense.RunningMedian(4, 5),
        "TotalVariation": lambda: sense.TotalVariation(4, 2.0),
        "Live": lambda: sense.Live(sound()["localizer"], sound()["health"], 4, 13.3),
        "FaultMonitor": lambda: sense.FaultMonitor(sound()["model"]),
        "Spec": lambda: design.Spec({}),
        **{name: lambda key=key: sound()[key] for name, key in _OF_CLASS.items()},
    }
    for package in (design, fabricate, sense):
        for name in sorted(package.__all__):
            thing, full = getattr(package, name), f"{package.__name__}.{name}"
            if not inspect.isclass(thing):
                found[full] = thing
                continue
            if issubclass(thing, Exception):
                continue
            if not is_dataclass(thing) or hasattr(thing, "__post_init__"):
                found[full] = thing
            for key, method in inspect.getmembers(thing, callable):
                inherited = not (getattr(method, "__module__", "") or "").startswith(f"{package.__name__}.")
                if key.startswith("_") or inherited:
                    continue
                if inspect.ismethod(method) or isinstance(inspect.getattr_static(thing, key), staticmethod):
                    found[f"{full}.{key}"] = method
                elif name in made:
                    found[f"{full}.{key}"] = _of_instance(made[name], method)
    return found


def _of_instance(make: Callable[[], Any], method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of whatever `make` gives when it is called, with the parameters it has beside `self`."""

    def call(**arguments: Any) -> Any:
        return method(make(), **arguments)

    signature = inspect.signature(method)
    call.__signature__ = signature.replace(parameters=list(signature.parameters.values())[1:])  # pyright: ignore
    return call


def _numbers(value: Any) -> bool:
    """Whether a value is an array of numbers, and no endless one."""
    return isinstance(value, np.ndarray) and value.dtype.kind in "fi" and value.ndim > 0 and 0 < value.size < 10**6


def drawn(rng: Rng) -> tuple[Callable[[], None], str]:
    """A call of a public function with some of its arguments spoiled, and what it is."""
    name = pick(rng, sorted(functions()))
    function, suits = functions()[name], sound()
    given: dict[str, Any] = {}
    names = []
    for key, parameter in inspect.signature(function).parameters.items():
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL) or key in CALLBACKS:
            continue
        names.append(key)
        if f"{key} of {name}" in suits or key in suits:
            given[key] = suits.get(f"{key} of {name}", suits.get(key))
        elif parameter.default is inspect.Parameter.empty:
            given[key] = pick(rng, ODD)
    for key in rng.permutation(names)[: pick(rng, (1, 1, 2, 3))].tolist():
        value: Any = given.get(key)
        if _numbers(value) and rng.random() < 0.7:
            given[key] = spoiled(rng, value)
        else:
            given[key] = pick(rng, ODD) if rng.random() < 0.7 else pick(rng, list(suits.values()))
    told = f"{name}({', '.join(f'{key}={short_repr(value)}' for key, value in given.items())})"

    def call() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            try:
                function(**given)
            except (InputError, Fault) as error:
                print(f"padforge: {error}".encode(errors="backslashreplace").decode(), file=sys.stderr)
                raise SystemExit(1 if isinstance(error, Fault) else 2) from error  # as on the command line

    return call, told
