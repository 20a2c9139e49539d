"""Lists the gains of control laws that stay the same in all runs of a parameter sweep.

A sweep runs a scenario with many combinations of parameters. Its result is often shown as a
stability map, which marks the combinations with which the arms are stable. These results also
depend on the gains that the sweep did not vary, so reports and figures of a sweep state them.

Invariant:
    - A gain is named unless an axis of the sweep changes it at every site, which is the process
      that runs one arm.
"""

from collections.abc import Iterator
from typing import Any

import msgspec

from trilat_net.own_code import ImportedLaw
from trilat_net.scenario import Scenario, describe_value, identify_law

from .sweep_plan import SweepPlan

FAIR_COMPARISON = "laws at their best gains compare fairly by: trilat compare --tune"
"""Advice that is printed below a comparison of control laws by a sweep."""


def describe_fixed_gains(plan: SweepPlan) -> list[str]:
    """Lists the gains that a sweep did not vary, on which its results depend, too.

    An entry is a text such as "p_d of s: K 10, gravity 1". Sites with the same law and the same
    gains share a string. A string that applies to all sites names no site.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
    """
    texts = list[str]()
    first_values = [axis.override(0) for axis in plan.axes]
    for law_overrides in plan.laws.values() or [()]:
        scenario = plan.scenario(*law_overrides, *first_values)
        texts += _describe_laws(plan, scenario)
    return list(dict.fromkeys(texts))


def _describe_laws(plan: SweepPlan, scenario: Scenario) -> Iterator[str]:
    """Yields one text for each combination of a law and its gains in a scenario.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        scenario: Scenario of the sweep with one of its laws.
    """
    sites_of_law: dict[tuple[str, str], list[str]] = {}
    for site, spec in scenario.sites.items():
        law = identify_law(spec.control)
        gain_texts = _format_gains(plan, site, spec.control)
        gains = ", ".join(gain_texts) or "none"
        sites = sites_of_law.setdefault((law, gains), [])
        sites.append(site)
    for (law, gains), sites in sites_of_law.items():
        owner = law
        if len(sites) < len(scenario.sites):
            site_names = ", ".join(sites)
            owner = f"{law} of {site_names}"
        yield f"{owner}: {gains}"


def _format_gains(plan: SweepPlan, site: str, law: Any) -> Iterator[str]:
    """Yields the gains of a site's law that no axis of the sweep changes, with their values.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        site: Name of the site.
        law: Control law of the site.
    """
    settings = law.settings if isinstance(law, ImportedLaw) else msgspec.to_builtins(law)
    swept_keys = {axis.key for axis in plan.axes}
    for key, value in settings.items():
        common_key = f"control.{key}"
        site_key = f"sites.{site}.control.{key}"
        is_swept = common_key in swept_keys or site_key in swept_keys
        if key != "law" and not is_swept:
            yield f"{key} {describe_value(value)}"
