"""Recordings from MATLAB files."""

from pathlib import Path

import numpy as np
import scipy.io

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
