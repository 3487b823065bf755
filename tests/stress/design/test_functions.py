"""The public functions of `design` given anything: a right result, or one line that says what is wrong."""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design import (
    Contact,
    Indenter,
    InputError,
    Morphology,
    Spec,
    crossings,
    flatten,
    indented_signals,
    published_objective,
    signals,
    signals_quantized,
    signals_sparse,
)
from design.criteria.rules import check_rules
from design.criteria.score import score
from design.evaluation.localisation_error import localisation_error
from design.optimisers.search import SearchRun, search
from design.report.plan_drawing import draw_plan
from design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.values import LAX, call_spoiled, contacts, pads, presses

Arguments = dict[str, Any]
PAD = Morphology.random(2, 3, seed=1)
SMALL = SearchSettings(knots=3, starts=1, steps=2, lost=1)
WEIGHTS = ["uniform", "inverse_square", "inverse"]


def finite(result: Any) -> None:
    assert np.isfinite(result).all()


def some_signals(found: Any, given: Arguments) -> None:
    pad = given["pad"]
    grid = (pad.knots if isinstance(pad, Morphology) else np.asarray(pad)).shape[-3] // 2
    assert found.shape[-1] == 2 * grid
    assert found.dtype == np.float64
    finite(found)
    assert (found >= 0).all()


def some_sparse(found: Any, given: Arguments) -> None:
    some_signals(found.toarray() if found.shape[0] < 1000 else found.data[None], {"pad": PAD})


def lines(found: Any, given: Arguments) -> None:
    assert len(found) == len(given["pad"].knots)
    for line, knots in zip(found, given["pad"].knots, strict=True):
        finite(line)
        assert (line[0] == knots[0]).all()
        assert (line[-1] == knots[-1]).all()


def a_pad(found: Any, given: Arguments) -> None:
    assert isinstance(found, Morphology)
    assert Morphology.of_layout(found.knots, found.layout) == found


def a_section(found: Any, given: Arguments) -> None:
    assert type(found)(**found.model_dump(mode="python")) == found


def numbers(found: Any, given: Arguments) -> None:
    assert found
    assert all(isinstance(name, str) for name in found)
    finite(list(found.values()))


def ignored(found: Any, given: Arguments) -> None: ...


def quick_search(contact: Any, rules: Any, origin: Any, **run: Any) -> Any:
    return search(PadSettings(grid=1), contact, SMALL, rules, origin=origin, run=SearchRun(**run))


