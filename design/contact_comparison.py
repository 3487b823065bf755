"""Sensitivity of expected errors to the contact model, written to `contacts.json`."""

from collections.abc import Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from padforge.common.files import provenance, write_json
from padforge.common.parallel import run_tasks
from padforge.common.profiling import stage
from padforge.common.settings import Spec
from padforge.design.contact_set import judged_contacts
from padforge.design.morphology import Morphology
from padforge.design.objectives.bayes_error import expected_errors
from padforge.design.settings import Contact, PadSettings, SearchSettings, read_contact

FORMAT, NAME = "padforge-contacts/1", "contacts.json"


def errors_by_contact(
    pads: Mapping[str, Morphology], contacts: Mapping[str, Contact], pad_settings: PadSettings, search: SearchSettings
) -> dict[tuple[str, str], list[float]]:
    """Compute the expected errors of pads of one layout under every contact, with the same random numbers.

    Errors, in mm, are with 0, 1, ... fibres failed, by the names of contact and pad.
    """
    names = list(product(contacts, pads))
    with threadpool_limits(1, "blas"):  # else the first task to end lifts the limit that the others run under
        tasks = (((c, p), partial(expected_errors, pads[p], contacts[c], search, pad_settings)) for c, p in names)
        errors = dict(run_tasks(tasks))
    return {(c, p): [pads[p].unit_mm * error for error in errors[c, p]] for c, p in names}


def beside_straight(pad: Morphology) -> dict[str, Morphology]:
    """Return a pad, "designed", and straight fibres of its layout, by name."""
    return {"designed": pad, "straight": Morphology.straight(pad.layout)}


def design_contact(spec: Spec, settings: SearchSettings) -> Contact:
    """Return the contact to design for: the one that `spec` states, or the default of the search method."""
    is_default = settings.method == "genetic" and not spec.stated(Contact)
    return settings.default_contact if is_default else read_contact(spec)


def compare_contacts(spec: Spec, pad: Morphology, out: Path, seed: int | None = None) -> dict[str, Any]:
    """Write and return the errors of a pad and of straight fibres under the contact of `spec` and others."""
    settings = spec.section(SearchSettings, seed=seed)
    pad_settings = spec.section(PadSettings, **pad.layout.settings)
    contacts = judged_contacts(design_contact(spec, settings), settings)
    with stage("contacts"):
        errors = errors_by_contact(beside_straight(pad), contacts, pad_settings, settings)
    rows = [{"contact": contact, "pad": name, "errors_mm": values} for (contact, name), values in errors.items()]
    document = {
        "format": FORMAT,
        "scatter": settings.response_scatter._asdict(),
        "rows": rows,
        "provenance": provenance("padforge run", settings.seed, [out / "morphology.json"]),
    }
    write_json(out / NAME, document)
    return document
