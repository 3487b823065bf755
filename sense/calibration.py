"""Calibration: learn places from a recording, and say how far off they are on presses never learnt from."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from design.errors import InputError
from design.files import provenance
from design.losses import lost_subsets
from design.settings import validated

from . import settings
from .localizer import Localizer, Scaling
from .network import refuse_unsound
from .presses import INPUTS
from .recording import Recording

FORMAT = "padforge-calibration/1"
LEAST_TRAINING = 2
"""Presses needed to learn from: of fewer, the span is none."""

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def calibrate(
    recording: Recording,
    options: settings.Localizer | None = None,
    *,
    split: str | None = None,
    seed: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Localizer, dict[str, Any]]:
    """Train a localizer on a part of the presses and test it on the rest.

    Test presses enter nothing but the test: not the scaling, not the training, not its length.

    Args:
        recording: readings and presses with known places.
        options: how to learn; the defaults if None. split, seed: win over those of `options`.
        progress: called with (epochs done, epochs in all).

    Returns:
        The localizer, and the document of `calibration.json`.

    Raises:
        InputError: an option out of range, too few presses to hold a share back, or a training that diverged.
    """
    given = {key: value for key, value in (("split", split), ("seed", seed)) if value is not None}
    options = validated(settings.Localizer, {**(options or settings.Localizer()).model_dump(), **given}, "[localizer]")
    rng = np.random.default_rng(options.seed)
    training, test = split_presses(len(recording.presses_mm), options.split, options.test_share, rng)
    made_by = provenance("padforge sense calibrate", options.seed, packages=("torch", "safetensors"))
    made_by["inputs"] = {"recording": recording.digest}

    raw = INPUTS[options.features](recording.readings, recording.begun, recording.lifted)[training]
    places_mm = recording.presses_mm[training]
    scaling = Scaling.fit(raw, places_mm)
    from .training import train  # torch, seconds to import, is needed here only

    weights = train(scaling.inputs(raw), scaling.targets(places_mm), options, rng, progress)
    try:
        refuse_unsound(weights, scaling.entries)
    except InputError as error:
        raise InputError(f"training diverged at [localizer] rate {options.rate:g}, try a lower one: {error}") from error
    localizer = Localizer(
        weights=weights,
        scaling=scaling,
        features=options.features,
        rate_hz=recording.rate_hz,
        learnt_from=recording.digest,
        split=options.split,
        test=tuple(test.tolist()),
        provenance=made_by,
    )
    document = evaluate(localizer, recording, range(min(options.lost, recording.fibres - 1) + 1))
    document |= {"training_presses": len(training), "settings": options.model_dump()}
    return replace(localizer, errors=document["errors"]), document


def split_presses(presses: int, split: str, share: float, rng: np.random.Generator) -> tuple[Indices, Indices]:
    """Indices (ascending) of the presses to learn from and of those held back: drawn at random, or the last.

    Raises:
        InputError: a share of so few presses leaves none on one side.
    """
    test = round(share * presses)
    if not 1 <= test <= presses - LEAST_TRAINING:
        raise InputError(
            f"recording has {presses} presses: a test share of {share:g} holds {test} back, expected at least 1, "
            f"and {LEAST_TRAINING} to learn from"
        )
    order = rng.permutation(presses) if split == "random" else np.arange(presses)
    return np.sort(order[:-test]), np.sort(order[-test:])


def evaluate(localizer: Localizer, recording: Recording, levels: Iterable[int] = (0, 1, 2, 3)) -> dict[str, Any]:
    """Errors of a localizer for every set of lost fibres of the sizes `levels`.

    On the recording it was trained on, only the presses held back then count; of any other, all do.

    Returns:
        A document with "errors", one row per level: how many sets of lost fibres were tried; mean, standard deviation
        and greatest of their mean errors; median and 95th percentile over all their presses, mm. Besides "split"
        ("none" for another recording), "test_presses", "by_subset" (mean error of each set) and "test" (places
        pressed, and found with all fibres).

    Raises:
        InputError: no level, one that leaves no fibre, or a recording that does not suit the localizer.
    """
    levels, presses = tuple(levels), len(recording.presses_mm)
    if not levels:
        raise InputError(f"lost names no number of fibres, expected one or more of 0 to {localizer.fibres - 1}")
    own = recording.digest == localizer.learnt_from
    if own and not max(localizer.test) < presses:
        raise InputError(
            f"test press {max(localizer.test)} of the localizer: no such press, allowed are 0 to {presses - 1}"
        )
    test = np.array(localizer.test if own else range(presses), dtype=np.int64)
    inputs, places_mm = localizer.inputs(recording)[test], recording.presses_mm[test]
    rows, by_subset = [], []
    for level in levels:
        if not 0 <= level < localizer.fibres:
            raise InputError(f"lost is {level}, allowed is 0 to {localizer.fibres - 1}, so that a fibre is left")
        subsets = lost_subsets(localizer.fibres, level)
        errors = np.stack([distances(localizer.places(inputs, subset), places_mm) for subset in subsets])
        rows.append(_summary(level, errors))
        by_subset += [
            {"lost": list(subset), "mean_mm": mean}
            for subset, mean in zip(subsets, errors.mean(axis=1).tolist(), strict=True)
        ]
    return {
        "format": FORMAT,
        "errors": rows,
        "split": localizer.split if own else "none",
        "test_presses": len(test),
        "by_subset": by_subset,
        "test": {
            "press": test.tolist(),
            "pressed_mm": places_mm.tolist(),
            "found_mm": localizer.places(inputs).tolist(),
        },
        "provenance": dict(localizer.provenance),
    }


def locate(localizer: Localizer, recording: Recording, lost: ArrayLike = ()) -> Array:
    """(Q, 2) places in mm found for every press of `recording`, without the fibres `lost`, by index."""
    return localizer.places(localizer.inputs(recording), lost)


def distances(found_mm: Array, pressed_mm: Array) -> Array:
    """(Q,) distance of (Q, 2) places."""
    return np.hypot(*(found_mm - pressed_mm).T)


def _summary(lost: int, errors: Array) -> dict[str, Any]:
    """A row of "errors" from (subsets, Q) errors in mm."""
    means = errors.mean(axis=1)
    return {
        "lost": lost,
        "subsets": len(errors),
        "mean_mm": float(means.mean()),
        "std_mm": float(means.std()),
        "max_mm": float(means.max()),
        "median_mm": float(np.median(errors)),
        "p95_mm": float(np.percentile(errors, 95)),
    }
