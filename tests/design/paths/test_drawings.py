import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ezdxf import new, units  # pyright: ignore[reportPrivateImportUsage]

from padforge import InputError
from padforge.design import Morphology, flatten
from padforge.design.paths.import_plan import import_plan
from tests.design.conftest import LAYOUT, max_distance_mm
from tests.helpers.golden import Golden

STRAIGHT = "M -20 6 L 20 6", *(f"M {x} -18 L {x} 18" for x in (0, 10))
WAYS = "M -20 -6 C -6 -8 6 -8 20 -6", STRAIGHT[0], "M -10 -18 C -14 -6 -14 6 -10 18", *STRAIGHT[1:]
"""Two of them bow, by one knot."""

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
    return import_plan(svg(tmp_path_factory.mktemp("plain"), PATHS), LAYOUT, 0.4).pad


DRAWN = [
    (PATHS, 'viewBox="-20 -18 40 36" width="113.38583pt" height="3.6cm"'),
    (f'<g transform="translate(7 3) rotate(90) rotate(-90) matrix(1 0 0 1 -7 -3)">{PATHS}</g>', HEAD),
    (f'<defs><g id="all">{PATHS}</g></defs><use href="#all"/>', HEAD),
    (f'<symbol id="all">{PATHS}</symbol><use xlink:href="#all" x="0" y="0"/>', HEAD),
    (f'<g transform="translate(20 18)">{PATHS}</g>', FIRST),
    (f'<g transform="translate(20 -18)">{PATHS}</g>', FIRST),  # y of an SVG goes down
    (f'<a transform="translate(500 80)">{PATHS}</a>', FIRST),
    (f'<rect id="pad" x="-20" y="-18" width="40" height="36"/>{PATHS}', 'viewBox="0 0 9 9"'),
    (f'<path d="M -20 0 H 20"/><g id="fibres">{PATHS}</g>', HEAD),
    (f'<svg x="-20" y="-28" width="40" height="56" viewBox="-20 -18 40 36">{PATHS}</svg>', HEAD),
    (f'{PATHS}<text>no fibre</text><path d="M0 0L1 0L1 1Z"/><path style="display: none" d="M0 0L1 1"/>', HEAD),
    (f'<style>.no {{display: none}}</style><g class="no"><path d="M0 0L1 1"/></g>{PATHS}', HEAD),
    (paths(*(re.sub("M -20 (-?6)", r"M -25 \1 L -20 \1", way) for way in WAYS)), HEAD),  # they begin outside
    (f'<g style="display:none" id="fibres_old"><path d="M-20 0H20"/></g>{PATHS}', HEAD),
    (f'<style>.no {{visibility: hidden}}</style><g class="no"><path d="M-20 0H20"/></g>{PATHS}', HEAD),
    (f'<g visibility="hidden"><path d="M-20 0H20"/><g visibility="visible">{PATHS}</g></g>', HEAD),
    (f'<g display="none"><path style="display:inline" d="M-20 0H20"/></g>{PATHS}', HEAD),
    (f'<g opacity="0"><path d="M-20 0H20"/></g>{PATHS}', HEAD),
]


def test_import_follows_units_transforms_and_visibility(tmp_path: Path, plain: Morphology, golden: Golden) -> None:
    placements = []
    for drawn, head in DRAWN:
        imported = import_plan(svg(tmp_path, drawn, head=head), LAYOUT, 0.4)
        assert max_distance_mm(imported.pad, plain) < 0.02, drawn
        placements.append(f"{drawn.replace(PATHS, '...')}\n  {imported.placement}")
    golden("design/placements.txt", "\n".join(placements))


def instead(way: str) -> str:
    """Paths of which the upper horizontal is another."""
    return paths(way, *WAYS[1:])


def scaled(factor: float) -> str:
    return f'<g transform="scale({factor})">{PATHS}</g>'


REFUSED = [
    paths(*WAYS[1:]).replace("w0", "w4"),
    f'{PATHS}<path id="again" d="M-20-6.01 20-6.01"/>',
    instead("M -20 -6 C 30 0 -30 0 20 -6"),
    paths(*WAYS[:2], "M-10 18L-9-9-8 0-10-18", *WAYS[3:]),  # from (-9, 9) down to (-8, 0) mm, where y points up
    instead("M -20 -6 L -10 -6 L 0 -20 L 10 -6 L 20 -6"),
    instead("M -20 -6 L 10 -6"),
    instead("M -20 -6 L 20 -6.06"),
    instead("M -20 -6 H -5 M -4.9 -6 H 20"),
    paths(*WAYS[:4], "M 13 18 L 13 -18"),
    instead("M -20 -3 L 20 -3"),
    f'<rect id="pad" width="1" height="7"/>{PATHS}',
    PATHS + "".join(f'<line x1="-20" y1="-6" x2="{x}" y2="0"/>' for x in (-18, -17)),
    '<g transform="scale(1e200)"><path id="x" d="M 0 0C1 1 2 2 3 3"/></g>',
    '<path id="x" d="M 0 0 L 1"/>',
    '<use id="x" href="#x"/>',
    PATHS + "".join(f'<path d="M{k} 0L{k + 0.5} 1"/>' for k in range(50)),
    *map(scaled, (0.5, 72 / 96, 96 / 72, 25.4, 1 / 25.4, 1000, 0.001, 10, 0.1)),
    *map(scaled, (25.4 / 96, 96 / 25.4, 90 / 96, 300 / 96, 25.4 / 72)),
]


