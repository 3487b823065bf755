"""What happens to files that hold others or name what they hold: HDF5, MATLAB, archives, weights, databases."""

import hashlib
import json
import sqlite3
import struct
import zipfile
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path

import h5py
import numpy as np
import scipy.io

from .texts import FLOATS, Rng, numbers, pick, some_bytes
from .values import EXTREMES
from .workplace import published

_BOASTS = (2**31 - 1, 2**32, 2**40, 2**63 - 1, -1, 10**9)
"""Sizes that a file may say it has."""
_WAYS = ("gone", "odd", "type", "shape", "huge", "packed", "link", "soft", "outside", "group", "virtual")


def hdf5(rng: Rng, path: Path) -> str:
    """One of the datasets is missing, of other values, type or shape, lies elsewhere, or boasts."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
        name = pick(rng, names)
        values = np.asarray(file[name])  # pyright: ignore[reportArgumentType]
        if rng.random() < 0.15:
            file[name].attrs[pick(rng, ("format", "units", "x"))] = pick(rng, (np.nan, "x" * 1000, np.zeros(3), -1))
            return f"attribute of {name}"
        del file[name]
        kind = pick(rng, _WAYS)
        with np.errstate(all="ignore"):
            if kind == "odd" and values.dtype.kind in "fiu":
                odd = values.astype(float)
                odd[rng.random(odd.shape) < pick(rng, (0.01, 1.0))] = pick(rng, EXTREMES)
                file[name] = odd
            elif kind == "type":
                file[name] = pick(rng, (np.array(["a", "b"], "S1"), np.ones(3, complex), np.zeros(0), 1.0, b"x"))
            elif kind == "shape" and values.ndim:
                file[name] = pick(rng, (values[:-1], values[None], values.T, values.ravel(), values[:0]))
            elif kind in ("huge", "packed"):
                rows = pick(rng, (2**27, 2**30, 2**40))
                shape = (rows, *values.shape[1:]) if values.ndim else (rows,)
                chunks = (min(rows, 2**16), *values.shape[1:])
                packing = {"compression": "gzip"} if kind == "packed" else {}
                made = file.create_dataset(name, shape, "f8", chunks=chunks, fillvalue=0.5, **packing)
                if kind == "packed":
                    made[: 2**16] = np.zeros((2**16, *values.shape[1:]))
            elif kind == "link":
                file[name] = h5py.ExternalLink(pick(rng, ("presses.csv", "pipe.h5", path.name, "/dev/zero")), name)
            elif kind == "soft":
                file[name] = h5py.SoftLink(f"/{name}")
            elif kind == "outside":
                file.create_dataset(name, (64,), "u1", external=[("presses.csv", 0, 64)])
            elif kind == "group":
                file.create_group(name)
            elif kind == "virtual":
                layout = h5py.VirtualLayout((2**40,), "f8")
                file.create_virtual_dataset(name, layout, fillvalue=1)
    return f"{kind} {name}"


def matlab(rng: Rng, path: Path) -> str:
    """Variables as MATLAB keeps them, some replaced."""
    if h5py.is_hdf5(path):
        return hdf5(rng, path)
    variables = published(pick(rng, (2, 4, 4, 6)))
    name = pick(rng, sorted(variables))
    cell = np.empty((2, 2), object)
    cell[:] = [["a", 1.0], [None, np.nan]]
    cell[1, 0] = np.zeros(0)
    odd = (np.nan, np.inf, 1e308, "text", np.zeros((0, 4)), np.ones((1, 1)), np.ones((3, 3), bool), cell, {"a": {}})
    variables[name] = pick(rng, (*odd, np.full((4, 8), 1e300), np.ones((2, 3, 4)), 1j * np.ones((3, 8))))
    if rng.random() < 0.2:
        del variables[name]
    scipy.io.savemat(path, variables, do_compression=bool(rng.integers(2)))
    return f"variable {name}"


def archive(rng: Rng, path: Path) -> str:
    """Another content of one of the members of a .zip, which .npz and .3mf are: a sealed state, a model."""
    with zipfile.ZipFile(path) as file:
        members = {name: file.read(name) for name in file.namelist()}
    name = pick(rng, sorted(members))
    if name.endswith(".npy"):
        array = np.load(BytesIO(members[name]), allow_pickle=False)
        new, kind = BytesIO(), int(rng.integers(4))
        if kind == 0:
            np.save(new, np.array([{"a": 1}], object), allow_pickle=True)
        elif kind == 1:
            np.lib.format.write_array_header_2_0(
                new, {"descr": "<f8", "fortran_order": False, "shape": (pick(rng, _BOASTS),)}
            )
        else:
            np.save(new, array.astype(pick(rng, ("O", "S3", "U1"))) if kind == 2 else array.ravel()[:0])
        members[name] = new.getvalue()
    else:
        inner = path.with_name("member")
        inner.write_bytes(members[name])
        (numbers if rng.random() < 0.7 else some_bytes)(rng, inner)
        members[name] = inner.read_bytes()
        inner.unlink()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for each, content in members.items():
            file.writestr(each, content)
    return f"member {name}"


def weights(rng: Rng, path: Path) -> str:
    """Another header of a .safetensors, or other numbers, with the digest that its document then has to name."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header, data = json.loads(content[8 : 8 + length]), bytearray(content[8 + length :])
    names = sorted(set(header) - {"__metadata__"})
    name, kind = pick(rng, names), int(rng.integers(5))
    if kind == 0:
        header[name]["shape"] = pick(rng, ([pick(rng, _BOASTS)], [], [0], [2**20, 2**20], header[name]["shape"][::-1]))
    elif kind == 1:
        header[name]["dtype"] = pick(rng, ("F16", "I64", "BOOL", "F64", "X", "BF16"))
    elif kind == 2:
        header[name]["data_offsets"] = pick(rng, ([0, 2**62], [0, 0], [-1, 4], [8, 4]))
    elif kind == 3:
        del header[name]
    else:
        at = 4 * int(rng.integers(len(data) // 4))
        data[at : at + 4] = pick(rng, FLOATS)
    told = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", pick(rng, (len(told),) * 9 + (2**62,))) + told + bytes(data))
    document = path.with_suffix(".json")
    about = json.loads(document.read_text())
    about["weights_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    document.write_text(json.dumps(about))
    return f"weights {name}, {('shape', 'type', 'place', 'gone', 'value')[kind]}"


def database(rng: Rng, path: Path) -> str:
    """Another value in a database of SQLite, or other tables."""
    with closing(sqlite3.connect(path)) as file:
        tables = [name for (name,) in file.execute("select name from sqlite_master where type = 'table' order by name")]
        table = pick(rng, tables)
        columns = [row[1] for row in file.execute(f"pragma table_info({table})")]
        column = pick(rng, columns)
        if rng.random() < 0.15:
            file.execute(f"drop table {table}")
        elif rng.random() < 0.15:
            file.execute(f"create view other as select * from {table}")
            file.execute(f"alter table {table} rename to {table}_2")
        else:
            odd = (None, -1, 2**63 - 1, 1e308, "x", "", b"", b"\xff" * 40, "x" * 10**6, "std_msgs/msg/String")
            rows = file.execute(f"select rowid from {table}").fetchall()
            row = pick(rng, rows)[0] if rows else 0
            with suppress(sqlite3.Error):  # of a column that takes no such value
                file.execute(f"update {table} set {column} = ? where rowid = ?", (pick(rng, odd), row))
        file.commit()
    return f"table {table}.{column}"
