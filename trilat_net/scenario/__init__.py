"""Scenarios: what an experiment is, typed, frozen and validated.

Law: a scenario that loads is one that runs; everything that a person can get wrong is refused here, with
the path of the key and the nearest valid name.
"""

from .model import Arm, Control, Limits, Link, Pulse, Scenario, SiteSpec
from .reader import load, override, parse, shipped, shipped_text, site_named, template_text

__all__ = [
    "Arm",
    "Control",
    "Limits",
    "Link",
    "Pulse",
    "Scenario",
    "SiteSpec",
    "load",
    "override",
    "parse",
    "shipped",
    "shipped_text",
    "site_named",
    "template_text",
]
