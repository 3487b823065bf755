"""`laying.md` and its sections of `fabrication.json`: amounts and lengths by integration, and the texts."""

import math
import re
from itertools import pairwise

import numpy as np
import pytest
import shapely
from scipy.integrate import quad

from padforge.design.morphology import Morphology
from padforge.fabricate.export import build
from padforge.fabricate.mesh import mould_mesh
from padforge.fabricate.mould import sizes
from padforge.fabricate.outputs.drawings import CROSSING_LINK, ORIENTATION_FILE, orientation_sentence
from padforge.fabricate.outputs.laying_page import (
    PRINT_SETTINGS_HEAD,
    laying_document,
    laying_page,
    pad_document,
    print_settings_rows,
)
from padforge.fabricate.plan import Plan
from padforge.fabricate.settings import DEFAULTS, FabricationSettings, MouldSettings, PrinterSettings
from tests.fabricate.planted import exact_fibre, level_pad, with_settings


def fabrication_document(plan: Plan, findings: tuple[dict, ...] = ()) -> dict:
    """Return the parts of a fabrication document that the page reads."""
    volume = mould_mesh(plan.shrinkage_compensated).volume()
    return {
        "files": ["mould.stl"],
        "size_mm": [64.669, 64.669, 8.0],
        "sizes": sizes(plan),
        "mould_volume_ml": volume / 1000,
        "findings": list(findings),
        "settings": {
            "mould": plan.settings.mould.model_dump(),
            "printer": plan.settings.printer.model_dump(),
            "pad": pad_document(plan),
        },
        **laying_document(plan, volume),
    }


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
    silicone = laying_document(plan, mould_mesh(plan).volume())["silicone"]
    expected = straight_volume_mm3(draft_deg) / 1000
    assert silicone["volume_ml"] == pytest.approx(expected, abs=1e-3)
    assert silicone["mass_g"] == pytest.approx(expected * 1.07 * 1.1, abs=0.02)
    assert silicone["part_a_g"] == silicone["part_b_g"] == pytest.approx(silicone["mass_g"] / 2)
    other = with_settings(plan.settings.mould.model_dump(), silicone={"density_g_per_ml": 1.3, "parts": [10.0, 1.0]})
    mixed = laying_document(Plan(plan.pad, other), mould_mesh(plan).volume())["silicone"]
    assert mixed["mass_g"] == pytest.approx(expected * 1.3 * 1.1, abs=0.02)
    assert mixed["part_a_g"] == pytest.approx(10 * mixed["part_b_g"], abs=0.06)


def test_silicone_ignores_pins_and_grows_with_thickness(tmp_path):
    pad = Morphology.straight(2)
    settings = [with_settings({"pins": pins}, silicone={"shrinkage": 0.04}) for pins in (True, False)]
    pinned, plain = (build(pad, tmp_path, [], each) for each in settings)
    box_ml = plain.sizes["tray_mm"] ** 2 * plain.sizes["tray_height_mm"] / 1000
    assert plain.silicone_volume_ml == pytest.approx(box_ml - plain.mould_volume_ml, abs=1e-3)
    assert pinned.silicone_volume_ml == pytest.approx(plain.silicone_volume_ml, abs=1e-3)
    plan = Plan(level_pad(1.8, 1.2), with_settings({"silicone_mm": 2.5}))
    silicone = laying_document(plan, mould_mesh(plan).volume())["silicone"]
    assert silicone["thickness_mm"] == plan.silicone_mm == 3.0
    empty = plan.silicone.area * 3
    tracks = sum(area.area * height for area, height in zip(plan.ridges, plan.heights_mm, strict=True))
    assert empty - tracks < 1000 * silicone["volume_ml"] < empty * 1.02


@pytest.mark.parametrize("mould", [{}, {"border_mm": 1.5, "exit_mm": 0.0, "lead_mm": 12.5}])
def test_lengths_match_curves(mould):
    plan = Plan(Morphology.random(3, 4, seed=3), with_settings(mould))
    tongue = plan.settings.mould.border_mm + plan.settings.mould.exit_mm
    for fibre, entry in enumerate(laying_document(plan, 1.0)["fibres"]):
        length = shapely.LineString(exact_fibre(plan.pad, fibre)).length
        assert entry["in_pad_mm"] == pytest.approx(length + 2 * tongue, abs=0.006)
        assert entry["cut_mm"] == pytest.approx(entry["in_pad_mm"] + 2 * plan.settings.mould.lead_mm, abs=0.011)


