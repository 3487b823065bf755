"""Files of the published study: MATLAB morphologies with the presses and signals they were sampled at."""

import faulthandler
import io
import os
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from design.common.errors import InputError, reals, whole
from design.common.files import read_bytes
from design.settings import Contact

from .kernels.press import INVERSE_SQUARE, MANHATTAN, UNIFORM, Law, frames
from .kernels.published.sampled_signals import quantized_signals
from .knots import FARTHEST, Array, assemble, axes, of_parameters

PITCH_MM = 11.25
"""Pitch of the built pads."""
MOST_BYTES = 2**29
"""Unpacked; the longest published recording is far below."""
MOST_SAMPLES = 2**20
"""Most points a fibre is sampled at."""
_PACKED, _PIECE = 15, 2**20
"""Kind of the elements of a MATLAB file that are packed, and how much of them is unpacked at a time, bytes."""


def load_mat(path: Path, needed: tuple[str, ...]) -> dict[str, Any]:
    """Read a MATLAB file and see that it holds the variables `needed`.

    Raises:
        InputError: the file is missing, torn, no MATLAB file, or lacks a variable.
    """
    stored = read_bytes(path)
    try:
        _refuse_swollen(stored)
        _refuse_crashing(stored)
        content = scipy.io.loadmat(io.BytesIO(stored))
    except Exception as error:  # SciPy's reader raises whatever a torn stream leads it to
        raise InputError(f"{path}: not a readable MATLAB file, torn or of another kind ({error})") from error
    missing = [name for name in needed if name not in content]
    if missing:
        found = ", ".join(sorted(name for name in content if not name.startswith("__"))) or "nothing"
        raise InputError(f"{path}: has no variable {', '.join(missing)} (found {found})")
    return content


def _refuse_swollen(stored: bytes) -> None:
    """Raise ValueError where the packed variables of a file unpack to more than MOST_BYTES together."""
    order, at, size = "<" if stored[126:128] == b"IM" else ">", 128, 0
    while at + 8 <= len(stored):
        kind, length = struct.unpack_from(f"{order}II", stored, at)
        packed, unpacker = stored[at + 8 : at + 8 + length], zlib.decompressobj()
        while kind == _PACKED and packed and not unpacker.eof:
            size += len(unpacker.decompress(packed, _PIECE))
            packed = unpacker.unconsumed_tail
            if size > MOST_BYTES:
                raise ValueError(f"it unpacks to more than {MOST_BYTES} bytes")
        at += 8 + length


def _refuse_crashing(stored: bytes) -> None:
    """Raise ValueError where SciPy's compiled reader would take the whole process down: a child tries it first."""
    if not hasattr(os, "fork"):
        return
    child = os.fork()
    if child == 0:
        try:
            faulthandler.disable()
            warnings.simplefilter("ignore")
            scipy.io.loadmat(io.BytesIO(stored))
        except BaseException:  # it is for the parent to tell
            pass
        finally:
            os._exit(0)
    if os.WIFSIGNALED(os.waitpid(child, 0)[1]):
        raise ValueError("the reader breaks down over it")


def read_knots(path: Path) -> Array:
    """Knots (2M, N+2, 2) of a published `.mat`: `para`, or straight fibres where the file's own signals say so.

    The square-grid files carry a `para` that was never used; their samples fit straight fibres and not `para`.

    Raises:
        InputError: the file is missing, torn, of another kind, or its variables are not as published.
    """
    content = load_mat(path, ("para",))
    try:
        knots = of_parameters(content["para"])
    except (InputError, ValueError, TypeError) as error:
        raise InputError(f"{path}: {error}") from error
    straight = assemble(np.empty((len(knots), 0, 2)))
    try:
        return straight if _misfit(straight, content) < 1e-9 < _misfit(knots, content) else knots
    except (InputError, ValueError, TypeError, IndexError, KeyError, AttributeError) as error:
        said = str(error).splitlines()[0]
        raise InputError(f"{path}: K, loc_all and sens_raw_all are not as published ({said})") from error


def _misfit(knots: Array, content: dict[str, Any], presses: int = 32) -> float:
    """Largest difference of the published samples to those of fibres; 0 where the file has no samples."""
    if not {"K", "loc_all", "sens_raw_all"} <= content.keys():
        return 0.0
    settings = content["K"][0, 0]
    contact = Contact(radius=float(settings["object_size"].item()), sides=int(settings["str_shp"].item()))
    places, expected = reals("loc_all", content["loc_all"][:presses], FARTHEST), content["sens_raw_all"][:presses]
    if places.ndim != 2 or places.shape[1] != 2:
        raise InputError(f"loc_all has shape {content['loc_all'].shape}, expected (Q, 2)")
    samples = whole("fineness", int(settings["fineness"].item()), 2, MOST_SAMPLES)
    travel, cross = axes(knots[None])
    misfits = []
    for weight in (UNIFORM, INVERSE_SQUARE):
        found = np.zeros((1, len(places), len(knots)))
        shape = (*frames(contact.radius, contact.sides), Law(contact.radius, weight, MANHATTAN))
        quantized_signals(travel, cross, places, shape, samples, 0, len(knots), found)
        misfits.append(float(np.abs(found[0] - expected).max()))
    return min(misfits)
