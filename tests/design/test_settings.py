"""`pad.toml`: defaults, comments, refusals."""

import re
import tomllib

import numpy as np
import pytest

from design import (
    Contact,
    InputError,
    Morphology,
    Spec,
    localisation_error,
    published_objective,
    score,
    signals,
    signals_quantized,
    signals_sparse,
)
from design.common.settings import commented_toml
from design.criteria.information import information
from design.pad.kernels.press import profile_of, profile_weights
from design.settings import (
    MEASURED_REACH,
    PUBLISHED_CONTACT,
    Layout,
    PadSettings,
    RulesSettings,
    SearchSettings,
    sensed_rectangle,
)
from tests.helpers.limits import require_ends

MODELS = {model.section(): model for model in (PadSettings, Contact, SearchSettings, RulesSettings)}


def test_the_written_defaults_read_back_as_the_defaults():
    text = commented_toml(MODELS)
    spec = Spec(tomllib.loads(text))
    for model in MODELS.values():
        assert spec.section(model) == model()
    for name, model in MODELS.items():
        assert f"[{name}]" in text
        for key, field in model.model_fields.items():
            assert any(line.startswith(f"{key} = ") and str(field.description) in line for line in text.splitlines())


@pytest.mark.parametrize(
    ("tables", "model", "message"),
    [
        ({"pads": {}}, PadSettings, r"unknown section \[pads\], allowed are pad, contact"),
        ({"pad": {"gird": 4}}, PadSettings, r"\[pad\] gird: no such key, allowed are grid"),
        ({"pad": {"grid": 0}}, PadSettings, r"\[pad\] grid: got 0, .*greater than or equal to 1"),
        ({"pad": {"pitch_mm": float("nan")}}, PadSettings, r"\[pad\] pitch_mm: got nan, .*finite"),
        ({"pad": {"grid": "4"}}, PadSettings, r"\[pad\] grid: got '4', .*integer"),
        ({"contact": {"sides": 2}}, Contact, r"\[contact\] sides: got 2"),
        ({"contact": {"weight": "cubic"}}, Contact, r"\[contact\] weight: got 'cubic', .*inverse_square"),
        ({"contact": {"reach": [[0, 1], [1, 0]]}}, Contact, r"\[contact\] reach: got .*3 points or more"),
        ({"contact": {"reach": [[0, 1], [1, 0.5], [1, 0]]}}, Contact, r"\[contact\] reach: .*distances ascend from 0"),
        ({"contact": {"reach": [[0, 1], [1, 0.5], [2, 0.1]]}}, Contact, r"\[contact\] reach: .*last weight must be 0"),
        ({"search": {"method": "luck"}}, SearchSettings, r"\[search\] method: got 'luck', .*descent"),
        ({"rules": 3}, RulesSettings, r"rules is 3, expected a section \[rules\]"),
    ],
)
def test_refusals_name_the_key_the_value_and_what_is_allowed(tables, model, message):
    with pytest.raises(InputError, match=message) as refusal:
        Spec(tables, sections=MODELS).section(model)
    assert "\n" not in str(refusal.value)


def test_a_circle_is_written_and_read_as_a_word():
    assert Spec({"contact": {"sides": "circle"}}).section(Contact).sides is None
    assert Contact(sides=None).model_dump()["sides"] == "circle"


def test_a_measured_reach_is_read_from_a_table_of_points():
    points = [[0, 1], [0.5, 0.4], [1.25, 0]]
    assert Spec({"contact": {"reach": points}}).section(Contact).reach == ((0.0, 1.0), (0.5, 0.4), (1.25, 0.0))


