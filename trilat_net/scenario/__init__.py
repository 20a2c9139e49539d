"""Scenarios: experiments, typed, frozen and validated.

Invariant: a scenario that loads also runs; every mistake that a person can make is refused here, with the
path of the key and the nearest valid name.
"""

from ..deprecated import lookup_of
from .delay_models import Link
from .expect import Expect
from .laws import Adaptive, ProportionalDamped
from .operators import Pulse
from .override import apply_overrides
from .run_changes import (
    find_owner,
    initial_link_tables,
    parse_core_change,
    resolve_change,
    scheduled_link_tables,
    to_core_change,
)
from .scenario_reader import (
    find_site,
    list_shipped,
    load_scenario,
    parse_embedded,
    parse_scenario,
    read_shipped,
    read_template,
)
from .scenario_types import Arm, Limits, OnStale, Scenario, SiteSpec

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
    "apply_overrides",
    "find_owner",
    "find_site",
    "initial_link_tables",
    "list_shipped",
    "load_scenario",
    "parse_core_change",
    "parse_embedded",
    "parse_scenario",
    "read_shipped",
    "read_template",
    "resolve_change",
    "scheduled_link_tables",
    "to_core_change",
]

__getattr__ = lookup_of("scenario")
