"""Morphologies of the published study, with the presses and signals they were sampled at."""

from pathlib import Path
from typing import Any

import numpy as np
from padforge.design.common.errors import InputError, reals, whole
from padforge.design.pad.kernels.press import INVERSE_SQUARE, MANHATTAN, UNIFORM, Law, frames
from padforge.design.pad.kernels.published.sampled_signals import quantized_signals
from padforge.design.pad.knots import FARTHEST, Array, assemble, axes, of_parameters
from padforge.design.settings import Contact

from .matlab import load_mat

PITCH_MM = 11.25
"""Pitch of the built pads."""
MOST_SAMPLES = 2**20
"""Most points a fibre is sampled at."""


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
    settings = content["K"]
    contact = Contact(radius=float(settings["object_size"].item()), sides=int(settings["str_shp"].item()))
    places, expected = reals("loc_all", content["loc_all"][:presses], FARTHEST), content["sens_raw_all"][:presses]
    if places.ndim != 2 or places.shape[1] != 2:
        raise InputError(f"loc_all has shape {content['loc_all'].shape}, expected (Q, 2)")
    samples = whole("fineness", int(settings["fineness"].item()), 2, MOST_SAMPLES)
    horizontals = len(knots) // 2
    travel, cross = axes(knots[None], horizontals)
    misfits = []
    for weight in (UNIFORM, INVERSE_SQUARE):
        found = np.zeros((1, len(places), len(knots)))
        shape = (*frames(contact.radius, contact.sides), Law(contact.radius, weight, MANHATTAN))
        quantized_signals(travel, cross, horizontals, places, shape, samples, 0, len(knots), found)
        misfits.append(float(np.abs(found[0] - expected).max()))
    return min(misfits)
