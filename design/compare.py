"""Compare pads, such as those of variants of settings, by what they cost to make and by their localisation errors."""

import itertools
import re
import tomllib
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from padforge.common.command_line import text_table
from padforge.common.files import provenance, write_json
from padforge.common.plotting import CURVES, FAINT, add_caption, add_title, new_figure, save_figure, style_axes
from padforge.common.profiling import stage
from padforge.common.progress import OnProgress
from padforge.common.settings import Spec
from padforge.common.validation import InputError, short_repr
from padforge.design.contact import half_width_mm
from padforge.design.contact_comparison import beside_straight, design_contact, errors_by_contact
from padforge.design.contact_set import served_contacts
from padforge.design.design_run import run_design
from padforge.design.morphology import Morphology
from padforge.design.optimize.search import SearchOptions
from padforge.design.paths.curves import crossings, lengths
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings, cast_as_contact

FORMAT, NAME = "padforge-comparison/1", "comparison.json"
MAX_VARIANTS = 64
MODELS = (PadSettings, Contact, SearchSettings, RulesSettings)  # settings of a design, which may be varied
MakePad = Callable[[Morphology, Spec, Path], Mapping[str, Any]]
"""Makes the mould of a pad in a folder, and returns its costs by the keys of COSTS."""
COSTS = {  # heading and unit of the columns that not every pad has
    "half_width_mm": ("width", "mm"),
    "force_n": ("force", "N"),
    "strain_percent": ("strain", "%"),
    "mould_ml": ("mould", "ml"),
    "silicone_ml": ("cast", "ml"),
    "failed": ("faults", ""),
}


@dataclass(frozen=True)
class Variant:
    """A pad to compare: settings to design it by, or a finished morphology."""

    name: str  # in tables and figures
    spec: Spec
    pad: Morphology | None = None  # None if it is to be designed

    @property
    def folder(self) -> str:
        """Name of its folder, valid on every system."""
        return re.sub(r"[^\w.+-]+", "-", self.name).strip(".-") or "pad"


def read_variants(
    sources: Sequence[Path], vary: Sequence[str], load_spec: Callable[[Path | None], Spec]
) -> list[Variant]:
    """Return the pads to compare: morphologies, and settings (.toml) under every combination of varied values.

    Varied values are TOML, such as "pad.grid=3,4,6". They apply to settings, not to morphologies, and to the default
    settings if there are no sources. If they vary the thickness of the pad or the depths of the fibres in `[contact]`,
    the mould follows. InputError is raised for invalid files, keys and values, for two variants of one name, and unless
    there are 2 to MAX_VARIANTS.
    """
    varied = [_parse_varied(text) for text in vary]
    variants = []
    for path in sources or [None]:
        if path is not None and path.suffix.lower() != ".toml":
            name = path.resolve().parent.name if path.name == "morphology.json" else path.stem
            variants.append(Variant(name, load_spec(None), Morphology.load(path)))
            continue
        spec, source = load_spec(path), [] if path is None else [path.stem]
        for combination in itertools.product(*varied):
            tables = defaultdict[str, dict[str, Any]](dict)
            for section, key, value in combination:
                tables[section][key] = value
            labels = [f"{key} {str(value).strip('()').replace(', ', ' x ')}" for _, key, value in combination]
            stated = spec.replaced(tables, f"{spec.source} with --vary" if varied else "")
            varied_spec = cast_as_contact(stated, tables["contact"])
            variants.append(Variant(", ".join([*source, *labels]) or "defaults", varied_spec))
    folders = [variant.folder.casefold() for variant in variants]  # macOS and Windows ignore case
    if len(set(folders)) < len(folders):
        raise InputError(f"{max(folders, key=folders.count)}: two pads have this name, expected different names")
    if not 2 <= len(variants) <= MAX_VARIANTS:
        advice = "name settings or morphologies, or vary a setting with --vary"
        raise InputError(f"pads to compare are {len(variants)}, allowed are 2 to {MAX_VARIANTS}: {advice}")
    for variant in variants:  # refuse invalid settings before minutes are spent on another variant
        for model in (PadSettings, SearchSettings, RulesSettings):
            variant.spec.section(model)
    return variants


def _parse_varied(text: str) -> list[tuple[str, str, Any]]:
    """Parse `section.key=value,value` into (section, key, value) triples."""
    key, equals, values_text = text.partition("=")
    section, dot, name = key.strip().partition(".")
    try:
        values = tomllib.loads(f"values = [{values_text}]")["values"]
    except ValueError as error:
        raise InputError(f"--vary is {short_repr(text)}, its values are not TOML ({error})") from error
    if not (equals and dot and name and values):
        raise InputError(f"--vary is {short_repr(text)}, expected SECTION.KEY=VALUE,VALUE such as pad.grid=3,4")
    if section not in (allowed := [model.section() for model in MODELS]):
        raise InputError(f"--vary is {short_repr(text)}: unknown section, allowed are {', '.join(allowed)}")
    return [(section, name, tuple(value) if isinstance(value, list) else value) for value in values]


