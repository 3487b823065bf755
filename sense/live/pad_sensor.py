"""A live pad as a sensor: a thread localizes its presses, and a program reads the latest state at its own rate."""

import threading
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

from padforge.common.validation import InputError
from padforge.sense.arrays import Array
from padforge.sense.health.fault_detector import FaultDetector, has_health
from padforge.sense.health.health_model import HealthModel
from padforge.sense.live.pipeline import Live
from padforge.sense.localizer.model import MEASURE_COLUMNS, LocalizerModel
from padforge.sense.rig.devices import Board, RigFault, load_device
from padforge.sense.rig.streams import stream_board
from padforge.sense.settings import RigSettings

START_S = 20.0  # longest wait for the first reading


def open_board(rig: str, model: Path, options: RigSettings, fibres: int) -> Board:
    """Return the board of `[rig]`, not yet connected; "simulated" is the simulated pad that the model was trained on.

    Raises InputError if the board is not installed, or the model is not that of a simulated pad.
    """
    if rig == "simulated":
        from padforge.sense.rig.simulated_board import simulated_board_of

        return simulated_board_of(model)
    return load_device("padforge.boards", options.board)(options, options.inputs(fibres))


def load_health(model: Path) -> HealthModel | None:
    """Load the health model in the folder of a model; None if there is none."""
    return FaultDetector.load(model).live_model_ if has_health(model) else None


class PadSensor:
    """A live pad, localized in a thread; see `open_board` for the arguments."""

    def __init__(self, rig: str, model: Path, options: RigSettings) -> None:
        self._rig, self._model, self._options = rig, model, options
        self._localizer = LocalizerModel.load(model)
        measures = [column for measure in self._localizer.scaler.measures for column in MEASURE_COLUMNS[measure.name]]
        fibres = [f"fibre_{fibre}_v" for fibre in range(self._localizer.fibres)]
        self._touch_names = ["x_mm", "y_mm", "r90_mm", "unlike", *measures]
        self.names = (*fibres, "pressed", "valid", *self._touch_names)  # of the values that `read` returns
        self._thread: threading.Thread | None = None
        self._stop, self._started = threading.Event(), threading.Event()
        self._values: Mapping[str, float] = {}
        self._error: Exception | None = None

    @property
    def is_connected(self) -> bool:
        return self._thread is not None

    def connect(self) -> None:
        """Connect the board, and wait for the first reading; raises InputError or RigFault if none arrives."""
        if self._thread is not None:
            raise InputError("the pad is connected already")
        self._error = None
        self._stop.clear()
        self._started.clear()
        self._thread = threading.Thread(target=self._follow, name="padforge pad", daemon=True)
        self._thread.start()
        if not self._started.wait(START_S):
            self._error = RigFault("stale", f"no reading has arrived in {START_S:g} s", "look at the board")
        if self._error is not None:
            self.close()
            raise self._error

    def read(self) -> dict[str, float]:
        """Return the latest state by name: readings in V, NaN where missing, and the touch.

        `pressed` is 1 while the pad is pressed. Position, radius, depth and force are those of the current press (with
        two fingers, of the one that landed last) or, while there is none, of the last press; if `valid` is 0, there is
        no estimate, and they are 0. `unlike` is 1 if no single press explains the responses, for example with two
        fingers. Raises RigFault if the board failed.
        """
        if self._thread is None:
            raise InputError("the pad is not connected")
        if self._error is not None:
            raise self._error
        return dict(self._values)

    def close(self) -> None:
        """Disconnect the board; the pad can be connected again."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _follow(self) -> None:
        try:
            board = open_board(self._rig, self._model, self._options, self._localizer.fibres)
            with closing(board):
                stream = stream_board(board, self._localizer.rate_hz)
                health = load_health(self._model)
                pipeline = Live(self._localizer, rate_hz=stream.rate_hz, fibres=stream.fibres, health=health)
                for times_s, readings in stream.blocks:
                    pipeline.update(times_s, readings)
                    if len(times_s):
                        self._values = self._summarize(pipeline, readings[-1])
                        self._started.set()
                    if self._stop.is_set():
                        return
        except Exception as error:  # raised by the next `read`
            self._error = error
            self._started.set()

    def _summarize(self, pipeline: Live, volts: Array) -> Mapping[str, float]:
        latest = pipeline.shown_presses[-1] if pipeline.presses else None
        # A model of method `published` does not estimate the current press: its latest estimate is of the one before.
        is_valid = latest is not None and not (pipeline.pressed and latest.final)
        touch = [float(getattr(latest, name)) if is_valid else 0.0 for name in self._touch_names]
        return dict(zip(self.names, [*volts.tolist(), float(pipeline.pressed), float(is_valid), *touch], strict=True))
