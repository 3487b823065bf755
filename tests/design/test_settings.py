import tomllib
from typing import Any

import numpy as np
import pytest

from padforge import InputError, Spec, design
from padforge.common.settings import commented_toml
from padforge.design import Contact, Morphology, PadSettings, RulesSettings, SearchSettings, signals
from padforge.design.settings import PUBLISHED_CONTACT, Layout, Scatter, read_contact, sensed_rectangle
from tests.helpers.golden import Golden

MODELS = {model.section(): model for model in (PadSettings, Contact, SearchSettings, RulesSettings)}
REFUSED = {
    PadSettings: [
        *({"grid": 0}, {"gird": 4}, {"horizontals": 0, "verticals": 0}, {"bent_radius_mm": "round"}),
        *({"pitch_mm": float("nan")}, {"pitch_mm": [8, 0]}),
        {"horizontals": 2, "pitch_mm": [8, 15], "sensed_mm": [40, 46]},
        {"grid": 2, "pitch_mm": 10, "sensed_mm": [31, 5]},
        *(
            {"keep_out_mm": shape}
            for shape in ("hole", [[0, 0, 5, 3]], [[0, 0, 0]], [[20, 0, 3], [27, 0, 2, 4]], [[0, 0]])
        ),
        {"size_mm": [120, 30], "pitch_mm": 8},
        *({"size_mm": size} for size in ([120, 0.2], [120], [120, 0], "large")),
    ],
    Contact: [
        *({"weight": "cubic"}, {"model": "half-space"}, {"tool": "cone"}, {"depth_mm": 6}, {"thickness_mm": 4}),
        *({"fibre_depths_mm": [1, 6.5]}, {"fibre_depths_mm": [1, 0]}, {"squeeze": 0, "stretch": 0}),
        *({"length": "manhattan"}, {"model": "layer", "radius": 0.9}, {"radius": 0.9, "depth_mm": 2}),
        *({"model": "profile", "scale": 2}, {"model": "shape", "tool": "ball"}),
        *({"sensitivity_profile": [[0, 1], *rest]} for rest in ([[1, 0]], [[1, 0.5], [1, 0]], [[1, 0.5], [2, 0.1]])),
        # whose splines leave their points
        *({"sensitivity_profile": points} for points in ([[0, 10], [9, 10], [10, 0]], [[0, -1], [0.2, 1], [1, 0]])),
    ],
    SearchSettings: [  # whose messages name the whole path of a key
        *({"contacts": [{"radius": 0.9}, {"radius": -1}]}, {"contacts": [{"radius": 0.9, "height": 1}]}),
        *({"contacts": [{"model": "layer", "radius": 0.9}]}, {"contacts": [{"fibre_depths_mm": [1, 0]}]}),
        *({"contacts": 3}, {"contacts": "likely"}, {"weights": [1, "x", 1]}, {"max_failures": [0, 0]}),
    ],
    RulesSettings: [{"max_crossings": "none"}, {"max_common_track_mm": 0.8}],
}


def test_refusals_name_key_value_and_limits(golden: Golden) -> None:
    """In one line, of a file and of a model alike; a wrong override is not blamed on the file."""
    lines = []
    for model, table in ((model, table) for model, tables in REFUSED.items() for table in tables):
        with pytest.raises(InputError, match=r"^pad\.toml: [^\n]*$") as refused:
            Spec({model.section(): table}, "pad.toml", sections=MODELS).section(model)
        lines.append(str(refused.value))
    golden("design/settings_refusals.txt", "\n".join(lines))
    with pytest.raises(InputError, match=r"^\[search\] contacts\[1\]\.radius: got -1, .*greater"):
        SearchSettings(**REFUSED[SearchSettings][0])
    spec = Spec({"pad": {"grid": 2, "pitch_mm": 0}}, "pad.toml")
    with pytest.raises(InputError, match=r"^\[pad\] horizontals: got 300, input should be less than or equal to 256"):
        spec.section(PadSettings, horizontals=300, pitch_mm=8.0)
    with pytest.raises(InputError, match=r"^pad\.toml: \[pad\] pitch_mm: got 0"):
        spec.section(PadSettings, horizontals=3)


def test_holes_of_a_pad_are_polygons_around_their_screws():
    pad = PadSettings.model_validate({"keep_out_mm": [[1, 2, 3], [-9, 0, 3, 6], HOLE]})
    assert PadSettings.model_validate_json(pad.model_dump_json()) == pad
    round_, head, polygon = map(np.array, pad.keep_out_corners_mm)
    for corners, centre, diameter in ((round_, (1, 2), 3), (head, (-9, 0), 6)):
        away = np.linalg.norm(corners - centre, axis=1)
        assert diameter / 2 < away.min() == pytest.approx(away.max())
        assert away.max() < 1.002 * diameter / 2
    np.testing.assert_array_equal(polygon, HOLE)


HOLE = [[0, 0], [4, 0], [0, 4]]
PROFILE = [[0, 1], [0.5, 0.25], [1, 0]]
SHAPE = {"radius": 0.6, "sides": 30, "weight": "uniform"}


