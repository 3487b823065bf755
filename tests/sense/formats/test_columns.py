"""Mappings: what they name, and what they leave to guess."""

import pytest

from padforge.design.common.validation import InputError
from padforge.sense.formats.columns import Part, chosen, parse_mapping

NAMES = ["t_ms", "Time [s]", "ch1", "ch2", "a,b", "a:b", "px", "py", "contact"]


def meant(mapping: str, names: list[str] = NAMES) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for part, places in chosen(parse_mapping(mapping), names):
        found.setdefault(part.quantity, []).extend(names[at] for at in places)
    return found


def test_a_mapping_names_columns_and_units() -> None:
    assert parse_mapping("time=t_ms:ms, fibres = ch* : 0.005 ,fibres=ü:uV,x=px:cm,y=py,press=contact") == [
        Part("time", "t_ms", 1e-3),
        Part("fibres", "ch*", 0.005),
        Part("fibres", "ü", 1e-6),
        *(Part("x", "px", 10), Part("y", "py", None), Part("press", "contact", None)),
    ]
    units = ["time=t:min,fibres=c:V,places=p:um,depth=d:m,force=f:mN", "time=t:us,fibres=c:mV,reached=r:mm,force=f:N"]
    factors = [[part.factor for part in parse_mapping(each)] for each in units]
    assert factors == [[60, 1, 1e-3, 1000, 1e-3], [1e-6, 1e-3, 1, 1]]


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
        ("time=,fibres=ch*", "mapping has 'time='"),
        ("zeit=t,fibres=ch*", "mapping has 'zeit=t'"),
        ("time=t_ms", "does not name fibres"),
        ("time=t_ms,time=t_ms,fibres=ch*", "names time twice"),
        ("time=t_ms,fibres=ch*,x=px", "names one of x and y, expected both or neither"),
        ("time=t_ms,fibres=ch*,lifted=px", "names one of begun and lifted"),
        ("time=t_ms,fibres=ch*,x=px,y=py,places=contact", "names x and places, expected one of them"),
        ("time=t_ms,fibres=ch*,press=contact,begun=px,lifted=py", "names press and begun"),
        ("time=t_ms:volt,fibres=ch*", "unit of time is 'volt', allowed is s, ms, us, min or a factor"),
        ("time=t_ms:0,fibres=ch*", "unit of time is '0'"),
        ("time=t_ms:nan,fibres=ch*", "unit of time is 'nan'"),
        ("time=t_ms:,fibres=ch*", "unit of time is ''"),
        ("time=t_ms,fibres=ch*,press=contact:2", "unit of press is '2', allowed is none"),
        ("time=t,fibres=ch*", r"time is 't', expected one of 't_ms', 'Time \[s\]', 'ch1'"),
        ("time=?*,fibres=ch*", "time is '..', which may be each of"),
        ("time=ch1,fibres=ch1", "fibres is 'ch1', which is named before"),
        ("time=a\nb,fibres=ch*", "time is 'a.nb', expected one of"),
        ("time=" + "t" * 20_000, "mapping has 20005 characters"),
    ],
)
def test_a_mapping_that_leaves_something_open_is_refused(mapping: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as refused:
        meant(mapping)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400
