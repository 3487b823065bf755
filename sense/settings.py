"""Settings of sense, sections of `pad.toml`: `[rig]` and `[localizer]`."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticCustomError

from padforge.common.settings import Settings, Spec, as_tuple, null_as
from padforge.common.validation import InputError
from padforge.design.settings import PRESS_DEPTH_MM, Contact, Scatter, read_contact

Method = Literal["ensemble", "published"]
Split = Literal["random", "chronological"]

PLANS = ("uniform", "grid", "serpentine", "adaptive")


def _check_plan(value: str) -> str:
    if value not in PLANS and not value.lower().endswith(".csv"):
        raise PydanticCustomError("plan", "expected uniform, grid, serpentine, adaptive or a .csv file of positions")
    return value


Unknown, Unwatched = null_as("unknown"), null_as("unwatched")
Millimetres = Annotated[float, Field(ge=-1e4, le=1e4)]
Box = tuple[Millimetres, Millimetres, Millimetres, Millimetres, Millimetres, Millimetres]
Angle = Annotated[float, Field(ge=-6.3, le=6.3)]
Depth = Annotated[float, Field(gt=0, le=50)]
Force = Annotated[float, Field(gt=0, le=250)]
Input = Annotated[int, Field(ge=0, le=511)]


class RigSettings(Settings):
    """`[rig]`: how presses are recorded, where a real arm may go, and how the simulated pad responds.

    Presses are as deep as those that the pad is designed for, unless `depth_mm` or `depths_mm` says otherwise.
    No arm moves while `box_mm`, `contact_mm` or `pad_mm` is unknown, nor if its controller has another `tcp_mm`. While
    `mirrored` is unknown a pad's holder decides, and without one x runs to the right of y.
    """

    presses: int = Field(default=1500, ge=1, le=1_000_000, description="presses in a recording")
    plan: Annotated[str, AfterValidator(_check_plan)] = Field(
        default="uniform",
        max_length=4096,
        description="positions: uniform, grid, serpentine, adaptive (by --model), or a .csv file of them",
    )
    rate_hz: float = Field(default=13.3, ge=0.1, le=10_000, description="readings per second")
    readings_per_press: int = Field(
        default=40, ge=8, le=100_000, description="readings in the cycle of a press: down at its half, up at its end"
    )
    depth_mm: Annotated[Depth | None, *null_as("contact")] = Field(
        default=None, description='depth of a press, mm, or "contact": that of [contact]'
    )
    depths_mm: Annotated[tuple[Depth, ...], BeforeValidator(as_tuple)] = Field(
        default=(), description="depths that presses take in turn, in place of depth_mm"
    )
    seed: int = Field(default=0, ge=0, le=2**32 - 1, description="seed of the positions and of the simulated pad")
    noise_mv: float = Field(default=2.0, ge=0, le=1000, description="simulated pad: white noise of a reading, mV")
    drift_mv: float = Field(default=20.0, ge=0, le=1000, description="simulated pad: std of the drifting baseline, mV")
    creep: float = Field(default=0.3, ge=0, lt=1, description="simulated pad: share of a response lost by creep")
    hysteresis: float = Field(
        default=0.65, ge=0, lt=1, description="simulated pad: residue of a press as a share of its response, inverted"
    )
    hysteresis_s: float = Field(default=30.0, ge=0.01, le=1e4, description="simulated pad: residue's time constant, s")
    onset_width: float = Field(default=0.75, ge=0.1, le=2, description="simulated pad: onset width / press width")
    after_width: float = Field(default=0.7, ge=0.1, le=2, description="simulated pad: residue width / press width")
    sensitivity: float = Field(
        default=0.6, ge=0, le=2, description="simulated pad: std of the logarithm of the sensitivity along a fibre"
    )
    own_sensitivity: float = Field(
        default=1.0, ge=0, le=2, description="simulated pad: std of what onset, creep and residue add to that logarithm"
    )
    path_mm: float = Field(default=1.0, ge=0, le=10, description="simulated pad: std of paths about their plan, mm")
    memory: float = Field(default=0.8, ge=0, le=1, description="simulated pad: share of residues that a press removes")
    memory_mm: float = Field(default=10.0, gt=0, le=1e3, description="simulated pad: distance over which it falls, mm")
    gain_wander: float = Field(default=0.06, ge=0, le=1, description="simulated pad: relative std of gains in minutes")
    floor_mv: float = Field(default=3.0, ge=0, le=1000, description="simulated pad: scatter at zero response, mV")
    touch_s: float = Field(default=0.025, ge=0, le=1, description="simulated pad: std over the pad of touch times, s")
    scatter: float = Field(default=0.17, ge=0, le=1, description="simulated pad: scatter as a share of the response")
    scatter_common: float = Field(
        default=0.7, ge=0, le=1, description="simulated pad: share of the variance of that scatter common to all fibres"
    )
    host: str = Field(default="192.168.0.100", pattern=r"^[A-Za-z0-9._:-]{1,253}$", description="UR controller address")
    board: str = Field(
        default="due",
        min_length=1,
        max_length=100,
        description='name of the board: "due", "line", "csv", or another that is installed',
    )
    port: str = Field(default="auto", min_length=1, max_length=4096, description='serial port of the board, or "auto"')
    baud: int = Field(
        default=921_600, ge=9600, le=20_000_000, description="speed of the board's port; native USB takes any"
    )
    printer_port: Annotated[Annotated[str, Field(min_length=1, max_length=4096)] | None, *Unknown] = Field(
        default=None, description='serial port of the 3D printer, or "unknown"'
    )
    printer_baud: int = Field(default=115_200, ge=9600, le=2_000_000, description="speed of the printer's port, baud")
    board_rate_hz: float = Field(default=1000.0, ge=1, le=10_000, description="samples a second, averaged to rate_hz")
    count_v: float = Field(
        default=1.0,
        gt=0,
        le=1000,
        description='board "csv": volts of a count in its lines, such as 0.00489 for 5 V and 10 bits',
    )
    channels: Annotated[tuple[Input, ...], BeforeValidator(as_tuple)] = Field(
        default=(), max_length=512, description="input of the board that each fibre is on, from 0; [] in order"
    )
    box_mm: Annotated[Box | None, BeforeValidator(as_tuple), *Unknown] = Field(
        default=None, description='workspace [x0, x1, y0, y1, z0, z1] in the base frame, or "unknown"'
    )
    contact_mm: Annotated[Millimetres | None, *Unknown] = Field(
        default=None, description='height of the pad\'s surface in the base frame, or "unknown"'
    )
    pad_mm: Annotated[tuple[Millimetres, Millimetres] | None, BeforeValidator(as_tuple), *Unknown] = Field(
        default=None, description='the pad\'s centre [x, y] in the base frame, mm, or "unknown"'
    )
    pad_angle_deg: float = Field(default=0.0, ge=-360, le=360, description="angle from the base's y axis to the pad's")
    mirrored: Annotated[bool | None, *Unknown] = Field(
        default=None,
        description='tracks up, so that x runs the other way: true, false, or "unknown": a holder\'s, or false',
    )
    tool_rad: Annotated[tuple[Angle, Angle, Angle], BeforeValidator(as_tuple)] = Field(
        default=(0.0, 3.141592653589793, 0.0), description="rotation vector of the tool, pointing down, radians"
    )
    tcp_mm: Annotated[tuple[Millimetres, Millimetres, Millimetres] | None, BeforeValidator(as_tuple), *Unknown] = Field(
        default=None, description='the tip [x, y, z] from the flange, as set on the controller, or "unknown"'
    )
    max_depth_mm: float = Field(default=6.0, gt=0, le=50, description="maximum depth of a press, mm")
    clearance_mm: float = Field(default=10.0, ge=1, le=500, description="height above the surface between presses, mm")
    travel_mm_s: float = Field(default=100.0, gt=0, le=500, description="speed between presses, mm/s")
    press_mm_s: float = Field(default=40.0, gt=0, le=250, description="speed of pressing, mm/s")
    acceleration_mm_s2: float = Field(default=500.0, gt=0, le=3000, description="acceleration, mm/s^2")
    max_force_n: Annotated[Force | None, *Unwatched] = Field(
        default=60.0, description='force at which the arm is stopped, N; "unwatched" if the arm measures none (CB3)'
    )

    @property
    def plan_file(self) -> Path | None:
        """The file that `plan` names; None if it is a kind of plan."""
        return None if self.plan in PLANS else Path(self.plan)

    @property
    def samples_per_reading(self) -> int:
        """Number of the board's samples that are averaged to a reading, at about `rate_hz`."""
        return max(1, round(self.board_rate_hz / self.rate_hz))

    @property
    def half_cycle_s(self) -> float:
        """Time for which a press is held, and half of the time from press to press."""
        return self.readings_per_press / 2 * self.samples_per_reading / self.board_rate_hz

    @property
    def press_depths_mm(self) -> tuple[float, ...]:
        """Depths that presses take in turn; that of the default contact where no contact is known (`for_contact`)."""
        return self.depths_mm or (PRESS_DEPTH_MM if self.depth_mm is None else self.depth_mm,)

    def for_contact(self, contact: Contact) -> "RigSettings":
        """Return these settings with the depth of a contact, if they state none.

        Args:
            contact: contact that the pad is designed for.

        Raises:
            InputError: a depth that no rig reaches.
        """
        if self.depth_mm is not None:
            return self
        return type(self)(**{**self.model_dump(), "depth_mm": contact.depth_mm})

    @property
    def response_scatter(self) -> Scatter:
        """Scatter of the responses of the simulated pad, besides the noise of readings."""
        return Scatter(0.0, self.scatter, self.scatter_common)

    def inputs(self, n_fibres: int) -> tuple[int, ...]:
        """Return the input of the board that each fibre of a pad is on.

        Args:
            n_fibres: number of fibres of the pad.

        Raises:
            InputError: `channels` names more or fewer inputs than the pad has fibres, or one twice.
        """
        inputs = self.channels or tuple(range(n_fibres))
        if len(inputs) != n_fibres:
            raise InputError(
                f"[rig] channels: got {len(inputs)} inputs, the pad has {n_fibres} fibres: name one for each, "
                "or none if they are in order"
            )
        if repeated := [number for number in inputs if inputs.count(number) > 1]:
            raise InputError(f"[rig] channels: got input {repeated[0]} for more than one fibre, expected one for each")
        return inputs


