"""Hashes of results that a change of code is not to move: signals, objective, search, mould, calibration and the rest.

`python -m benchmarks.hashes > FILE` keeps them, with `--recording PATH` also of the presses found in a recording of a
real pad. `--against FILE` prints what has moved since then, and exits with 1 if anything has. The hashes are of all
bits, so that they hold for one machine and its libraries.
"""

import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from padforge import design, fabricate, sense
from padforge.common.parallel import one_thread
from padforge.design.published.objective import published_terms

PAD = design.Morphology.random(2, knots=3, seed=5)
SEARCH = design.SearchSettings(knots=3, starts=1, steps=20)
CALIBRATION = sense.LocalizerSettings(members=2, hidden=48, layers=2, epochs=20, batch=64)
Result = tuple[str, str]  # the name of a result and its digest


def digest(*parts: Any) -> str:
    """Return a short SHA-256 digest of arrays, and of other values by their representation."""
    content = hashlib.sha256()
    for part in parts:
        content.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return content.hexdigest()[:16]


def hash_pads() -> Iterator[Result]:
    """Yield the digests of what is computed of a pad, of a short search and of a mould."""
    presses = np.random.default_rng(0).uniform(0, 1, (50, 2))
    yield "signals", digest(design.signals(PAD, presses))
    yield "published signals", digest(design.signals_quantized(PAD, presses))
    yield "published objective", digest(published_terms(PAD))
    yield "score", digest(design.score(PAD))
    yield "search", digest(design.search(settings=SEARCH).morphology.knots)
    with tempfile.TemporaryDirectory() as folder:
        fabricate.build(PAD, folder, formats=["stl"])
        yield "mould", digest((Path(folder) / "mould.stl").read_bytes())


def hash_calibration() -> Iterator[Result]:
    """Yield the digests of a simulated recording and of all that a calibration makes of it.

    Health and the live replay also see a fibre that is stuck from the middle of the recording on.
    """
    recording = sense.simulate(PAD, sense.RigSettings(presses=320, seed=1))
    yield "simulated recording", digest(recording.readings, recording.presses_mm)
    yield "detected presses", hash_presses(recording)
    model, evaluation = sense.calibrate(recording, CALIBRATION)
    weights = [array for network in model.networks.values() for array in network.values()]
    yield "calibration", digest(*weights, model.table, model.interval_factors, evaluation.errors)
    detector = sense.FaultDetector(seed=0).fit(recording)
    faulty, half = recording.readings.copy(), len(recording.readings) // 2
    faulty[half:, 1] = faulty[half, 1]
    recordings = recording, replace(recording, readings=faulty)
    yield "health", digest([fault.text for each in recordings for fault in detector.predict(each)])
    live = sense.Live(model, rate_hz=recording.rate_hz, health=detector.live_model_)
    middle = slice(half - 1000, half + 3000)
    yield "live", digest(live.update(recording.times_s[middle], faulty[middle]), live.view())


def hash_presses(recording: sense.Recording) -> str:
    """Return the digest of the presses that are detected in a recording."""
    return digest(*sense.detect_presses(recording.readings, recording.times_s))


@click.command(help=__doc__)
@click.option("--recording", type=click.Path(path_type=Path), help="A recording, such as the published one.")
@click.option("--against", type=click.Path(exists=True, path_type=Path), help="Hashes of an earlier run.")
def main(recording: Path | None, against: Path | None) -> None:
    """Print the hashes, or what has moved."""
    with one_thread():
        hashes = dict([*hash_pads(), *hash_calibration()])
    if recording is not None:
        hashes[f"presses of {recording.name}"] = hash_presses(sense.open_recording(recording))
    if against is None:
        print(json.dumps(hashes, indent=1))
        return
    earlier = json.loads(against.read_text(encoding="utf-8"))
    moved = [name for name in hashes if hashes[name] != earlier.get(name)]
    print("\n".join(f"moved: {name}" for name in moved) or f"{len(hashes)} results, nothing moved")
    sys.exit(bool(moved))


if __name__ == "__main__":
    main()
