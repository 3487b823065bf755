"""Model of a healthy pad, whose fibres predict each other: training on a recording, and files."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import ConfigDict, Field, JsonValue, TypeAdapter

from padforge.common.validation import InputError
from padforge.sense.arrays import MAX_FIBRES, MAX_RATE_HZ, MIN_RATE_HZ, MIN_SCALE_V, Array, Indices
from padforge.sense.health.fault_likelihoods import HYPOTHESES, MAX_HEIGHT, ExceedanceModel, FaultLikelihoods
from padforge.sense.health.trace_model import (
    MEMBERS,
    REST,
    TracePCA,
    Weights,
    extract_traces,
    predict_fibres,
    train_networks,
)
from padforge.sense.localizer.model_files import DOCUMENT_CONFIG, files_of, select_arrays

FORMAT = "padforge-health/1"
COMMANDED, DETECTED = "health/commanded", "health/detected"
"""Names of the files of a model: trained on presses as commanded, and as detected in the readings."""
FALSE_ALARM_RATE = 1e-5  # default false alarms per press, of all fibres and kinds of fault together
MAX_FALSE_ALARM_RATE = 0.1
MAX_FAILED = 2  # maximum number of failed fibres in the fit of `ExceedanceModel`
MIN_PRESSES = 300  # minimum presses of a training
MIN_GAIN_PRESSES = 850
"""Minimum presses for reports of a reduced gain: with 680, every other simulated pad gave a false alarm, with 850 none
of 12."""
WARM_UP = 10  # presses after which the running mean of a baseline is reliable
BLOCK = 50  # successive presses of a fold; neighbouring presses share their drift
SUBSETS = 4  # random sets of failed fibres of a size in the fit of `ExceedanceModel`


@dataclass(frozen=True, kw_only=True)
class HealthDocument:
    """Content of the JSON file of a model, by these names."""

    __pydantic_config__: ClassVar[ConfigDict] = DOCUMENT_CONFIG
    fibres: Annotated[int, Field(ge=1, le=MAX_FIBRES)]  # number of fibres, C
    dead: tuple[Annotated[int, Field(ge=0, lt=MAX_FIBRES)], ...]  # indices of fibres that were dead in the recording
    rate_hz: Annotated[float, Field(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)]  # readings per second of the recording
    false_alarm_rate: Annotated[float, Field(gt=0, le=MAX_FALSE_ALARM_RATE)]  # false alarms per press on a healthy pad
    presses: Annotated[int, Field(ge=MIN_PRESSES)]  # number of training presses
    provenance: Mapping[str, JsonValue] = field(default_factory=dict)  # origin of the model


_DOCUMENT = TypeAdapter(HealthDocument)


@dataclass(frozen=True, kw_only=True)
class HealthModel(HealthDocument):
    """Model of a healthy pad. Its arrays are of the L living fibres: those of the C fibres that were not dead."""

    pca: TracePCA  # reduces traces to the inputs and targets of the networks
    weights: Weights  # of the networks that predict each fibre from the others
    likelihoods: FaultLikelihoods  # distribution of healthy presses about the predictions
    exceedance: ExceedanceModel  # of the cumulative sums of healthy presses
    rest_range_v: Array  # lowest and highest baseline; shape (2, L), V

    @property
    def living(self) -> Indices:
        """Indices (L,) of the fibres that were not dead."""
        return np.setdiff1d(np.arange(self.fibres), self.dead)

    @property
    def threshold(self) -> float:
        """Minimum `ExceedanceModel.neg_log_p` of a fault; all hypotheses share the false alarms equally."""
        return float(np.log(len(HYPOTHESES) / self.false_alarm_rate))

    def save(self, folder: str | Path, name: str = COMMANDED) -> None:
        """Write NAME.safetensors and NAME.json; `load` restores every bit.

        Args:
            folder: destination.
            name: of the files.

        Raises:
            InputError: the folder cannot be written.
        """
        document = _DOCUMENT.dump_python(self, warnings=False)
        parts = {key: part for key, part in vars(self).items() if key not in document}
        files_of(folder, name).write(FORMAT, document, parts)

    @classmethod
    def load(cls, folder: str | Path, name: str = COMMANDED) -> "HealthModel":
        """Read what `save` wrote.

        Args:
            folder: that was passed to `save`.
            name: of the files.

        Raises:
            InputError: a file is missing, torn or of another kind, or the two do not belong together.
        """
        files = files_of(folder, name)
        document, digest = files.read_document(FORMAT, _DOCUMENT)
        arrays = files.read_arrays(digest)
        return cls(
            **vars(document),
            pca=TracePCA(**select_arrays(arrays, "pca.")),
            weights=select_arrays(arrays, "weights."),
            likelihoods=FaultLikelihoods(**select_arrays(arrays, "likelihoods.")),
            exceedance=ExceedanceModel(**select_arrays(arrays, "exceedance.")),
            rest_range_v=arrays["rest_range_v"],
        )


def fit_health_model(
    readings: Array,
    rate_hz: float,
    down_command: Indices,
    up_command: Indices,
    *,
    rng: np.random.Generator,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    provenance: Mapping[str, Any],
) -> HealthModel:
    """Train a model on presses of a recording.

    Presses that miss a reading of a living fibre are ignored. A single living fibre suffices for faults that its own
    readings show (stuck, noisy, offset); faults of responses need two or more. A model of fewer than MIN_GAIN_PRESSES
    never reports a reduced gain.
    """
    dead = find_dead_fibres(readings)
    living = np.setdiff1d(np.arange(readings.shape[1]), dead)
    if len(living) == 0:
        raise InputError(f"all {len(dead)} fibres are dead: they read one value, or nothing; one must live")
    traces = extract_traces(readings[:, living], down_command, up_command)
    traces = traces[np.isfinite(traces).all(axis=(1, 2))]
    if len(traces) < MIN_PRESSES:
        raise InputError(f"{len(traces)} complete presses to learn from, expected {MIN_PRESSES} or more")

    pca, inputs, targets = TracePCA.fit_transform(traces)
    # Each member is trained without its fold, since a network is overconfident on its training presses.
    presses = np.arange(len(traces))
    # After few presses a network also fits the drift of baselines near them, so that each fold must be one block.
    is_short = len(presses) < MIN_GAIN_PRESSES
    fold = presses * MEMBERS // len(presses) if is_short else presses // BLOCK % MEMBERS
    is_warm = presses >= WARM_UP
    rows = [np.flatnonzero(is_warm & (fold != member)) for member in range(MEMBERS)]
    weights = train_networks(inputs, targets, rows, rng)

    def predict_held_out(failed: Indices) -> tuple[Array, Array]:
        """Predict mean and deviation of warm presses without the failed fibres, by the member not trained on them."""
        mean, std = np.empty_like(targets), np.empty_like(targets)
        fibre_mask = ~np.isin(np.arange(len(living)), failed)
        for member in range(MEMBERS):
            part = fold == member
            mask = np.tile(fibre_mask, (part.sum(), 1))
            network = {key: array[member : member + 1] for key, array in weights.items()}
            mean[part], std[part] = predict_fibres(network, inputs[part], mask)
        return mean[is_warm], std[is_warm]

    measured = traces[is_warm], targets[is_warm]
    prediction = predict_held_out(np.array([], dtype=np.int64))
    likelihoods = FaultLikelihoods.fit(*measured, *prediction, pca.target_scale_v, rng)
    llrs = []
    for n_failed in range(min(MAX_FAILED, len(living) - 1) + 1):
        subsets = []
        for failed in [rng.permutation(len(living))[:n_failed] for _ in range(SUBSETS if n_failed else 1)]:
            llr = np.stack(likelihoods.log_likelihood_ratios(*measured, *predict_held_out(failed)))
            llr[:, :, failed] = 0.0  # a failed fibre is not tested
            subsets.append(llr)
        continuing, onset = np.concatenate(subsets, axis=1)
        llrs.append((continuing, onset))
    exceedance = ExceedanceModel.fit(llrs)
    if is_short:
        exceedance.level[:, HYPOTHESES.index("reduced_gain")] = MAX_HEIGHT
    rests = traces[:, :, :REST].mean(axis=2)
    return HealthModel(
        pca=pca,
        weights=weights,
        likelihoods=likelihoods,
        exceedance=exceedance,
        rest_range_v=np.stack([rests.min(axis=0), rests.max(axis=0)]),
        fibres=readings.shape[1],
        dead=tuple(dead.tolist()),
        rate_hz=rate_hz,
        presses=len(traces),
        false_alarm_rate=false_alarm_rate,
        provenance=provenance,
    )


def find_dead_fibres(readings: Array) -> Indices:
    """Find fibres that are constant, mostly missing, or, unlike most, mostly at an end of their range."""
    missing = np.isnan(readings).mean(axis=0) > 0.5
    present = np.where(missing, 0.0, readings)
    low, high = np.nanmin(present, axis=0), np.nanmax(present, axis=0)
    at_end = np.maximum((present == low).mean(axis=0), (present == high).mean(axis=0))
    # Without noise every fibre is at the end of its range while at rest.
    saturated = (at_end > 0.5) & (np.median(at_end) <= 0.5)
    return np.flatnonzero(missing | (high - low < MIN_SCALE_V) | saturated)
