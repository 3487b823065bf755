import math
from pathlib import Path

import numpy as np
import pytest

from padforge.common import validation as errors
from padforge.common.validation import InputError, missing_extra


def test_checks_accept_values_at_their_bounds():
    assert str(InputError("pad\n.toml:\u2028none")) == "pad .toml: none"
    assert [errors.check_int("n", np.int8(n), 2, 5) for n in (2, 5)] == [2, 5]
    for value in (0.0, 2.5, 1, np.float32(0.5)):
        number = errors.check_float("x", value, 0.0, 2.5)
        assert (type(number), number) == (float, value)
    assert errors.check_array("xs", [0, 3, -3], 3).tolist() == [0, 3, -3]
    assert errors.check_path("file", "a/b") == Path("a/b")


@pytest.mark.parametrize(
    ("check", "values", "message"),
    [
        (lambda x: errors.check_int("n", x, 2, 5), (1, 6, True, 3.0), "n is .*, allowed is a whole number from 2 to 5"),
        (
            lambda x: errors.check_float("x", x, 0.0, 2.5),
            (-1e-9, 2.5 + 1e-9, math.nan, True, "1"),
            r"x is .*, allowed is 0 to 2\.5",
        ),
        (lambda x: errors.check_array("xs", [0, x], 3), (3.5, -3.5), r"xs hold 3\.5, allowed is -3 to 3"),
        (lambda x: errors.check_array("xs", x), ([1, [2]], "a", [1j], [math.nan]), "xs (are|hold) .*, expected"),
        (lambda x: errors.check_path("file", x), ("", 3), "file is .*, expected a path"),
    ],
)
def test_checks_refuse_values_beyond_their_bounds_and_of_other_types(check, values, message):
    for value in values:
        with pytest.raises(InputError, match=message):
            check(value)


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
