"""Pictures of an identified pad.

All that an identification leaves in a folder: the twin, the document and its pictures, and what the report says.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from padforge.design.common.files import atomic_files, check_replaceable, check_writable, provenance, write_json
from padforge.design.common.page import PageSection, figures, paragraph, table
from padforge.design.common.plotting import FAINT, HORIZONTAL, INK, PAPER, VERTICAL, add_title, save_figure, style_axes
from padforge.design.common.profiling import stage
from padforge.design.paths.curves import flatten
from padforge.sense.arrays import Array, Mask
from padforge.sense.twin.identification import Identification

if TYPE_CHECKING:
    from padforge.design.morphology import Morphology
    from padforge.design.twin import Twin
    from padforge.sense.recording.recording import Recording


COLUMNS = ("measured", "predicted", "left over")


def draw_responses(found: Identification, path: Path) -> None:
    """Draw what each live channel answers by place: measured, predicted, and what is left over, on one scale each."""
    presses, pad = found.held_out, found.fit.pad
    predicted = pad.predict(presses.positions_mm)
    channels = len(found.live)
    figure = Figure(figsize=(7.2, 0.5 + 1.9 * channels), layout="constrained")
    axes = figure.subplots(channels, 3, squeeze=False, sharex=True, sharey=True)
    for row in range(channels):
        there = presses.there[:, row]
        x, y = presses.positions_mm[there].T
        measured, told = presses.volts[there, row] * 1e3, predicted[there, row] * 1e3
        most = float(np.abs(np.concatenate([measured, told])).max()) or 1.0
        dots = None
        for column, values in enumerate((measured, told, measured - told)):
            each = axes[row, column]
            dots = each.scatter(x, y, c=values, s=9, cmap="RdBu_r", vmin=-most, vmax=most, linewidths=0)
            style_axes(each)
            each.set_aspect("equal")
        figure.colorbar(dots, ax=list(axes[row]), label="mV", shrink=0.85).outline.set_visible(False)  # type: ignore[operator]
        axes[row, 0].set_ylabel(f"channel {found.live[row] + 1}, fibre {pad.fibres[row] + 1}\ny (mm)", color=INK)
        axes[row, 2].set_title(f"explained {found.explained[row]:.2f}", fontsize=9, color=INK, loc="left")
    for column, name in enumerate(COLUMNS):
        first = axes[0, column].get_title("left")
        axes[0, column].set_title(f"{name}, {first}" if first else name, fontsize=9, color=INK, loc="left")
        axes[-1, column].set_xlabel("x (mm)")
    add_title(figure, f"What {len(presses)} presses held out show, and what the twin says")
    save_figure(figure, path)


def draw_laid_plan(found: Identification, path: Path) -> None:
    """Draw the plan with the fibres as laid over it, their uncertainty as a band, and how far each is off, in mm."""
    pad = found.pad
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    plan, aside = figure.subplots(1, 2, width_ratios=(1.15, 1))
    right, top = (side / 2 for side in pad.layout.size_mm)
    plan.add_patch(Rectangle((-right, -top), 2 * right, 2 * top, facecolor=PAPER, edgecolor=FAINT))
    for points in flatten(pad, 1e-3):
        plan.plot(*pad.to_mm(points).T, color=FAINT, linewidth=1.4)
    pressed = found.fit.pad.frame.to_plan(found.learnt.positions_mm)
    plan.scatter(*pressed.T, s=1, color=INK, alpha=0.25, linewidths=0)
    for row, (off, unsure, within) in enumerate(found.laid_mm()):
        fibre = found.fit.pad.fibres[row]
        colour = VERTICAL if pad.layout.family(fibre) else HORIZONTAL
        x, y = pad.to_mm(found.fit.pad.course(row)[0]).T
        plan.plot(x, y, color=colour, linewidth=1.6)
        beside = 0.03 * max(right, top)
        end = (x[-1], top + beside) if pad.layout.family(fibre) else (right + beside, y[-1])
        plan.text(*end, str(fibre + 1), color=colour, fontsize=9, ha="center", va="center")
        run, shown = np.linspace(0, 100, len(off)), np.where(within, off, np.nan)
        aside.plot(run, shown, color=colour, linewidth=1.2)
        aside.fill_between(run, shown - unsure, shown + unsure, color=colour, alpha=0.12, linewidth=0)
        last = int(np.flatnonzero(within)[-1]) if within.any() else 0
        aside.annotate(str(fibre + 1), (run[last], off[last]), color=colour, fontsize=9, va="center")
    plan.set_aspect("equal")
    room = 0.1 * max(right, top)
    plan.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(-room - right, right + room), ylim=(-room - top, top + room))
    aside.set(xlabel="along the fibre (%)", ylabel="beside its plan, to the left (mm)", xlim=(0, 104))
    aside.axhline(0, color=FAINT, linewidth=0.8)
    for axes in (plan, aside):
        style_axes(axes)
    add_title(figure, "Grey: the plan; coloured: as laid; dots: presses, on the plan")
    save_figure(figure, path)


FORMAT = "padforge-identification/2"
STRANGER = 0.02
"""Share of the variance by which a plan must explain more than straight fibres do, to be known by its presses."""
COMMAND, TWIN = "padforge sense identify", "twin.json"


def identify_into(
    recording: "Recording",
    pad: "Morphology",
    out: Path,
    seed: int = 0,
    *,
    inputs: list[Path] | None = None,
    report: Callable[[str, int, int], None] = lambda what, done, of: None,
    force: bool = False,
) -> dict[str, Any]:
    """Identify a pad, write twin.json, identification.json and two pictures to `out`, and return the document.

    Nothing in `out` changes before the last result is there.

    Args:
        force: whether a twin is replaced that others in `out` were made from.

    Raises:
        InputError: as `identify`, `out` cannot be written, or others were made from the twin in it.
    """
    from padforge.sense.twin.identification import identify

    check_writable(out)
    origin = provenance(COMMAND, seed, inputs or [])  # minutes later they may differ from what was read
    check_replaceable(out / TWIN, origin, force=force)
    with stage("identify"):
        found = identify(recording, pad, seed, report)
    twin = found.twin(origin)
    document = identification_document(found, twin) | {"rig_mirrored": recording.mirrored, "provenance": origin}
    with atomic_files(out) as folder, stage("figures"):
        twin.save(folder / TWIN)
        check_replaceable(out / TWIN, folder / TWIN, force=force)  # the same plan, but perhaps another recording
        write_json(folder / "identification.json", document)
        draw_responses(found, folder / "twin_responses.png")
        draw_laid_plan(found, folder / "twin_plan.png")
    return document


def identification_document(found: "Identification", twin: "Twin") -> dict[str, Any]:
    """What was found, and told as a twin, as JSON: fibres count from 0, None where no fibre explains a channel."""
    laid = found.laid_mm()
    return {
        "format": FORMAT,
        "presses": len(found.learnt),
        "held_out": len(found.held_out),
        "channels": [
            asdict(channel) | _laid(found, laid, channel.channel) | {"or_fibres": _others(found, channel.channel)}
            for channel in twin.channels
        ],
        "explained": float(found.explained.mean()),
        "explained_on_plan": found.on_plan,
        "noise": twin.noise,
        "frame": asdict(twin.frame),
        "sensitivity_profile": {"distance_mm": twin.distance_mm.tolist(), "weight": twin.weight.tolist()},
        "angle": twin.angular_weight is not None,
        "sensed_mm": list(twin.sensed_mm),
        "doubts": len(found.doubts),
        "explained_by_straight": found.straight,
    }


def _laid(found: "Identification", laid: Sequence[tuple[Array, Array, Mask]], channel: int) -> dict[str, float]:
    """How far the fibre of a channel lies beside its plan within what was pressed, and how sure that is, mm."""
    rows = np.flatnonzero(found.live == channel)
    if not len(rows):
        return {}
    aside, unsure, within = laid[int(rows[0])]
    if not within.any():
        return {"aside_mm": 0.0, "unsure_mm": float(unsure.mean())}
    return {"aside_mm": float(np.sqrt((aside[within] ** 2).mean())), "unsure_mm": float(unsure[within].mean())}


def _others(found: "Identification", channel: int) -> list[int]:
    """Fibres that a channel may read as well, by the wirings that cannot be told from the one found."""
    rows = np.flatnonzero(found.live == channel)
    if not len(rows):
        return []
    row = int(rows[0])
    return sorted({doubt.fibres[row] for doubt in found.doubts} - {found.fit.pad.fibres[row]})


def identification_lines(document: Mapping[str, Any], out: Path) -> list[str]:
    """An identification for people; channels and fibres count from 1."""
    frame = document["frame"]
    return [
        f"twin of {document['presses']} presses -> {out / 'twin.json'}",
        "channel fibre gain (mV/%)  noise (mV)  explained  beside its plan (mm)",
        *map(_line, document["channels"]),
        f"explained {document['explained']:.3f} of what presses held out show; on the plan as it is"
        f" {document['explained_on_plan']:.3f}; noise {document['noise']:.1%} of full scale",
        f"laid {_side(document)}, turned {_tenths(frame['turn_deg'])} degrees, shifted {_shift(frame)} mm,"
        f" scale {frame['scale']:.3f}",
        *doubt_lines(document),
    ]


def _line(row: Mapping[str, Any]) -> str:
    line = f"{row['channel'] + 1:7d} {_fibre(row):>5} {row['gain_v'] * 10:10.1f} {row['noise_v'] * 1e3:11.2f}"
    return line + (
        f" {row['explained']:10.2f} {row['aside_mm']:10.2f} +- {row['unsure_mm']:.2f}" if "aside_mm" in row else ""
    )


def doubt_lines(document: Mapping[str, Any]) -> Iterator[str]:
    """What the presses cannot tell, in words."""
    if document["doubts"]:
        told = "; ".join(
            f"channel {row['channel'] + 1}: {_fibre(row)} or {', '.join(str(fibre + 1) for fibre in row['or_fibres'])}"
            for row in document["channels"]
            if row["or_fibres"]
        )
        yield (
            f"not to be told: {document['doubts']} other ways to lie and be wired explain the presses as well"
            + (f" ({told})" if told else "")
        )
    straight = document["explained_by_straight"]
    if straight is not None and document["explained_on_plan"] < straight + STRANGER:
        yield (
            f"straight fibres explain {straight:.3f}, about as much as this plan does: is it the recording of this pad?"
        )


def identification_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """How the pad was laid and wired, from an `identification.json` in `folder`.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: a picture beside it cannot be read.
    """
    frame = document["frame"]
    live = [row for row in document["channels"] if "aside_mm" in row]
    rows = [
        [
            row["channel"] + 1,
            _fibre(row),
            ", ".join(str(fibre + 1) for fibre in row["or_fibres"]) or "-",
            f"{row['gain_v'] * 10:.1f}",
            f"{row['noise_v'] * 1e3:.2f}",
            *([f"{row['explained']:.2f}", f"{row['aside_mm']:.2f} ± {row['unsure_mm']:.2f}"] if row in live else "--"),
        ]
        for row in document["channels"]
    ]
    head = ["channel", "fibre", "or", "gain (mV a %)", "noise (mV)", "explained", "beside its plan (mm)"]
    return [
        PageSection(
            "How the pad was laid",
            [
                paragraph(
                    f"Localization from {document['presses']} presses: it lay {_side(document)}, turned"
                    f" {_tenths(frame['turn_deg'])} degrees, shifted {_shift(frame)} mm, scale {frame['scale']:.3f}."
                    f" The twin explains {document['explained']:.0%} of what {document['held_out']} presses held out"
                    f" show, the plan as it is {document['explained_on_plan']:.0%}; noise is"
                    f" {document['noise']:.1%} of full scale."
                ),
                *map(paragraph, doubt_lines(document)),
                table(head, rows),
                figures(
                    [
                        (folder / "twin_plan.png", "The plan, and the fibres as laid over it."),
                        (
                            folder / "twin_responses.png",
                            "Answers of each channel by place: measured, predicted, left.",
                        ),
                    ]
                ),
            ],
            [(f"{document['explained']:.0%}", "of the responses explained by the twin")],
        )
    ]


def _fibre(row: Mapping[str, Any]) -> str:
    return "none" if row["fibre"] is None else str(row["fibre"] + 1)


def _side(document: Mapping[str, Any]) -> str:
    """How the pad lay, and what `[rig] mirrored` had said of it: the frame of a twin is what is left to tell."""
    over, told = document["frame"]["mirrored"], document.get("rig_mirrored", False)
    if told:
        return "as planned, which [rig] mirrored denies" if over else "turned over, as [rig] mirrored says"
    return "turned over" if over else "as planned"


def _shift(frame: Mapping[str, Any]) -> str:
    return ", ".join(map(_tenths, frame["shift_mm"]))


def _tenths(value: float) -> str:
    """To one digit, 0 without a sign."""
    return f"{round(value, 1) + 0.0:.1f}"
