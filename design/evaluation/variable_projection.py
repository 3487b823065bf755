"""Levenberg-Marquardt for a batch of equal networks, each with its own samples, damping and end.

The outputs are linear in the neurons, so for any hidden weights the best output weights are known, and the steps are
taken in the hidden weights alone (variable projection: Golub & Pereyra 1973, The differentiation of pseudo-inverses and
nonlinear least squares problems whose variables separate; Kaufman 1975, A variable projection method for solving
separable nonlinear least squares problems). That takes half the steps, and each is cheaper. Damping follows the ratio
of the gain to the one foreseen (Nielsen 1999, Damping parameter in Marquardt's method).

Shapes: S networks, Q samples, D inputs, H neurons, O outputs, A targets that are equally right, P = (D+1) H hidden
weights. With J the derivative of the outputs by the hidden weights, R the projection off what output weights can make
up for, and e the error, a step solves (J'R J + damping) d = J'e. Where there are fewer residuals than weights, Q O < P,
it solves the dual (R J J'R + damping) z = -y for the targets y and takes d = J'R z, which is the same step but for the
ridge. These large products are made in single precision, which tells where to step; how far off a network is, is
computed in double.
"""

from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

FAILURES = 3
"""Steps in a row without a new best on validation that end the training."""
RIDGE = 1e-5
"""Penalty of squared output weights per sample: keeps them finite where neurons are alike."""
FIRST_DAMPING = 3.0
"""In units of the mean curvature: high, since small first steps lead to smoother networks."""
EASE = 0.2
"""Least factor by which a step that was taken lowers the damping."""
LEAST_DAMPING, MOST_DAMPING = 1e-15, 1e10
LEAST_SLOPE = 1e-7
BLOCK = 64
"""Columns of a symmetric product made at once."""

Examples = tuple[Tensor, Tensor]


def train_batch(hidden: Tensor, learn: Examples, validate: Examples, epochs: int) -> tuple[Tensor, Tensor, Tensor]:
    """Train every network until validation has not gained for FAILURES steps, or no step makes it better.

    Args:
        hidden: (S, D+1, H) first hidden weights.
        learn, validate: scaled inputs (S, Q, D) and targets (S, A, Q, O).
        epochs: at most so many steps of a network.

    Returns:
        Hidden (S, D+1, H) and output weights (S, H+1, O) that did best on `validate`, and (S,) steps taken.
    """
    live = _Batch.begun(hidden, learn, validate)
    best = live.fit.hidden.clone(), live.fit.output.clone()
    steps = torch.zeros_like(live.number)
    while epochs > 0 and len(live.number):
        better, ended = live.step()
        for kept, own in zip(best, (live.fit.hidden, live.fit.output), strict=True):
            kept[live.number[better]] = own[better]
        steps[live.number] = live.steps
        ended |= live.steps == epochs
        if ended.any():
            live = live.rows(~ended)
    return best[0], best[1], steps


@dataclass
class _Rows:
    """Tensors that have a row for each network."""

    def rows(self, chosen: Tensor) -> Self:
        """Those of some networks."""
        parts = (getattr(self, field.name) for field in fields(self))
        return type(self)(*(part.rows(chosen) if isinstance(part, _Rows) else part[chosen] for part in parts))

    def take(self, other: Self, chosen: Tensor) -> None:
        """Rows `chosen` (S,) of `other` in place of the own ones."""
        every = bool(chosen.all())
        for field in fields(self):
            own, new = getattr(self, field.name), getattr(other, field.name)
            rows = chosen.view(-1, *[1] * (own.dim() - 1))
            setattr(self, field.name, new if every else torch.where(rows, new, own))


