"""`localizer.json`: what it may hold, so that nothing else gets past its reading."""

from collections.abc import Mapping, Sequence
from reprlib import repr as shortened
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, ValidationError

from padforge.design.common.settings import Settings
from padforge.design.common.validation import InputError
from padforge.sense.recordings.processing.limits import (
    LEAST_SPREAD_V,
    MAX_FIBRES,
    MAX_MM,
    MAX_RATE_HZ,
    MAX_VOLTS,
    MIN_RATE_HZ,
)
from padforge.sense.settings import Features, Method, Split

from padforge.sense.localizer.features import PASTS, PHASES, SIZES

FORMAT = "padforge-localizer/2"
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Volts = Annotated[float, Field(ge=-2 * MAX_VOLTS, le=2 * MAX_VOLTS)]
Spread = Annotated[float, Field(ge=LEAST_SPREAD_V, le=2 * MAX_VOLTS)]
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
    """`scaling` of `localizer.json`, see `normalization.Normalization`."""

    centre_v: list[list[Volts]]
    spread_v: list[list[Spread]]
    memory: list[list[list[Memory]]]
    usual_v: list[list[Volts]]
    middle_mm: Annotated[list[Place], Field(min_length=2, max_length=2)]
    span_mm: float = Field(gt=0, le=MAX_MM)
    measures: Annotated[list[MeasureTable], Field(max_length=2)] = Field(default_factory=list)
    half_mm: Annotated[list[Side], Field(min_length=2, max_length=2)] | None = None


class ErrorRow(Settings):
    """A row of `errors`, see `evaluation.evaluate`."""

    lost: int = Field(ge=0)
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

    format: Literal["padforge-localizer/2"] = FORMAT
    method: Method
    features: Features
    fibres: int = Field(ge=1, le=MAX_FIBRES)
    rate_hz: float = Field(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)
    scaling: ScalingTable
    factors: Annotated[list[Annotated[list[Factor], Field(min_length=3, max_length=5)]], Field(min_length=1)]
    weights_sha256: Digest
    split: Split
    test_presses: int
    errors: list[ErrorRow]
    learnt_from: Digest
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
    size = windows + gains * any(len(row) > windows for row in table.centre_v)  # a localizer of before knows no gains
    shapes = {
        "centre_v": (_sizes(table.centre_v), (found.fibres, size)),
        "spread_v": (_sizes(table.spread_v), (found.fibres, size)),
        "usual_v": (_sizes(table.usual_v), (found.fibres, past)),
        "memory": (_sizes([row for fibre in table.memory for row in fibre]), (found.fibres * past, size)),
        "memory of fibres": (_sizes(table.memory), (found.fibres, past)),
    }
    names = [each.name for each in table.measures]
    if names != ["depth_mm", "force_n"][: len(names)] or (names and found.method == "published"):
        raise InputError(
            f"{where}: scaling.measures are {', '.join(names)} of method {found.method}, expected none, depth_mm, or "
            "depth_mm and force_n, and of method masked"
        )
    if _sizes(found.factors) != [3 + len(names)] * len(found.factors):
        raise InputError(
            f"{where}: factors have {shortened(sorted(set(_sizes(found.factors))))} values a row, "
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
