"""`import padforge`: one import name for all that the packages hand out."""

import subprocess
import sys

import pytest

import design
import fabricate
import padforge
import sense

ALIASES = """
import padforge.design.pad.morphology as by_alias
from padforge.sense import Recording
import design.pad.morphology as by_name, sense
assert by_alias is by_name and by_name.__name__ == by_name.__spec__.name == "design.pad.morphology"
assert Recording is sense.Recording
"""


def test_the_packages_and_what_they_hand_out_are_there() -> None:
    assert (padforge.design, padforge.fabricate, padforge.sense) == (design, fabricate, sense)
    for package in (design, fabricate, sense):
        for name in package.__all__:
            assert getattr(padforge, name) is getattr(package, name), name
            assert name in dir(padforge)


def test_no_two_packages_hand_out_one_name() -> None:
    names = [name for package in (design, fabricate, sense) for name in package.__all__]
    assert len(names) == len(set(names))


def test_what_calls_them_needs_is_there() -> None:
    models = {name for name in dir(padforge) if name.endswith("Settings")}
    pad, mould = {"PadSettings", "SearchSettings", "RulesSettings"}, {"MouldSettings", "PrinterSettings"}
    assert models >= pad | mould | {"RigSettings", "LocalizerSettings", "FabricationSettings"}
    for model in models:
        getattr(padforge, model)()  # each has a default for everything
    with pytest.raises(AttributeError, match="module 'padforge' has no attribute 'nothing'"):
        padforge.nothing  # noqa: B018


@pytest.mark.parametrize("first", ["padforge", "design"])
def test_a_module_has_two_names_but_is_one(first: str) -> None:
    code = f"import {first}\n" + ALIASES
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_what_is_not_there_is_said_to_be_missing() -> None:
    for name in ("padforge.nothing", "padforge.design.nothing"):
        with pytest.raises(ModuleNotFoundError, match="nothing"):
            __import__(name)
