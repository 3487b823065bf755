"""Gradient search on the expected error under noise and fibre loss, within the rules.

One start is a `GradientSearch`: it advances by any number of steps, returns its state as plain arrays and goes on from
them to the same bits, so that it can run in slices on any thread or machine and survive being killed.
"""

import json
import math
from typing import NamedTuple

import numpy as np

from padforge.common.parallel import State
from padforge.design.morphology import MARGIN, Array, Morphology, assemble_knots, fibre_ends, split_axes
from padforge.design.objectives import expected_error as objective
from padforge.design.objectives.fibre_loss import failure_shares, sample_failures
from padforge.design.objectives.penalties import penalties
from padforge.design.objectives.score import weighted_terms
from padforge.design.optimize.problem import SearchProblem
from padforge.design.paths.curves import refine
from padforge.design.paths.keep_outs import pass_keep_outs, straight_paths
from padforge.design.settings import Contact, Layout, PadSettings, RulesSettings, Scatter
from padforge.design.signal_gradients import Differentiate, FibreCurves


class Schedule(NamedTuple):
    """How the steps of a start change from the first to the last one."""

    rate: float  # learning rate of the first step
    fall: int  # power of cos(pi p / 2), by which it falls after a share p of the steps
    penalty_weights: tuple[float, float]  # weight of the rules at the first and at the last step


GENTLE, STRICT = Schedule(0.02, 2, (1.6, 530.0)), Schedule(0.04, 4, (5.0, 1600.0))
"""Most starts are gentle: large steps and strong rules shake fibres out of what locates with two and three failed, too.
But zigzags may tangle so that some rules stay broken, as that on the angle of crossings.
"""
STRICT_START = 3
"""Of four starts the strict one, which is nearly straight at first."""
MIN_RATE = 0.02
"""Learning rate of the last step, as a share of that of the first one."""
BETAS = 0.9, 0.999
"""By which a step of Adam multiplies its means of gradients and of their squares."""
INITIAL_NOISE = 2.0
"""Scatter of the first step as a multiple of the last one's."""
COMMON_TRACKS_FROM = 0.7
"""Share of the steps after which the rule on common tracks counts: before, it hinders crossings from moving, and what
it asks for in the end is a small change.
"""
RULE_MARGIN = 1.05
"""On the limits of the rules."""
FORGETTING = 0.03
"""Weight of a step in the running means of errors."""
HISTORY_STEPS = 10
"""Steps between entries of the history, each the geometric mean of the objectives since the last one."""
MAX_GRADIENT = 1e150
"""Whose square is finite."""
REPAIR_STEPS, REPAIR_CHECKS, FINE_STEPS = 800, 20, 200
"""Most steps of repair after the last step, steps between two exact checks, and the first ones, which are fine."""
REPAIR_MARGIN = 0.01
"""Added to the margin at each failed check."""
FINE_REPAIR, FIRM_REPAIR, MAX_REPAIR_RATE = (0.003, 1.1), (0.002, 1.15), 0.01
"""Learning rate of the repair, gentle at first, and its growth at each failed check."""
FINE_MEMORY = 0.5
"""By which a fine step of the repair multiplies its means of directions."""
KNOTS_PER_TURN = 3
"""Before, at and after: a turn of given radius needs its shoulders."""
KNOT_STD = 0.1
"""Standard deviation by which knots are moved off straight paths or an origin, grid units."""
MAX_BORDER = 0.45
"""Of the pad's side: a wider border leaves no room, which the rule check then reports."""


