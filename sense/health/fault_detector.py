"""Following the health of a pad press by press, and naming the fibre at fault.

Health in the folder of a model, as `calibrate` leaves it there: what is known of a recording's fibres by it.
"""

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from padforge.design.common.files import resolve_exchange
from padforge.design.common.validation import InputError, check_int, check_type
from padforge.sense.arrays import MAX_VOLTS, Array, Floats, Indices, Mask, check_magnitude, check_numbers
from padforge.sense.formats.columns import PRESSES_DETECTED
from padforge.sense.health.fault_likelihoods import HYPOTHESES, MOST, climb, noise_of
from padforge.sense.health.health_model import COMMANDED, DETECTED, SETTLED, HealthModel, checked_presses
from padforge.sense.health.trace_model import RELEASED, REST, History, expected, press_ranges, press_trace
from padforge.sense.localizer.model_files import files_of
from padforge.sense.recording.recording import Recording

MISSING = 20
"""Presses on end without a reading after which a fibre is missing."""
WINDOW = 64
"""Presses that are gone through again when a fibre is to be named."""
SUSPECTS = 4
"""Most fibres that are weighed against each other then."""
MOST_SCORE = 99.0
"""What is certain."""
FLOATING = 30.0
"""Noise, as a multiple of the usual, that no fibre makes: an open input picks it up."""

TEXTS = {
    "stuck": "reads one value",
    "open": "is open: it reads what its rest never was, or noise alone",
    "silent": "answers no press",
    "weak": "answers by about half",
    "odd": "answers as if another place were pressed",
    "swapped": "have changed places",
    "noisy": "is noisy",
    "offset": "rests at another level",
    "drifting": "rests ever further from its level",
    "missing": "gives no readings",
}
"""The kinds of findings, in words."""


@dataclass(frozen=True)
class FibreFault:
    """A fibre at fault.

    Attributes:
        press: index of the press at which it was named, counted from the first that was seen.
        since: estimate of the first bad press.
        fibres: by index; two if they were swapped.
        kind: a key of `TEXTS`.
        score: a healthy pad looks like this once in 10 ** score presses; at most 99, which is certainty.
    """

    press: int
    since: int
    fibres: tuple[int, ...]
    kind: str
    score: float

    @property
    def text(self) -> str:
        """One line; fibres by number, the first is 1."""
        who = " and ".join(str(fibre + 1) for fibre in self.fibres)
        return (
            f"fibre{'s' * (len(self.fibres) > 1)} {who} {TEXTS[self.kind]} ({self.kind}) since press {self.since}, "
            f"found at press {self.press}; by chance once in 1e{self.score:.0f} presses"
        )


class _Press(NamedTuple):
    """What is kept of a press; `level` (L,) of the rests before it, and where that had settled."""

    traces: Array
    inputs: Floats
    targets: Array
    level: Array
    settled: Mask


