"""Gradient search on the expected error under noise and fibre loss, within the rules.

One start is a `GradientSearch`. It advances by any number of steps and returns its state as plain arrays, from which it
resumes bit for bit, so that it can run in slices on any thread or machine and survive being killed.
"""

import json
import math
from typing import NamedTuple

import numpy as np

from padforge.common.parallel import State
from padforge.design.morphology import MARGIN, Array, Morphology, assemble_knots, split_axes
from padforge.design.objectives import criterion as criteria
from padforge.design.objectives.fibre_loss import failure_shares, sample_failures
from padforge.design.objectives.penalties import penalties
from padforge.design.objectives.score import sharpness_loss
from padforge.design.optimize.problem import SearchProblem
from padforge.design.paths.curves import refine
from padforge.design.paths.keep_outs import pass_keep_outs, straight_paths
from padforge.design.settings import Contact, Layout, PadSettings, RulesSettings, Scatter
from padforge.design.signal_gradients import Differentiate, FibreCurves


class Schedule(NamedTuple):
    """Learning rate and penalty weight of a start as functions of its progress p, from 0 to 1."""

    rate: float  # learning rate of the first step
    decay_power: int  # the rate decays as cos(pi p / 2) to this power, down to 2 % of its first value
    penalty_weights: tuple[float, float]  # weight of the penalties at the first and at the last step


GENTLE = Schedule(0.02, 2, (1.6, 530.0))
"""Schedule of most starts. Larger steps and stronger penalties move fibres away from layouts that still locate presses
with two or three failures.
"""
STRICT = Schedule(0.04, 4, (5.0, 1600.0))
"""Schedule of every second start, which begins nearly straight. Zigzags may tangle so that some rules stay broken, such
as the one on crossing angles.
"""
COMMON_TRACKS_FROM = 0.7
"""Progress from which the rule on common tracks counts. Earlier it hinders crossings from moving, and in the end it
takes only small changes to keep it.
"""
RULE_MARGIN = 1.05
"""Safety factor on the limits of the rules during the search."""
HISTORY_STEPS = 10
"""Steps between entries of the history, each the geometric mean of the objectives since the last one."""
REPAIR_STEPS = 800
"""Maximum steps of repair after the search."""
FINE_STEPS = 200
"""The first steps of repair, which move only the fibres that break rules."""
REPAIR_CHECKS = 20
"""Steps of repair between two exact checks of the rules."""
MEAN_ERROR_RATE = 0.03
"""Weight of the errors of a step in their running means."""
KNOTS_PER_TURN = 3
"""Knots of a rounded turn: one at its peak and a shoulder to either side."""


