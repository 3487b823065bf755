"""Gradient search on the expected error under noise and fibre loss, within the rules.

One start is a `GradientSearch`: it advances by any number of steps, tells its state as plain arrays and goes on from
them to the same bits, so that it can run in slices on any thread or machine and survive being killed.
"""

import json
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padforge.design.common.checkpoints import State
from padforge.design.contact import serpentine_presses
from padforge.design.morphology import MARGIN, Array, Morphology, assemble_knots, fibre_ends, split_axes
from padforge.design.objectives.expected_error import (
    SEARCHED,
    aggregate_failures,
    confusable,
    drawn_window,
    expected_error,
    kernel_weights,
    straight_full_scale,
    window_presses,
)
from padforge.design.objectives.fibre_loss import loss_shares, sample_failures
from padforge.design.objectives.penalties import penalties
from padforge.design.objectives.score import sharpness
from padforge.design.optimize.problem import SearchProblem
from padforge.design.paths.curves import refine
from padforge.design.paths.keep_outs import pass_keep_outs, straight_paths
from padforge.design.settings import Layout, PadSettings, RulesSettings
from padforge.design.torch_signals import arc_lengths, pchip_slopes, press_signals

KNOTS_PER_TURN = 3  # before, at and after: a turn of given radius needs its shoulders
OTHER_START = 3  # the last of the default's
MOVED = 0.1  # standard deviation of knots that are moved off a straight course or an origin, grid units
WIDEST_BORDER = 0.45  # of the pad's side: a wider border leaves no room, which the rule check then says


class Fibres:
    """Free variables of a pad's fibres, mapped so that knots stay ascending, apart and off the border.

    Travel coordinates are running sums of a softmax with a floor under every span, cross coordinates a sigmoid.

    Attributes:
        layout: where they end.
        spans: (F, N+1) logits of the spans. cross: (F, N) logits of the cross coordinates; leaves with gradient.
        floor: least span, grid units. border: least cross distance of a knot to the border, grid units.
    """

    def __init__(self, layout: Layout, spans: Tensor, cross: Tensor, floor: float, border: float) -> None:
        self.layout, self.floor, self.border = layout, floor, border
        self.spans, self.cross = (x.detach().clone().requires_grad_() for x in (spans, cross))
        self.ends = fibre_ends(layout)
        along, across = _sides(layout)
        self._along, self._across, self._level = (
            torch.tensor(each)[:, None] for each in (along, across, layout.levels)
        )

    @classmethod
    def through(cls, knots: Array, layout: Layout, border: float) -> "Fibres":
        """Variables of the fibres through knots (F, N+2, 2); knots within `border` of the border are moved off."""
        travel, across = (axis[0] for axis in split_axes(knots[None], layout.horizontals))
        width = np.diff(travel, axis=1)
        floor = min(0.1 * min(layout.extent) / (knots.shape[1] - 1), 0.5 * float(width.min()))
        unit = np.clip((across[:, 1:-1] - border) / (_sides(layout)[1][:, None] - 2 * border), 0.005, 0.995)
        spans, cross = np.log(width - floor), np.log(unit / (1 - unit))
        return cls(layout, torch.tensor(spans), torch.tensor(cross), floor, border)

    def axes(self) -> tuple[Tensor, Tensor]:
        """Travel and cross coordinates of all knots, ends included, both (F, N+2)."""
        count = self.spans.shape[1]
        width = self.floor + (self._along - count * self.floor) * self.spans.softmax(dim=1)
        start = torch.zeros_like(width[:, :1])
        travel = torch.cat([start, width.cumsum(dim=1)[:, :-1], start + self._along], dim=1)
        cross = self.border + (self._across - 2 * self.border) * self.cross.sigmoid()
        return travel, torch.cat([self._level, cross, self._level], dim=1)

    def knots(self) -> Array:
        """(F, N+2, 2) knots as `Morphology` holds them."""
        with torch.no_grad():
            travel, cross = (x.numpy() for x in self.axes())
        inner = np.stack([travel, cross], axis=-1)[:, 1:-1]
        inner[self.layout.horizontals :] = inner[self.layout.horizontals :, :, ::-1]
        return assemble_knots(inner, self.layout)


def _sides(layout: Layout) -> tuple[Array, Array]:
    """(F,) length of the pad along each fibre, and across it, grid units."""
    along = np.repeat(layout.extent, layout.counts)
    return along, np.repeat(layout.extent[::-1], layout.counts)