CALLS: Mapping[str, tuple[Callable[..., Any], Arguments, Callable[[Any, Arguments], None]]] = {
    "signals": (signals, {"pad": PAD, "presses": [[1, 1], [2, 2]], "contact": None}, some_signals),
    "signals_quantized": (
        signals_quantized,
        {"pad": PAD, "presses": [[1, 1]], "contact": PUBLISHED_CONTACT, "samples": 50},
        some_signals,
    ),
    "signals_sparse": (signals_sparse, {"pad": PAD, "presses": [[1, 1]], "contact": PUBLISHED_CONTACT}, some_sparse),
    "crossings": (crossings, {"pad": PAD, "tolerance": 1e-3}, lambda found, given: finite([c.place for c in found])),
    "flatten": (flatten, {"pad": PAD, "tolerance": 1e-2}, lines),
    "published_objective": (
        published_objective,
        {"pad": PAD, "contact": None, "presses": [[1, 1]], "samples": 40, "weights": (1.0, 1e-7, 5e-6)},
        lambda found, given: finite(found),
    ),
    "Indenter": (
        lambda **given: Indenter(**given).contact_radius([0, 1e-6]),
        {"shape": "cone", "radius": 0.5, "angle_deg": 30},
        lambda found, given: finite(found),
    ),
    "contact_radius": (
        Indenter().contact_radius,
        {"depths": [0.1]},
        lambda found, given: finite(found),
    ),
    "deflection": (Indenter().deflection, {"r": [0.1], "depth": 0.1}, lambda found, given: finite(found)),
    "force_n": (
        Indenter("flat").force_n,
        {"depths": [0.1], "unit_mm": 11.25, "reduced_modulus_kpa": 70},
        lambda found, given: finite(found),
    ),
    "indented_signals": (
        indented_signals,
        {"pad": PAD, "presses": [[1, 1]], "depths": 0.1, "indenter": Indenter()},
        some_signals,
    ),
    "Morphology": (Morphology, {"knots": PAD.knots, "pitch_mm": 11.25, "provenance": {}}, a_pad),
    "straight": (Morphology.straight, {"fibres": (2, 1), "pitch_mm": 5.0}, a_pad),
    "random": (Morphology.random, {"fibres": 2, "knots": 2, "seed": 0, "pitch_mm": 5.0}, a_pad),
    "from_parameters": (Morphology.from_parameters, {"parameters": np.ones((3, 8)), "pitch_mm": 5}, a_pad),
    "tiled": (PAD.tiled, {"times": 2}, a_pad),
    "load": (Morphology.load, {"path": "nowhere.json"}, a_pad),
    "to_mm": (PAD.to_mm, {"places": [1, 2]}, lambda found, given: finite(found)),
    "to_grid": (PAD.to_grid, {"places_mm": [1, 2]}, lambda found, given: finite(found)),
    "Contact": (Contact, {"radius": 0.6, "sides": 30, "weight": "uniform", "length": "manhattan"}, a_section),
    "Pad": (PadSettings, {"grid": 2, "pitch_mm": 5.0, "deep_family": "vertical"}, a_section),
    "Search": (
        SearchSettings,
        {"knots": 3, "lost": 2, "noise": 0.1, "contacts": [{"radius": 0.9}], "seed": 1},
        a_section,
    ),
    "Rules": (RulesSettings, {"max_crossings": "any", "min_gap_mm": 1.0, "same_family_crossings": 1}, a_section),
    "Spec": (lambda tables: Spec(tables).section(Contact), {"tables": {"contact": {"radius": 0.5}}}, a_section),
    "Spec.load": (Spec.load, {"path": None}, lambda found, given: a_section(found.section(Contact), given)),
    "Spec.section": (Spec({}).section, {"model": Contact, "radius": 0.5}, a_section),
    "check": (
        check_rules,
        {"pad": PAD, "rules": RulesSettings()},
        lambda found, given: finite([v.measured for v in found]),
    ),
    "draw_plan": (draw_plan, {"pad": PAD, "contact": PUBLISHED_CONTACT, "violations": []}, ignored),
}
SLOW_CALLS: Mapping[str, tuple[Callable[..., Any], Arguments, Callable[[Any, Arguments], None]]] = {
    "score": (
        score,
        {"pad": PAD, "contact": PUBLISHED_CONTACT, "lost": 1, "noise": 0.1, "rules": RulesSettings()},
        numbers,
    ),
    "search": (
        quick_search,
        {
            "contact": PUBLISHED_CONTACT,
            "rules": RulesSettings(),
            "origin": None,
            "resume": False,
            "time_budget": 5.0,
            "executor": None,
        },
        lambda found, given: a_pad(found.morphology, given),
    ),
    "evaluate": (
        localisation_error,
        {"pad": PAD, "contact": None, "lost": (0,), "seed": 0, "hidden": 2, "presses": 16, "test": 3, "subsets": 1},
        lambda found, given: finite([level.mean for level in found]),
    ),
}


@settings(few(300), suppress_health_check=LAX)
@given(st.data())
def test_any_argument_gives_a_right_result_or_one_line(data):
    call_spoiled(CALLS, data)


@settings(few(15), suppress_health_check=LAX)
@given(st.data())
def test_any_argument_of_the_long_work_gives_a_right_result_or_one_line(data):
    call_spoiled(SLOW_CALLS, data)


@settings(few(40), suppress_health_check=LAX)
@given(st.data())
def test_a_pad_however_wild_is_written_and_read_back_as_it_was(data):
    pad = data.draw(pads((1, 6), (0, 30)))
    with tempfile.TemporaryDirectory() as folder, ends_in_time():
        path = Path(folder) / "morphology.json"
        pad.save(path)
        assert Morphology.load(path) == pad
        assert [child.name for child in Path(folder).iterdir()] == ["morphology.json"]


