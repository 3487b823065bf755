"""What fits into a microcontroller: bytes of the tables and of the state of `localizer.h`, and the largest network."""

from dataclasses import dataclass

from padforge.design.common.validation import InputError

from padforge.sense.live.deployment.kernels.press_stream import RING, WINDOWS
from padforge.sense.live.deployment.streaming import POLES

LAYERS = 3
"""Residual layers of a student."""
WIDEST, STEP = 256, 4
"""Neurons of a layer at most, and by which it grows."""
CODE = 8192
"""Bytes of flash left for the code: 3 KiB of them on x86-64, and the expf and sqrtf of the library."""
SCALARS = 64
"""Bytes of the state beside its arrays, at most."""
_HISTORY, _INPUTS = len(POLES), len(WINDOWS)


@dataclass(frozen=True)
class Budget:
    """What a student may take.

    Attributes:
        flash, ram: bytes for code and tables, and for the state, its working arrays included.
        quantized: whether the weights are int8, not float32.
    """

    flash: int
    ram: int
    quantized: bool = False


def table_bytes(fibres: int, measures: int, levels: int, hidden: int, quantized: bool) -> int:
    """Bytes of all constant tables of a student.

    Args:
        measures: what is learnt beside the place. levels: numbers of lost fibres that radii are known for.
    """
    entries, outputs = fibres * (_INPUTS + 1), 2 * (2 + measures)
    weights = entries * hidden + LAYERS * hidden * hidden + hidden * outputs
    biases = (LAYERS + 1) * hidden + outputs
    network = weights + 8 * biases if quantized else 4 * (weights + biases)  # of int8, one scale goes with each bias
    memory = fibres * (2 * _INPUTS + _HISTORY * (1 + _INPUTS))
    return network + 4 * (memory + fibres + _HISTORY + levels * (3 + measures))


def state_bytes(fibres: int, measures: int, hidden: int) -> int:
    """Bytes of `localizer_state`, at most."""
    entries, outputs = fibres * (_INPUTS + 1), 2 * (2 + measures)
    kept = fibres * (RING + 2 * _HISTORY + 2) + entries + 2 * hidden + outputs
    return 4 * kept + 3 * fibres + 4 * fibres + SCALARS


def widest(fibres: int, measures: int, levels: int, budget: Budget) -> int:
    """Neurons of a layer that a budget allows.

    Raises:
        InputError: not even the least student fits.
    """

    def takes(hidden: int) -> tuple[int, int]:
        flash = CODE + table_bytes(fibres, measures, levels, hidden, budget.quantized)
        return flash, state_bytes(fibres, measures, hidden)

    fitting = [
        hidden
        for hidden in range(STEP, WIDEST + 1, STEP)
        if takes(hidden)[0] <= budget.flash and takes(hidden)[1] <= budget.ram
    ]
    if not fitting:
        flash, ram = takes(STEP)
        name, given, needed = ("flash", budget.flash, flash) if flash > budget.flash else ("ram", budget.ram, ram)
        raise InputError(
            f"--{name} is {given} bytes: the least localizer of {fibres} fibres takes {needed}, allowed is that or more"
        )
    return fitting[-1]