class Parametrization:
    """Unconstrained variables of a pad's fibres: knots that follow from them always ascend and stay off the border.

    Coordinates along a fibre are cumulative sums of spans, each a floor plus a softmax share of the remaining length.
    Coordinates across it are sigmoids between the borders.

    Attributes:
        layout: number and spacing of the fibres.
        spans: logits of the spans; shape (F, N + 1).
        across: logits of the coordinates across; shape (F, N).
        floor: minimum span, grid units.
        border: minimum distance of a knot to the border, grid units.
    """

    def __init__(self, layout: Layout, spans: Array, across: Array, floor: float, border: float) -> None:
        self.layout = layout
        self.spans, self.across, self.floor, self.border = spans, across, floor, border
        self._length, self._width, self._level = (x[:, None] for x in (*_sides(layout), layout.levels))
        self._free_length = self._length - spans.shape[1] * floor  # distributed by the softmax; shape (F, 1)

    @classmethod
    def from_knots(cls, knots: Array, layout: Layout, border: float) -> "Parametrization":
        """Return the variables of fibres through knots (F, N + 2, 2), moving knots beyond the border onto it."""
        along, across = (axis[0] for axis in split_axes(knots[None], layout.horizontals))
        spans = np.diff(along, axis=1)
        floor = min(0.1 * min(layout.extent) / (knots.shape[1] - 1), 0.5 * float(spans.min()))
        unit = np.clip((across[:, 1:-1] - border) / (_sides(layout)[1][:, None] - 2 * border), 0.005, 0.995)
        return cls(layout, np.log(spans - floor), np.log(unit / (1 - unit)), floor, border)

    def axes(self) -> tuple[Array, Array]:
        """Return the coordinates of all knots along and across the fibres, ends included, both (F, N + 2)."""
        spans = self.floor + self._free_length * self._softmax()
        along = np.concatenate([np.zeros_like(self._length), spans.cumsum(axis=1)[:, :-1], self._length], axis=1)
        across = self.border + (self._width - 2 * self.border) * self._sigmoid()
        return along, np.concatenate([self._level, across, self._level], axis=1)

    def gradients(self, grad_along: Array, grad_across: Array) -> tuple[Array, Array]:
        """Return the gradients by `spans` and `across` of a value, from those by the knots' coordinates (F, N + 2)."""
        shares, unit = self._softmax(), self._sigmoid()
        grad_shares = np.zeros_like(shares)  # a span moves all later knots except the last, which is fixed
        grad_shares[:, :-1] = self._free_length * grad_along[:, -2:0:-1].cumsum(axis=1)[:, ::-1]
        grad_spans = shares * (grad_shares - (shares * grad_shares).sum(axis=1, keepdims=True))
        return grad_spans, grad_across[:, 1:-1] * (self._width - 2 * self.border) * unit * (1 - unit)

    def knots(self) -> Array:
        """Return the knots (F, N + 2, 2) as `Morphology` holds them."""
        inner = np.stack(self.axes(), axis=-1)[:, 1:-1]
        inner[self.layout.horizontals :] = inner[self.layout.horizontals :, :, ::-1]
        return assemble_knots(inner, self.layout)

    def _softmax(self) -> Array:
        powers = np.exp(self.spans - self.spans.max(axis=1, keepdims=True))
        return powers / powers.sum(axis=1, keepdims=True)

    def _sigmoid(self) -> Array:
        return 1 / (1 + np.exp(-self.across))


class Adam:
    """Adam (Kingma and Ba, ICLR 2015) on arrays, which it changes in place.

    Attributes:
        variables: the arrays.
        steps: steps so far.
        moments: decaying means of the gradient and of its square, for each variable; shape (2, ...).
    """

    def __init__(self, variables: list[Array], steps: int = 0, moments: list[Array] | None = None) -> None:
        self.variables, self.steps = variables, steps
        self.moments = [np.zeros((2, *x.shape)) for x in variables] if moments is None else moments

    def step(self, gradients: tuple[Array, ...], rate: float) -> None:
        """Take one step; components of the gradients that are not finite count as 0."""
        self.steps += 1
        beta1, beta2 = 0.9, 0.999
        for x, (mean, square), gradient in zip(self.variables, self.moments, gradients, strict=True):
            finite = _finite(gradient)
            mean += (1 - beta1) * (finite - mean)
            square += (1 - beta2) * (finite**2 - square)
            unbiased_mean, unbiased_square = mean / (1 - beta1**self.steps), square / (1 - beta2**self.steps)
            x -= rate * unbiased_mean / (np.sqrt(unbiased_square) + 1e-8)


class SignedRootDescent(Adam):
    """Descent along the signed square root of the gradient, averaged over steps; its state has the arrays of Adam's.

    Unlike a step along the gradient, this moves knots of small gradients too; unlike a step of Adam, it leaves knots of
    zero gradient in place. The step has the length `rate` where a fibre's gradient is largest.
    """

    def step(self, gradients: tuple[Array, ...], rate: float) -> None:
        """Take one step; components of the gradients that are not finite count as 0."""
        finite = [_finite(gradient) for gradient in gradients]
        largest = np.maximum(*(np.abs(gradient).max(axis=1, keepdims=True) for gradient in finite))
        for x, (mean, _), gradient in zip(self.variables, self.moments, finite, strict=True):
            direction = np.sign(gradient) * np.sqrt(np.abs(gradient) / np.where(largest > 0, largest, 1))
            mean += 0.5 * (direction - mean)
            x -= rate * mean


