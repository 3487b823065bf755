"""The figure of a learning curve: error against the number of presses learnt from.

How much more recording is worth: error against the number of presses that were learnt from.
Localizers learn from nested shares of the training presses and are tested on the same presses. A power law with a
floor, e(n) = c + a n^-b, is what such curves follow (Hestness et al. 2017, Deep learning scaling is predictable,
empirically); it leads on to what more presses would bring.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from padforge.design.common.files import provenance
from padforge.design.common.parallel import one_torch_thread, run_tasks
from padforge.design.common.plotting import ALARM, FAINT, INK, add_caption, new_figure, save_figure
from padforge.design.common.settings import or_default
from padforge.design.common.validation import InputError, check_type
from padforge.sense import settings
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer.calibration import fit_recording, split_presses
from padforge.sense.localizer.evaluation import distances
from padforge.sense.recording.recording import Recording


def draw_learning_curve(document: Mapping[str, Any], path: Path) -> None:
    """Draw the error against the number of presses learnt from, the fit, and what twice as many would bring."""
    figure, axes = new_figure(6.4, 4.4)
    presses = np.array([point["presses"] for point in document["points"]], dtype=float)
    means = [point["mean_mm"] for point in document["points"]]
    ahead, fit = document["forecast"], document["fit"]
    along = np.geomspace(presses[0], ahead["presses"], 200)
    axes.plot(along, power_law(along, (fit["floor_mm"], fit["factor_mm"], fit["exponent"])), color=FAINT, linewidth=1.6)
    errors = [2 * point["standard_error_mm"] for point in document["points"]]
    axes.errorbar(presses, means, errors, fmt="o", color=INK, markersize=5, linewidth=1.2, label="measured")
    reach = [[ahead["mean_mm"] - ahead["low_mm"]], [ahead["high_mm"] - ahead["mean_mm"]]]
    expected = {"fmt": "D", "color": ALARM, "markersize": 6, "linewidth": 1.2, "label": "expected"}
    axes.errorbar([ahead["presses"]], [ahead["mean_mm"]], reach, **expected)
    axes.set_xscale("log")
    ticks = [*presses.astype(int).tolist(), ahead["presses"]]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set(ylim=(0, None), xlabel="presses learnt from", ylabel="mean error (mm)")
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.legend(frameon=False)
    axes.set_title(
        f"Error by number of presses, on the same {document['test_presses']}\n", loc="left", color=INK, fontsize=11
    )
    add_caption(axes, "bars: two standard errors; expected: 80 % of resamplings")
    save_figure(figure, path)


FORMAT = "padforge-learning-curve/2"
SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Shares of the training presses."""
LEAST_PRESSES = 10
"""Presses of the smallest localizer."""
EXPONENTS = np.linspace(0.1, 1.5, 57)
"""Exponents b that are tried."""
DRAWS = 400
"""Resamplings that the uncertainty is found by."""