def test_overrides_win_over_the_file():
    spec = Spec({"search": {"knots": 7, "seed": 3}})
    found = spec.section(SearchSettings, knots=2, seed=None)
    assert (found.knots, found.seed) == (2, 3)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[pad", b"= 3"])
def test_files_that_are_no_toml_are_refused(tmp_path, content):
    path = tmp_path / "pad.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"pad\.toml: not a TOML file"):
        Spec.load(path)


def test_a_key_that_has_moved_is_told_where_it_is():
    with pytest.raises(InputError) as error:
        Spec({"pad": {"fibre_diameter_mm": 0.3}}, "pad.toml").section(PadSettings)
    assert str(error.value) == "pad.toml: [pad] fibre_diameter_mm: no such key, it is [fibre] diameter_mm now"


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        Spec.load(tmp_path / "none.toml")


def test_the_defaults_are_what_a_built_pad_showed_and_what_can_be_built():
    assert PadSettings().model_dump() == {
        "grid": 4,
        "horizontals": "grid",
        "verticals": "grid",
        "pitch_mm": 11.25,
        "deep_family": "horizontal",
        "leads": "edges",
        "sensed_mm": "beyond",
        "keep_out_mm": (),
        "bent_radius_mm": "flat",
    }
    published = {"radius": 0.6, "sides": 30, "weight": "uniform", "length": "manhattan", "reach": ()}
    assert PUBLISHED_CONTACT.model_dump() == published
    assert Contact().model_dump() == published | {"length": "euclidean", "reach": MEASURED_REACH}
    assert RulesSettings().model_dump() == {
        "enforce": True,
        "min_bend_radius_mm": 1.0,
        "min_gap_mm": 0.8,
        "same_family_crossings": 0,
        "max_crossings": "any",
        "min_crossing_angle_deg": 0.0,
        "max_common_track_mm": 2.0,
        "border_mm": 2.0,
        "keep_out_mm": 1.5,
        "max_length_mm": 500.0,
    }
    search = SearchSettings().model_dump()
    assert (search["knots"], search["starts"], search["steps"]) == (21, 4, 1000)
    assert (search["population"], search["generations"], search["seed"]) == (200, 50, 0)
    assert (search["weights"], search["presses"], search["levels"]) == ((1.0, 1e-7, 5e-6), 7, 4096)
    assert (search["lost"], search["noise"], search["sharpness"]) == (3, 0.02, 0.0)


@pytest.mark.parametrize(
    ("model", "key", "kept", "refused"),
    [
        (PadSettings, "grid", (1, 64), (0,)),
        (PadSettings, "sensed_mm", ("beyond", "fibres", (56.25, 0.1)), ("all", (0.0, 1.0), (1.0, 56.3), (1.0,), 5.0)),
        (Contact, "sides", (3,), (2,)),
        (SearchSettings, "lost", (0, (0.0, 1.0)), (-1, (0.0, 0.0), (-1.0, 2.0))),
        (SearchSettings, "noise", (1e-9, 10.0), (0.0, 10.1)),
        (SearchSettings, "weights", ((1.0, 0.0, 0.0), (0.0, 1e6, 5e-324)), ((0.0, 0.0, 0.0), (-1.0, 1.0, 1.0), (1.0,))),
        (SearchSettings, "presses", (2, 64), (1, 65)),
        (SearchSettings, "levels", (1, 2**24), (0, 2**24 + 1)),
        (SearchSettings, "seed", (0, 2**32 - 1), (-1, 2**32)),
        (RulesSettings, "min_crossing_angle_deg", (0.0, 90.0), (-0.1, 90.1)),
        (RulesSettings, "min_gap_mm", (0.0, 1000.0), (-0.1, 1000.1)),
        (RulesSettings, "max_length_mm", (1e-6, 1e6), (0.0, 1.1e6)),
        (RulesSettings, "same_family_crossings", (0, 10**6), (-1,)),
        (RulesSettings, "max_crossings", (0, "any"), (-1, "all")),
    ],
)
def test_values_at_the_ends_of_what_is_allowed(model, key, kept, refused):
    require_ends(model, key, kept, refused)


def test_what_is_pressed_lies_about_the_middle_of_the_pad():
    assert sensed_rectangle(Layout.of(4)) == PadSettings().sensed == ((0.5, 0.5), (4.5, 4.5))
    assert sensed_rectangle(Layout.of(4), "fibres") == ((1, 1), (4, 4))
    assert sensed_rectangle(Layout.of(1), "fibres") == ((0.5, 0.5), (1.5, 1.5))
    assert PadSettings(grid=3, pitch_mm=2, sensed_mm=(8, 3)).sensed == ((0, 1.25), (4, 2.75))
    again = PadSettings.model_validate_json(PadSettings(sensed_mm=(40, 20)).model_dump_json())
    np.testing.assert_allclose(again.sensed, [(2.5 - 16 / 9, 2.5 - 8 / 9), (2.5 + 16 / 9, 2.5 + 8 / 9)])


def test_what_is_pressed_is_no_larger_than_the_pad():
    spec = Spec({"pad": {"grid": 2, "pitch_mm": 10, "sensed_mm": [31, 5]}}, "pad.toml")
    expected = r"pad\.toml: \[pad\] sensed_mm: got \[31, 5\], .*the pad itself is 30 mm wide and high"
    with pytest.raises(InputError, match=expected):
        spec.section(PadSettings)


@pytest.mark.parametrize(
    ("pad", "message"),
    [
        ({"horizontals": 0, "verticals": 0}, "horizontals and verticals are both 0, allowed is one fibre or more"),
        ({"horizontals": -1}, r"\[pad\] horizontals: got -1"),
        ({"verticals": 257}, r"\[pad\] verticals: got 257"),
        ({"pitch_mm": 0}, r"\[pad\] pitch_mm.*: got 0"),
        (
            {"pitch_mm": [8, 0]},
            r"\[pad\] pitch_mm: got .8, 0., .*allowed is 0.1 to 1000, or .along x, along y.",
        ),
        ({"pitch_mm": [8, 9, 10]}, r"\[pad\] pitch_mm"),
        ({"horizontals": 2, "pitch_mm": [8, 15], "sensed_mm": [40, 46]}, "the pad itself is 45 mm high"),
        ({"keep_out_mm": [[0, 0], [1, 1]]}, r"\[pad\] keep_out_mm"),
        ({"keep_out_mm": [[[0, 0], [1, 1]]]}, r"\[pad\] keep_out_mm: .*polygon 1 has 2 corners"),
        ({"keep_out_mm": "hole"}, r"\[pad\] keep_out_mm"),
        ({"bent_radius_mm": 0.5}, r"\[pad\] bent_radius_mm.*: got 0.5"),
        ({"bent_radius_mm": "round"}, r"\[pad\] bent_radius_mm.*: got 'round'"),
    ],
)
def test_rectangles_that_are_none_are_refused_in_one_line(pad, message):
    with pytest.raises(InputError, match=message) as refused:
        Spec({"pad": pad}, "pad.toml").section(PadSettings)
    assert "\n" not in str(refused.value)


def test_a_rectangle_is_stated_and_written_and_is_what_was_stated():
    pad = {"horizontals": 3, "verticals": 6, "pitch_mm": [8, 15], "bent_radius_mm": 40}
    hole = {"keep_out_mm": [[[0, 0], [4, 0], [0, 4]]]}
    stated = Spec({"pad": pad | hole}).section(PadSettings)
    assert stated.layout == Layout(3, 6, 8.0, 15.0)
    assert stated.sensed == sensed_rectangle(stated.layout)
    assert Spec(tomllib.loads(commented_toml({"pad": PadSettings}, {"pad": stated}))).section(PadSettings) == stated
    assert PadSettings.model_validate_json(stated.model_dump_json()) == stated
    assert stated.of(Layout.of(4)).layout == Layout.of(4)
    assert PadSettings(grid=5, verticals=0).layout.counts == (5, 0)


def test_a_contact_given_by_its_shape_is_of_the_published_kind():
    """As it was before contacts were measured, and where it is written out, whatever it is, it reads back so."""
    ways = (
        ({}, MEASURED_REACH, "euclidean"),
        ({"length": "manhattan"}, MEASURED_REACH, "manhattan"),
        ({"reach": [[0, 1], [0.5, 0.25], [1, 0]]}, ((0, 1), (0.5, 0.25), (1, 0)), "euclidean"),
        ({"radius": 0.6}, (), "manhattan"),
        ({"sides": "circle"}, (), "manhattan"),
        ({"weight": "inverse", "length": "euclidean"}, (), "euclidean"),
        ({"reach": []}, (), "manhattan"),
    )
    for given, reach, length in ways:
        contact = Spec({"contact": given}).section(Contact)
        assert (contact.reach, contact.length) == (reach, length), given
        assert Contact.model_validate_json(contact.model_dump_json()) == contact
        assert Contact.model_validate(contact.model_dump()) == contact
        search = SearchSettings(contacts=(contact, Contact(radius=0.9)))
        assert SearchSettings.model_validate_json(search.model_dump_json()) == search
        assert (
            Spec(tomllib.loads(commented_toml({"contact": Contact}, {"contact": contact}))).section(Contact) == contact
        )


@pytest.mark.parametrize("shape", [{"radius": 0.9}, {"sides": "circle"}, {"weight": "inverse"}])
def test_a_shape_beside_a_reach_is_refused_since_it_would_change_nothing(shape):
    stated = tomllib.loads(commented_toml({"contact": Contact}))["contact"]
    with pytest.raises(InputError, match=r"\[contact\] reach: .*which counts where reach is \[\]"):
        Spec({"contact": stated | shape}).section(Contact)
    assert Spec({"contact": stated | shape | {"reach": []}}).section(Contact).reach == ()


def test_the_measured_profile_is_in_mm_and_in_grid_units_of_the_built_pad_in_fifths():
    distance = [d for d, _ in Contact().profile_points(11.25)]
    assert distance == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.65]  # to the bit
    assert [d for d, _ in Contact().profile_points(5.0)] == [d / 5 for d, _ in MEASURED_REACH]