class Parametrization:
    """Free variables of a pad's fibres, mapped so that knots stay ascending, separate and off the border.

    Coordinates along a fibre are running sums of a softmax with a floor under every span, those across it a sigmoid.
    """

    def __init__(self, layout: Layout, spans: Array, across: Array, floor: float, border: float) -> None:
        self.layout, self.ends = layout, fibre_ends(layout)
        self.floor, self.border = floor, border  # least span, and least distance of a knot to the border, grid units
        self.spans, self.across = spans, across  # logits of the spans (F, N + 1), and of the coordinates across (F, N)
        self._length, self._width, self._level = (x[:, None] for x in (*_sides(layout), layout.levels))
        self._free = self._length - spans.shape[1] * floor  # what the spans share; shape (F, 1)

    @classmethod
    def from_knots(cls, knots: Array, layout: Layout, border: float) -> "Parametrization":
        """Return the variables of fibres through knots (F, N + 2, 2); those nearer to the border are moved to it."""
        along, across = (axis[0] for axis in split_axes(knots[None], layout.horizontals))
        width = np.diff(along, axis=1)
        floor = min(0.1 * min(layout.extent) / (knots.shape[1] - 1), 0.5 * float(width.min()))
        unit = np.clip((across[:, 1:-1] - border) / (_sides(layout)[1][:, None] - 2 * border), 0.005, 0.995)
        return cls(layout, np.log(width - floor), np.log(unit / (1 - unit)), floor, border)

    def axes(self) -> tuple[Array, Array]:
        """Return the coordinates of all knots along and across the fibres, ends included, both (F, N + 2)."""
        width, unit = self.floor + self._free * self._shares(), 1 / (1 + np.exp(-self.across))
        begin = np.zeros_like(self._length)
        along = np.concatenate([begin, width.cumsum(axis=1)[:, :-1], self._length], axis=1)
        across = self.border + (self._width - 2 * self.border) * unit
        return along, np.concatenate([self._level, across, self._level], axis=1)

    def gradients(self, by_along: Array, by_across: Array) -> tuple[Array, Array]:
        """Return the derivatives by the logits of a value that has these (F, N + 2) by the coordinates of the knots."""
        shares, unit = self._shares(), 1 / (1 + np.exp(-self.across))
        by_shares = np.zeros_like(shares)  # each moves the knots after it, but for the last, which is fixed
        by_shares[:, :-1] = self._free * by_along[:, -2:0:-1].cumsum(axis=1)[:, ::-1]
        by_spans = shares * (by_shares - (shares * by_shares).sum(axis=1, keepdims=True))
        return by_spans, by_across[:, 1:-1] * (self._width - 2 * self.border) * unit * (1 - unit)

    def knots(self) -> Array:
        """Return the knots (F, N + 2, 2) as `Morphology` holds them."""
        inner = np.stack(self.axes(), axis=-1)[:, 1:-1]
        inner[self.layout.horizontals :] = inner[self.layout.horizontals :, :, ::-1]
        return assemble_knots(inner, self.layout)

    def _shares(self) -> Array:
        """Return the softmax (F, N + 1) of the spans' logits."""
        powers = np.exp(self.spans - self.spans.max(axis=1, keepdims=True))
        return powers / powers.sum(axis=1, keepdims=True)


class Adam:
    """Steps of variables in place along smoothed gradients (Kingma and Ba, ICLR 2015), with the usual constants.

    `moments` are the smoothed gradients of each variable and their squares, after `steps` steps.
    """

    def __init__(self, variables: list[Array], steps: int = 0, moments: list[Array] | None = None) -> None:
        self.variables, self.steps = variables, steps
        self.moments = [np.zeros((2, *x.shape)) for x in variables] if moments is None else moments

    def step(self, gradients: tuple[Array, ...], rate: float) -> None:
        """Take a step of a learning rate; what is not finite of a gradient counts as 0."""
        self.steps += 1
        for x, (mean, square), gradient in zip(self.variables, self.moments, gradients, strict=True):
            finite = _finite(gradient)
            mean += (1 - BETAS[0]) * (finite - mean)
            square += (1 - BETAS[1]) * (finite**2 - square)
            unbiased = mean / (1 - BETAS[0] ** self.steps), square / (1 - BETAS[1] ** self.steps)
            x -= rate * unbiased[0] / (np.sqrt(unbiased[1]) + 1e-8)


