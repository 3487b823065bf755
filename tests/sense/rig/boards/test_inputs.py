import pytest

from sense.rig.boards.inputs import chosen_inputs
from sense.rig.devices.protocols import RigFault


def test_inputs_are_those_that_are_named_or_all() -> None:
    assert chosen_inputs((5, 0, 15), 16, "the board") == (5, 0, 15)
    assert chosen_inputs((), 3, "the board") == (0, 1, 2)


@pytest.mark.parametrize("inputs", [(0, 1, 2, 3), (0, 3), (-1, 3)])
def test_an_input_that_is_not_there_is_named(inputs: tuple[int, ...]) -> None:
    with pytest.raises(RigFault, match=r"\[rig\] channels: fibre [124] is on input (3|-1), the board has 0 to 2"):
        chosen_inputs(inputs, 3, "the board")
