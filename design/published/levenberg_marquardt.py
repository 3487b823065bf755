"""Batched Levenberg-Marquardt with variable projection: networks of one hidden layer trained side by side.

For given hidden weights the best output weights solve a ridge regression, so only the hidden weights are searched for.
With activations H, Z Z' = H (H'H + ridge)^-1 H', the residual projector R = 1 - Z Z' and Kaufman's Jacobian J, a step
solves (J'R J + damping) change = J'e, or the dual equations. `docs/method.md` names the sources.

Shapes: S networks, Q samples, D inputs, H hidden neurons, O outputs, A alternative targets, P = (D + 1) H weights.
"""

from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

MAX_STALLED_STEPS = 3  # steps in a row without a new best on validation that end the training
RIDGE = 1e-5  # penalty of squared output weights per sample: keeps them finite if neurons respond equally
INITIAL_DAMPING = 3.0  # in units of the mean curvature: high, since small first steps lead to smoother networks
MIN_DAMPING_FACTOR = 0.2  # least factor by which an accepted step lowers the damping
MIN_DAMPING, MAX_DAMPING = 1e-15, 1e10  # limits of the damping; training of a network ends above the second
MIN_GRADIENT = 1e-7  # norm of the gradient below which training ends
BLOCK = 64  # columns of a symmetric product computed at once

Samples = tuple[Tensor, Tensor]  # scaled inputs (S, Q, D) and targets (S, A, Q, O)


