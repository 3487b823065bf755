"""Which inputs of a board are read, and whether it has them."""

from collections.abc import Sequence

from padforge.sense.rig.devices.protocols import RigFault


def chosen_inputs(inputs: Sequence[int], there: int, board: str) -> tuple[int, ...]:
    """`inputs`, fibre by fibre, of a board that has 0 to `there` - 1; all of them where none is named.

    Raises:
        RigFault: "refused" for one that the board has not.
    """
    for fibre, number in enumerate(inputs, start=1):
        if not 0 <= number < there:
            message = f"[rig] channels: fibre {fibre} is on input {number}, {board} has 0 to {there - 1}"
            raise RigFault("refused", message, "it may take a board with more inputs")
    return tuple(inputs) or tuple(range(there))