@dataclass
class Fit(_Rows):
    """Networks with the output weights that are best for their hidden ones.

    Attributes:
        hidden: (S, D+1, H). targets: (S, Q, O), of those that are equally right the ones nearest to what was found.
        neurons: (S, Q, H+1), the last column 1.
        root: (S, H+1, H+1) by which the neurons become Z = neurons root', with R = 1 - Z Z'.
        output: (S, H+1, O). error: (S, Q, O). squares: (S,) of the error, and the ridge's penalty.
    """

    hidden: Tensor
    targets: Tensor
    neurons: Tensor
    root: Tensor
    output: Tensor
    error: Tensor
    squares: Tensor

    @classmethod
    def of(cls, hidden: Tensor, x: Tensor, targets: Tensor) -> Self:
        """Solve for the output weights, for inputs (S, Q, D+1) with a last column of 1 and targets (S, Q, O)."""
        neurons = neurons_of(hidden, x)
        ridge = RIDGE * x.shape[1]
        gram = neurons.mT @ neurons
        gram.diagonal(dim1=1, dim2=2).add_(ridge)
        factor = torch.linalg.cholesky_ex(gram).L
        root = torch.linalg.solve_triangular(factor, torch.eye(gram.shape[1]).to(gram), upper=False)
        output = root.mT @ (root @ (neurons.mT @ targets))
        error = torch.baddbmm(targets, neurons, output, beta=-1)
        return cls(hidden, targets, neurons, root, output, error, squares(error) + ridge * squares(output))

    def basis(self, like: Tensor) -> Tensor:
        """Z (S, Q, H+1) in the precision of `like`."""
        return self.neurons.to(like) @ self.root.mT.to(like)


@dataclass
class _Batch(_Rows):
    """The networks still in training.

    Attributes:
        number: (L,) which of all networks they are. steps: (L,) each has taken. fit: where they are.
        x, right: (L, Q, D+1) and (L, A, Q, O) to learn from. check_x, check_right: the like for validation.
        least: (L,) least squares on validation so far, and failures: (L,) steps since.
        damping, growth: (L,) damping, and by what it grows if the next step fails.
    """

    number: Tensor
    steps: Tensor
    fit: Fit
    x: Tensor
    right: Tensor
    check_x: Tensor
    check_right: Tensor
    least: Tensor
    failures: Tensor
    damping: Tensor
    growth: Tensor

    @classmethod
    def begun(cls, hidden: Tensor, learn: Examples, validate: Examples) -> Self:
        """Before the first step."""
        (x, right), (check_x, check_right) = ((with_ones(inputs), targets) for inputs, targets in (learn, validate))
        fit = reassigned(Fit.of(hidden, x, right[:, 0]), x, right)
        least = squares(nearest(neurons_of(hidden, check_x) @ fit.output, check_right)[1])
        number = torch.arange(len(hidden), device=hidden.device)
        none = torch.zeros_like(number)
        unset, two = torch.full_like(least, torch.nan), torch.full_like(least, 2.0)
        return cls(number, none, fit, x, right, check_x, check_right, least, none, unset, two)

    def step(self) -> tuple[Tensor, Tensor]:
        """Try a step of every network; where none is taken, the next one is damped more.

        Returns:
            (L,) whether it is the best on validation so far, and whether it was the last one to try.
        """
        slope = pull_back(self.x, self.fit, self.fit.error)
        change = self._change(slope)
        candidate = Fit.of(self.fit.hidden - change.view_as(self.fit.hidden), self.x, self.fit.targets)
        foreseen = (change * (self.damping[:, None] * change + slope)).sum(dim=1)
        ratio = (self.fit.squares - candidate.squares) / foreseen
        gained = (ratio > 0) & candidate.squares.isfinite()
        self.fit.take(reassigned(candidate, self.x, self.right), gained)
        eased = (1 - (2 * ratio - 1) ** 3).clamp(min=EASE)
        self.damping = (self.damping * torch.where(gained, eased, self.growth)).clamp(min=LEAST_DAMPING)
        self.growth = torch.where(gained, 2.0, 2 * self.growth)
        self.steps = self.steps + gained
        found = neurons_of(self.fit.hidden, self.check_x) @ self.fit.output
        checked = squares(nearest(found, self.check_right)[1])
        better = gained & (checked < self.least)
        self.least = torch.where(better, checked, self.least)
        self.failures = torch.where(better, 0, self.failures + gained)
        going = (slope.norm(dim=1) >= LEAST_SLOPE) & (self.damping <= MOST_DAMPING) & (self.failures < FAILURES)
        return better, ~going

    def _change(self, slope: Tensor) -> Tensor:
        """(L, P) by which hidden weights are to be lowered; NaN where a damped matrix is singular to rounding."""
        dual = self.fit.error[0].numel() < slope.shape[1]
        matrix = (dual_curvature if dual else curvature)(self.x.float(), self.fit)
        right = (-self.fit.targets.flatten(1) if dual else slope).float()
        diagonal = matrix.diagonal(dim1=1, dim2=2)
        if self.damping.isnan().any():
            self.damping = FIRST_DAMPING * diagonal.double().sum(dim=1) / slope.shape[1]
        diagonal += self.damping[:, None]
        factor, failed = torch.linalg.cholesky_ex(matrix)
        change = torch.cholesky_solve(right[:, :, None], factor)[:, :, 0].double()
        change[failed != 0] = torch.nan
        if not dual:
            return change
        residual, basis = change.view_as(self.fit.error), self.fit.basis(slope)
        return pull_back(self.x, self.fit, residual - basis @ (basis.mT @ residual))


