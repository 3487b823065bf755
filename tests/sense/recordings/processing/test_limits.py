"""What a recording may hold, at the ends of what is allowed."""

import numpy as np
import pytest

from design.common.errors import InputError
from sense.recordings.processing.limits import MAX_INDEX, as_numbers, refuse_beyond


def test_what_lies_beyond_is_named_with_its_row_and_the_limit() -> None:
    values = np.array([[1.0, -5.0], [5.0, 2.0], [0.0, -5.1]])
    refuse_beyond("places", values[:2], 5.0, "mm")
    with pytest.raises(InputError, match=r"places hold -5.1 mm \(first in row 2\), allowed is -5 to 5 mm"):
        refuse_beyond("places", values, 5.0, "mm")


@pytest.mark.parametrize(("bad", "missing", "told"), [(np.nan, False, "NaN or infinity"), (np.inf, True, "infinity")])
def test_what_is_not_finite_is_named_with_its_row(bad: float, missing: bool, told: str) -> None:
    values = np.array([[1.0, 2.0], [1.0, bad], [bad, 1.0]])
    with pytest.raises(InputError, match=rf"readings hold {told} \(first in row 1\)"):
        refuse_beyond("readings", values, 5.0, "V", missing)
    refuse_beyond("readings", np.array([[np.nan, 1.0]]), 5.0, "V", missing=True)


def test_whole_numbers_are_whole_and_not_too_great() -> None:
    assert as_numbers([1.0, -2.0], np.int64, "starts").tolist() == [1, -2]
    assert as_numbers([MAX_INDEX], np.int64, "starts").tolist() == [MAX_INDEX]
    for values in ([0.5], [MAX_INDEX + 2], [-MAX_INDEX - 2], [np.nan], ["1"], [True]):
        with pytest.raises(InputError, match=r"starts are .*, expected an array of whole numbers"):
            as_numbers(values, np.int64, "starts")
    with pytest.raises(InputError, match="expected an array of real numbers"):
        as_numbers([1j], np.float64, "readings")
