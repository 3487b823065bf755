"""STEP files that say everything once: what is said, and that the CAD kernel reads the same shape from it."""

import re
from pathlib import Path

import pytest
from build123d import Color, Compound, Cylinder, Location, Solid, Vector, export_step, import_step

from padforge.fabricate.cad.step_file import said_once, write_step

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


REFERENCES = "( REPRESENTATION_RELATIONSHIP('','',#2,#1) SHAPE_REPRESENTATION_RELATIONSHIP() )"
WORDS = ["#2", "a #2, b", "(#2)", "it''s  two   blanks", "'';#1=X", "CARTESIAN_POINT(", "1.23456789012", "DATA;"]


@pytest.mark.parametrize(
    ("entity", "said"),
    [
        *((f"PRODUCT('{word}','{word}','',(#2))", f"PRODUCT('{word}','{word}','',(#1))") for word in WORDS),
        *((f"PRODUCT_X('a','',{each})", "PRODUCT_X('a','',#1,$)") for each in ("#2\n  ,$", "\n  #2,$", "\n#2\n,\n$")),
        (REFERENCES, REFERENCES.replace("#2", "#1")),
    ],
)
def test_references_change_wherever_lines_are_wrapped_and_words_stay_as_they_are(entity, said):
    found = said_once(step("DIRECTION('',(0.,0.,1.))", "DIRECTION('',(0.,0.,1.))", entity))
    first, other = entities(found).values()
    assert first == "DIRECTION('',(0.,0.,1.))"
    assert other == said or re.sub(r"\s", "", other) == re.sub(r"\s", "", said) != re.sub(r"\s", "", entity)


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


def test_the_kernel_reads_the_same_shape_with_its_names_colours_and_places(file):
    read, whole = import_step(file), shape()
    assert read.is_valid
    assert (len(read.faces()), len(read.edges())) == (len(whole.faces()), len(whole.edges()))
    for side in ("min", "max"):
        found, expected = (getattr(each.bounding_box(), side) for each in (read, whole))
        assert [*found] == pytest.approx([*expected], abs=1e-6)
    assert (read.label, [child.label for child in read.children]) == ("whole", ["inner", "pair"])
    parts = {leaf.label: leaf for leaf in leaves(read)}
    assert list(parts) == ["a_block", "drum", "pair"]  # build123d reads blanks of names as underscores
    for expected in leaves(whole):
        found = parts[expected.label.replace(" ", "_")]
        assert [*found.color] == pytest.approx([*expected.color], abs=2e-3)
        assert (found.volume, found.area) == pytest.approx((expected.volume, expected.area), rel=1e-9)
    assert (parts["drum"].center() - Vector(4, 4, 4.5)).length < 1e-6
    assert "PRODUCT('a block','a block'" in file.read_text(encoding="utf-8")


def test_the_file_is_shorter_than_the_kernels_and_as_many_faces_are_in_it(file, tmp_path):
    export_step(shape(), tmp_path / "plain.step", write_pcurves=False)
    plain, text = (tmp_path / "plain.step").read_text(encoding="utf-8"), file.read_text(encoding="utf-8")
    assert len(text) < 0.7 * len(plain)
    for kind in ("ADVANCED_FACE", "EDGE_CURVE", "ORIENTED_EDGE", "VERTEX_POINT", "MANIFOLD_SOLID_BREP", "PRODUCT"):
        assert len(re.findall(rf"= *{kind}\s*\(", text)) == len(re.findall(rf"= *{kind}\s*\(", plain)) > 0
    assert said_once(text) == text
    geometry = [content for content in entities(text).values() if re.match("CARTESIAN_POINT|DIRECTION|LINE", content)]
    assert len(geometry) == len(set(geometry))


def test_the_same_shape_gives_the_same_bytes(file, tmp_path):
    """Whatever was written before it in the same process, and wherever in memory it lies."""
    kept = []
    for number in range(2):
        kept.append(shape())
        path = tmp_path / f"{number}.step"
        write_step(path, kept[-1])
        assert path.read_bytes() == file.read_bytes()
    assert len(list(tmp_path.iterdir())) == 2  # nothing is left beside them
