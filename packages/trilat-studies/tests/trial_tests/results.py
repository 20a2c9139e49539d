"""A scenario that takes milliseconds, and figures and results as a trial would return them."""

from typing import Any

import msgspec
from trilat_studies.measure_run import ExpectationResult, LinkAge, RunMetrics
from trilat_studies.trials import Trial, TrialResult

from trilat_net.analysis.run_end import EndBehaviour, RunEnd
from trilat_net.analysis.twins.envelope_trend import EnvelopeFit, EnvelopeTrend
from trilat_net.own_code.code_consent import allow_own_code
from trilat_net.scenario import Scenario, parse_scenario

QUICK = """
name = "quick"
rate_hz = 100
duration_s = 0.5
[link]
model = "uniform"
delay_ms = 60.0
half_width_ms = 60.0
[sites.m]
role = "master"
q0_rad = [0.3, 0.0]
[sites.s]
role = "slave"
[dominance]
m = { s = 1.0 }
s = { m = 1.0 }
[expect]
peak_error_max_rad = 2.0
mean_age_max_ms = 100.0
"""
"""Two sites, half a second, a link on which every seed gives another run."""

TOO_MUCH = {"expect.mean_age_max_ms": 1.0}
"""An override that nothing meets."""

FIT = EnvelopeFit(EnvelopeTrend.DECAYS, -0.2)
CALM = RunMetrics(
    simulated_s=20.0,
    end=RunEnd(EndBehaviour.DECAYS, FIT, FIT, 0.003, 0.02),
    synchronised_at_s=11.0,
    peak_error_rad=0.9,
    rms_error_rad=0.1,
    end_error_rad=0.003,
    end_spread_rad=0.002,
    end_pose_rad={"m1": (0.1, 0.2), "m2": (0.1, 0.2), "s": (0.1, 0.2)},
    peak_torque_nm=50.0,
    peak_speed_rad_s=1.5,
    ages={"m1->s": LinkAge(200.0, 210.0), "m2->s": LinkAge(100.0, 110.0)},
    late_samples=3,
    missing=2,
)


def figures(**changes: Any) -> RunMetrics:
    return msgspec.structs.replace(CALM, **changes)


def quick(**overrides: Any) -> Scenario:
    return allow_own_code(parse_scenario(QUICK, "quick", overrides))


def result(
    seed: int, *outcomes: ExpectationResult, error: str = "", source: str = "quick.toml"
) -> TrialResult:
    return TrialResult(Trial(quick(seed=seed), source), list(outcomes), 20.0, 0.5, error)
