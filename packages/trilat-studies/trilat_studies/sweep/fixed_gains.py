"""Lists the gains that a parameter sweep did not vary, as a note for its figures.

A stability map over two parameters also depends on all the gains that were the same in every
run, and could not be reproduced without them. A typical entry of the list is "p_d of s: K 10,
gravity 1".

Invariant:
    - A gain is listed unless an axis of the sweep changes it for every arm. The defaults of a
      user's law are listed too.
"""

from collections.abc import Iterator

from trilat_net.scenario import Scenario

from .sweep_plan import SweepPlan

FAIR_COMPARISON = "to compare laws at their best gains, use: trilat compare --tune"
"""Advice that is printed below a sweep that compares control laws."""


def describe_fixed_gains(plan: SweepPlan) -> list[str]:
    """Lists the gains that affect the results of a sweep but were not varied.

    A typical entry is "p_d of s: K 10, gravity 1". Sites with the same law and gains share one
    entry. An entry that applies to all sites does not name a site.

    Args:
        plan: The sweep.
    """
    texts = list[str]()
    first_values = [axis.override(0) for axis in plan.axes]
    for law_overrides in plan.laws.values() or [()]:
        scenario = plan.scenario(*law_overrides, *first_values)
        texts += _describe_laws(plan, scenario)
    return list(dict.fromkeys(texts))


def _describe_laws(plan: SweepPlan, scenario: Scenario) -> Iterator[str]:
    """Yields one string per control law of the sweep, with the gains that are not swept.

    Args:
        plan: The sweep.
        scenario: Scenario of the sweep with one of its laws.
    """
    sites_of_law: dict[tuple[str, str], list[str]] = {}
    for site, spec in scenario.sites.items():
        law = spec.law_name
        gain_texts = _format_gains(plan, scenario, site)
        gains = ", ".join(gain_texts) or "none"
        sites = sites_of_law.setdefault((law, gains), [])
        sites.append(site)

    for (law, gains), sites in sites_of_law.items():
        owner = law
        if len(sites) < len(scenario.sites):
            site_names = ", ".join(sites)
            owner = f"{law} of {site_names}"
        yield f"{owner}: {gains}"


def _format_gains(plan: SweepPlan, scenario: Scenario, site: str) -> Iterator[str]:
    """Yields the gains of a site that the sweep does not vary, with their values.

    Args:
        plan: The sweep.
        scenario: Scenario of the sweep with one of its laws.
        site: Name of the site.
    """
    swept_keys = {axis.key for axis in plan.axes}
    gains = scenario.sites[site].describe_gains(with_defaults=True)
    for key, text in gains.items():
        common_key = f"control.{key}"
        site_key = f"sites.{site}.control.{key}"
        is_swept = common_key in swept_keys or site_key in swept_keys
        if not is_swept:
            yield f"{key} {text}"
