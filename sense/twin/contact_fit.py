"""Fit of a contact to the responses of a pad: width of the press, and in which shares fibres feel squeeze and stretch.

    volts_c(p) = rest_c + gain_c ((1 - share) squeeze_c(T(p)) + share stretch_c(T(p)))

with signals of the strains of a layer, each family of fibres at its depth, all distances multiplied by `scale`. These
two numbers and the plan transform T are fitted by nonlinear least squares; gains and rests follow at each step from
linear ones (variable projection; G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10, 1973). The stated contact is the
prior mean.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from padforge.design.contact import contact_law
from padforge.design.kernels.element_signals import sum_elements
from padforge.design.settings import Contact
from padforge.design.twin import PlanTransform
from padforge.sense.arrays import Array, masked_mean
from padforge.sense.twin.as_built import AsBuiltPad
from padforge.sense.twin.fitting import TRANSFORM_STD
from padforge.sense.twin.responses import Responses

PRIOR_STD = np.append(TRANSFORM_STD, [0.3, 0.5])
"""Prior standard deviations: those of the transform, of log `scale` (from the stated one) and of the share."""
STEPS = np.array([0.01, 0.3, 0.3, 0.01, 0.02, 0.02])
"""Steps of the finite differences: shorter ones give noise, as elements are long for the edge of the strains."""
BOUNDS = (math.log(0.1), 0.0), (math.log(10.0), 1.0)  # least and largest log `scale` and share, as in `[contact]`
TOLERANCE = 1e-4  # relative change of the objective at which a fit has converged
MAX_EVALUATIONS = 20


@dataclass(frozen=True)
class ContactFit:
    """A contact fitted to presses; `scale`, `squeeze` and `stretch` as in `[contact]`."""

    scale: float
    squeeze: float  # squeeze + stretch is that of the stated contact, since gains take up any other
    stretch: float
    scale_std: float
    shares_std: float  # standard deviation of squeeze, and of stretch
    explained: float  # share of the variance of held-out responses, mean over channels


def fit_contact(
    pad: AsBuiltPad, contact: Contact, training: Responses, held_out: Responses, noise_v: Array
) -> ContactFit:
    """Fit a contact to a pad whose fibres stay where they are, and whose profiles and gains do not count.

    The transform is fitted too. Of a contact that is no layer but a profile, `scale` is fitted and no shares. `noise_v`
    (C,) is the standard deviation of the residuals, inflated where neighbouring ones are correlated; `explained` is
    measured on the held-out responses.
    """
    total, signals = contact.squeeze + contact.stretch, _Signals(pad, contact)
    start = np.array([*pad.values[:4], math.log(contact.scale), contact.stretch / total])
    mean, quarter = start.copy(), math.pi / 2
    mean[:4] = round(start[0] / quarter) * quarter, 0.0, 0.0, 1.0
    free = slice(6 if contact.model == "layer" else 5)

    def complete(x: Array) -> Array:
        return np.append(x, start[len(x) :])

    def residuals(x: Array) -> Array:
        predictors = signals(complete(x), training.positions_mm)
        gains, rests_v = _fit_gains(predictors, training)
        misfit = np.where(training.valid, (training.volts - rests_v - gains * predictors) / noise_v, 0.0)
        return np.append(misfit, ((complete(x) - mean) / PRIOR_STD)[free])

    def jacobian(x: Array) -> Array:
        steps = np.diag(STEPS[free])
        return np.column_stack([(residuals(x + step) - residuals(x - step)) / (2 * step.max()) for step in steps])

    low, high = (np.array([*[sign * np.inf] * 4, *ends])[free] for sign, ends in zip((-1, 1), BOUNDS, strict=True))
    fit = least_squares(
        residuals,
        np.clip(start[free], low + 1e-6, high - 1e-6),
        jacobian,  # pyright: ignore[reportArgumentType]
        (low, high),
        x_scale=PRIOR_STD[free],
        ftol=TOLERANCE,
        max_nfev=MAX_EVALUATIONS,
    )
    values = complete(fit.x)
    std = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    gains, rests_v = _fit_gains(signals(values, training.positions_mm), training)
    predicted = rests_v + gains * signals(values, held_out.positions_mm)
    scale, share = math.exp(values[4]), float(values[5])
    return ContactFit(
        scale=scale,
        squeeze=total * (1 - share),
        stretch=total * share,
        scale_std=float(scale * std[4]),
        shares_std=float(total * std[5:].sum()),  # 0 of a profile
        explained=float(held_out.explained_variance(predicted).mean()),
    )


class _Signals:
    """Signals (Q, C) of presses by transform, log `scale` and share of stretch, grid units."""

    def __init__(self, pad: AsBuiltPad, contact: Contact) -> None:
        layout, parts = pad.plan.layout, [contact]
        if contact.model == "layer":
            shares = [{"squeeze": 1.0, "stretch": 0.0}, {"squeeze": 0.0, "stretch": 1.0}]
            parts = [contact.model_copy(update={"scale": 1.0, **share}) for share in shares]
        self._pad, self._laws = pad, [contact_law(part, layout.unit_mm) for part in parts]
        self._channels = [(pad.elements(channel), layout.family(fibre)) for channel, fibre in enumerate(pad.fibres)]

    def __call__(self, values: Array, positions_mm: Array) -> Array:
        turn, *shift, plan_scale, log_scale, share = values.tolist()
        transform = PlanTransform(self._pad.mirrored, math.degrees(turn), (shift[0], shift[1]), plan_scale)
        # a wider press is the same as a smaller pad
        width = math.exp(log_scale)
        presses = np.ascontiguousarray(self._pad.plan.to_grid(transform.to_plan(positions_mm)) / width)
        signals = np.zeros((len(presses), len(self._channels)))
        for c, ((points, lengths, tangents), family) in enumerate(self._channels):
            for law, weight in zip(self._laws, (1 - share, share) if len(self._laws) > 1 else (1.0,), strict=True):
                signals[:, c] += weight * sum_elements(points / width, lengths, tangents, presses, law, family)
        return signals


def _fit_gains(signals: Array, responses: Responses) -> tuple[Array, Array]:
    """Fit gains (C,), V per grid unit, and rests (C,), V, to signals (Q, C) by least squares."""
    valid = responses.valid
    mean, mean_v = (masked_mean(values, valid) for values in (signals, responses.volts))
    centred = np.where(valid, signals - mean, 0.0)
    gains = (centred * np.where(valid, responses.volts - mean_v, 0.0)).sum(axis=0)
    gains /= np.maximum((centred**2).sum(axis=0), 1e-300)
    return gains, mean_v - gains * mean
