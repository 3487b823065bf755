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
from padforge.design.common.checkpoints import State
from padforge.design.criteria.ambiguity import sharpness
from padforge.design.criteria.differentiable import arc_lengths, pchip_slopes, press_signals
from padforge.design.criteria.fibre_loss import draw_losses, loss_shares
from padforge.design.criteria.penalties import penalties
from padforge.design.evaluation.expected_error import (
    SEARCHED,
    confusable,
    drawn_window,
    expected_error,
    kernel_weights,
    over_losses,
    straight_full_scale,
    window_presses,
)
from padforge.design.pad.contact import boustrophedon
from padforge.design.pad.knots import Array
from padforge.design.pad.morphology import Morphology
from torch import Tensor

from .parametrization import Fibres, border_of, first_course
from .problem import SearchProblem

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
            gentle = bool(problem.contacts[0].reach)
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
        return Morphology.of_layout(self.fibres.knots(), self.fibres.layout)

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
            total = total + PENALTY[0] * (PENALTY[1] / PENALTY[0]) ** progress * self._penalty(travel, cross, RULE_MARGIN)
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
        shares = loss_shares(search.lost)
        masks, _ = draw_losses(pad.layout.fibres, shares, self.rng)
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
            total = total + over_losses(expected_error(*given, weights), masks, shares)
            if search.sharpness > 0:
                in_order = signals_at(boustrophedon(pad.sensed, SEARCHED))
                total = total + search.sharpness * sharpness(in_order.float().to(search.device))
        return total.cpu() / len(self.problem.contacts)

    def _broken(self) -> bool:
        return bool(self.problem.broken(self.morphology()))
