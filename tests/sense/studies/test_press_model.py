"""What fibres respond to the presses of a study."""

import numpy as np
import pytest

from padforge.design import Contact, Morphology, signals
from padforge.design.contact import relative_stretch
from padforge.design.settings import PUBLISHED_CONTACT, Scatter
from padforge.sense.studies.multicontact import METHODS, multicontact_study
from padforge.sense.studies.press_model import PUBLISHED_PRESSES, PressModel
from padforge.sense.studies.scaling import METHODS as SCALING_METHODS
from padforge.sense.studies.scaling import scaling_study
from padforge.sense.studies.study import Sizes

PAD = Morphology.random(2, 3, 0)
PAIRS = np.random.default_rng(1).uniform(1, 2, (20, 2, 2))
LAYER = PressModel(Contact(), Scatter(0.02, 0.1, 0.5))
QUIET = PressModel(Contact(), Scatter(1e-9))


def respond(model: PressModel, presses: np.ndarray, present: np.ndarray | None = None) -> np.ndarray:
    return model.respond(PAD, presses, np.random.default_rng(0), present)


def test_published_responses_are_exact_signals() -> None:
    np.testing.assert_array_equal(respond(PUBLISHED_PRESSES, PAIRS), signals(PAD, PAIRS, PUBLISHED_CONTACT))


def test_layer_responds_with_scatter_about_the_stretch_in_units_of_full_scale() -> None:
    exact = respond(QUIET, PAIRS[:, 0])
    stretch = relative_stretch(PAD, PAIRS[:, 0], Contact())
    assert np.ptp(exact / stretch) < 1e-6
    assert 0.5 < exact.max() < 2
    repeated = np.repeat(PAIRS[:1, 0], 4000, axis=0)
    sampled = respond(LAYER, repeated)
    noise = 0.02 * 0.182 * (exact / stretch)[0, 0]  # the same strain whatever the full scale
    assert sampled.mean(axis=0) == pytest.approx(exact[0], abs=0.01)
    assert sampled.std(axis=0) == pytest.approx(np.hypot(0.1 * exact[0], noise), rel=0.06)


@pytest.mark.parametrize("model", [PUBLISHED_PRESSES, QUIET])
def test_responses_of_simultaneous_presses_add(model: PressModel) -> None:
    first, second = (respond(model, PAIRS[:, number]) for number in (0, 1))
    np.testing.assert_allclose(respond(model, PAIRS), first + second, atol=1e-6)
    present = np.tile([True, False], (len(PAIRS), 1))
    np.testing.assert_allclose(respond(model, PAIRS, present), first, atol=1e-6)


def test_studies_of_several_contacts_and_of_scaling_locate_under_a_layer() -> None:
    """Also on a pad that is not square, for contacts."""
    pads, sizes = {"wide": Morphology.straight((2, 3), 8.0)}, Sizes(300, 100, hidden=10, members=1, epochs=10)
    study = multicontact_study(pads, press_model=LAYER, sizes=sizes)
    free = study.tasks[list(METHODS).index("free")].compute()
    assert free["predicted"].shape == (100, 2, 2)
    assert np.isfinite(free["predicted"]).all()
    study = scaling_study({"square": Morphology.straight(3, 8.0)}, press_model=LAYER, grids=(6,), side=16)
    errors = [task.compute()["errors"].mean() for task in study.tasks]
    assert len(errors) == len(SCALING_METHODS)
    assert max(errors) < 0.5