def _finite(gradient: Array) -> Array:
    """Set components that are not finite to 0, and clip the others so that their squares do not overflow."""
    return np.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0).clip(-1e150, 1e150)


def _sides(layout: Layout) -> tuple[Array, Array]:
    """Return the side (F,) of the pad along each fibre, and the one across it, grid units."""
    return np.repeat(layout.extent, layout.counts), np.repeat(layout.extent[::-1], layout.counts)


def border_width(pad: PadSettings, rules: RulesSettings) -> float:
    """Return the minimum distance of a knot to the border, grid units."""
    limit = rules.border_mm / pad.layout.unit_mm if rules.enforce else 0.0
    # a border of half the side would leave no room; if the rule asks for that, its exact check fails
    return min(max(MARGIN, limit), 0.45 * min(pad.layout.extent))


def is_strict(start: int) -> bool:
    """Return whether a start follows the schedule STRICT."""
    return start % 2 == 1


def initial_paths(
    pad: PadSettings, rules: RulesSettings, knots: int, origin: Morphology | None, start: int, rng: np.random.Generator
) -> Array:
    """Draw the initial knots (F, N + 2, 2) of a start; its paths pass keep-outs.

    Without an origin, gentle starts begin with random zigzags and strict ones with straight fibres. With an origin, all
    begin with its paths. Knots of straight fibres, and of the origin except in start 0, are moved by a tenth of a grid
    unit or so: where slopes are 0 on both sides of a knot, PCHIP has slope 0 and no gradient there.
    """
    if origin is None and not is_strict(start):
        return pass_keep_outs(_zigzag(pad.layout, rules, knots, rng), pad, rules)
    paths = straight_paths(pad, rules, knots) if origin is None else refine(origin.knots, knots, pad.layout)
    if origin is not None and start == 0 and len(origin.knots[0]) > 2:
        return paths
    inner = paths[:, 1:-1] + 0.1 * rng.standard_normal(paths[:, 1:-1].shape)
    return assemble_knots(np.clip(inner, MARGIN, np.array(pad.layout.extent) - MARGIN), pad.layout)


