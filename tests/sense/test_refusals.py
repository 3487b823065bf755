"""What settings, filters, localizers, studies and live pads refuse of a program, and in which words."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge import sense
from padforge.benchmarks.twin import printed_pad
from padforge.common.validation import InputError
from padforge.design import Contact, Morphology
from padforge.design.settings import Layout
from padforge.design.twin import TwinChannel
from padforge.sense.deploy.onnx_export import export_onnx
from padforge.sense.live.outputs import JsonLines
from padforge.sense.live.viewers import RerunOutput
from padforge.sense.localizer.model import LocalizerModel, write_localization
from padforge.sense.localizer.response_priors import planned_pad
from padforge.sense.settings import LocalizerSettings, RigSettings
from padforge.sense.studies.drift import drift_study
from padforge.sense.studies.fibre_loss import fibre_loss_study
from padforge.sense.studies.indentation import force_study, shape_study
from padforge.sense.studies.learning_curve import learning_curve
from padforge.sense.studies.robustness import robustness_study
from padforge.sense.studies.scaling import scaling_study
from padforge.sense.studies.sensitivity import sensitivity_study
from padforge.sense.studies.study import load_pads
from tests.helpers.golden import Golden
from tests.helpers.limits import require_ends
from tests.helpers.refusals import refusal_table

PADS = {"square": Morphology.straight(2)}
SIX = Morphology.random(3, knots=2, seed=0)


def known(recording: sense.Recording, presses: int) -> sense.Recording:
    """The recording, with the positions of its first presses alone."""
    is_known = np.arange(len(recording.presses_mm))[:, None] < presses
    return replace(recording, presses_mm=np.where(is_known, recording.presses_mm, np.nan))


def test_what_programs_ask_of_signals_and_localizers_in_vain(
    localizer: LocalizerModel, recording: sense.Recording, golden: Golden, tmp_path: Path
) -> None:
    detector, presses = sense.PressDetector(2), localizer.scaled_features(recording)
    detector.update([0.0, 0.1], np.zeros((2, 2)))
    detector.update([], np.zeros((0, 2)))
    published, few = replace(localizer, method="published"), LocalizerSettings(epochs=1, test_share=1e-4)
    learnt, x = replace(localizer, fibre_names=("c1", "c2", "c3", "c4")), np.zeros((9, 4, 3))
    swapped = replace(recording, source={"fibre_names": ["c1", "c3", "c2", "c4"]})
    other = replace(recording, source={"morphology": recording.source["morphology"] | {"pitch_mm": 9.0}})
    live = sense.Live(localizer, rate_hz=recording.rate_hz)
    live.update(recording.times_s[:9], recording.readings[:9])
    dead = replace(printed_pad(SIX, np.random.default_rng(3)), channels=(TwinChannel(0, None, 0.0, 0.0, 0.0),))
    of_arrays = sense.Localizer()
    of_arrays.model_ = replace(localizer, features="array")
    rows = {
        "a filter of an infinite reading": lambda: sense.total_variation([1, np.inf], 4),
        "a filter without weight": lambda: sense.total_variation([1], 0),
        "a filter of a cube": lambda: sense.total_variation(np.zeros((1, 1, 1)), 4),
        "a median of two": lambda: sense.running_median([1], 2),
        "a detector of other fibres": lambda: sense.PressDetector(4).update(np.zeros(3), np.zeros((3, 2))),
        "a detector at the time before": lambda: detector.update([0.1, 0.3], np.zeros((2, 2))),
        "no press to test on": lambda: sense.calibrate(recording, few),
        "the published method in a given time": lambda: sense.calibrate(
            recording, LocalizerSettings(method="published"), time_budget=5
        ),
        "presses where a localizer errs, simulated": lambda: sense.simulate(SIX, sense.RigSettings(plan="adaptive")),
        "presses on a dead twin": lambda: sense.simulate(dead, sense.RigSettings(presses=3)),
        "presses on a pad like a dead twin": lambda: sense.simulate(SIX, sense.RigSettings(presses=3), like=dead),
        "a plan of more fibres": lambda: planned_pad(recording, SIX),
        "as many failed fibres as there are": lambda: sense.evaluate(localizer, recording, [4]),
        "no number of failed fibres": lambda: sense.evaluate(localizer, recording, []),
        "a recording of the recalibration": lambda: sense.evaluate(
            replace(localizer, recalibrated_by=(recording.digest, "of later")), recording
        ),
        "few presses to recalibrate by": lambda: sense.recalibrate(localizer, known(recording, 9)),
        "a fibre that is not there": lambda: localizer.predict_features(presses, [4]),
        "no fibre that works": lambda: localizer.predict_features(presses, range(4)),
        "failed fibres by the published method": lambda: published.predict(recording, [1]),
        "a fibre that is missing": lambda: localizer.predict(replace(recording, readings=recording.readings[:, :3])),
        "few readings a second": lambda: localizer.predict(replace(recording, times_s=recording.times_s / 0.74)),
        "fibres in another order": lambda: learnt.predict(swapped),
        "another plan": lambda: localizer.predict(other),
        "a table where a folder is": lambda: write_localization(localizer.predict(recording), tmp_path),
        "a localizer before its fit": lambda: sense.Localizer().predict(recording),
        "more presses than positions": lambda: sense.Localizer().fit(x, recording.presses_mm),
        "positions beside a recording": lambda: sense.Localizer().fit(recording, recording.presses_mm),
        "a recording by a localizer of arrays": lambda: of_arrays.predict(recording),
        "arrays of other windows": lambda: of_arrays.predict(x),
        "an option that is none": lambda: sense.Localizer(depth=3, **dict.fromkeys("hgfedcba", 0)),
        "windows before their fit": lambda: sense.PressWindows().transform(recording),
        "windows of other presses": lambda: sense.PressWindows().fit(recording, np.zeros((3, 2))),
        "a graph of the published method": lambda: export_onnx(published, "", tmp_path / "l.onnx"),
        "a graph of arrays": lambda: export_onnx(of_arrays.model_, "", tmp_path / "l.onnx"),
        "few readings a second, live": lambda: sense.Live(localizer, rate_hz=9.9),
        "no rate, live": lambda: sense.Live(localizer, rate_hz=float("nan")),
        "other fibres, live": lambda: sense.Live(localizer, rate_hz=20.0, fibres=3),
        "arrays, live": lambda: of_arrays.live(20.0),
        "a localizer before its fit, live": lambda: sense.Localizer().live(20.0),
        "a localizer before its fit, handed to live": lambda: sense.Live(sense.Localizer(), rate_hz=20.0),
        "readings of before, live": lambda: live.update(recording.times_s[8:12], recording.readings[8:12]),
        "lines for all without a token": lambda: JsonLines("0.0.0.0", 0),
        "a file for a viewer in no folder": lambda: RerunOutput(
            str(tmp_path / "no.csv/pad.rrd"), 2, [1.0, 2.0], [20.0, 10.0]
        ),
    }
    (tmp_path / "no.csv").touch()
    digests, tokens = rf"{other.pad_digest[:12]}|{localizer.pad_sha256[:12]}", r"(?<=--token )\S+"
    golden("sense/refusals.txt", refusal_table(rows), forget=[digests, tokens, r"(?<=cannot be written )\(.*\)"])
    for ratio in (0.76, 7.0):  # three quarters of the readings a second will do, and more
        localizer.scaled_features(replace(recording, times_s=recording.times_s / ratio))
    detector.update([0.11], np.zeros((1, 2)))


def test_what_studies_are_asked_in_vain(localizer: LocalizerModel, recording: sense.Recording, golden: Golden) -> None:
    shape, profile = Contact(radius=0.6), Contact(model="profile")
    rows = {
        "a fibre that a pad has not": lambda: robustness_study(PADS, failed=(4,)),
        "all fibres of a pad": lambda: robustness_study(PADS, failed=(0, 1, 2, 3)),
        "a label twice": lambda: drift_study({"a": PADS["square"]}, {"a": recording}),
        "a recording of three presses": lambda: drift_study({}, {"few": known(recording, 3)}),
        "the size of a profile": lambda: sensitivity_study(PADS, contact=profile),
        "the depth of a shape": lambda: force_study(PADS, contact=shape),
        "tools of a shape": lambda: shape_study(PADS, contact=shape),
        "a fibre that a recording has not": lambda: fibre_loss_study(recording, localizer, failed=(4,)),
        "all fibres of a recording": lambda: fibre_loss_study(recording, localizer, failed=(0, 1, 2, 3)),
        "neither method of fibre loss": lambda: fibre_loss_study(recording),
        "half a tile": lambda: scaling_study({"square": Morphology.straight(4)}, grids=(4, 6)),
        "a tile that is not square": lambda: scaling_study({"wide": Morphology.straight((1, 2), 8.0)}, grids=(4,)),
        "a curve of 85 presses": lambda: learning_curve(known(recording, 100)),
        "more knots than are searched for": lambda: load_pads(("genetic-65",), 0),
        "no knots": lambda: load_pads(("optimised-0",), 0, Layout.create((1, 2), 8.0)),
    }
    golden("studies/refusals.txt", refusal_table(rows))


@pytest.mark.parametrize(
    ("model", "key", "kept", "refused"),
    [
        (RigSettings, "max_force_n", (0.1, 250.0, "unwatched"), (0.0, 250.1, "unknown")),
        (RigSettings, "depth_mm", (0.1, 50.0, "contact"), (0.0, 50.1, "deep")),
        (RigSettings, "depths_mm", ([0.1, 50.0],), ([5.0, 0.0], [50.1])),
        (RigSettings, "box_mm", ([-1e4, 1e4] * 3, "unknown"), ([0, 1] * 2, [0, float("nan")] * 3)),
        (RigSettings, "contact_mm", (-1e4, 1e4, "unknown"), (1.1e4, float("inf"), "unwatched")),
        (RigSettings, "tool_rad", ([0, 6.3, 0],), ([0, 6.4, 0], [0, 3.14])),
        (RigSettings, "plan", ("serpentine", "mine.CSV"), ("boustrophedon", "mine.txt")),
        (RigSettings, "channels", ([0, 511], []), (8, [-1], [512], ["A0"])),
    ],
)
def test_values_at_the_ends_of_what_is_allowed(model: type, key: str, kept: tuple, refused: tuple) -> None:
    require_ends(model, key, kept, refused)


def test_a_force_that_nobody_watches_is_said_in_words_and_numbers_may_be_of_numpy() -> None:
    assert RigSettings.model_validate({"max_force_n": "unwatched"}).max_force_n is None
    assert RigSettings(max_force_n=None).model_dump()["max_force_n"] == "unwatched"
    box_mm = np.array([[-30, 30], [-30, 30], [5, 60]]).ravel()  # numbers of NumPy are numbers
    rig = RigSettings(presses=np.int64(50), noise_mv=np.float32(0.5), channels=np.arange(3), box_mm=box_mm)  # type: ignore[arg-type]
    assert rig == RigSettings(presses=50, noise_mv=0.5, channels=(0, 1, 2), box_mm=(-30, 30, -30, 30, 5, 60))


def test_inputs_are_in_order_or_as_they_are_named() -> None:
    assert RigSettings().inputs(16) == tuple(range(16))
    assert RigSettings(channels=(3, 0, 11, 2)).inputs(4) == (3, 0, 11, 2)
    with pytest.raises(InputError, match=r"^\[rig\] channels: got input 3 for more than one fibre"):
        RigSettings(channels=(3, 0, 2, 3)).inputs(4)