@pytest.mark.slow
def test_published_pad_is_laid_deepest_first_with_silicone_at_every_crossing(published):
    plan = Plan(Morphology.load(published / "5para_dis.mat"))
    document = laying_document(plan, 1.0)
    assert [fibre["number"] for fibre in document["fibres"]] == list(range(1, 9))
    assert [fibre["fibre"] for fibre in document["fibres"]][::7] == ["horizontal 1", "vertical 4"]
    depths = [{document["fibres"][n - 1]["depth_mm"] for n in step} for step in document["laying_order"]]
    assert depths == [{2.8}, {2.0}, {1.2}, {0.4}]
    assert sorted(n for step in document["laying_order"] for n in step) == list(range(1, 9))
    assert [fibre["level"] for fibre in document["fibres"]] == list(plan.layer_indices)
    crossings = document["crossings"]
    assert crossings["total"] == len(crossings["table"]) == 30
    assert (crossings["same_family"], crossings["gap_mm"]) == (6, 0.5)
    assert all(len(row) == len(crossings["columns"]) for row in crossings["table"])
    for *_, first_mm, second_mm, gap in crossings["table"]:
        assert gap == pytest.approx(abs(first_mm - second_mm) - 0.3)
    table = rows(laying_page(fabrication_document(plan)), "depths")  # more than 24 crossings are counted by depth
    assert sum(int(count) for *_, count in table) == 30
    assert table[0] == ["2.8 and 2 mm", "0.5 mm", "4"]


@pytest.mark.parametrize(
    ("settings", "gap"),
    [(DEFAULTS, 0.5), (with_settings(fibre={"diameter_mm": 1.0}), -0.2), (with_settings({"levels": "two"}), -0.3)],
)
def test_gap_of_touching_fibres_is_not_positive(settings: FabricationSettings, gap: float):
    crossings = laying_document(Plan(level_pad(1.8, 1.2), settings), 1.0)["crossings"]
    assert crossings["gap_mm"] == pytest.approx(gap)
    assert crossings["same_family"] == 2


def test_common_tracks_are_listed_from_twice_a_right_angled_crossing_on():
    """Straight ones have 0.8 mm in common; a vertical that crosses at 25 degrees 1.9 mm, at 35 degrees 1.4 mm."""
    assert laying_document(Plan(Morphology.straight(4)), 1.0)["common_tracks"] == []
    assert "over a deeper one" not in laying_page(fabrication_document(Plan(Morphology.straight(4))))
    for angle_deg, listed in ((25, True), (35, False)):
        shift = 0.2 / 3 / math.tan(math.radians(angle_deg))
        vertical = [[1, 0], [1 - shift, 0.9], [1 + shift, 1.1], [1, 2]]
        pad = Morphology(np.array([[[0, 1], [0.5, 1], [1.5, 1], [2, 1]], vertical]), 20.0)
        document = fabrication_document(Plan(pad))
        assert bool(document["common_tracks"]) == listed
        if listed:
            (track,) = document["common_tracks"]
            assert (track["shallow"], track["deep"]) == (2, 1)
            assert track["position_mm"] == pytest.approx([0, 0], abs=1e-3)
            ((tracks, *_, length),) = rows(laying_page(document), "tracks")
            assert (tracks, length) == ("2 over 1", f"{track['length_mm']:.1f} mm")


@pytest.mark.parametrize("draft_deg", [0.0, 5.0])
def test_adhesive_fills_tracks(draft_deg):
    plan = Plan(Morphology.straight(4), with_settings({"ridge_draft_deg": draft_deg}))
    steps = laying_document(plan, 1.0)["adhesive"]["steps_ml"]
    for step, height in zip(steps, (1.2, 0.4), strict=True):
        width = 0.4 + height * math.tan(math.radians(draft_deg))
        assert 1000 * step == pytest.approx(4 * 60.25 * width * height, abs=0.06)


def rows(page: str, head: str) -> list[list[str]]:
    """Return the rows of the table whose first column has the heading `head`."""
    lines = page.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {head} "))
    body = lines[start + 2 :]
    end = next((i for i, line in enumerate(body) if not line.startswith("|")), len(body))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in body[:end]]


