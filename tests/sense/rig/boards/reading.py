"""What tests of boards share: a source of known voltages, and readings gathered for a while or up to a fault."""

import time
from collections.abc import Callable

import numpy as np
import pytest

from sense.rig.devices.protocols import Converter, ConverterSamples, RigFault

STEP_V = 3.3 / 4095


def waves(times_s: np.ndarray) -> np.ndarray:
    """Sixteen different slow voltages."""
    return 1.65 + 1.5 * np.sin(2 * np.pi * (0.7 + 0.1 * np.arange(16)) * times_s[:, None])


def joined(parts: list[ConverterSamples]) -> ConverterSamples:
    return ConverterSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def read_for(converter: Converter, seconds: float) -> ConverterSamples:
    parts, end = [converter.read()], time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.02)
        parts.append(converter.read())
    return joined(parts)


def fault_of(action: Callable[[], object], cause: str, match: str = ".") -> float:
    """Call `action` until it raises the fault; returns how long that took."""

    def repeat() -> None:
        while time.monotonic() < begun + 10:
            action()
            time.sleep(0.01)

    begun = time.monotonic()
    with pytest.raises(RigFault, match=match) as caught:
        repeat()
    assert caught.value.cause == cause
    return time.monotonic() - begun
