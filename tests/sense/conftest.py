"""A simulated recording and a quickly trained localizer, shared by the tests of sense."""

import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any
from unittest.mock import patch

import filelock
import numpy as np
import pytest

from padforge.design import Morphology, contact
from padforge.sense import Evaluation, Recording, calibrate
from padforge.sense import settings as sense_settings
from padforge.sense.localizer import calibration, evaluation
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import MOMENTS
from padforge.sense.localizer.network import Weights
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.devices import RigFault
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.twin import identification as twin_identification
from padforge.sense.twin import wiring
from padforge.sense.twin.identification import Identification, identify_pad
from tests.emulators import rigs
from tests.emulators.ur5 import EmulatedUR5
from tests.emulators.ur5_controller import Series
from tests.helpers.less import blank_pictures
from tests.helpers.once import Once
from tests.helpers.rigs import ideal_rig
from tests.helpers.steady_clock import SteadyClock, steady_clock

QUICK = sense_settings.LocalizerSettings(members=2, hidden=48, layers=2, epochs=20, batch=64)


@pytest.fixture(scope="session")
def recording(once: Once) -> Recording:
    """300 presses on a pad whose fibres wind."""
    rig = sense_settings.RigSettings(presses=300, seed=1)
    return once("recording", lambda folder: simulate(Morphology.random(2, knots=3, seed=5), rig))


@contextmanager
def few_candidates() -> Iterator[None]:
    """One wiring is fitted beside the stated one and images, of six that are refined, in place of 4 of 24."""
    with patch.object(twin_identification, "N_CANDIDATES", 1), patch.object(wiring, "N_REFINED", 6):
        yield


def identify_simulated(built: Morphology, told: Morphology, rig: sense_settings.RigSettings) -> Identification:
    """Identify a simulated pad by a plan; its contact and the parts of presses, which take longest, do not count."""
    contact = patch.object(twin_identification, "_measure_contact", lambda *_: None)
    with contact, patch.object(twin_identification, "measure_rig_settings", lambda _: {}):
        return identify_pad(simulate(built, rig), told, seed=1)


@pytest.fixture(scope="session")
def identification(once: Once) -> Identification:
    """A pad of 2 + 2 fibres that lies as planned, without its contact and its parts."""
    plan = Morphology.random(2, knots=3, seed=5)

    @few_candidates()
    def make(folder: Path) -> Identification:
        return identify_simulated(plan, plan, ideal_rig(presses=120, seed=1))

    return once("identification", make)


def first_presses(recording: Recording, presses: int) -> Recording:
    """Return the first presses of a recording, by their positions alone."""
    end = int(recording.down_command[presses])
    edges = (getattr(recording, name)[:presses] for name in ("presses_mm", "down_command", "up_command"))
    return Recording(recording.readings[:end], recording.times_s[:end], *edges)


@pytest.fixture(scope="session")
def brief(recording: Recording) -> Recording:
    return first_presses(recording, 40)


@contextmanager
def few_moments() -> Iterator[None]:
    """Radii are learnt from one set of failed fibres of each size, and errors evaluated at two moments of a press.

    Both take longer than a short training.
    """
    sets = patch.multiple(calibration, MOMENT_SUBSETS=1, SCALE_SUBSETS=1)
    with sets, patch.object(evaluation, "MOMENTS", (MOMENTS[0], MOMENTS[-1])):
        yield


@pytest.fixture(scope="session")
def calibrated(once: Once, recording: Recording) -> tuple[LocalizerModel, Evaluation]:
    return once("calibrated", lambda folder: calibrate(recording, QUICK))


@pytest.fixture(scope="session")
def localizer(calibrated: tuple[LocalizerModel, Evaluation]) -> LocalizerModel:
    return calibrated[0]