def _zigzag(layout: Layout, rules: RulesSettings, knots: int, rng: np.random.Generator) -> Array:
    """Draw random zigzags, in parallel within each family, so that fibres of a family do not cross.

    PCHIP has slope 0 at a turn. A turn of one knot bends the sharper the steeper its flanks are; one with a knot on
    either shoulder, a little lower than its peak, keeps its radius however steep they are.
    """
    radius = rules.min_mean_bend_radius_mm / layout.unit_mm if rules.enforce else 0.0
    per_turn = KNOTS_PER_TURN if radius > 0 and knots >= 2 * KNOTS_PER_TURN else 1
    extent = min(extent for extent, count in zip(layout.extent, layout.counts, strict=True) if count)
    turns = max(1, min(knots // per_turn, int(extent / (4 * radius)) if radius > 0 else knots))
    fibres = []
    for axis, rows in enumerate(layout.families):
        width, spacing, level = layout.extent[1 - axis], layout.extent[axis] / (turns + 1), layout.levels[rows, None]
        shoulder = float(np.clip(0.8 * radius, 0.1 * spacing, 0.25 * spacing))  # distance from the turn along the fibre
        # what the fibres of a family have in common: where they turn, to which side, and how far
        position = spacing * (np.arange(1, turns + 1) + 0.12 * rng.standard_normal(turns))
        sign = np.where(np.arange(turns) % 2 == 0, 1, -1) * rng.choice([-1, 1])
        swing = 0.6 * sign * rng.uniform(0.5, 1.2, turns)
        aspect = min(1.0, layout.extent[axis] / width)  # fibres shorter than the pad is wide have less room to turn
        centre = width / 2 + (1 - 0.3 * aspect) * (level - width / 2)
        across = np.sort(centre + aspect * swing + 0.1 * rng.standard_normal((len(level), turns)), axis=0)
        along = np.sort(position + 0.02 * rng.standard_normal((len(level), turns)), axis=1)
        path = np.concatenate([level, across, level], axis=1)
        drop = np.clip(0.12 * np.stack([across - path[:, :-2], across - path[:, 2:]]), -0.1, 0.1)
        turn_knots = [(along, across)]
        if per_turn == KNOTS_PER_TURN:
            turn_knots = [(along - shoulder, across - drop[0]), *turn_knots, (along + shoulder, across - drop[1])]
        points = np.array(turn_knots).transpose(2, 3, 0, 1)  # (F, turns, knots of a turn, 2), along and across
        points = points.reshape(len(level), turns * len(turn_knots), 2)
        fibres.append(points if axis == 0 else points[..., ::-1])
    inner = np.clip(np.concatenate(fibres), 0.02, np.array(layout.extent) - 0.02)
    return refine(assemble_knots(inner, layout), knots, layout)


class GradientSearch:
    """One start of the gradient search: Adam with annealed noise and rising penalties, then repair of broken rules.

    A start gives the same fibres whichever other starts run and however it is sliced.
    """

    def __init__(self, problem: SearchProblem, start: int, state: State | None = None) -> None:
        self.problem, self.rng = problem, np.random.default_rng([problem.search.seed, start])
        self._schedule = STRICT if is_strict(start) else GENTLE
        self.step, self.done = 0, False
        self.objective = math.inf  # of the last step, without penalties
        self._history: list[tuple[int, float]] = []
        self._log_sum = 0.0  # sum of log(objective) since the last entry of the history
        self._breaks_rules = np.zeros(problem.pad.layout.fibres, bool)  # by fibre, at the last exact check
        # running means of the errors by contact and number of failed fibres, which begin as those of straight fibres
        self._mean_errors = problem.straight_errors.copy()
        if state is not None:
            self._restore(state)
            return
        pad, rules = problem.pad, problem.rules
        self.scales = [  # full scale of straight fibres under each contact
            criteria.straight_full_scale(pad.layout, contact, pad.sensed_mm) for contact in problem.contacts
        ]
        paths = initial_paths(pad, rules, problem.search.knots, problem.origin, start, self.rng)
        self.fibres = Parametrization.from_knots(paths, pad.layout, border_width(pad, rules))
        self._optimizer = Adam([self.fibres.spans, self.fibres.across])

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
        """Return the current fibres."""
        return Morphology.from_layout(self.fibres.knots(), self.fibres.layout)

    def state(self) -> State:
        """Return everything that the remaining search depends on, as arrays."""
        generator = json.dumps(self.rng.bit_generator.state).encode()
        return {
            "spans": self.fibres.spans.copy(),
            "across": self.fibres.across.copy(),
            "fixed": np.array([self.fibres.floor, self.fibres.border]),
            "scales": np.array(self.scales),
            "means": self._mean_errors.copy(),
            "progress": np.array([self.step, self.objective, self._log_sum]),
            "done": np.array(self.done),
            "history": np.array(self._history).reshape(-1, 2),
            "generator": np.frombuffer(generator, np.uint8).copy(),
            "adam_steps": np.array(self._optimizer.steps),
            "adam_spans": self._optimizer.moments[0].copy(),
            "adam_across": self._optimizer.moments[1].copy(),
            "broken": self._breaks_rules.copy(),
        }

    def _restore(self, state: State) -> None:
        variables = [state["spans"].copy(), state["across"].copy()]
        self.scales, self._mean_errors = state["scales"].tolist(), state["means"].copy()
        self.fibres = Parametrization(self.problem.pad.layout, *variables, *state["fixed"].tolist())
        step, self.objective, self._log_sum = state["progress"].tolist()
        self.step, self.done = int(step), bool(state["done"])
        self._history = [(int(step), objective) for step, objective in state["history"].tolist()]
        self.rng.bit_generator.state = json.loads(state["generator"].tobytes())
        moments = [state["adam_spans"].copy(), state["adam_across"].copy()]
        is_fine = 0 <= self.step - self.problem.steps < FINE_STEPS
        self._optimizer = (SignedRootDescent if is_fine else Adam)(variables, int(state["adam_steps"]), moments)
        self._breaks_rules = state["broken"].copy()

    def _descend(self) -> None:
        """Take one step on the sum of objective and penalties."""
        initial_rate, decay_power, (first_weight, last_weight) = self._schedule
        progress = self.step / max(1, self.problem.steps - 1)
        rate = initial_rate * (0.02 + 0.98 * math.cos(math.pi / 2 * progress) ** decay_power)
        curves = self._curves()
        self.objective, grad_curves = self._objective(curves, noise_factor=2.0 ** (1 - progress))
        gradient = curves.by_knots(grad_curves)
        if (rules := self.problem.rules).enforce:
            if progress < COMMON_TRACKS_FROM:
                rules = rules.model_copy(update={"max_common_track_mm": None})
            weight = first_weight * (last_weight / first_weight) ** progress
            gradient = gradient + weight * self._penalty_gradient(curves, rules, RULE_MARGIN, all_bends=False)
        self._optimizer.step(self.fibres.gradients(*gradient), rate)
        self.step += 1
        self._log_sum += math.log(self.objective)
        if self.step % HISTORY_STEPS == 0 or self.step == self.problem.steps:
            n_averaged = (self.step - 1) % HISTORY_STEPS + 1
            self._history.append((self.step, math.exp(self._log_sum / n_averaged)))
            self._log_sum = 0.0
        if self.step == self.problem.steps:
            self._begin_repair()

    def _begin_repair(self) -> None:
        """End the search, and check whether there is anything to repair."""
        self.step = self.problem.steps
        self._optimizer = SignedRootDescent([self.fibres.spans, self.fibres.across])
        self.done = self._check_rules()

    def _check_rules(self) -> bool:
        """Check the rules exactly, note which fibres break them, and return whether all are kept."""
        violations = self.problem.violations(self.morphology())
        self._breaks_rules[:] = False
        for violation in violations:  # one without fibres concerns all of them
            self._breaks_rules[[fibre - 1 for fibre in violation.fibres] or slice(None)] = True
        return not violations

    def _repair(self) -> None:
        """Take one step on the penalties alone, with a margin and a learning rate that grow at each failed check.

        The first FINE_STEPS move only fibres that break rules. If these do not suffice, Adam moves all fibres, and all
        knots by nearly the same step: that resolves more, but costs accuracy.
        """
        n_steps = self.step - self.problem.steps
        is_fine = n_steps < FINE_STEPS
        n_failed_checks = (n_steps if is_fine else n_steps - FINE_STEPS) // REPAIR_CHECKS
        rate = 0.003 * 1.1**n_failed_checks if is_fine else 0.002 * 1.15**n_failed_checks
        margin = RULE_MARGIN + 0.01 * n_failed_checks
        gradient = self._penalty_gradient(self._curves(), self.problem.rules, margin)
        if is_fine:
            gradient = gradient * self._breaks_rules[:, None]
        elif n_steps == FINE_STEPS:
            self._optimizer = Adam(self._optimizer.variables)
        self._optimizer.step(self.fibres.gradients(*gradient), min(rate, 0.01))
        self.step += 1
        if (n_steps + 1) % REPAIR_CHECKS == 0:
            self.done = n_steps + 1 >= REPAIR_STEPS or self._check_rules()

    def _curves(self) -> FibreCurves:
        return FibreCurves(*self.fibres.axes(), self.problem.pad.layout)

    def _penalty_gradient(
        self, curves: FibreCurves, rules: RulesSettings, margin: float, all_bends: bool = True
    ) -> Array:
        """Return the gradient (2, F, n) of the sum of all penalties by the knots."""
        result = penalties(curves.along, curves.across, self.problem.pad, rules, margin, all_bends)
        return np.stack([result.grad_along, result.grad_across])

    def _objective(self, curves: FibreCurves, noise_factor: float) -> tuple[float, Array]:
        """Return the sum of the relative error and the weighted sharpness, and its gradient (3, F, n) by the curves.

        The relative error R depends on the errors e_ck under each contact c with k failed fibres. A step computes them
        on random presses and failures, under one contact alone; running means of earlier steps stand in for the others.
        The contact is drawn with the probability

            p_c = sum over k of (dR / de_ck) e_ck / R,

        its share of R (the shares add up to 1, since R is homogeneous of degree 1). The part of the gradient that comes
        from its errors is divided by p_c, so that on average over the draws it is the gradient by all contacts.
        """
        search, pad, shares = self.problem.search, self.problem.pad, failure_shares(self.problem.search.max_failures)
        straight_errors = self.problem.straight_errors
        # 1. a random window, all of the pad unless it is large, outside keep-outs; random failures
        while True:
            window = criteria.place_window(pad.sensed, self.rng.random(2))
            presses = criteria.window_presses(pad, window, criteria.SEARCH_SIDE, self.rng)
            if presses.free.any():
                break
        masks = sample_failures(pad.layout.fibres, shares, self.rng)
        n_failed = (masks == 0).sum(axis=1)  # one set of each number
        # 2. a random contact
        relative_error, grad_means = criteria.relative_error(self._mean_errors, straight_errors, shares)
        probabilities = (grad_means * self._mean_errors).sum(axis=1) / relative_error
        drawn = int(self.rng.choice(len(probabilities), p=probabilities))
        contact, scale = self.problem.contacts[drawn], self.scales[drawn]
        scatter = criteria.scatter_of_full_scale(search.response_scatter.scaled(noise_factor), contact, scale)
        # 3. the errors under it, by number of failed fibres, and their running means
        errors, differentiate = self._errors(curves, presses, masks, contact, scale, scatter)
        self._mean_errors[drawn, n_failed] += MEAN_ERROR_RATE * (errors - self._mean_errors[drawn, n_failed])
        # 4. the relative error with these means, and its gradient by the errors, then by the curves
        total, grad_means = criteria.relative_error(self._mean_errors, straight_errors, shares)
        gradient = differentiate(grad_means[drawn, n_failed]) / probabilities[drawn]
        # 5. the sharpness
        if (weight := search.sharpness) > 0:
            loss, grad_curves = sharpness_loss(curves, self.problem.contacts[0], pad)
            total, gradient = total + weight * loss, gradient + weight * grad_curves
        return total, gradient

    def _errors(
        self,
        curves: FibreCurves,
        presses: criteria.PressWindow,
        masks: Array,
        contact: Contact,
        scale: float,
        scatter: Scatter,
    ) -> tuple[Array, Differentiate]:
        """Return the criterion (L,) under a contact, and its derivative: from gradients (L,) by it to (3, F, n).

        The response of a fibre is its relative stretch in full scales, signal / (scale * length).
        """
        length, grad_length = curves.lengths()
        weights = criteria.kernel_weights(self.problem.pad.layout)
        per_signal, positions = 1 / (scale * length[:, None]), presses.positions
        if len(presses.far):
            near, far = (
                weights[:, None] * per_signal * curves.signals(x, contact)[0] for x in (presses.positions, presses.far)
            )
            positions = presses.with_partners(criteria.confusable(near, far, masks))
        signals, differentiate_signals = curves.signals(positions, contact)
        responses = per_signal * signals
        errors, error_gradients = criteria.criterion(
            responses, positions, presses.step, presses.free, masks, scatter, weights
        )

        def differentiate(grad_errors: Array) -> Array:
            grad_responses = np.tensordot(grad_errors, error_gradients, axes=1)
            by_signals = differentiate_signals(grad_responses * per_signal)
            # d response / d length = -response / length
            by_lengths = -(grad_responses * responses).sum(axis=1) / length
            return by_signals + by_lengths[:, None] * grad_length

        return errors, differentiate