@settings(few(15), suppress_health_check=LAX)
@given(st.data())
def test_a_pad_however_wild_is_drawn_checked_and_tiled(data):
    pad = data.draw(pads((1, 2), (0, 8)))
    contact = data.draw(contacts())
    rules = RulesSettings(
        min_bend_radius_mm=data.draw(st.sampled_from([0.0, 1e-9, 1.0, 1000.0])),
        min_gap_mm=data.draw(st.sampled_from([0.0, 1e-9, 0.8, 1000.0])),
        max_crossings=data.draw(st.sampled_from([None, 0, 3])),
        min_crossing_angle_deg=data.draw(st.sampled_from([0.0, 1e-9, 45.0, 90.0])),
        border_mm=data.draw(st.sampled_from([0.0, 2.0, 1000.0])),
        max_length_mm=data.draw(st.sampled_from([1e-300, 10.0, 1e6])),
    )
    with ends_in_time():
        found = check_rules(pad, rules)
        finite([[violation.measured, violation.limit] for violation in found])
        draw_plan(pad, contact, found).draw_without_rendering()
        assert pad.tiled(2).grid == 2 * pad.grid


@settings(few(10), suppress_health_check=LAX)
@given(st.data())
def test_a_pad_however_wild_has_a_finite_score(data):
    pad, contact = data.draw(pads((1, 2), (0, 8))), data.draw(contacts())
    rules = RulesSettings(
        same_family_crossings=data.draw(st.sampled_from([0, 2])),
        max_crossings=data.draw(st.sampled_from([None, 4])),
        min_crossing_angle_deg=data.draw(st.sampled_from([0.0, 30.0])),
    )
    with ends_in_time():
        numbers(
            score(
                pad,
                contact,
                data.draw(st.sampled_from([0, 3, 8])),
                data.draw(st.sampled_from([1e-9, 0.1, 10.0])),
                rules,
            ),
            {},
        )


@settings(few(3), suppress_health_check=LAX)
@given(st.data())
def test_a_short_search_of_any_settings_gives_a_pad(data):
    grid = data.draw(st.integers(1, 2))
    knots = data.draw(st.sampled_from([1, 2, 5, 64]))
    origin = data.draw(st.none() | pads((grid, grid), (0, knots)))
    asked = SearchSettings(
        method=data.draw(st.sampled_from(["descent", "descent", "genetic"])),
        knots=knots,
        starts=data.draw(st.integers(1, 2)),
        steps=2,
        population=data.draw(st.sampled_from([4, 7])),
        generations=2,
        seed=data.draw(st.sampled_from([0, 2**32 - 1])),
        lost=data.draw(st.sampled_from([0, 8, (0.0, 1.0), (1e-300, 1e6), (5e-324,)])),
        noise=data.draw(st.sampled_from([1e-9, 0.1, 10.0])),
        sharpness=data.draw(st.sampled_from([0.0, 1e-3, 1e6])),
    )
    rules = RulesSettings(
        enforce=data.draw(st.booleans()),
        min_bend_radius_mm=data.draw(st.sampled_from([0.0, 1.0, 1000.0])),
        min_gap_mm=data.draw(st.sampled_from([0.0, 0.8, 1000.0])),
        border_mm=data.draw(st.sampled_from([0.0, 2.0, 1000.0])),
        max_length_mm=data.draw(st.sampled_from([1e-300, 10.0, 1e6])),
    )
    with ends_in_time(20):
        found = search(
            PadSettings(grid=grid, pitch_mm=data.draw(st.sampled_from([0.1, 11.25, 1000.0]))),
            data.draw(contacts()),
            asked,
            rules,
            origin=origin,
            run=SearchRun(time_budget=3.0),
        )
    a_pad(found.morphology, {})
    numbers(found.terms, {})


def test_a_pad_of_too_many_knots_to_score_is_refused():
    with ends_in_time(), pytest.raises(InputError, match="too many"):
        score(Morphology.random(16, 3000, seed=0), lost=0)


@settings(few(20), suppress_health_check=LAX)
@given(st.data())
def test_signals_do_not_depend_on_how_presses_are_laid_out(data):
    pad, contact = data.draw(pads()), data.draw(contacts())
    places = data.draw(presses(pad))
    plain = np.array(places, dtype=np.float64).reshape(-1, 2)
    with ends_in_time():
        assert (signals(pad, places, contact) == signals(pad, plain.copy(), contact)).all()
        assert (signals_sparse(pad, places, contact).toarray() == signals(pad, plain, contact)).all()
