"""The trained localizer: its parts, its predictions with any fibres failed, and its files. It does not need torch.

A localizer trained on presses of several depths also predicts depth, and force if that was known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field, JsonValue, TypeAdapter

from padforge.common.files import reraise_write_error, write_text
from padforge.common.validation import InputError, join_names, short_repr
from padforge.sense.arrays import MAX_RATE_HZ, MIN_RATE_HZ, Array, Floats, Indices, Mask
from padforge.sense.localizer.bayes import BayesianLocalizer
from padforge.sense.localizer.features import FeatureSet, PressFeatures, compute_features
from padforge.sense.localizer.model_files import DOCUMENT_CONFIG, check_same_pad, files_of, select_arrays
from padforge.sense.localizer.moments import (
    BAYES_STAGES,
    N_PRESS_WINDOWS,
    N_TIMED,
    PHASES,
    POSSIBLE_SLIDE_THRESHOLD,
    RESIDUAL,
    SLIDE_NETWORK,
    complete_at,
)
from padforge.sense.localizer.network import Networks, Sliding, Weights, predict
from padforge.sense.localizer.scaler import FeatureScaler, ScaledFeatures, array_field
from padforge.sense.localizer.single_press import SinglePressTest, find_misfits, find_unlike, is_other_pad, stages
from padforge.sense.recording.frames import framed
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import Method, Split

FORMAT = "padforge-localizer/2"
NAME = "localizer"  # of its files, `localizer.json` and `localizer.safetensors`
TABLE, BAYES, SINGLE_PRESS = "table", "bayes", "single_press"
"""Names, among the arrays, of the response table, the Bayesian localizers and the tests for single presses."""
UNIFORM = (3**-0.5, (2 / np.pi) ** 0.5, 1.1150)
"""Standard deviation and radii of 50 and 90 % of a uniform distribution over a square of half-width 1."""
MEASURE_COLUMNS = {"depth_mm": ("depth_mm", "depth_r90_mm"), "force_n": ("force_n", "force_r90_n")}
"""Names of depth and force, and of their r90, in tables and messages."""
COLUMNS = ("press", "x_mm", "y_mm", "std_x_mm", "std_y_mm", "r50_mm", "r90_mm", "unlike")
"""Columns of `write_localization`; those of `MEASURE_COLUMNS` follow where depth and force are predicted."""
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
_CHUNK = 2**16  # presses times fibres that are predicted at once


@dataclass(frozen=True)
class MeasureEstimate:
    """Depth, mm, or force, N, of Q presses, and the half-width that holds it in 90 % of cases."""

    values: Array
    r90: Array


@dataclass(frozen=True)
class Localization:
    """Predicted positions of Q presses and their uncertainty.

    Attributes:
        positions_mm: (Q, 2).
        std_mm: (Q, 2) standard deviations in x and y.
        r50_mm: (Q,) radius that holds the true position in 50 % of cases.
        r90_mm: (Q,) radius that holds it in 90 % of cases.
        measures: depth and force by the names of `Recording.measures`, where they are predicted.
        unlike: (Q,) whether two presses, for example by two fingers, explain the responses much better than one; the
            radii of such a press are those of an unknown position. None if not tested.
    """

    positions_mm: Array
    std_mm: Array
    r50_mm: Array
    r90_mm: Array
    measures: Mapping[str, MeasureEstimate] = field(default_factory=dict)
    unlike: Mask | None = None


def write_localization(localization: Localization, path: str | Path) -> None:
    """Write predictions as CSV of `COLUMNS` and `MEASURE_COLUMNS`, one line a press, atomically."""
    estimates = [column for measure in localization.measures.values() for column in (measure.values, measure.r90)]
    columns = [localization.positions_mm, localization.std_mm, localization.r50_mm, localization.r90_mm, *estimates]
    rows = np.column_stack(columns)
    unlike = np.zeros(len(rows), bool) if localization.unlike is None else localization.unlike
    lines = [",".join([*COLUMNS, *(name for measure in localization.measures for name in MEASURE_COLUMNS[measure])])]
    for press, (row, is_unlike) in enumerate(zip(rows.tolist(), unlike.tolist(), strict=True)):
        position, measures = ([f"{value:.4f}" for value in part] for part in (row[:6], row[6:]))
        lines.append(",".join([str(press), *position, str(int(is_unlike)), *measures]))
    with reraise_write_error(Path(path)):
        write_text(Path(path), "\n".join(lines) + "\n")


def concatenate(parts: Sequence[Localization]) -> Localization:
    """Concatenate one or more predictions of the same measures, without `unlike`."""
    columns = [(part.positions_mm, part.std_mm, part.r50_mm, part.r90_mm) for part in parts]
    measures = {}
    for name in parts[0].measures:
        estimates = [(part.measures[name].values, part.measures[name].r90) for part in parts]
        measures[name] = MeasureEstimate(*map(np.concatenate, zip(*estimates, strict=True)))
    return Localization(*map(np.concatenate, zip(*columns, strict=True)), measures)


@dataclass(frozen=True, kw_only=True)
class LocalizerDocument:
    """Content of `localizer.json`, by these names."""

    __pydantic_config__: ClassVar[ConfigDict] = DOCUMENT_CONFIG
    method: Method
    features: FeatureSet
    rate_hz: Annotated[float, Field(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)]  # of the training recording
    scaler: FeatureScaler
    # (K + 1, L, 3 + T), by numbers of complete windows and of failed fibres: factors by which predicted standard
    # deviations become calibrated ones, radii of 50 and 90 %, and the r90 of T measures
    interval_factors: Annotated[Array, *array_field(1e-9, 1e6)]
    training_recording_sha256: Digest
    split: Split = "random"  # of training and test presses
    test: tuple[Annotated[int, Field(ge=0)], ...] = ()  # indices of test presses
    recalibrated_by: tuple[Digest, ...] = ()  # recordings of recalibrations
    fibre_names: tuple[str, ...] = ()  # of the training recording, if it was imported
    pad_sha256: Digest | Literal[""] = ""  # `pad_digest` of the training recording
    trained_share: Annotated[float, Field(gt=0, le=1)] = 1.0  # share of its usual steps that the training took
    radii_presses: Annotated[int, Field(ge=0)] = 0  # presses on which the factors were calibrated
    errors: Sequence[Mapping[str, int | float]] = ()  # rows of `evaluation.error_row` on the test presses
    provenance: Mapping[str, JsonValue] = field(default_factory=dict)


_DOCUMENT = TypeAdapter(LocalizerDocument)


@dataclass(frozen=True, kw_only=True)
class LocalizerModel(LocalizerDocument):
    """A trained localizer: its document and its arrays.

    Attributes:
        networks: of the members, see `network.Networks`.
        table: (S, S, C, F + G) scaled response by position, which a recalibration augments presses with.
        bayes: Bayesian localizers, see `bayes.fit_stages`; none where depths vary, or for method "published".
        residual_network: weights of the network that corrects them.
        single_press: tests for single presses, one for each of `single_press.stages`.
    """

    networks: Networks
    table: Floats
    single_press: tuple[SinglePressTest, ...]
    bayes: tuple[BayesianLocalizer, ...] = ()
    residual_network: Weights = field(default_factory=dict)

    @property
    def fibres(self) -> int:
        """Number of fibres, C."""
        return len(self.scaler.mean_v)

    @property
    def max_failures(self) -> int:
        """Maximum number of failed fibres that it was trained for."""
        return self.interval_factors.shape[1] - 1

    @property
    def corrected(self) -> tuple[tuple[BayesianLocalizer, ...], Weights]:
        """The Bayesian localizers and the network that corrects them."""
        return self.bayes, self.residual_network

    @property
    def sliding(self) -> Sliding | None:
        """Tracking of sliding fingers; None if the localizer does not track them."""
        weights = self.networks.get(SLIDE_NETWORK)
        return Sliding(weights, *self.scaler.latest_window_map(N_TIMED)) if weights else None

    def check_recording(self, recording: Recording) -> None:
        """Raise InputError unless a recording has the pad, the fibres, their names and the rate of the training.

        Args:
            recording: to be localized. Names and plans are compared if both have them.
        """
        check_same_pad(self, "the localizer", recording.fibres, recording.rate_hz)
        if self.pad_sha256 and recording.pad_digest not in ("", self.pad_sha256):
            raise InputError(
                f"recording is of a pad with the plan {recording.pad_digest[:12]}, "
                f"the localizer was learnt from {self.pad_sha256[:12]}"
            )
        for fibre, (name, trained) in enumerate(zip(recording.fibre_names, self.fibre_names, strict=False), 1):
            if name != trained and (name in self.fibre_names or trained in recording.fibre_names):
                raise InputError(
                    f"fibre {fibre} is {short_repr(name)}, the localizer learnt it as {short_repr(trained)}; "
                    f"import the fibres in the order {join_names(self.fibre_names)}"
                )

    def raw_features(self, recording: Recording, until: ArrayLike | None = None) -> PressFeatures:
        """Return the features of every press, V.

        Args:
            recording: of a pad with the fibres of the training, with about as many readings a second or more.
            until: (Q,) first frames (see `framed`) that are not used; None for all frames up to the next press.

        Raises:
            InputError: another pad, a localizer fitted to arrays, or `until` is not one frame for each press.
        """
        if self.features == "array":
            raise InputError("the localizer was fitted to arrays of features, expected such arrays, not a recording")
        self.check_recording(recording)
        frames = framed(recording)
        commands = frames.down_command, frames.up_command
        end = None if until is None else np.asarray(until)
        if end is not None and (end.dtype.kind not in "iu" or end.shape != commands[0].shape):
            raise InputError(f"until is {short_repr(until)}, expected a frame for each of {len(commands[0])} presses")
        return compute_features(frames.readings, *commands, end, self.features == "published")

    def scaled_features(self, recording: Recording, until: ArrayLike | None = None) -> ScaledFeatures:
        """Return the scaled features of every press.

        Args:
            recording: as in `raw_features`, which raises.
            until: likewise.
        """
        return self.scaler.transform(self.raw_features(recording, until))

    def predict(
        self,
        recording: Recording,
        failed: ArrayLike = (),
        fibre_mask: Mask | None = None,
        until: ArrayLike | None = None,
    ) -> Localization:
        """Predict the position of every press of a recording.

        Args:
            recording: of a pad with the fibres of the training, with about as many readings a second or more.
            failed: indices of fibres to mask in every press.
            fibre_mask: (Q, C), false where a fibre is masked in a press; see `health.fault_detector.mask_faults`.
            until: as in `raw_features`.

        Raises:
            InputError: as `raw_features` and `predict_features`.
        """
        features = self.scaled_features(recording, until)
        if fibre_mask is not None:
            mask = np.asarray(fibre_mask)
            if mask.dtype != bool or mask.shape != features.fibre_mask.shape:
                raise InputError(
                    f"fibre_mask is {mask.dtype} of shape {mask.shape}, expected bool {features.fibre_mask.shape}"
                )
            features = replace(features, fibre_mask=features.fibre_mask & mask)
        return self.localize(features, failed)

    def is_other_pad(self, presses: ScaledFeatures) -> bool:
        """Return whether presses are of another pad than that of the calibration, or of one cast again by its plan.

        The result is false for fewer than 25 presses, and for a pad that drifts or has two failed fibres.

        Args:
            presses: scaled features.
        """
        return is_other_pad(self.single_press, find_misfits(self.single_press, presses))

    def calibrate_tests(self, recording: Recording, presses: Indices) -> tuple[SinglePressTest, ...]:
        """Return `single_press`, calibrated on some presses of a recording that were not used in training.

        Args:
            recording: as in `raw_features`, which raises.
            presses: indices in it.
        """
        frames, tests = framed(recording), []
        for test, n_complete in zip(self.single_press, stages(len(self.interval_factors) - 1), strict=True):
            until = complete_at(n_complete, frames.down_command, frames.up_command) if n_complete else None
            tests.append(test.calibrated(self.scaled_features(recording, until)[presses]))
        return tuple(tests)

    def localize(self, presses: ScaledFeatures, failed: ArrayLike = ()) -> Localization:
        """Predict the positions of Q presses, and test whether each of them is a single press.

        Args:
            presses: scaled features.
            failed: indices of fibres to mask in every press.

        Raises:
            InputError: as `predict_features`.
        """
        localization = self.predict_features(presses, failed)
        presses = presses.without(self._check_failed(failed))
        unlike = find_unlike(self.single_press, presses)
        rows = np.flatnonzero(unlike)
        if self.sliding is not None and len(rows):  # a sliding finger responds like several presses
            unlike[rows] = self.sliding.follow(presses[rows]).distance <= POSSIBLE_SLIDE_THRESHOLD
        std_mm, r50_mm, r90_mm = np.array(UNIFORM) * self.scaler.scale_mm
        return replace(
            localization,
            std_mm=np.where(unlike[:, None], std_mm, localization.std_mm),
            r50_mm=np.where(unlike, r50_mm, localization.r50_mm),
            r90_mm=np.where(unlike, r90_mm, localization.r90_mm),
            measures={
                target.name: replace(estimate, r90=np.where(unlike, target.scale, estimate.r90))
                for target, estimate in zip(self.scaler.measures, localization.measures.values(), strict=True)
            },
            unlike=unlike,
        )

    def predict_features(self, presses: ScaledFeatures, failed: ArrayLike = ()) -> Localization:
        """Predict the positions of Q single presses.

        A press without a valid fibre (of method "published", with an invalid one) or without a complete window has the
        middle of the pressed area, and the radii of an unknown position.

        Args:
            presses: scaled features.
            failed: indices of fibres to mask in every press.

        Raises:
            InputError: `failed` are no indices of fibres, or all of them, or any for method "published".
        """
        presses = presses.without(self._check_failed(failed))
        size = max(1, _CHUNK // self.fibres)
        chunks = (presses[first : first + size] for first in range(0, max(len(presses), 1), size))
        parts = [predict(self.networks, chunk, *self.corrected, self.sliding) for chunk in chunks]
        targets, std, slid = (np.concatenate(part) for part in zip(*parts, strict=True))
        fibre_mask, n_complete = presses.fibre_mask, presses.n_complete
        level = np.minimum((~fibre_mask).sum(axis=1), self.max_failures)
        # the network of the touch locates a finger that slid, even when it rests again
        factors = self.interval_factors[np.where(slid, N_PRESS_WINDOWS - 1, n_complete), level]
        to_std, to_r50, to_r90 = factors[:, :3].T * self.scaler.scale_mm
        radius = np.hypot(*std[:, :2].T)
        is_complete = n_complete > 0 if presses.n_timed else np.ones(len(presses), bool)
        has_fibres = fibre_mask.all(axis=1) if self.method == "published" else fibre_mask.any(axis=1)
        is_unknown = np.logical_not(is_complete & has_fibres)
        unknown_std_mm, unknown_r50_mm, unknown_r90_mm = np.array(UNIFORM) * self.scaler.scale_mm
        measures = {}
        for column, target in enumerate(self.scaler.measures):
            value = target.inverse_transform(np.where(is_unknown, 0.0, targets[:, 2 + column]))
            r90 = np.where(is_unknown, 1.0, factors[:, 3 + column] * std[:, 2 + column])
            measures[target.name] = MeasureEstimate(value, target.scale * r90)
        return Localization(
            self.scaler.positions_mm(np.where(is_unknown[:, None], 0.0, targets[:, :2])),
            np.where(is_unknown[:, None], unknown_std_mm, to_std[:, None] * std[:, :2]),
            np.where(is_unknown, unknown_r50_mm, to_r50 * radius),
            np.where(is_unknown, unknown_r90_mm, to_r90 * radius),
            measures,
        )

    def _check_failed(self, failed: ArrayLike) -> Indices:
        """Return indices of failed fibres, checked."""
        indices = np.asarray(failed).ravel()
        if indices.size and not (indices.dtype.kind in "iu" and ((indices >= 0) & (indices < self.fibres)).all()):
            raise InputError(f"failed is {short_repr(failed)}, expected indices of fibres, 0 to {self.fibres - 1}")
        if indices.size and self.method == "published":
            raise InputError(
                "failed is given: method published knows no fibre loss, expected a model of method ensemble"
            )
        if len(np.unique(indices)) == self.fibres:
            raise InputError(f"all {self.fibres} fibres are failed, expected at least one that works")
        return indices

    def save(self, folder: str | Path) -> None:
        """Write `localizer.json` and `localizer.safetensors` atomically; `load` restores every bit.

        Args:
            folder: destination; its localizer is replaced.

        Raises:
            InputError: the folder cannot be written.
        """
        parts = {**self.networks, RESIDUAL: self.residual_network, TABLE: self.table, SINGLE_PRESS: self.single_press}
        parts[BAYES] = tuple(stage.map_arrays(np.asarray) for stage in self.bayes)
        files_of(folder, NAME).write(FORMAT, _DOCUMENT.dump_python(self, warnings=False), parts)

    @classmethod
    def load(cls, folder: str | Path) -> "LocalizerModel":
        """Read what `save` wrote.

        Args:
            folder: that was passed to `save`.

        Raises:
            InputError: a file is missing or torn, the two do not belong together, or a value is out of range.
        """
        files = files_of(folder, NAME)
        try:
            document, digest = files.read_document(FORMAT, _DOCUMENT)
        except InputError as error:
            if not isinstance(error.__cause__, FileNotFoundError):
                raise
            name = files.document.name
            raise InputError(f"{folder}: no {name}, expected a folder that `padforge sense calibrate` wrote") from error
        scaler = document.scaler
        # without history features (J = 0) the file holds empty lists, which lack the last axis
        coef = scaler.history_coef.reshape(*scaler.history_mean_v.shape, scaler.mean_v.shape[-1])
        document = replace(document, scaler=replace(scaler, history_coef=coef))
        n_timed = len(document.interval_factors) - 1
        arrays = files.read_arrays(digest)
        residual_network = select_arrays(arrays, f"{RESIDUAL}.")
        n_stages = (len(BAYES_STAGES) if n_timed else 1) if residual_network else 0
        bayes = [select_arrays(arrays, f"{BAYES}.{number}.") for number in range(n_stages)]
        tests = [select_arrays(arrays, f"{SINGLE_PRESS}.{number}.") for number in range(len(stages(n_timed)))]
        return cls(
            **vars(document),
            networks={name: select_arrays(arrays, f"{name}.") for name in PHASES[n_timed]},
            table=arrays[TABLE],
            bayes=tuple(BayesianLocalizer(**stage).map_arrays(np.float64) for stage in bayes),
            residual_network=residual_network,
            single_press=tuple(SinglePressTest(**test) for test in tests),
        )


class FittedLocalizer(Protocol):
    """What `padforge.sense.Localizer` is once it is fitted."""

    @property
    def model_(self) -> LocalizerModel: ...


def fitted_model(localizer: FittedLocalizer | LocalizerModel) -> LocalizerModel:
    """Return the model of a localizer; InputError if it is not fitted."""
    model = localizer if isinstance(localizer, LocalizerModel) else getattr(localizer, "model_", None)
    if model is None:
        raise InputError("the localizer is not fitted, expected fit or load before")
    return model
