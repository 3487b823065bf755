"""Settings at the ends of their ranges can be checked ahead of a run; broken files are refused in one line."""

import json
import math
from pathlib import Path
from typing import Any

import annotated_types
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.common.settings import Spec
from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.objectives.rules import check_rules
from padforge.design.settings import PadSettings, RulesSettings
from padforge.fabricate.checks import plan_checks
from padforge.fabricate.settings import FabricationSettings
from padforge.run import Run, check_run
from padforge.settings import section_models

MODELS = section_models()
KEYS = [(name, key) for name, model in MODELS.items() for key in model.model_fields]


def one_line(error: InputError) -> str:
    assert "\n" not in str(error)
    assert len(str(error)) < 5000
    return str(error)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("settings") / "pad.toml"


@pytest.mark.parametrize(
    "content",
    [b"pad = 1\n", b"[pad]\n[pad]\n", "[pad]\ndeep_family = 'é'\n".encode("latin-1"), "[pad]\n".encode("utf-16")],
    ids=range(4),
)
def test_broken_settings_are_refused_in_one_line(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"pad\.toml: ") as refused:
        Spec.load(path, MODELS)
    one_line(refused.value)


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