def test_the_measured_reach_is_about_a_gaussian():
    distance = np.linspace(0, 22, 400)
    weight = profile_weights(profile_of(MEASURED_REACH), MEASURED_REACH[-1][0], distance)
    np.testing.assert_allclose(weight, np.exp(-(distance**2) / (2 * 6.2**2)), atol=0.015)
    assert (np.diff(weight) <= 1e-12).all()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (
            [[0, 1], [0.5, 0.8], [0.51, 0.6], [1.2, 0]],
            "between the points at 0 and 0.5 mm their spline comes to 1.77, allowed is 0.65 to 1.15",
        ),
        ([[0, 10], [9, 10], [10, 0]], "between the points at 0 and 9 mm their spline comes to 20.5, allowed is 8.5"),
        ([[0, -1], [0.2, 1], [1, 0]], "between the points at 0.2 and 1 mm their spline comes to 7.48, allowed is"),
    ],
)
def test_a_profile_whose_spline_leaves_its_points_is_refused(points, message):
    with pytest.raises(InputError, match=rf"^pad\.toml: \[contact\] reach: got .*{re.escape(message)}") as refused:
        Spec({"contact": {"reach": points}}, "pad.toml").section(Contact)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("points", [5, 7, 13, 40])
@pytest.mark.parametrize("skirt", [0.0, 0.05, 0.3])
def test_a_smooth_profile_with_a_skirt_below_0_is_a_contact(points, skirt):
    distance = np.linspace(0, 18, points)
    weight = np.exp(-0.5 * (distance / 5) ** 2) - skirt * np.exp(-0.5 * ((distance - 13) / 2.5) ** 2)
    reach = np.column_stack([distance, np.append(weight[:-1], 0)]).tolist()
    assert len(Contact(reach=reach).reach) == points


