"""Scenarios: what an experiment is, typed, frozen and validated.

Law: a scenario that loads is one that runs; everything that a person can get wrong is refused here, with
the path of the key and the nearest valid name.
"""

from .actors import Pulse
from .commands import command, command_from, later_tables, owner, present_links, resolve_change
from .expectation import Expect
from .laws import Adaptive, ProportionalDamped
from .links import Link
from .model import Scenario
from .reader import embedded, load, override, parse, shipped, shipped_text, site_named, template_text
from .site import Arm, Limits, OnStale, SiteSpec

__all__ = [
    "Adaptive",
    "Arm",
    "Expect",
    "Limits",
    "Link",
    "OnStale",
    "ProportionalDamped",
    "Pulse",
    "Scenario",
    "SiteSpec",
    "command",
    "command_from",
    "embedded",
    "later_tables",
    "load",
    "override",
    "owner",
    "parse",
    "present_links",
    "resolve_change",
    "shipped",
    "shipped_text",
    "site_named",
    "template_text",
]
