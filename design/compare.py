"""Which pad to make: variants of settings side by side, by what they cost and how well they locate."""

import itertools
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.design.common.files import provenance, write_json
from padforge.design.common.plotting import (
    CURVES,
    FAINT,
    INK,
    add_caption,
    add_title,
    new_figure,
    save_figure,
    style_axes,
)
from padforge.design.common.profiling import stage
from padforge.design.common.settings import Spec
from padforge.design.common.validation import InputError, short_repr
from padforge.design.contact_comparison import beside_straight, design_contact, errors_by_contact
from padforge.design.morphology import Morphology
from padforge.design.optimize.search import SearchOptions
from padforge.design.paths.curves import crossings, lengths
from padforge.design.run import run_search
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT, NAME = "padforge-comparison/1", "comparison.json"
MOST_VARIANTS = 64
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)", re.IGNORECASE)
"""Names that are no files on Windows."""
DESIGNED = (PadSettings, Contact, SearchSettings, RulesSettings)
"""What a design depends on, and so what is varied."""
Making = Callable[[Morphology, Spec, Path], Mapping[str, Any]]
"""What it takes to make a pad, with what is written of it in a folder: of `MAKING`."""
MAKING = {"mould_ml": "mould (ml)", "silicone_ml": "silicone (ml)", "failed": "failed checks"}


@dataclass(frozen=True)
class Variant:
    """A pad to be designed, by its name and settings; or one that is there, `pad`."""

    name: str
    spec: Spec
    pad: Morphology | None = None

    @property
    def folder(self) -> str:
        """Name of the folder that it goes to, which every system takes."""
        name = re.sub(r"[^\w.+-]+", "-", self.name).strip(".-") or "pad"
        return f"pad-{name}" if _DEVICE.match(name) else name


def variants(sources: Sequence[Path], vary: Sequence[str], load: Callable[[Path | None], Spec]) -> list[Variant]:
    """What is to be compared: every source, settings (.toml) or a morphology, under every combination of `vary`.

    Args:
        sources: the settings that `load` finds without a file if there are none.
        vary: `pad.grid=3,4,6`: a key and the values it takes in turn, as TOML has them; of settings only.

    Raises:
        InputError: no such file, key or value, a name met twice, one variant alone, or more than MOST_VARIANTS.
    """
    changes = [_changes(each) for each in vary]
    found = []
    for path in sources or [None]:
        if path is not None and path.suffix.lower() != ".toml":
            named = path.resolve().parent.name if path.name == "morphology.json" else path.stem
            found.append(Variant(named, load(None), Morphology.load(path)))
            continue
        spec, name = load(path), "" if path is None else path.stem
        for chosen in itertools.product(*changes):
            tables: dict[str, dict[str, Any]] = {}
            for section, key, value in chosen:
                tables.setdefault(section, {})[key] = value
            said = [f"{key} {str(value).strip('()').replace(', ', ' x ')}" for _, key, value in chosen]
            found.append(Variant(", ".join([name, *said] if name else said) or "defaults", spec.replaced(tables)))
    folders = [variant.folder.casefold() for variant in found]  # as macOS and Windows tell them apart
    if len(set(folders)) < len(folders):
        raise InputError(f"{max(folders, key=folders.count)}: one of this name is there already, expected each once")
    if not 2 <= len(found) <= MOST_VARIANTS:
        raise InputError(f"these are {len(found)} pads to compare, allowed are 2 to {MOST_VARIANTS}")
    for variant in found:  # before minutes are spent on another
        for model in DESIGNED:
            variant.spec.section(model)
    return found


def _changes(text: str) -> list[tuple[str, str, Any]]:
    """Section, key and value, of `section.key=value,value`."""
    key, equals, values = text.partition("=")
    section, dot, name = key.strip().partition(".")
    try:
        found = tomllib.loads(f"values = [{values}]")["values"]
    except ValueError as error:
        raise InputError(f"--vary is {short_repr(text)}, its values are none of TOML ({error})") from error
    if not (equals and dot and name and found):
        raise InputError(f"--vary is {short_repr(text)}, expected SECTION.KEY=VALUE,VALUE such as pad.grid=3,4")
    if section not in (allowed := [model.section() for model in DESIGNED]):
        raise InputError(f"--vary is {short_repr(text)}: no such section to vary, allowed are {', '.join(allowed)}")
    return [(section, name, tuple(value) if isinstance(value, list) else value) for value in found]


