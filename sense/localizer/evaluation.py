"""Evaluation: how far off a localizer is, by sets of lost fibres, by place, and whether its radii hold."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from math import ceil, isnan
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError, check_int, check_type, short_repr
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer.features import bridged, window_inputs
from padforge.sense.localizer.model import Localization, LocalizerModel, Measured
from padforge.sense.recording.recording import Recording

FORMAT = "padforge-calibration/2"
CELLS = 5
"""Cells along a side of the map of errors by place."""
ACTIVE = 0.02
"""Share of its total variation that a fibre must change by to be active in a press (paper, table III)."""


def evaluate(localizer: LocalizerModel, recording: Recording, levels: Iterable[int] = (0, 1, 2, 3)) -> dict[str, Any]:
    """Errors of a localizer for every set of lost fibres of the sizes `levels`.

    On the recording it was trained on, only the presses held back then count; of any other, all of known place do.

    Returns:
        A document with "errors", one row per level: how many sets of lost fibres were tried; mean, standard deviation
        and greatest of their mean errors; median and 95th percentile over all their presses, mm; shares of presses
        within the radii of 50 and 90 %; where they were learnt and are known, the mean and 95th percentile of the error
        of depths and forces, and the share within their r90. Besides "split" ("none" for another recording),
        "test_presses", "by_subset" (mean error of each set), "by_place" (`by_place`), "idle_share" of each fibre, and
        "test" (places, depths and forces pressed, and found with all fibres).

    Raises:
        InputError: no level, one that leaves no fibre, no place known, or a recording that does not suit the localizer
            or was seen in its recalibration.
    """
    check_type("localizer", localizer, LocalizerModel)
    check_type("recording", recording, Recording)
    presses = len(recording.presses_mm)
    try:
        levels = tuple(levels)
    except TypeError as error:
        raise InputError(f"lost is {short_repr(levels)}, expected numbers of lost fibres") from error
    if not levels:
        raise InputError(f"lost names no number of fibres, expected one or more of 0 to {localizer.fibres - 1}")
    digest = recording.digest
    if digest in localizer.recalibrated_by:
        raise InputError("recording is one that the localizer was recalibrated by, expected one it has not seen")
    own = digest == localizer.training_recording_sha256
    test = held_back(localizer, recording) if own else np.flatnonzero(recording.known)
    if len(test) == 0:
        raise InputError(f"recording has no press of known place among its {presses}, expected at least one")
    inputs, positions_mm = localizer.scaled_features(recording)[test], recording.presses_mm[test]
    measures = {name: values[test] for name, values in recording.measures.items()}
    locate = partial(localizer.predict_features, inputs)
    rows, by_subset = errors_by_loss(localizer.fibres, levels, locate, positions_mm, measures)
    whole = localizer.predict_features(inputs)
    return {
        "format": FORMAT,
        "errors": rows,
        "split": localizer.split if own else "none",
        "test_presses": len(test),
        "by_subset": by_subset,
        "by_place": by_place(whole.positions_mm, positions_mm),
        "idle_share": idle_share(recording).tolist(),
        "test": {
            "press": test.tolist(),
            "pressed_mm": positions_mm.tolist(),
            "predicted_mm": whole.positions_mm.tolist(),
            "r90_mm": whole.r90_mm.tolist(),
            **_measures_told(whole, measures),
        },
        "provenance": {**localizer.provenance, "recording_kind": recording.source.get("kind")},
    }


def held_back(localizer: LocalizerModel, recording: Recording) -> Indices:
    """Presses of the recording it was trained on that a localizer says were held back, by index.

    Raises:
        InputError: one of them is not there, or its place is not known, so that it was not.
    """
    presses = len(recording.presses_mm)
    for press in localizer.test:
        if not 0 <= press < presses or not recording.known[press]:
            raise InputError(
                f"test press {press} of the localizer: no such press, allowed are 0 to {presses - 1} of known place"
            )
    return np.array(localizer.test, dtype=np.int64)


def _measures_told(found: Localization, measures: Mapping[str, Array]) -> dict[str, Any]:
    """Depths and forces found, their `r90`, and what they were, None where that is not known; by name."""
    return {
        name: {
            "pressed": [None if isnan(value) else value for value in measures[name].tolist()],
            "found": each.values.tolist(),
            "r90": each.r90.tolist(),
        }
        for name, each in found.measures.items()
    }


def errors_by_loss(
    fibres: int,
    levels: Iterable[int],
    locate: Callable[[tuple[int, ...]], Localization],
    positions_mm: Array,
    measures: Mapping[str, Array] | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """ "errors" and "by_subset" as `evaluate` gives them.

    Args:
        fibres: how many there are. levels: how many are lost.
        locate: finds the presses without the fibres given by index. positions_mm: (Q, 2) where they were.
        measures: (Q,) how deep and forceful they were, see `Recording.measures`.

    Raises:
        InputError: a level that leaves no fibre.
    """
    rows, by_subset = [], []
    for level in levels:
        level = check_int("lost", level, 0, fibres - 1)
        subsets = failure_subsets(fibres, level)
        found = [locate(subset) for subset in subsets]
        rows.append(error_row(level, found, positions_mm, measures))
        by_subset += [
            {"failed": list(subset), "mean_mm": float(distances(each.positions_mm, positions_mm).mean())}
            for subset, each in zip(subsets, found, strict=True)
        ]
    return rows, by_subset


def distances(predicted_mm: Array, pressed_mm: Array) -> Array:
    """(Q,) distance of (Q, 2) places."""
    return np.hypot(*(predicted_mm - pressed_mm).T)


def conformal(found: Sequence[Localization], positions_mm: Array, measures: Mapping[str, Array] | None = None) -> Array:
    """(3 + T,) factors by which standard deviations, the radii of 50 and 90 %, and the r90 of T measures must grow.

    They are then right for these presses.

    The radii are split-conformal (Lei et al. 2018, Distribution-free predictive inference for regression): of distance
    over radius on presses that entered nothing before, the least that is not below a share of them and the next one.
    So of few presses they are the more cautious.

    Args:
        found: the Q presses, with each of some sets of lost fibres. positions_mm: (Q, 2).
        measures: (Q,) of those that were learnt; where none is known its factor is 1.
    """
    off = [(each.positions_mm - positions_mm) / each.std_mm for each in found]
    errors = [distances(each.positions_mm, positions_mm) for each in found]
    r50 = _covering(0.5, np.array([error / each.r50_mm for error, each in zip(errors, found, strict=True)]))
    r90 = _covering(0.9, np.array([error / each.r90_mm for error, each in zip(errors, found, strict=True)]))
    more = [_conformal_r90(each) for each in _paired(found, measures).values()]
    return np.array([np.sqrt(np.square(off).mean()), r50, r90, *more])


def _covering(share: float, ratios: Array) -> float:
    """The least of the ratios (sets, Q) that a share of them and one more does not exceed; the greatest if all are few.

    Sets of one press are not independent of each other: they count for as many as the presses differ in how often they
    keep to the share.
    """
    ranked = np.sort(ratios, axis=None)
    kept = (ratios <= np.quantile(ratios, share)).mean(axis=0)
    presses, spread = len(kept), float(kept.var())
    alone = min(max(presses, share * (1 - share) * presses / spread), ranked.size) if spread else ranked.size
    rank = ceil(round(share * (1 + 1 / alone) * ranked.size, 9))
    return float(ranked[min(rank, ranked.size) - 1])


def _conformal_r90(pairs: list[tuple[Measured, Array]]) -> float:
    """The factor of `conformal` of the r90 of a measure."""
    ratios = np.array([np.abs(each.values - true) / each.r90 for each, true in pairs])
    ratios = ratios[:, np.isfinite(ratios).all(axis=0)]
    return _covering(0.9, ratios) if ratios.shape[1] else 1.0


def _paired(
    found: Sequence[Localization], measures: Mapping[str, Array] | None
) -> dict[str, list[tuple[Measured, Array]]]:
    """Of each measure learnt, how it was found with each set of lost fibres, and what it was; NaN if unknown."""
    names = list(found[0].measures)
    unknown = np.full(len(found[0].positions_mm), np.nan)
    return {name: [(each.measures[name], (measures or {}).get(name, unknown)) for each in found] for name in names}


def by_place(predicted_mm: Array, pressed_mm: Array) -> list[dict[str, Any]]:
    """Presses, mean and greatest error in each cell of the pad that was pressed; "x_mm", "y_mm" are its middle."""
    low, high = pressed_mm.min(axis=0), pressed_mm.max(axis=0)
    side = np.where(high > low, (high - low) / CELLS, 1.0)
    cells = np.minimum(((pressed_mm - low) / side).astype(int), CELLS - 1)
    errors = distances(predicted_mm, pressed_mm)
    rows = []
    for cell in np.unique(cells, axis=0):
        inside = (cells == cell).all(axis=1)
        x, y = low + (cell + 0.5) * side
        rows.append(
            {
                "x_mm": float(x),
                "y_mm": float(y),
                "presses": int(inside.sum()),
                "mean_mm": float(errors[inside].mean()),
                "max_mm": float(errors[inside].max()),
            }
        )
    return rows


def idle_share(recording: Recording) -> Array:
    """(C,) share of presses in which each fibre is idle: it changes by less than 2 % of its range over all presses."""
    changes = window_inputs(bridged(recording.readings), recording.down_command, recording.up_command, release=False)[
        :, :, -1
    ]
    variation = np.ptp(changes, axis=0)
    return (np.abs(changes) <= ACTIVE * variation).mean(axis=0)


def error_row(
    lost: int, found: list[Localization], positions_mm: Array, measures: Mapping[str, Array] | None = None
) -> dict[str, Any]:
    """A row of "errors" from what was found with each set of so many lost fibres, and what was pressed."""
    errors = np.stack([distances(each.positions_mm, positions_mm) for each in found])
    means = errors.mean(axis=1)
    return {
        "n_failed": lost,
        "subsets": len(errors),
        "mean_mm": float(means.mean()),
        "std_mm": float(means.std()),
        "max_mm": float(means.max()),
        "median_mm": float(np.median(errors)),
        "p95_mm": float(np.percentile(errors, 95)),
        "within_r50": float(np.mean([error <= each.r50_mm for error, each in zip(errors, found, strict=True)])),
        "within_r90": float(np.mean([error <= each.r90_mm for error, each in zip(errors, found, strict=True)])),
        **_measure_errors(found, measures),
    }


def _measure_errors(found: Sequence[Localization], measures: Mapping[str, Array] | None) -> dict[str, float]:
    """What a row of "errors" says of the measures that were learnt and are known."""
    out = {}
    for name, pairs in _paired(found, measures).items():
        kind, unit = name.rsplit("_", 1)
        known = ~np.isnan(pairs[0][1])
        if known.any():
            errors = np.stack([np.abs(each.values - true)[known] for each, true in pairs])
            within = [error <= each.r90[known] for error, (each, _) in zip(errors, pairs, strict=True)]
            out |= {
                f"{kind}_mean_{unit}": float(errors.mean()),
                f"{kind}_p95_{unit}": float(np.percentile(errors, 95)),
                f"{kind}_within_r90": float(np.mean(within)),
            }
    return out


def calibration_lines(document: Mapping[str, Any]) -> list[str]:
    """The errors of a calibration document as tables for people: of places, and of depth and force if learnt."""
    names = ("mean_mm", "std_mm", "max_mm", "median_mm", "p95_mm")
    of = " of a simulated pad" if document["provenance"].get("recording_kind") == "simulated" else ""
    return [
        f"error in mm on {document['test_presses']} presses{of} (split: {document['split']})",
        "lost  sets   mean    std    max median    p95  in r50  in r90",
        *(
            f"{row['n_failed']:4d} {row['subsets']:5d} {' '.join(f'{row[name]:6.2f}' for name in names)} "
            f"{row['within_r50']:7.1%} {row['within_r90']:7.1%}"
            for row in document["errors"]
        ),
        *measure_lines(document["errors"]),
    ]


def measure_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Errors of depth and force as tables for people, by rows of "errors"; none where they were not learnt."""
    out = []
    for kind, unit in (("depth", "mm"), ("force", "N")):
        names = (f"{kind}_mean_{unit.lower()}", f"{kind}_p95_{unit.lower()}")
        if names[0] in rows[0]:
            out += [f"error of {kind} in {unit}", "lost  sets   mean    p95  in r90"]
            out += [
                f"{row['n_failed']:4d} {row['subsets']:5d} {' '.join(f'{row[name]:6.2f}' for name in names)} "
                f"{row[f'{kind}_within_r90']:7.1%}"
                for row in rows
            ]
    return out
