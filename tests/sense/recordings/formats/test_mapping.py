"""Mappings: what they name, and what they leave to guess."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.common.errors import InputError
from sense.recordings.formats.mapping import UNITS, Part, chosen, parse_mapping
from tests.helpers.effort import few

NAMES = ["t_ms", "Time [s]", "ch1", "ch2", "a,b", "a:b", "px", "py", "contact"]


def meant(mapping: str, names: list[str] = NAMES) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for part, places in chosen(parse_mapping(mapping), names):
        found.setdefault(part.quantity, []).extend(names[at] for at in places)
    return found


def test_a_mapping_names_columns_and_units() -> None:
    assert parse_mapping("time=t_ms:ms, fibres = ch* : 0.005 ,x=px:cm,y=py,press=contact") == [
        Part("time", "t_ms", 1e-3),
        Part("fibres", "ch*", 0.005),
        Part("x", "px", 10),
        Part("y", "py", None),
        Part("press", "contact", None),
    ]


def test_parts_mean_columns() -> None:
    assert meant("time=t_ms,fibres=ch*") == {"time": ["t_ms"], "fibres": ["ch1", "ch2"]}
    assert meant("time=Time [s],fibres=ch2,fibres=ch1") == {"time": ["Time [s]"], "fibres": ["ch2", "ch1"]}
    assert meant("time=a?b,fibres=ch?", ["a,b", "ch1", "ch22"]) == {"time": ["a,b"], "fibres": ["ch1"]}
    assert meant("time=T*,fibres=*,x=px,y=py", ["px", "c", "Time", "py"])["fibres"] == ["c"]
    assert meant("time=*,fibres=c*", ["*", "c", "d"]) == {"time": ["*"], "fibres": ["c"]}


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ("", "mapping has '', expected QUANTITY=NAME or QUANTITY=NAME:UNIT, where QUANTITY is one of time, fibres, x"),
        ("time", "mapping has 'time'"),
        ("time=,fibres=ch*", "mapping has 'time='"),
        ("zeit=t,fibres=ch*", "mapping has 'zeit=t'"),
        ("time=t_ms", "does not name fibres"),
        ("fibres=ch*", "does not name time"),
        ("time=t_ms,time=t_ms,fibres=ch*", "names time twice"),
        ("time=t_ms,fibres=ch*,x=px", "names one of x and y, expected both or neither"),
        ("time=t_ms,fibres=ch*,lifted=px", "names one of begun and lifted"),
        ("time=t_ms,fibres=ch*,x=px,y=py,places=contact", "names x and places, expected one of them"),
        ("time=t_ms,fibres=ch*,press=contact,begun=px,lifted=py", "names press and begun"),
        ("time=t_ms:volt,fibres=ch*", "unit of time is 'volt', allowed is s, ms, us, min or a factor"),
        ("time=t_ms:0,fibres=ch*", "unit of time is '0'"),
        ("time=t_ms:nan,fibres=ch*", "unit of time is 'nan'"),
        ("time=t_ms:1_0,fibres=ch*", "unit of time is '1_0'"),
        ("time=t_ms:,fibres=ch*", "unit of time is ''"),
        ("time=t_ms,fibres=ch*,press=contact:2", "unit of press is '2', allowed is none"),
        ("time=t,fibres=ch*", r"time is 't', expected one of 't_ms', 'Time \[s\]', 'ch1'"),
        ("time=t_ms,fibres=z*", "fibres is 'z.', expected one of"),
        ("time=?*,fibres=ch*", "time is '..', which may be each of"),
        ("time=ch1,fibres=ch1", "fibres is 'ch1', which is named before"),
        ("time=t_ms,fibres=ch1,fibres=ch1", "fibres is 'ch1', which is named before"),
        ("time=" + "t" * 20_000, "mapping has 20005 characters"),
    ],
)
def test_a_mapping_that_leaves_something_open_is_refused(mapping: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as refused:
        meant(mapping)
    assert len(str(refused.value)) < 400


words = st.text(st.characters(blacklist_characters=",:=*?", blacklist_categories=["Cs", "Cc", "Z"]), min_size=1)


@few(100)
@given(
    fibres=st.lists(st.tuples(words, st.sampled_from([None, 1.0, 1e-3, 1e-6])), min_size=1, max_size=5),
    time=st.tuples(words, st.sampled_from([None, *UNITS["time"]])),
)
def test_what_is_written_is_what_is_read(fibres, time) -> None:
    units = {None: "", **{factor: f":{unit}" for unit, factor in UNITS["fibres"].items()}}
    text = ",".join(f"fibres={name}{units[factor]}" for name, factor in fibres)
    expected = [Part("fibres", *each) for each in fibres]
    name, unit = time
    unit_part = "" if unit is None else f":{unit}"
    parts = parse_mapping(f"time={name}{unit_part},{text}")
    assert parts == [Part("time", name, None if unit is None else UNITS["time"][unit]), *expected]


@few(150)
@given(mapping=st.text(max_size=60), names=st.lists(st.text(max_size=5), max_size=6))
def test_any_text_is_a_mapping_or_one_line(mapping: str, names: list[str]) -> None:
    refused, found = "", []
    try:
        found = chosen(parse_mapping(mapping), names)
    except InputError as error:
        refused = str(error)
    assert refused.strip() if not found else all(places for _, places in found)
    assert "\n" not in refused
