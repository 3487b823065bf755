"""Recordings from MATLAB files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from padforge.common.validation import InputError
from padforge.sense import import_mat

MAT = "para5_long_first4500.mat"


def test_import_mat_reads_the_published_recording(published: Path) -> None:
    recording = import_mat(published / MAT)
    content = scipy.io.loadmat(published / MAT)
    assert np.array_equal(recording.readings, content["voltage"])
    assert np.array_equal(recording.presses_mm, content["pos"].T)
    assert np.array_equal(recording.times_s, content["tim"].ravel())
    assert recording.down_command[:3].tolist() == [20, 60, 100]
    assert recording.up_command[:3].tolist() == [40, 80, 120]


def published_content() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "voltage": rng.uniform(1, 2, (120, 4)),
        "pos": rng.uniform(-9, 9, (2, 3)),
        "tim": np.arange(120.0)[None] / 13,
    }


@pytest.mark.parametrize(
    ("rows", "presses", "n_complete", "note"),
    [
        (120, 3, 3, None),
        (111, 3, 2, "the last of 3 presses is left out, with 31 of 40 readings"),
        (100, 2, 2, "the last 20 readings belong to no press"),
    ],
)
def test_import_mat_notes_incomplete_presses(
    tmp_path: Path, rows: int, presses: int, n_complete: int, note: str | None
) -> None:
    content = published_content()
    cut = {"pos": content["pos"][:, :presses], "voltage": content["voltage"][:rows], "tim": content["tim"][:, :rows]}
    scipy.io.savemat(tmp_path / "r.mat", cut)
    recording = import_mat(tmp_path / "r.mat")
    assert np.array_equal(recording.readings, cut["voltage"])
    assert np.array_equal(recording.presses_mm, cut["pos"].T[:n_complete])
    assert recording.up_command.tolist() == [40, 80, 120][:n_complete]
    assert recording.source.get("note") == note


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("voltage", np.ones((79, 4)), r"voltage has shape \(79, 4\), expected 40 rows for each of the 3 presses"),
        ("voltage", scipy.sparse.csc_matrix(np.ones((120, 4))), "voltage is a sparse matrix, expected a full matrix"),
    ],
)
def test_import_mat_refuses_variables_that_do_not_fit(tmp_path: Path, name: str, value: Any, message: str) -> None:
    content = {key: each for key, each in (published_content() | {name: value}).items() if each is not None}
    scipy.io.savemat(tmp_path / "bad.mat", content)
    with pytest.raises(InputError, match=message) as caught:
        import_mat(tmp_path / "bad.mat")
    assert "\n" not in str(caught.value)


def test_import_mat_accepts_any_types_gaps_and_no_positions(tmp_path: Path) -> None:
    content = published_content()
    holed = content["voltage"].astype(np.float32)
    holed[:, 2] = holed[50:55] = np.nan
    for change in (
        {"voltage": np.rint(content["voltage"] * 200).astype(np.uint16)},
        {"voltage": holed, "tim": content["tim"].T, "pos": content["pos"].T},
    ):
        scipy.io.savemat(tmp_path / "r.mat", content | change)
        recording = import_mat(tmp_path / "r.mat")
        assert np.array_equal(recording.readings, (content | change)["voltage"], equal_nan=True)
        assert np.array_equal(recording.times_s, (content | change)["tim"].ravel())
        assert np.array_equal(recording.presses_mm, content["pos"].T)
    scipy.io.savemat(tmp_path / "blind.mat", {name: content[name] for name in ("voltage", "tim")})
    blind = import_mat(tmp_path / "blind.mat")
    assert not blind.has_position.any()
    assert blind.down_command.tolist() == [20, 60, 100]
    content["pos"][:, 1] = np.nan
    scipy.io.savemat(tmp_path / "partly.mat", content)
    assert import_mat(tmp_path / "partly.mat").has_position.tolist() == [True, False, True]
