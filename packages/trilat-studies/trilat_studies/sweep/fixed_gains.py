"""Lists the gains that a parameter sweep did not vary, as a note for its figures.

A stability map over two parameters also depends on all gains that were the same in every run.
Without these gains, the map could not be reproduced. An entry of the list is, for example, "p_d
of s: K 10, gravity 1".

Invariant:
    - A gain is named unless an axis of the sweep changes it for every arm. The defaults of a
      user's law are named too.
"""

import ast
from collections.abc import Iterator
from typing import Any

import msgspec

from trilat_net.errors import ScenarioError
from trilat_net.own_code import ImportedLaw, read_code
from trilat_net.scenario import Scenario, describe_value

from .sweep_plan import SweepPlan

FAIR_COMPARISON = "to compare laws at their best gains, use: trilat compare --tune"
"""Advice that is printed below a comparison of control laws by a sweep."""


def describe_fixed_gains(plan: SweepPlan) -> list[str]:
    """Lists the gains that a sweep did not vary, but on which its results also depend.

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
    """Yields one text for each control law of a sweep, with the gains that are not swept.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        scenario: Scenario of the sweep with one of its laws.
    """
    sites_of_law: dict[tuple[str, str], list[str]] = {}
    for site, spec in scenario.sites.items():
        law = spec.law_name
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
    """Yields the control gains that a parameter sweep leaves unchanged, with their values.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        site: Name of the site.
        law: Control law of the site.
    """
    if isinstance(law, ImportedLaw):
        settings = _read_default_settings(law) | law.settings
    else:
        settings = msgspec.to_builtins(law)
    swept_keys = {axis.key for axis in plan.axes}
    for key, value in settings.items():
        common_key = f"control.{key}"
        site_key = f"sites.{site}.control.{key}"
        is_swept = common_key in swept_keys or site_key in swept_keys
        if key != "law" and not is_swept:
            yield f"{key} {describe_value(value)}"


def _read_default_settings(law: ImportedLaw) -> dict[str, Any]:
    """Returns the defaults of the arguments of a user's law, which the scenario does not state.

    They are read from the file of the law, which is not run. Defaults that are not written out
    as literals are given as their Python text.

    Args:
        law: The law.

    Returns:
        Defaults by the name of the argument. Empty if the file is missing, has changed since
        the sweep was planned, or does not define the arguments.
    """
    try:
        source = read_code(law.code, "control.law")
    except ScenarioError:
        return {}
    if source.sha256 != law.source_sha256:
        return {}
    tree = ast.parse(source.content)
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    law_class = classes.get(law.code.partition(":")[2])
    while law_class is not None:
        for member in law_class.body:
            if isinstance(member, ast.FunctionDef) and member.name == "__init__":
                return _list_defaults(member.args)
        # The class may have the arguments of a base class, which stands before it in the file.
        bases = [base.id for base in law_class.bases if isinstance(base, ast.Name)]
        law_class = classes.pop(bases[0], None) if bases else None
    return {}


def _list_defaults(arguments: ast.arguments) -> dict[str, Any]:
    """Returns the default values of a Python function's arguments, by name.

    Args:
        arguments: The arguments, as Python's parser returns them.
    """
    positional = [*arguments.posonlyargs, *arguments.args]
    # Only the last of the positional arguments have defaults.
    first = len(positional) - len(arguments.defaults)

    pairs = [
        *zip(positional[first:], arguments.defaults, strict=True),
        *zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True),
    ]

    defaults = {}
    for argument, value in pairs:
        if value is None:  # an argument without a default
            continue
        try:
            defaults[argument.arg] = ast.literal_eval(value)
        except ValueError:
            defaults[argument.arg] = ast.unparse(value)
    return defaults
