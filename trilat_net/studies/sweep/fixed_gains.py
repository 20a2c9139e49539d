"""Describes the gains of a sweep's control laws that were not swept: a map depends on them too.

Invariant:
    - A gain is named unless an axis of the sweep changes it at every site.
"""

from collections.abc import Iterator
from typing import Any

import msgspec

from ...scenario.describe import describe_value
from ...scenario.imported_code import ImportedLaw
from ...scenario.laws import identify_law
from .sweep_plan import SweepPlan

FAIR_COMPARISON = "laws at their best gains compare fairly by: trilat compare --tune"
"""Advice under a comparison of laws by a sweep."""


def describe_fixed_gains(plan: SweepPlan) -> list[str]:
    """Returns the gains that were not swept, a text per law, as in "p_d of s: K 10, gravity 1".

    Sites with the same law and gains share a text. A text that applies to all sites names no
    site.
    """
    texts = list[str]()
    first_values = [axis.override(0) for axis in plan.axes]
    for law_overrides in plan.laws.values() or [()]:
        scenario = plan.scenario(*law_overrides, *first_values)
        sites_of: dict[tuple[str, str], list[str]] = {}
        for site, spec in scenario.sites.items():
            gains = ", ".join(_format_gains(plan, site, spec.control)) or "none"
            law = identify_law(spec.control)
            sites_of.setdefault((law, gains), []).append(site)
        for (law, gains), sites in sites_of.items():
            shared = len(sites) == len(scenario.sites)
            owner = law if shared else f"{law} of {', '.join(sites)}"
            texts.append(f"{owner}: {gains}")
    return list(dict.fromkeys(texts))


def _format_gains(plan: SweepPlan, site: str, law: Any) -> Iterator[str]:
    """Yields the gains of a site's law that no axis changes, each with its value."""
    settings = law.settings if isinstance(law, ImportedLaw) else msgspec.to_builtins(law)
    swept_keys = {axis.key for axis in plan.axes}
    for key, value in settings.items():
        paths = {f"control.{key}", f"sites.{site}.control.{key}"}
        if key != "law" and not swept_keys & paths:
            yield f"{key} {describe_value(value)}"