def test_page_lists_failed_checks_and_follows_settings():
    findings = (
        {"name": "bed", "status": "pass", "message": "fits", "positions_mm": []},
        {"name": "thin", "status": "warn", "message": "thin walls", "positions_mm": [[1.0, 2.0]]},
        {"name": "wall", "status": "fail", "message": "no wall", "positions_mm": []},
    )
    lid = with_settings(
        {"lid": True, "spout": True, "number_mm": 0.0}, printer={"resin": True, "nozzle_mm": 0.05, "layer_mm": 0.05}
    )
    page = laying_page(fabrication_document(Plan(Morphology.straight(2), lid), findings))
    assert "1 of 3 checks passed" in page
    assert page.index("**fail** wall: no wall") < page.index("**warn** thin: thin walls (1 position,")
    assert "pour through its spout" in page
    for text in ("of resin", "in layers of 0.05 mm", "A ridge is 8 pixels wide", "the floor is 2 mm, 40 layers"):
        assert text in page
    assert "PrusaSlicer" not in page
    assert page.index("- Slice it") < page.index("- Turn anti-aliasing") < page.index("- Wash and cure")
    assert "read the right way" not in page
    plain = laying_page(fabrication_document(Plan(Morphology.straight(2)), findings[:1]))
    assert "1 of 1 checks passed.\n" in plain


def print_setting(name: str, mould: MouldSettings, printer: PrinterSettings) -> tuple[str, str]:
    """Return the value of a setting of PrusaSlicer, and its reason."""
    row = next(row for row in print_settings_rows(mould, printer) if row[0].startswith(f"{name}: "))
    return row[0].removeprefix(f"{name}: "), row[-1]


def test_every_slicer_has_every_setting_and_reason():
    table = list(print_settings_rows(MouldSettings(), PrinterSettings()))
    assert {len(row) for row in table} == {len(PRINT_SETTINGS_HEAD)}
    assert all(cell for row in table for cell in row)
    for columns in zip(*table, strict=True):
        assert len(set(columns)) == len(table)
    for prusa, orca, cura, _ in table:  # sizes agree, but for the sign
        sizes = [re.findall(r"([\d.]+) mm", cell) for cell in (prusa, orca, cura)]
        assert sizes[0] == sizes[1]
        assert sizes[2] in (sizes[0], [])


@pytest.mark.parametrize(
    ("floor", "layer", "nozzle", "first"),
    [(2, 0.3, 0.4, 0.2), (2.05, 0.1, 0.4, 0.15), (0.4, 0.2, 1, 0.4)],
)
def test_floor_above_first_layer_is_whole_layers(floor, layer, nozzle, first):
    printer = PrinterSettings(layer_mm=layer, nozzle_mm=nozzle)
    assert print_setting("First layer height", MouldSettings(floor_mm=floor), printer)[0] == f"{first:g} mm"
    perimeters = [
        print_setting("Perimeters", MouldSettings(wall_mm=wall), PrinterSettings())[0] for wall in (0.8, 2.0, 20.0)
    ]
    assert perimeters == ["2", "3", "4"]  # walls are solid where they are thin
    assert (floor - first) / layer == pytest.approx(round((floor - first) / layer), abs=1e-9)


@pytest.mark.parametrize(
    ("ridge", "nozzle", "width", "why"),
    [
        (0.4, 0.4, "0.4 mm", "0.4 mm wide is one line"),
        (0.65, 0.4, "0.65 mm", "0.65 mm wide is one line"),  # two would be narrower than 0.85 nozzles
        (0.68, 0.4, "0.34 mm", "0.68 mm wide is 2 lines"),
        (0.4, 0.6, "0.51 mm", "0.4 mm wide is narrower than the nozzle: see the checks"),
    ],
)
def test_ridge_is_whole_lines(ridge, nozzle, width, why):
    mould, printer = MouldSettings(ridge_width_mm=ridge), PrinterSettings(nozzle_mm=nozzle)
    assert print_setting("Extrusion width, External perimeters", mould, printer) == (width, f"a ridge {why}")


@pytest.mark.parametrize(("layer", "layers"), [(0.1, 8), (0.3, 3)])
def test_solid_layers_hide_the_infill_below_them(layer, layers):
    value, _ = print_setting("Solid layers, Top", MouldSettings(), PrinterSettings(layer_mm=layer))
    assert value.startswith(f"{layers}; ")  # 0.8 mm or more