class FaultDetector:
    """Follows presses and names fibres; a fibre that was named is left out from then on.

    Attributes:
        presses: seen so far.
    """

    def __init__(self, model: HealthModel) -> None:
        self.model = check_type("model", model, HealthModel)
        self.presses = 0
        fibres = len(model.living)
        self._lost = np.zeros(fibres, dtype=bool)
        self._missing = np.zeros(fibres, dtype=np.int64)
        self._history = History.none(fibres)
        self._recent: deque[_Press] = deque(maxlen=WINDOW)
        self._height = np.zeros((fibres, len(HYPOTHESES)))
        self._start = np.zeros((fibres, len(HYPOTHESES)), dtype=np.int64)

    @property
    def lost(self) -> tuple[int, ...]:
        """Fibres that are not to be relied on, by index: dead from the first, or named since."""
        return tuple(sorted((*self.model.dead, *self.model.living[self._lost].tolist())))

    def update(self, readings: Array, down_command: int, up_command: int) -> list[FibreFault]:
        """Take in the next press.

        Args:
            readings: (R, C) volts, NaN where missing: of this press alone, best from 10 readings before the probe was
                sent down to 20 after it was sent up; fewer after it only where the next press begins.
            down_command, up_command: first of them after the probe was sent down, and up; 1 <= begun < lifted <= R.

        Returns:
            What this press brought to light, mostly nothing.

        Raises:
            InputError: other fibres than health was learnt from, or indices out of range.
        """
        readings = check_numbers(readings, np.float64, "readings", copy=False)
        if readings.ndim != 2 or readings.shape[1] != self.model.fibres:
            raise InputError(f"readings have shape {readings.shape}, expected (R, {self.model.fibres})")
        check_magnitude("readings", readings, MAX_VOLTS, "V", missing=True)
        down_command = check_int("down_command", down_command, 1, len(readings) - 1)
        up_command = check_int("up_command", up_command, down_command + 1, len(readings))
        traces = press_trace(readings[:, self.model.living], down_command, up_command, 0, len(readings))
        level, settled = self._history.level, self._history.seen >= SETTLED
        inputs, targets = self.model.shapes.scaled(*self.model.shapes.advance(traces, self._history))
        self._recent.append(_Press(traces, inputs, targets, level, settled))
        stay, begin = self._ratios(list(self._recent)[-2:], self._lost)
        self._climb(stay[-1], begin[-1], self.presses)
        findings = self._absent(traces)
        while (self._rarity(self._height, self._lost) > self.model.threshold).any():
            findings.append(self._name())
        self.presses += 1
        return findings

    def _absent(self, traces: Array) -> list[FibreFault]:
        self._missing = np.where(np.isfinite(traces).all(axis=1), 0, self._missing + 1)
        gone = ~self._lost & (self._missing == MISSING)
        self._lost |= gone
        since = self.presses - MISSING + 1
        return [FibreFault(self.presses, since, (int(c),), "missing", MOST_SCORE) for c in self.model.living[gone]]

    def _rarity(self, height: Array, lost: Mask) -> Array:
        """(L, H); of lost fibres minus infinity."""
        return np.where(lost[:, None], -np.inf, self.model.tail.rarity(height, int(lost.sum())))

    def _climb(self, stay: Array, begin: Array, press: int) -> None:
        begins = (self._height <= 0) | (begin >= self._height + stay)
        self._start = np.where(begins, press, self._start)
        self._height = climb(self._height, stay, begin)

    def _predicted(self, presses: Sequence[_Press], lost: Mask) -> tuple[Array, Array, Array, Array]:
        """Traces, targets, and the means and spreads predicted without the fibres `lost`, (Q, L, ...) each."""
        traces, inputs, targets, _, settled = (np.stack(part) for part in zip(*presses, strict=True))
        fibre_mask = ~lost & np.isfinite(traces).all(axis=2)
        mean, spread = expected(self.model.weights, inputs, fibre_mask)
        # A rest has no level to be compared with before some presses have made one.
        targets[:, :, -1] = np.where(settled, targets[:, :, -1], np.nan)
        return traces, targets, mean, spread

    def _ratios(self, presses: Sequence[_Press], lost: Mask) -> tuple[Array, Array]:
        return self.model.evidence.ratios(*self._predicted(presses, lost))

    def _replay(self, first: int, lost: Mask) -> None:
        """Climb again through the recent presses from index `first` on, without the fibres `lost`."""
        self._height, self._start = np.zeros_like(self._height), np.zeros_like(self._start)
        stay, begin = self._ratios(self._since(first), lost)
        for index in range(len(stay)):
            self._climb(stay[index], begin[index], first + index)

    def _since(self, first: int) -> list[_Press]:
        """Kept presses from index `first` on."""
        return list(self._recent)[first - self.presses - 1 :]

    def _name(self) -> FibreFault:
        """The fibre at fault, now that one is: it is lost from here on, and the climbs are as if it always had been.

        A bad fibre spoils what is expected of the others. So every suspect is judged anew by the fibres that are
        not suspected; the culprit stands out even then.
        """
        rarity = self._rarity(self._height, self._lost)
        worst = rarity.max(axis=1)
        order = np.argsort(-worst, kind="stable")[: min(SUSPECTS, int((~self._lost).sum()))]
        suspects = order[worst[order] > self.model.threshold / 2]
        starts = self._start[suspects, rarity[suspects].argmax(axis=1)]
        first = max(int(starts.min()), self._kept())
        alarmed = worst > self.model.threshold
        pairs = [pair for pair in combinations(sorted(order.tolist()), 2) if alarmed[list(pair)].any()]
        pair = self._swapped(pairs, first)
        start = self._start
        alone = []
        for fibre in suspects:
            lost = self._lost.copy()
            lost[suspects] = True
            lost[fibre] = False
            self._replay(first, lost)
            alone.append(self._rarity(self._height, lost)[fibre].max())
        fibres = pair or (int(suspects[np.argmax(alone)]),)
        fibre = max(fibres, key=lambda c: worst[c])
        hypothesis = int(rarity[fibre].argmax())
        since = int(start[fibre, hypothesis])
        kind = "swapped" if pair else self._kind(fibre, hypothesis, since)
        score = min(float(worst[fibre] / np.log(10)), MOST_SCORE)
        self._lost[list(fibres)] = True
        self._replay(first, self._lost)
        return FibreFault(self.presses, since, tuple(self.model.living[list(fibres)].tolist()), kind, score)

    def _swapped(self, pairs: Sequence[tuple[int, int]], first: int) -> tuple[int, int] | None:
        """The one of `pairs` whose readings since `first` fit far better if exchanged, if there is one."""
        presses = self._since(first)
        shapes, evidence = self.model.shapes, self.model.evidence
        found, most = None, self.model.threshold
        for pair in pairs:
            own, other = list(pair), list(reversed(pair))
            lost = self._lost.copy()
            lost[own] = True
            traces, targets, mean, spread = self._predicted(presses, lost)
            rests = traces[:, :, :REST].mean(axis=2)
            answers = traces[:, other] - rests[:, other, None]
            exchanged = targets.copy()
            exchanged[:, own, :-1] = np.einsum("qcw,cwd->qcd", answers, shapes.basis[own]) / shapes.targets[own, :-1]
            better = evidence.answer_fit(exchanged, mean, spread) - evidence.answer_fit(targets, mean, spread)
            gain = np.nan_to_num(np.clip(better, -MOST, MOST)).sum()
            # Rests of successive presses hang together: they count once.
            spread_v, level = shapes.targets[own, -1], presses[0].level[own]
            away, back = ((rests[:, source].mean(axis=0) - level) / spread_v for source in (own, other))
            gain += np.nan_to_num(np.clip(away**2 - back**2, -2 * MOST, 2 * MOST)).sum() / 2
            if gain > most:
                found, most = pair, gain
        return found

    def _kind(self, fibre: int, hypothesis: int, since: int) -> str:
        """What is wrong, by the last presses of the fibre named."""
        presses = self._since(max(since, self._kept()))
        rests = np.array([press.traces[fibre, :REST].mean() for press in presses])
        last = self._recent[-1].traces[fibre]
        low, high = self.model.rests[:, fibre]
        outside = not 2 * low - high <= last[:REST].mean() <= 2 * high - low
        if np.ptp(last) == 0:
            return "open" if outside else "stuck"
        if outside and noise_of(last) > FLOATING * self.model.evidence.noise[fibre]:
            return "open"
        name = HYPOTHESES[hypothesis]
        if not name.startswith("offset"):
            return name
        moved = rests - presses[0].level[fibre]
        ramp = np.arange(1.0, len(moved) + 1)
        ramp *= (ramp @ moved) / (ramp @ ramp)
        return "drifting" if ((moved - ramp) ** 2).sum() < ((moved - moved.mean()) ** 2).sum() else "offset"

    def _kept(self) -> int:
        """Index of the oldest press that is kept."""
        return self.presses + 1 - len(self._recent)


