"""Drawings as pads: our own come back, others are placed and read, and what is none is told in one line."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import shapely
from click.testing import CliRunner
from ezdxf import new, units  # pyright: ignore[reportPrivateImportUsage]

from padforge import InputError
from padforge.common.plotting import save_figure
from padforge.design import Contact, Morphology, PadSettings, draw_plan, flatten
from padforge.design.cli import design
from padforge.design.paths.import_plan import import_plan
from padforge.design.settings import Layout

LAYOUT = Layout.create((2, 3), (10.0, 12.0))
"""40 by 36 mm: ends of horizontals at y = -6 and 6, of verticals at x = -10, 0 and 10."""
WAYS = (
    *(f"M -20 {y} C -10 {y - 9} 10 {y + 9} 20 {y}" for y in (-6, 6)),
    *(f"M {x} -18 C {x - 6} -6 {x + 6} 6 {x} 18" for x in (-10, 0, 10)),
)


HEAD = 'viewBox="-20 -18 40 36" width="40mm" height="36mm"'
FIRST = 'viewBox="0 0 40 36" width="40mm" height="36mm"'


def svg(tmp_path: Path, *parts: str, head: str = HEAD) -> Path:
    path = tmp_path / "plan.svg"
    link = 'xmlns:xlink="http://www.w3.org/1999/xlink"'
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {link} {head}>{"".join(parts)}</svg>')
    return path


def paths(*ways: str) -> str:
    return "".join(f'<path id="w{number}" d="{way}"/>' for number, way in enumerate(ways))


PATHS = paths(*WAYS)


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Morphology:
    """What the paths are."""
    return import_plan(svg(tmp_path_factory.mktemp("plain"), PATHS), LAYOUT, 0.4).pad


def max_distance_mm(one: Morphology, other: Morphology) -> float:
    """Greatest distance of fibres, mm."""
    lines = ([shapely.LineString(pad.to_mm(line)) for line in flatten(pad, 1e-5)] for pad in (one, other))
    return max(a.hausdorff_distance(b) for a, b in zip(*lines, strict=True))


def test_import_moves_ends_within_the_tolerance(tmp_path: Path) -> None:
    plain = import_plan(svg(tmp_path, PATHS), LAYOUT, 0.05).pad
    assert plain.to_mm(flatten(plain, 1e-4)[1])[0] == pytest.approx([-20, 6])  # y of an SVG goes down
    t = np.linspace(0, 1, 200)[:, None]
    a, b, c, d = np.array([[-20, -6], [-10, -15], [10, 3], [20, -6]]) * [1, -1]
    drawn = (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d
    upper = shapely.LineString(plain.to_mm(flatten(plain, 1e-4)[1]))
    assert shapely.distance(shapely.points(drawn), upper).max() < 0.06
    ways = [way.replace("20 -6", "20 -6.03") for way in WAYS]
    found = import_plan(svg(tmp_path, paths(*ways)), LAYOUT, 0.05)
    assert found.fibres[1].end_shift_mm == pytest.approx(0.03, abs=1e-4)
    with pytest.raises(
        InputError, match=r"w0: runs from \(-20, -6.03\) to \(20, -6.03\) in the drawing, 0.03 mm from"
    ) as told:
        import_plan(svg(tmp_path, paths(*ways)), LAYOUT, 0.01)
    assert "--tolerance-mm" in str(told.value)


@pytest.mark.parametrize(
    ("drawn", "head", "placement"),
    [
        (PATHS, 'viewBox="-20 -18 40 36" width="113.38583pt" height="3.6cm"', "middle"),
        (f'<g transform="translate(7 3) rotate(90) rotate(-90) matrix(1 0 0 1 -7 -3)">{PATHS}</g>', HEAD, "middle"),
        (f'<defs><g id="all">{PATHS}</g></defs><use href="#all"/>', HEAD, "middle"),
        (f'<symbol id="all">{PATHS}</symbol><use xlink:href="#all" x="0" y="0"/>', HEAD, "middle"),
        (f'<g transform="translate(20 18)">{PATHS}</g>', FIRST, "upper left corner"),
        (f'<g transform="translate(20 -18)">{PATHS}</g>', FIRST, "lower left corner"),  # y of an SVG goes down
        (f'<a transform="translate(500 80)">{PATHS}</a>', FIRST, "the middle of its curves"),
        (f'<rect id="pad" x="-20" y="-18" width="40" height="36"/>{PATHS}', 'viewBox="0 0 9 9"', "named pad"),
        (f'<path d="M -20 0 H 20"/><g id="fibres">{PATHS}</g>', HEAD, "middle"),
        (f'<svg x="-20" y="-28" width="40" height="56" viewBox="-20 -18 40 36">{PATHS}</svg>', HEAD, "middle"),
        (f'{PATHS}<text>no fibre</text><path d="M0 0L1 0L1 1Z"/><path style="display: none" d="M0 0L1 1"/>', HEAD, ""),
        (f'<style>.no {{display: none}}</style><g class="no"><path d="M0 0L1 1"/></g>{PATHS}', HEAD, "middle"),
        (paths(*(re.sub("M -20 (-?6)", r"M -25 \1 L -20 \1", way) for way in WAYS)), HEAD, ""),  # they begin outside
    ],
)
def test_import_follows_units_transforms_and_visibility(
    tmp_path: Path, plain: Morphology, drawn: str, head: str, placement: str
) -> None:
    imported = import_plan(svg(tmp_path, drawn, head=head), LAYOUT, 0.4)
    assert max_distance_mm(imported.pad, plain) < 0.02
    assert placement in imported.placement


def test_import_joins_pieces(tmp_path: Path) -> None:
    parts = [
        '<polyline points="-20,-6 -5,-8"/><line x1="5" y1="-4" x2="-5" y2="-8"/><path d="M5-4 20-6"/>',
        '<line x1="-20" y1="6" x2="20" y2="6"/>',
        *(f'<line x1="{x}" y1="18" x2="{x}" y2="-18"/>' for x in (-10, 0, 10)),
    ]
    imported = import_plan(svg(tmp_path, *parts), LAYOUT, 0.05)
    assert imported.fibres[1].max_error_mm < 0.05
    assert "to" in imported.fibres[1].name


def instead(way: str) -> str:
    """Paths of which the upper horizontal is another."""
    return paths(way, *WAYS[1:])


REFUSED = [
    (paths(*WAYS[1:]).replace("w0", "w4"), "no curve is horizontal 2"),
    (f'{PATHS}<path id="again" d="M-20-6.01 20-6.01"/>', "w0 and again: both are horizontal 2"),
    (instead("M -20 -6 C 30 0 -30 0 20 -6"), r"w0: turns back at \(.*\) mm, expected .* along x"),
    # from (-9, 9) down to (-8, 0) mm, where y points up
    (paths(*WAYS[:2], "M-10 18L-9-9-8 0-10-18", *WAYS[3:]), r"w2: turns back at \(-8.5, 4.5\) mm, .* along y"),
    (instead("M -20 -6 L -10 -6 L 0 -20 L 10 -6 L 20 -6"), r"w0: leaves the pad at"),
    (instead("M -20 -6 L 10 -6"), r"w0: runs from .*, 10 mm from where horizontal 2 ends"),
    (paths(*WAYS[:4], "M 13 18 L 13 -18"), r"w4: runs from \(13, 18\) to \(13, -18\) in the drawing, 3 mm from"),
    (instead("M -20 -3 L 20 -3"), r"w0: runs from \(-20, -3\) to \(20, -3\) in the drawing, 3 mm from"),
    ('<rect id="pad" width="1" height="7"/>' + PATHS, "pad is drawn 1 by 7, expected the shape of 40 by 36"),
    (PATHS + "".join(f'<line x1="-20" y1="-6" x2="{x}" y2="0"/>' for x in (-18, -17)), "more than two"),
    (
        '<g transform="scale(1e200)"><path id="x" d="M 0 0C1 1 2 2 3 3"/></g>',
        "coordinates that are no numbers or beyond",
    ),
    ('<path id="x" d="M 0 0 L 1"/>', "not an SVG file that can be read"),
    ('<use id="x" href="#x"/>', "not an SVG file that can be read"),
    (PATHS + "".join(f'<path d="M{k} 0L{k + 0.5} 1"/>' for k in range(50)), "55 open curves, expected 5, one a fibre"),
]


@pytest.mark.parametrize(("drawn", "message"), REFUSED, ids=range(len(REFUSED)))
def test_import_refuses_other_drawings_in_one_line(tmp_path: Path, drawn: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as refused:
        import_plan(svg(tmp_path, drawn), LAYOUT, 0.05)
    assert str(refused.value).startswith(str(tmp_path / "plan.svg"))
    assert len(str(refused.value)) < 500


def test_import_refuses_other_files_in_one_line(tmp_path: Path) -> None:
    for name in ("plan.svg", "plan.dxf"):
        for content in (b"nonsense", b"<html/>", b"  0\nSECTION\n  2\nHEADER\n"):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(InputError, match=name):
                import_plan(tmp_path / name, LAYOUT, 0.05)
    with pytest.raises(InputError, match=r"allowed are \.svg and \.dxf"):
        import_plan(tmp_path / "plan.pdf", LAYOUT, 0.05)


def dxf(tmp_path: Path, draw) -> Path:
    document = new(units=units.MM)  # pyright: ignore[reportPrivateImportUsage]
    space = document.modelspace()
    draw(space)
    document.saveas(tmp_path / "plan.dxf")
    return tmp_path / "plan.dxf"


def straight_ones(space) -> None:
    space.add_lwpolyline([(-20, 6), (20, 6)])
    for x in (-10, 0, 10):
        space.add_line((x, -18), (x, 18))


def several(space) -> None:
    space.add_line((-20, -6), (-5, -6))
    space.add_arc((0, -6), 5, 0, 180)
    space.add_polyline2d([(5, -6), (20, -6)])
    space.add_circle((0, 0), 3)
    space.add_text("no fibre")


@pytest.mark.parametrize(
    ("draw", "middle_mm"),
    [
        (several, -1.0),  # over the top of the arc
        (lambda space: space.add_lwpolyline([(-20, -6, 0.1), (20, -6, 0)], format="xyb"), -8.0),  # a bulge
        (lambda space: space.add_spline([(-20, -6), (0, -9), (20, -6)]), -9.0),
    ],
)
def test_import_reads_all_kinds_of_dxf_entities(tmp_path: Path, draw, middle_mm: float) -> None:
    found = import_plan(dxf(tmp_path, lambda space: (straight_ones(space), draw(space))), LAYOUT, 0.05)
    assert all(fibre.max_error_mm < 0.06 for fibre in found.fibres)
    line = found.pad.to_mm(flatten(found.pad, 1e-4)[0])
    assert np.interp(0, *line.T) == pytest.approx(middle_mm, abs=0.1)


def test_import_restores_a_drawn_plan(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    courses = Morphology.random(LAYOUT, 4, rng).knots.copy()
    for fibre, line in enumerate(courses):  # not as steep as random ones are
        axis = LAYOUT.family(fibre)
        line[:, axis] = np.linspace(0, LAYOUT.extent[axis], 6)
        line[1:-1, 1 - axis] = LAYOUT.levels[fibre] + rng.uniform(-0.4, 0.4, 4)
    pad = Morphology.from_layout(courses, LAYOUT)
    save_figure(
        draw_plan(pad, Contact(), (), PadSettings().for_layout(LAYOUT).keep_out_corners_mm), tmp_path / "plan.svg"
    )
    found = import_plan(tmp_path / "plan.svg", LAYOUT, 0.05)
    assert max_distance_mm(found.pad, pad) < 0.08
    assert found.pad.knots.shape[1] <= 6 + 3
    assert found.placement.startswith("the border is that named pad; open curves outside of 'horizontal-1'")


def test_import_command_writes_morphology_and_reports_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    stated = "[pad]\nhorizontals = 2\nverticals = 3\npitch_mm = [10, 12]\n[rules]\nmin_mean_bend_radius_mm = 0\n"
    Path("pad.toml").write_text(stated)
    ways = ("M -20 -6 L 20 -6.03", "M -20 6 L 20 6", *(f"M {x} -18 L {x} 18" for x in (-10, 0, 10)))
    svg(tmp_path, paths(*ways))
    result = CliRunner().invoke(design, ["import", "plan.svg"], catch_exceptions=False)
    lines = result.output.splitlines()
    assert (result.exit_code, lines[-1]) == (0, "  all rules hold")
    assert re.fullmatch(r"  fibre 1: w1, within 0\.000 mm", lines[2])
    assert re.fullmatch(r"  fibre 2: w0, within 0\.0\d+ mm, ends moved by 0\.030 mm", lines[3])
    pad = Morphology.load(tmp_path / "out/plan/morphology.json")
    assert pad.provenance["command"] == "padforge design import"
    assert list(pad.provenance["inputs"]) == ["plan.svg"]
    Path("pad.toml").write_text(stated + "max_length_mm = 38\n")
    broken = CliRunner().invoke(design, ["import", "plan.svg", "--json"], catch_exceptions=False)
    assert broken.exit_code == 1
    assert json.loads(broken.output)["fibres"][1]["end_shift_mm"] == pytest.approx(0.03, abs=1e-4)


HIDDEN = [
    f'<g style="display:none" id="fibres_old"><path d="M-20 0H20"/></g>{PATHS}',
    f'<style>.no {{visibility: hidden}}</style><g class="no"><path d="M-20 0H20"/></g>{PATHS}',
    f'<g visibility="hidden"><path d="M-20 0H20"/><g visibility="visible">{PATHS}</g></g>',
    f'<g display="none"><path style="display:inline" d="M-20 0H20"/></g>{PATHS}',
    f'<g opacity="0"><path d="M-20 0H20"/></g>{PATHS}',
]


@pytest.mark.parametrize("drawn", HIDDEN, ids=range(len(HIDDEN)))
def test_import_leaves_out_hidden_curves_of_svg(tmp_path: Path, plain: Morphology, drawn: str) -> None:
    imported = import_plan(svg(tmp_path, drawn), LAYOUT, 0.4)
    assert max_distance_mm(imported.pad, plain) < 0.02
    assert imported.placement.endswith("hidden curves, which are left out: 1")


def test_import_leaves_out_hidden_curves_of_dxf(tmp_path: Path) -> None:
    document = new(units=units.MM)  # pyright: ignore[reportPrivateImportUsage]
    space = document.modelspace()
    straight_ones(space)
    space.add_line((-20, -6), (20, -6))
    for name in ("fibres off", "fibres frozen"):
        layer = document.layers.add(name)
        layer.off() if "off" in name else layer.freeze()
        space.add_line((-20, 0), (20, 0), dxfattribs={"layer": name})
    space.add_line((-20, 0), (20, 0), dxfattribs={"invisible": 1})
    document.saveas(tmp_path / "plan.dxf")
    found = import_plan(tmp_path / "plan.dxf", LAYOUT, 0.05)
    assert found.placement.endswith("hidden curves, which are left out: 3")


def test_import_says_which_open_curves_are_left_out(tmp_path: Path) -> None:
    drawn = f'<g id="fibres">{PATHS}</g><path d="M-20 0H20"/>'
    assert import_plan(svg(tmp_path, drawn), LAYOUT, 0.4).placement.endswith(
        "open curves outside of 'fibres', which are left out: 1"
    )


def test_import_reads_blocks(tmp_path: Path) -> None:
    document = new(units=units.MM)  # pyright: ignore[reportPrivateImportUsage]
    inner, outer = document.blocks.new("LINES"), document.blocks.new("PAD")
    straight_ones(inner)
    inner.add_line((-20, -6), (20, -6))
    outer.add_blockref("LINES", (1, 2))
    document.modelspace().add_blockref("PAD", (-1, -2))
    document.saveas(tmp_path / "plan.dxf")
    assert len(import_plan(tmp_path / "plan.dxf", LAYOUT, 0.05).fibres) == 5
    document.layers.add("away").off()
    document.modelspace()[0].dxf.layer = "away"
    document.saveas(tmp_path / "plan.dxf")
    with pytest.raises(InputError, match="there is no open curve in it but 5 hidden ones"):
        import_plan(tmp_path / "plan.dxf", LAYOUT, 0.05)


@pytest.mark.parametrize("gap", [1e-4, 1e-3, 0.008])
def test_import_joins_pieces_that_nearly_touch(tmp_path: Path, gap: float) -> None:
    parts = [
        f'<path d="M-20 -6H-5"/><path d="M{-5 + gap} -6H5"/><path d="M{5 - gap} {-6 + gap / 2}H20"/>',
        '<line x1="-20" y1="6" x2="20" y2="6"/>',
        *(f'<line x1="{x}" y1="18" x2="{x}" y2="-18"/>' for x in (-10, 0, 10)),
    ]
    imported = import_plan(svg(tmp_path, *parts), LAYOUT, 0.05)
    assert imported.fibres[1].max_error_mm < 0.02


def test_import_does_not_join_pieces_that_are_apart(tmp_path: Path) -> None:
    parts = ('<path d="M-20 -6H-5"/><path d="M-4.9 -6H20"/>', paths(*WAYS[1:]))
    with pytest.raises(InputError, match=r"path 1: runs from \(-20, -6\) to \(-5, -6\) in the drawing, 24 mm from"):
        import_plan(svg(tmp_path, *parts), LAYOUT, 0.05)


def test_import_replaces_entities_of_plain_text(tmp_path: Path, plain: Morphology) -> None:
    path = svg(tmp_path, PATHS)
    declared = '<!DOCTYPE svg [<!ENTITY ns "http://www.w3.org/2000/svg">]>'
    path.write_text(declared + path.read_text().replace("http://www.w3.org/2000/svg", "&ns;"))
    assert np.array_equal(import_plan(path, LAYOUT, 0.4).pad.knots, plain.knots)


SCALED = {
    0.75: "span 30 by 27 mm.*the pad 40 by 36 mm, a factor of 0.75 .points of 1/72 inch",
    25.4: "span 1016 by 914.4 mm.*a factor of 25.4 .it states inches",
    0.5: "a factor of 0.5; ",
}


@pytest.mark.parametrize("scale", SCALED)
def test_import_says_by_which_factor_a_drawing_is_off(tmp_path: Path, scale: float) -> None:
    lines = ('<path d="M-20 -6H20"/><path d="M-20 6H20"/>', *(f'<path d="M{x} -18V18"/>' for x in (-10, 0, 10)))
    with pytest.raises(InputError, match=SCALED[scale]):
        import_plan(svg(tmp_path, f'<g transform="scale({scale})">{"".join(lines)}</g>'), LAYOUT, 0.05)