def bench_document(**changes: object) -> dict:
    """A document whose every number is another one, so that none can stand in the place of another."""
    fibre = {
        "name": "soft thread",
        "diameter_mm": 0.35,
        "ohm_per_mm": 20.0,
        "max_strain": 0.45,
        "min_bend_radius_mm": 1.5,
    }
    entry = {"in_pad_mm": 50.04, "cut_mm": 90.06, "resistance_ohm": 1801.2, "divider_ohm": 1800.0}
    fibres = [
        entry | {"number": 1, "fibre": "horizontal 1", "depth_mm": 1.75},
        {"number": 2, "fibre": "vertical 1", "depth_mm": 0.25, "in_pad_mm": 60.0, "cut_mm": 100.0}
        | {"resistance_ohm": 2.5e6, "divider_ohm": 2.4e6},
    ]
    settings = {
        "mould": MouldSettings(lead_mm=20.0, holder=True).model_dump(),
        "printer": PrinterSettings().model_dump(),
        "pad": {"leads": "edges", "horizontals": 1, "verticals": 1, "keep_out_mm": []},
    }
    return {
        "files": ["mould.stl", "laying.gcode"],
        "size_mm": [40.5, 30.126, 8.0],
        "sizes": {"pad_mm": 33.75},
        "mould_volume_ml": 10.0,
        "findings": [],
        "settings": settings,
        "silicone": {
            "name": "Goo",
            "part_a_g": 3.04,
            "part_b_g": 1.96,
            "volume_ml": 4.56,
            "thickness_mm": 6.125,
            "mass_g": 5.0,
        }
        | {"mass_g": 5.0, "surplus_percent": 12, "shrinkage": 0.013, "pot_life_min": 91, "cure_h": 1.5},
        "adhesive": {"name": "glue", "volume_ml": 0.6, "steps_ml": [0.4, 0.2]},
        "order": {"fibre_m": 0.234, "waste_percent": 17, "plastic_g": 13.4, "print_h": 1.34, "laying_h": 2.26},
        "fibre": fibre,
        "fibres": fibres,
        "laying_order": [[1], [2]],
        "crossings": {"total": 1, "same_family": 0, "gap_mm": 1.2, "columns": []}
        | {"table": [["horizontal 1", "vertical 1", -3.04, 7.06, 1.75, 0.25, 1.2]]},
        "common_tracks": [{"shallow": 2, "deep": 1, "length_mm": 2.34, "position_mm": [-1.5, 4.5]}],
    } | changes


def section(document: dict, title: str) -> list[str]:
    """Return the lines of a section that are not empty."""
    text = laying_page(document).partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    return [line for line in text.splitlines() if line]


def test_page_has_the_amounts_of_the_document():
    document = bench_document()
    titles = [line for line in laying_page(document).splitlines() if line.startswith("#")]
    names = ["Pad", "Order", "Print", "Mix", "Cast", "Orientation", "Lay", "Wire", "Crossings", "Checks"]
    assert titles == ["# How to make the pad", *(f"## {name}" for name in names)]
    assert section(document, "Pad") == ["The pad is 33.75 x 33.75 mm, 6.12 mm thick, with 2 fibres."]
    lines = section(document, "Print")
    assert lines[:2] == [
        "- The mould is 40.5 x 30.13 x 8 mm and takes 10.0 ml, 12 g of PLA if solid.",  # of 1.24 g/ml
        "- Print it as it lies, open side up, without supports.",
    ]
    assert lines[2].endswith("its tracks up; fibres 1 and 2 start at the cut corner.")
    assert lines[3:5] == ["Slicer settings, by the names they have there:", f"| {' | '.join(PRINT_SETTINGS_HEAD)} |"]
    assert section(document, "Mix") == [
        "| Goo | part A | part B | together |",
        "| --- | --- | --- | --- |",
        "| mass | 3.0 g | 2.0 g | 5.0 g |",
        "The mould holds 4.6 ml, the pad is 6.12 mm thick. The masses include 12 % for what stays in the cup.",
        "The silicone shrinks by 1.3 % as it cures, and the mould is larger by that. Lengths and positions below are"
        " those of the pad.",
    ]
    cast = section(document, "Cast")
    assert "The pot life is 1.52 hours: finish" in cast[0]
    assert cast[2:] == [
        "3. Pour it slowly into one corner of the level mould, up to the top of the walls.",
        "4. Leave it for 90 minutes at room temperature.",
        "5. Free the casting all along the walls, then pull it out from a corner.",
    ]
    assert section(document, "Checks") == ["0 of 0 checks passed."]


