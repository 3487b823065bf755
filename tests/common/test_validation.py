import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from padforge.common import validation as errors
from padforge.common.validation import InputError, missing_extra
from tests.helpers.refusals import refusal_table


def test_checks_accept_values_at_their_bounds():
    assert str(InputError("pad\n.toml:\u2028none")) == "pad .toml: none"
    assert [errors.check_int("n", np.int8(n), 2, 5) for n in (2, 5)] == [2, 5]
    for value in (0.0, 2.5, 1, np.float32(0.5)):
        number = errors.check_float("x", value, 0.0, 2.5)
        assert (type(number), number) == (float, value)
    assert errors.check_array("xs", [0, 3, -3], 3).tolist() == [0, 3, -3]
    assert errors.check_path("file", "a/b") == Path("a/b")


CHECKS: tuple[tuple[Callable[..., object], tuple[object, ...], tuple[float, ...]], ...] = (
    (errors.check_int, (1, 6, True, 3.0), (2, 5)),
    (errors.check_float, (-1e-9, 2.5 + 1e-9, math.nan, True, "1"), (0.0, 2.5)),
    (errors.check_array, ([0, 3.5], [0, -3.5], [1, [2]], "a", [1j], [math.nan]), (3,)),
    (errors.check_path, ("", 3), ()),
)


def test_checks_refuse_values_beyond_their_bounds_and_of_other_types(golden):
    calls = ((partial(check, "x", value, *bounds), value) for check, values, bounds in CHECKS for value in values)
    golden("padforge/refusals_of_values.txt", refusal_table({f"{call.func.__name__} {x!r}": call for call, x in calls}))


@pytest.mark.parametrize(
    ("module", "wanted", "said"),
    [
        ("torch.nn", "train", "torch, which is not installed: pip install 'padforge[train]'"),
        ("torch", "", "torch, which is not installed: pip install 'padforge[train]'"),
        ("distributed", "design", "distributed, which is not installed: pip install 'padforge[cluster]'"),
        ("serial", "train", "pyserial, which is not installed: pip install 'padforge[rig]'"),
        ("PIL", "design,cad,train", "pillow, which is not installed: pip install 'padforge[design,cad,train]'"),
        *((name, "", None) for name in ("nothing_of_the_kind", "numpy", None)),
    ],
)
def test_missing_extra_names_the_extra(module, wanted, said):
    assert missing_extra(ModuleNotFoundError(name=module), wanted) == (said and f"this needs {said}")
