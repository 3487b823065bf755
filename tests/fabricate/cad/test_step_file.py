"""STEP files in which each entity stands once, and the shapes that the CAD kernel reads from them."""

import re
from pathlib import Path

import pytest

from padforge.fabricate.cad.step_file import CadPart, deduplicate, export_xcaf, write_step


def entities(text: str) -> dict[str, str]:
    data = text.partition("DATA;\n")[2].rpartition("ENDSEC;")[0]
    return dict(re.findall(r"^(#\d+)=(.*);$", data, re.MULTILINE))


def assembly() -> CadPart:
    """An assembly within an assembly: a block with a drum on it, and a part of two solids."""
    from build123d import Cylinder, Location, Solid  # takes seconds, also in workers that run other tests

    block = CadPart("a block", "#8FA3B8", (Solid.make_box(20, 10, 2).wrapped,))
    drum = CadPart("drum", "#0B6E99", (Cylinder(2, 5).solid().wrapped,), position_mm=(4, 4, 4.5))
    boxes = Solid.make_box(1, 1, 1), Solid.make_box(1, 1, 3).moved(Location((5, 0, 0)))
    pair = CadPart("pair", "#D9C27E", tuple(box.wrapped for box in boxes), position_mm=(0, 30, 0))
    return CadPart("whole", children=(CadPart("inner", children=(block, drum)), pair))


def leaves(part) -> list:
    return [leaf for child in part.children for leaf in leaves(child)] if part.children else [part]


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("step") / "whole.step"
    write_step(path, assembly())
    return path


def test_write_step_keeps_shapes_names_colours_and_positions(file):
    from build123d import Color, Vector, import_step

    read = import_step(file)
    assert read.is_valid
    assert (len(read.faces()), len(read.edges())) == (3 * 6 + 3, 3 * 12 + 3)
    assert [*read.bounding_box().min] == pytest.approx([0, 0, 0], abs=1e-6)
    assert [*read.bounding_box().max] == pytest.approx([20, 31, 7], abs=1e-6)
    assert (read.label, [child.label for child in read.children]) == ("whole", ["inner", "pair"])
    parts = {leaf.label: leaf for leaf in leaves(read)}
    assert list(parts) == ["a_block", "drum", "pair"]  # build123d reads blanks of names as underscores
    volumes = {"a_block": 400, "drum": 20 * 3.141592653589793, "pair": 4}
    for expected in leaves(assembly()):
        part = parts[expected.name.replace(" ", "_")]
        assert [*part.color] == pytest.approx([*Color(expected.colour)], abs=2e-3)
        assert part.volume == pytest.approx(volumes[part.label], rel=1e-9)
    assert (parts["drum"].center() - Vector(4, 4, 4.5)).length < 1e-6
    text = file.read_text(encoding="utf-8")
    assert "PRODUCT('a block','a block'" in text
    assert re.search(r"FILE_NAME\(\s*'whole',", text)
    assert re.search(r"LENGTH_UNIT\(\)\s*NAMED_UNIT\(\*\)\s*SI_UNIT\(\.MILLI\.,\.METRE\.\)", text)


def test_written_file_is_shorter_than_the_kernels_and_has_as_many_faces(file, tmp_path):
    export_xcaf(tmp_path / "plain.step", assembly())
    plain, text = (tmp_path / "plain.step").read_text(encoding="utf-8"), file.read_text(encoding="utf-8")
    assert len(text) < 0.7 * len(plain)
    for kind in ("ADVANCED_FACE", "EDGE_CURVE", "ORIENTED_EDGE", "VERTEX_POINT", "MANIFOLD_SOLID_BREP", "PRODUCT"):
        assert len(re.findall(rf"= *{kind}\s*\(", text)) == len(re.findall(rf"= *{kind}\s*\(", plain)) > 0
    assert deduplicate(text) == text
    geometry = [content for content in entities(text).values() if re.match("CARTESIAN_POINT|DIRECTION|LINE", content)]
    assert len(geometry) == len(set(geometry))


def test_same_shapes_give_the_same_bytes(file, tmp_path):
    """Whatever was written before in the same process, and wherever in memory the shapes lie."""
    assemblies = []
    for number in range(2):
        assemblies.append(assembly())
        path = tmp_path / f"{number}.step"
        write_step(path, assemblies[-1])
        assert path.read_bytes() == file.read_bytes()
    assert len(list(tmp_path.iterdir())) == 2  # no temporary file is left beside them


def test_items_of_a_representation_stay_a_set(file):
    """ISO 10303-43: no item twice; a part that is not moved has a placement of its own beside its assembly's."""
    kinds = {"SHAPE_REPRESENTATION": [], "ITEM_DEFINED_TRANSFORMATION": []}
    for content in entities(file.read_text(encoding="utf-8")).values():
        if (kind := content.partition("(")[0]) in kinds:
            kinds[kind].append(content)
    lists = [content.split("(")[2].partition(")")[0] for content in kinds["SHAPE_REPRESENTATION"]]
    items = [re.findall(r"#\d+", each) for each in lists]
    assert max(map(len, items)) == 3  # the origin of an assembly, and the placements of its two parts
    assert [len(set(each)) for each in items] == [len(each) for each in items]
    ends = [re.findall(r"#\d+", each) for each in kinds["ITEM_DEFINED_TRANSFORMATION"]]
    assert [len(set(each)) for each in ends] == [2] * 4
