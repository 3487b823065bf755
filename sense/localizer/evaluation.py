"""Evaluation of a localizer: errors for every set of failed fibres and by position, and coverage of its radii."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import gammaincinv

from padforge.common.parallel import map_threads
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.validation import InputError, check_int, check_type
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer.features import compute_features, interpolate_gaps, window_means
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.localizer.moments import MOMENTS, PRESS_WINDOWS, Moment
from padforge.sense.localizer.single_press import OTHER_PAD
from padforge.sense.recording import doubts
from padforge.sense.recording.frames import framed
from padforge.sense.recording.recording import Recording

if TYPE_CHECKING:
    from pandas import DataFrame

FORMAT = "padforge-calibration/1"
SIMULATED_NOTE = "simulated, by default with the scatter of a built pad, which itself errs 0.94 / 1.20 / 1.57 / 2.33 mm"
"""Note beside simulated errors. Its numbers are of the published recording, with 0 to 3 of its 6 fibres failed."""
CELLS = 5  # cells along a side of the map of errors by position
MOMENT_SETS = 3  # maximum sets of failed fibres of a size at each moment
NO_MOMENTS: dict[str, Any] = {"by_moment": [], "focus": {}}
CONVERGED_SHARE = 0.5  # share of the steps of a training after which errors are within 5 % of the final ones
PRIOR_PRESSES = 100  # weight of the experience with other pads in radii, in presses
RATIO_SHAPE = 2.1
"""Shape of the gamma distribution of the ratio of distance to expected radius on other pads; it does not depend on the
pad, the moment or the failed fibres."""
N_PRIOR = 200  # quantiles that represent this distribution
MAX_UNCERTAINTY = 0.043  # uncertainty of the share within r90 above which it is reported
MAX_RADII = 4.0
"""Maximum distance of the predicted from the stated position, in radii of 90 %: on the published recording it is up to
2.5, and 5 or more if the sign of a coordinate is lost."""
MIN_WITHIN_R90 = 0.5  # minimum share of presses within their radii; on a pad that drifted for hours it is larger
MIN_PRESSES = 20  # minimum number of presses for that share
ACTIVE = 0.02  # share of its range that a fibre must change by to be active in a press (paper, table III)
Measures = Mapping[str, Array]
_NO_PRIOR = np.empty(0)


@dataclass(frozen=True)
class Evaluation:
    """Errors of a localizer on test presses.

    Attributes:
        errors: rows of `error_row`, one a number of failed fibres.
        split: how the test presses were held back; "none" in another recording than that of the training.
        test_presses: their number.
        by_subset: mean error of each set of failed fibres.
        by_position: rows of `errors_by_position`.
        by_moment: rows of `errors_by_moment`.
        focus: how a press is localized while it is read, see `errors_by_moment`.
        idle_share: of each fibre, see `idle_share`.
        test: true and predicted positions, depths and forces, with all fibres valid.
        provenance: of the localizer, and the kind of the recording.
        training_presses: their number, after a calibration.
        settings: of the training, after a calibration.
        trained_share: share of the usual steps in the training of the localizer.
        radii_presses: presses on which the radii of the localizer were calibrated; 0 if unknown.
        doubts: reasons to doubt the evaluation, one a line.
    """

    errors: list[dict[str, Any]]
    split: str
    test_presses: int
    by_subset: list[dict[str, Any]]
    by_position: list[dict[str, Any]]
    by_moment: list[dict[str, Any]]
    focus: dict[str, Any]
    idle_share: list[float]
    test: dict[str, Any]
    provenance: dict[str, Any]
    training_presses: int | None = None
    settings: dict[str, Any] | None = None
    trained_share: float = 1.0
    radii_presses: int = 0
    doubts: Sequence[str] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the document of `calibration.json`."""
        return {"format": FORMAT} | {name: value for name, value in vars(self).items() if value is not None}

    def to_frame(self) -> "DataFrame":
        """Return `errors` as a table of pandas; InputError where it is not installed."""
        try:
            from pandas import DataFrame
        except ModuleNotFoundError as error:
            raise InputError("a table needs pandas, which is not installed: pip install 'padforge[formats]'") from error
        return DataFrame(self.errors)


