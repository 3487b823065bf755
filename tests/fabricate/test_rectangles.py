import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import settings as effort
from hypothesis import strategies as st

from padforge.design import Morphology, PadSettings
from padforge.fabricate.cad.model import body_solid
from padforge.fabricate.checks.plan_checks import check_mould
from padforge.fabricate.leads import lead_spacing
from padforge.fabricate.mesh import build_mesh, mould_mesh
from padforge.fabricate.mould import bed_frame, holder_body, lid_body, tray_body
from padforge.fabricate.plan import Plan
from padforge.fabricate.settings import DEFAULTS, FabricationSettings
from tests.fabricate.planted import with_settings

PAD = Morphology.straight((3, 6), (8.0, 15.0))


def settings(pad: Morphology, mould: dict | None = None, **more) -> FabricationSettings:
    return with_settings({"number_mm": 0.0} | (mould or {}), pad={**pad.layout.settings, **more})


def test_round_holes_are_round_pillars_whose_feet_are_the_heads_of_screws():
    holes = [[0.0, 7.0, 3.0], [-8.0, -7.0, 3.0, 5.0]]
    pad = replace(settings(PAD, keep_out_mm=holes), silicone=DEFAULTS.silicone.model_copy(update={"shrinkage": 0.02}))
    plan, plain = Plan(PAD, pad), Plan(PAD, replace(pad, pad=PadSettings(**PAD.layout.settings)))
    found = {finding.name: finding for finding in check_mould(plan)[-1]}
    assert all(found[name].status == "pass" for name in ("watertight", "bodies", "genus", "keep_out", "pillars"))
    printed = plan.shrinkage_compensated
    more = mould_mesh(printed).volume() - mould_mesh(plain.shrinkage_compensated).volume()
    disc, sunk = math.pi / 4 / 0.98**2, printed.silicone_mm / 2
    assert more == pytest.approx(disc * (2 * 3**2 * printed.silicone_mm + (5**2 - 3**2) * sunk), rel=2e-3)
    solid = body_solid(tray_body(printed))
    round_ = [face for face in solid.faces() if face.geom_type.name == "CYLINDER"]
    areas = [math.pi / 0.98 * (diameter * height) for diameter, height in ((3, 2 * sunk), (3, sunk), (5, sunk))]
    assert sorted(face.area for face in round_) == pytest.approx(sorted(areas), rel=1e-3)


def test_keep_out_at_the_edge_joins_the_wall_and_bores_of_lids_are_clear_of_pillars():
    notch = ((20.0, 20.0), (28.0, 20.0), (28.0, 30.0), (20.0, 30.0))
    plan = Plan(Morphology.straight((1, 1), (28.0, 30.0)), settings(PAD, keep_out_mm=(notch,)))
    rim = DEFAULTS.mould.floor_mm + DEFAULTS.mould.silicone_mm
    free = [ring for ring in mould_mesh(plan).slice(rim - 1e-3).to_polygons() if len(ring)]
    assert len(free) == 2  # the walls' outside and inside: no film between pillar and wall
    hole = ((-6.0, -5.0), (6.0, -5.0), (6.0, 5.0), (-6.0, 5.0))
    plan = Plan(PAD, settings(PAD, {"lid": True, "spout": True}, keep_out_mm=(hole,)))
    for prism in lid_body(plan).cuts:
        assert not prism.area.intersects(plan.pillars)


@pytest.mark.parametrize("fibres", [(0, 3), (1, 0)])
@pytest.mark.parametrize("leads", ["edges", "one side"])
def test_mould_of_few_fibres_is_sound(fibres, leads):
    pad = Morphology.straight(fibres, (9.0, 12.0))
    found = {finding.name: finding for finding in check_mould(Plan(pad, settings(pad, leads=leads)))[-1]}
    assert all(found[name].status == "pass" for name in ("watertight", "bodies", "volume", "genus", "crossing_gap"))


@effort(max_examples=8)
@given(
    st.tuples(st.integers(0, 8), st.integers(0, 8)).filter(any),
    st.tuples(st.floats(4, 25), st.floats(4, 25)),
    st.floats(0, 4),
)
def test_one_side_leads_keep_their_spacing(fibres, pitches, border):
    pad = Morphology.straight(fibres, pitches)
    plan = Plan(pad, settings(pad, {"border_mm": border}, leads="one side"))
    apart = min(lead_spacing(plan.settings, plan.heights_mm[-1], plan.flare_mm)[1], *pitches)
    ways = []
    for fibre, pair in enumerate(plan.leads.pairs):
        for lead in pair:
            assert lead.point_past_edge(0)[1] == pytest.approx(plan.cavity.bounds[1])
            way = np.vstack([lead.end_mm, lead.flatten_bends(1e-4), lead.point_past_edge(0)])
            assert lead.length_mm == pytest.approx(shapely.LineString(way).length, rel=1e-4)
            ways.append((fibre, shapely.LineString(way)))
    for fibre, way in ways:
        assert way.within(plan.cavity.buffer(1e-6))
        for other, its in ways:
            if other != fibre:
                assert way.distance(its) > apart - 1e-3
    exits = sorted(lead.point_past_edge(0)[0] for pair in plan.leads.pairs for lead in pair)
    assert np.diff(exits).min() > apart - 1e-6


def test_holder_slots_are_at_the_mirrored_leads():
    pad = Morphology.straight((1, 3), (9.0, 12.0))
    plan = Plan(pad, settings(pad, {"holder": True}, leads="one side"))
    walls = build_mesh(holder_body(plan)).slice(DEFAULTS.mould.floor_mm + 0.5)
    solid = shapely.Polygon()
    for ring in walls.to_polygons():
        solid = solid.symmetric_difference(shapely.Polygon(ring))
    for lead in (lead for pair in plan.leads.pairs for lead in pair):
        x, y = lead.point_past_edge(DEFAULTS.mould.exit_mm + 1)
        assert solid.distance(shapely.Point(-x, y)) > 1
    low, high = plan.tray.bounds[1], plan.tray.bounds[3]
    assert bed_frame(plan)["centre_mm"] == pytest.approx([110.0, 110.0 - (low + high) / 2])


def test_leads_to_one_side_leave_two_printed_lines_between_their_slots():
    """At the rim, to which both walls of a slot lean outwards; without slots ridges and rules set the distance."""
    rules: dict[str, object] = {"min_gap_mm": 1.5, "min_mean_bend_radius_mm": 4.0}
    printer: dict[str, object] = {"nozzle_mm": 0.5}
    mould: dict[str, object] = {"exit_width_mm": 3.0, "border_mm": 1.0, "ridge_width_mm": 0.6, "min_silicone_mm": 0.7}
    slots = lead_spacing(with_settings(mould, printer, rules=rules), 1.2, 0.25)
    assert slots == pytest.approx((4.0 / 2, 3.0 + 2 * 0.25 + 2 * 0.5, 4.0, 4.5 / 2))
    none = lead_spacing(with_settings(mould | {"exit_mm": 0.0}, printer, rules=rules | {"min_gap_mm": 0.8}), 1.2, 0.25)
    assert none == pytest.approx((4.0 / 2, 0.6 + 0.7, 4.0, 0.6 / 2 + 0.7))
    gap = lead_spacing(with_settings(mould | {"exit_mm": 0.0}, printer, rules=rules), 1.2, 0.25)
    assert gap[1] == 1.5
