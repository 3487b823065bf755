"""The study of robustness, and what its files say; that it goes on where it was broken off."""

import csv
import json
import os
import signal
from collections.abc import Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense.studies import robustness
from padforge.sense.studies.robustness import robustness_study
from padforge.sense.studies.study import Study, load_pads, run

PADS = {"square": Morphology.straight(2), "random": Morphology.random(2, 3, 0)}


def small(**options) -> Study:
    return robustness_study(PADS, max_failures=2, hidden=10, presses=144, test=300, **options)


def least(pads: Mapping[str, Morphology], test: int = 20, contact: Contact | None = None) -> Study:
    """Two tasks a pad, of hardly any work."""
    return robustness_study(pads, max_failures=1, hidden=4, presses=16, test=test, contact=contact)


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("robustness")
    return folder, run(small(), folder)


def rows_of(document: dict, **wanted) -> list[dict]:
    return [row for row in document["rows"] if wanted.items() <= row.items()]


def test_robustness_tells_the_errors_of_every_set_of_lost_fibres_and_its_files_say_the_same(
    studied: tuple[Path, dict],
) -> None:
    folder, document = studied
    assert [(row["pad"], row["n_failed"], row["subsets"]) for row in document["rows"]] == [
        (pad, lost, sets) for pad in PADS for lost, sets in ((0, 1), (1, 4), (2, 6))
    ]
    for pad in PADS:
        none, one, two = rows_of(document, pad=pad)
        assert none["mean"] < one["mean"] < two["mean"] <= two["max"]
        assert none["mean_mm"] == pytest.approx(11.25 * none["mean"])
        by_subset = [each for each in document["by_subset"] if each["pad"] == pad and len(each["failed"]) == 2]
        assert two["mean"] == pytest.approx(np.mean([each["mean"] for each in by_subset]))
        worst = max(by_subset, key=lambda each: each["mean"])
        assert [each["failed"] for each in document["maps"] if each["pad"] == pad][2] == worst["failed"]
    # A map of the square grid without both horizontal fibres: off by the height, which nothing tells any more.
    assert rows_of(document, pad="square", lost=2)[0]["max"] > 0.2
    assert json.loads((folder / "robustness.json").read_text()) == json.loads(json.dumps(document))
    with (folder / "robustness.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [float(row["mean"]) for row in table] == [row["mean"] for row in document["rows"]]
    text = (folder / "robustness.md").read_text()
    assert all(paragraph in text for paragraph in document["text"])
    assert f"{document['rows'][0]['mean']:.4g}" in text


@pytest.mark.slow
def test_published_errors_are_reproduced(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean errors with all fibres and with one lost, as measured by others with the same protocol."""
    monkeypatch.setattr(robustness, "NETWORKS", 4)
    expected = {"square_grid_cir": (0.217, 0.216), "5para_dis": (0.065, 0.099), "20para": (0.056, 0.080)}
    pads = load_pads(tuple(str(published / f"{name}.mat") for name in expected), 0)
    document = run(robustness_study(pads, max_failures=1), tmp_path)
    for name, errors in expected.items():
        assert [row["mean"] for row in rows_of(document, pad=name)] == pytest.approx(errors, rel=0.15)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_loses_a_worker_finds_the_same(tmp_path: Path) -> None:
    """Its only one: another is started in its place, and goes on."""
    distributed = pytest.importorskip("distributed")
    study = least({"a": Morphology.straight(1), "b": Morphology.random(1, 1)})
    here = run(study, tmp_path / "here")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        victim = next(iter(client.run(os.getpid).values()))

        def progress(done: int, total: int, name: str) -> None:
            if done == 1:
                os.kill(victim, signal.SIGKILL)

        executor = client.get_executor(pure=False, retries=10)
        there = run(study, tmp_path / "there", executor=cast(Executor, executor), progress=progress)
        with pytest.raises(ProcessLookupError):
            os.kill(victim, 0)
    assert there["rows"] == here["rows"]


def test_any_name_of_a_file_will_do(tmp_path: Path) -> None:
    names = ("_under", "a$\\frac$", "pi|pe <b>", b"\xff".decode(errors="surrogateescape"))
    paths = [tmp_path / name / "morphology.json" for name in names]
    for path in paths:
        PADS["random"].save(path)
    pads = load_pads(tuple(map(str, paths)), 0)
    document = run(robustness_study(pads, max_failures=0, hidden=5, presses=16, test=20), tmp_path / "out")
    assert [row["pad"] for row in document["rows"]] == list(pads)
    assert len(pads) == len(names)
    for table in (tmp_path / "out" / "robustness.md").read_text().splitlines()[-len(names) :]:
        assert table.replace("\\|", "").count("|") == len(document["rows"][0]) + 1
        assert "<b>" not in table


def test_a_pad_that_no_press_touches_is_studied_and_maps_are_as_wide_as_what_is_pressed(
    tmp_path: Path,
) -> None:
    """Of 2 verticals 8 mm apart and 3 horizontals 15 mm apart."""
    document = run(least(PADS, test=300, contact=Contact(radius=1e-6)), tmp_path)
    # Nothing is told, so the middle of the pad is the best guess: half a grid unit off each way at most.
    assert all(0.3 < row["mean"] < 0.5 for row in document["rows"])
    pad = Morphology.straight((3, 2), (8.0, 15.0))
    document = run(robustness_study({"tall": pad}, max_failures=0, hidden=4, presses=16, test=10), tmp_path)
    left, right, low, high = document["maps"][0]["extent"]
    assert ((right - left) * pad.unit_mm, (high - low) * pad.unit_mm) == pytest.approx((8, 30))
    assert document["rows"][0]["mean_mm"] == pytest.approx(document["rows"][0]["mean"] * np.sqrt(8 * 15))
