"""`localizer.onnx`: written only if onnxruntime finds the places in it that the localizer itself finds."""

import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime

from padforge.design.common.files import atomic_file
from padforge.design.common.validation import Fault, InputError
from padforge.sense.health.trained_model import refuse_other_pad
from padforge.sense.localizer.features import DOWN, bridged, press_inputs
from padforge.sense.localizer.localizer import Localizer
from padforge.sense.recordings.processing.limits import Array, Indices, Mask
from padforge.sense.recordings.recording import Recording

from padforge.sense.live.deployment.onnx_graph.localizer_graph import INPUTS, MEASURES, OUTPUTS, onnx_model

FORMAT = "padforge-onnx/1"
MOST_OFF_MM = 1e-4
"""A graph whose places differ by more from those of its localizer is not written."""
TRIED = 64
"""Presses made up to try a graph on where there is no recording."""
CYCLE = 40
"""Readings from one of them to the next."""


class Exported(NamedTuple):
    """What was written: bytes of the file, presses it was tried on, with up to so many fibres lost, and the greatest
    distance, mm, of a place from that of the localizer, and difference, mm, of a radius of 90 %."""

    size: int
    presses: int
    lost: int
    places_mm: float
    radii_mm: float


class _Readings(NamedTuple):
    readings: Array
    begun: Indices
    lifted: Indices


def onnx_line(found: Exported) -> str:
    """The same for people."""
    return (
        f"{found.size / 1e6:.1f} MB, tried on {found.presses} presses with up to {found.lost} fibres lost: "
        f"places within {1e3 * found.places_mm:.2f} µm of the localizer's, radii within {1e3 * found.radii_mm:.2f} µm"
    )


def export_onnx(localizer: Localizer, digest: str, path: Path, recording: Recording | None = None) -> Exported:
    """Write `localizer` as an ONNX graph, tried on the presses of `recording`, or on some made up.

    Args:
        digest: of its `localizer.json`, which has that of its weights.

    Raises:
        InputError: it is of the published method, the recording is of another pad or rate, or `path` cannot be written.
        Fault: places differ by more than `MOST_OFF_MM`.
    """
    if localizer.method != "masked":
        raise InputError(f"the localizer is of method {localizer.method}, expected masked: calibrate again")
    if recording is not None:
        refuse_other_pad(localizer, "the localizer", recording.fibres, recording.rate_hz)
    metadata = {
        "format": FORMAT,
        "padforge": version("padforge"),
        "localizer_sha256": digest,
        "learnt_from": localizer.learnt_from,
        "features": localizer.features,
        "rate_hz": f"{localizer.rate_hz:.9g}",
        "fibres": json.dumps([f"fibre_{fibre}_v" for fibre in range(localizer.fibres)]),
        "inputs": json.dumps(INPUTS),
        "outputs": json.dumps(OUTPUTS | {name: MEASURES[name] for name in _measured(localizer)}),
    }
    content = onnx_model(localizer, metadata).SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    tried = _made_up(localizer) if recording is None else _of(recording)
    places, radii, lost = _differences(localizer, session, tried)
    if not places <= MOST_OFF_MM:
        raise Fault(
            f"{path}: not written, onnxruntime finds places {places:.2g} mm off those of the localizer, "
            f"allowed are {MOST_OFF_MM:g} mm"
        )
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)
    return Exported(len(content), len(tried.begun), lost, places, radii)


def _measured(localizer: Localizer) -> list[str]:
    kinds = [target.name.rsplit("_", 1) for target in localizer.normalization.measures]
    return [f"{kind}{part}_{unit}" for kind, unit in kinds for part in ("", "_r90")]


def _of(recording: Recording) -> _Readings:
    return _Readings(recording.readings, recording.begun, recording.lifted)


def _made_up(localizer: Localizer) -> _Readings:
    """Readings of presses as strong as those that were learnt from, wherever such may be."""
    rng, scaling = np.random.default_rng(0), localizer.normalization
    begun = CYCLE // 2 + CYCLE * np.arange(TRIED)
    lifted = begun + DOWN[-1][1]
    readings = 1e-3 * rng.standard_normal((TRIED * CYCLE + CYCLE, localizer.fibres))
    strength = np.abs(scaling.centre).max(axis=1) + scaling.spread.max(axis=1)
    for first, end in zip(begun, lifted, strict=True):
        readings[first:end] += strength * rng.uniform(-1, 1, localizer.fibres)
    return _Readings(readings, begun, lifted)


def _differences(
    localizer: Localizer, session: onnxruntime.InferenceSession, tried: _Readings
) -> tuple[float, float, int]:
    """Greatest distance of places, and difference of radii, mm, over all levels of loss that it was trained for."""
    presses = localizer.normalization.inputs(press_inputs(*tried, localizer.features))
    rng, most = np.random.default_rng(0), len(localizer.factors) - 1
    off: list[tuple[float, float]] = []
    for lost in range(most + 1):
        alive = presses.alive & _without(presses.alive.shape, lost, rng)
        found = localizer.locate(replace(presses, alive=alive))
        given = {"readings": bridged(tried.readings), "begun": tried.begun, "lifted": tried.lifted, "alive": alive}
        places, r90 = map(np.asarray, session.run(["places_mm", "r90_mm"], given))
        off.append((float(np.hypot(*(places - found.places_mm).T).max()), float(np.abs(r90 - found.r90_mm).max())))
    worst = np.max(off, axis=0)
    return float(worst[0]), float(worst[1]), most


def _without(shape: tuple[int, ...], lost: int, rng: np.random.Generator) -> Mask:
    """(Q, C) masks, in every press another random set of so many fibres lost."""
    return rng.random(shape).argsort(axis=1) >= lost
