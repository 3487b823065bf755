"""Hostile settings files: each is read, or refused in one line; and what is allowed can be done."""

import json
import math
from pathlib import Path
from typing import Any

import annotated_types
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.common.errors import InputError
from design.common.settings import Settings, Spec, commented_toml
from design.criteria.rules import check_rules
from design.pad.morphology import Morphology
from design.settings import Contact, PadSettings, RulesSettings
from fabricate import settings as fabricate
from fabricate.checks import plan_checks as printability
from padforge.running import Run, check_ahead
from padforge.tables import sections
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.door import require_one_line

MODELS = sections()
DEFAULTS = commented_toml(MODELS).encode()
KEYS = [(name, key) for name, model in MODELS.items() for key in model.model_fields]

VALUES = (
    *(
        "0",
        "1",
        "-1",
        "2",
        "1.0",
        "0.5",
        "-0.0",
        "1e308",
        "-1e308",
        "5e-324",
        "nan",
        "-nan",
        "inf",
        "-inf",
        "true",
        "false",
    ),
    *(
        "9223372036854775807",
        "-9223372036854775808",
        "9" * 30,
        "9" * 5000,
        "1e400",
        "0x7fffffffffffffff",
        "0b1",
        "1_000",
    ),
    *(
        '""',
        '"any"',
        '"unknown"',
        '"circle"',
        '"1"',
        '"nan"',
        '"\\u0000"',
        '"\\ud800"',
        "'''\n'''",
        '"' + "x" * 20_000 + '"',
    ),
    *(
        "[]",
        "[[]]",
        "[1]",
        "[1, 2, 3]",
        "[nan]",
        '["a"]',
        "[" * 60 + "]" * 60,
        "[" * 5000,
        f"[{'1, ' * 9000}]",
        "{}",
        "{a = 1}",
    ),
    *(
        "{radius = 0.5}",
        "[{radius = 0.5}, {sides = 3}]",
        "[{}, {}]",
        "1979-05-27",
        "07:32:00",
        "1979-05-27T07:32:00Z",
        "",
    ),
)
"""Values as TOML has them, or has them not."""


def read(path: Path) -> dict[str, Settings] | InputError:
    """All sections of a settings file, or why there are none: one line."""
    with ends_in_time():
        try:
            spec = Spec.load(path, MODELS)
            return {name: spec.section(model) for name, model in MODELS.items()}
        except InputError as error:
            require_one_line(error)
            return error


def require_sound(sections: dict[str, Settings]) -> None:
    """Sections that were read hold finite numbers within their limits, and read back as they are written."""
    for name, section in sections.items():
        json.dumps(section.model_dump(mode="json"), allow_nan=False)
        assert type(section).model_validate(section.model_dump()) == section, name


def values() -> st.SearchStrategy[str]:
    numbers = st.one_of(st.integers().map(str), st.floats().map(repr), st.integers(-(10**40), 10**40).map(str))
    return st.one_of(st.sampled_from(VALUES), numbers, st.text(max_size=20).map(json.dumps), st.text(max_size=20))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("settings")


@few(150)
@given(
    st.lists(st.tuples(st.sampled_from(KEYS), values()), min_size=1, max_size=4), st.sampled_from(["\n", "\r\n", "\r"])
)
def test_settings_of_any_value(folder: Path, lines: list[tuple[tuple[str, str], str]], end: str):
    tables: dict[str, list[str]] = {}
    for (section, key), value in lines:
        tables.setdefault(section, []).append(f"{key} = {value}")
    text = end.join(part for section, rows in tables.items() for part in (f"[{section}]", *rows))
    path = folder / "values.toml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    found = read(path)
    if isinstance(found, dict):
        require_sound(found)


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """A whole settings file with bytes changed, left out, doubled, or cut off."""
    content = bytearray(DEFAULTS)
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.integers(0, len(content) - 1))
        match draw(st.integers(0, 4)):
            case 0:
                content[at] = draw(st.integers(0, 255))
            case 1:
                del content[at : at + draw(st.integers(1, 200))]
            case 2:
                content[at:at] = content[at : at + draw(st.integers(1, 200))]
            case 3:
                content[at:at] = draw(st.binary(max_size=8))
            case 4:
                del content[max(at, 1) :]
        content = content or bytearray(b"\n")
    return draw(st.sampled_from([b"", b"\xef\xbb\xbf", b"\xff\xfe", b"\0"])) + bytes(content)