def compare(
    variants: Sequence[Variant], out: Path, options: SearchOptions, seed: int | None, make_pad: MakePad
) -> dict[str, Any]:
    """Design and make every variant in its own folder, evaluate it, and write comparison.json and comparison.png.

    Each pad and straight fibres of its layout are evaluated by their expected errors (`errors_by_contact`) on the
    pad's own sensed area, under its own contact and under the others that a search for it serves. Returned is the
    document, with a row for each variant. KeyboardInterrupt is raised if a search was interrupted; the finished pads
    are in their folders then.
    """
    rows = []
    for variant in variants:
        folder, pad = out / variant.folder, variant.pad
        if pad is None:
            on_progress = _name_progress(options.on_progress, variant.name)
            named = replace(options, on_progress=on_progress)
            _, result = run_design(variant.spec, folder, {"seed": seed}, options=named)
            if result.stopped == "interrupted":
                raise KeyboardInterrupt  # ends the comparison, not only this search
            pad = result.morphology
        rows.append(_evaluate(variant, pad, seed) | dict(make_pad(pad, variant.spec, folder)))
    document = {"format": FORMAT, "rows": rows, "provenance": provenance("padforge design compare", seed)}
    write_json(out / NAME, document)
    _draw_comparison(rows, out / "comparison.png")
    return document


def _name_progress(on_progress: OnProgress, name: str) -> OnProgress:
    """Return a callback that puts a name before each message."""
    return lambda done, total, what: on_progress(done, total, f"{name}, {what}")


def _evaluate(variant: Variant, pad: Morphology, seed: int | None) -> dict[str, Any]:
    search = variant.spec.section(SearchSettings, seed=seed)
    pad_settings = variant.spec.section(PadSettings, **pad.layout.settings)
    contact = design_contact(variant.spec, search)
    with stage("compare"):
        contacts = served_contacts(contact, search)
        errors_mm = errors_by_contact(beside_straight(pad), contacts, pad_settings, search)
    main, *others = contacts
    straight = Morphology.straight(pad.layout)
    return {
        "name": variant.name,
        "fibres": list(pad.layout.counts),
        "pitch_mm": pad.pitch_mm,
        "knots": pad.knots.shape[1] - 2,
        "length_mm": float(lengths(pad).sum() * pad.unit_mm),
        "crossings": len(crossings(pad)),
        "straight_length_mm": float(lengths(straight).sum() * pad.unit_mm),
        "straight_crossings": len(crossings(straight)),
        "errors_mm": errors_mm[main, "designed"],
        "straight_mm": errors_mm[main, "straight"],
        "others": {
            name: {"errors_mm": errors_mm[name, "designed"], "straight_mm": errors_mm[name, "straight"]}
            for name in others
        },
        "contact": contact.model_dump(mode="json"),
    } | ({} if contact.model == "shape" else {"half_width_mm": half_width_mm(contact)})


def comparison_lines(document: Mapping[str, Any]) -> list[str]:
    """Format a comparison as two tables of text, of costs and of errors, within 100 columns for short names.

    In the first, `width` is the half width of a press, `strain` the greatest stretch of a fibre under it, `cast` the
    volume of silicone, and `faults` the number of failed checks of the mould. In the second, a pad that differs from
    straight fibres is followed by the errors of straight fibres, and by those of both under other contacts.
    """
    rows = document["rows"]
    costs = {key: heads for key, heads in COSTS.items() if any(key in row for row in rows)}
    names, units = zip(("fibre", "m"), ("crossings", ""), *costs.values(), strict=True)
    table = [["pad", "fibres", "knots", *names], ["", "", "", *units]]
    n_errors = max(len(row["errors_mm"]) for row in rows)
    errors = [["error (mm) with failed fibres", *map(str, range(n_errors))]]
    for row in rows:
        cells = [row["name"], "{} + {}".format(*row["fibres"]), str(row["knots"]), f"{row['length_mm'] / 1000:.2f}"]
        table.append([*cells, str(row["crossings"]), *(f"{row[key]:.3g}" if key in row else "-" for key in costs)])
        errors.append([row["name"], *(f"{error:.2f}" for error in row["errors_mm"])])
        if row["errors_mm"] != row["straight_mm"]:
            cells = ["  straight fibres", "", "", f"{row['straight_length_mm'] / 1000:.2f}"]
            table.append([*cells, str(row["straight_crossings"]), *[""] * len(costs)])
            errors.append(["  straight fibres", *(f"{error:.2f}" for error in row["straight_mm"])])
            for contact, other in row["others"].items():
                pairs = zip(other["errors_mm"], other["straight_mm"], strict=True)
                errors.append([f"  {contact}", *(f"{a:.2f} / {b:.2f}" for a, b in pairs)])
    return [*text_table(table), "", *text_table(errors)]


def _draw_comparison(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw errors over the number of failed fibres, and errors with none and with most failed over fibre length."""
    figure, _ = new_figure(9.6, 4.2)
    figure.clear()
    by_failures, by_length = figure.subplots(1, 2)
    for colour, row in zip(itertools.cycle(CURVES), rows, strict=False):
        errors, length_m = row["errors_mm"], row["length_mm"] / 1000
        by_failures.plot(range(len(errors)), errors, "o-", color=colour, label=row["name"])
        by_failures.plot(range(len(errors)), row["straight_mm"], ":", color=colour, linewidth=1)
        by_length.plot([length_m, length_m], [errors[0], errors[-1]], "-", color=colour, alpha=0.4)
        by_length.plot([length_m], errors[:1], "o", color=colour)
        by_length.plot([length_m], errors[-1:], "s", color=colour, markerfacecolor="none")
    for axes in (by_failures, by_length):
        style_axes(axes)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        axes.set_ylim(bottom=0)
        axes.set_ylabel("mean error (mm)")
    by_failures.set(xlabel="failed fibres", xticks=range(max(len(row["errors_mm"]) for row in rows)))
    by_length.set_xlabel("length of fibre (m)")
    add_caption(by_failures, "lines: as designed; dotted: straight fibres")
    add_caption(by_length, "dot: no failed fibres; square: most failed fibres")
    by_failures.legend(frameon=False, fontsize=8)
    add_title(figure, "Cost and localisation error of pads")
    save_figure(figure, path)