def learning_curve(
    recording: Recording,
    options: settings.LocalizerSettings | None = None,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Learn from more and more presses, and say what still more would bring.

    Args:
        recording: with presses of known place.
        options: how to learn; of the members one is trained, so errors are somewhat above those of a calibration. The
            defaults if None.
        progress: called with (steps done, steps in all).

    Returns:
        A document with "points" ("presses", "mean_mm", "standard_error_mm" on the test presses), "fit" ("floor_mm",
        "factor_mm", "exponent"), "forecast" ("presses", "mean_mm", "low_mm", "high_mm": 80 % of resamplings of test
        presses and scatter about the curve lie between), "advice" in words, and "settings".

    Raises:
        InputError: too few presses for a curve.
    """
    check_type("recording", recording, Recording)
    options = or_default("options", options, settings.LocalizerSettings)
    rng = np.random.default_rng(options.seed)
    known = np.flatnonzero(recording.has_position)
    training, test = (known[part] for part in split_presses(len(known), options.split, options.test_share, rng))
    if len(training) * SHARES[0] < LEAST_PRESSES:
        raise InputError(
            f"recording has {len(training)} presses to learn from, "
            f"expected at least {round(LEAST_PRESSES / SHARES[0])} for a curve"
        )
    order = rng.permutation(training)
    sizes = [round(share * len(order)) for share in SHARES]
    options = options.model_copy(update={"members": 1, "method": "ensemble"})
    found = _found(recording, [np.sort(order[:size]) for size in sizes], test, options, progress)
    errors = [distances(positions_mm, recording.presses_mm[test]) for positions_mm in found]
    table, counts = np.array(errors), np.array(sizes, dtype=float)
    fit = fit_power_law(counts, table.mean(axis=1))
    forecast = _forecast(counts, table, fit, rng)
    made_by = provenance("padforge sense learning-curve", options.seed, packages=("torch",))
    made_by["inputs"] = {"recording": recording.digest}
    return {
        "format": FORMAT,
        "test_presses": len(test),
        "points": [
            {"presses": size, "mean_mm": row.mean(), "standard_error_mm": row.std(ddof=1) / np.sqrt(len(row))}
            for size, row in zip(sizes, table, strict=True)
        ],
        "fit": dict(zip(("floor_mm", "factor_mm", "exponent"), fit, strict=True)),
        "forecast": forecast,
        "advice": f"{forecast['presses'] - sizes[-1]} more presses to learn from, twice as many, would bring "
        f"{table[-1].mean():.2f} mm to about {forecast['mean_mm']:.2f} mm "
        f"({forecast['low_mm']:.2f} to {forecast['high_mm']:.2f} mm)",
        "settings": options.model_dump(),
        "provenance": made_by,
    }


def _found(
    recording: Recording,
    trainings: Sequence[Indices],
    test: Indices,
    options: settings.LocalizerSettings,
    progress: Callable[[int, int], None],
) -> list[Array]:
    """Places (Q, 2) that localizers trained on each of `trainings` find for the test presses."""
    from padforge.sense.localizer.training import JointProgress, training_steps

    # As many as a calibration takes for so many presses: of one short training for all, the most presses would seem to
    # bring little.
    steps = [training_steps(len(training), options) for training in trainings]
    joint = JointProgress(steps, progress)

    def train(number: int) -> Array:
        def report(step: int, total: int) -> None:
            joint.update(number, round(step / total * steps[number]))

        training = trainings[number]
        localizer = fit_recording(
            recording, training, options, np.random.default_rng([options.seed, len(training)]), report
        )
        return localizer.predict_features(localizer.scaled_features(recording)[test]).positions_mm

    longest_first = reversed(range(len(steps)))
    with one_torch_thread(), joint:
        found = dict(run_tasks((number, partial(train, number)) for number in longest_first))
    return [found[number] for number in range(len(steps))]


def fit_power_law(presses: Array, errors: Array) -> tuple[float, float, float]:
    """Floor c >= 0, factor a >= 0 and exponent b of errors c + a n^-b, by least squares of relative errors.

    Args:
        presses: (P,) n > 0. errors: (P,) > 0.
    """
    from scipy.optimize import nnls

    def solved(exponent: float) -> tuple[Array, float]:
        shape = np.column_stack([np.ones_like(presses), (presses / presses[-1]) ** -exponent])
        return nnls(shape / errors[:, None], np.ones_like(errors))

    exponent = min(EXPONENTS.tolist(), key=lambda b: solved(b)[1])
    (floor, at_last), _ = solved(exponent)
    return float(floor), float(at_last * presses[-1] ** exponent), float(exponent)


def power_law(presses: Array, fit: tuple[float, float, float]) -> Array:
    """Errors that a fit gives for numbers of presses."""
    floor, factor, exponent = fit
    return floor + factor * presses**-exponent


def _forecast(
    presses: Array, table: Array, fit: tuple[float, float, float], rng: np.random.Generator
) -> dict[str, Any]:
    """What twice as many presses would bring, from errors (P, Q) of the test presses."""
    off = np.log(table.mean(axis=1) / power_law(presses, fit))
    scatter = np.sqrt((off**2).sum() / max(1, len(off) - 3))
    aim = 2 * presses[-1:]
    steps = []
    for _ in range(DRAWS):
        drawn = table[:, rng.integers(table.shape[1], size=table.shape[1])].mean(axis=1)
        again = fit_power_law(presses, drawn * np.exp(scatter * rng.standard_normal(len(drawn))))
        steps.append((power_law(aim, again) / power_law(presses[-1:], again))[0])
    now = table[-1].mean()
    ratio = (power_law(aim, fit) / power_law(presses[-1:], fit))[0]
    low, high = np.quantile(steps, [0.1, 0.9])
    return {
        "presses": int(aim[0]),
        "mean_mm": float(now * ratio),
        "low_mm": float(now * min(low, ratio)),
        "high_mm": float(now * max(high, ratio)),
    }


def learning_curve_lines(document: dict[str, Any]) -> list[str]:
    """A learning curve for people."""
    fit = document["fit"]
    return [
        f"error in mm on {document['test_presses']} presses never learnt from",
        "presses   mean  standard error",
        *(f"{row['presses']:7d} {row['mean_mm']:6.2f}  {row['standard_error_mm']:14.2f}" for row in document["points"]),
        f"fit: {fit['floor_mm']:.2f} mm + {fit['factor_mm']:.3g} mm / presses^{fit['exponent']:.2f}",
        document["advice"],
    ]