def without_training(weights: Weights, expected_error: float) -> Weights:
    """Weights of networks that answer 0, and expect such an error of it."""
    still = {name: np.zeros_like(part) for name, part in weights.items()}
    still["last.b"][..., still["last.b"].shape[-1] // 2 :] = np.log(expected_error)
    return still


@pytest.fixture(scope="session")
def bayesian_localizer(localizer: LocalizerModel) -> LocalizerModel:
    """The Bayesian localizers alone, whose answers no training has touched: they are the same on every processor."""
    networks = {name: without_training(weights, 0.4) for name, weights in localizer.networks.items()}
    moments, levels = np.ogrid[: localizer.interval_factors.shape[0], : localizer.interval_factors.shape[1]]
    growth = (2.0 - moments / 17) * (1 + 0.1 * levels)
    return replace(
        localizer,
        networks=networks,
        residual_network=without_training(localizer.residual_network, 0.05),
        interval_factors=growth[:, :, None] * [0.5, 0.3, 0.9],
        errors=(),
    )


@pytest.fixture(scope="session")
def deep_recording(once: Once) -> Recording:
    """400 presses of 0.5 to 5 mm, each as hard as a spring would have it, on a pad whose responses do not scatter.

    They are interpolated between few depths, as wide in all their parts: each depth and width is solved of its own.
    """
    depths = tuple(np.random.default_rng(4).uniform(0.5, 5, 400).tolist())
    settings = {"presses": 400, "seed": 2, "depths_mm": depths, "scatter": 0, "onset_width": 1.0, "after_width": 1.0}
    rig = sense_settings.RigSettings.model_validate(settings)

    def make(folder: Path) -> Recording:
        with patch.object(contact, "DEPTH_STEPS", 4):
            return simulate(Morphology.random(2, knots=3, seed=5), rig)

    recording = once("deep-recording", make)
    return replace(recording, forces_n=3.0 * recording.depths_mm)


@pytest.fixture(scope="session")
def deeply_calibrated(once: Once, deep_recording: Recording) -> tuple[LocalizerModel, Evaluation]:
    options = QUICK.model_copy(update={"members": 1, "epochs": 12})

    @few_moments()
    def make(folder: Path) -> tuple[LocalizerModel, Evaluation]:
        return calibrate(deep_recording, options, by_moment=False)

    return once("deeply-calibrated", make)


@pytest.fixture(scope="session")
def deep_localizer(deeply_calibrated: tuple[LocalizerModel, Evaluation]) -> LocalizerModel:
    """It has learnt depth and force."""
    return deeply_calibrated[0]


@pytest.fixture(scope="session")
def model(recording: Recording, localizer: LocalizerModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as `padforge run` leaves it."""
    folder = tmp_path_factory.mktemp("pad")
    localizer.save(folder)
    recording.save(folder / "recording", {})
    return folder


@pytest.fixture
def folder(recording: Recording, tmp_path: Path) -> Path:
    recording.save(tmp_path / "run", {"command": "test"})
    return tmp_path / "run"


@pytest.fixture
def steady() -> Iterator[SteadyClock]:
    """The clock of rigs stands still for all while one of their threads gets no processor."""
    with steady_clock() as clock:
        yield clock


@pytest.fixture
def blank(monkeypatch: pytest.MonkeyPatch) -> None:
    blank_pictures(monkeypatch)


WAIT_S = 180.0
ADDRESSES = [f"127.0.0.{last}" for last in range(1, 33 if sys.platform == "linux" else 2)]
"""Of this machine: on Linux all that begin with 127, elsewhere the first alone."""

FORBIDDEN = ("play", "unlock", "power", "brake", "safety")
"""Words of orders to the dashboard that are for a person alone."""


class Robots:
    """One emulator at a time, kept while the next test wants the same, and the link to it while that is whole."""

    def __init__(self, host: str) -> None:
        self.host, self.series, self.robot = host, "", None
        self.arm: UR5 | None = None

    def get(self, series: Series, **settings: Any) -> EmulatedUR5:
        if self.robot is None or settings or self.series != series:
            self.free()
            self.series, self.robot = series, EmulatedUR5(series, host=self.host, **settings).__enter__()
        return self.robot

    def connected(self, host: str) -> UR5:
        """The arm by one of its names, at rest."""
        arm = self.arm = self.arm or UR5(host)
        try:
            if arm.state().moving:
                arm.stop()
        except RigFault:
            arm.connect()
        return arm

    def free(self) -> None:
        arm, robot, self.arm, self.robot, self.series = self.arm, self.robot, None, None, ""
        if arm is not None:
            arm.close()
        if robot is not None:
            asked = robot.dashboard_log
            robot.__exit__()
            assert not [line for line in asked if any(word in line for word in FORBIDDEN)]


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """An address whose ports are held by one module of one test process at a time."""
    end = time.monotonic() + WAIT_S
    for address in cycle(ADDRESSES):
        lock = filelock.FileLock(Path(tempfile.gettempdir()) / f"padforge-ur-{address}.lock", timeout=0.1)
        with suppress(filelock.Timeout), lock:
            yield address
            return
        if time.monotonic() > end:
            pytest.fail(f"other processes have had the emulator's ports for {WAIT_S} s")


@pytest.fixture(scope="module")
def own_address(address: str) -> Iterator[None]:
    """Whole rigs are emulated at the address."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "HOST", address)
        yield


@pytest.fixture(scope="module")
def host(address: str) -> str:
    """The address by a name for which ur-rtde asks whether the arm is in remote control."""
    return address.replace("127.0.0.", "127.")


@pytest.fixture(scope="module")
def robots(address: str) -> Iterator[Robots]:
    pytest.importorskip("rtde_control")
    robots = Robots(address)
    yield robots
    robots.free()


@pytest.fixture
def series() -> Series:
    return "cb3"


@pytest.fixture
def robot(robots: Robots, series: Series) -> EmulatedUR5:
    return robots.get(series)


@pytest.fixture
def arm(robots: Robots, robot: EmulatedUR5, host: str) -> UR5:
    return robots.connected(host)
