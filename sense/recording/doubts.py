"""Doubts about a recording: implausible units, and presses far outside of the others."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from padforge.sense.arrays import Array, Mask
from padforge.sense.recording.recording import Recording

MIN_SPAN_MM = 2.0  # span of the presses on the smallest pad; positions in m have a smaller one
MIN_RATE_HZ = 1.5  # even multimeters are faster; 200 readings a second have 0.2 Hz if times in ms are read as s
MAX_RATE_HZ = 10_000.0  # even fast boards are slower
REFERENCE_V = 3.3  # reference of common boards
MARGIN = 0.5  # distance from most presses, relative to their span, beyond which a press is far outside
MIN_PRESSES = 20  # minimum number of presses for an estimate of that span
MAX_NAMED = 5  # presses in a message


def area_mm(recording: Recording) -> Array | None:
    """Return the extent (2,) of the known positions along x and y, mm; None for fewer than two."""
    positions_mm = recording.presses_mm[recording.has_position]
    return np.ptp(positions_mm, axis=0) if len(positions_mm) > 1 else None


def find_doubts(recording: Recording) -> list[str]:
    """Return the doubts about a recording, a line each; presses count from 0."""
    return [*_unit_doubts(recording), *_far_presses(recording)]


def name_presses(recording: Recording, mask: Mask) -> str:
    """Describe the presses of a mask (Q,): positions of the first `MAX_NAMED`, and the number of the others."""
    presses = np.flatnonzero(mask)
    named = ["press {} at ({:.4g}, {:.4g}) mm".format(press, *recording.presses_mm[press]) for press in presses]
    more = [f"{len(presses) - MAX_NAMED} more"] if len(presses) > MAX_NAMED else []
    return ", ".join([*named[:MAX_NAMED], *more])


def suggest_unit(
    source: Mapping[str, Any], quantity: str, readings: Array | None = None, rate_hz: float = MIN_RATE_HZ / 1000
) -> str:
    """Return the probable unit of `time`, `positions` or `fibres`, and the entry of the mapping that states it.

    The mapping is `columns` in the source of the recording. Readings that were taken as V show how many bits a
    converter has; the rate of times that were taken as s decides between ms, us and ns.
    """
    columns = str(source.get("columns", ""))
    names = [piece.partition("=")[::2] for piece in columns.split(",")] if columns else []

    def entry(quantities: Sequence[str], unit: str) -> str:
        stated = [
            (quantity, re.sub(r":[^:\]]*$", "", name)) for quantity, name in names if quantity.strip() in quantities
        ]
        unnamed = [(quantity, "NAME") for quantity in quantities]
        return ",".join(f"{quantity.strip()}={name}:{unit}" for quantity, name in stated or unnamed)

    if quantity == "time":
        units = {"ms": 1e3, "us": 1e6}
        unit = next((unit for unit, factor in units.items() if rate_hz * factor >= MIN_RATE_HZ), "ns")
        return f"{unit} ({entry(['time'], unit)})"
    if quantity == "positions":
        return f"in m ({entry(['x', 'y'] if 'x=' in columns or not columns else ['positions'], 'm')})"
    highest = float(np.nanmax(readings)) if readings is not None else 0.0
    bits = next((bits for bits in (10, 12, 14, 16) if highest < 2**bits), 24)
    volts = f"{entry(['fibres'], format(REFERENCE_V / (2**bits - 1), '.3g'))} for {bits} bits of {REFERENCE_V:g} V"
    return f"counts ({volts}), or mV ({entry(['fibres'], 'mV')})"


def rate_doubts(rate_hz: float, source: Mapping[str, Any]) -> list[str]:
    """Return the doubts about a number of readings a second, with advice by the mapping in a recording's source."""
    if rate_hz < MIN_RATE_HZ:
        return [
            f"there are {rate_hz:.2g} readings a second; is time in {suggest_unit(source, 'time', rate_hz=rate_hz)}?"
        ]
    if rate_hz > MAX_RATE_HZ:
        return [f"there are {rate_hz:.4g} readings a second; is time in s (time=NAME:s)?"]
    return []


def _unit_doubts(recording: Recording) -> list[str]:
    doubts, source = [], recording.source
    area, rate_hz = area_mm(recording), recording.rate_hz
    rest_v = float(np.nanmedian(np.abs(recording.readings)))
    if area is not None and 0 < area.max() < MIN_SPAN_MM:
        doubts.append(f"positions span {area[0]:.4g} x {area[1]:.4g} mm; are they {suggest_unit(source, 'positions')}?")
    if area is not None and area.max() > 2000.0:
        doubts.append(f"positions span {area[0]:.4g} x {area[1]:.4g} mm; are they in another unit (x=NAME:UNIT)?")
    doubts += rate_doubts(rate_hz, source)
    if rest_v > 50.0:
        doubts.append(f"fibres rest at {rest_v:.4g} V; are they {suggest_unit(source, 'fibres', recording.readings)}?")
    return doubts


def _far_presses(recording: Recording) -> list[str]:
    positions_mm = recording.presses_mm[recording.has_position]
    if len(positions_mm) < MIN_PRESSES:
        return []
    low, high = np.percentile(positions_mm, [5, 95], axis=0)
    margin = MARGIN * (high - low).max()
    is_far = ((recording.presses_mm < low - margin) | (recording.presses_mm > high + margin)).any(axis=1)
    if not is_far.any():
        return []
    usual = "x = {:.4g} to {:.4g}, y = {:.4g} to {:.4g} mm".format(*np.stack([low, high], axis=1).ravel())
    return [f"far outside of where most presses lie, {usual}: {name_presses(recording, is_far)}"]
