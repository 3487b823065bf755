"""Lost fibres: one test for both ways, and resumed work is the same work."""

import errno
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from padforge.design.common.validation import InputError
from padforge.sense import Recording, evaluate
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.settings import LocalizerSettings as Options
from padforge.sense.studies import fibre_loss as fibre_loss_figure
from padforge.sense.studies import fibre_loss as loss_study
from padforge.sense.studies.fibre_loss import MANY, ONE, fibre_loss_study
from tests.helpers.door import Ended, call


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A published network of three neurons, and a coarse map of the answers, which is not what is tested."""
    monkeypatch.setattr("padforge.sense.localizer.training.PUBLISHED_HIDDEN", 3)
    monkeypatch.setattr("padforge.sense.localizer.response_model.RBF_SIDE", 7)


def mean_of(part: dict) -> float:
    cells = part["by_position"]
    return float(np.average([cell["mean_mm"] for cell in cells], weights=[cell["presses"] for cell in cells]))


def test_one_network_is_judged_as_by_evaluate(localizer: LocalizerModel, recording: Recording) -> None:
    document, expected = (
        fibre_loss_study(recording, localizer, max_failures=2),
        evaluate(localizer, recording, (0, 1, 2)),
    )
    assert list(document["ways"]) == [ONE]
    way = document["ways"][ONE]
    assert (way["errors"], way["by_subset"]) == (expected["errors"], expected["by_subset"])
    assert way["maps"][0] == {"failed": [], "by_position": expected["by_position"]}
    worst = max((each for each in expected["by_subset"] if len(each["failed"]) == 2), key=lambda each: each["mean_mm"])
    assert way["maps"][2]["failed"] == worst["failed"]
    assert mean_of(way["maps"][2]) == pytest.approx(worst["mean_mm"])
    assert document["test_presses"] == expected["test_presses"]


def test_both_ways_stand_side_by_side_and_a_chosen_set_is_mapped(
    localizer: LocalizerModel, recording: Recording
) -> None:
    """Of more fibres, too, than are lost in the errors."""
    document = fibre_loss_study(recording, localizer, retrain=True, max_failures=1, failed=(3, 1, 3))
    plain = fibre_loss_study(recording, localizer, retrain=True, max_failures=1)
    assert list(document["ways"]) == [ONE, MANY]
    for name, way in document["ways"].items():
        assert [row["subsets"] for row in way["errors"]] == [1, 4]
        assert [each["failed"] for each in way["by_subset"]] == [[], [0], [1], [2], [3]]
        *worst, chosen = way["maps"]
        assert chosen["failed"] == [1, 3]
        assert {**way, "maps": worst} == plain["ways"][name]
    assert document["test_presses"] == len(localizer.test)
    assert document["training_presses"] == 300 - len(localizer.test)
    json.dumps(document, allow_nan=False)
    assert len(loss_study.fibre_loss_lines(document)) == 6
    expected = evaluate(localizer, recording, (2,))["by_subset"]
    (mean_mm,) = (each["mean_mm"] for each in expected if each["failed"] == [1, 3])
    assert mean_of(document["ways"][ONE]["maps"][-1]) == pytest.approx(mean_mm)
    for failed, message in (
        ((4,), "failed fibre is 4, allowed is a whole number from 0 to 3"),
        ((0, 1, 2, 3), "failed are all 4 fibres, at least one must be left"),
    ):
        with pytest.raises(InputError, match=message):
            fibre_loss_study(recording, localizer, failed=failed)


def test_a_retrained_network_is_not_told_of_its_test_nor_of_lost_fibres(recording: Recording) -> None:
    def retrained(changed: Recording) -> dict:
        return fibre_loss_study(changed, retrain=True, max_failures=1)["ways"][MANY]

    plain = retrained(recording)
    spoilt = recording.readings.copy()
    spoilt[:, 2] = np.random.default_rng(1).uniform(0, 3, len(spoilt))
    deaf = retrained(replace(recording, readings=spoilt))
    for each, other in zip(plain["by_subset"], deaf["by_subset"], strict=True):
        assert (each["mean_mm"] == other["mean_mm"]) == (each["failed"] == [2])
    test = np.sort(np.random.default_rng(0).permutation(300)[-45:])
    far = recording.presses_mm.copy()
    far[test] = 2e4  # whoever had learnt from one of them would find all of it elsewhere
    moved = retrained(replace(recording, presses_mm=far))
    centre = np.hypot(*(2e4 - recording.presses_mm[test]).T).mean()
    assert moved["errors"][0]["mean_mm"] == pytest.approx(centre, abs=30)


def stop_at(number: int) -> Callable[[int, int], None]:
    def interrupted(done: int, total: int) -> None:
        if done == number:
            raise KeyboardInterrupt

    return interrupted


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The sets of lost fibres that networks have been trained for since."""
    real, trained = loss_study.train_without, []

    def counted(lost: tuple[int, ...], *rest: object) -> object:
        trained.append(lost)
        return real(lost, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(loss_study, "train_without", counted)
    return trained


def test_broken_off_work_goes_on_and_gives_the_same(recording: Recording, tmp_path: Path, trained: list) -> None:
    wanted = {"retrain": True, "max_failures": 1, "failed": (0, 1)}
    whole = fibre_loss_study(recording, **wanted)
    kept = tmp_path / "unfinished"
    with pytest.raises(KeyboardInterrupt):
        fibre_loss_study(recording, **wanted, keep_in=kept, progress=stop_at(2))
    finished = len(list(kept.glob("start_*.npz")))
    assert finished >= 2
    with pytest.raises(InputError, match="begun with fibre-loss"):
        fibre_loss_study(recording, retrain=True, max_failures=1, options=Options(seed=1), keep_in=kept)
    trained.clear()
    for _ in range(2):
        assert fibre_loss_study(recording, **wanted, keep_in=kept) == whole
        assert len(trained) == 6 - finished
    with pytest.raises(InputError, match="neither a localizer nor retraining"):
        fibre_loss_study(recording)


@pytest.fixture
def here(localizer: LocalizerModel, recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The current folder holds a `model` and a recording `rec`."""
    localizer.save(tmp_path / "model")
    recording.save(tmp_path / "rec", {})
    monkeypatch.chdir(tmp_path)


def loss(*arguments: str) -> Ended:
    return call("sense", "fibre-loss", "rec", *arguments)


@pytest.mark.usefixtures("here")
def test_the_command_writes_a_document_and_a_figure() -> None:
    ended = loss("--model", "model", "--retrain", "--max-failures", "1", "--failed", "2,4", "--out", "out", "--json")
    assert (ended.code, json.loads(ended.out)["ways"][ONE]["maps"][-1]["failed"]) == (0, [1, 3])
    assert json.loads(ended.out) == json.loads(Path("out", "fibre_loss.json").read_text())
    assert Path("out", "fibre_loss.png").read_bytes()[:4] == b"\x89PNG"
    assert sorted(path.name for path in Path("out").iterdir()) == ["fibre_loss.json", "fibre_loss.png"]
    for arguments, said in (
        (("--out", "other"), "neither --model nor --retrain"),
        (("--model", "model", "--failed", "5"), "padforge: fibre 5: no such fibre, allowed are 1 to 4\n"),
    ):
        ended = loss(*arguments)
        assert (ended.code, ended.out, ended.err.count("\n")) == (2, "", 1)
        assert said in ended.err
    assert not Path("other").exists()


@pytest.mark.usefixtures("here")
def test_networks_are_kept_until_the_result_is_written(trained: list, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    command = ("--retrain", "--max-failures", "1", "--out", "out")
    with monkeypatch.context() as broken:
        broken.setattr("padforge.sense.studies.fibre_loss.draw_fibre_loss", full)
        ended = loss(*command)
    assert (ended.code, len(trained)) == (2, 5), ended
    assert len(list(Path("out", "unfinished").glob("start_*.npz"))) == 5
    assert not Path("out", "fibre_loss.json").exists()
    ended = loss(*command)
    assert (ended.code, len(trained)) == (0, 5), ended
    assert sorted(path.name for path in Path("out").iterdir()) == ["fibre_loss.json", "fibre_loss.png"]


def test_maps_of_errors_have_y_upwards(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(fibre_loss_figure, "save_figure", lambda figure, path: drawn.append(figure))
    errors = {"errors": [{"n_failed": 0, "subsets": 1, "mean_mm": 1.0}], "by_subset": [{"failed": [], "mean_mm": 1.0}]}
    cells = [{"x_mm": 0.0, "y_mm": y_mm, "mean_mm": mean_mm} for y_mm, mean_mm in ((-5.0, 1.0), (5.0, 9.0))]
    ways = {"one network": errors | {"maps": [{"failed": [], "by_position": cells}]}}
    fibre_loss_figure.draw_fibre_loss({"ways": ways, "test_presses": 2}, Path("none.png"))
    (image,) = (image for axes in drawn[0].axes for image in axes.images)
    assert image.origin == "lower"
    assert np.asarray(image.get_array())[-1, 0] == 9.0
    assert image.get_extent()[3] > 5
