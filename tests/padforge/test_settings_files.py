import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge import InputError, Spec
from padforge.design import Morphology, PadSettings, RulesSettings, check_rules
from padforge.fabricate.checks import plan_checks
from padforge.fabricate.settings import FabricationSettings
from padforge.run import Run, check_run
from padforge.settings import section_models
from tests.helpers.refusals import require_one_line

MODELS = section_models()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("settings")


@pytest.mark.parametrize(
    "content",
    [b"pad = 1\n", b"[pad]\n[pad]\n", "[pad]\ndeep_family = 'é'\n".encode("latin-1"), "[pad]\n".encode("utf-16")],
    ids=range(4),
)
def test_broken_settings_are_refused_in_one_line(folder: Path, content: bytes) -> None:
    (folder / "pad.toml").write_bytes(content)
    with pytest.raises(InputError, match=r"^[^\n]*pad\.toml: [^\n]*$"):
        Spec.load(folder / "pad.toml", MODELS)


def limits(section: str, key: str) -> list[float]:
    """The least and the greatest value that a number in the settings may have, and its default."""
    info = MODELS[section].model_fields[key]
    if info.annotation not in (int, float):
        return []
    found = [info.default]
    for rule in info.metadata:
        found += [info.annotation(getattr(rule, name)) for name in ("ge", "le") if hasattr(rule, name)]
        beyond = {"gt": math.inf, "lt": -math.inf}
        found += [math.nextafter(getattr(rule, name), beyond[name]) for name in beyond if hasattr(rule, name)]
    return found


EXTREMES = {(name, key): ends for name in MODELS for key in MODELS[name].model_fields if (ends := limits(name, key))}


@st.composite
def extremes(draw: st.DrawFn, *sections: str) -> Spec:
    keys = [(section, key) for section, key in EXTREMES if section in (sections or MODELS)]
    tables: dict[str, dict[str, Any]] = {}
    for section, key in draw(st.lists(st.sampled_from(keys), min_size=1, max_size=5, unique=True)):
        tables.setdefault(section, {})[key] = draw(st.sampled_from(EXTREMES[section, key]))
    return Spec(tables)


@settings(max_examples=15)
@given(extremes())
def test_check_run_handles_extreme_settings(folder: Path, spec: Spec) -> None:
    assert EXTREMES["pad", "grid"] == [4, 1, 256]
    try:
        check_run(Run(spec, folder / "none"))
    except InputError as error:
        require_one_line(error)


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
        require_one_line(error)
        return
    json.dumps([finding.to_dict() for finding in findings], allow_nan=False)