@pytest.mark.parametrize(
    ("model", "given", "plain"),
    [
        (PadSettings, {"grid": np.int64(3)}, {"grid": 3}),
        (
            PadSettings,
            {"pitch_mm": np.array([8, 15.0]), "horizontals": np.uint8(0)},
            {"pitch_mm": (8, 15.0), "horizontals": 0},
        ),
        (
            PadSettings,
            {"keep_out_mm": [np.array([[0, 0], [4, 0], [0, 4]])]},
            {"keep_out_mm": [[[0, 0], [4, 0], [0, 4]]]},
        ),
        (Contact, {"radius": np.float64(0.9), "sides": np.int32(4)}, {"radius": 0.9, "sides": 4}),
        (Contact, {"reach": np.array([[0, 1], [5, 0.5], [12, 0]])}, {"reach": ((0, 1), (5, 0.5), (12, 0))}),
        (SearchSettings, {"lost": np.array([0.5, 0.5]), "seed": np.uint32(7)}, {"lost": (0.5, 0.5), "seed": 7}),
        (SearchSettings, {"contacts": ({"radius": np.float32(0.5)},)}, {"contacts": (Contact(radius=0.5),)}),
        (RulesSettings, {"enforce": np.bool_(False)}, {"enforce": False}),
    ],
)
def test_numbers_of_numpy_are_numbers(model, given, plain):
    assert model(**given) == Spec({}).section(model, **given) == model(**plain)
    assert model(**given).model_dump_json() == model(**plain).model_dump_json()


