"""Detection of faulty fibres: press by press (`FaultMonitor`), and in a recording (`FaultDetector`, an estimator)."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.parallel import one_thread, run_tasks
from padforge.common.validation import InputError, check_float, short_repr
from padforge.sense.arrays import Array, Floats, Mask, check_numbers
from padforge.sense.health.domain_shift import rest_levels
from padforge.sense.health.fault_likelihoods import HYPOTHESES, MAX_LLR, cusum_update, estimate_noise
from padforge.sense.health.health_model import (
    COMMANDED,
    DETECTED,
    FALSE_ALARM_RATE,
    MAX_FALSE_ALARM_RATE,
    WARM_UP,
    HealthModel,
    fit_health_model,
)
from padforge.sense.health.trace_model import RELEASED, REST, TraceHistory, bound_presses, extract_trace, predict_fibres
from padforge.sense.localizer.features import MIN_PRESENT
from padforge.sense.localizer.model_files import check_same_pad, files_of
from padforge.sense.recording.frames import framed
from padforge.sense.recording.recording import PRESSES_DETECTED, Recording
from padforge.sense.signals.press_detection import align_to_detected

MAX_MISSING = 20  # successive presses with too few readings, see `MIN_PRESENT`, after which a fibre is missing
WINDOW = 64  # recent presses that are evaluated again to identify a faulty fibre
MAX_SUSPECTS = 4  # maximum number of fibres that are compared to identify it
MAX_SCORE = 99.0  # score of a certain fault

TEXTS = {
    "stuck": "reads one value",
    "open": "has an open circuit: its readings are at an impossible level, or noise alone",
    "no_response": "does not respond to presses",
    "reduced_gain": "responds with about half its gain",
    "inverted": "responds with the opposite sign, as if wired the other way round",
    "inconsistent": "responds as if another position were pressed",
    "swapped": "are swapped",
    "noisy": "is noisy",
    "offset": "has another baseline",
    "drifting": "has a drifting baseline",
    "missing": "gives no readings",
    "misfit": "respond otherwise than in the calibration, which does not fit this recording: is it of this pad, with "
    "its channels in this order? They are not masked",
}
"""Kinds of faults, in words."""
RESPONSE_FAULTS = ("no_response", "reduced_gain", "inverted", "inconsistent", "swapped")
"""Kinds that are detected by the calibration alone; if most fibres have them, the calibration is wrong (misfit)."""


@dataclass(frozen=True)
class FibreFault:
    """A faulty fibre."""

    press: int  # index of the press at which the fault was detected
    since: int  # estimated index of the first bad press
    fibres: tuple[int, ...]  # indices of the fibres; two if they are swapped, most of a misfit
    kind: str  # a key of `TEXTS`
    score: float  # a healthy pad shows any such fault once in 10 ** score presses; at most 99, which is certain

    @property
    def is_masked(self) -> bool:
        """Whether its fibres are masked."""
        return self.kind != "misfit"

    @property
    def text(self) -> str:
        """One line; fibres are numbered from 1."""
        *others, last = (str(fibre + 1) for fibre in self.fibres)
        numbers = f"{', '.join(others)} and {last}" if others else last
        return (
            f"fibre{'s' * (len(self.fibres) > 1)} {numbers} {TEXTS[self.kind]} ({self.kind}) since press {self.since}, "
            f"detected at press {self.press}; false alarm probability 1e-{self.score:.0f} per press"
        )


class _PressRecord(NamedTuple):
    press: int  # index of the press; a live pad may leave out some presses
    trace: Array  # shape (L, TRACE)
    inputs: Floats  # shape (L, N)
    targets: Array  # shape (L, T)
    level: Array  # running mean of the baseline before the press; shape (L,)
    is_warm: Mask  # whether that level is reliable; shape (L,)


class _WiringFault(NamedTuple):
    kind: str  # a key of `TEXTS`
    fibres: tuple[int, ...]  # among the living
    llr: float  # log-likelihood ratio of this wiring against that of the calibration


class FaultMonitor:
    """Detects faulty fibres press by press; they are masked from then on.

    If the responses of most fibres seem faulty, the model does not fit the pad, and these fibres are unmasked.

    Args:
        model: of the healthy pad.
    """

    def __init__(self, model: HealthModel) -> None:
        self.model = model
        self.n_presses = 0  # processed so far
        fibres = len(model.living)
        self._failed = np.zeros(fibres, dtype=bool)
        self._n_missing = np.zeros(fibres, dtype=np.int64)
        self._history = TraceHistory.initial(fibres)
        self._response_faults: list[FibreFault] = []
        self._recent: deque[_PressRecord] = deque(maxlen=WINDOW)
        self._height = np.zeros((fibres, len(HYPOTHESES)))
        self._onset = np.zeros((fibres, len(HYPOTHESES)), dtype=np.int64)

    @property
    def failed(self) -> tuple[int, ...]:
        """Indices of the fibres that are dead, or were found faulty."""
        failed = {*self.model.dead, *self.model.living[self._failed].tolist()}
        return tuple(sorted(failed - self._suspected if self._is_misfit else failed))

    @property
    def _suspected(self) -> set[int]:
        """Indices of the fibres whose responses seem to be at fault."""
        return {fibre for fault in self._response_faults for fibre in fault.fibres}

    @property
    def _is_misfit(self) -> bool:
        """Whether two or more faults suspect over half of all fibres."""
        return len(self._response_faults) > 1 and 2 * len(self._suspected) > self.model.fibres

    def update(self, readings: Array, down_command: int, up_command: int) -> list[FibreFault]:
        """Process the next press.

        Args:
            readings: readings of this press alone, best from 10 before the probe was sent down to 20 after it was sent
                up (fewer only if the next press begins), NaN where missing; shape (R, C), V.
            down_command: index of the first reading after the probe was sent down, >= 1.
            up_command: index of the first reading after it was sent up, > `down_command`, <= R.

        Raises:
            InputError: another number of fibres than the model's.
        """
        if readings.ndim != 2 or readings.shape[1] != self.model.fibres:
            raise InputError(f"readings have shape {readings.shape}, expected (R, {self.model.fibres})")
        trace = extract_trace(readings[:, self.model.living], down_command, up_command, 0, len(readings))
        level, is_warm = self._history.level, self._history.n_presses >= WARM_UP
        inputs, targets = self.model.pca.scale(*self.model.pca.project(trace, self._history))
        self._recent.append(_PressRecord(self.n_presses, trace, inputs, targets, level, is_warm))
        llr_continuing, llr_onset = self._llrs(list(self._recent)[-2:], self._failed)
        self._update_sums(llr_continuing[-1], llr_onset[-1], self.n_presses)
        faults = self._find_missing(trace)
        while (self._neg_log_p(self._failed) > self.model.threshold).any():
            faults += self._report(self._identify())
        self.n_presses += 1
        return faults

    def _report(self, fault: FibreFault) -> list[FibreFault]:
        """Return the fault, with a misfit if it causes one; after a misfit, nothing for a fault of a response."""
        if fault.kind not in RESPONSE_FAULTS:
            return [fault]
        was_misfit = self._is_misfit
        self._response_faults.append(fault)
        if was_misfit:
            return []
        if not self._is_misfit:
            return [fault]
        since = min(each.since for each in self._response_faults)
        score = min(each.score for each in self._response_faults)
        return [fault, FibreFault(self.n_presses, since, tuple(sorted(self._suspected)), "misfit", score)]

    def _find_missing(self, trace: Array) -> list[FibreFault]:
        self._n_missing = np.where(np.isfinite(trace).mean(axis=1) >= MIN_PRESENT, 0, self._n_missing + 1)
        missing = ~self._failed & (self._n_missing == MAX_MISSING)
        self._failed |= missing
        fibres = self.model.living[missing].tolist()
        since = self._recent[-MAX_MISSING].press if fibres else 0
        return [FibreFault(self.n_presses, since, (fibre,), "missing", MAX_SCORE) for fibre in fibres]

    def _neg_log_p(self, failed: Mask) -> Array:
        """Return `ExceedanceModel.neg_log_p` (L, H) of the present sums; minus infinity for failed fibres."""
        neg_log_p = self.model.exceedance.neg_log_p(self._height, int(failed.sum()))
        return np.where(failed[:, None], -np.inf, neg_log_p)

    def _update_sums(self, llr_continuing: Array, llr_onset: Array, press: int) -> None:
        begins = (self._height <= 0) | (llr_onset >= self._height + llr_continuing)
        self._onset = np.where(begins, press, self._onset)
        self._height = cusum_update(self._height, llr_continuing, llr_onset)

    def _predict(self, records: Sequence[_PressRecord], failed: Mask) -> tuple[Array, Array, Array, Array]:
        """Return traces, targets, and means and deviations predicted without failed fibres; shape (Q, L, ...) each."""
        _, traces, inputs, targets, _, is_warm = (np.stack(part) for part in zip(*records, strict=True))
        mean, std = predict_fibres(self.model.weights, inputs, ~failed & np.isfinite(traces).all(axis=2))
        # A rest cannot be compared with its running level before some presses have defined one.
        targets[:, :, -1] = np.where(is_warm, targets[:, :, -1], np.nan)
        return traces, targets, mean, std

    def _llrs(self, records: Sequence[_PressRecord], failed: Mask) -> tuple[Array, Array]:
        return self.model.likelihoods.log_likelihood_ratios(*self._predict(records, failed))

    def _replay(self, first: int, failed: Mask) -> None:
        """Compute the sums again over the recent presses from index `first` on, without the failed fibres."""
        self._height, self._onset = np.zeros_like(self._height), np.zeros_like(self._onset)
        records = self._records_since(first)
        for record, continuing, onset in zip(records, *self._llrs(records, failed), strict=True):
            self._update_sums(continuing, onset, record.press)

    def _records_since(self, first: int) -> list[_PressRecord]:
        return [record for record in self._recent if record.press >= first]

    def _identify(self) -> FibreFault:
        """Identify the faulty fibre, mask it, and recompute the sums without it from the earliest onset on.

        A faulty fibre disturbs the predictions for the others. So every suspect is tested again by the fibres that are
        not suspected; the faulty one still stands out.
        """
        # 1. Of the largest sums, those above half the threshold are suspect; replays begin at their first onset.
        neg_log_p, onset = self._neg_log_p(self._failed), self._onset
        largest, threshold = neg_log_p.max(axis=1), self.model.threshold
        ranked = np.argsort(-largest, kind="stable")[: min(MAX_SUSPECTS, int((~self._failed).sum()))]
        suspects = ranked[largest[ranked] > threshold / 2]
        first = int(onset[suspects, neg_log_p[suspects].argmax(axis=1)].min())
        # 2. A swapped pair or an inverted fibre is the fault if it makes the readings far more likely.
        pairs = [pair for pair in combinations(sorted(ranked.tolist()), 2) if (largest[list(pair)] > threshold).any()]
        wirings = [*self._swapped(pairs, first), *self._inverted(first)]
        wiring = max((each for each in wirings if each.llr > threshold), key=lambda each: each.llr, default=None)
        # 3. Otherwise it is the suspect that stands out most when it is predicted without the other suspects.
        if wiring:
            fibres = wiring.fibres
        else:
            sums = []
            for suspect in suspects:
                failed = self._failed.copy()
                failed[suspects] = True
                failed[suspect] = False
                self._replay(first, failed)
                sums.append(self._neg_log_p(failed)[suspect].max())
            fibres = (int(suspects[np.argmax(sums)]),)
        # 4. Kind, onset and score are those of its hypothesis with the largest sum before the replays.
        fibre = max(fibres, key=lambda each: largest[each])
        hypothesis = int(neg_log_p[fibre].argmax())
        since = int(onset[fibre, hypothesis])
        kind = wiring.kind if wiring else self._classify(fibre, hypothesis, since)
        score = min(float((largest[fibre] - np.log(len(HYPOTHESES))) / np.log(10)), MAX_SCORE)
        # 5. The faulty fibres are masked, and the sums of the others computed without them.
        self._failed[list(fibres)] = True
        self._replay(first, self._failed)
        return FibreFault(self.n_presses, since, tuple(self.model.living[list(fibres)].tolist()), kind, score)

    def _inverted(self, first: int) -> Iterator[_WiringFault]:
        """Yield the evidence that each fibre is inverted: that disturbs predictions for the others, not its own."""
        _, targets, mean, std = self._predict(self._records_since(first), self._failed)
        log_likelihood = self.model.likelihoods.log_likelihood_healthy
        difference = log_likelihood(-targets, mean, std) - log_likelihood(targets, mean, std)
        llrs = np.nan_to_num(np.clip(difference, -MAX_LLR, MAX_LLR)).sum(axis=0)
        for fibre in np.flatnonzero(~self._failed).tolist():
            yield _WiringFault("inverted", (fibre,), float(llrs[fibre]))

    def _swapped(self, pairs: Sequence[tuple[int, int]], first: int) -> Iterator[_WiringFault]:
        """Yield the evidence that each pair is swapped: each fibre responds and rests as predicted for the other."""
        records = self._records_since(first)
        pca, likelihoods = self.model.pca, self.model.likelihoods
        for pair in pairs:
            this, other = list(pair), list(reversed(pair))
            failed = self._failed.copy()
            failed[this] = True
            traces, targets, mean, std = self._predict(records, failed)
            rests = traces[:, :, :REST].mean(axis=2)
            responses = traces[:, other] - rests[:, other, None]
            swapped = targets.copy()
            swapped[:, this, :-1] = np.einsum("qcw,cwd->qcd", responses, pca.components[this])
            swapped[:, this, :-1] /= pca.target_scale_v[this, :-1]
            log_likelihoods = (likelihoods.log_likelihood_healthy(each, mean, std) for each in (swapped, targets))
            difference = np.subtract(*log_likelihoods)
            llr = np.nan_to_num(np.clip(difference, -MAX_LLR, MAX_LLR)).sum()
            # Rests of successive presses correlate: they count once.
            scale_v, level = pca.target_scale_v[this, -1], records[0].level[this]
            as_wired, if_swapped = ((rests[:, source].mean(axis=0) - level) / scale_v for source in (this, other))
            llr += np.nan_to_num(np.clip(as_wired**2 - if_swapped**2, -2 * MAX_LLR, 2 * MAX_LLR)).sum() / 2
            yield _WiringFault("swapped", pair, float(llr))

    def _classify(self, fibre: int, hypothesis: int, since: int) -> str:
        """Return the kind of fault, by the last presses of the fibre."""
        records = self._records_since(since)
        rests = np.array([record.trace[fibre, :REST].mean() for record in records])
        last = self._recent[-1].trace[fibre]
        low, high = self.model.rest_range_v[:, fibre]
        is_outside = not 2 * low - high <= last[:REST].mean() <= 2 * high - low  # by more than the width of the range
        if np.ptp(last) == 0:
            return "open" if is_outside else "stuck"
        if is_outside and estimate_noise(last) > 30 * self.model.likelihoods.noise_v[fibre]:
            return "open"  # no other input picks up so much noise
        name = HYPOTHESES[hypothesis]
        if not name.startswith("offset"):
            return name
        offsets = rests - records[0].level[fibre]
        ramp = np.arange(1.0, len(offsets) + 1)
        ramp *= (ramp @ offsets) / (ramp @ ramp)  # least squares
        return "drifting" if ((offsets - ramp) ** 2).sum() < ((offsets - offsets.mean()) ** 2).sum() else "offset"


class FaultDetector:
    """Detect faulty fibres in recordings of a pad, from the readings alone.

    Args:
        false_alarm_rate: false alarms a press, all fibres and kinds of fault together; 1e-12 to 0.1.
        seed: seed of the training.

    Attributes:
        model_: fitted model, for presses as they were commanded.
        live_model_: the same for presses as they are detected in the readings, which a `FaultMonitor` takes live.

    Raises:
        InputError: an argument out of range.
    """

    def __init__(self, false_alarm_rate: float = FALSE_ALARM_RATE, seed: int = 0) -> None:
        self.false_alarm_rate = check_float("false_alarm_rate", false_alarm_rate, 1e-12, MAX_FALSE_ALARM_RATE)
        self.seed = seed
        self.model_: HealthModel
        self.live_model_: HealthModel

    def fit(
        self, recording: Recording, held_back: ArrayLike = (), provenance: Mapping[str, Any] | None = None
    ) -> "FaultDetector":
        """Train on a recording of the healthy pad; positions of presses are not needed.

        Args:
            recording: of the healthy pad.
            held_back: indices of presses that are left out.
            provenance: origin of the model, JSON.

        Raises:
            InputError: fewer than 300 complete presses, no living fibre, or indices out of range.
        """
        mask = np.ones(len(recording.presses_mm), dtype=bool)
        indices = check_numbers(held_back, np.int64, "held_back")
        if indices.ndim != 1 or not ((indices >= 0) & (indices < len(mask))).all():
            raise InputError(f"held_back is {short_repr(held_back)}, allowed are presses from 0 to {len(mask) - 1}")
        mask[indices] = False
        frames = framed(recording)
        readings, times_s, commanded = frames.readings, frames.times_s, (frames.down_command, frames.up_command)
        presses = {COMMANDED: commanded, DETECTED: align_to_detected(readings, times_s, *commanded)}
        options = {"false_alarm_rate": self.false_alarm_rate, "provenance": dict(provenance or {})}

        def fit_model(name: str) -> HealthModel:
            down_command, up_command = (command[mask] for command in presses[name])
            rng = np.random.default_rng(self.seed)
            return fit_health_model(readings, recording.rate_hz, down_command, up_command, rng=rng, **options)

        with one_thread():
            models = dict(run_tasks((name, partial(fit_model, name)) for name in presses))
        self.model_, self.live_model_ = models[COMMANDED], models[DETECTED]
        return self

    def predict(self, recording: Recording) -> list[FibreFault]:
        """Detect faults in a recording of the same pad; return them in the order of their detection.

        A misfit takes the place of the faults that made it.

        Args:
            recording: of a pad with the fibres of the training, with about as many readings a second or more.

        Raises:
            InputError: another number of fibres, or fewer readings a second, than trained on; or `fit` or `load` was
                not called.
        """
        self._check_fitted()
        is_detected = PRESSES_DETECTED.items() <= recording.source.items()
        monitor = FaultMonitor(self.live_model_ if is_detected else self.model_)
        check_same_pad(monitor.model, "health", recording.fibres, recording.rate_hz)
        frames = framed(recording)
        commands = frames.down_command, frames.up_command
        readings, firsts, ends = bound_presses(frames.readings, *commands)
        faults: list[FibreFault] = []
        for down, up, low, high in zip(*commands, firsts, ends, strict=True):
            first, last = min(max(low, down - REST), down - 1), min(up + RELEASED, high)
            faults += monitor.update(readings[first:last], int(down - first), int(up - first))
        is_fit = all(fault.is_masked for fault in faults)
        return [fault for fault in faults if is_fit or fault.kind not in RESPONSE_FAULTS]

    def include_rests(self, recording: Recording) -> None:
        """Extend the usual range of rests to those of a recording, as after a recalibration.

        Args:
            recording: of the pad as it is now, healthy.

        Raises:
            InputError: another number of fibres than trained on, or `fit` or `load` was not called.
        """
        self._check_fitted()
        rests = rest_levels(recording)
        check_same_pad(self.model_, "health", recording.fibres, recording.rate_hz)
        for name in ("model_", "live_model_"):
            model: HealthModel = getattr(self, name)
            (low, high), new = model.rest_range_v, rests[:, model.living]  # fmin and fmax ignore NaN
            range_v = np.stack([np.fmin(low, np.fmin.reduce(new)), np.fmax(high, np.fmax.reduce(new))])
            setattr(self, name, replace(model, rest_range_v=range_v))

    def save(self, folder: str | Path) -> None:
        """Write both models.

        Args:
            folder: destination; its models are replaced.

        Raises:
            InputError: `fit` or `load` was not called, or the folder cannot be written.
        """
        self._check_fitted()
        self.model_.save(folder, COMMANDED)
        self.live_model_.save(folder, DETECTED)

    @classmethod
    def load(cls, folder: str | Path) -> "FaultDetector":
        """Read what `save` wrote.

        Args:
            folder: that was passed to `save`.

        Raises:
            InputError: as `HealthModel.load`.
        """
        model, live_model = HealthModel.load(folder, COMMANDED), HealthModel.load(folder, DETECTED)
        detector = cls(model.false_alarm_rate)
        detector.model_, detector.live_model_ = model, live_model
        return detector

    def _check_fitted(self) -> None:
        if not hasattr(self, "model_"):
            raise InputError("the fault detector is not fitted, expected fit or load before")


def has_health(folder: Path) -> bool:
    """Return whether the folder of a model has a fault detector."""
    return any(files_of(folder, name).document.exists() for name in (COMMANDED, DETECTED))


HEALTH_FILES = frozenset(file.as_posix() for name in (COMMANDED, DETECTED) for file in files_of(Path(), name))
"""Names of the files of a fault detector."""


def mask_faults(faults: Sequence[FibreFault], presses: int, fibres: int) -> Mask:
    """Return the valid fibres (Q, C) of each of `presses`: faulty ones are masked from the first bad press on."""
    mask = np.ones((presses, fibres), dtype=bool)
    for fault in faults:
        if fault.is_masked:
            mask[fault.since :, list(fault.fibres)] = False
    return mask


def fault_lines(faults: Sequence[FibreFault], fibres: int, dead: Sequence[int] = ()) -> list[str]:
    """Return lines for people: dead fibres, faults, and the sound fibres that remain, numbered from 1."""
    bad = {fibre for fault in faults for fibre in fault.fibres} | set(dead)
    sound = [str(fibre + 1) for fibre in range(fibres) if fibre not in bad]
    lines = [f"fibre {fibre + 1} was dead in the recording that health was learnt from" for fibre in dead]
    return [*lines, *(fault.text for fault in faults), f"sound fibres: {', '.join(sound) or 'none'}"]