def evaluate(
    model: LocalizerModel,
    recording: Recording,
    levels: Iterable[int] = (0, 1, 2, 3),
    *,
    by_moment: bool = True,
    on_progress: OnProgress = ignore_progress,
) -> Evaluation:
    """Evaluate a localizer for every set of failed fibres of some sizes.

    Of the training recording, only the presses that were held back are used; of any other, all of known position.

    Args:
        model: to evaluate.
        recording: of a pad with the fibres of the training, with about as many readings a second or more.
        levels: numbers of failed fibres.
        by_moment: whether to evaluate presses also while they are read.
        on_progress: called with (steps done, total, what is evaluated).

    Raises:
        InputError: no level, one that leaves no fibre, no press of known position, or a recording that does not suit
            the localizer or was seen in its recalibration.
    """
    check_type("model", model, LocalizerModel)
    levels = tuple(check_type("levels", levels, Iterable))
    if not levels:
        raise InputError(f"levels name no number of failed fibres, expected one or more of 0 to {model.fibres - 1}")
    held_back = held_back_presses(model, check_type("recording", recording, Recording))
    test = np.flatnonzero(recording.has_position) if held_back is None else held_back
    if len(test) == 0:
        raise InputError(
            f"recording has no press of known position to test on among {len(recording.presses_mm)}, "
            "expected at least one"
        )
    presses = model.scaled_features(recording)
    features, positions_mm = presses[test], recording.presses_mm[test]
    measures = {name: values[test] for name, values in recording.measures.items()}
    predict = partial(model.predict_features, features)
    rows, by_subset = errors_by_loss(model.fibres, levels, predict, positions_mm, measures, on_progress)
    prediction = model.predict_features(features)
    within_r90 = float((distances(prediction.positions_mm, positions_mm) <= prediction.r90_mm).mean())
    localization, is_other_pad = model.predict_features(presses), model.is_other_pad(features)
    return Evaluation(
        errors=rows,
        split="none" if held_back is None else model.split,
        test_presses=len(test),
        by_subset=by_subset,
        by_position=errors_by_position(prediction.positions_mm, positions_mm),
        **(errors_by_moment(model, recording, test, levels, on_progress) if by_moment else NO_MOMENTS),
        idle_share=idle_share(recording).tolist(),
        test={
            "press": test.tolist(),
            "pressed_mm": positions_mm.tolist(),
            "predicted_mm": prediction.positions_mm.tolist(),
            "r90_mm": prediction.r90_mm.tolist(),
            **{
                name: {
                    "pressed": [None if math.isnan(value) else value for value in measures[name].tolist()],
                    "predicted": estimate.values.tolist(),
                    "r90": estimate.r90.tolist(),
                }
                for name, estimate in prediction.measures.items()
            },
        },
        provenance={**model.provenance, "recording_kind": recording.source.get("kind")},
        trained_share=model.trained_share,
        radii_presses=model.radii_presses,
        doubts=find_doubts(recording, localization, within_r90, len(test), is_other_pad),
    )


def find_doubts(
    recording: Recording, localization: Localization, within_r90: float, n_presses: int, is_other_pad: bool = False
) -> list[str]:
    """Return reasons to doubt an evaluation, one a line: another pad, and improbable positions.

    The localization is of all presses of the recording, `within_r90` the share of `n_presses` test presses.
    """
    lines = doubts.find_doubts(recording)
    distance = distances(localization.positions_mm, recording.presses_mm)
    is_misplaced = distance > MAX_RADII * localization.r90_mm  # false where the position is unknown
    if is_other_pad:
        lines.append(OTHER_PAD)
    elif within_r90 < MIN_WITHIN_R90 and n_presses >= MIN_PRESSES:
        lines.append(f"{within_r90:.0%} of {n_presses} presses lie within r90: is it the recording of this pad?")
    elif is_misplaced.any():
        named = doubts.name_presses(recording, is_misplaced)
        lines.append(f"stated more than {MAX_RADII:g} r90 from where they are predicted: {named}")
    return lines


def held_back_presses(model: LocalizerModel, recording: Recording) -> Indices | None:
    """Return the test presses of a model in its training recording; None for any other recording."""
    if recording.digest in model.recalibrated_by:
        raise InputError("recording is one that the localizer was recalibrated by, expected one it has not seen")
    if recording.digest != model.training_recording_sha256:
        return None
    return np.array(model.test, dtype=np.int64)