def _finite(gradient: Array) -> Array:
    """Return a gradient whose squares are finite; what is not finite of it counts as 0."""
    return np.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0).clip(-MAX_GRADIENT, MAX_GRADIENT)


def _sides(layout: Layout) -> tuple[Array, Array]:
    """Return the side (F,) of the pad along each fibre, and the one across it, grid units."""
    return np.repeat(layout.extent, layout.counts), np.repeat(layout.extent[::-1], layout.counts)


def border_width(pad: PadSettings, rules: RulesSettings) -> float:
    """Return the least distance of a knot to the border, grid units."""
    limit = rules.border_mm / pad.layout.unit_mm if rules.enforce else 0.0
    return min(max(MARGIN, limit), MAX_BORDER * min(pad.layout.extent))


def is_strict(start: int) -> bool:
    """Return whether a start takes large steps under strong rules."""
    return start % 4 == STRICT_START


def initial_paths(
    pad: PadSettings, rules: RulesSettings, knots: int, origin: Morphology | None, start: int, rng: np.random.Generator
) -> Array:
    """Draw the knots (F, N + 2, 2) that a start of the search begins with; they pass keep-outs.

    Without an origin, each start has a zigzag of its own, but for strict ones, which have straight fibres with knots
    moved by a tenth of a grid unit or so: where slopes are 0 to both sides of a knot, PCHIP keeps them there and has no
    gradient. With an origin, start 0 has its very paths, later ones have them with knots moved.
    """
    if origin is None and not is_strict(start):
        return pass_keep_outs(_zigzag(pad.layout, rules, knots, rng), pad, rules)
    paths = straight_paths(pad, rules, knots) if origin is None else refine(origin.knots, knots, pad.layout)
    if origin is not None and start == 0 and len(origin.knots[0]) > 2:
        return paths
    inner = paths[:, 1:-1] + KNOT_STD * rng.standard_normal(paths[:, 1:-1].shape)
    return assemble_knots(np.clip(inner, MARGIN, np.array(pad.layout.extent) - MARGIN), pad.layout)


