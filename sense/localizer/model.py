"""`localizer.json`: what it may hold, so that nothing else gets past its reading.

The localizer: from the readings of a press to its place, with any fibres lost. Needs no torch.
Where it has learnt from presses of several depths, it finds their depth too, and their force where that was known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from reprlib import repr as shortened
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, JsonValue, ValidationError

from padforge.design.common.files import read_json, reraise_write_error, write_text
from padforge.design.common.settings import Settings
from padforge.design.common.validation import InputError, check_type, short_repr
from padforge.sense.arrays import (
    MAX_FIBRES,
    MAX_MM,
    MAX_RATE_HZ,
    MAX_VOLTS,
    MIN_RATE_HZ,
    MIN_SCALE_V,
    Array,
    Floats,
    Mask,
)
from padforge.sense.localizer.bayes import PREFIX as OBSERVER
from padforge.sense.localizer.bayes import TOLD, BayesianLocalizer
from padforge.sense.localizer.features import (
    PASTS,
    PHASES,
    SIZES,
    FeatureScaler,
    PressFeatures,
    ScaledFeatures,
    TargetScaler,
    press_inputs,
)
from padforge.sense.localizer.model_files import files_of, refuse_other_pad
from padforge.sense.localizer.network import Weights, learnt, pooled, refuse_unsound
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import Features, Method, Split

FORMAT = "padforge-localizer/3"
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Volts = Annotated[float, Field(ge=-2 * MAX_VOLTS, le=2 * MAX_VOLTS)]
Spread = Annotated[float, Field(ge=MIN_SCALE_V, le=2 * MAX_VOLTS)]
Share = Annotated[float, Field(ge=0, le=1)]
Memory = Annotated[float, Field(ge=-1e6, le=1e6)]
Factor = Annotated[float, Field(gt=0, le=1e6)]
Distance = Annotated[float, Field(ge=0)]
Side = Annotated[float, Field(ge=0, le=MAX_MM)]
Place = Annotated[float, Field(ge=-MAX_MM, le=MAX_MM)]


class MeasureTable(Settings):
    """An entry of `measures` of `scaling`, see `normalization.Target`."""

    name: Literal["depth_mm", "force_n"]
    middle: float = Field(ge=0, le=MAX_MM)
    span: float = Field(gt=0, le=MAX_MM)


class ScalingTable(Settings):
    """`scaling` of `localizer.json`, see `normalization.FeatureScaler`."""

    mean_v: list[list[Volts]]
    spread_v: list[list[Spread]]
    memory: list[list[list[Memory]]]
    history_mean_v: list[list[Volts]]
    origin_mm: Annotated[list[Place], Field(min_length=2, max_length=2)]
    span_mm: float = Field(gt=0, le=MAX_MM)
    measures: Annotated[list[MeasureTable], Field(max_length=2)] = Field(default_factory=list)
    half_mm: Annotated[list[Side], Field(min_length=2, max_length=2)] | None = None


class ErrorRow(Settings):
    """A row of `errors`, see `evaluation.evaluate`."""

    n_failed: int = Field(ge=0)
    subsets: int = Field(ge=1)
    mean_mm: Distance
    std_mm: Distance
    max_mm: Distance
    median_mm: Distance
    p95_mm: Distance
    within_r50: Share
    within_r90: Share
    depth_mean_mm: Distance | None = None
    depth_p95_mm: Distance | None = None
    depth_within_r90: Share | None = None
    force_mean_n: Distance | None = None
    force_p95_n: Distance | None = None
    force_within_r90: Share | None = None


class LocalizerDocument(Settings):
    """The whole of `localizer.json`, see `localizer.Localizer`."""

    format: Literal["padforge-localizer/3"] = FORMAT
    method: Method
    features: Features
    fibres: int = Field(ge=1, le=MAX_FIBRES)
    rate_hz: float = Field(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)
    scaling: ScalingTable
    interval_factors: Annotated[list[Annotated[list[Factor], Field(min_length=3, max_length=5)]], Field(min_length=1)]
    weights_sha256: Digest
    split: Split
    test_presses: int
    errors: list[ErrorRow]
    training_recording_sha256: Digest
    test: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    recalibrated_by: list[Digest]
    provenance: dict[str, JsonValue]


def read_document(document: Mapping[str, Any], where: str) -> LocalizerDocument:
    """`document` with every value checked, and what must fit together.

    Raises:
        InputError: one line that begins with `where` and names the value.
    """
    try:
        found = LocalizerDocument.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(f"{where}: {key} is {shortened(first['input'])}: {first['msg'].lower()}") from error
    past, table = PASTS[found.features], found.scaling
    windows, gains = SIZES[found.features], len(PHASES[found.features])
    size = windows + gains * any(len(row) > windows for row in table.mean_v)  # a localizer of before knows no gains
    shapes = {
        "mean_v": (_sizes(table.mean_v), (found.fibres, size)),
        "spread_v": (_sizes(table.spread_v), (found.fibres, size)),
        "history_mean_v": (_sizes(table.history_mean_v), (found.fibres, past)),
        "memory": (_sizes([row for fibre in table.memory for row in fibre]), (found.fibres * past, size)),
        "memory of fibres": (_sizes(table.memory), (found.fibres, past)),
    }
    names = [each.name for each in table.measures]
    if names != ["depth_mm", "force_n"][: len(names)] or (names and found.method == "published"):
        raise InputError(
            f"{where}: scaling.measures are {', '.join(names)} of method {found.method}, expected none, depth_mm, or "
            "depth_mm and force_n, and of method masked"
        )
    if _sizes(found.interval_factors) != [3 + len(names)] * len(found.interval_factors):
        raise InputError(
            f"{where}: factors have {shortened(sorted(set(_sizes(found.interval_factors))))} values a row, "
            f"expected {3 + len(names)} for {len(names)} measures"
        )
    for name, (sizes, (rows, values)) in shapes.items():
        if sizes != [values] * rows:
            raise InputError(
                f"{where}: scaling.{name} has {len(sizes)} rows of {shortened(sorted(set(sizes)))} values, "
                f"expected {rows} of {values} for {found.fibres} fibres and features {found.features}"
            )
    if found.method == "published" and found.features != "published":
        raise InputError(f"{where}: method is published, features are {found.features}, expected published")
    if len(set(found.test)) != len(found.test) or found.test_presses != len(found.test):
        raise InputError(
            f"{where}: test has {len(found.test)} presses, {len(set(found.test))} of them different, "
            f"expected {found.test_presses} different ones"
        )
    return found


def _sizes(rows: Sequence[Sequence[Any]]) -> list[int]:
    return [len(row) for row in rows]


NAME = "localizer"
"""Of its files, `localizer.json` and `localizer.safetensors`."""
TABLE = "table"
CORRECTOR = "corrector."
"""Names of the table, and of what corrects the observer, among the weights."""
UNKNOWN = (3**-0.5, (2 / np.pi) ** 0.5, 1.1150)
"""Standard deviation and the radii of 50 and 90 % for a place anywhere in a square of half-width 1."""
_VALUES = 2**16


@dataclass(frozen=True)
class Measured:
    """A measure of Q presses, and how sure it is.

    Attributes:
        values: (Q,). r90: (Q,) half the width around it that holds the press's own in 90 % of cases.
    """

    values: Array
    r90: Array


@dataclass(frozen=True)
class Localization:
    """Places found for Q presses, and how sure they are.

    Attributes:
        positions_mm: (Q, 2). std_mm: (Q, 2) standard deviation in x and in y.
        r50_mm, r90_mm: (Q,) radius around the place that holds the press in 50 % and in 90 % of cases.
        measures: depth and force, by the names of `Recording.measures`, where they were learnt.
    """

    positions_mm: Array
    std_mm: Array
    r50_mm: Array
    r90_mm: Array
    measures: Mapping[str, Measured] = field(default_factory=dict)


COLUMNS = ("press", "x_mm", "y_mm", "std_x_mm", "std_y_mm", "r50_mm", "r90_mm")
"""Columns of `write_localization`; those of `MEASURED` follow where depth and force were learnt."""
MEASURED = {"depth_mm": ("depth_mm", "depth_r90_mm"), "force_n": ("force_n", "force_r90_n")}


def write_localization(localization: Localization, path: str | Path) -> None:
    """Write predictions for Q presses as CSV, one line a press, atomically.

    Args:
        localization: of Q presses.
        path: of the file; columns `COLUMNS`, then of `MEASURED`.

    Raises:
        InputError: `path` cannot be written.
    """
    measured = [column for measure in localization.measures.values() for column in (measure.values, measure.r90)]
    columns = [localization.positions_mm, localization.std_mm, localization.r50_mm, localization.r90_mm, *measured]
    names = (*COLUMNS, *(name for measure in localization.measures for name in MEASURED[measure]))
    rows = np.column_stack(columns).tolist()
    lines = [",".join([str(press), *(f"{value:.4f}" for value in row)]) for press, row in enumerate(rows)]
    with reraise_write_error(Path(path)):
        write_text(Path(path), "\n".join([",".join(names), *lines]) + "\n")


def joined(parts: Sequence[Localization]) -> Localization:
    """What was found in several parts, at least one, by localizers that learnt the same."""

    def whole(of: Sequence[object]) -> dict[str, Array]:
        names = [name for name, value in vars(of[0]).items() if isinstance(value, np.ndarray)]
        return {name: np.concatenate([getattr(part, name) for part in of]) for name in names}

    measures = {name: Measured(**whole([part.measures[name] for part in parts])) for name in parts[0].measures}
    return Localization(**whole(parts), measures=measures)


@dataclass(frozen=True)
class LocalizerModel:
    """A trained localizer.

    Attributes:
        weights: of the network, see `network.Weights`.
        scaler: of its inputs and outputs.
        table: (S, S, C, F + G) scaled inputs by place, see `ResponseModel`; what a recalibration moves presses by.
        method: which network and training, of `settings.Method`.
        features: which inputs it takes, of `features.FEATURES`.
        factors: (K, 3 + T) by number of lost fibres, what makes of the expected error a standard deviation, the radii
            of 50 % and of 90 %, and the `r90` of each of T measures learnt; found on presses never trained on.
        rate_hz: readings per second of the recording it learnt from.
        training_recording_sha256: digest of that recording, `test`: its presses that were held back, by index, and `split`: how.
        recalibrated_by: digests of the recordings that it was recalibrated by, all of whose presses it has seen.
        errors: on those, one row per number of lost fibres.
        provenance: where the localizer came from; free JSON.
        bayes: what finds places by the fitted pad; None of several depths, and of what has not learnt by losing
            fibres. residual_network: weights of the network that corrects it, a member beside the others.
    """

    weights: Weights
    scaler: FeatureScaler
    table: Floats
    method: str
    features: str
    interval_factors: Array
    rate_hz: float
    training_recording_sha256: str
    split: str = "random"
    test: tuple[int, ...] = ()
    recalibrated_by: tuple[str, ...] = ()
    errors: Sequence[Mapping[str, Any]] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    bayes: BayesianLocalizer | None = None
    residual_network: Weights = field(default_factory=dict)

    @property
    def fibres(self) -> int:
        """C, the number of fibres it was trained on, lost ones included."""
        return len(self.scaler.centre)

    def scaled_features(self, recording: Recording) -> ScaledFeatures:
        """The scaled inputs of every press of `recording`; raises what `raw_features` raises."""
        return self.scaler.inputs(self.raw_features(recording))

    def raw_features(self, recording: Recording) -> PressFeatures:
        """The inputs of every press of `recording` in volts.

        Raises:
            InputError: the recording has other fibres or another rate than the one that was learnt from.
        """
        check_type("recording", recording, Recording)
        refuse_other_pad(self, "the localizer", recording.fibres, recording.rate_hz)
        return press_inputs(recording.readings, recording.down_command, recording.up_command, self.features)

    def predict(self, recording: Recording, failed: ArrayLike = (), fibre_mask: Mask | None = None) -> Localization:
        """Predict the position of every press of a recording.

        Args:
            recording: of a pad with the fibres and the rate that were trained on.
            failed: indices of fibres to leave out of every press.
            fibre_mask: (Q, C), false where a fibre is left out of a press; see `health.fault_detector.fibre_mask_of`.

        Returns:
            Positions and their uncertainty, Q presses.

        Raises:
            InputError: as `scaled_features` and `predict_features`.
        """
        features = self.scaled_features(recording)
        if fibre_mask is not None:
            features = replace(features, fibre_mask=features.fibre_mask & fibre_mask)
        return self.predict_features(features, failed)

    def predict_features(self, presses: ScaledFeatures, failed: ArrayLike = ()) -> Localization:
        """Find the places of Q presses without what the fibres `failed`, by index, gave.

        A press of which no fibre is left is put in the middle, with radii that say it may be anywhere.

        Raises:
            InputError: a lost fibre that is not there, or none left, or a published localizer that is to do without.
        """
        check_type("presses", presses, ScaledFeatures)
        fibre_mask: Mask = np.logical_and(presses.fibre_mask, self._fibre_mask(failed))
        if self.method == "published" and np.size(failed):
            raise InputError("fibres are lost: a published localizer knows none, train one of method masked")
        step = max(1, _VALUES // self.fibres)
        chunks = range(0, len(presses), step)
        found = [self._pooled(presses.inputs[i : i + step], fibre_mask[i : i + step]) for i in chunks]
        measured = self.scaler.measures
        nothing = np.empty((0, 2 + len(measured)))
        numbers, spreads = (
            (np.concatenate(parts) for parts in zip(*found, strict=True)) if found else (nothing, nothing)
        )
        places, spread = numbers[:, :2], spreads[:, :2]
        level = np.minimum((~fibre_mask).sum(axis=1), len(self.interval_factors) - 1)
        to_sd, to_r50, to_r90 = self.interval_factors[level, :3].T * self.scaler.span_mm
        radius = np.hypot(*spread.T)
        sd, r50, r90 = to_sd[:, None] * spread, to_r50 * radius, to_r90 * radius
        blind = np.logical_not(fibre_mask.all(axis=1) if self.method == "published" else fibre_mask.any(axis=1))
        anywhere = np.array(UNKNOWN) * self.scaler.span_mm
        places, sd = np.where(blind[:, None], 0.0, places), np.where(blind[:, None], anywhere[0], sd)
        r50, r90 = np.where(blind, anywhere[1], r50), np.where(blind, anywhere[2], r90)
        measures = {}
        for column, target in enumerate(measured):
            half = self.interval_factors[level, 3 + column] * spreads[:, 2 + column]
            value = np.where(blind, 0.0, numbers[:, 2 + column])
            measures[target.name] = Measured(target.values(value), target.span * np.where(blind, 1.0, half))
        return Localization(self.scaler.positions_mm(places), sd, r50, r90, measures)

    def _pooled(self, inputs: Floats, fibre_mask: Mask) -> tuple[Floats, Floats]:
        return pooled(learnt(self.weights, inputs, fibre_mask, self.method, self.bayes, self.residual_network))

    def _fibre_mask(self, failed: ArrayLike) -> Mask:
        fibre_mask = np.ones(self.fibres, dtype=bool)
        try:
            fibres = np.asarray(failed).ravel().tolist()
        except Exception as error:  # numpy lets pass whatever an object raises that poses as an array
            raise InputError(f"lost fibres are {short_repr(failed)}, expected their indices") from error
        for fibre in fibres:
            if type(fibre) is not int or not 0 <= fibre < self.fibres:
                raise InputError(f"lost fibre at index {short_repr(fibre)}: none, allowed are 0 to {self.fibres - 1}")
            fibre_mask[fibre] = False
        if not fibre_mask.any():
            raise InputError(f"all {self.fibres} fibres are lost, at least one must be left")
        return fibre_mask

    def save(self, folder: str | Path) -> None:
        """Write `localizer.safetensors` and `localizer.json`; reading them back gives the same to the last bit.

        Both appear together, or the old ones stay. The document has the digest of its weights, so `load` tells two
        that do not belong together.

        Raises:
            InputError: something is not finite or no JSON, or `folder` cannot be written.
        """
        document = {
            "format": FORMAT,
            **{name: getattr(self, name) for name in ("method", "features", "fibres", "rate_hz")},
            "scaling": {
                "mean_v": self.scaler.centre.tolist(),
                "spread_v": self.scaler.spread.tolist(),
                "memory": self.scaler.memory.tolist(),
                "history_mean_v": self.scaler.usual.tolist(),
                "origin_mm": self.scaler.origin_mm.tolist(),
                "span_mm": self.scaler.span_mm,
                **({"measures": [asdict(each) for each in measures]} if (measures := self.scaler.measures) else {}),
                **({} if (half_mm := self.scaler.half_mm) is None else {"half_mm": half_mm.tolist()}),
            },
            "interval_factors": self.interval_factors.tolist(),
            "weights_sha256": "",  # known when they are written
            "split": self.split,
            "test_presses": len(self.test),
            "errors": [dict(row) for row in self.errors],
            "training_recording_sha256": self.training_recording_sha256,
            "test": list(self.test),
            "recalibrated_by": list(self.recalibrated_by),
            "provenance": dict(self.provenance),
        }
        arrays = {**self.weights, TABLE: self.table}
        if self.bayes is not None:
            arrays |= self.bayes.arrays() | {CORRECTOR + name: part for name, part in self.residual_network.items()}
        files_of(folder, NAME).write(document, arrays, "localizer")

    @classmethod
    def load(cls, folder: str | Path) -> "LocalizerModel":
        """Read what `save` wrote.

        Raises:
            InputError: a file is missing, torn or of another kind, a value is none that `save` writes, or the two do
                not belong together.
        """
        files = files_of(folder, NAME)
        document = read_document(read_json(files.document, FORMAT), str(files.document))
        scaler = FeatureScaler(
            np.array(document.scaling.mean_v),
            np.array(document.scaling.spread_v),
            np.array(document.scaling.memory).reshape(document.fibres, -1, len(document.scaling.mean_v[0])),
            np.array(document.scaling.history_mean_v).reshape(document.fibres, -1),
            np.array(document.scaling.origin_mm),
            document.scaling.span_mm,
            tuple(TargetScaler(each.name, each.middle, each.span) for each in document.scaling.measures),
            None if document.scaling.half_mm is None else np.array(document.scaling.half_mm),
        )
        with files.arrays(document.weights_sha256, "the localizer") as weights:
            table = weights.pop(TABLE)
            scaler.refuse_unsound(table)
            entries = scaler.entries(document.method)
            bayes, residual_network = _observing(weights, scaler, entries, document.method)
            refuse_unsound(weights, entries, document.method, len(scaler.measures))
        plain = ("method", "features", "rate_hz", "training_recording_sha256", "split", "provenance")
        return cls(
            weights,
            scaler,
            table,
            interval_factors=np.array(document.interval_factors),
            test=tuple(document.test),
            recalibrated_by=tuple(document.recalibrated_by),
            errors=[row.model_dump(exclude_none=True) for row in document.errors],
            bayes=bayes,
            residual_network=residual_network,
            **{name: getattr(document, name) for name in plain},
        )


def _observing(
    arrays: dict[str, Any], scaler: FeatureScaler, entries: int, method: str
) -> tuple[BayesianLocalizer | None, Weights]:
    """The observer and what corrects it, taken out of the `arrays` of a localizer; none in one of before, or without.

    Raises:
        InputError: they are none that belong to it. KeyError: one of them is missing.
    """
    parts = {name: arrays.pop(name) for name in list(arrays) if name.startswith((OBSERVER, CORRECTOR))}
    if not parts:
        return None, {}
    residual_network = {
        name.removeprefix(CORRECTOR): part for name, part in parts.items() if name.startswith(CORRECTOR)
    }
    bayes = BayesianLocalizer.of(parts)
    bayes.refuse_unsound(*scaler.centre.shape)
    if method != "ensemble" or scaler.measures:
        raise InputError("observer is there beside measures, or method published, expected none")
    refuse_unsound(residual_network, entries + TOLD, method)
    return bayes, residual_network
