"""What a machine is told, one thing after the other, whatever language it speaks: ways, and pauses for the person."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from padforge.fabricate.mould.plan import Plan
from padforge.fabricate.report.fibre_layers import fibre_name

from .course import Step, Stroke

Place = tuple[float, float, float]
"""(x, y, z) in mm, in the frame of the pad turned over."""


@dataclass(frozen=True)
class Go:
    """Straight to a place with the needle empty, above the pad or beside it."""

    place: Place
    speed_mm_s: float


@dataclass(frozen=True)
class Lay:
    """Along a fibre, from where the stroke begins."""

    stroke: Stroke


@dataclass(frozen=True)
class Pause:
    """Wait until the person has done what the message says."""

    message: str


Instruction = Go | Lay | Pause


def instructions(plan: Plan, steps: Sequence[Step]) -> Iterator[Instruction]:
    """The whole work: every fibre is fastened, laid and cut, every step sealed before the next.

    In a message stand no brackets, and no number after an s or a p: firmwares take the one for the end of a comment,
    the other for a time to wait.
    """
    dispenser = plan.settings.dispenser
    height = dispenser.travel_height_mm
    for number, step in enumerate(steps, 1):
        for stroke in step.strokes:
            name = f"fibre {stroke.fibre + 1}, {fibre_name(plan, stroke.fibre)}"
            (start_x, start_y), (end_x, end_y) = stroke.places_mm[[0, -1]].tolist()
            yield Go((start_x, start_y, height), dispenser.travel_mm_s)
            yield Go((start_x, start_y, stroke.z_mm), dispenser.feed_mm_s)
            yield Pause(f"{name}: fasten its end under the needle")
            yield Lay(stroke)
            yield Pause(f"{name}: cut it at the needle")
            yield Go((end_x, end_y, height), dispenser.travel_mm_s)
        yield Pause(f"layer {number} of {len(steps)}, {step.layer.depth_mm:.3g} mm deep: seal it and let it cure")


def summary_lines(plan: Plan, steps: Sequence[Step]) -> Iterator[str]:
    """What stands at the head of every program, for whoever starts it."""
    strokes = [stroke for step in steps for stroke in step.strokes]
    length = sum(float(stroke.steps_mm.sum()) for stroke in strokes)
    seconds = sum(float((stroke.steps_mm / stroke.feeds_mm_s).sum()) for stroke in strokes)
    lowest = min(stroke.z_mm for stroke in strokes)
    yield "padforge: the fibres of a pad, laid by a needle"
    yield f"{len(strokes)} fibres in {len(steps)} layers, {length / 1000:.2f} m; {seconds / 60:.1f} minutes of laying"
    yield "the pad lies turned over, left to right, with its tracks up, on a flat plate"
    near = "on the right, nearest"
    if plan.settings.pad.leads == "one side":
        near = "at the near edge"
    elif not plan.pad.layout.horizontals:
        near = "on the right, at the near side"
    yield f"seen from above: x to the right, against the pad's, y away from you; fibre 1 starts {near}"
    yield f"z is 0 where the needle touches the upper face; it goes down to {lowest:.3f} mm"
    yield f"needle of at most {plan.settings.dispenser.tip_mm:g} mm, pad {plan.thickness_mm:.3g} mm thick"
