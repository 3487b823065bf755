import re

import pytest

from fabricate.report.laying.print_settings import HEAD, for_resin, rows
from fabricate.settings import MouldSettings, PrinterSettings


def found(name: str, mould: MouldSettings, printer: PrinterSettings) -> tuple[str, str]:
    """The value of a setting as PrusaSlicer has it, and why."""
    row = next(row for row in rows(mould, printer) if row[0].startswith(f"{name}: "))
    return row[0].removeprefix(f"{name}: "), row[-1]


def test_every_slicer_is_told_every_setting_and_why():
    told = list(rows(MouldSettings(), PrinterSettings()))
    assert {len(row) for row in told} == {len(HEAD)}
    assert all(cell for row in told for cell in row)
    for columns in zip(*told, strict=True):
        assert len(set(columns)) == len(told)
    for prusa, orca, cura, _ in told:  # where all give a size, it is the same one, but for its sign
        sizes = [re.findall(r"([\d.]+) mm", cell) for cell in (prusa, orca, cura)]
        assert sizes[0] == sizes[1]
        assert sizes[2] in (sizes[0], [])


@pytest.mark.parametrize(
    ("floor", "layer", "nozzle", "first"),
    [(2, 0.1, 0.4, 0.2), (2, 0.2, 0.4, 0.2), (2, 0.3, 0.4, 0.2), (2.05, 0.1, 0.4, 0.15), (0.4, 0.2, 1, 0.4)],
)
def test_whole_layers_are_left_of_the_floor(floor, layer, nozzle, first):
    printer = PrinterSettings(layer_mm=layer, nozzle_mm=nozzle)
    assert found("First layer height", MouldSettings(floor_mm=floor), printer)[0] == f"{first:g} mm"
    assert (floor - first) / layer == pytest.approx(round((floor - first) / layer), abs=1e-9)


@pytest.mark.parametrize(
    ("ridge", "nozzle", "width", "why"),
    [
        (0.4, 0.4, "0.4 mm", "0.4 mm wide is one line"),
        (0.5, 0.4, "0.5 mm", "0.5 mm wide is one line"),
        (0.8, 0.4, "0.4 mm", "0.8 mm wide is 2 lines"),
        (0.4, 0.6, "0.51 mm", "0.4 mm wide is narrower than the nozzle: see the checks"),
    ],
)
def test_a_ridge_is_whole_lines(ridge, nozzle, width, why):
    mould, printer = MouldSettings(ridge_width_mm=ridge), PrinterSettings(nozzle_mm=nozzle)
    assert found("Extrusion width, External perimeters", mould, printer) == (width, f"a ridge {why}")


@pytest.mark.parametrize(("wall", "lines"), [(0.8, "2"), (2.0, "3"), (20.0, "4")])
def test_walls_of_the_tray_are_solid_where_they_are_thin(wall, lines):
    assert found("Perimeters", MouldSettings(wall_mm=wall), PrinterSettings())[0] == lines


def test_resin_is_told_in_pixels_and_layers():
    text = "\n".join(for_resin(MouldSettings(), PrinterSettings(resin=True, nozzle_mm=0.05, layer_mm=0.05)))
    assert "in layers of 0.05 mm" in text
    assert "A ridge is 8 pixels wide" in text
    assert "the floor is 2 mm, 40 layers" in text
    one = for_resin(MouldSettings(), PrinterSettings(resin=True, nozzle_mm=0.4))
    assert any("A ridge is 1 pixel wide" in line for line in one)
