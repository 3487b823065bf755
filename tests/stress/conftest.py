"""A folder of a pad, whose files stress tests spoil."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from design.pad.morphology import Morphology
from design.settings import PUBLISHED_CONTACT
from fabricate.export import build
from fabricate.mesh_files import read_mesh
from tests.stress.damage import PAD, RULES, SEARCH, published


@pytest.fixture(scope="session")
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
        for name, values in published(4).items():
            if isinstance(values, dict):
                for field, value in values.items():
                    file[f"{name}/{field}"] = np.full((1, 1), value)
            else:
                file[name] = values.T
    with (folder / "new.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + b"\0" * 8 + b"\x00\x02IM")
    terms = {"ambiguity_lost_0": 0.1, "information": 3.0}
    settings = {"pad": PAD, "contact": PUBLISHED_CONTACT, "search": SEARCH, "rules": RULES}
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
