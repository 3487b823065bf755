"""Priors of the response of a pad, from its plan or from the maps of an earlier pad.

The signal of a fibre is linear in the sensitivity along it, and nearly linear in the lateral offset of its path from
the plan. Both are smooth along the fibre, so that some ten numbers define its whole map, and as many presses along it
determine them.
"""

import numpy as np

from padforge.common.settings import validate
from padforge.common.validation import InputError
from padforge.design import Contact, Morphology
from padforge.sense.arrays import Array
from padforge.sense.localizer.response_model import GRID_CELLS, grid_positions
from padforge.sense.localizer.response_process import ResponsePrior
from padforge.sense.recording.recording import Recording

N_NODES = 9  # points along a fibre between which its sensitivity and its lateral offset are linear
CORRELATION_LENGTH = 0.2  # of both, as a share of the fibre
OFFSET_MM = 2.0  # prior standard deviation of the lateral offset, mm, if that of the logarithm of the sensitivity is 1
WIDTHS = 1.0, 0.7  # widths of a held press, and of onset and residue, relative to that of the contact; see `[rig]`
RBF_SIDE = 6  # basis functions along a side that scale the maps of an earlier pad
RBF_STD = 0.4  # their standard deviation, scaled position


def planned_pad(recording: Recording, pad: Morphology | None = None) -> Morphology | None:
    """Return the plan of the pad of a recording: `pad`, or the one that the recording holds, if any.

    The plan in a recording of a twin is ignored, since the twin does not lie under the arm as planned.

    Raises:
        InputError: `pad` has another number of fibres than the recording.
    """
    if pad is not None and len(pad.knots) != recording.fibres:
        raise InputError(f"pad has {len(pad.knots)} fibres, the recording {recording.fibres}; expected as many")
    plan = recording.source.get("morphology")
    if pad is not None or plan is None or "twin" in recording.source:
        return pad
    recorded = Morphology.from_dict(plan)
    return recorded if len(recorded.knots) == recording.fibres else None


def stated_contact(recording: Recording) -> Contact:
    """Return the contact that a simulated recording states; the default one for any other recording."""
    return validate(Contact, recording.source.get("contact", {}), "recording: contact")


def plan_prior(pad: Morphology, contact: Contact, origin_mm: Array, scale_mm: float) -> ResponsePrior:
    """Return the prior of a pad from its plan: fibres with varying sensitivity and lateral offset.

    The plan is in the frame of the arm. A scaled position is 0 at `origin_mm` (2,), and `scale_mm` is its unit.
    """
    # compiled kernels take long to import
    from padforge.design.contact import signals, widened
    from padforge.design.kernels.element_signals import LAYER_PRECISION

    side, fibres = GRID_CELLS + 1, len(pad.knots)
    grid = pad.to_grid(grid_positions(side).reshape(-1, 2) * scale_mm + origin_mm)
    nodes = np.linspace(0, 1, N_NODES)
    covariance = np.exp(-0.5 * ((nodes[:, None] - nodes) / CORRELATION_LENGTH) ** 2)
    # Roots of the prior covariance: of offsets, and of log sensitivities, all of which also share a gain of variance 1
    smooth, with_gain = (np.linalg.cholesky(covariance + gain + 1e-6 * np.eye(N_NODES)) for gain in (0.0, 1.0))
    hats = [np.tile(hat, (fibres, 1)) for hat in np.eye(N_NODES)]
    parts = []
    for width in WIDTHS:
        # 1. Signal by the sensitivity at each node, scaled to a prior standard deviation of at most 1
        pressed = widened(contact, width)
        maps = [signals(pad, grid, pressed, precision=LAYER_PRECISION, sensitivity=hat) for hat in hats]
        maps = np.stack(maps, axis=2).reshape(side, side, fibres, N_NODES)
        maps /= np.linalg.norm(maps @ with_gain, axis=3).max(axis=(0, 1))[:, None]
        # 2. Signal by the offset at each node, in x and in y
        slopes = np.gradient(maps, 2 / GRID_CELLS, axis=(0, 1))
        parts += [maps @ with_gain, *(OFFSET_MM / scale_mm * slope @ smooth for slope in slopes)]
    return ResponsePrior(np.concatenate(parts, axis=3))


def map_prior(maps: Array) -> ResponsePrior:
    """Return the prior of a pad from the responses (S, S, C, F) of an earlier one, each fibre scaled smoothly."""
    envelope = np.sqrt((maps**2 / np.maximum((maps**2).max(axis=(0, 1)), 1e-12)).mean(axis=3))
    centres = np.linspace(-1, 1, RBF_SIDE)
    weights = np.exp(-0.5 * ((np.linspace(-1, 1, len(maps))[:, None] - centres) / RBF_STD) ** 2)
    rbf = np.einsum("xi,yj->xyij", weights, weights).reshape(*maps.shape[:2], -1)
    deviations = envelope[..., None] * rbf[:, :, None]
    scale = np.linalg.norm(deviations, axis=3).max(axis=(0, 1))
    return ResponsePrior(deviations / np.maximum(scale, 1e-12)[:, None], maps)
