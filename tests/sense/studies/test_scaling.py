"""Studies of larger surfaces and of other objects than were learnt from, in small."""

from pathlib import Path

import numpy as np
import pytest

from padforge.design import InputError, Morphology, signals
from padforge.sense.studies import scaling, sensitivity
from padforge.sense.studies.scaling import around, scaling_study, shares, spread_presses
from padforge.sense.studies.sensitivity import sensitivity_study
from padforge.sense.studies.study import run


def rows_of(document: dict, **wanted) -> list[dict]:
    return [row for row in document["rows"] if wanted.items() <= row.items()]


@pytest.mark.slow
def test_one_network_for_all_tiles_keeps_its_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("TEST", 600), ("HIDDEN", 30), ("EPOCHS", 30)):
        monkeypatch.setattr(scaling, name, value)
    document = run(scaling_study({"square": Morphology.straight(2)}, grids=(4, 16), side=32), tmp_path)
    small_shared, large_shared = (rows_of(document, way="shared", grid=grid)[0] for grid in (4, 16))
    assert large_shared["mean"] < 1.3 * small_shared["mean"] < 0.4
    assert large_shared["percent_of_side"] == pytest.approx(100 * large_shared["mean"] / 16)
    assert len(rows_of(document, way="published")) == len(rows_of(document, way="spread")) == 2


def test_shares_surroundings_and_presses_of_tiles() -> None:
    given = np.array([[1.0, 3.0, 0.0, 0.0], [0.0, 2.0, 5.0, 5.0]])
    np.testing.assert_allclose(shares(given), [[0.25, 0.75, 0, 0, 4, 0], [0, 1, 0.5, 0.5, 2, 10]])
    pad = Morphology.random(2, 3, 1).tiled(6)
    place = np.array([[5.2, 7.1]])
    here, origin = around(signals(pad, place), 2)
    there, moved = around(signals(pad, place + np.array([2.0, -4.0])), 2)
    np.testing.assert_allclose(here, there, atol=1e-9)
    np.testing.assert_array_equal(moved - origin, [[2.0, -4.0]])
    assert here.shape == (1, 12)
    places = spread_presses(((1, 1), (9, 9)), 8, 0)
    assert set(map(tuple, np.floor(places - 1).astype(int))) == {(x, y) for x in range(8) for y in range(8)}
    with pytest.raises(InputError, match="grids has 6, expected multiples of 4"):
        scaling_study({"square": Morphology.straight(4)}, grids=(4, 6))
    with pytest.raises(InputError, match=r"wide has 1 \+ 2 fibres, pitch 8 mm, expected tiles of M \+ M fibres"):
        scaling_study({"wide": Morphology.straight((1, 2), 8.0)}, grids=(4,))


@pytest.mark.slow
def test_a_larger_object_is_located_better(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("SIDE", 16), ("TEST", 300), ("MEMBERS", 2), ("HIDDEN", 15)):
        monkeypatch.setattr(sensitivity, name, value)
    document = run(sensitivity_study({"square": Morphology.straight(3)}, radii=(0.6, 1.0), sides=(4, 30)), tmp_path)
    assert len(document["rows"]) == 16

    def mean(trained: tuple, met: tuple) -> float:
        wanted = dict(zip(("trained_radius", "trained_sides", "radius", "sides"), (*trained, *met), strict=True))
        return next(row["mean"] for row in document["rows"] if wanted.items() <= row.items())

    assert mean((1.0, 30), (1.0, 30)) < 0.5 * mean((0.6, 30), (0.6, 30))
    assert mean((1.0, 30), (0.6, 30)) > 1.5 * mean((0.6, 30), (0.6, 30))