def errors_by_loss(
    fibres: int,
    levels: Iterable[int],
    predict: Callable[[tuple[int, ...]], Localization],
    positions_mm: Array,
    measures: Measures | None = None,
    on_progress: OnProgress = ignore_progress,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return `errors` and `by_subset` of an evaluation, for numbers of failed fibres.

    `predict` predicts the presses without the fibres of the given indices. Positions (Q, 2) and measures, the depth and
    force (Q,), are the true ones, NaN where unknown.
    """
    rows, by_subset = [], []
    by_level = [failure_subsets(fibres, check_int("n_failed", level, 0, fibres - 1)) for level in levels]
    total = sum(map(len, by_level))
    for subsets in by_level:
        predictions: list[Localization] = []
        for prediction in map_threads(predict, subsets):
            on_progress(len(by_subset) + len(predictions), total, "sets of failed fibres")
            predictions.append(prediction)
        rows.append(error_row(len(subsets[0]), predictions, positions_mm, measures))
        by_subset += [
            {"failed": list(subset), "mean_mm": float(distances(each.positions_mm, positions_mm).mean())}
            for subset, each in zip(subsets, predictions, strict=True)
        ]
    return rows, by_subset


def errors_by_moment(
    model: LocalizerModel, recording: Recording, presses: Indices, levels: Iterable[int], on_progress: OnProgress
) -> dict[str, Any]:
    """Return the errors of presses at `MOMENTS`, while they are read, for up to `MOMENT_SETS` sets of failed fibres.

    Returned are "by_moment": rows of `error_row`, with "since" touch or lift, "readings" since then, and "time_s"; and
    "focus": the press of the median error, with "press", "pressed_mm", and "moments" of "since", "time_s",
    "predicted_mm" and "r90_mm". Both are empty for a localizer without moments.
    """
    if model.features != "windows":
        return NO_MOMENTS
    from padforge.sense.signals.press_detection import first_readings  # compiled kernels take long to import

    frames = framed(recording)
    commands = frames.down_command, frames.up_command
    touched = first_readings(frames.readings, frames.times_s, *commands)
    positions_mm = recording.presses_mm[presses]
    measures = {name: values[presses] for name, values in recording.measures.items()}
    history, rows, intact = model.raw_features(recording).history, [], []

    def evaluate_at(moment: Moment) -> tuple[dict[str, Any], Localization, list[dict[str, Any]]]:
        until = moment.until(touched, frames.up_command)
        raw = compute_features(frames.readings, *commands, until, history=history)
        predict = partial(model.predict_features, model.scaler.transform(raw[presses]))
        at = {"since": moment.since, "readings": moment.readings, "time_s": round(moment.readings / frames.rate_hz, 3)}
        by_loss = []
        for n_failed in levels:
            predictions = [predict(failed) for failed in failure_subsets(model.fibres, n_failed, MOMENT_SETS)]
            by_loss.append(at | error_row(n_failed, predictions, positions_mm, measures))
        return at, predict(), by_loss

    for at, prediction, by_loss in map_threads(evaluate_at, MOMENTS):
        on_progress(len(intact), len(MOMENTS), "moments of a press")
        intact.append((at, prediction))
        rows += by_loss
    errors = distances(intact[-1][1].positions_mm, positions_mm)
    press = int(np.argsort(errors)[len(errors) // 2])
    moments = [
        {
            "since": at["since"],
            "time_s": at["time_s"],
            "predicted_mm": predicted.positions_mm[press].tolist(),
            "r90_mm": float(predicted.r90_mm[press]),
        }
        for at, predicted in intact
    ]
    focus = {"press": int(presses[press]), "pressed_mm": positions_mm[press].tolist(), "moments": moments}
    return {"by_moment": rows, "focus": focus}


def error_row(
    n_failed: int, predictions: Sequence[Localization], positions_mm: Array, measures: Measures | None = None
) -> dict[str, Any]:
    """Summarize the errors of presses predicted with each set of failed fibres of a size.

    Mean, standard deviation and maximum are over the mean errors of the sets; median, 95th percentile and shares are
    over all presses. Arguments are as in `errors_by_loss`, with a prediction for each set.
    """
    errors = np.stack([distances(each.positions_mm, positions_mm) for each in predictions])
    means = errors.mean(axis=1)
    row = {
        "n_failed": n_failed,
        "subsets": len(errors),
        "mean_mm": float(means.mean()),
        "std_mm": float(means.std()),
        "max_mm": float(means.max()),
        "median_mm": float(np.median(errors)),
        "p95_mm": float(np.percentile(errors, 95)),
        "within_r50": float((errors <= np.stack([each.r50_mm for each in predictions])).mean()),
        "within_r90": float((errors <= np.stack([each.r90_mm for each in predictions])).mean()),
    }
    for name, (measure_errors, r90) in _measure_errors(predictions, measures).items():
        kind, unit = name.rsplit("_", 1)
        measured = np.isfinite(measure_errors[0])
        if measured.any():
            row |= {
                f"{kind}_mean_{unit}": float(measure_errors[:, measured].mean()),
                f"{kind}_p95_{unit}": float(np.percentile(measure_errors[:, measured], 95)),
                f"{kind}_within_r90": float((measure_errors <= r90)[:, measured].mean()),
            }
    return row


def _measure_errors(predictions: Sequence[Localization], measures: Measures | None) -> dict[str, tuple[Array, Array]]:
    """Return the errors (sets, Q) of each predicted measure, NaN where the true value is unknown, and their r90."""
    errors = {}
    for name in predictions[0].measures:
        estimates = [each.measures[name] for each in predictions]
        values, r90 = np.stack([each.values for each in estimates]), np.stack([each.r90 for each in estimates])
        errors[name] = np.abs(values - (measures or {}).get(name, np.nan)), r90
    return errors


def distances(predicted_mm: Array, pressed_mm: Array) -> Array:
    """Return the distances (Q,) of predicted from pressed positions (Q, 2)."""
    return np.hypot(*(predicted_mm - pressed_mm).T)


def conformal(
    predictions: Sequence[Localization],
    positions_mm: Array,
    measures: Measures | None = None,
    prior_ratio: float | None = None,
) -> Array:
    """Return the factors on standard deviations, radii and r90 of measures with which these hold on presses.

    Radii are split conformal (Lei et al. 2018, Distribution-free predictive inference for regression): quantiles of
    distance over radius on presses that were not used before, one rank higher than the share, which is more cautious
    after few presses. With a `prior_ratio`, the mean ratio of distance to radius on other pads, a gamma distribution
    about it counts as PRIOR_PRESSES further presses, since quantiles of few presses vary much. The other arguments are
    as in `error_row`.

    Returns:
        Factors (3 + T,) on the standard deviation, the radii of 50 and 90 %, and the r90 of T measures (1 if no true
        value is known).
    """
    squares = np.square([(each.positions_mm - positions_mm) / each.std_mm for each in predictions])
    variance, presses, prior = squares.mean(), len(positions_mm), _NO_PRIOR
    if prior_ratio is not None:
        prior = prior_ratio / RATIO_SHAPE * gammaincinv(RATIO_SHAPE, (np.arange(N_PRIOR) + 0.5) / N_PRIOR)
        variance = (presses * variance + PRIOR_PRESSES * (prior**2).mean()) / (presses + PRIOR_PRESSES)
    errors = np.array([distances(each.positions_mm, positions_mm) for each in predictions])
    factors = [
        float(np.sqrt(variance)),
        _conformal_quantile(0.5, errors / [each.r50_mm for each in predictions], prior),
        _conformal_quantile(0.9, errors / [each.r90_mm for each in predictions], prior),
    ]
    for measure_errors, r90 in _measure_errors(predictions, measures).values():
        ratios = measure_errors / r90
        ratios = ratios[:, np.isfinite(ratios).all(axis=0)]
        factors.append(_conformal_quantile(0.9, ratios) if ratios.shape[1] else 1.0)
    return np.array(factors)


def _conformal_quantile(share: float, ratios: Array, prior: Array = _NO_PRIOR) -> float:
    """Compute the split-conformal quantile of (sets, Q) ratios: the smallest ratio that the share does not exceed.

    The sets of failed fibres of one press are not independent; the effective sample size is that of a binomial
    distribution with the observed variance between presses. Values of the prior weigh PRIOR_PRESSES in total; without
    them one ratio more, above all others, is counted. The greatest ratio is returned where no other is large enough.
    """
    within = (ratios <= np.quantile(ratios, share)).mean(axis=0)
    presses, variance = len(within), float(within.var())
    effective = min(max(presses, share * (1 - share) * presses / variance), ratios.size) if variance else ratios.size
    values = np.concatenate([ratios.ravel(), prior])
    weights = np.repeat([effective / ratios.size, PRIOR_PRESSES / max(len(prior), 1)], [ratios.size, len(prior)])
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    extra = 0 if len(prior) else 1  # the finite-sample correction of split conformal intervals
    rank = np.searchsorted(below, share * (below[-1] + extra) - 1e-9)
    return float(values[order[min(rank, len(order) - 1)]])


def errors_by_position(predicted_mm: Array, pressed_mm: Array) -> list[dict[str, Any]]:
    """Return number of presses, mean and maximum error in each pressed cell, with its centre "x_mm", "y_mm"."""
    low, high = pressed_mm.min(axis=0), pressed_mm.max(axis=0)
    side = np.where(high > low, (high - low) / CELLS, 1.0)
    cells = np.minimum(((pressed_mm - low) / side).astype(int), CELLS - 1)
    errors = distances(predicted_mm, pressed_mm)
    rows = []
    for cell in np.unique(cells, axis=0):
        inside = (cells == cell).all(axis=1)
        x, y = (low + (cell + 0.5) * side).tolist()
        mean, worst = float(errors[inside].mean()), float(errors[inside].max())
        rows.append({"x_mm": x, "y_mm": y, "presses": int(inside.sum()), "mean_mm": mean, "max_mm": worst})
    return rows


def idle_share(recording: Recording) -> Array:
    """Return the (C,) share of presses in which a fibre changes by less than `ACTIVE` of its range over all presses."""
    frames = framed(recording)
    readings, commands = interpolate_gaps(frames.readings), (frames.down_command, frames.up_command)
    changes = window_means(readings, *commands, frames.up_command)[:, :, len(PRESS_WINDOWS) - 1]
    return (np.abs(changes) <= ACTIVE * np.ptp(changes, axis=0)).mean(axis=0)


def calibration_lines(document: Mapping[str, Any]) -> list[str]:
    """Format a calibration document: errors of positions, those of depth and force if predicted, and doubts."""
    rows = document["errors"]

    def table(title: str, header: str, errors: Sequence[str], shares: Sequence[str]) -> list[str]:
        formats = [("n_failed", "6d"), ("subsets", "5d"), *((name, "6.2f") for name in errors)]
        formats += [(name, "7.1%") for name in shares]
        return [title, header, *(" ".join(f"{row[name]:{spec}}" for name, spec in formats) for row in rows)]

    is_simulated = document["provenance"].get("recording_kind") == "simulated"
    pad = " of a simulated pad" if is_simulated else ""
    lines = table(
        f"error in mm on {document['test_presses']} presses{pad} (split: {document['split']})",
        "failed  sets   mean    std    max median    p95  in r50  in r90",
        ("mean_mm", "std_mm", "max_mm", "median_mm", "p95_mm"),
        ("within_r50", "within_r90"),
    )
    for kind, unit in (("depth", "mm"), ("force", "N")):
        names = (f"{kind}_mean_{unit.lower()}", f"{kind}_p95_{unit.lower()}")
        if names[0] in rows[0]:
            header = "failed  sets   mean    p95  in r90"
            lines += table(f"error of {kind} in {unit}", header, names, [f"{kind}_within_r90"])
    return [*lines, *([SIMULATED_NOTE] if is_simulated else []), *reserve_lines(document)]


def reserve_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the reservations about a calibration, a line each: short training, radii of few presses, and doubts."""
    share, presses, lines = document.get("trained_share", 1.0), document.get("radii_presses", 0), []
    if share < CONVERGED_SHARE:
        lines.append(f"not converged: {share:.0%} of the usual steps; errors fall with more time")
    if presses and (slack := 2 * math.sqrt(0.9 * 0.1 / presses)) > MAX_UNCERTAINTY:
        shares = f"{0.9 - slack:.0%} to {min(0.9 + slack, 1):.0%}"
        lines.append(f"radii rest on few presses: {shares} of further presses may lie in r90")
    return [*lines, *(f"doubtful: {doubt}" for doubt in document.get("doubts", ()))]


def moment_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format the errors by moment as a table, with a column for each number of failed fibres."""
    if not rows:
        return []
    levels = sorted({row["n_failed"] for row in rows})
    heads = "".join(f"  {n_failed} failed  in r90" for n_failed in levels)
    title = "mean error in mm while a press is read, by time since the touch and since the lift"
    lines = [title, f"since   time s{heads}"]
    for first in range(0, len(rows), len(levels)):
        row = rows[first]
        at_moment = rows[first : first + len(levels)]
        cells = "".join(f" {each['mean_mm']:9.2f} {each['within_r90']:7.1%}" for each in at_moment)
        lines.append(f"{row['since']:<7} {row['time_s']:6.2f}{cells}")
    return lines
