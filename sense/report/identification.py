"""Files of an identification (twin, document, figures), its printed lines and its section of the report."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from padforge.common.command_line import text_table
from padforge.common.files import atomic_files, check_replaceable, check_writable, provenance, write_json
from padforge.common.page import PageSection, figures, paragraph, table
from padforge.common.plotting import FAINT, HORIZONTAL, INK, PAPER, VERTICAL, add_title, save_figure, style_axes
from padforge.common.profiling import stage
from padforge.common.progress import OnProgress, ignore_progress
from padforge.design.morphology import Morphology
from padforge.design.paths.curves import flatten
from padforge.design.settings import Contact
from padforge.sense.recording.recording import Recording
from padforge.sense.twin.doubts import find_doubts, offset_mm
from padforge.sense.twin.identification import Identification, identify_pad

FORMAT = "padforge-identification/1"
CHANNEL_HEAD = ["channel", "fibre", "or", "gain (mV/%)", "noise (mV)", "explained", "lateral offset (mm)"]
TWIN = "twin.json"


def identify_into(
    recording: Recording,
    pad: Morphology,
    out: Path,
    seed: int = 0,
    *,
    contact: Contact | None = None,
    inputs: list[Path] | None = None,
    on_progress: OnProgress = ignore_progress,
    force: bool = False,
) -> dict[str, Any]:
    """Identify a pad as `identify`, write the twin and figures into `out`, and return `identification.json`.

    No file changes before all are done. The digests of the files `inputs` become part of the provenance, and `force`
    replaces a twin that other files in `out` were made from.

    Raises:
        InputError: as `identify`, `out` cannot be written, or other files were made from the twin in it.
    """
    check_writable(out)
    # now, since the files may change during the identification, which takes minutes
    origin = provenance("padforge sense identify", seed, inputs or [])
    check_replaceable(out / TWIN, origin, force=force)
    with stage("identify"):
        result = identify_pad(recording, pad, contact, seed, on_progress)
    document = _document(result) | {"rig_mirrored": recording.mirrored, "provenance": origin}
    with atomic_files(out) as folder, stage("figures"):
        replace(result.twin, provenance=origin).save(folder / TWIN)
        check_replaceable(out / TWIN, folder / TWIN, force=force)  # by content, since provenance does not show all
        write_json(folder / "identification.json", document)
        _draw_responses(result, folder / "twin_responses.png")
        _draw_plan(result, folder / "twin_plan.png")
    return document


def _document(result: Identification) -> dict[str, Any]:
    """Return an identification as JSON: fibres count from 0, None where no fibre explains a channel."""
    twin, contact = result.twin, None
    if measured := result.contact:
        best = measured.best
        contact = {
            "stated": measured.stated.model_dump(mode="json"),
            **{name: getattr(best, name) for name in ("scale", "squeeze", "stretch", "scale_std", "shares_std")},
            "explained": best.explained,
            "explained_on_plan": measured.on_plan.explained,
            "explained_on_plan_by_gaussian": measured.gaussian_on_plan.explained,
        }
    channels = [asdict(channel) | {"alternative_fibres": []} for channel in twin.channels]
    for row, (offset, std, within) in enumerate(result.lateral_offsets_mm()):
        fibre = result.fit.pad.fibres[row]
        channels[int(result.live[row])] |= {
            "explained_smooth": float(result.explained_smooth[row]),
            "lateral_offset_mm": offset_mm(offset, within),
            "lateral_offset_std_mm": float((std[within] if within.any() else std).mean()),
            "alternative_fibres": sorted({wiring.fibres[row] for wiring in result.alternatives} - {fibre}),
        }
    return {
        "format": FORMAT,
        "presses": len(result.training),
        "held_out": len(result.held_out),
        "channels": channels,
        "explained": float(result.explained.mean()),
        "explained_on_plan": result.explained_on_plan,
        "contact": contact,
        "noise": twin.noise,
        "frame": asdict(twin.frame),
        "sensitivity_profile": {"distance_mm": twin.distance_mm.tolist(), "weight": twin.weight.tolist()},
        "angular": twin.angular_weight is not None,
        "sensed_mm": list(twin.sensed_mm),
        "n_alternatives": len(result.alternatives),
        "doubts": find_doubts(result),
    }


def _draw_responses(result: Identification, path: Path) -> None:
    """Draw held-out responses of each live channel by position: measured, predicted and residual, on one scale."""
    held_out, pad = result.held_out, result.fit.pad
    predicted, channels = pad.predict(held_out.positions_mm), len(result.live)
    figure = Figure(figsize=(7.2, 0.5 + 1.9 * channels), layout="constrained")
    panels = figure.subplots(channels, 3, squeeze=False, sharex=True, sharey=True)
    for row in range(channels):
        valid = held_out.valid[:, row]
        x, y = held_out.positions_mm[valid].T
        measured_mv, predicted_mv = held_out.volts[valid, row] * 1e3, predicted[valid, row] * 1e3
        limit = float(np.abs(np.concatenate([measured_mv, predicted_mv])).max()) or 1.0
        dots = None
        for axes, values in zip(panels[row], (measured_mv, predicted_mv, measured_mv - predicted_mv), strict=True):
            dots = axes.scatter(x, y, c=values, s=9, cmap="RdBu_r", vmin=-limit, vmax=limit, linewidths=0)
            style_axes(axes)
            axes.set_aspect("equal")
        figure.colorbar(dots, ax=list(panels[row]), label="mV", shrink=0.85).outline.set_visible(False)  # type: ignore[operator]
        panels[row, 0].set_ylabel(f"channel {result.live[row] + 1}, fibre {pad.fibres[row] + 1}\ny (mm)", color=INK)
        panels[row, 2].set_title(f"explained {result.explained[row]:.2f}", fontsize=9, color=INK, loc="left")
    for column, name in enumerate(("measured", "predicted", "residual")):
        title = panels[0, column].get_title("left")
        panels[0, column].set_title(f"{name}, {title}" if title else name, fontsize=9, color=INK, loc="left")
        panels[-1, column].set_xlabel("x (mm)")
    add_title(figure, f"Responses to {len(held_out)} held-out presses, measured and predicted by the twin")
    save_figure(figure, path)


def _draw_plan(result: Identification, path: Path) -> None:
    """Draw the fibres as built over the plan; and their lateral offset with its standard deviation as a band."""
    pad, built = result.pad, result.fit.pad
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    plan, offsets = figure.subplots(1, 2, width_ratios=(1.15, 1))
    right, top = (side / 2 for side in pad.layout.size_mm)
    plan.add_patch(Rectangle((-right, -top), 2 * right, 2 * top, facecolor=PAPER, edgecolor=FAINT))
    for points in flatten(pad, 1e-3):
        plan.plot(*pad.to_mm(points).T, color=FAINT, linewidth=1.4)
    pressed = built.transform.to_plan(result.training.positions_mm)
    plan.scatter(*pressed.T, s=1, color=INK, alpha=0.25, linewidths=0)
    margin = 0.03 * max(right, top)
    for row, (offset, std, within) in enumerate(result.lateral_offsets_mm()):
        fibre = built.fibres[row]
        vertical = pad.layout.family(fibre)
        colour = VERTICAL if vertical else HORIZONTAL
        x, y = pad.to_mm(built.path(row)[0]).T
        plan.plot(x, y, color=colour, linewidth=1.6)
        start = (x[0], -top - margin) if vertical else (-right - margin, y[0])
        plan.text(*start, str(fibre + 1), color=colour, fontsize=9, ha="center", va="center")
        along, visible = np.linspace(0, 100, len(offset)), np.where(within, offset, np.nan)
        offsets.plot(along, visible, color=colour, linewidth=1.2)
        offsets.fill_between(along, visible - std, visible + std, color=colour, alpha=0.12, linewidth=0)
        last = int(np.flatnonzero(within)[-1]) if within.any() else 0
        offsets.annotate(str(fibre + 1), (along[last], offset[last]), color=colour, fontsize=9, va="center")
    plan.set_aspect("equal")
    margin = 0.1 * max(right, top)
    limits = {"xlim": (-margin - right, right + margin), "ylim": (-margin - top, top + margin)}
    plan.set(xlabel="x (mm)", ylabel="y (mm)", **limits)
    offsets.set(xlabel="along the fibre (%)", ylabel="lateral offset, to the left (mm)", xlim=(0, 104))
    offsets.axhline(0, color=FAINT, linewidth=0.8)
    for axes in (plan, offsets):
        style_axes(axes)
    add_title(figure, "Grey: the plan; coloured: as built; dots: presses, on the plan")
    save_figure(figure, path)


def identification_lines(document: Mapping[str, Any], out: Path) -> list[str]:
    """Describe an identification; channels and fibres count from 1."""
    return [
        f"twin of {document['presses']} presses -> {out / TWIN}",
        *text_table([CHANNEL_HEAD, *map(_channel_cells, document["channels"])], text_columns=()),
        f"explained {document['explained']:.3f} of held-out responses; {document['explained_on_plan']:.3f} on the plan"
        f" as it is; noise {document['noise']:.1%} of full scale",
        f"the pad lay {_pose(document)}",
        *_contact_lines(document),
        *(f"doubtful: {doubt}" for doubt in document["doubts"]),
    ]


def _contact_lines(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield the measured contact, if it is a layer, by the keys of `[contact]`."""
    if contact := document.get("contact"):
        yield (
            f"a press as [contact] with scale {contact['scale']:.2f} ± {contact['scale_std']:.2f}, squeeze"
            f" {contact['squeeze']:.2f} and stretch {contact['stretch']:.2f} ± {contact['shares_std']:.2f}"
        )
        yield (
            f"this layer explains {contact['explained']:.3f}; on the plan {contact['explained_on_plan']:.3f}, a"
            f" Gaussian {contact['explained_on_plan_by_gaussian']:.3f}, a free profile"
            f" {document['explained_on_plan']:.3f}"
        )


