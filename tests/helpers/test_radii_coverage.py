"""What `radii_coverage` prints: a line per recording, and means of them with their standard errors."""

import re

import numpy as np
import pytest

from sense import LocalizerSettings
from tests.helpers import radii_coverage


def test_lines_and_their_means(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(radii_coverage, "PRESSES", (60, 90))
    monkeypatch.setattr(radii_coverage, "GRIDS", (2,))
    monkeypatch.setattr(
        radii_coverage, "LEARNT", LocalizerSettings(members=1, hidden=8, layers=1, epochs=3, test_share=0.4)
    )
    radii_coverage.main(4, 5)
    lines = capsys.readouterr().out.splitlines()
    rows = [line for line in lines if "tested" in line]
    assert [("chronological", "random")[number % 2] in row for number, row in enumerate(rows)] == [True] * 4
    presses = [int(re.findall(r"(\d+) presses", row)[0]) for row in rows]
    assert all(60 <= count <= 90 for count in presses)
    assert len(set(presses)) > 1
    shares = np.array([re.findall(r"\d\.\d{3}", row) for row in rows], float).reshape(4, 2, 4)
    assert ((shares >= 0) & (shares <= 1)).all()
    assert shares[:, 1].mean() > shares[:, 0].mean()  # more lie within r90 than within r50
    told = {line.partition(":")[0]: re.findall(r"(\S+) \+- (\S+)", line) for line in lines if "+-" in line}
    assert len(told) == 6
    for column, share in enumerate((50, 90)):
        found = np.array(told[f"all, 4 recordings, within r{share} with 0.. fibres lost"], float)
        np.testing.assert_allclose(found[:, 0], shares[:, column].mean(axis=0), atol=6e-4)
        np.testing.assert_allclose(found[:, 1], shares[:, column].std(axis=0, ddof=1) / 2, atol=1e-3)


def test_a_recording_is_the_same_again_and_another_one_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(radii_coverage, "PRESSES", (40, 60))
    monkeypatch.setattr(radii_coverage, "LEARNT", LocalizerSettings(members=1, hidden=8, layers=1, epochs=2))
    one, again, other = (str(radii_coverage.covered(number, 1)) for number in (0, 0, 2))
    assert one == again != other
