"""`localizer.json`: what it may hold, so that nothing else gets past its reading."""

from collections.abc import Mapping
from reprlib import repr as shortened
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, ValidationError

from design.errors import InputError
from design.settings import Section

from .limits import MAX_FIBRES, MAX_MM, MAX_RATE_HZ, MAX_VOLTS, MIN_RATE_HZ
from .presses import SIZES
from .settings import Features, Split

LEAST_SPREAD_V = 1e-9
"""Least spread that an input is divided by: what varies less never varied."""

FORMAT = "padforge-localizer/1"

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Volts = Annotated[float, Field(ge=-2 * MAX_VOLTS, le=2 * MAX_VOLTS)]
Spread = Annotated[float, Field(ge=LEAST_SPREAD_V, le=2 * MAX_VOLTS)]
Distance = Annotated[float, Field(ge=0)]
Place = Annotated[float, Field(ge=-MAX_MM, le=MAX_MM)]


class ScalingTable(Section):
    """`scaling` of `localizer.json`, see `localizer.Scaling`."""

    centre_v: list[list[Volts]]
    spread_v: list[list[Spread]]
    middle_mm: Annotated[list[Place], Field(min_length=2, max_length=2)]
    span_mm: float = Field(gt=0, le=MAX_MM)


class ErrorRow(Section):
    """A row of `errors`, see `calibration.evaluate`."""

    lost: int = Field(ge=0)
    subsets: int = Field(ge=1)
    mean_mm: Distance
    std_mm: Distance
    max_mm: Distance
    median_mm: Distance
    p95_mm: Distance


class LocalizerDocument(Section):
    """The whole of `localizer.json`, see `localizer.Localizer`."""

    format: Literal["padforge-localizer/1"] = FORMAT
    features: Features
    fibres: int = Field(ge=1, le=MAX_FIBRES)
    rate_hz: float = Field(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)
    scaling: ScalingTable
    weights_sha256: Digest
    split: Split
    test_presses: int
    errors: list[ErrorRow]
    learnt_from: Digest
    test: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
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
    size = SIZES[found.features]
    for name, rows in (("centre_v", found.scaling.centre_v), ("spread_v", found.scaling.spread_v)):
        if [len(row) for row in rows] != [size] * found.fibres:
            raise InputError(
                f"{where}: scaling.{name} has {len(rows)} rows of {shortened(sorted({len(row) for row in rows}))} "
                f"values, expected {found.fibres} of {size} for features {found.features}"
            )
    if len(set(found.test)) != len(found.test) or found.test_presses != len(found.test):
        raise InputError(
            f"{where}: test has {len(found.test)} presses, {len(set(found.test))} of them different, "
            f"expected {found.test_presses} different ones"
        )
    return found
