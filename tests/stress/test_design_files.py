"""Hostile files of design and fabricate: torn, damaged, swapped or boasting; each is read or refused in one line."""

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from design.common.checkpoints import Checkpoints
from design.common.errors import InputError
from design.criteria.rules import check_rules
from design.optimisers.search import search
from design.pad.morphology import Morphology
from design.settings import Contact, PadSettings, RulesSettings, SearchSettings
from fabricate.checks.mesh_checks import inspect_mesh
from fabricate.export import build
from fabricate.mesh_files import read_mesh
from padforge import write_report
from tests.stress.clock import ends_in_time, few
from tests.stress.door import require_one_line

SEARCH = SearchSettings(knots=1, starts=1, steps=30, lost=1, population=4, generations=4)
PAD, RULES = PadSettings(grid=1), RulesSettings(enforce=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A pad's folder as the stages leave it, and files of the same pad in other formats."""
    folder = tmp_path_factory.mktemp("files")
    pad = Morphology.random(1, 2, 1)
    pad.save(folder / "morphology.json")
    build(pad, folder, ["stl", "3mf", "png"])
    vertices, triangles = read_mesh(folder / "mould.stl")
    corners = "".join(
        f"facet normal 0 0 0\nouter loop\n{rows}endloop\nendfacet\n"
        for rows in ("".join(f"vertex {x} {y} {z}\n" for x, y, z in vertices[t].tolist()) for t in triangles[:200])
    )
    (folder / "text.stl").write_text(f"solid mould\n{corners}endsolid mould\n")
    scipy.io.savemat(folder / "pad.mat", published(4))
    scipy.io.savemat(folder / "packed.mat", published(4), do_compression=True)
    with h5py.File(folder / "new.mat", "w", userblock_size=512) as file:
        file["para"] = published(4)["para"]
    with (folder / "new.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + b"\0" * 8 + b"\x00\x02IM")
    terms = {"ambiguity_lost_0": 0.1, "information": 3.0}
    settings = {"pad": PAD, "contact": Contact(), "search": SEARCH, "rules": RULES}
    made_by = {
        "command": "padforge design",
        "seed": 0,
        "versions": {},
        "inputs": {},
        "settings": {name: section.model_dump(mode="json") for name, section in settings.items()},
    }
    design = {"format": "padforge-design/1", "terms": terms, "violations": [], "provenance": made_by}
    (folder / "design.json").write_text(json.dumps(design))
    return folder


def published(fibres: int) -> dict[str, Any]:
    """Variables as the published files have them: a morphology, settings, presses and their signals."""
    rng = np.random.default_rng(0)
    settings = {"object_size": 0.6, "str_shp": 30.0, "fineness": 200.0}
    knots = np.sort(rng.uniform(0.1, fibres / 2 + 0.9, (3, 4 * fibres // 2)), axis=0)
    return {"para": knots, "K": settings, "loc_all": rng.uniform(1, 2, (9, 2)), "sens_raw_all": rng.random((9, fibres))}


@st.composite
def damages(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """A few things that happen to files: bytes that change or go, an end that is missing, what does not belong."""
    steps = draw(
        st.lists(
            st.tuples(st.integers(0, 5), st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8)),
            min_size=1,
            max_size=4,
        )
    )

    def damaged(content: bytes) -> bytes:
        found = bytearray(content)
        for kind, share, piece in steps:
            at = int(share * len(found))
            match kind:
                case 0:
                    found[at : at + 1] = piece[:1]
                case 1:
                    found[at : at + len(piece)] = piece
                case 2:
                    del found[at:]
                case 3:
                    found[at : at + 64] = bytes(64)
                case 4:
                    found[at:at] = piece
                case 5:
                    del found[at : at + 16]
        return bytes(found)

    return damaged


def load(path: Path) -> None:
    """A morphology is whole and can be worked with, or refused."""
    with ends_in_time():
        try:
            pad = Morphology.load(path)
        except InputError as error:
            require_one_line(error, path.name)
            return
        assert np.isfinite(pad.knots).all()
        if pad.knots.size < 1000:
            check_rules(pad, RulesSettings())


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


KINDS = (
    "morphology.json",
    "pad.mat",
    "packed.mat",
    "new.mat",
    "mould.stl",
    "mould.3mf",
    "text.stl",
    "design.json",
    "mould.png",
)


@few(120)
@given(st.sampled_from(KINDS[:4]), st.sampled_from(KINDS), damages(), st.booleans())
def test_damaged_morphologies(folder: Path, name: str, other: str, damage: Callable[[bytes], bytes], swapped: bool):
    content = (folder / (other if swapped else name)).read_bytes()
    path = folder / f"damaged{Path(name).suffix}"
    path.write_bytes(content if swapped and other != name else damage(content))
    load(path)


@few(60)
@given(st.sampled_from(KINDS[4:7]), st.sampled_from(KINDS), damages(), st.booleans())
def test_damaged_meshes(folder: Path, name: str, other: str, damage: Callable[[bytes], bytes], swapped: bool):
    content = (folder / (other if swapped else name)).read_bytes()
    path = folder / f"damaged{Path(name).suffix}"
    path.write_bytes(content if swapped and other != name else damage(content))
    check_mesh(path)


JUNK = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.integers(-(10**400), 10**400),
        st.floats(),
        st.text(max_size=8),
        st.sampled_from(["nan", "1e999", "\ud800", "x" * 5000, 10**4000, -1, 0]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=4)),
    max_leaves=8,
)
"""Whatever JSON can hold, and a little more."""


@st.composite
def replacements(draw: st.DrawFn) -> Callable[[Any], Any]:
    """Something else in the place of a few values of a document, wherever they lie, or nothing there."""
    steps = draw(st.lists(st.tuples(st.integers(0, 10**6), st.booleans(), JUNK), min_size=1, max_size=3))

    def replaced(document: Any) -> Any:
        document = json.loads(json.dumps(document))
        for number, gone, junk in steps:
            places = list(_places(document))
            if places:
                holder, key = places[number % len(places)]
                if gone:
                    del holder[key]
                else:
                    holder[key] = junk
        return document

    return replaced


def _places(value: Any) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def dump(path: Path, document: Any) -> None:
    path.write_text(json.dumps(document), encoding="utf-8", errors="surrogatepass")


@few(100)
@given(replacements())
def test_morphologies_of_any_content(folder: Path, replace: Callable[[Any], Any]):
    path = folder / "changed.json"
    dump(path, replace(json.loads((folder / "morphology.json").read_text())))
    load(path)


@few(60)
@given(st.sampled_from(["design.json", "fabrication.json"]), replacements(), damages(), st.integers(0, 4))
def test_reports_on_changed_files(
    folder: Path, name: str, replace: Callable[[Any], Any], damage: Callable[[bytes], bytes], how: int
):
    target = folder / ("mould.stl" if how == 0 else "mould.png" if how == 1 else name)
    before = target.read_bytes()
    try:
        if how < 3:
            target.write_bytes(damage(before))
        else:
            dump(target, replace(json.loads(before)))
        (folder / "report.html").unlink(missing_ok=True)
        with ends_in_time():
            try:
                assert write_report(folder).read_text().endswith("</body></html>\n")
            except InputError as error:
                require_one_line(error)
                assert not (folder / "report.html").exists()
    finally:
        target.write_bytes(before)


ARRAYS = st.one_of(
    st.sampled_from(
        [np.zeros((0, 0)), np.zeros((0, 4)), np.zeros((3, 3)), np.zeros((1, 4)), np.array([[1j, 2, 3, 4]])]
    ),
    st.sampled_from(
        [np.array(["text"]), np.array([[1]], dtype=np.uint8), np.full((2, 8), np.nan), np.full((2, 8), 1e308)]
    ),
    st.sampled_from([np.array([["a", 1.0]], dtype=object), np.ones((2, 2, 8)), {}, {"a": {}}, np.array([[True] * 4])]),
    st.floats(),
    st.text("abc", max_size=5),
)


@few(60)
@given(st.dictionaries(st.sampled_from(["para", "K", "loc_all", "sens_raw_all"]), ARRAYS, min_size=1), st.booleans())
def test_matlab_files_of_any_content(folder: Path, variables: dict[str, Any], packed: bool):
    path = folder / "changed.mat"
    scipy.io.savemat(path, published(4) | variables, do_compression=packed)
    load(path)


@few(40)
@given(st.sampled_from(["object_size", "str_shp", "fineness"]), ARRAYS)
def test_matlab_files_of_any_settings(folder: Path, key: str, value: Any):
    path, content = folder / "changed.mat", published(4)
    scipy.io.savemat(path, content | {"K": content["K"] | {key: value}})
    load(path)


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


def test_a_packed_variable_of_very_much_is_refused(tmp_path: Path):
    packer = zlib.compressobj(1)
    packed = b"".join(packer.compress(bytes(2**20)) for _ in range(600)) + packer.flush()
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "bomb.mat").write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
    with ends_in_time(), pytest.raises(InputError, match=r"bomb\.mat: .*it unpacks to more than"):
        Morphology.load(tmp_path / "bomb.mat")


@pytest.fixture(scope="module")
def begun(tmp_path_factory) -> dict[str, bytes]:
    """Searches of both kinds that were broken off, as files by name."""
    found = {}
    for method in ("descent", "genetic"):
        kept = tmp_path_factory.mktemp(method)
        settings = SEARCH.model_copy(update={"method": method})

        def stop(*_: object) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            search(PAD, Contact(), settings, RULES, keep_in=kept, report=stop)
        found |= {f"{method}/{path.name}": path.read_bytes() for path in kept.iterdir()}
    return found


@few(40)
@given(st.sampled_from(["descent", "genetic"]), st.data())
def test_damaged_checkpoints(folder: Path, begun: dict[str, bytes], method: str, data: st.DataObject):
    kept = folder / "search"
    kept.mkdir(exist_ok=True)
    files = {name.split("/")[1]: content for name, content in begun.items() if name.startswith(method)}
    target = data.draw(st.sampled_from(sorted(files)))
    how = data.draw(st.integers(0, 2))
    if how == 0:
        files[target] = data.draw(damages())(files[target])
    elif how == 1:
        files[target] = files[data.draw(st.sampled_from(sorted(files)))]
    elif target.endswith(".npz"):
        files[target] = _changed_arrays(files[target], data)
    else:
        files[target] = json.dumps(data.draw(replacements())(json.loads(files[target]))).encode()
    for name, content in files.items():
        (kept / name).write_bytes(content)
    settings = SEARCH.model_copy(update={"method": method})
    with ends_in_time():
        try:
            found = search(PAD, Contact(), settings, RULES, keep_in=kept, resume=True)
        except InputError as error:
            require_one_line(error)
            Checkpoints(kept, {}).clear()
            return
    assert np.isfinite(list(found.terms.values())).all()


def _changed_arrays(content: bytes, data: st.DataObject) -> bytes:
    """A state with one array of other values, another shape, another type, or none."""
    with np.load(io.BytesIO(content)) as arrays:
        state = {name: arrays[name] for name in arrays.files}
    name = data.draw(st.sampled_from(sorted(state)))
    array = state[name]
    match data.draw(st.integers(0, 6)):
        case 0:
            del state[name]
        case 1:
            state[name] = array.reshape(-1)[:0]
        case 2:
            state[name] = np.full(array.shape, data.draw(st.sampled_from([np.nan, np.inf, -1e308, 0, 1e308])))
        case 3:
            state[name] = np.array("text")
        case 4:
            state[name] = np.zeros((2, 3, 4))
        case 5:
            state[name] = array[..., None]
        case 6:
            state["more"] = array
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **state)
    return buffer.getvalue()
