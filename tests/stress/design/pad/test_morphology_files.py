"""Files of morphologies: torn, damaged, swapped or boasting; each is read or refused in one line."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from design.common.errors import InputError
from design.criteria.rules import check_rules
from design.pad.morphology import Morphology
from design.settings import RulesSettings
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.damage import ARRAYS, damages, dump, published, replacements
from tests.stress.door import require_one_line


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


@few(100)
@given(replacements())
def test_morphologies_of_any_content(folder: Path, replace: Callable[[Any], Any]):
    path = folder / "changed.json"
    dump(path, replace(json.loads((folder / "morphology.json").read_text())))
    load(path)


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


def test_a_packed_variable_of_very_much_is_refused(tmp_path: Path):
    packer = zlib.compressobj(1)
    first = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    again = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    packed = first + 599 * again + packer.flush()  # what follows a full flush needs nothing before it
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "bomb.mat").write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
    with ends_in_time(), pytest.raises(InputError, match=r"bomb\.mat: .*it unpacks to more than"):
        Morphology.load(tmp_path / "bomb.mat")