def compare(pads: Sequence[Variant], out: Path, run: SearchOptions, seed: int | None, making: Making) -> dict[str, Any]:
    """Design every variant in a folder of its own in `out`, judge all alike, and write comparison.json and .png.

    A pad is judged by a small network on responses that scatter, by its own contact and sensed area, beside straight
    fibres of the same layout (`errors_by_contact`).

    Args:
        run: how each search runs.
        seed: of searches, noise and networks; that of `[search]` if None.

    Returns:
        The document: a row a variant, with errors in mm by 0, 1, ... lost fibres.

    Raises:
        KeyboardInterrupt: a search was interrupted; the pads before it are in their folders.
    """
    rows = []
    for variant in pads:
        folder = out / variant.folder
        pad = variant.pad
        if pad is None:
            found = run_search(variant.spec, folder, {"seed": seed}, run=run)[1]
            if found.stopped == "interrupted":
                raise KeyboardInterrupt  # of all of it, not of this search alone
            pad = found.morphology
        rows.append(_row(variant, pad, seed) | dict(making(pad, variant.spec, folder)))
    made_by = provenance("padforge design compare", seed or 0, packages=("torch",))
    document = {"format": FORMAT, "rows": rows, "provenance": made_by}
    write_json(out / NAME, document)
    save_figure(_figure(rows), out / "comparison.png")
    return document


def _row(variant: Variant, pad: Morphology, seed: int | None) -> dict[str, Any]:
    settings = variant.spec.section(SearchSettings, seed=seed)
    size = variant.spec.section(PadSettings, **pad.layout.settings)
    contact = design_contact(variant.spec, settings)
    with stage("compare"):
        asked = {"assumed": contact}, size, settings.response_scatter, settings.seed
        found = errors_by_contact(beside_straight(pad), *asked)
    errors = {each.pad: list(each.errors_mm) for each in found}
    return {
        "name": variant.name,
        "fibres": list(pad.layout.counts),
        "pitch_mm": pad.pitch_mm,
        "knots": pad.knots.shape[1] - 2,
        "length_mm": float(lengths(pad).sum() * pad.unit_mm),
        "crossings": len(crossings(pad)),
        "errors_mm": errors["designed"],
        "straight_mm": errors["straight"],
    }


def comparison_lines(document: Mapping[str, Any]) -> list[str]:
    """The comparison as a table of text."""
    rows = document["rows"]
    most = max(len(row["errors_mm"]) for row in rows)
    kinds = {key: name for key, name in MAKING.items() if any(key in row for row in rows)}
    head = ["pad", "fibres", "knots", "fibre (m)", "crossings", *kinds.values()]
    table = [[*head, *(f"{lost} lost (mm)" for lost in range(most))]]
    for row in rows:
        horizontals, verticals = row["fibres"]
        known = [row["name"], f"{horizontals} + {verticals}", row["knots"], f"{row['length_mm'] / 1000:.2f}"]
        made = [f"{row[key]:.3g}" for key in kinds]
        table.append([*map(str, known), str(row["crossings"]), *made, *_errors(row["errors_mm"], most)])
        if any(a != b for a, b in zip(row["errors_mm"], row["straight_mm"], strict=True)):
            straight = [""] * (4 + len(kinds))
            table.append(["  straight fibres", *straight, *_errors(row["straight_mm"], most)])
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return [
        "  ".join(cell.ljust(width) if at == 0 else cell.rjust(width) for at, (cell, width) in enumerate(cells))
        for cells in (list(zip(row, widths, strict=True)) for row in table)
    ]


def _errors(errors: Sequence[float], most: int) -> list[str]:
    return [f"{error:.2f}" for error in errors] + ["-"] * (most - len(errors))


def _figure(rows: Sequence[Mapping[str, Any]]) -> "Figure":
    """Errors by lost fibres, and what the first and the last of them cost in fibre."""
    figure, _ = new_figure(9.6, 4.2)
    figure.clear()
    by_loss, by_length = figure.subplots(1, 2)
    for at, row in enumerate(rows):
        colour, errors = CURVES[at % len(CURVES)], row["errors_mm"]
        by_loss.plot(range(len(errors)), errors, "o-", color=colour, label=row["name"])
        by_loss.plot(range(len(errors)), row["straight_mm"], ":", color=colour, linewidth=1)
        length, ends = row["length_mm"] / 1000, (errors[0], errors[-1])
        by_length.plot([length, length], ends, "-", color=colour, alpha=0.4)
        by_length.plot([length], ends[:1], "o", color=colour)
        by_length.plot([length], ends[1:], "s", color=colour, markerfacecolor="none")
    for axes in (by_loss, by_length):
        style_axes(axes)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        axes.set_ylim(bottom=0)
        axes.set_ylabel("mean error (mm)", color=INK)
    by_loss.set_xticks(np.arange(max(len(row["errors_mm"]) for row in rows)))
    by_loss.set_xlabel("lost fibres")
    by_length.set_xlabel("fibre to lay (m)")
    add_caption(by_loss, "lines: as designed; dotted: straight fibres")
    add_caption(by_length, "dot: all fibres; square: most lost")
    by_loss.legend(frameon=False, fontsize=8)
    add_title(figure, "What a pad costs, and how well it locates")
    return figure
