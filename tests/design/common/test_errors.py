"""What a caller hands over: bounds belong to what is allowed, and just beyond them is refused."""

import math
from pathlib import Path

import numpy as np
import pytest

from design.common import errors
from design.common.errors import InputError, what_to_install


@pytest.mark.parametrize(
    ("value", "allowed"), [(2, True), (5, True), (1, False), (6, False), (True, False), (3.0, False)]
)
def test_a_whole_number_is_one_within_its_bounds(value, allowed):
    if allowed:
        assert errors.whole("n", np.int8(value), 2, 5) == value
    else:
        with pytest.raises(InputError, match=r"n is .*, allowed is a whole number from 2 to 5"):
            errors.whole("n", value, 2, 5)


@pytest.mark.parametrize("value", [0.0, 2.5, 1, np.float32(0.5)])
def test_a_number_within_its_bounds_is_a_float(value):
    number = errors.real("x", value, 0.0, 2.5)
    assert type(number) is float
    assert number == value


@pytest.mark.parametrize("value", [-1e-9, 2.5 + 1e-9, math.nan, math.inf, True, "1", 10**400, None])
def test_a_number_beyond_its_bounds_is_refused(value):
    with pytest.raises(InputError, match=r"x is .*, allowed is 0 to 2\.5"):
        errors.real("x", value, 0.0, 2.5)


@pytest.mark.parametrize("sign", [1, -1])
def test_numbers_are_bounded_on_either_side(sign):
    assert errors.reals("xs", [0, 3 * sign], 3).tolist() == [0, 3 * sign]
    with pytest.raises(InputError, match=r"xs hold 3\.5, allowed is -3 to 3"):
        errors.reals("xs", [0, 3.5 * sign], 3)


def test_a_path_is_neither_empty_nor_longer_than_systems_take():
    longest = "a" * errors.LONGEST_PATH
    assert errors.path("file", longest) == Path(longest)
    for value in ("", "a\0b", longest + "a", 3, None):
        with pytest.raises(InputError, match=r"file is .*, expected a path"):
            errors.path("file", value)


@pytest.mark.parametrize(
    ("module", "wanted", "said"),
    [
        ("torch.nn", "train", "torch, which is not installed: pip install 'padforge[train]'"),
        ("torch", "", "torch, which is not installed: pip install 'padforge[design]'"),
        ("distributed", "design", "distributed, which is not installed: pip install 'padforge[cluster]'"),
        ("serial", "train", "pyserial, which is not installed: pip install 'padforge[rig]'"),
        ("PIL", "design,cad,train", "pillow, which is not installed: pip install 'padforge[design,cad,train]'"),
    ],
)
def test_what_is_missing_is_told_with_what_brings_it(module, wanted, said):
    assert what_to_install(ModuleNotFoundError(name=module), wanted) == f"this needs {said}"


def test_what_no_extra_brings_is_no_matter_of_installing():
    for name in ("nothing_of_the_kind", "numpy", None):
        assert what_to_install(ModuleNotFoundError(name=name)) is None
