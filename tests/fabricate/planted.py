from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from padforge.design.morphology import Morphology, assemble_knots
from padforge.fabricate.settings import DEFAULTS, FabricationSettings


def level_pad(first: float, second: float) -> Morphology:
    """A pad of 2 x 2 whose horizontals run level at y = `first` and `second` (grid units) from x = 1 to 2."""
    inner = np.empty((4, 2, 2))
    inner[:2, :, 0] = (1, 2)
    inner[:2, :, 1] = [[first], [second]]
    inner[2:, :, 0] = [[1], [2]]
    inner[2:, :, 1] = (1, 2)
    return Morphology(assemble_knots(inner), 10.0)


def winding_pad(*places: tuple[float, float]) -> Morphology:
    """A pad of 1 x 1 whose horizontal fibre runs through places (grid units, 0..2); its vertical one is straight."""
    along = 2 * np.arange(1, len(places) + 1) / (len(places) + 1)
    vertical = np.stack([np.ones(len(places)), along], axis=1)
    return Morphology(assemble_knots(np.stack([np.array(places, dtype=float), vertical])), 10.0)


def with_settings(
    mould: Mapping[str, object] | None = None, printer: Mapping[str, object] | None = None, **sections: Mapping
) -> FabricationSettings:
    """Return the defaults with some keys changed, section by section."""
    changed = {"mould": mould, "printer": printer, **sections}
    models = {name: type(getattr(DEFAULTS, name)) for name in changed}
    return replace(DEFAULTS, **{name: models[name].model_validate(keys or {}) for name, keys in changed.items()})


def exact_fibre(pad: Morphology, fibre: int, step_mm: float = 5e-3) -> np.ndarray:
    """(n, 2) mm: places of a fibre by scipy's own PCHIP, a step apart along it, and its knots."""
    family, knots = pad.layout.family(fibre), pad.to_mm(pad.knots[fibre])
    curve = PchipInterpolator(knots[:, family], knots[:, 1 - family])
    t = np.unique(np.linspace(knots[:-1, family], knots[1:, family], 3000))
    along = np.concatenate([[0], np.cumsum(np.hypot(np.diff(t), np.diff(curve(t))))])
    t = np.union1d(np.interp(np.arange(0, along[-1], step_mm), along, t), knots[:, family])
    return np.stack([t, curve(t)], axis=1)[:, :: -1 if family else 1]