def read_rig(spec: Spec, **overrides: Any) -> RigSettings:
    """Read `[rig]` with the depth of `[contact]`, if it states none; overrides replace its values, unless None.

    Raises:
        InputError: an unknown key or a value out of range, or a press as deep as the pad is thick.
    """
    contact, rig = read_contact(spec), spec.section(RigSettings, **overrides)
    rig = rig.for_contact(contact)
    if contact.model == "layer" and (deepest := max(rig.press_depths_mm)) >= contact.thickness_mm:
        key = "depths_mm" if rig.depths_mm else "depth_mm"
        allowed = f"less than the thickness of the pad, {contact.thickness_mm:g} mm"
        raise InputError(f"{spec.source}: [rig] {key}: got {deepest:g}, allowed is {allowed}")
    return rig


IDEAL_RIG = RigSettings(
    noise_mv=1.6,
    drift_mv=40.0,
    creep=0.0,
    hysteresis=0.2,
    hysteresis_s=2.5,
    onset_width=1.0,
    after_width=1.0,
    sensitivity=0.0,
    own_sensitivity=0.0,
    path_mm=0.0,
    memory=0.0,
    gain_wander=0.0,
    floor_mv=0.0,
    touch_s=0.0,
    scatter=0.18,
    scatter_common=0.36,
)
"""A pad whose fibres lie as planned, and respond to all parts of a press alike."""
SIMULATED = frozenset(IDEAL_RIG.model_fields_set | {"memory_mm"})  # names of the settings of the simulated pad
IDEAL = {"rig": IDEAL_RIG}


