"""STEP files that say everything once: what is said, and that the CAD kernel reads the same shape from it."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from build123d import Color, Compound, Cylinder, Location, Solid, Vector, export_step, import_step

from design.common.errors import InputError
from design.pad.morphology import Morphology
from fabricate.export import build
from fabricate.mould.cad.step_file import said_once, write_step
from tests.fabricate.planted import with_settings

PAD = Morphology.random(1, 2, seed=7)
SETTINGS = with_settings({"lid": True, "pins": True, "conductive": True, "holder": True})
HEAD = "ISO-10303-21;\nHEADER;\nFILE_NAME('a','2000-01-01T00:00:00',(''),(''),'','','');\nENDSEC;\n"
TAIL = "\nEND-ISO-10303-21;\n"


def step(*entities: str) -> str:
    lines = "".join(f"#{number} = {entity};\n" for number, entity in enumerate(entities, 1))
    return f"{HEAD}DATA;\n{lines}ENDSEC;{TAIL}"


def entities(text: str) -> dict[str, str]:
    data = text.partition("DATA;\n")[2].rpartition("ENDSEC;")[0]
    return dict(re.findall(r"^(#\d+)=(.*);$", data, re.MULTILINE))


def test_geometry_is_said_once_and_in_few_digits():
    found = said_once(
        step(
            "CARTESIAN_POINT('',(0.123456789,-1.E-09,2.))",
            "CARTESIAN_POINT('',(0.12345678,0.,2.))",
            "DIRECTION('',(0.,0.,1.))",
            "DIRECTION('',(0.,0.,1.))",
            "VECTOR('',#3,1.)",
            "VECTOR('',#4,1.)",
            "LINE('',#1,#5)",
            "LINE('',#2,#6)",
            "EDGE_CURVE('',#10,#10,#7,.T.)",
            "VERTEX_POINT('',#1)",
            "EDGE_CURVE('',#10,#10,#8,.T.)",
        )
    )
    assert found.startswith(HEAD)
    assert found.endswith(TAIL)
    assert list(entities(found).values()) == [
        "CARTESIAN_POINT('',(0.123457,0.,2.))",
        "DIRECTION('',(0.,0.,1.))",
        "VECTOR('',#2,1.)",
        "LINE('',#1,#3)",
        "EDGE_CURVE('',#6,#6,#4,.T.)",
        "VERTEX_POINT('',#1)",
        "EDGE_CURVE('',#6,#6,#4,.T.)",
    ]


@pytest.mark.parametrize("name", ["VERTEX_POINT", "EDGE_CURVE", "ORIENTED_EDGE", "ADVANCED_FACE", "CLOSED_SHELL"])
def test_topology_stays_one_each(name):
    found = said_once(step(f"{name}('',#3)", f"{name}('',#3)", "DIRECTION('',(1.,0.,0.))"))
    assert [content.partition("(")[0] for content in entities(found).values()] == [name, name, "DIRECTION"]


@pytest.mark.parametrize(
    "word", ["#2", "a #2, b", "(#2)", "it''s  two   blanks", "'';#1=X", "CARTESIAN_POINT(", "1.23456789012", "DATA;"]
)
def test_strings_stay_as_they_are(word):
    found = said_once(
        step("DIRECTION('',(0.,0.,1.))", "DIRECTION('',(0.,0.,1.))", f"PRODUCT('{word}','{word}','',(#2))")
    )
    assert list(entities(found).values()) == ["DIRECTION('',(0.,0.,1.))", f"PRODUCT('{word}','{word}','',(#1))"]


@pytest.mark.parametrize("wrapped", ["#2\n  ,$", "\n  #2,$", "#2,\n  $", "\n#2\n,\n$"])
def test_lines_may_be_wrapped_anywhere(wrapped):
    found = said_once(step("DIRECTION('',(0.,0.,1.))", "DIRECTION('',(0.,0.,1.))", f"PRODUCT_X('a','',{wrapped})"))
    (content,) = (content for content in entities(found).values() if content.startswith("PRODUCT"))
    assert content.replace(" ", "") == "PRODUCT_X('a','',#1,$)"


def test_entities_of_several_types_keep_their_references():
    found = said_once(
        step(
            "DIRECTION('',(0.,0.,1.))",
            "DIRECTION('',(0.,0.,1.))",
            "( REPRESENTATION_RELATIONSHIP('','',#2,#1) SHAPE_REPRESENTATION_RELATIONSHIP() )",
        )
    )
    (_, relation) = entities(found).values()
    assert (
        re.sub(r"\s", "", relation) == "(REPRESENTATION_RELATIONSHIP('','',#1,#1)SHAPE_REPRESENTATION_RELATIONSHIP())"
    )


def shape() -> Compound:
    """An assembly within an assembly: a block, a drum that stands on it twice, and a part of two solids."""
    block, drums = (
        Compound([Solid.make_box(20, 10, 2)], label="a block"),
        Compound(list(Cylinder(2, 5).solids()), label="drum"),
    )
    pair = Compound([Solid.make_box(1, 1, 1), Solid.make_box(1, 1, 3).moved(Location((5, 0, 0)))], label="pair")
    block.color, drums.color, pair.color = Color("#8FA3B8"), Color("#0B6E99"), Color("#D9C27E")
    inner = Compound(label="inner", children=[block, drums.locate(Location((4, 4, 4.5)))])
    return Compound(label="whole", children=[inner, pair.locate(Location((0, 30, 0)))])


def leaves(part) -> list:
    return [leaf for child in part.children for leaf in leaves(child)] if part.children else [part]


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("step") / "whole.step"
    write_step(path, shape())
    return path


def test_the_kernel_reads_the_same_shape(file):
    read, whole = import_step(file), shape()
    assert read.is_valid
    for size in ("volume", "area"):
        found, expected = (sum(getattr(leaf, size) for leaf in leaves(each)) for each in (read, whole))
        assert found == pytest.approx(expected, rel=1e-9)
    assert (len(read.faces()), len(read.edges())) == (len(whole.faces()), len(whole.edges()))
    for side in ("min", "max"):
        found, expected = (getattr(each.bounding_box(), side) for each in (read, whole))
        assert [*found] == pytest.approx([*expected], abs=1e-6)


def test_names_colours_and_places_come_back(file):
    """build123d reads blanks of names as underscores."""
    read = import_step(file)
    assert (read.label, [child.label for child in read.children]) == ("whole", ["inner", "pair"])
    parts = {leaf.label: leaf for leaf in leaves(read)}
    assert list(parts) == ["a_block", "drum", "pair"]
    for expected in leaves(shape()):
        found = parts[expected.label.replace(" ", "_")]
        assert [*found.color] == pytest.approx([*expected.color], abs=2e-3)
        assert found.volume == pytest.approx(expected.volume)
    assert (parts["drum"].center() - Vector(4, 4, 4.5)).length < 1e-6
    assert "PRODUCT('a block','a block'" in file.read_text(encoding="utf-8")


def test_what_was_said_once_stays_as_it_is(file):
    text = file.read_text(encoding="utf-8")
    assert said_once(text) == text
    geometry = [content for content in entities(text).values() if re.match("CARTESIAN_POINT|DIRECTION|LINE", content)]
    assert len(geometry) == len(set(geometry))


def test_the_file_is_shorter_and_as_many_faces_are_in_it(file, tmp_path):
    export_step(shape(), tmp_path / "plain.step", write_pcurves=False)
    plain, text = (tmp_path / "plain.step").read_text(encoding="utf-8"), file.read_text(encoding="utf-8")
    assert len(text) < 0.7 * len(plain)
    for kind in ("ADVANCED_FACE", "EDGE_CURVE", "ORIENTED_EDGE", "VERTEX_POINT", "MANIFOLD_SOLID_BREP", "PRODUCT"):
        assert len(re.findall(rf"= *{kind}\s*\(", text)) == len(re.findall(rf"= *{kind}\s*\(", plain)) > 0


def test_the_same_shape_gives_the_same_bytes(file, tmp_path):
    """Whatever was written before it in the same process, and wherever in memory it lies."""
    kept = []
    for number in range(4):
        kept.append(shape())
        path = tmp_path / f"{number}.step"
        write_step(path, kept[-1])
        assert path.read_bytes() == file.read_bytes()
    assert len(list(tmp_path.iterdir())) == 4  # nothing is left beside them


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    out = tmp_path_factory.mktemp("built")
    return out, build(PAD, out, ["stl", "step"], SETTINGS)


def test_step_reads_back_as_the_same_solid(built):
    from build123d import import_step

    out, document = built
    whole = import_step(out / "mould.step")
    assert whole.is_valid
    assert {part.label: [each.label for each in part.children] for part in whole.children} == {
        "mould": ["tray", "horizontal_tracks", "vertical_tracks", "numbers", "pins"],
        "lid": [],
        "conductive": ["tray", "horizontal_tracks", "vertical_tracks", "numbers", "pins"],
        "holder": [],
    }
    volume = {part.label: part.volume for part in whole.children}
    assert volume["mould"] / 1000 == pytest.approx(document["mould_volume_ml"], rel=1e-4)
    for name in ("lid", "conductive", "holder"):  # the mesh has polygons for circles
        assert volume[name] == pytest.approx(trimesh.load_mesh(out / f"{name}.stl").volume, rel=1e-4)


def test_the_step_file_is_judged_by_the_meshes(built):
    _, document = built
    (found,) = (finding for finding in document["findings"] if finding["name"] == "cad_solid")
    assert found["status"] == "pass"
    (volume, surface), (most_volume, most_surface) = found["measured"], found["limit"]
    assert 0 < volume < 2e-4 < most_volume
    assert 0 < surface < 2e-4 < most_surface
    assert found["message"].endswith("curves within 2 µm")


def test_a_coarse_mesh_is_no_reason_to_refuse(tmp_path):
    """What chords take away of the volume grows with the tolerance."""
    settings = with_settings({"tolerance_mm": 0.099, "ridge_width_mm": 1.2})
    (found,) = (
        finding
        for finding in build(Morphology.random(2, 12, seed=0), tmp_path, ["step"], settings)["findings"]
        if finding["name"] == "cad_solid"
    )
    assert found["limit"] == pytest.approx([9.9 * 5e-4, 9.9 * 5e-3])
    assert 5e-4 < found["measured"][0] < found["limit"][0]


def test_without_step_nothing_is_said_of_it(tmp_path):
    document = build(PAD, tmp_path, ["stl"])
    assert "cad_solid" not in {finding["name"] for finding in document["findings"]}


@pytest.mark.parametrize(
    ("body", "makes"), [("mould", "mould_model"), ("conductive", "mould_model"), ("lid", "body_model")]
)
def test_nothing_is_written_when_mesh_and_solid_disagree(tmp_path, monkeypatch, body, makes):
    from build123d import Compound, Solid

    from fabricate.mould.cad import model

    right = getattr(model, makes)

    def other(of, name, *rest):
        made = right(of, name, *rest)
        return replace(made, shape=Compound(label=name, children=[Solid.make_box(1, 1, 1)])) if name == body else made

    monkeypatch.setattr(model, makes, other)
    with pytest.raises(InputError, match=rf"^{body}: the CAD solid is not of its mesh \(.*nothing was written"):
        build(PAD, tmp_path / "out", ["stl", "step"], SETTINGS)
    assert not (tmp_path / "out").exists()


def test_a_solid_that_the_kernel_finds_invalid_writes_nothing(tmp_path, monkeypatch):
    from build123d import Solid

    monkeypatch.setattr(Solid, "is_valid", False)
    with pytest.raises(InputError, match="mould: the CAD kernel finds a solid invalid; leave step out"):
        build(PAD, tmp_path / "out", ["stl", "step"])
    assert not (tmp_path / "out").exists()