def _zigzag(layout: Layout, rules: RulesSettings, knots: int, rng: np.random.Generator) -> Array:
    """Draw a random zigzag that each family runs side by side: no crossings within a family, and round turns.

    PCHIP has slope 0 at a turn, so that one knot alone bends sharper the higher the flanks; with shoulders
    beside it the flanks may be as steep as they like.
    """
    radius = rules.min_mean_bend_radius_mm / layout.unit_mm if rules.enforce else 0.0
    per_turn = KNOTS_PER_TURN if radius > 0 and knots >= 2 * KNOTS_PER_TURN else 1
    extent = min(extent for extent, count in zip(layout.extent, layout.counts, strict=True) if count)
    turns = max(1, min(knots // per_turn, int(extent / (4 * radius)) if radius > 0 else knots))
    fibres = []
    for axis, rows in enumerate(layout.families):
        width, pitch, level = layout.extent[1 - axis], layout.extent[axis] / (turns + 1), layout.levels[rows, None]
        shoulder = float(np.clip(0.8 * radius, 0.1 * pitch, 0.25 * pitch))
        position = pitch * (np.arange(1, turns + 1) + 0.12 * rng.standard_normal(turns))
        side = np.where(np.arange(turns) % 2 == 0, 1, -1) * rng.choice([-1, 1])
        swing = 0.6 * side * rng.uniform(0.5, 1.2, turns)
        short = min(1.0, layout.extent[axis] / width)  # fibres shorter than the pad is wide have less room to turn
        centre = width / 2 + (1 - 0.3 * short) * (level - width / 2)
        peak = np.sort(centre + short * swing + 0.1 * rng.standard_normal((len(level), turns)), axis=0)
        turn = np.sort(position + 0.02 * rng.standard_normal((len(level), turns)), axis=1)
        path = np.concatenate([level, peak, level], axis=1)
        drop = np.clip(0.12 * np.stack([peak - path[:, :-2], peak - path[:, 2:]]), -0.1, 0.1)
        parts = [(turn, peak)]
        if per_turn == KNOTS_PER_TURN:
            parts = [(turn - shoulder, peak - drop[0]), *parts, (turn + shoulder, peak - drop[1])]
        points = np.moveaxis(np.array(parts), 1, -1)  # (parts, F, turns, 2), along and across
        points = np.moveaxis(points, 0, 2).reshape(len(level), turns * len(parts), 2)
        fibres.append(points if axis == 0 else points[..., ::-1])
    inner = np.clip(np.concatenate(fibres), 0.02, np.array(layout.extent) - 0.02)
    return refine(assemble_knots(inner, layout), knots, layout)


class GradientSearch:
    """One start of the gradient search: Adam with annealed noise and rising penalties, then repair of broken rules.

    The same start of the same problem gives the same fibres, whichever other starts run and however it is sliced.
    """

    def __init__(self, problem: SearchProblem, start: int, state: State | None = None) -> None:
        self.problem, self.rng = problem, np.random.default_rng([problem.search.seed, start])
        self._schedule = STRICT if is_strict(start) else GENTLE
        self.step, self.objective, self.done = 0, math.inf, False  # objective of the last step, without penalties
        self._log_sum = 0.0  # of the objectives since the last entry of the history
        self._history: list[tuple[int, float]] = []
        self._broken = np.zeros(problem.pad.layout.fibres, bool)  # fibres that broke rules at the last check
        # running means of the errors by contact and number of failed fibres, from straight fibres' on
        self._means = problem.straight_errors.copy()
        if state is not None:
            self._restore(state)
            return
        pad, rules = problem.pad, problem.rules
        # full scale of straight fibres under each contact
        self.scales = [objective.straight_full_scale(pad.layout, c, pad.sensed_mm) for c in problem.contacts]
        paths = initial_paths(pad, rules, problem.search.knots, problem.origin, start, self.rng)
        self.fibres = Parametrization.from_knots(paths, pad.layout, border_width(pad, rules))
        self._adam = Adam([self.fibres.spans, self.fibres.across])

    def advance(self) -> None:
        """Take one step of the search, or of the repair after it."""
        if self.step < self.problem.steps:
            self._descend()
        else:
            self._repair()

    def finish(self) -> None:
        """Skip the remaining steps of the search, so that the next ones are repair."""
        if self.step < self.problem.steps:
            self._begin_repair()

    def morphology(self) -> Morphology:
        """Return the fibres as they are."""
        return Morphology.from_layout(self.fibres.knots(), self.fibres.layout)

    def state(self) -> State:
        """Return everything that the remaining search depends on, as arrays."""
        generator = json.dumps(self.rng.bit_generator.state).encode()
        return {
            "spans": self.fibres.spans.copy(),
            "across": self.fibres.across.copy(),
            "fixed": np.array([self.fibres.floor, self.fibres.border]),
            "scales": np.array(self.scales),
            "means": self._means.copy(),
            "progress": np.array([self.step, self.objective, self._log_sum]),
            "done": np.array(self.done),
            "history": np.array(self._history).reshape(-1, 2),
            "generator": np.frombuffer(generator, np.uint8).copy(),
            "adam_steps": np.array(self._adam.steps),
            "adam_spans": self._adam.moments[0].copy(),
            "adam_across": self._adam.moments[1].copy(),
            "broken": self._broken.copy(),
        }

    def _restore(self, state: State) -> None:
        variables = [state["spans"].copy(), state["across"].copy()]
        self.scales, self._means = state["scales"].tolist(), state["means"].copy()
        self.fibres = Parametrization(self.problem.pad.layout, *variables, *state["fixed"].tolist())
        step, self.objective, self._log_sum = state["progress"].tolist()
        self.step, self.done = int(step), bool(state["done"])
        self._history = [(int(step), objective) for step, objective in state["history"].tolist()]
        self.rng.bit_generator.state = json.loads(state["generator"].tobytes())
        moments = [state["adam_spans"].copy(), state["adam_across"].copy()]
        self._adam = Adam(variables, int(state["adam_steps"]), moments)
        self._broken = state["broken"].copy()

    def _descend(self) -> None:
        """Take one step on the objective and the rules."""
        rate, fall, (first, last) = self._schedule
        progress = self.step / max(1, self.problem.steps - 1)
        rate *= MIN_RATE + (1 - MIN_RATE) * math.cos(math.pi / 2 * progress) ** fall
        curves = self._curves()
        self.objective, by_curves = self._objective(curves, INITIAL_NOISE ** (1 - progress))
        gradient = curves.by_knots(by_curves)
        if (rules := self.problem.rules).enforce:
            if progress < COMMON_TRACKS_FROM:
                rules = rules.model_copy(update={"max_common_track_mm": None})
            weight = first * (last / first) ** progress
            gradient = gradient + weight * self._penalty_gradient(curves, rules, RULE_MARGIN, all_bends=False)
        self._adam.step(self.fibres.gradients(*gradient), rate)
        self.step += 1
        self._log_sum += math.log(self.objective)
        if self.step % HISTORY_STEPS == 0 or self.step == self.problem.steps:
            steps = (self.step - 1) % HISTORY_STEPS + 1
            self._history.append((self.step, math.exp(self._log_sum / steps)))
            self._log_sum = 0.0
        if self.step == self.problem.steps:
            self._begin_repair()

    def _begin_repair(self) -> None:
        """End the search; there is nothing to repair if the exact check passes."""
        self.step = self.problem.steps
        self._adam = Adam([self.fibres.spans, self.fibres.across])
        self.done = self._check()

    def _check(self) -> bool:
        """Find the fibres that break rules, all of them where one concerns the pad as a whole; return if none does."""
        violations = self.problem.violations(self.morphology())
        self._broken[:] = False
        for violation in violations:
            self._broken[[fibre - 1 for fibre in violation.fibres] or slice(None)] = True
        return not violations

    def _repair(self) -> None:
        """Take one step on the rules alone; the margin grows until they hold.

        The first ones are fine, of fibres that break rules, and as the root of the gradient: as the gradient itself,
        knots of small ones would stay. Where these do not suffice, all fibres take steps of Adam, which move all knots
        nearly alike: that resolves more, but costs accuracy.
        """
        repairs = self.step - self.problem.steps
        fine = repairs < FINE_STEPS
        if repairs == FINE_STEPS:
            self._adam = Adam(self._adam.variables)
        checks = (repairs if fine else repairs - FINE_STEPS) // REPAIR_CHECKS
        rate, growth = FINE_REPAIR if fine else FIRM_REPAIR
        rate = min(rate * growth**checks, MAX_REPAIR_RATE)
        margin = RULE_MARGIN + REPAIR_MARGIN * checks
        gradient = self._penalty_gradient(self._curves(), self.problem.rules, margin)
        if fine:
            self._step_finely(self.fibres.gradients(*gradient * self._broken[:, None]), rate)
        else:
            self._adam.step(self.fibres.gradients(*gradient), rate)
        self.step += 1
        if (repairs + 1) % REPAIR_CHECKS == 0:
            self.done = repairs + 1 >= REPAIR_STEPS or self._check()

    def _step_finely(self, gradients: tuple[Array, Array], rate: float) -> None:
        """Take a step as the root of the gradients, of length `rate` where a fibre's gradient is greatest."""
        gradients = _finite(gradients[0]), _finite(gradients[1])
        largest = np.maximum(*(np.abs(by_x).max(axis=1, keepdims=True) for by_x in gradients))
        for x, (mean, _), by_x in zip(self._adam.variables, self._adam.moments, gradients, strict=True):
            direction = np.sign(by_x) * np.sqrt(np.abs(by_x) / np.where(largest > 0, largest, 1))
            mean += (1 - FINE_MEMORY) * (direction - mean)
            x -= rate * mean

    def _curves(self) -> FibreCurves:
        return FibreCurves(*self.fibres.axes(), self.fibres.ends, self.problem.pad.layout.unit_mm)

    def _penalty_gradient(
        self, curves: FibreCurves, rules: RulesSettings, margin: float, all_bends: bool = True
    ) -> Array:
        """Return the gradient (2, F, n) of the sum of all penalties by the knots."""
        total = penalties(curves.along, curves.across, self.problem.pad, rules, margin, all_bends)
        return np.stack([total.by_along, total.by_across])

    def _objective(self, curves: FibreCurves, noise_factor: float) -> tuple[float, Array]:
        """Return the relative error on random presses and failures, and the weighted terms; and a gradient.

        A step looks at one contact, drawn by its part in the mean, and remembers what earlier steps have seen of the
        others: so the gradient (3, F, n) by the curves is that of the mean on average, for the time of one contact.
        """
        search, pad, shares = self.problem.search, self.problem.pad, failure_shares(self.problem.search.max_failures)
        # 1. a random window, all of the pad unless it is large; another one if it lies in a keep-out; random failures
        presses = None
        while presses is None or not presses.free.any():
            window = objective.place_window(pad.sensed, self.rng.random(2))
            presses = objective.window_presses(pad, window, objective.SEARCH_SIDE, self.rng)
        masks = sample_failures(pad.layout.fibres, shares, self.rng)
        # 2. errors under one contact, and how straight fibres compare
        straight = self.problem.straight_errors
        value, by_means = objective.relative_error(self._means, straight, shares)
        parts = (by_means * self._means).sum(axis=1) / value  # in the mean, of each contact; they add up to 1
        which = int(self.rng.choice(len(parts), p=parts))
        contact, scale = self.problem.contacts[which], self.scales[which]
        stated = search.response_scatter.scaled(noise_factor)
        scatter = objective.scatter_of_full_scale(stated, contact, scale)
        errors, differentiate = self._errors(curves, presses, masks, contact, scale, scatter)
        averages = objective.averages(masks, straight.shape[1])
        self._means[which] += FORGETTING * (averages @ errors - self._means[which])
        total, by_means = objective.relative_error(self._means, straight, shares)
        gradient = differentiate(by_means[which] @ averages) / parts[which]
        # 3. the terms that `[search]` weighs
        for weight, term in weighted_terms(search):
            if term.loss is not None:
                value, by_curves = term.loss(curves, self.problem.contacts[0], pad)
                total, gradient = total + weight * value, gradient + weight * by_curves
        return total, gradient

    def _errors(
        self,
        curves: FibreCurves,
        presses: objective.PressWindow,
        masks: Array,
        contact: Contact,
        scale: float,
        scatter: Scatter,
    ) -> tuple[Array, Differentiate]:
        """Return the expected errors (L,) under a contact, and what differentiates: from (L,) to (3, F, n)."""
        (length, by_length), weights = curves.lengths(), objective.kernel_weights(self.problem.pad.layout)
        per_signal, positions = 1 / (scale * length[:, None]), presses.positions
        if len(presses.far):  # those whose responses resemble some of the window
            near, far = (
                weights[:, None] * per_signal * curves.signals(x, contact)[0] for x in (presses.positions, presses.far)
            )
            positions = presses.with_partners(objective.confusable(near, far, masks))
        signals, by_signals = curves.signals(positions, contact)
        responses = per_signal * signals
        where = positions, presses.step, presses.free
        errors, by_responses = objective.expected_error(responses, *where, masks, scatter, weights)

        def differentiate(by_errors: Array) -> Array:
            by_response = np.tensordot(by_errors, by_responses, axes=1)
            by_lengths = (by_response * responses).sum(axis=1) / length
            return by_signals(by_response * per_signal) - by_lengths[:, None] * by_length

        return errors, differentiate
