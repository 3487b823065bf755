"""Files of meshes: torn, damaged, swapped or boasting; each is judged or refused in one line."""

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.common.errors import InputError
from fabricate.checks.mesh_checks import inspect_mesh
from fabricate.mesh_files import read_mesh
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.damage import damages
from tests.stress.design.pad.test_morphology_files import KINDS
from tests.stress.door import require_one_line


def check_mesh(path: Path) -> None:
    """A mesh is judged with findings that JSON can hold, or refused."""
    with ends_in_time():
        try:
            vertices, triangles = read_mesh(path)
        except InputError as error:
            require_one_line(error, path.name)
            return
        findings = inspect_mesh(vertices, triangles)
    json.dumps([finding.document() for finding in findings], allow_nan=False)


@few(30)
@given(st.sampled_from(KINDS[4:7]), st.sampled_from(KINDS), damages(), st.booleans())
def test_damaged_meshes(folder: Path, name: str, other: str, damage: Callable[[bytes], bytes], swapped: bool):
    content = (folder / (other if swapped else name)).read_bytes()
    path = folder / f"damaged{Path(name).suffix}"
    path.write_bytes(content if swapped and other != name else damage(content))
    check_mesh(path)


def _stl(corners: np.ndarray, count: int | None = None) -> bytes:
    """A binary STL of triangles (m, 3, 3) that says it has `count`."""
    records = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["corners"] = corners
    return b"x".ljust(80) + struct.pack("<I", len(corners) if count is None else count) + records.tobytes()


@few(40)
@given(
    st.integers(0, 60),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 1e-30, 1e-3, 1.0, 100.0, 1e6, 1e30]),
    st.sampled_from([None, 0, 1, 2**32 - 1]),
    st.sampled_from([None, np.nan, np.inf, -np.inf, 0.0, 3e38]),
    st.booleans(),
)
def test_meshes_of_any_triangles(
    folder: Path, count: int, seed: int, size: float, said: int | None, odd: float | None, flat: bool
):
    rng = np.random.default_rng(seed)
    with np.errstate(over="ignore"):
        corners = np.round(rng.normal(0, size, (count, 3, 3)), 1 if size == 100 else 8).astype(np.float32)
    if count and odd is not None:
        corners[rng.integers(count), rng.integers(3), rng.integers(3)] = odd
    if flat:
        corners[:, :, 2] = 0
    path = folder / "triangles.stl"
    path.write_bytes(_stl(corners, said))
    check_mesh(path)


@pytest.mark.parametrize("count", [3000, 30_000])
@pytest.mark.parametrize("size", [0.1, 100.0])
def test_a_heap_of_triangles_is_judged_in_time(tmp_path: Path, count: int, size: float):
    corners = np.random.default_rng(1).normal(0, size, (count, 3, 3))
    (tmp_path / "heap.stl").write_bytes(_stl(corners))
    check_mesh(tmp_path / "heap.stl")


def _model(objects: str, items: str) -> str:
    core = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    return f'<model unit="millimeter" xmlns="{core}"><resources>{objects}</resources><build>{items}</build></model>'


TRIANGLE = (
    '<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/></vertices>'
    '<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh>'
)


def _doubled(levels: int, copies: int) -> str:
    """Objects each made of so many of the one before."""
    parts = [f'<object id="0" type="model">{TRIANGLE}</object>']
    for n in range(1, levels + 1):
        part = f'<component objectid="{n - 1}"/>'
        parts.append(f'<object id="{n}" type="model"><components>{part * copies}</components></object>')
    return _model("".join(parts), f'<item objectid="{levels}"/>')


MODELS = {
    "bomb": _doubled(40, 2),
    "wide": _doubled(5, 30),
    "deep": _doubled(3000, 1),
    "ring": _model(
        '<object id="1"><components><component objectid="2"/></components></object>'
        '<object id="2"><components><component objectid="1"/></components></object>',
        '<item objectid="1"/>',
    ),
    "self": _model(
        '<object id="1"><components><component objectid="1"/></components></object>', '<item objectid="1"/>'
    ),
    "missing": _model("", '<item objectid="1"/>'),
    "none": _model("", ""),
    "beyond": _model(
        f'<object id="1">{TRIANGLE.replace("v3=" + chr(34) + "2", "v3=" + chr(34) + "9")}</object>',
        '<item objectid="1"/>',
    ),
    "nan": _model(f'<object id="1">{TRIANGLE.replace("1", "nan")}</object>', '<item objectid="1"/>'),
    "huge": _model(
        f'<object id="1">{TRIANGLE.replace("x=" + chr(34) + "1", "x=" + chr(34) + "1e999")}</object>',
        '<item objectid="1"/>',
    ),
    "twist": _model(f'<object id="1">{TRIANGLE}</object>', '<item objectid="1" transform="1 2 nan"/>'),
    "entities": '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY a{n} "{"&a" + (str(n - 1) if n else "") + ";" * 1}">' for n in range(3))
    + "]><model>&a2;</model>",
    "outside": '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///dev/zero">]><model>&a;</model>',
    "blank": _model(" " * 20_000_000, ""),
    "text": "no model at all",
}


@pytest.mark.parametrize("name", sorted(MODELS))
def test_models_made_to_be_awkward(tmp_path: Path, name: str):
    with zipfile.ZipFile(tmp_path / "model.3mf", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", MODELS[name])
    check_mesh(tmp_path / "model.3mf")


def test_an_archive_of_very_much_is_refused(tmp_path: Path):
    with (
        zipfile.ZipFile(tmp_path / "bomb.3mf", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("3D/3dmodel.model", "w", force_zip64=True) as file,
    ):
        for _ in range(140):
            file.write(bytes(2**20))
    with ends_in_time(), pytest.raises(InputError, match=r"bomb\.3mf: .*it unpacks to 146800640 bytes"):
        read_mesh(tmp_path / "bomb.3mf")