def _channel_cells(row: Mapping[str, Any]) -> list[str]:
    explained = ["-", "-"]
    if "lateral_offset_mm" in row:
        offset = f"{row['lateral_offset_mm']:.2f} ± {row['lateral_offset_std_mm']:.2f}"
        explained = [f"{row['explained']:.2f}", offset]
    fibre = "none" if row["fibre"] is None else str(row["fibre"] + 1)
    alternatives = ", ".join(str(index + 1) for index in row["alternative_fibres"]) or "-"
    gain, noise = f"{row['gain_v'] * 10:.1f}", f"{row['noise_v'] * 1e3:.2f}"
    return [str(row["channel"] + 1), fibre, alternatives, gain, noise, *explained]


def identification_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Write the section of the report on an `identification.json` in `folder`; errors are as in `sections`."""
    summary = (
        f"Identified from {document['presses']} presses: the pad lay {_pose(document)}. The twin explains"
        f" {document['explained']:.0%} of the responses to {document['held_out']} held-out presses, the plan as it is"
        f" {document['explained_on_plan']:.0%}; noise is {document['noise']:.1%} of full scale."
    )
    pictures = [
        (folder / "twin_plan.png", "The plan, and the fibres as built over it."),
        (folder / "twin_responses.png", "Responses of each channel by position: measured, predicted, residual."),
    ]
    body = [
        paragraph(summary),
        *map(paragraph, _contact_lines(document)),
        *(paragraph(f"doubtful: {doubt}") for doubt in document["doubts"]),
        table(CHANNEL_HEAD, [_channel_cells(row) for row in document["channels"]]),
        figures(pictures),
    ]
    result = (f"{document['explained']:.0%}", "of the responses explained by the twin")
    return [PageSection("The pad as built", body, [result])]


def _pose(document: Mapping[str, Any]) -> str:
    """Describe how the pad lay; a recording with `[rig] mirrored` has mirrored positions already."""
    frame = document["frame"]
    if document.get("rig_mirrored", False):
        side = "as planned, which [rig] mirrored denies" if frame["mirrored"] else "turned over, as [rig] mirrored says"
    else:
        side = "turned over" if frame["mirrored"] else "as planned"
    # z: 0 without a sign
    turn, *shift = (f"{value:z.1f}" for value in (frame["turn_deg"], *frame["shift_mm"]))
    return f"{side}, rotated {turn} degrees, shifted {', '.join(shift)} mm, scale {frame['scale']:.3f}"
