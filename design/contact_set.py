"""The contacts that a pad may really meet: those that a search serves, and those that a finished pad is judged by."""

from padforge.design.contact import half_width_mm, widened
from padforge.design.settings import MEASURED_STD_MM, PUBLISHED_CONTACT, Contact, SearchSettings

UNCERTAINTY = 0.1
"""Relative uncertainty of the width of a measured profile: profiles from parts of one recording differ by as much."""


def served_contacts(assumed: Contact, search: SearchSettings) -> dict[str, Contact]:
    """Return the contacts that a search serves, by name, the assumed one first."""
    others: dict[str, Contact] = {}
    if search.contacts == "plausible":
        others = _plausible_contacts(assumed)
    elif search.contacts != "assumed":
        others = {f"contact {number} of [search]": contact for number, contact in enumerate(search.contacts, 1)}
    return {"as assumed": assumed} | {name: other for name, other in others.items() if other != assumed}


def _plausible_contacts(assumed: Contact) -> dict[str, Contact]:
    """Return contacts that the assumed one may turn out to be.

    - Of a layer, the least certain part is how much a press stretches fibres: on the built pad an isotropic profile
      explains the responses as well as a layer does. So the others are the measured isotropic profile at 0.75 and at
      1.25 of its width, in proportion to the width of the layer. Fibres that are only pressed flat respond in between.
    - A profile was measured, so only its width is uncertain.
    - A shape is a convention and has no others.
    """
    if assumed.model == "layer":
        scale = half_width_mm(assumed) / half_width_mm(Contact())
        return {
            f"isotropic, {half_width_mm(profile):.2g} mm": profile
            for profile in (widened(Contact(model="profile"), scale * factor) for factor in (0.75, 1.25))
        }
    if assumed.model == "profile":
        factors = {"narrower": 1 - UNCERTAINTY, "wider": 1 + UNCERTAINTY}
        return {f"{UNCERTAINTY:.0%} {name}": widened(assumed, factor) for name, factor in factors.items()}
    return {}


def judged_contacts(assumed: Contact, search: SearchSettings) -> dict[str, Contact]:
    """Return the contacts that a pad is judged by, by name: those that a search serves, and others; none twice.

    Beside a layer the others are a tool of half the radius, a press of half the depth, and fibres that respond only to
    being pressed flat. Beside another contact they are Gaussian profiles of three widths, and the published shape.
    """
    if assumed.model == "layer":
        tool_mm, depth_mm = assumed.tool_radius_mm / 2, assumed.depth_mm / 2
        changes: dict[str, dict[str, float]] = {
            f"tool of {tool_mm:g} mm": {"tool_radius_mm": tool_mm},
            f"{depth_mm:g} mm deep": {"depth_mm": depth_mm},
            "pressed flat alone": {"squeeze": 1.0, "stretch": 0.0},
        }
        others = {name: Contact(**assumed.model_dump() | change) for name, change in changes.items()}
    else:
        others = {
            f"profile of {std:g} mm": widened(Contact(model="profile"), std / MEASURED_STD_MM)
            for std in (5.0, MEASURED_STD_MM, 7.9)
        }
        others["published disc, K = 0.6"] = PUBLISHED_CONTACT
    served = served_contacts(assumed, search)
    return served | {name: other for name, other in others.items() if other not in served.values()}
