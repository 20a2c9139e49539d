"""The gains of the control laws of a sweep that were not swept: what a picture of it depends on
besides.

Invariant: a gain is named unless an axis of the sweep changes it at every site.
"""

from collections.abc import Iterator
from typing import Any

import msgspec

from ...scenario.describe import describe_value
from ...scenario.imported_code import ImportedLaw
from ...scenario.laws import identify_law
from .sweep_plan import SweepPlan

FAIR_COMPARISON = "laws at their best gains compare fairly by: trilat compare --tune"
"""Where a sweep leads whoever wants to know which law is better."""


def describe_fixed_gains(plan: SweepPlan) -> list[str]:
    """Returns for each law the gains that were not swept, in words, as in "p_d of s: K 10,
    gravity 1".

    Sites with the same gains share a text, and a text for all sites names none.
    """
    texts: dict[str, None] = {}
    for fixed in plan.laws.values() or [()]:
        first = [axis.override(0) for axis in plan.axes]
        scenario = plan.scenario(*fixed, *first)
        owners: dict[str, list[str]] = {}
        for site, spec in scenario.sites.items():
            gains = ", ".join(_format_gains(plan, site, spec.control))
            owners.setdefault(f"{identify_law(spec.control)}: {gains or 'none'}", []).append(
                site
            )
        for text, sites in owners.items():
            law, _, gains = text.partition(": ")
            of_sites = "" if len(sites) == len(scenario.sites) else f" of {', '.join(sites)}"
            texts[f"{law}{of_sites}: {gains}"] = None
    return list(texts)


def _format_gains(plan: SweepPlan, site: str, law: Any) -> Iterator[str]:
    """Yields the gains of a site's law, each with its value, without those that an axis
    changes.
    """
    table = law.settings if isinstance(law, ImportedLaw) else msgspec.to_builtins(law)
    swept = {axis.key for axis in plan.axes}
    for key, value in table.items():
        paths = (f"control.{key}", f"sites.{site}.control.{key}")
        if key != "law" and not swept & {*paths}:
            yield f"{key} {describe_value(value)}"