def border_of(pad: PadSettings, rules: RulesSettings) -> float:
    """Least cross distance of a knot to the border, grid units."""
    wanted = rules.border_mm / pad.layout.unit_mm if rules.enforce else 0.0
    return min(max(MARGIN, wanted), WIDEST_BORDER * min(pad.layout.extent))


def first_course(
    pad: PadSettings,
    rules: RulesSettings,
    knots: int,
    origin: Morphology | None,
    start: int,
    rng: np.random.Generator,
    gentle: bool = True,
) -> Array:
    """Draw the knots (F, N+2, 2) that a start of the search begins with.

    Without an origin most starts have straight fibres with knots moved by a tenth of a grid unit or so: where slopes
    are 0 to both sides of a knot, PCHIP keeps them there and has no gradient to follow. Start 3 has a zigzag; where
    `gentle` does not hold, as under a contact that is felt alike up to its edge, it is the other way round. With an
    origin, start 0 has its very course, later ones have it with knots moved. All pass by keep-outs.

    Args:
        pad, rules: to be kept to.
        knots: N, inside of each fibre.
        origin: to start from.
        start: number of the start.
        rng: of the start.
        gentle: whether fibres that are hardly curved mostly lead to the better pad.
    """
    layout = pad.layout
    if origin is None and (start == OTHER_START) == gentle:
        return pass_keep_outs(_zigzag(layout, rules, knots, rng), pad, rules)
    refined = straight_paths(pad, rules, knots) if origin is None else refine(origin.knots, knots, layout)
    if origin is not None and start == 0 and len(origin.knots[0]) > 2:
        return refined
    inner = refined[:, 1:-1] + MOVED * rng.standard_normal(refined[:, 1:-1].shape)
    return assemble_knots(np.clip(inner, MARGIN, np.array(layout.extent) - MARGIN), layout)


