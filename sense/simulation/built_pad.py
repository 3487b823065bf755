"""A simulated pad as it comes out of the mould: fibres beside their plan, with a sensitivity that varies along them.

The response to a press has four parts: held, that of the contact; onset, while the probe moves; creep, by which the
held part relaxes; and the residue after the release. `[rig]` states the widths of the last three, and each part has its
own sensitivity along the fibres. The readings of one press therefore differ in how they depend on the position, as on a
built pad.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from padforge.design import Contact, Morphology
from padforge.design.contact import signals, widened
from padforge.design.morphology import split_axes
from padforge.design.paths.curves import lengths
from padforge.sense.arrays import Array
from padforge.sense.settings import RigSettings

T = TypeVar("T")
SMOOTH_MM = 8.0  # half of the shortest wavelength in the sensitivity along a fibre, and in the deviation of its path
SAMPLES = 65  # samples of the sensitivity along the axis of a fibre
KNOTS_PER_WAVE = 8  # knots of an as-built path in each half wave


class PressParts(NamedTuple, Generic[T]):
    """Responses, or other quantities, of the four parts of a press."""

    held: T
    onset: T  # initial response, which becomes the held one with a lag
    creep: T  # part of the held response that is lost while the probe rests
    after: T  # residue after the release, with the opposite sign


def build_pad(plan: Morphology, rig: RigSettings) -> "BuiltPad":
    """Build a pad by a plan and `[rig]`; the same seed gives the same pad."""
    return BuiltPad.sample(plan, rig, np.random.default_rng([2, rig.seed]))


@dataclass(frozen=True)
class BuiltPad:
    """Fibres of a pad as built."""

    paths: Morphology
    sensitivities: PressParts[Array] | None = None  # along the axis of each fibre, shapes (F, SAMPLES); None is uniform

    @cached_property
    def _lengths(self) -> Array:
        return lengths(self.paths)

    @classmethod
    def sample(cls, plan: Morphology, rig: RigSettings, rng: np.random.Generator) -> "BuiltPad":
        """Sample a pad that is built by a plan, with the deviations that `[rig]` states."""
        paths = _deviate(plan, rig.path_mm, rng) if rig.path_mm else plan
        if not (rig.sensitivity or rig.own_sensitivity):
            return cls(paths)
        common, *others = (_log_sensitivity(plan, rng) for _ in PressParts._fields)
        of_parts = (np.zeros_like(common), *others)  # what a part adds to the sensitivity that all have in common
        factors = [np.exp(rig.sensitivity * common + rig.own_sensitivity * each) for each in of_parts]
        return cls(paths, PressParts(*(each / each.mean(axis=1, keepdims=True) for each in factors)))

    def stretch(self, positions_mm: Array, contacts: PressParts[Contact]) -> PressParts[Array]:
        """Compute the relative stretch (Q, F) of the fibres by presses (Q, 2), with a contact for each part."""
        presses, parts = self.paths.to_grid(positions_mm), []
        for contact, sensitivity in zip(contacts, self.sensitivities or [None] * len(contacts), strict=True):
            parts.append(signals(self.paths, presses, contact, sensitivity=sensitivity) / self._lengths)
        return PressParts(*parts)


def press_contacts(contact: Contact, rig: RigSettings) -> PressParts[Contact]:
    """Return the contacts of the parts of a press, as wide as `[rig]` says."""
    after = widened(contact, rig.after_width)
    return PressParts(contact, widened(contact, rig.onset_width), after, after)


def _deviate(plan: Morphology, deviation_mm: float, rng: np.random.Generator) -> Morphology:
    """Return a pad whose paths deviate across their axes by a standard deviation; fibre ends stay where they are."""
    from scipy.interpolate import PchipInterpolator

    horizontals, knots = plan.layout.counts[0], []
    along, across = (axis[0] for axis in split_axes(plan.knots[None], horizontals))
    extents_mm = plan.unit_mm * (along[:, -1] - along[:, 0])
    at = np.linspace(0, 1, KNOTS_PER_WAVE * _waves(extents_mm.max()) + 1)
    for fibre, (t, v) in enumerate(zip(along, across, strict=True)):
        modes = np.sin(np.pi * np.outer(at, np.arange(1, _waves(extents_mm[fibre]) + 1)))
        offset = deviation_mm / plan.unit_mm * np.sqrt(2 / modes.shape[1]) * modes @ rng.standard_normal(modes.shape[1])
        t_new = t[0] + at * (t[-1] - t[0])
        path = np.stack([t_new, PchipInterpolator(t, v)(t_new) + offset], axis=1)
        path[[0, -1]] = [(t[0], v[0]), (t[-1], v[-1])]
        knots.append(path if fibre < horizontals else path[:, ::-1])
    return Morphology.from_layout(np.clip(np.stack(knots), 0, plan.layout.extent), plan.layout)


def _log_sensitivity(plan: Morphology, rng: np.random.Generator) -> Array:
    """Sample a smooth function (F, SAMPLES) of zero mean and unit variance along each fibre."""
    at, rows = np.linspace(0, 1, SAMPLES), []
    for extent in np.repeat(plan.unit_mm * np.array(plan.layout.extent), plan.layout.counts):
        modes = np.cos(np.pi * np.outer(at, np.arange(1, _waves(extent) + 1)))
        falling = 1 / np.arange(1, modes.shape[1] + 1)
        rows.append(np.sqrt(2 / (falling**2).sum()) * (falling * modes) @ rng.standard_normal(modes.shape[1]))
    return np.array(rows)


def _waves(extent_mm: float) -> int:
    """Return the number of half waves of at least `SMOOTH_MM` in an extent."""
    return max(int(extent_mm / SMOOTH_MM), 1)