def test_import_refuses_other_drawings_in_one_line(tmp_path: Path, golden: Golden) -> None:
    messages = []
    for drawn in REFUSED:
        with pytest.raises(InputError, match=r"^.*plan\.svg: [^\n]{,400}$") as refused:
            import_plan(svg(tmp_path, drawn), LAYOUT, 0.05)
        messages.append(f"{drawn.replace(PATHS, '...')[:100]}\n  {refused.value}")
    golden("design/import_refusals.txt", "\n".join(messages), forget=["(?<=read [(])maximum recursion.*"])


def test_import_replaces_entities_of_plain_text(tmp_path: Path, plain: Morphology) -> None:
    path = svg(tmp_path, PATHS)
    declared = '<!DOCTYPE svg [<!ENTITY ns "http://www.w3.org/2000/svg">]>'
    path.write_text(declared + path.read_text().replace("http://www.w3.org/2000/svg", "&ns;"))
    assert np.array_equal(import_plan(path, LAYOUT, 0.4).pad.knots, plain.knots)


@pytest.mark.parametrize("gap", [0.0, 1e-4, 0.008])
def test_import_joins_pieces_that_nearly_touch(tmp_path: Path, gap: float) -> None:
    parts = [
        f'<polyline points="-20,-6 -5,-6"/><line x1="5" y1="-6" x2="{-5 + gap}" y2="-6"/>',
        f'<path d="M{5 - gap} {-6 + gap / 2}H20"/><line x1="-20" y1="6" x2="20" y2="6"/>',
        *(f'<line x1="{x}" y1="18" x2="{x}" y2="-18"/>' for x in (-10, 0, 10)),
    ]
    imported = import_plan(svg(tmp_path, *parts), LAYOUT, 0.05)
    assert imported.fibres[1].max_error_mm < 0.02
    assert "to" in imported.fibres[1].name


@pytest.fixture
def document() -> Any:
    """A DXF of all fibres but the upper horizontal, straight in a block."""
    document = new(units=units.MM)  # pyright: ignore[reportPrivateImportUsage]
    inner, outer = document.blocks.new("LINES"), document.blocks.new("PAD")
    inner.add_lwpolyline([(-20, 6), (20, 6)])
    for x in (-10, 0, 10):
        inner.add_line((x, -18), (x, 18))
    outer.add_blockref("LINES", (1, 2))
    document.modelspace().add_blockref("PAD", (-1, -2))
    return document


def several(space: Any) -> None:
    space.add_line((-20, -6), (-5, -6))
    space.add_arc((0, 0), 61**0.5, 230.19442891, 309.80557109)  # through (-5, -6) and (5, -6)
    space.add_polyline2d([(5, -6), (20, -6)])
    space.add_circle((0, 0), 3)
    space.add_text("no fibre")


def test_import_reads_all_kinds_of_dxf_entities(tmp_path: Path, document: Any, golden: Golden) -> None:
    space, path = document.modelspace(), tmp_path / "plan.dxf"
    for draw, middle_mm in (
        (lambda: space.add_lwpolyline([(-20, -6, 0.1), (20, -6, 0)], format="xyb"), -8.0),  # a bulge
        (lambda: space.add_spline([(-20, -6), (0, -9), (20, -6)]), -9.0),
        (lambda: several(space), -(61**0.5)),
    ):
        drawn = draw()
        document.saveas(path)
        found = import_plan(path, LAYOUT, 0.9)
        line = found.pad.to_mm(flatten(found.pad, 1e-4)[0])
        assert np.interp(0, *line.T) == pytest.approx(middle_mm, abs=0.9)
        if drawn is not None:
            space.delete_entity(drawn)
    golden("design/dxf_names.txt", "\n".join([found.placement, *(fibre.name for fibre in found.fibres)]))


def test_import_leaves_out_hidden_curves_of_dxf(tmp_path: Path, document: Any) -> None:
    space, path = document.modelspace(), tmp_path / "plan.dxf"
    space.add_line((-20, -6), (20, -6))
    for name in ("fibres off", "fibres frozen"):
        layer = document.layers.add(name)
        layer.off() if "off" in name else layer.freeze()
        space.add_line((-20, 0), (20, 0), dxfattribs={"layer": name})
    space.add_line((-20, 0), (20, 0), dxfattribs={"invisible": 1})
    document.saveas(path)
    assert import_plan(path, LAYOUT, 0.05).placement.endswith("hidden curves, which are left out: 3")
    for entity in space:
        entity.dxf.layer = "fibres off"
    document.saveas(path)
    with pytest.raises(InputError, match="there is no open curve in it but 8 hidden ones"):
        import_plan(path, LAYOUT, 0.05)