@pytest.mark.parametrize(
    ("stated", "model", "length"),
    [
        ({}, "layer", "euclidean"),
        ({"tool": "flat", "depth_mm": 1.0, "thickness_mm": 2.0}, "layer", "euclidean"),
        ({"model": "profile", "length": "manhattan"}, "profile", "manhattan"),
        ({"sensitivity_profile": np.array(PROFILE), "length": "manhattan"}, "profile", "manhattan"),
        ({"radius": 0.9}, "shape", "manhattan"),
        ({"sides": "circle"}, "shape", "manhattan"),
        ({"weight": "inverse", "length": "euclidean"}, "shape", "euclidean"),
        ({"sensitivity_profile": []}, "shape", "manhattan"),
        (SHAPE | {"length": "euclidean", "sensitivity_profile": PROFILE}, "profile", "euclidean"),
    ],
    ids=str,
)
def test_contact_model_follows_from_the_stated_keys(stated, model, length):
    """And wherever the contact is written out, it reads back so."""
    contact = Spec({"contact": stated}).section(Contact)
    assert (contact.model, contact.length) == (model, length)
    assert Contact.model_validate_json(contact.model_dump_json()) == contact
    search = SearchSettings(contacts=(contact, Contact(radius=0.9)))
    assert SearchSettings.model_validate_json(search.model_dump_json()) == search
    written = tomllib.loads(commented_toml({"contact": Contact}, {"contact": contact}))
    assert Spec(written).section(Contact) == contact


@pytest.mark.parametrize(
    ("tables", "thickness_mm", "depths_mm"),
    [
        ({}, 6.0, (1.05, 0.25)),
        ({"pad": {"deep_family": "vertical"}}, 6.0, (0.25, 1.05)),
        ({"mould": {"silicone_mm": 8, "deep_ridge_height_mm": 2.0}, "contact": {"depth_mm": 7.0}}, 8.0, (1.85, 0.25)),
        ({"mould": {"shallow_ridge_height_mm": 0.5}, "fibre": {"diameter_mm": 0.4}}, 6.0, (1.0, 0.3)),
        ({"mould": {"silicone_mm": 8.0}, "contact": {"thickness_mm": 7.0, "fibre_depths_mm": [2, 3]}}, 7.0, (2, 3)),
        ({"mould": {"silicone_mm": "thick"}}, 6.0, (1.05, 0.25)),
    ],
)
def test_unstated_lengths_of_contact_are_those_of_the_mould(tables, thickness_mm, depths_mm):
    contact = read_contact(Spec(tables))
    assert contact.thickness_mm == thickness_mm
    assert contact.fibre_depths_mm == pytest.approx(depths_mm)


def test_other_contacts_do_not_depend_on_the_mould():
    tables: list[dict[str, Any]] = [{"radius": 0.5}, {"model": "profile"}]
    for stated in tables:
        assert read_contact(Spec({"contact": stated, "mould": {"silicone_mm": 8.0}})) == Contact(**stated)
    with pytest.raises(InputError, match=r"^pad: \[contact\] .*depth_mm is 5, the pad is 4 mm thick"):
        read_contact(Spec({"mould": {"silicone_mm": 4.0}}, "pad"))


def test_gains_scatter_by_their_share_and_have_the_common_part_of_its_variance():
    gains = Scatter(floor=0.5, share=0.2, common=0.36).sample_gains((50_000, 3), np.random.default_rng(0))
    assert gains.mean(axis=0) == pytest.approx([1, 1, 1], abs=0.005)
    assert gains.std(axis=0) == pytest.approx([0.2] * 3, rel=0.02)
    expected = 0.36 + 0.64 * np.eye(3)
    np.testing.assert_allclose(np.corrcoef(gains.T), expected, atol=0.02)


def test_settings_accept_numpy_numbers():
    cases: tuple[tuple[Any, dict[str, Any], dict[str, Any]], ...] = (
        (PadSettings, {"grid": np.int64(3), "keep_out_mm": [np.array(HOLE)]}, {"grid": 3, "keep_out_mm": [HOLE]}),
        (SearchSettings, {"contacts": ({"radius": np.float32(0.5)},)}, {"contacts": (Contact(radius=0.5),)}),
    )
    for model, arrays, plain in cases:
        assert model(**arrays) == Spec({}).section(model, **arrays) == model(**plain)
        assert model(**arrays).model_dump_json() == model(**plain).model_dump_json()


def test_default_contact_is_a_layer_or_published():
    pad, presses = Morphology.random(1, 3, seed=0), [[1.2, 0.7], [0.5, 0.8]]
    np.testing.assert_array_equal(signals(pad, presses), signals(pad, presses, Contact()))
    assert design.published_objective(pad) == design.published_objective(pad, PUBLISHED_CONTACT)
    assert SearchSettings().default_contact == Contact()
    assert SearchSettings(method="genetic").default_contact == PUBLISHED_CONTACT


def test_pad_settings_set_layout_pitches_and_sensed_area():
    assert PadSettings(horizontals=3, verticals=6, pitch_mm=(8, 15)).layout == Layout(3, 6, 8.0, 15.0)
    assert PadSettings(grid=5, verticals=0).layout.counts == (5, 0)
    assert sensed_rectangle(Layout.create(4)) == PadSettings().sensed == ((0.5, 0.5), (4.5, 4.5))
    assert sensed_rectangle(Layout.create(4), "fibres") == ((1, 1), (4, 4))
    assert sensed_rectangle(Layout.create(1), "fibres") == ((0.5, 0.5), (1.5, 1.5))
    assert PadSettings(grid=3, pitch_mm=2, sensed_mm=(8, 3)).sensed == ((0, 1.25), (4, 2.75))
    pad = PadSettings(size_mm=(120, 30), horizontals=2, verticals=7)
    assert (pad.layout, pad.layout.size_mm) == (Layout(2, 7, 15.0, 10.0), (120, 30))
    assert pad == PadSettings(pitch_mm=(15, 10), horizontals=2, verticals=7)
    assert pad.for_layout(Layout.create(4)).layout == Layout.create(4)
    stated = Spec({"pad": {"size_mm": [60, 60], "grid": 5}})
    assert stated.section(PadSettings).layout == Layout.create(5, 10.0)
    assert stated.section(PadSettings, grid=2).layout == Layout.create(2, 20.0)
    assert stated.section(PadSettings, **Layout.create(3, 8.0).settings).layout == Layout.create(3, 8.0)
