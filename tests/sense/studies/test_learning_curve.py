"""Learning curves: the power law is found again, forecasts follow, and broken off it ends at once."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.settings import LocalizerSettings as Options
from padforge.sense.studies.learning_curve import fit_power_law, learning_curve, power_law
from tests.helpers.door import called

QUICK = Options(hidden=8, layers=1, epochs=1, batch=64)


@settings(max_examples=20)
@given(floor=st.floats(0, 2), factor=st.floats(0.5, 100), exponent=st.sampled_from([0.2, 0.4, 0.5, 0.75, 1.0]))
def test_a_power_law_is_found_again(floor: float, factor: float, exponent: float) -> None:
    presses = np.array([50.0, 100, 200, 400, 800])
    errors = power_law(presses, (floor, factor, exponent))
    found = fit_power_law(presses, errors)
    ahead = np.array([1600.0])
    np.testing.assert_allclose(power_law(ahead, found), power_law(ahead, (floor, factor, exponent)), rtol=1e-3)


@settings(max_examples=20)
@given(errors=st.lists(st.floats(0.1, 10), min_size=5, max_size=5))
def test_a_fit_never_rises_with_more_presses(errors: list[float]) -> None:
    presses = np.array([50.0, 100, 200, 400, 800])
    fit = fit_power_law(presses, np.array(errors))
    along = power_law(np.geomspace(50, 3200, 9), fit)
    assert (np.diff(along) <= 1e-9).all()
    assert min(fit) >= 0


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Few resamplings, and a coarse map of the answers."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("padforge.sense.studies.learning_curve.DRAWS", 40)
        patched.setattr("padforge.sense.localizer.response_model.RBF_SIDE", 7)
        yield


@pytest.fixture(scope="module")
def document(recording: Recording) -> dict[str, Any]:
    return learning_curve(recording, QUICK)


def test_it_is_said_what_more_presses_would_bring(
    document: dict[str, Any], recording: Recording, tmp_path: Path
) -> None:
    assert [point["presses"] for point in document["points"]] == [16, 32, 64, 128, 255]
    assert all(0.02 < point["standard_error_mm"] / point["mean_mm"] < 0.2 for point in document["points"])
    ahead = document["forecast"]
    assert ahead["presses"] == 510
    assert 0 < ahead["low_mm"] <= ahead["mean_mm"] <= ahead["high_mm"] <= document["points"][-1]["mean_mm"] + 1e-9
    assert "255 more presses" in document["advice"]
    assert (document["settings"]["members"], document["test_presses"]) == (1, 45)
    json.dumps(document, allow_nan=False)
    recording.save(tmp_path / "rec", {})
    (tmp_path / "pad.toml").write_text("[localizer]\nhidden = 8\nlayers = 1\nepochs = 1\nbatch = 64\n")
    ended = called("sense", "learning-curve", "rec", "--out", "out", "--json", cwd=tmp_path)
    found = json.loads(ended.out)
    assert (ended.code, found) == (0, json.loads((tmp_path / "out/learning_curve.json").read_text()))
    assert found | {"provenance": None} == json.loads(json.dumps(document)) | {"provenance": None}
    assert (tmp_path / "out/learning_curve.png").read_bytes()[:4] == b"\x89PNG"


def test_a_curve_of_too_few_presses_is_refused_and_one_broken_off_ends_at_once(recording: Recording) -> None:
    places = recording.presses_mm.copy()
    places[100:] = np.nan
    with pytest.raises(InputError, match="85 presses to learn from, expected at least 160"):
        learning_curve(replace(recording, presses_mm=places), QUICK)
    long, heard = QUICK.model_copy(update={"epochs": 1000}), []

    def interrupted(done: int, total: int) -> None:
        heard.append(done / total)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learning_curve(recording, long, progress=interrupted)
    assert max(heard) < 0.5
