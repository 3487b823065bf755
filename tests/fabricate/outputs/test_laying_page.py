import math
import re
from itertools import pairwise

import numpy as np
import pytest
import shapely
from scipy.integrate import quad

from padforge.design.morphology import Morphology
from padforge.fabricate import MouldSettings, Plan, PrinterSettings, build
from padforge.fabricate.mesh import mould_mesh
from padforge.fabricate.outputs import laying_page as laying
from tests.fabricate.planted import exact_fibre, with_settings


def straight_volume_mm3(draft_deg: float) -> float:
    """Integrate the default mould of the straight pad of 4 + 4 without numbers over its height."""
    lean, half, height = math.tan(math.radians(draft_deg)), 28.125, 6.0

    def layer(z: float) -> float:
        reach = half + 2 + lean * z
        open_mm2 = 4 * (half + lean * z) ** 2 + 16 * 2 * (3 + 2 * lean * z)
        deep, shallow = 4 * (z < 1.2), 4 * (z < 0.4)
        return open_mm2 - (deep + shallow) * 2 * reach * 0.4 + deep * shallow * 0.4**2

    bounds = [0, 0.4, 1.2, height]
    return sum(quad(layer, *stretch)[0] for stretch in pairwise(bounds))


@pytest.mark.parametrize("draft_deg", [0.0, 10.0])
def test_silicone_fills_straight_pad(draft_deg):
    plan = Plan(Morphology.straight(4), with_settings({"wall_draft_deg": draft_deg, "number_mm": 0.0}))
    silicone = laying.laying_document(plan, mould_mesh(plan).volume())["silicone"]
    expected = straight_volume_mm3(draft_deg) / 1000
    assert silicone["volume_ml"] == pytest.approx(expected, abs=1e-3)
    assert silicone["mass_g"] == pytest.approx(expected * 1.07 * 1.1, abs=0.02)
    assert silicone["part_a_g"] == silicone["part_b_g"] == pytest.approx(silicone["mass_g"] / 2)
    other = with_settings(plan.settings.mould.model_dump(), silicone={"density_g_per_ml": 1.3, "parts": [10.0, 1.0]})
    mixed = laying.laying_document(Plan(plan.pad, other), mould_mesh(plan).volume())["silicone"]
    assert mixed["mass_g"] == pytest.approx(expected * 1.3 * 1.1, abs=0.02)
    assert mixed["part_a_g"] == pytest.approx(10 * mixed["part_b_g"], abs=0.06)


@pytest.mark.parametrize("mould", [{}, {"border_mm": 1.5, "exit_mm": 0.0, "lead_mm": 12.5}])
def test_lengths_match_curves(mould):
    plan = Plan(Morphology.random(3, 4, seed=3), with_settings(mould))
    tongue = plan.settings.mould.border_mm + plan.settings.mould.exit_mm
    for fibre, entry in enumerate(laying.laying_document(plan, 1.0)["fibres"]):
        length = shapely.LineString(exact_fibre(plan.pad, fibre)).length
        assert entry["in_pad_mm"] == pytest.approx(length + 2 * tongue, abs=0.006)
        assert entry["cut_mm"] == pytest.approx(entry["in_pad_mm"] + 2 * plan.settings.mould.lead_mm, abs=0.011)


def test_common_tracks_are_listed_from_twice_a_right_angled_crossing_on(tmp_path):
    """Straight ones have 0.8 mm in common; a vertical that crosses at 25 degrees 1.9 mm, at 35 degrees 1.4 mm."""
    document = build(Morphology.straight(4), tmp_path, []).to_dict()
    assert document["common_tracks"] == []
    assert "over a deeper one" not in laying.laying_page(document)
    for angle_deg, listed in ((25, True), (35, False)):
        shift = 0.2 / 3 / math.tan(math.radians(angle_deg))
        vertical = [[1, 0], [1 - shift, 0.9], [1 + shift, 1.1], [1, 2]]
        pad = Morphology(np.array([[[0, 1], [0.5, 1], [1.5, 1], [2, 1]], vertical]), 20.0)
        document = build(pad, tmp_path, []).to_dict()
        assert bool(document["common_tracks"]) == listed
        if listed:
            (track,) = document["common_tracks"]
            assert (track["shallow"], track["deep"]) == (2, 1)
            assert track["position_mm"] == pytest.approx([0, 0], abs=1e-3)
            rows = re.findall(r"^\| (\d+ over \d+) \|.*\| (.*) \|$", laying.laying_page(document), re.MULTILINE)
            assert rows == [("2 over 1", f"{track['length_mm']:.1f} mm")]


@pytest.mark.parametrize("draft_deg", [0.0, 5.0])
def test_adhesive_fills_tracks(draft_deg):
    plan = Plan(Morphology.straight(4), with_settings({"ridge_draft_deg": draft_deg}))
    steps = laying.laying_document(plan, 1.0)["adhesive"]["steps_ml"]
    for step, height in zip(steps, (1.2, 0.4), strict=True):
        width = 0.4 + height * math.tan(math.radians(draft_deg))
        assert 1000 * step == pytest.approx(4 * 60.25 * width * height, abs=0.06)