class LocalizerSettings(Settings):
    """`[localizer]`: how positions are learnt from readings."""

    method: Method = Field(
        default="ensemble",
        description="one ensemble for every moment and loss of fibres, or published: 50 tanh, Levenberg-Marquardt",
    )
    split: Split = Field(default="random", description="presses of the test: drawn at random, or the last ones")
    test_share: float = Field(default=0.15, gt=0, lt=1, description="share of the presses held back for the test")
    max_failures: int = Field(default=3, ge=0, le=8, description="train and test for up to this many failed fibres")
    members: int = Field(
        default=2,
        ge=1,
        le=64,
        description="members combined by their variances, the last of several a Bayesian localizer of the release",
    )
    hidden: int = Field(default=192, ge=1, le=4096, description="width of the hidden layers")
    layers: int = Field(default=5, ge=1, le=32, description="residual hidden layers after the first")
    epochs: int = Field(
        default=150,
        ge=1,
        le=100_000,
        description="passes through the presses, up to 9900 steps; in `padforge run` the default is 80",
    )
    batch: int = Field(default=256, ge=1, le=65_536, description="presses in a training step")
    learning_rate: float = Field(default=5e-3, gt=0, le=1, description="maximum rate of the one-cycle schedule")
    seed: int = Field(default=0, ge=0, le=2**32 - 1, description="seed of the split and of the training")
