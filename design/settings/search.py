"""`[search]`: how the fibres are found."""

import math
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from padforge.design.common.settings import Settings, as_tuple
from pydantic import BeforeValidator, Field, field_validator

from .contact import PUBLISHED_CONTACT, Contact

if TYPE_CHECKING:  # settings alone take no NumPy
    import numpy as np
    from numpy.typing import NDArray

Share = Annotated[float, Field(ge=0, le=1e6)]

Lost = Annotated[
    Annotated[int, Field(ge=0, le=8)] | Annotated[tuple[Share, ...], Field(min_length=1, max_length=9)],
    BeforeValidator(as_tuple),
]


WEIGHTS = (1.0, 1e-7, 5e-6)
"""Published alpha, beta and gamma: of entropy, sharpness and disorder (formula (5))."""
SIDE = 7
"""The published search presses 7 x 7 places."""
LEVELS = 4096
"""Levels of the published 12-bit converter."""
MOST_LEVELS = 2**24


class Scatter(NamedTuple):
    """How the response of a fibre scatters from press to press at the same position.

    Attributes:
        floor: standard deviation of what does not depend on the response, of a straight fibre's full scale, > 0.
        share: standard deviation of what is proportional to the response, share of it.
        common: share of the latter's variance that all fibres have in common.
    """

    floor: float
    share: float = 0.0
    common: float = 0.0

    def gains(self, shape: tuple[int, int], rng: "np.random.Generator") -> "NDArray[np.float64]":
        """Draw by what each response (presses, fibres) is more or less than usual, about 1."""
        own, common = rng.standard_normal(shape), rng.standard_normal((shape[0], 1))
        return 1 + self.share * (math.sqrt(1 - self.common) * own + math.sqrt(self.common) * common)

    def scaled(self, factor: float) -> "Scatter":
        """Return the same scatter, louder by a factor."""
        return Scatter(self.floor * factor, self.share * factor, self.common)


class SearchSettings(Settings):
    """`[search]`: how the fibres are found.

    Attributes:
        noise, scatter, scatter_common: the defaults are what the responses of a built pad scatter by.
        lost: how many fibres may fail; or the loss distribution, weights of 0, 1, 2, ... lost fibres.
        weights, presses, levels: of the published objective, alpha, beta and gamma; the side of its square of presses;
            and the levels that signals are rounded up to.
        contacts: further contacts the pad must serve as well as that of `[contact]`, such as `{radius = 0.9}`.
    """

    method: Literal["descent", "genetic"] = Field(
        default="descent", description="gradients of the expected error, or the genetic search as published"
    )
    knots: int = Field(default=21, ge=1, le=64, description="inner knots per fibre (N); the rules take 3 a turn")
    starts: int = Field(default=4, ge=1, le=10_000, description="random starts of the gradient search")
    steps: int = Field(default=1000, ge=1, le=1_000_000, description="steps of a start of the gradient search")
    population: int = Field(default=200, ge=4, le=100_000, description="pads per generation of the genetic search")
    generations: int = Field(default=50, ge=1, le=1_000_000, description="generations of the genetic search")
    weights: Annotated[tuple[Share, Share, Share], BeforeValidator(as_tuple)] = Field(
        default=WEIGHTS, description="weights of entropy, sharpness and disorder in the genetic search"
    )
    presses: int = Field(default=SIDE, ge=2, le=64, description="side of the square of presses of the genetic search")
    levels: int = Field(default=LEVELS, ge=1, le=MOST_LEVELS, description="levels of a signal in the genetic search")
    seed: int = Field(default=0, ge=0, le=2**32 - 1, description="seed of every random choice")
    lost: Lost = Field(
        default=3, description="failed fibres designed for, at half of the weight, or weights of 0, 1, ... failed"
    )
    noise: float = Field(
        default=0.02,
        ge=1e-9,
        le=10,
        description="standard deviation of a response's noise, of the full scale of straight fibres",
    )
    scatter: float = Field(
        default=0.18, ge=0, le=1, description="scatter of a response from press to press, share of the response"
    )
    scatter_common: float = Field(
        default=0.36, ge=0, le=0.99, description="share of that scatter's variance that all fibres have in common"
    )
    sharpness: float = Field(default=0.0, ge=0, le=1e6, description="weight of the signals' mean second difference")
    contacts: Annotated[tuple[Contact, ...], BeforeValidator(as_tuple)] = Field(
        default=(), description="further contacts to serve as well, each a table like [contact]"
    )
    device: Literal["cpu", "cuda"] = Field(default="cpu", description="where presses are told apart")

    @property
    def usual_contact(self) -> Contact:
        """What is designed for where nothing else is asked: the measured contact, by the published method its own."""
        return PUBLISHED_CONTACT if self.method == "genetic" else Contact()

    @property
    def response_scatter(self) -> Scatter:
        """How responses scatter that are designed for."""
        return Scatter(self.noise, self.scatter, self.scatter_common)

    @field_validator("lost", "weights")
    @classmethod
    def _some_weight(cls, weights: int | tuple[float, ...]) -> int | tuple[float, ...]:
        if isinstance(weights, tuple) and sum(weights) == 0:
            raise ValueError("one of the weights must be above 0")
        return weights