def test_slicer_settings(golden):
    """What is left of the floor are whole layers; two lines of a ridge are at least 0.85 nozzles wide."""
    variants: list[tuple[dict, dict]] = [
        ({}, {}),
        ({"floor_mm": 2, "wall_mm": 0.8}, {"layer_mm": 0.3, "nozzle_mm": 0.4}),
        ({"floor_mm": 2.05, "wall_mm": 20.0}, {}),
        ({"floor_mm": 0.4}, {"layer_mm": 0.2, "nozzle_mm": 1}),
        ({"ridge_width_mm": 0.65, "lid": True}, {}),
        ({"ridge_width_mm": 0.68}, {"nozzle_mm": 0.4}),
        ({}, {"nozzle_mm": 0.6}),
    ]
    lines, usual = [" | ".join(laying.PRINT_SETTINGS_HEAD)], set[str]()
    for mould, printer in variants:
        found = laying.print_settings_rows(MouldSettings(**mould), PrinterSettings(**printer))
        rows = [" | ".join(row) for row in found]
        lines += [f"{mould} {printer}", *(f"  {row}" for row in rows if row not in usual)]
        usual = usual or {*rows}
    golden("fabricate/slicer_settings.txt", "\n".join(lines))


def make_document(**changes: object) -> dict:
    """A document whose every number is another one, so that none can stand in the place of another."""
    names, entries = ("horizontal 1", "vertical 1"), []
    for number, (name, depth, length) in enumerate(zip(names, (1.75, 0.25), (50.04, 60.0), strict=True), 1):
        lengths = {"in_pad_mm": length, "cut_mm": length + 40.02, "depth_mm": depth}
        entries.append({"number": number, "fibre": name, "resistance_ohm": 999.4, "divider_ohm": 0.5} | lengths)
    entries[1] |= {"resistance_ohm": 2.5e6, "divider_ohm": 2.4e6}
    return {
        "files": ["mould.stl"],
        "size_mm": [40.5, 30.126, 8.0],
        "sizes": {"pad_mm": [33.75, 30.5]},
        "mould_volume_ml": 10.0,
        "findings": [{"name": "thin", "status": "warn", "message": "thin walls", "positions_mm": [[1.0, 2.0]]}],
        "settings": {
            "mould": MouldSettings(lead_mm=20.0, holder=True).model_dump(),
            "printer": PrinterSettings(resin=True, nozzle_mm=0.4).model_dump(),
            "pad": {"leads": "edges", "horizontals": 1, "verticals": 1, "keep_out_mm": [[9.0, 5.0, 4.0]]},
        },
        "silicone": {"name": "Goo", "part_a_g": 3.04, "part_b_g": 1.96, "volume_ml": 4.56, "thickness_mm": 6.125}
        | {"mass_g": 5.0, "surplus_percent": 12, "shrinkage": 0.013, "pot_life_min": 91, "cure_h": 1.5},
        "adhesive": {"name": "glue", "volume_ml": 0.6, "steps_ml": [0.4, 0.2]},
        "order": {"fibre_m": 0.234, "waste_percent": 17, "plastic_g": 13.4, "print_h": 1.34, "laying_h": 2.26},
        "fibre": {"name": "soft thread", "diameter_mm": 0.35, "ohm_per_mm": 20.0}
        | {"max_strain": 0.45, "min_bend_radius_mm": None},
        "fibres": entries,
        "laying_order": [[1], [2]],
        "crossings": {"total": 1, "same_family": 0, "gap_mm": 1.2, "columns": []}
        | {"table": [["horizontal 1", "vertical 1", -3.04, 7.06, 1.75, 0.25, 1.2]]},
        "common_tracks": [{"shallow": 2, "deep": 1, "length_mm": 2.34, "position_mm": [-1.5, 4.5]}],
    } | changes


def make_crowded_document() -> dict:
    """A document with more crossings and common tracks than have room, whose fibres touch."""
    row, upper = ["horizontal 1", "vertical 1", 0, 0, 1.75, 0.25, 1.2], ["vertical 1", "horizontal 1", 0, 0, 0.25, 2.5]
    crossings = {"total": 25, "same_family": 7, "gap_mm": -0.1, "table": [row] * 20 + [[*upper, -0.1]] * 5}
    tracks = [{"shallow": 2, "deep": 1, "length_mm": float(mm), "position_mm": [0.0, 0.0]} for mm in range(26, 0, -1)]
    plain = {"name": "thread", "diameter_mm": 0.35, "ohm_per_mm": 20.0, "max_strain": None, "min_bend_radius_mm": None}
    return make_document(crossings=crossings, common_tracks=tracks, fibre=plain)


def make_document_of_one_family() -> dict:
    document = make_document(crossings={"total": 0}, common_tracks=[])
    document["settings"]["pad"] |= {"horizontals": 0, "verticals": 3, "keep_out_mm": []}
    return document


@pytest.mark.parametrize(
    ("name", "make"),
    [("few", make_document), ("crowded", make_crowded_document), ("one_family", make_document_of_one_family)],
)
def test_page_of_a_document(name, make, golden):
    golden(f"fabricate/laying_{name}.md", laying.laying_page(make()))