def test_page_orders_materials_by_kind_and_estimates_the_work():
    order = section(bench_document(), "Order")
    assert [row.split(" | ")[:2] for row in order[2:10]] == [
        ["| fibre", "0.23 m of soft thread, 0.35 mm"],
        ["| silicone", "5 g of Goo"],
        ["| adhesive", "0.60 ml"],
        ["| filament", "13 g of PLA"],
        ["| connectors", "4"],
        ["| wire", "4 pieces, from the pad to the board"],
        ["| resistors", "2, of values by the resistance of the fibre"],
        ["| board", "for 2 fibres"],
    ]
    assert order[10].startswith("The fibre includes 17 % for waste. The mould prints in about 1.3 h, by rules of thumb")
    assert (
        "Laying and sealing by hand takes about 2.3 h, an estimate of 60 minutes a metre and 2 minutes a" in order[10]
    )


@pytest.mark.parametrize(("resin", "hours"), [(False, 4.0 * 1000 / (0.4 * 0.1 * 50) / 3600), (True, 80 * 12 / 3600)])
def test_order_follows_lengths_crossings_and_the_printer(resin, hours):
    plan = Plan(Morphology.straight(2, 10.0), with_settings({"lead_mm": 25.0}, {"resin": resin}))
    order = laying_document(plan, 4000.0)["order"]
    in_pad_m = 4 * (30 + 2 * 2) / 1000
    assert order["fibre_m"] == pytest.approx(1.2 * (in_pad_m + 4 * 2 * 0.025), abs=1e-3)
    assert order["laying_h"] == pytest.approx(in_pad_m * 1 + 4 * 2 / 60, abs=0.01)
    assert order["print_h"] == pytest.approx(hours, abs=0.01)
    assert order["plastic_g"] == pytest.approx(4.0 * (1.1 if resin else 1.24), abs=0.1)


def test_page_lays_and_wires_every_fibre_by_its_own_numbers():
    document = bench_document()
    lay = section(document, "Lay")
    assert "the tracks lie on top. The numbers on it read the right way now." in lay[0]
    assert lay[1].endswith(
        "with 20 mm out at both ends. Lay them unstretched: soft thread bears 45 % of stretch at most and bends of no"
        " less than 1.5 mm radius."
    )
    assert "fill the tracks over the fibres with glue." in lay[2]
    assert lay[3:7] == [
        "| step | number | fibre | depth | in the pad | cut to | then seal with |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        "| 1 | 1 | horizontal 1 | 1.75 mm | 50.0 mm | 90.1 mm | 0.40 ml |",
        "| 2 | 2 | vertical 1 | 0.25 mm | 60.0 mm | 100.0 mm | 0.20 ml |",
    ]
    assert "toolpath is in `laying.gcode` and drawn in `toolpath.svg`." in lay[7]
    together = document | {"laying_order": [[1, 2]], "adhesive": {"name": "glue", "steps_ml": [0.6]}}
    assert [row[-1] for row in rows(laying_page(together), "step")] == ["", "0.60 ml"]  # once all of a step are laid
    wire = section(document, "Wire")
    assert wire[0].startswith("At 20 Ohm per mm the fibres")
    assert wire[1:] == [
        "| number | fibre | resistance | fixed resistor |",
        "| --- | --- | --- | --- |",
        "| 1 | horizontal 1 | 1.8 kOhm | 1.8 kOhm |",
        "| 2 | vertical 1 | 2.5 MOhm | 2.4 MOhm |",
    ]
    small = [entry | {"resistance_ohm": 999.4, "divider_ohm": 0.5} for entry in document["fibres"]]
    assert rows(laying_page(document | {"fibres": small}), "number")[0][2:] == ["999 Ohm", "0.5 Ohm"]
    exits = section(document | {"exits": [2, 1, 1, 2]}, "Wire")
    assert exits[0].endswith("from left to right as the pad lies for laying, these fibres end: 2, 1, 1, 2.")