@few(100)
@given(damaged())
def test_damaged_settings(folder: Path, content: bytes):
    path = folder / "damaged.toml"
    path.write_bytes(content)
    found = read(path)
    if isinstance(found, dict):
        require_sound(found)


@pytest.mark.parametrize(
    "content",
    [
        b"a = " + b"[" * 200_000,
        b"a" + b".a" * 100_000 + b" = 1",
        b"[a" + b".a" * 100_000 + b"]",
        b"a = " + b"{a = " * 50_000,
        b"[[pad]]\n" * 30_000,
        b"".join(b"[a%d]\n" % i for i in range(20_000)),
        b"[pad]\n" + b"".join(b"a%d = 1\n" % i for i in range(20_000)),
        b"pad = 1\n",
        b"[pad]\n[pad]\n",
        b"[pad]\ngrid = 1\ngrid = 1\n",
        b"[pad.grid]\n",
        b"# " + b"x" * 200_000,
        b"\n" * 10**7,
        "[pad]\ndeep_family = 'é'\n".encode("latin-1"),
        "[pad]\ngrid = 2\n".encode("utf-16"),
        b"\0" * 1000,
    ],
    ids=range(16),
)
def test_settings_made_to_be_awkward(tmp_path: Path, content: bytes):
    path = tmp_path / "awkward.toml"
    path.write_bytes(content)
    found = read(path)
    assert isinstance(found, InputError) or content.startswith(b"#")


def _limits(section: str, key: str) -> list[float]:
    """The least and the greatest value that a number in the settings may have, and its default."""
    info = MODELS[section].model_fields[key]
    if info.annotation not in (int, float):
        return []
    kind, default = info.annotation, info.default
    found = [default]
    for rule in info.metadata:
        match rule:
            case annotated_types.Ge(ge=bound) | annotated_types.Le(le=bound):
                found.append(kind(bound))  # pyright: ignore[reportArgumentType]
            case annotated_types.Gt(gt=bound):
                found.append(math.nextafter(float(bound), math.inf))  # pyright: ignore[reportArgumentType]
            case annotated_types.Lt(lt=bound):
                found.append(math.nextafter(float(bound), -math.inf))  # pyright: ignore[reportArgumentType]
    return found


EXTREMES = {(section, key): found for section, key in KEYS if (found := _limits(section, key))}


@st.composite
def extremes(draw: st.DrawFn, sections: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Settings of some sections, a few of them at the least or greatest value that is allowed."""
    keys = [(section, key) for section, key in EXTREMES if section in sections]
    tables: dict[str, dict[str, Any]] = {}
    for section, key in draw(st.lists(st.sampled_from(keys), min_size=1, max_size=5, unique=True)):
        tables.setdefault(section, {})[key] = draw(st.sampled_from(EXTREMES[section, key]))
    return tables


def test_what_can_be_at_its_extreme_is_known():
    assert len(EXTREMES) > 60
    assert EXTREMES["pad", "grid"] == [4, 1, 256]


@few(60)
@given(extremes(tuple(MODELS)))
def test_a_whole_run_with_extreme_settings_is_checked_in_time(folder: Path, tables: dict[str, dict[str, Any]]):
    with ends_in_time():
        try:
            check_ahead(Run(Spec(tables), folder / "none"))
        except InputError as error:
            require_one_line(error)


@few(30)
@given(extremes(("pad", "rules", "contact")), st.integers(1, 3), st.integers(0, 6), st.integers(0, 2**32 - 1))
def test_rules_at_their_extremes(tables: dict[str, dict[str, Any]], grid: int, knots: int, seed: int):
    spec = Spec(tables)
    pad = Morphology.random(grid, knots, seed, spec.section(PadSettings).pitch_mm)
    spec.section(Contact)
    with ends_in_time():
        found = check_rules(pad, spec.section(RulesSettings))
    assert all(math.isfinite(violation.measured) for violation in found)
    assert all(1 <= fibre <= 2 * grid for violation in found for fibre in violation.fibres)


@few(10)
@given(extremes(("pad", "rules", "mould", "printer")), st.integers(1, 2), st.integers(0, 2), st.integers(0, 2**32 - 1))
def test_a_mould_at_the_extremes(tables: dict[str, dict[str, Any]], grid: int, knots: int, seed: int):
    spec = Spec(tables)
    pad = Morphology.random(grid, knots, seed, spec.section(PadSettings).pitch_mm)
    with ends_in_time():
        try:
            findings = printability.check(pad, fabricate.FabricationSettings.from_spec(spec))
        except InputError as error:
            require_one_line(error)
            return
    json.dumps([finding.document() for finding in findings], allow_nan=False)
