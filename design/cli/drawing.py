"""`padforge design import`: fibres that were drawn elsewhere become a morphology."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from padforge.design.common.command_line import (
    force_option,
    json_option,
    load_spec,
    out_option,
    pad_folder,
    show_result,
    spec_option,
)


@click.command("import")
@click.argument("plan", type=click.Path(dir_okay=False, path_type=Path))
@spec_option
@click.option(
    "--tolerance-mm",
    type=click.FloatRange(1e-3, 10),
    default=0.05,
    show_default=True,
    help="How far fibres and their ends may be off what is drawn.",
)
@out_option()
@force_option
@json_option
@click.pass_context
def import_(
    context: click.Context,
    plan: Path,
    spec: Path | None,
    tolerance_mm: float,
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Take fibres from a drawing, .svg or .dxf, one curve each; exit 1 if they break a rule.

    \b
    padforge design import plan.svg                      into out/plan/morphology.json
    padforge design import plan.dxf --tolerance-mm 0.2 --out out/pad

    [pad] of the settings says which fibres there are and where they end. Taken are curves in layers or groups whose
    names begin with fibre, horizontal or vertical, else all open ones; what is named pad is its border.
    """
    from padforge.design.common.files import check_replaceable, provenance, staged
    from padforge.design.criteria.rules import check_rules
    from padforge.design.pad.courses.drawings.plan import import_plan
    from padforge.design.pad.morphology import Morphology
    from padforge.design.settings import PadSettings, RulesSettings

    settings = load_spec(spec)
    size, rules = settings.section(PadSettings), settings.section(RulesSettings)
    found = import_plan(plan, size.layout, tolerance_mm)
    made_by: dict[str, Any] = provenance(
        "padforge design import", None, [plan], packages=("ezdxf", "lxml", "fonttools")
    )
    made_by["settings"] = {"pad": size.model_dump(mode="json"), "tolerance_mm": tolerance_mm}
    folder = out or pad_folder(plan)
    with staged(folder) as together:
        Morphology.of_layout(found.pad.knots, size.layout, made_by).save(together / "morphology.json")
        check_replaceable(folder / "morphology.json", together / "morphology.json", force=force)
    broken = check_rules(found.pad, rules, size)
    fibres = [{"fibre": number, **asdict(fibre)} for number, fibre in enumerate(found.fibres, 1)]
    knots = found.pad.knots.shape[1] - 2
    lines = [
        f"import: {len(fibres)} fibres of {knots} knots -> {folder / 'morphology.json'}",
        f"  {found.placed}",
        *(
            f"  fibre {each['fibre']}: {each['name']}, within {each['off_mm']:.3f} mm"
            + (f", ends moved by {each['moved_mm']:.3f} mm" if each["moved_mm"] >= 5e-4 else "")
            for each in fibres
        ),
        *([f"  broken  {violation}" for violation in broken] or ["  all rules hold"]),
    ]
    document = {"fibres": fibres, "knots": knots, "placed": found.placed, "violations": list(map(asdict, broken))}
    show_result(document, lines, as_json)
    context.exit(1 if broken else 0)