def _zigzag(layout: Layout, rules: RulesSettings, knots: int, rng: np.random.Generator) -> Array:
    """A random zigzag each family runs side by side: nothing crosses within a family, and every turn is round.

    PCHIP has slope 0 at a turn, so that one knot alone bends sharper the higher the flanks; with shoulders
    beside it the flanks may be as steep as they like.
    """
    radius = rules.min_bend_radius_mm / layout.unit_mm if rules.enforce else 0.0
    per_turn = KNOTS_PER_TURN if radius > 0 and knots >= 2 * KNOTS_PER_TURN else 1
    along = [extent for extent, count in zip(layout.extent, layout.counts, strict=True) if count]
    most = max(1, int(min(along) / (4 * radius))) if radius > 0 else knots
    turns = max(1, min(knots // per_turn, most))
    fibres = []
    for axis, rows in enumerate(layout.families):
        width, pitch, level = layout.extent[1 - axis], layout.extent[axis] / (turns + 1), layout.levels[rows, None]
        shoulder = float(np.clip(0.8 * radius, 0.1 * pitch, 0.25 * pitch))
        along = pitch * (np.arange(1, turns + 1) + 0.12 * rng.standard_normal(turns))
        side = np.where(np.arange(turns) % 2 == 0, 1, -1) * rng.choice([-1, 1])
        swing = 0.6 * side * rng.uniform(0.5, 1.2, turns)
        short = min(1.0, layout.extent[axis] / width)  # fibres shorter than the pad is wide have less room to turn
        towards = width / 2 + (1 - 0.3 * short) * (level - width / 2)
        peak = towards + short * swing + 0.1 * rng.standard_normal((len(level), turns))
        peak = np.sort(peak, axis=0)
        turn = np.sort(along + 0.02 * rng.standard_normal((len(level), turns)), axis=1)
        whole = np.concatenate([level, peak, level], axis=1)
        drop = np.clip(0.12 * np.stack([peak - whole[:, :-2], peak - whole[:, 2:]]), -0.1, 0.1)
        parts = [(turn - shoulder, peak - drop[0]), (turn, peak), (turn + shoulder, peak - drop[1])]
        chosen = parts if per_turn == KNOTS_PER_TURN else parts[1:2]
        travel, cross = (
            np.stack([part[i] for part in chosen], axis=-1).reshape(len(level), turns * len(chosen)) for i in (0, 1)
        )
        fibres.append(np.stack([travel, cross] if axis == 0 else [cross, travel], axis=-1))
    inner = np.clip(np.concatenate(fibres), 0.02, np.array(layout.extent) - 0.02)
    return refine(assemble_knots(inner, layout), knots, layout)


LOUDER = 2.0  # scatter of the first step as a multiple of the last one's
RATE = 0.04
PENALTY = (1.0, 300.0)  # weight of the rules, raised from first to last step
RULE_MARGIN = 1.05  # on the limits of the rules
NOTED_STEPS = 10  # between entries of the history
REPAIR_STEPS, REPAIR_CHECKS = 600, 20  # after the last step, until the exact check passes; steps between checks
REPAIR_MARGIN = 0.01  # added to the margin at each check that does not pass
REPAIR_RATE, REPAIR_FASTER, REPAIR_FASTEST = 0.002, 1.15, 0.01  # gentle at first, and faster with each such check


class GradientSearch:
    """One start of the gradient search: Adam with annealed noise and rising penalties, then repair of what is broken.

    The same start of the same problem gives the same fibres, whichever other starts run and however it is sliced.

    Attributes:
        step: steps done. objective: what is minimised, but for the rules, at the last step. done: whether nothing is
            left to do.
        scales: full scale of straight fibres under each contact.
    """

    def __init__(self, problem: SearchProblem, start: int, state: State | None = None) -> None:
        self.problem = problem
        self.rng = np.random.default_rng([problem.search.seed, start])
        self.step, self.objective, self.done = 0, math.inf, False
        self._history: list[tuple[int, float]] = []
        pad, search, rules = problem.pad, problem.search, problem.rules
        if state is None:
            self.scales = [straight_full_scale(pad.layout, contact, pad.sensed_mm) for contact in problem.contacts]
            gentle = bool(problem.contacts[0].sensitivity_profile)
            course = first_course(pad, rules, search.knots, problem.origin, start, self.rng, gentle)
            self.fibres = Fibres.through(course, pad.layout, border_of(pad, rules))
            self._optimiser = self._adam()
        else:
            self._restore(state)

    def advance(self, steps: int) -> None:
        """Take up to `steps` steps, fewer if it is done before."""
        for _ in range(steps):
            if self.done:
                return
            if self.step < self.problem.search.steps:
                self._step()
            else:
                self._repair()

    def finish(self) -> None:
        """Leave out what is left of the search, so that the next steps repair what is broken."""
        if self.step < self.problem.search.steps:
            self._begin_repair()

    def morphology(self) -> Morphology:
        """The fibres as they are."""
        return Morphology.from_layout(self.fibres.knots(), self.fibres.layout)

    def state(self) -> State:
        """Everything the rest of the search depends on, as arrays."""
        adam = self._optimiser.state_dict()["state"]
        generator = json.dumps(self.rng.bit_generator.state).encode()
        state = {
            "spans": self.fibres.spans.detach().numpy().copy(),
            "cross": self.fibres.cross.detach().numpy().copy(),
            "fixed": np.array([self.fibres.floor, self.fibres.border]),
            "scales": np.array(self.scales),
            "progress": np.array([self.step, self.objective]),
            "done": np.array(self.done),
            "history": np.array(self._history).reshape(-1, 2),
            "generator": np.frombuffer(generator, np.uint8).copy(),
        }
        for variable, moments in adam.items():
            state |= {f"adam_{variable}_{name}": value.numpy().copy() for name, value in moments.items()}
        return state

    def _restore(self, state: State) -> None:
        floor, border = state["fixed"].tolist()
        self.scales = state["scales"].tolist()
        self.fibres = Fibres(
            self.problem.pad.layout, torch.tensor(state["spans"]), torch.tensor(state["cross"]), floor, border
        )
        step, self.objective = state["progress"].tolist()
        self.step, self.done = int(step), bool(state["done"])
        self._history = [(int(step), objective) for step, objective in state["history"].tolist()]
        self.rng.bit_generator.state = json.loads(state["generator"].tobytes())
        self._optimiser = self._adam()
        moments: dict[int, dict[str, Any]] = {}
        for name, value in state.items():
            if name.startswith("adam_"):
                _, variable, moment = name.split("_", 2)
                moments.setdefault(int(variable), {})[moment] = torch.tensor(value)
        self._optimiser.load_state_dict(self._optimiser.state_dict() | {"state": moments})

    def _step(self) -> None:
        """One step on the expected error and the rules."""
        search, rules = self.problem.search, self.problem.rules
        progress = self.step / max(1, search.steps - 1)
        rate = RATE * (0.02 + 0.98 * (1 + math.cos(math.pi * progress)) / 2)
        travel, cross = self.fibres.axes()
        total = self._expected_error(travel, cross, LOUDER ** (1 - progress))
        self.objective = total.item()
        if rules.enforce:
            total = total + PENALTY[0] * (PENALTY[1] / PENALTY[0]) ** progress * self._penalty(
                travel, cross, RULE_MARGIN
            )
        self._follow(total, rate)
        self.step += 1
        if self.step % NOTED_STEPS == 0 or self.step == search.steps:
            self._history.append((self.step, self.objective))
        if self.step == search.steps:
            self._begin_repair()

    def _begin_repair(self) -> None:
        """What comes after the last step: nothing, if the exact check finds nothing."""
        self.step = self.problem.search.steps
        self.done = not self._broken()
        self._optimiser = self._adam()

    def _repair(self) -> None:
        """One step on the rules alone, which moves only what breaks them, with a margin that grows until they hold."""
        repairs = self.step - self.problem.search.steps
        checks = repairs // REPAIR_CHECKS
        rate = min(REPAIR_RATE * REPAIR_FASTER**checks, REPAIR_FASTEST)
        self._follow(self._penalty(*self.fibres.axes(), RULE_MARGIN + REPAIR_MARGIN * checks), rate)
        self.step += 1
        if (repairs + 1) % REPAIR_CHECKS == 0:
            self.done = repairs + 1 >= REPAIR_STEPS or not self._broken()

    def _follow(self, total: Tensor, rate: float) -> None:
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        self._optimiser.zero_grad()
        total.backward()
        for variable in (self.fibres.spans, self.fibres.cross):
            if variable.grad is not None:  # where all presses are told apart beyond doubt, or none are, it may be NaN
                variable.grad.nan_to_num_(0.0, 0.0, 0.0)
        self._optimiser.step()

    def _penalty(self, travel: Tensor, cross: Tensor, margin: float) -> Tensor:
        found = penalties(travel, cross, self.problem.pad, self.problem.rules, margin)
        return torch.stack(list(found.values())).sum()

    def _adam(self) -> torch.optim.Adam:
        return torch.optim.Adam([self.fibres.spans, self.fibres.cross], lr=RATE)

    def _expected_error(self, travel: Tensor, cross: Tensor, louder: float) -> Tensor:
        """What is minimised, and sharpness where it is asked for, averaged over the contacts."""
        search, pad = self.problem.search, self.problem.pad
        slope = pchip_slopes(travel, cross)
        length = arc_lengths(travel, cross, slope)[:, None]
        presses = window_presses(pad, drawn_window(pad.sensed, self.rng), SEARCHED, self.rng)
        while not presses.free.any():  # it lies in a keep-out
            presses = window_presses(pad, drawn_window(pad.sensed, self.rng), SEARCHED, self.rng)
        shares = loss_shares(search.max_failures)
        masks, _ = sample_failures(pad.layout.fibres, shares, self.rng)
        step, free, masks = (torch.tensor(x, device=search.device) for x in (presses.step, presses.free, masks))
        masks, scatter = masks.float(), search.response_scatter.scaled(louder)
        weights = kernel_weights(pad.layout).float().to(search.device)
        total = torch.zeros((), device=search.device)
        for contact, scale in zip(self.problem.contacts, self.scales, strict=True):
            signals_at = partial(
                press_signals,
                *(travel, cross, slope),
                contact=contact,
                ends=self.fibres.ends,
                unit_mm=pad.layout.unit_mm,
            )

            def responses(
                positions: Array, signals_at: Callable[[Array], Tensor] = signals_at, scale: float = scale
            ) -> Tensor:
                return (signals_at(positions) / (scale * length)).float().to(search.device)

            positions = torch.from_numpy(presses.positions)
            if len(presses.far):
                with torch.no_grad():
                    near, far = (weights[:, None] * responses(each) for each in (presses.positions, presses.far))
                    positions = presses.joined(confusable(near, far, masks))
            given = responses(positions.numpy()), positions.to(search.device), step, free, masks, scatter
            total = total + aggregate_failures(expected_error(*given, weights), masks, shares)
            if search.sharpness > 0:
                in_order = signals_at(serpentine_presses(pad.sensed, SEARCHED))
                total = total + search.sharpness * sharpness(in_order.float().to(search.device))
        return total.cpu() / len(self.problem.contacts)

    def _broken(self) -> bool:
        return bool(self.problem.broken(self.morphology()))
