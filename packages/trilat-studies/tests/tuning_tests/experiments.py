"""A scenario that takes milliseconds: three sites, two seconds, 100 Hz."""

from pathlib import Path

from trilat_studies.tuning import TuningPlan, plan_tuning
from trilat_studies.tuning.tuning_plan import ObjectivePoint

from trilat_net.scenario import Scenario, parse_scenario

TRIO = """
name = "trio"
rate_hz = 100
duration_s = 2.0
[limits]
tau_limit_nm = 60.0
[link]
delay_ms = 50.0
[sites.m1]
role = "master"
q0_rad = [0.3, -0.2]
[sites.m2]
role = "master"
q0_rad = [-0.2, 0.4]
[sites.s]
role = "slave"
q0_rad = [0.1, 0.1]
[dominance]
m1 = { m2 = 0.2, s = 0.8 }
m2 = { m1 = 0.5, s = 0.5 }
s = { m1 = 0.6, m2 = 0.4 }
"""


def trio(*overrides: str) -> Scenario:
    return parse_scenario(TRIO, overrides=overrides)


def plan_quick_tuning(
    folder: Path, *overrides: str, text: str = TRIO, **settings: object
) -> TuningPlan:
    """Returns a request for a comparison in the quick scenario, as a file."""
    path = folder / "trio.toml"
    path.write_text(text)
    return plan_tuning(path, overrides, **settings)  # type: ignore[arg-type]


def dominates(a: ObjectivePoint, b: ObjectivePoint) -> bool:
    """True if a is no worse than b in both objectives, and better in one."""
    return a[0] <= b[0] and a[1] <= b[1] and a != b
