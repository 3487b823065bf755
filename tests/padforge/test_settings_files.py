"""Settings files of any content: read, or refused in one line; and what is allowed can be checked ahead of a run."""

import json
import math
from pathlib import Path
from typing import Any

import annotated_types
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.common.settings import Settings, Spec, commented_toml
from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.objectives.rules import check_rules
from padforge.design.settings import PadSettings, RulesSettings
from padforge.fabricate.checks import plan_checks
from padforge.fabricate.settings import FabricationSettings
from padforge.run import Run, check_run
from padforge.settings import section_models

MODELS = section_models()
DEFAULTS = commented_toml(MODELS).encode()
KEYS = [(name, key) for name, model in MODELS.items() for key in model.model_fields]
VALUES = (
    *("0", "-1", "2", "0.5", "1e308", "5e-324", "nan", "-inf", "true", "9223372036854775807", "9" * 30, "1e400"),
    *("0x7fffffffffffffff", '""', '"any"', '"circle"', '"\\u0000"', '"\\ud800"', "'''\n'''", "[]", "[[]]", "[1, 2, 3]"),
    *("[nan]", '["a"]', "{}", "{a = 1}", "{radius = 0.5}", "1979-05-27", ""),
)
"""Values as TOML has them, or has them not."""


def one_line(error: InputError) -> str:
    assert "\n" not in str(error)
    assert len(str(error)) < 5000
    return str(error)


def read(path: Path, content: bytes) -> dict[str, Settings] | str:
    """All sections of a settings file of that content, which read back as they are written; or one line why none."""
    path.write_bytes(content)
    try:
        spec = Spec.load(path, MODELS)
        found = {name: spec.section(model) for name, model in MODELS.items()}
    except InputError as error:
        return one_line(error)
    for name, section in found.items():
        json.dumps(section.model_dump(mode="json"), allow_nan=False)
        assert type(section).model_validate(section.model_dump()) == section, name
    return found


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("settings") / "pad.toml"


@settings(max_examples=50)
@given(st.lists(st.tuples(st.sampled_from(KEYS), st.sampled_from(VALUES) | st.floats().map(repr)), min_size=1))
def test_settings_of_any_value_are_valid_or_refused(path: Path, lines: list[tuple[tuple[str, str], str]]) -> None:
    tables: dict[str, list[str]] = {}
    for (section, key), value in lines:
        tables.setdefault(section, []).append(f"{key} = {value}")
    text = "\n".join(part for section, rows in tables.items() for part in (f"[{section}]", *rows))
    read(path, text.encode())


@settings(max_examples=25)
@given(st.integers(0, len(DEFAULTS)), st.integers(0, 200), st.binary(max_size=8))
def test_damaged_settings_are_refused_in_one_line(path: Path, at: int, less: int, more: bytes) -> None:
    read(path, DEFAULTS[:at] + more + DEFAULTS[at + less :])


@pytest.mark.parametrize(
    "content",
    [
        b"pad = 1\n",
        b"[pad]\n[pad]\n",
        "[pad]\ndeep_family = 'é'\n".encode("latin-1"),
        "[pad]\ngrid = 2\n".encode("utf-16"),
        b"\0" * 1000,
    ],
    ids=range(5),
)
def test_broken_settings_are_refused(path: Path, content: bytes) -> None:
    assert isinstance(read(path, content), str)


def limits(section: str, key: str) -> list[float]:
    """The least and the greatest value that a number in the settings may have, and its default."""
    info = MODELS[section].model_fields[key]
    if info.annotation not in (int, float):
        return []
    kind, found = info.annotation, [info.default]
    for rule in info.metadata:
        match rule:
            case annotated_types.Ge(ge=bound) | annotated_types.Le(le=bound):
                found.append(kind(bound))  # pyright: ignore[reportArgumentType]
            case annotated_types.Gt(gt=bound):
                found.append(math.nextafter(float(bound), math.inf))  # pyright: ignore[reportArgumentType]
            case annotated_types.Lt(lt=bound):
                found.append(math.nextafter(float(bound), -math.inf))  # pyright: ignore[reportArgumentType]
    return found


EXTREMES = {(section, key): found for section, key in KEYS if (found := limits(section, key))}


@st.composite
def extremes(draw: st.DrawFn, *sections: str) -> Spec:
    """Settings, a few of them at the least or greatest value that is allowed."""
    keys = [(section, key) for section, key in EXTREMES if section in (sections or MODELS)]
    tables: dict[str, dict[str, Any]] = {}
    for section, key in draw(st.lists(st.sampled_from(keys), min_size=1, max_size=5, unique=True)):
        tables.setdefault(section, {})[key] = draw(st.sampled_from(EXTREMES[section, key]))
    return Spec(tables)


@settings(max_examples=15)
@given(extremes())
def test_check_run_handles_extreme_settings(path: Path, spec: Spec) -> None:
    assert EXTREMES["pad", "grid"] == [4, 1, 256]
    try:
        check_run(Run(spec, path.parent / "none"))
    except InputError as error:
        one_line(error)


@settings(max_examples=8)
@given(extremes("pad", "rules", "mould", "printer"), st.integers(1, 2), st.integers(0, 2), st.integers(0, 2**32 - 1))
def test_rules_and_moulds_handle_extreme_settings(spec: Spec, grid: int, knots: int, seed: int) -> None:
    pad = Morphology.random(grid, knots, seed, spec.section(PadSettings).pitch_mm)
    found = check_rules(pad, spec.section(RulesSettings))
    assert all(math.isfinite(violation.measured) for violation in found)
    assert all(1 <= fibre <= 2 * grid for violation in found for fibre in violation.fibres)
    try:
        findings = plan_checks.check(pad, FabricationSettings.from_spec(spec))
    except InputError as error:
        one_line(error)
        return
    json.dumps([finding.to_dict() for finding in findings], allow_nan=False)
