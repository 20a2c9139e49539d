"""Runs of every kind that a report must show, from all delay models and laws to logs without a record."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import trilat_net
from tests.analysis.builders import make_busy_run, make_diverged_log, make_run, make_short_log
from tests.control_laws.law_settings import LAWS as PLUGGED_LAWS
from tests.core.guarded_runs import make_guarded_scenario, make_stopped_log
from tests.log.builders import add_clock_readings, open_bytes, rewrite_log
from tests.scenario.builders import planar_task_text, posed_task_text, six_joint_text
from tests.sites.sessions import make_gliding_scenario, run_session
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, list_shipped, load_scenario, parse_scenario

MakeLog = Callable[[], Log]

LINKS: dict[str, dict[str, Any]] = {
    "none": {},
    "constant": {"delay_ms": 120.0},
    "uniform": {"delay_ms": 80.0, "half_width_ms": 40.0},
    "normal": {"delay_ms": 80.0, "deviation_ms": 15.0},
    "gamma": {"delay_ms": 80.0, "deviation_ms": 30.0, "loss": 0.1, "loss_burst": 4.0},
    "lognormal": {"delay_ms": 80.0, "deviation_ms": 30.0, "order": "in_order"},
    "hyperexponential": {
        "floor_ms": 30.0,
        "fast_ms": 5.0,
        "slow_ms": 200.0,
        "slow_share": 0.02,
    },
    "ar1": {"delay_ms": 80.0, "deviation_ms": 20.0, "correlation": 0.9, "playout_ms": 90.0},
    "sine": {"delay_ms": 60.0, "amplitude_ms": 30.0, "period_s": 0.7},
    "trace": {"trace": "0 20000, 400000 90000, 800000 lost, 1200000 40000", "at_end": "loop"},
    "low_orbit": {"slot_s": 0.5, "duplicate": 0.1, "outages_s": [[0.8, 1.1]]},
}
"""A link of each delay model that virtual time can have; "measured" needs a network."""

LAW_SETTINGS: dict[str, tuple[str, dict[str, Any]]] = {
    **PLUGGED_LAWS,
    "adaptive": ("paper", {}),
    "adaptive_box": ("box", {}),
    "p_d": ("p_d_margin", {}),
    "p_f": ("contact", {}),
    "pd_d": ("two_sites", {}),
    "wave": ("two_sites", {"scheme": "digital"}),
    "tdpa": ("two_sites", {"scheme": "digital"}),
    "tanks": ("two_sites", {"scheme": "digital"}),
    "own": ("two_sites", {"control": {"law": "tests.laws:Adaptive"}}),
}
"""A scenario and settings for each law."""

SHORT = {"duration_s": 2.0, "rate_hz": 200}


def simulate_shipped(name: str, overrides: Mapping[str, Any] = {}) -> Log:
    """Returns a short run of a shipped scenario."""
    return trilat_net.simulate(load_scenario(name, {**SHORT, **overrides}))


def simulate_law(law: str) -> Log:
    """Returns a short run in which every site has a law."""
    name, settings = LAW_SETTINGS[law]
    named = {} if "control" in settings else {"control.law": law}
    return simulate_shipped(name, {**named, **settings})


def record_session(scenario: Scenario, orders: tuple[tuple[float, str], ...] = ()) -> Log:
    """Returns the log of a session of sites and a recorder, in which the slave gets orders."""
    with TemporaryDirectory() as folder:
        run_session(scenario, Path(folder), orders)
        return open_bytes(Path(folder, "run.mcap").read_bytes())


def make_fault_log() -> Log:
    """Returns a slave under the rule `glide` that its hand pushes beyond its limit of speed."""
    limits = {"qd_limit_rad_s": 0.2}
    return trilat_net.simulate(make_guarded_scenario(limits, where="sites.s."))


def make_torn_log(ticks: int, *sites: str) -> Log:
    """Returns a log that ends after few ticks, without some sites."""
    whole = add_clock_readings(make_short_log("paper"))
    return rewrite_log(
        whole,
        lambda record: record.tick < ticks and record.site in (sites or whole.sites),
        finished=False,
        driver="live",
    )


def make_log_with_gaps() -> Log:
    """Returns a log in which a site has single records between gaps."""
    return rewrite_log(
        make_short_log("paper"), lambda record: record.site != "m1" or record.tick % 100 == 0
    )


VARIED: dict[str, MakeLog] = {
    **{f"shipped {name}": partial(trilat_net.simulate, name) for name in list_shipped()},
    **{
        f"delay {model}": partial(simulate_shipped, "paper", {"link": {"model": model, **keys}})
        for model, keys in LINKS.items()
    },
    "delay measured": lambda: record_session(
        load_scenario("two_sites", {**SHORT, "link": {"model": "measured"}})
    ),
    **{f"law {law}": partial(simulate_law, law) for law in LAW_SETTINGS},
    "six joints": lambda: trilat_net.simulate(
        parse_scenario(six_joint_text(1.0), overrides={"rate_hz": 200})
    ),
    "planar task": lambda: trilat_net.simulate(parse_scenario(planar_task_text(rate_hz=200))),
    "posed task": lambda: trilat_net.simulate(
        parse_scenario(posed_task_text(1.0), overrides={"rate_hz": 200})
    ),
    "carried bodies": lambda: simulate_shipped(
        "paper",
        {
            "sites.s.plant": {
                "class": "tests.own_code:Carousel",
                "bodies": {"box": [0.2, 0.2, 0.1]},
            }
        },
    ),
    "four sites": lambda: add_clock_readings(make_short_log("four")),
    "live change": lambda: make_busy_run().log,
    "stop and enable": make_stopped_log,
    "orders in a session": lambda: record_session(
        make_gliding_scenario(4.0), ((1.5, "stop"), (3.0, "enable"))
    ),
    "fault": make_fault_log,
    "diverged": make_diverged_log,
    "everything": lambda: make_run("rich").log,
    "no record": lambda: make_torn_log(0),
    "one record a site": lambda: make_torn_log(1),
    "one of three sites": lambda: make_torn_log(200, "m1"),
    "single records": make_log_with_gaps,
}
"""The makers of the runs, by the property that is varied."""
