"""Priors of the response: pads that are built by a plan lie among the maps of its prior."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense.localizer.response_model import GRID_CELLS, grid_positions
from padforge.sense.localizer.response_priors import map_prior, plan_prior, planned_pad, stated_contact
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.built_pad import build_pad, press_contacts

SIDE = GRID_CELLS + 1


def unexplained(maps: np.ndarray, deviations: np.ndarray) -> float:
    """Share of the variance of maps (S, S) that no sum of deviations (S, S, J) explains, with a slight ridge."""
    a, y = deviations.reshape(SIDE * SIDE, -1), maps.ravel()
    weights = np.linalg.solve(a.T @ a + 0.1 * np.eye(a.shape[1]), a.T @ y)
    return float((y - a @ weights).var() / y.var())


@pytest.mark.parametrize("path_mm", [0.0, 1.0])
def test_plan_prior_spans_pads_as_built(path_mm: float) -> None:
    """Uneven sensitivities are linear in it; paths beside their plan nearly so."""
    pad, rig, scale_mm = Morphology.random(2, knots=3, seed=5), RigSettings(path_mm=path_mm), 11.0
    contact, origin_mm = Contact(), np.array([1.0, -0.5])
    prior = plan_prior(pad, contact, origin_mm, scale_mm)
    positions_mm = grid_positions(SIDE).reshape(-1, 2) * scale_mm + origin_mm
    parts = build_pad(pad, rig).stretch(positions_mm, press_contacts(contact, rig))
    for fibre in range(4):
        shares = [unexplained(part[:, fibre].reshape(SIDE, SIDE), prior.deviations[:, :, fibre]) for part in parts]
        assert max(shares) < (0.02 if path_mm == 0 else 0.05)
        others = unexplained(parts.held[:, fibre].reshape(SIDE, SIDE), prior.deviations[:, :, (fibre + 2) % 4])
        assert others > 10 * shares[0]  # they are no maps of just anything
    variance = (prior.deviations**2).sum(axis=3)
    assert 1 <= variance.max() < 10  # of some unit, wherever it is largest


def test_map_prior_scales_maps_smoothly() -> None:
    rng, x = np.random.default_rng(0), grid_positions(SIDE)
    maps = np.exp(-0.5 * (x[..., :1] / 0.3) ** 2)[..., None] * np.array([1.0, -0.4])
    prior = map_prior(maps)
    assert prior.mean is maps
    scaled = maps[:, :, 0, 0] * (1 + 0.5 * np.sin(2 * x[..., 1] + rng.uniform(0, 6)))
    assert unexplained(scaled, prior.deviations[:, :, 0]) < 0.01
    assert unexplained(np.roll(scaled, SIDE // 2, axis=0), prior.deviations[:, :, 0]) > 0.3
    assert np.isfinite(map_prior(np.zeros((SIDE, SIDE, 1, 2))).deviations).all()  # of a fibre that was dead


def test_planned_pad_is_the_one_of_the_recording_unless_told(recording: Recording) -> None:
    plan = planned_pad(recording)
    assert plan is not None
    assert len(plan.knots) == recording.fibres
    assert stated_contact(recording) == Contact()
    foreign = replace(recording, source={})
    assert planned_pad(foreign) is None
    assert planned_pad(foreign, plan) is plan
    assert planned_pad(replace(recording, source={**recording.source, "twin": {}})) is None
