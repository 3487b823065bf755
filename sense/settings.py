"""The sections of `pad.toml` that sense owns: the rig and the localizer."""

from typing import Literal

from pydantic import Field

from design.settings import Section

Features = Literal["windows", "published"]
Split = Literal["random", "chronological"]


class Rig(Section):
    """`[rig]`: how presses are recorded, and how the simulated pad answers."""

    presses: int = Field(default=1500, ge=1, le=1_000_000, description="presses in a recording")
    rate_hz: float = Field(default=13.3, ge=0.1, le=10_000, description="readings per second")
    readings_per_press: int = Field(
        default=40, ge=8, le=100_000, description="readings in the cycle of a press: down at its half, up at its end"
    )
    depth_mm: float = Field(default=5.0, gt=0, le=50, description="depth of a press, mm")
    seed: int = Field(default=0, ge=0, le=2**32 - 1, description="seed of the places and of the simulated pad")
    noise_mv: float = Field(default=1.6, ge=0, le=1000, description="simulated pad: white noise of a reading, mV")
    drift_mv: float = Field(default=40.0, ge=0, le=1000, description="simulated pad: spread of the drifting rest, mV")
    creep: float = Field(default=0.1, ge=0, lt=1, description="simulated pad: share of a fibre's answer that creeps")
    hysteresis: float = Field(default=0.2, ge=0, lt=1, description="simulated pad: overshoot on unloading, share of it")


class Localizer(Section):
    """`[localizer]`: how places are learnt from readings."""

    features: Features = Field(
        default="windows", description="17 baseline-free window means a fibre, or the 3 published filtered values"
    )
    split: Split = Field(
        default="random", description="presses held back for the test: drawn at random, or the last ones"
    )
    test_share: float = Field(default=0.15, gt=0, lt=1, description="share of the presses held back for the test")
    lost: int = Field(default=3, ge=0, le=8, description="train and test for up to this many lost fibres")
    members: int = Field(default=2, ge=1, le=64, description="networks whose places are averaged")
    hidden: int = Field(default=192, ge=1, le=4096, description="width of the hidden layers")
    layers: int = Field(default=3, ge=1, le=32, description="residual hidden layers after the first")
    epochs: int = Field(default=240, ge=1, le=100_000, description="times every training press is shown")
    batch: int = Field(default=128, ge=1, le=65_536, description="presses in a training step")
    rate: float = Field(default=4e-3, gt=0, le=1, description="greatest learning rate of the one-cycle schedule")
    seed: int = Field(default=0, ge=0, le=2**32 - 1, description="seed of the split and of the training")


MODELS: dict[str, type[Section]] = {"rig": Rig, "localizer": Localizer}