def examine(
    model: HealthModel, readings: Array, times_s: Array, down_command: Indices, up_command: Indices
) -> list[FibreFault]:
    """Follow a whole recording.

    Args:
        model: of the same pad. readings: (R, C) volts, NaN where missing. times_s: (R,) s.
        down_command, up_command: (Q,) first reading after the probe was sent down, and up.

    Returns:
        Findings in the order in which they were made. Presses are counted from the recording's first.

    Raises:
        InputError: other fibres or another rate than health was learnt from, or presses out of order.
    """
    readings, times_s, down_command, up_command = checked_presses(readings, times_s, down_command, up_command)
    check_type("model", model, HealthModel).refuse_other(readings, times_s)
    monitor = FaultDetector(model)
    readings, lows, highs = press_ranges(readings, down_command, up_command)
    findings: list[FibreFault] = []
    for down, up, low, high in zip(down_command, up_command, lows, highs, strict=True):
        first, last = min(max(low, down - REST), down - 1), min(up + RELEASED, high)
        findings += monitor.update(readings[first:last], int(down - first), int(up - first))
    return findings


def fibre_mask_of(faults: Sequence[FibreFault], presses: int, fibres: int) -> Mask:
    """Return which fibres of each press no fault has reached.

    Args:
        faults: of a recording; a faulty fibre is left out from the press on since which it is.
        presses: Q of the recording.
        fibres: C of the pad.

    Returns:
        (Q, C), false where a fibre is at fault.

    Raises:
        InputError: a fault of a fibre that the pad does not have.
    """
    mask = np.ones((presses, fibres), dtype=bool)
    for fault in faults:
        if max(fault.fibres, default=0) >= fibres:
            raise InputError(f"findings name fibre {max(fault.fibres) + 1}, allowed are 1 to {fibres}")
        mask[fault.since :, list(fault.fibres)] = False
    return mask