def train_batch(
    hidden: Tensor, training: Samples, validation: Samples, max_steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Train every network from its hidden weights until its validation loss stalls or no step lowers its loss.

    Returns:
        Hidden weights (S, D + 1, H) and output weights (S, H + 1, O) of the least validation loss, and the numbers of
        accepted steps (S,).
    """
    batch = _Batch.start(hidden, training, validation)
    best = batch.fit.hidden.clone(), batch.fit.output.clone()
    steps = torch.zeros_like(batch.index)
    while max_steps > 0 and len(batch.index):
        improved, finished = batch.step()
        for stored, current in zip(best, (batch.fit.hidden, batch.fit.output), strict=True):
            stored[batch.index[improved]] = current[improved]
        steps[batch.index] = batch.steps
        finished |= batch.steps == max_steps
        if finished.any():
            batch = batch.rows(~finished)
    return best[0], best[1], steps


@dataclass
class _Rows:
    """Tensors that have a row for each network."""

    def rows(self, index: Tensor) -> Self:
        """Return the rows of the networks at `index`."""
        parts = (getattr(self, field.name) for field in fields(self))
        return type(self)(*(part.rows(index) if isinstance(part, _Rows) else part[index] for part in parts))

    def replace_rows(self, other: Self, mask: Tensor) -> None:
        """Replace the rows in `mask` (S,) by those of `other`."""
        for field in fields(self):
            current, new = getattr(self, field.name), getattr(other, field.name)
            setattr(self, field.name, torch.where(mask.view(-1, *[1] * (current.dim() - 1)), new, current))


@dataclass
class ProjectedFit(_Rows):
    """Networks with the best output weights for their hidden weights."""

    hidden: Tensor  # hidden weights; shape (S, D + 1, H)
    targets: Tensor  # the alternative targets nearest to the outputs; shape (S, Q, O)
    neurons: Tensor  # activations, the last column 1; shape (S, Q, H + 1)
    root: Tensor  # inverse Cholesky factor of the ridged Gram matrix, Z = neurons root'; shape (S, H + 1, H + 1)
    output: Tensor  # output weights; shape (S, H + 1, O)
    error: Tensor  # residual; shape (S, Q, O)
    loss: Tensor  # squared error with the ridge's penalty; shape (S,)

    @classmethod
    def solve(cls, hidden: Tensor, x: Tensor, targets: Tensor) -> Self:
        """Solve for the output weights by inputs x (S, Q, D + 1), whose last column is 1, and targets (S, Q, O)."""
        neurons = activations(hidden, x)
        ridge = RIDGE * x.shape[1]
        gram = neurons.mT @ neurons
        gram.diagonal(dim1=1, dim2=2).add_(ridge)
        factor = torch.linalg.cholesky_ex(gram).L
        root = torch.linalg.solve_triangular(factor, torch.eye(gram.shape[1]).to(gram), upper=False)
        output = root.mT @ (root @ (neurons.mT @ targets))
        error = torch.baddbmm(targets, neurons, output, beta=-1)
        loss = _sum_squares(error) + ridge * _sum_squares(output)
        return cls(hidden, targets, neurons, root, output, error, loss)

    def reassign(self, x: Tensor, targets: Tensor) -> "ProjectedFit":
        """Return the fit to the nearest to the outputs of targets (S, A, Q, O); its loss is never larger."""
        if targets.shape[1] == 1:
            return self
        return ProjectedFit.solve(self.hidden, x, _nearest_targets(self.neurons @ self.output, targets)[0])

    def validate(self, x: Tensor, targets: Tensor) -> Tensor:
        """Return the squared errors (S,) on other samples x, to the nearest of their targets (S, A, Q, O)."""
        return _sum_squares(_nearest_targets(activations(self.hidden, x) @ self.output, targets)[1])

    def basis(self, like: Tensor) -> Tensor:
        """Return Z (S, Q, H + 1) in the precision of `like`."""
        return self.neurons.to(like) @ self.root.mT.to(like)

    @property
    def slopes(self) -> Tensor:
        """Derivatives of the activations, 1 - h^2; shape (S, Q, H)."""
        return 1 - self.neurons[:, :, :-1].square()


@dataclass
class _Batch(_Rows):
    """The networks still in training."""

    index: Tensor  # their indices among all networks; shape (L,)
    steps: Tensor  # accepted steps of each; shape (L,)
    fit: ProjectedFit  # their weights and residuals
    x: Tensor  # training inputs; shape (L, Q, D + 1)
    targets: Tensor  # training targets; shape (L, A, Q, O)
    validation_x: Tensor
    validation_targets: Tensor
    best_loss: Tensor  # least squared error on validation so far; shape (L,)
    stalled: Tensor  # accepted steps since; shape (L,)
    damping: Tensor  # shape (L,)
    growth: Tensor  # factor on the damping if the next step fails; shape (L,)

    @classmethod
    def start(cls, hidden: Tensor, training: Samples, validation: Samples) -> Self:
        """Return the batch before the first step."""
        (x, targets), (validation_x, validation_targets) = ((append_ones(x), y) for x, y in (training, validation))
        fit = ProjectedFit.solve(hidden, x, targets[:, 0]).reassign(x, targets)
        loss = fit.validate(validation_x, validation_targets)
        index = torch.arange(len(hidden), device=hidden.device)
        zero, unset, two = torch.zeros_like(index), torch.full_like(loss, torch.nan), torch.full_like(loss, 2.0)
        return cls(index, zero, fit, x, targets, validation_x, validation_targets, loss, zero, unset, two)

    def step(self) -> tuple[Tensor, Tensor]:
        """Try a step; return two masks (L,): networks that improved on validation, and networks that are finished."""
        gradient = jacobian_product(self.x, self.fit, self.fit.error)
        change = self._solve(gradient)
        candidate = ProjectedFit.solve(self.fit.hidden - change.view_as(self.fit.hidden), self.x, self.fit.targets)
        predicted = (change * (self.damping[:, None] * change + gradient)).sum(dim=1)
        ratio = (self.fit.loss - candidate.loss) / predicted
        accepted = (ratio > 0) & candidate.loss.isfinite()
        self.fit.replace_rows(candidate.reassign(self.x, self.targets), accepted)
        factor = (1 - (2 * ratio - 1) ** 3).clamp(min=MIN_DAMPING_FACTOR)
        self.damping = (self.damping * torch.where(accepted, factor, self.growth)).clamp(min=MIN_DAMPING)
        self.growth = torch.where(accepted, 2.0, 2 * self.growth)  # consecutive rejections raise the damping faster
        self.steps = self.steps + accepted
        loss = self.fit.validate(self.validation_x, self.validation_targets)
        improved = accepted & (loss < self.best_loss)
        self.best_loss = torch.where(improved, loss, self.best_loss)
        self.stalled = torch.where(improved, 0, self.stalled + accepted)
        unfinished = (gradient.norm(dim=1) >= MIN_GRADIENT) & (self.damping <= MAX_DAMPING)
        return improved, ~(unfinished & (self.stalled < MAX_STALLED_STEPS))

    def _solve(self, gradient: Tensor) -> Tensor:
        """Return the decrease (L, P) of the hidden weights; NaN if the damped matrix is numerically singular."""
        is_dual = self.fit.error[0].numel() < gradient.shape[1]
        # single precision is sufficient, since the loss, in double precision, decides whether a step is accepted
        matrix = (dual_matrix if is_dual else gauss_newton_matrix)(self.x.float(), self.fit)
        right = (-self.fit.targets.flatten(1) if is_dual else gradient).float()
        diagonal = matrix.diagonal(dim1=1, dim2=2)
        if self.damping.isnan().any():
            self.damping = INITIAL_DAMPING * diagonal.double().sum(dim=1) / gradient.shape[1]
        diagonal += self.damping[:, None]
        factor, failed = torch.linalg.cholesky_ex(matrix)
        change = torch.cholesky_solve(right[:, :, None], factor)[:, :, 0].double()
        change[failed != 0] = torch.nan
        if not is_dual:
            return change
        residual, basis = change.view_as(self.fit.error), self.fit.basis(gradient)
        return jacobian_product(self.x, self.fit, residual - basis @ (basis.mT @ residual))


def append_ones(x: Tensor) -> Tensor:
    """Append a column of 1, for the biases, to x (S, Q, D)."""
    return torch.cat([x, torch.ones_like(x[:, :, :1])], dim=2)


def activations(hidden: Tensor, x: Tensor) -> Tensor:
    """Return the activations of the neurons for x (S, Q, D + 1), and a last column of 1; shape (S, Q, H + 1)."""
    return append_ones(torch.tanh(x @ hidden))


def jacobian_product(x: Tensor, fit: ProjectedFit, error: Tensor) -> Tensor:
    """Return J'e (S, P) for errors (S, Q, O)."""
    return (x.mT @ ((error @ fit.output[:, :-1].mT) * fit.slopes)).flatten(1)


def gauss_newton_matrix(x: Tensor, fit: ProjectedFit) -> Tensor:
    """Return J'R J (S, P, P), its lower triangle only, in the precision of x (S, Q, D + 1).

    The derivative of output k by the weight of neuron i on input a is V_ki (1 - h_i^2) x_a. All but V_ki is common to
    the outputs, so one symmetric product serves all of them.
    """
    networks, samples, inputs = x.shape
    slopes = fit.slopes.to(x)
    parts = (x[..., None] * slopes[:, :, None, :]).view(networks, samples, -1)
    size = parts.shape[2]
    matrix = x.new_empty(networks, size, size)
    # block by block, which saves almost half of the full product; entries above the blocks are never read
    for begin in range(0, size, BLOCK):
        end = begin + BLOCK
        matrix[:, begin:, begin:end] = parts[:, :, begin:].mT @ parts[:, :, begin:end]
    projected = fit.basis(x).mT @ parts
    matrix.baddbmm_(projected.mT, projected, alpha=-1)
    weights = fit.output[:, :-1].to(x)
    gram = weights @ weights.mT
    by_neuron = matrix.view(networks, inputs, len(gram[0]), inputs, len(gram[0]))
    by_neuron *= gram[:, None, :, None, :]
    return matrix


def dual_matrix(x: Tensor, fit: ProjectedFit) -> Tensor:
    """Return R J J'R (S, Q O, Q O), in the precision of x (S, Q, D + 1).

    Entry ((q, k), (r, l)) of J J' is (x_q . x_r) sum_i V_ki V_li b_qi b_ri with b = 1 - h^2.
    """
    networks, samples, outputs = fit.error.shape
    slopes, basis = fit.slopes.to(x), fit.basis(x)
    gram = x @ x.mT
    matrix = x.new_empty(networks, samples, outputs, samples, outputs)
    weighted = [slopes * fit.output[:, None, :-1, k].to(x) for k in range(outputs)]
    for k in range(outputs):
        for other in range(k + 1):
            block = (weighted[k] @ weighted[other].mT).mul_(gram)
            block.baddbmm_(basis, basis.mT @ block, alpha=-1)
            block.baddbmm_(block @ basis, basis.mT, alpha=-1)
            matrix[:, :, k, :, other] = block
            if other < k:
                matrix[:, :, other, :, k] = block.mT
    return matrix.view(networks, samples * outputs, samples * outputs)


def _nearest_targets(outputs: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Return the nearest of A targets (S, A, Q, O) to each output (S, Q, O), and the errors; both (S, Q, O)."""
    errors = outputs[:, None] - targets
    if targets.shape[1] == 1:
        return targets[:, 0], errors[:, 0]
    nearest = errors.square().sum(dim=3, keepdim=True).argmin(dim=1, keepdim=True)
    return targets.take_along_dim(nearest, dim=1)[:, 0], errors.take_along_dim(nearest, dim=1)[:, 0]


def _sum_squares(values: Tensor) -> Tensor:
    """Return the sum of squares (S,) over each row of values (S, ., .)."""
    return values.square().sum(dim=(1, 2))
