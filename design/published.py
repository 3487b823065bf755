"""Files of the published study: MATLAB morphologies with the presses and signals they were sampled at."""

from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from .contact import signals_quantized
from .errors import InputError
from .morphology import Morphology
from .settings import Contact

PITCH_MM = 11.25
"""Pitch of the built pads."""


def load_mat(path: Path, needed: tuple[str, ...]) -> dict[str, Any]:
    """Read a MATLAB file and see that it holds the variables `needed`.

    Raises:
        InputError: the file is missing, torn, no MATLAB file, or lacks a variable.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a MATLAB file")
    try:
        content = scipy.io.loadmat(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # SciPy's reader raises whatever a torn stream leads it to
        raise InputError(f"{path}: not a readable MATLAB file, torn or of another kind ({error})") from error
    missing = [name for name in needed if name not in content]
    if missing:
        found = ", ".join(sorted(name for name in content if not name.startswith("__"))) or "nothing"
        raise InputError(f"{path}: has no variable {', '.join(missing)} (found {found})")
    return content


def load_morphology(path: Path) -> Morphology:
    """The morphology of a published `.mat`: `para`, or straight fibres where the file's own signals say so.

    The square-grid files carry a `para` that was never used; their samples fit straight fibres and not `para`.
    """
    content = load_mat(path, ("para",))
    try:
        pad = Morphology.from_parameters(content["para"], PITCH_MM)
    except (InputError, ValueError, TypeError) as error:
        raise InputError(f"{path}: {error}") from error
    straight = Morphology.straight(pad.grid, PITCH_MM)
    try:
        return straight if _misfit(straight, content) < 1e-9 < _misfit(pad, content) else pad
    except (InputError, ValueError, TypeError, IndexError, KeyError, AttributeError) as error:
        said = str(error).splitlines()[0]
        raise InputError(f"{path}: K, loc_all and sens_raw_all are not as published ({said})") from error


def _misfit(pad: Morphology, content: dict[str, Any], presses: int = 32) -> float:
    """Largest difference of the published samples to those of `pad`; 0 where the file has no samples."""
    if not {"K", "loc_all", "sens_raw_all"} <= content.keys():
        return 0.0
    settings = content["K"][0, 0]
    contact = Contact(radius=float(settings["object_size"].item()), sides=int(settings["str_shp"].item()))
    places, expected = content["loc_all"][:presses], content["sens_raw_all"][:presses]
    samples = int(settings["fineness"].item())
    weights = (contact, contact.model_copy(update={"weight": "inverse_square"}))
    return min(float(np.abs(signals_quantized(pad, places, c, samples) - expected).max()) for c in weights)