def fault_lines(findings: Sequence[FibreFault], fibres: int, dead: Sequence[int] = ()) -> list[str]:
    """What to tell of a pad of so many fibres, of which `dead` never lived: a line each finding, and what is left.

    Fibres are counted from 1 in the lines, from 0 in `dead` and the findings.
    """
    bad = {fibre for finding in findings for fibre in finding.fibres} | set(dead)
    sound = [str(fibre + 1) for fibre in range(fibres) if fibre not in bad]
    told = [f"fibre {fibre + 1} was dead in the recording that health was learnt from" for fibre in dead]
    return [*told, *(finding.text for finding in findings), f"sound fibres: {', '.join(sound) or 'none'}"]


def has_health(model: Path, name: str = COMMANDED) -> bool:
    """Whether health was learnt into a folder."""
    return resolve_exchange(files_of(model, name).document).exists()


def examined(model: Path, recording: Recording) -> tuple[HealthModel, list[FibreFault]]:
    """What health is told by, presses that were found by what was learnt from such, and what is wrong.

    Raises:
        InputError: health was not learnt into this folder, or does not suit the recording.
    """
    known = HealthModel.load(model, DETECTED if PRESSES_DETECTED.items() <= recording.source.items() else COMMANDED)
    return known, examine(known, recording.readings, recording.times_s, recording.down_command, recording.up_command)


def health_files(names: Collection[str] = (COMMANDED, DETECTED)) -> set[str]:
    """Names of the files in a folder by which it tells health, for those of its models that are named."""
    return {file.name for name in names for file in files_of(Path(), name)}


def health_in(model: Path) -> dict[str, HealthModel]:
    """What the folder of a model tells health by, by the names of its files; nothing where none was learnt.

    Raises:
        InputError: it is damaged.
    """
    return {name: HealthModel.load(model, name) for name in (COMMANDED, DETECTED) if has_health(model, name)}
