"""Doubts about an identified pad: channels that its fibres do not explain, and wirings that fit nearly as well."""

from collections.abc import Iterator

import numpy as np

from padforge.sense.arrays import Array, Mask
from padforge.sense.twin.identification import Identification
from padforge.sense.twin.wiring import Wiring, planned_paths_mm

MAX_UNEXPLAINED, MAX_UNEXPLAINED_MEAN = 0.10, 0.025
"""Share of the variance of held-out responses that a smooth function of the position may explain beyond the twin: of a
channel, and mean over channels. From 250 presses of the right pad they are up to 0.08 and 0.02, if fibres bend much."""
MAX_TURN_DEG, MIN_SCALE = 10.0, 0.8
"""Largest rotation from a quarter turn, and smallest scale or inverse scale: the plan of another pad is rotated and
shrunk until it fits."""
MAX_OFFSET_MM, MAX_OFFSET = 3.0, 0.5
"""Largest rms lateral offset of a fibre, in mm and in grid units, whichever is less. Fibres are laid to a millimetre or
two, and beyond half a pitch the plan of another fibre is nearer."""
SAME_PLAN_MM = 1.0
"""Rms distance of the planned paths up to which two wirings count as one: no press tells a pad of straight fibres from
the same pad turned over."""
LAID_MM = 1.2
"""Rms lateral offset from the plan, as fibres are laid, up to which this holds: fibres that are in truth not straight
fit the plan of straight ones in eight ways alike."""


def find_doubts(result: Identification) -> list[str]:
    """Return what makes an identification doubtful, each in a line; channels and fibres count from 1."""
    unfit = list(_channel_doubts(result))
    lines = [line for _, line in unfit]
    channels = {channel for channel, _ in unfit}
    if 2 * len(channels) >= len(result.live):
        lines.insert(0, f"{len(channels)} of {len(result.live)} channels do not fit: is it the recording of this pad?")
    return [*_pad_doubts(result), *lines, *_wiring_doubts(result)]


def offset_mm(offset: Array, within: Mask) -> float:
    """Return the rms of a lateral offset along a fibre (F,), where it was pressed; 0 where it was not."""
    return float(np.sqrt((offset[within] ** 2).mean())) if within.any() else 0.0


def _pad_doubts(result: Identification) -> Iterator[str]:
    explained, smooth = (float(shares.mean()) for shares in (result.explained, result.explained_smooth))
    if explained < smooth - MAX_UNEXPLAINED_MEAN:
        yield (
            f"the fibres explain {explained:.3f} of held-out responses, smooth functions of the position {smooth:.3f}:"
            " is it the recording of this pad?"
        )
    transform = result.fit.pad.transform
    off_quarter_deg = abs((transform.turn_deg + 45) % 90 - 45)
    if off_quarter_deg > MAX_TURN_DEG or not MIN_SCALE <= transform.scale <= 1 / MIN_SCALE:
        yield (
            f"the pad would have lain {off_quarter_deg:.0f} degrees off a quarter turn, at a scale of"
            f" {transform.scale:.2f}: is it the recording of this pad?"
        )


def _channel_doubts(result: Identification) -> Iterator[tuple[int, str]]:
    allowed_mm = min(MAX_OFFSET_MM, MAX_OFFSET * result.pad.unit_mm)
    explained = zip(result.explained.tolist(), result.explained_smooth.tolist(), strict=True)
    for row, ((by_fibre, smooth), (offset, _, within)) in enumerate(
        zip(explained, result.lateral_offsets_mm(), strict=True)
    ):
        channel, fibre = int(result.live[row]) + 1, result.fit.pad.fibres[row] + 1
        if by_fibre < smooth - MAX_UNEXPLAINED:
            yield (
                channel,
                f"channel {channel} does not fit: fibre {fibre} explains {by_fibre:.2f} of held-out responses, a smooth"
                f" function of the position {smooth:.2f}",
            )
        if (beside_mm := offset_mm(offset, within)) > allowed_mm:
            yield (
                channel,
                f"channel {channel} does not fit: fibre {fibre} lies {beside_mm:.1f} mm beside its plan, allowed is"
                f" {allowed_mm:.1f}",
            )


def _wiring_doubts(result: Identification) -> Iterator[str]:
    built = result.fit.pad
    planned_mm = planned_paths_mm(built.plan, built.transform, built.fibres)

    def distance_mm(other: Wiring) -> float:
        paths_mm = planned_paths_mm(built.plan, other.transform, other.fibres)
        # a fibre may run either way
        squares = [((planned_mm - paths) ** 2).sum(axis=2).mean(axis=1) for paths in (paths_mm, paths_mm[:, ::-1])]
        return float(np.sqrt(np.minimum(*squares).mean()))

    beside_mm = np.concatenate([offset[within] for offset, _, within in result.lateral_offsets_mm()])
    is_laid = np.sqrt((beside_mm**2).mean()) <= LAID_MM
    others = [other for other in result.alternatives if not (is_laid and distance_mm(other) <= SAME_PLAN_MM)]
    if not others:
        return
    explain = "pose or wiring explains" if len(others) == 1 else "poses or wirings explain"
    yield f"{len(others)} other {explain} the presses nearly as well"
    for row, fibre in enumerate(built.fibres):
        if read := sorted({other.fibres[row] + 1 for other in others} - {fibre + 1}):
            fibres = " or ".join(map(str, read))
            yield f"channel {result.live[row] + 1} may read fibre {fibres} in place of {fibre + 1}"