def with_ones(x: Tensor) -> Tensor:
    """(S, Q, D) with a last column of 1, for the biases."""
    return torch.cat([x, torch.ones_like(x[:, :, :1])], dim=2)


def neurons_of(hidden: Tensor, x: Tensor) -> Tensor:
    """(S, Q, H+1) what the neurons give for x (S, Q, D+1), and 1."""
    return with_ones(torch.tanh(x @ hidden))


def nearest(found: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Of the targets (S, A, Q, O) those nearest to what was found (S, Q, O), and how far off it is."""
    errors = found[:, None] - right
    if right.shape[1] == 1:
        return right[:, 0], errors[:, 0]
    chosen = errors.square().sum(dim=3, keepdim=True).argmin(dim=1, keepdim=True)
    return right.take_along_dim(chosen, dim=1)[:, 0], errors.take_along_dim(chosen, dim=1)[:, 0]


def reassigned(fit: Fit, x: Tensor, right: Tensor) -> Fit:
    """The fit to those of the targets (S, A, Q, O) that are nearest to what `fit` finds: never a worse one."""
    if right.shape[1] == 1:
        return fit
    return Fit.of(fit.hidden, x, nearest(fit.neurons @ fit.output, right)[0])


def curvature(x: Tensor, fit: Fit) -> Tensor:
    """J'R J (S, P, P), its lower triangle only, in the precision of x (S, Q, D+1).

    Output k responds to the weight of neuron i on input a by V_ki (1 - h_i^2) x_a: all but V_ki is common to the
    outputs, so that one symmetric product serves all of them.
    """
    networks, samples, inputs = x.shape
    bend = bends(fit).to(x)
    parts = (x[..., None] * bend[:, :, None, :]).view(networks, samples, -1)
    size = parts.shape[2]
    matrix = x.new_empty(networks, size, size)
    # Block by block, which spares almost half of the full product; what lies above the blocks is never read.
    for begin in range(0, size, BLOCK):
        end = begin + BLOCK
        matrix[:, begin:, begin:end] = parts[:, :, begin:].mT @ parts[:, :, begin:end]
    made_up = fit.basis(x).mT @ parts
    matrix.baddbmm_(made_up.mT, made_up, alpha=-1)
    weights = fit.output[:, :-1].to(x)
    shared = weights @ weights.mT
    by_neuron = matrix.view(networks, inputs, len(shared[0]), inputs, len(shared[0]))
    by_neuron *= shared[:, None, :, None, :]
    return matrix


def dual_curvature(x: Tensor, fit: Fit) -> Tensor:
    """R J J'R (S, Q O, Q O), in the precision of x (S, Q, D+1).

    Entry ((q, k), (r, l)) of J J' is (x_q . x_r) sum_i V_ki V_li b_qi b_ri with b = 1 - h^2.
    """
    networks, samples, many = fit.error.shape
    bend, basis = bends(fit).to(x), fit.basis(x)
    alike = x @ x.mT
    matrix = x.new_empty(networks, samples, many, samples, many)
    pulls = [bend * fit.output[:, None, :-1, k].to(x) for k in range(many)]
    for k in range(many):
        for other in range(k + 1):
            block = (pulls[k] @ pulls[other].mT).mul_(alike)
            block.baddbmm_(basis, basis.mT @ block, alpha=-1)
            block.baddbmm_(block @ basis, basis.mT, alpha=-1)
            matrix[:, :, k, :, other] = block
            if other < k:
                matrix[:, :, other, :, k] = block.mT
    return matrix.view(networks, samples * many, samples * many)


def pull_back(x: Tensor, fit: Fit, error: Tensor) -> Tensor:
    """J'e (S, P) for errors (S, Q, O)."""
    return (x.mT @ ((error @ fit.output[:, :-1].mT) * bends(fit))).flatten(1)


def bends(fit: Fit) -> Tensor:
    """(S, Q, H) slopes of the neurons, 1 - h^2."""
    return 1 - fit.neurons[:, :, :-1].square()


def squares(values: Tensor) -> Tensor:
    """(S,) sums of squares of (S, ...)."""
    return values.square().sum(dim=(1, 2))