def test_page_lists_crossings_as_they_are_and_counts_many():
    lines = section(bench_document(), "Crossings")
    assert lines[0] == "1 crossings, 0 of them within a family. At least 1.2 mm lie between two fibres."
    assert lines.pop(1) == CROSSING_LINK
    assert lines[1] == "Positions are from the centre of the pad. As it lies, x runs to the left and y away from you."
    assert lines[3:6] == [
        "| tracks | x | y | in common |",
        "| --- | --- | --- | --- |",
        "| 2 over 1 | -1.5 mm | 4.5 mm | 2.3 mm |",
    ]
    assert lines[6:] == [
        "| fibres | x | y | depths | between them |",
        "| --- | --- | --- | --- | --- |",
        "| 1 and 2 | -3.0 mm | 7.1 mm | 1.75 and 0.25 mm | 1.2 mm |",
    ]
    row = bench_document()["crossings"]["table"][0]
    shallow = [*row[:4], 0.25, 2.5, -0.1]  # the first is the upper one
    many = {"total": 25, "same_family": 7, "gap_mm": -0.1, "table": [row] * 20 + [shallow] * 5}
    tracks = [{"shallow": 2, "deep": 1, "length_mm": float(mm), "position_mm": [0.0, 0.0]} for mm in range(26, 0, -1)]
    lines = section(bench_document(crossings=many, common_tracks=tracks), "Crossings")
    assert lines[0] == "25 crossings, 7 of them within a family. Some touch."
    assert [line for line in lines if " over 1 |" in line][-1].endswith("| 3.0 mm |")  # 24 of them
    assert "These are the 24 longest of 26; `fabrication.json` has them all." in lines
    assert lines[-5:] == [
        "| depths | between the fibres | crossings |",
        "| --- | --- | --- |",
        "| 2.5 and 0.25 mm | -0.1 mm | 5 |",
        "| 1.75 and 0.25 mm | 1.2 mm | 20 |",
        "`fabrication.json` has the position of each.",
    ]
    none = bench_document(crossings={"total": 0}, common_tracks=[])
    assert section(none, "Crossings") == ["No two fibres cross."]


def test_page_says_what_the_settings_ask_for():
    document = bench_document()

    def page(mould: dict | None = None, pad: dict | None = None, **changes: object) -> dict:
        settings = dict(document["settings"])
        settings["mould"] = settings["mould"] | (mould or {})
        settings["pad"] = settings["pad"] | (pad or {})
        return document | {"settings": settings} | changes

    lid = page({"lid": True, "conductive": True, "number_mm": 0.0, "holder": False})
    assert section(lid, "Print")[2:4] == [
        "- Print the lid as well.",
        "- The mould called `conductive` is for casting a conductive material in place of fibres.",
    ]
    assert section(lid, "Cast")[2].endswith(
        "to the top of the walls. Lay the lid on: air and surplus leave by its vents."
    )
    assert section(lid, "Lay")[0] == "1. Turn the casting over, as drawn above: the tracks lie on top."
    pillars = page(pad={"keep_out_mm": [[0.0, 0.0, 5.0, 5.0]], "leads": "one side"})
    assert "along the walls and around every pillar, then" in section(pillars, "Cast")[-1]
    assert "tracks up; its leads are at the side of the cut corner." in section(pillars, "Print")[2]
    alone = page(pad={"horizontals": 0, "verticals": 3})
    assert "tracks up; fibre 1 starts at the cut corner." in section(alone, "Print")[2]
    assert section(alone, "Orientation")[0] == orientation_sentence((0, 3), "edges")
    bent = {"name": "fibre_strain", "status": "pass", "message": "fibres stretch by 3 %", "positions_mm": []}
    assert section(page(findings=[bent]), "Orientation")[1] == (
        "The pad is worn on a cylinder whose axis runs along y, the face with the tracks outwards: fibres stretch"
        " by 3 %."
    )
    unknown = document["fibre"] | {"ohm_per_mm": None}
    [line] = section(page(fibre=unknown), "Wire")
    assert "unknown: measure 100 mm of it and set `[fibre] ohm_per_mm`" in line
    assert f"]({ORIENTATION_FILE})" in section(document, "Orientation")[-1]
    plain = document["fibre"] | {"max_strain": None, "min_bend_radius_mm": None}
    assert section(page(fibre=plain), "Lay")[1].endswith("with 20 mm out at both ends.")


def test_page_lists_holes_with_room_for_their_screws():
    pad = {"leads": "edges", "horizontals": 1, "verticals": 1}
    document = bench_document(sizes={"pad_mm": [120.0, 30.5]})
    document["settings"]["pad"] = pad | {
        "keep_out_mm": [[-50.5, 0.0, 3.2, 6.0], [[0, 0], [1, 0], [0, 1]], [9.0, 5.0, 4.0]]
    }
    size, lead, _, _, *rows, note = section(document, "Pad")
    assert size.startswith("The pad is 120 x 30.5 mm, ")
    assert lead == "It has these holes:"
    assert rows == ["| -50.5 mm | 0 mm | 3.2 mm | 6 mm, 3.06 mm deep |", "| 9 mm | 5 mm | 4 mm | - |"]
    assert "The heads of screws sink into the face with the tracks." in note
