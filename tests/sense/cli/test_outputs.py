"""What commands print and write of small recordings, kept as a whole.

Numbers of the Bayesian localizers may differ by some per cent, those of networks are left out.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense import Recording
from padforge.sense.cli.options import Prediction
from padforge.sense.health.domain_shift import DomainShift
from padforge.sense.health.fault_detector import HEALTH_FILES, FaultDetector, FibreFault
from padforge.sense.localizer import training
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.folders import files_in
from tests.helpers.golden import Golden
from tests.helpers.presses import changed
from tests.sense.cli.conftest import Run
from tests.sense.conftest import first_presses

RTOL = 0.05
"""Of what a network was trained for."""


class Session:
    """A terminal session: the commands, what they printed, and their exit codes where these are not 0."""

    def __init__(self, run: Run) -> None:
        self.run, self.lines = run, list[str]()

    def __call__(self, words: str) -> str:
        code, out, err = self.run(*words.split())
        ended = [f"(exit {code})"] if code else []
        self.lines += [f"$ padforge sense {words}", *err.splitlines(), *out.splitlines(), *ended, ""]
        return out

    def head(self, file: str, lines: int) -> None:
        self.lines += [f"$ head -{lines} {file}", *Path(file).read_text().splitlines()[:lines], ""]

    @property
    def text(self) -> str:
        return "\n".join(self.lines)


@pytest.mark.usefixtures("blank")
def test_session_of_few_presses(few: Run, golden: Golden, monkeypatch: pytest.MonkeyPatch) -> None:
    """A calibration is evaluated, exported and followed; presses in the wrong unit and a misplaced one are doubtful."""
    monkeypatch.setattr(training, "RETRAINING_STEPS", 15)
    monkeypatch.setattr("padforge.sense.deploy.onnx_export.N_TRIALS", 3)
    good, session, before = Recording.open("rec"), Session(few), files_in("model")
    shutil.copytree("rec", "torn")
    Path("torn/readings.bin").write_bytes(Path("rec/readings.bin").read_bytes()[:-100])
    first_presses(good, 4).save("short", {})
    replace(good, presses_mm=good.presses_mm / 1000).save("metres", {})
    changed(good, "presses_mm", 7, (250, 3)).save("typo", {})
    Morphology.straight(2).save(Path("plan.json"))
    session("calibrate rec --out new")
    session("calibrate metres --out m --without moments --without figures")
    session("evaluate --model model typo --max-failures 1")
    session("evaluate --model model torn --max-failures 0")
    session("locate --model model rec")
    session.head("places.csv", 4)
    session("export short short.csv")
    session.head("short.csv", 2)
    session("import short.csv")
    session("import --show short.csv")
    session("export short short.mcap --model model")
    session("import short.mcap --out again")
    session("export short set --format lerobot --model model")
    session("deploy --model model short localizer.onnx")
    session("record --presses 20 --seed 2 --out later/recording")
    for name in HEALTH_FILES:  # of an earlier model, and this one has none
        Path("later", name).parent.mkdir(exist_ok=True)
        Path("later", name).touch()
    session("recalibrate --model model later/recording --morphology plan.json")
    assert not HEALTH_FILES & files_in("later").keys()
    golden("cli/few.txt", session.text, rtol=RTOL, forget=[r"[\d.]+(?= µm)", r" *\d+\.\d%"])
    assert files_in("model") == before
    assert Path("later/localizer.json").read_bytes() != before["localizer.json"]


def test_session_of_depth_and_force(deep: Run, golden: Golden) -> None:
    session = Session(deep)
    session("evaluate --model model rec --max-failures 1")
    session("locate --model model rec")
    session.head("places.csv", 4)
    golden("cli/deep.txt", session.text, forget=[r"[ ,]*-?\d+\.\d+%?"])


def test_session_of_faulty_fibres_and_of_another_pad(enough: Run, golden: Golden) -> None:
    """A fibre is stuck from the 60th of the last 120 presses on, another one has moved, and a pad was cast again."""
    whole, session = Recording.open("rec"), Session(enough)
    readings, first = np.array(whole.readings), whole.up_command[239]
    readings[whole.down_command[300] - 15 :, 2] = readings[whole.down_command[300] - 15, 2]
    edges = whole.down_command[240:] - first, whole.up_command[240:] - first
    stuck = Recording(readings[first:], whole.times_s[first:], whole.presses_mm[240:], *edges)
    stuck.save("stuck", {})
    part = first_presses(whole, 120)
    changed(part, "readings", np.s_[:, 1], part.readings[:, 1] + 0.33).save("moved", {})
    again = simulate(Morphology.straight(2), RigSettings(presses=30, seed=14))
    again.save("again", {})
    session("health --model model rec")
    for name in ("stuck", "moved", "again"):
        session(f"health --model model {name}")
        session(f"locate --model model {name} --out {name}.csv")
    session("locate --model model stuck --exclude-fibres 3 --out masked.csv")
    session("locate --model model moved --exclude-fibres 2")
    golden("cli/health.txt", session.text)
    found = {name: json.loads(enough("health", "--model", "model", name, "--json")[1]) for name in ("stuck", "moved")}
    golden("cli/health.json", found)
    expected_mm = LocalizerModel.load("model").predict(again).positions_mm  # no fibre is masked
    np.testing.assert_allclose(np.loadtxt("again.csv", delimiter=",", skiprows=1)[:, 1:3], expected_mm, atol=1e-4)
    places, masked = (Path(name).read_text().splitlines()[1:] for name in ("stuck.csv", "masked.csv"))
    since = found["stuck"]["findings"][0]["since"]
    assert places[since:] == masked[since:]
    assert not set(places[:since]) & set(masked[:since])


def test_session_of_a_fibre_that_was_dead_from_the_start(few: Run, golden: Golden, monkeypatch) -> None:
    """The fourth; the second one is stuck, and all respond less than at the calibration."""
    fault = FibreFault(press=7, since=5, fibres=(1,), kind="stuck", score=4.0)
    shifts = [DomainShift("gain", (0, 1, 2, 3), 0.714, (0.9, 1.1)), DomainShift("rest", (0,), 1.5, (1.75, 2.25))]
    nothing = Localization(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    said = Prediction(nothing, [fault], shifts, None, False)
    monkeypatch.setattr("padforge.sense.cli.localizer.predict_despite_faults", lambda *_: said)
    monkeypatch.setattr(FaultDetector, "load", lambda folder: SimpleNamespace(model_=SimpleNamespace(dead=(3,))))
    session = Session(few)
    session("health --model model rec")
    session("health --model model rec --json")
    golden("cli/dead.txt", session.text)