@pytest.mark.parametrize(
    "grid", [np.float64(4), np.int64(0), np.array([4]), np.bool_(True), np.datetime64("2026-01-01")]
)
def test_values_of_numpy_that_are_no_such_number_are_refused_as_pythons_are(grid):
    with pytest.raises(InputError, match=r"^\[pad\] grid: got "):
        PadSettings(grid=grid)


@pytest.mark.parametrize(("model", "key"), [(Contact, "length"), (Contact, "reach"), (SearchSettings, "lost")])
def test_an_array_that_no_memory_holds_as_a_list_is_refused(model, key):
    with pytest.raises(InputError, match=rf"^\[{model.section()}\] {key}.*: got array") as raised:
        model(**{key: np.broadcast_to(1.0, (2**40, 2))})
    assert len(str(raised.value).splitlines()) == 1


def test_a_list_that_holds_itself_is_refused():
    endless = []
    endless.append(endless)
    with pytest.raises(InputError, match=r"\[pad\] keep_out_mm"):
        Spec({}).section(PadSettings, keep_out_mm=endless)


def test_functions_that_restate_the_paper_have_its_contact_by_default():
    pad, presses = Morphology.random(2, 3, seed=0), [[1.2, 1.7], [2.0, 0.8]]
    np.testing.assert_array_equal(signals_quantized(pad, presses), signals_quantized(pad, presses, PUBLISHED_CONTACT))
    assert published_objective(pad) == published_objective(pad, PUBLISHED_CONTACT)
    few = {"lost": (1,), "presses": 64, "test": 50, "hidden": 4, "subsets": 1}
    assert localisation_error(pad, **few) == localisation_error(pad, PUBLISHED_CONTACT, **few)


def test_signals_have_the_measured_contact_by_default_as_scores_have():
    pad, presses = Morphology.random(2, 3, seed=0), [[1.2, 1.7], [2.0, 0.8]]
    measured = signals(pad, presses, Contact())
    np.testing.assert_array_equal(signals(pad, presses), measured)
    np.testing.assert_array_equal(signals_sparse(pad, presses).toarray(), measured)
    assert information(pad) == information(pad, Contact()) == score(pad, lost=0)["information"]


def test_what_is_designed_for_unless_asked_is_measured_but_by_the_published_method():
    assert SearchSettings().usual_contact == Contact()
    assert SearchSettings(method="genetic").usual_contact == PUBLISHED_CONTACT
    terms = score(Morphology.random(2, 3, seed=0), lost=0)
    published = score(Morphology.random(2, 3, seed=0), PUBLISHED_CONTACT, lost=0)
    for name in terms:
        assert (terms[name] == published[name]) == name.startswith(("published", "penalty")), name


def test_keys_of_very_many_parts_are_refused_at_once(tmp_path):
    path = tmp_path / "pad.toml"
    path.write_text("a" + ".a" * 100_000 + " = 1")
    with pytest.raises(InputError, match="a line has more than 200 dots"):
        Spec.load(path)


@pytest.mark.parametrize("other", [None, 3, "a", int, np.ones((2, 2)), [1], {1: 2}])
def test_what_is_no_section_and_no_table_is_refused(other):
    for ask in (Spec({}).section, Spec({}).given):
        with pytest.raises(InputError, match=r"model is .*, expected a section"):
            ask(other)
    for tables in (other, {"pad": other}):
        with pytest.raises(InputError, match=r"expected a (table|section)"):
            Spec({}).replaced(tables)
    for sections in (3, [3], {None}, np.ones(2)):
        with pytest.raises(InputError, match=r"sections (is|are)"):
            Spec({"pad": {}}, sections=sections)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"unknown section \[pad\]"):
        Spec({"pad": {}}, sections=np.array([]))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("sections", [np.array(3.0), [3], 7, {None}])
def test_names_of_sections_that_are_none_are_refused(sections):
    with pytest.raises(InputError, match=r"sections (is|are) "):
        Spec({}, "pad.toml", sections)
