"""Describes the gains of a sweep's control laws that were not swept: a map depends on them too.

Invariant:
    - A gain is named unless an axis of the sweep changes it at every site.
"""

from collections.abc import Iterator
from typing import Any

import msgspec

from ...scenario import Scenario
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
        texts += _describe_laws(plan, scenario)
    return list(dict.fromkeys(texts))


def _describe_laws(plan: SweepPlan, scenario: Scenario) -> Iterator[str]:
    """Yields a text per law and choice of gains in a scenario of the sweep."""
    sites_of: dict[tuple[str, str], list[str]] = {}
    for site, spec in scenario.sites.items():
        law = identify_law(spec.control)
        gains = ", ".join(_format_gains(plan, site, spec.control)) or "none"
        sites_of.setdefault((law, gains), []).append(site)
    for (law, gains), sites in sites_of.items():
        owner = law
        if len(sites) < len(scenario.sites):
            owner = f"{law} of {', '.join(sites)}"
        yield f"{owner}: {gains}"


def _format_gains(plan: SweepPlan, site: str, law: Any) -> Iterator[str]:
    """Yields the gains of a site's law that no axis changes, each with its value."""
    settings = law.settings if isinstance(law, ImportedLaw) else msgspec.to_builtins(law)
    swept_keys = {axis.key for axis in plan.axes}
    for key, value in settings.items():
        common_key = f"control.{key}"
        site_key = f"sites.{site}.control.{key}"
        is_swept = common_key in swept_keys or site_key in swept_keys
        if key != "law" and not is_swept:
            yield f"{key} {describe_value(value)}"
