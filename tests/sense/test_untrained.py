"""What is learnt beside the training of networks, kept as a whole: networks stay as they are drawn."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import pytest

from padforge.sense import Recording, calibrate, recalibrate
from padforge.sense.health import health_model, trace_model
from padforge.sense.health.health_model import fit_health_model
from padforge.sense.localizer import calibration, evaluation, recalibration, single_press, training
from padforge.sense.localizer.evaluation import conformal
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.localizer.optimizer import Parameters
from padforge.sense.settings import LocalizerSettings
from padforge.sense.twin.identification import Identification
from tests.helpers.golden import Golden, json_text
from tests.sense.conftest import first_presses

OPTIONS = LocalizerSettings(max_failures=1, test_share=0.2)


@pytest.fixture(autouse=True)
def untrained(monkeypatch: pytest.MonkeyPatch) -> None:
    def stay(parameters: Parameters, *_: Any, **__: Any) -> dict[str, np.ndarray]:
        """Weights that are trained differ from processor to processor; what is computed beside them hardly does."""
        return parameters.by_name(parameters.flat.copy())

    monkeypatch.setattr(training, "fit_network", stay)
    monkeypatch.setattr(trace_model, "fit_network", stay)


def numbers(value: Any) -> Any:
    """JSON of all digits; of an array of more than 36 numbers its root mean square and its largest magnitude."""
    if isinstance(value, Mapping):
        return {name: numbers(part) for name, part in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return numbers(vars(value))
    if isinstance(value, np.ndarray) and value.size > 36:
        rms, largest = np.sqrt(np.square(value, dtype=float).mean()), np.abs(value).max()
        return f"{' x '.join(map(str, value.shape))}: {rms:.12g} to {largest:.12g}"
    if isinstance(value, np.ndarray | Sequence) and not isinstance(value, str):
        return [numbers(part) for part in value]
    return float(value) if isinstance(value, np.floating) else value


@patch.multiple(calibration, SCALE_SUBSETS=2, MOMENT_SUBSETS=1)
@patch.object(evaluation, "MOMENT_SETS", 1)
def test_what_a_calibration_computes(recording: Recording, golden: Golden) -> None:
    """By its presses alone, and by the experience with other pads, which counts after a training of all steps."""
    known, kept = first_presses(recording, 90), {}
    for name, share, most in (("alone", np.inf, 2.5), ("with experience", 0.0, np.inf)):
        with patch.multiple(calibration, CONVERGED_SHARE=share, CONTRADICTION=most):
            model, found = calibrate(known, OPTIONS, by_moment=name == "alone")
        kept |= {"by moment": found.by_moment[::2], "focus": found.focus} if found.by_moment else {}
        of_scales = {each: weights["last.b"] for each, weights in model.networks.items()}
        kept[name] = {"factors": model.interval_factors[[1, 5, 9, 12, -1]], "scales": of_scales, "errors": found.errors}
    kept |= {"table": model.table, "scaler": model.scaler, "single press": model.single_press, "bayes": model.bayes}
    golden("sense/untrained/calibration.json", json_text(numbers(kept)), rtol=2e-3)


@patch.multiple(recalibration, SUBSETS=2, FOLDS=3)
@patch.object(single_press, "SUBSETS", 1)
def test_what_a_recalibration_computes(
    bayesian_localizer: LocalizerModel, recording: Recording, golden: Golden
) -> None:
    """Of presses on the pad as it was, and as it is with other gains, in radii that are too small."""
    few, kept, small = first_presses(recording, 30), {}, bayesian_localizer.interval_factors[:, :2] / 2
    old = replace(bayesian_localizer, interval_factors=small, recalibrated_by=("of before",))
    refit, other = recalibration.refit, np.array([0.8, 1.2, 1.1, 0.9])
    none = Mock(side_effect=lambda old, *_, **__: (old, other < 0))
    for name, gains, fitting in (("as it was", 1.0, refit), ("other gains", other, refit), ("no fit", other**2, none)):
        with patch.object(recalibration, "refit", fitting):
            now, result = recalibrate(old, replace(few, readings=few.readings * gains))
        document = result.to_dict() | {"provenance": {}, "recalibrated by": now.recalibrated_by}
        kept[name] = document | {"single press": now.single_press, "factors": now.interval_factors[-1]}
    golden("sense/untrained/recalibration.json", json_text(numbers(kept)), rtol=1e-2)


def test_what_health_computes(recording: Recording, golden: Golden) -> None:
    """Of few presses, each fold of which is one block, and of as many, which are dealt out in shorter ones."""
    commands, kept = (recording.rate_hz, recording.down_command, recording.up_command), {}
    for name, least in (("few", 10**4), ("enough", 100)):
        with patch.multiple(health_model, MIN_GAIN_PRESSES=least, MIN_PRESSES=100, BLOCK=20):
            model = fit_health_model(recording.readings, *commands, rng=np.random.default_rng(0), provenance={})
        kept[name] = {"likelihoods": model.likelihoods, "exceedance": model.exceedance}
    kept |= {"pca": model.pca, "rests": model.rest_range_v}
    golden("sense/untrained/health.json", json_text(numbers(kept)), rtol=2e-3)


def test_what_an_identification_computes(identification: Identification, golden: Golden) -> None:
    """Of a pad that lies as planned, which was fitted by steps that end where another processor's hardly differ."""
    names = ("explained", "explained_smooth", "explained_on_plan", "noise_v", "noise", "scatter", "training")
    kept = {name: getattr(identification, name) for name in names} | {"stds": identification.fit.offset_std(1)}
    values = {"paths": identification.twin.as_built_mm, "contact": identification.twin.contact().sensitivity_profile}
    golden("sense/untrained/identification.json", json_text(numbers(kept | values)), rtol=2e-2)


def test_what_radii_are_of_known_errors(golden: Golden) -> None:
    """Of presses that are hard to find with every set of failed fibres, and with and without a prior."""
    rng, rows = np.random.default_rng(0), {}
    for presses in (9, 40):
        hard, ones = rng.exponential(size=presses), np.ones(presses)
        errors = [np.column_stack([hard * rng.exponential(size=presses), 0 * hard]) for _ in range(3)]
        found = [Localization(each, np.ones((presses, 2)), ones, 2 * ones) for each in errors]
        rows |= {
            f"{presses}, prior {prior}": conformal(found, np.zeros((presses, 2)), None, prior) for prior in (None, 0.8)
        }
    golden("sense/untrained/radii.json", json_text(numbers(rows)))
