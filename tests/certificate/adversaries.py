"""Experiments that try to fool the judgement of a run, each with its truth.

`ROWS` are made by hand: a run that once passed for stable, and beside it a stable one much like it that must
pass. `draw_experiment` makes any number of further ones from a seed, many at an edge of stability. Their
truth is what the linear loop's rightmost root says, and a run eight times as long; no judgement changes it,
so that of the first seeds is kept in `TRUTHS`, with the digest of each scenario.

`hidden_loops` draws a third kind, whose growth is hidden, and `linear_truth` tells theirs without a line of
the program.

    python -m tests.certificate.adversaries
    python -m tests.certificate.adversaries --find-truths

The first prints the table of docs/reference/stability.md, of the two thousand experiments of `ALL`; the second finds the stored
truths anew.
"""

import argparse
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from trilat_studies.sweep.sweep_cell import classify_cell

import trilat_net
from tests.certificate.drawn_loops import make_experiment, make_swinging_hand
from tests.execution.builders import run_fused
from tests.scenario.builders import make_overrides
from trilat_net.analysis.certificate.premise_quantities import MissingFunctional
from trilat_net.analysis.judge import VirtualRun
from trilat_net.analysis.theory.equilibrium import extend_scenario, follow_equilibrium
from trilat_net.analysis.theory.linear_edge import find_contact_growth, find_rightmost_root
from trilat_net.analysis.theory.operating_point import Equilibrium, OperatingConditions
from trilat_net.core.arms.two_link_arm import JOINTS
from trilat_net.core.step.ticks import BUCKETS_PER_S, NS_PER_S
from trilat_net.core.step.vectors import Array
from trilat_net.errors import ScenarioError
from trilat_net.execution.fused import FusedRun
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario

from .drawn_loops import SAMPLED, STIFFNESS, WIDE_FROM, Drawn, draw_experiment, p_d
from .hidden_loops import NEAR_PER_S, draw_hidden, write_scenario

HIDDEN = range(1000)
"""Seeds of `hidden_loops` that the table has."""
DRAWN = (*range(600), *range(WIDE_FROM, WIDE_FROM + 400))
"""Seeds of `drawn_loops` that the table has."""
LONGER = 8.0
"""The run that shows the truth is longer than the judged run by this factor."""
SEEN = 1e-6
"""The smallest speed of a growing mode that counts, in rad/s."""
SLOW_PER_S = 0.01
"""A stable root slower than this hardly decays within eight times the run, so that the root decides."""
NEAR_AN_EDGE = (0.8, 1.2)
DEAD_RAD_S = 1e-11
"""A difference of speeds below this has died."""
AT_REST_RAD_S = 1e-4
"""A run below this speed is at rest, if every push dies."""
NUDGE_RAD = 1e-8
"""The size of a push."""
LINEAR_RAD_S = 1e-5
"""A difference above this is made small again."""
LOST_RAD_S = 1e-13
"""A difference below this is lost in the rounding of the numbers."""
WINDOW_S = 4.0
"""The length of the windows in which the difference is measured."""
LEAST_WINDOWS = 12
"""The least number of windows from which a rate is computed."""
GROWS_PER_S = 0.004
"""The least rate of a push that grows."""
TRUTHS = Path(__file__).with_name("truths.csv")
"""The digest and the truth of each seed's scenario."""
SEEDS = 2000
"""Seeds below `WIDE_FROM` whose truth is stored."""


def two_pairs(
    laws: tuple[Any, Any], q1_rad: tuple[float, ...], across: float = 0.0, **more: Any
) -> Scenario:
    """Returns {a, b} and {c, e}, each pair under one of two laws; `across` is the share of the
    other pair.
    """
    sites = {
        name: {
            "role": "master" if name in "ac" else "slave",
            "q0_rad": [q1, q1],
            "control": laws[name in "ce"],
        }
        for name, q1 in zip("abce", q1_rad, strict=True)
    }
    partner = dict(zip("abce", "baec", strict=True))
    other = dict(zip("abce", "ceab", strict=True))
    dominance = {
        i: {j: 1.0 - across, **({other[i]: across} if across else {})}
        for i, j in partner.items()
    }
    keys = {"sites": sites, "dominance": dominance, "link": {"delay_ms": 200.0}}
    return make_experiment("pairs", **{**keys, **more})


class Row(NamedTuple):
    """One experiment made by hand.

    Attributes:
        mark: its number; mirrors end in "=".
        what: in words.
        make: its scenario.
        verdicts: The words that may be said of the run.
        reason: what its judgement names, in lower case; "" for anything.
    """

    mark: str
    what: str
    make: Callable[[], Scenario]
    verdicts: tuple[str, ...]
    reason: str = ""


NEVER_STABLE = ("not stable", "open")
AT_REST = ("stable", "settled")
"""The permitted words for a run that comes to rest; `stable` needs a proof."""


def _load(
    name: str, overrides: Mapping[str, Any] | None = None, /, **more: Any
) -> Callable[[], Scenario]:
    """Returns a maker of a shipped scenario with overrides, at the speed limit for which the verdict was judged."""
    limit = {"limits.qd_limit_rad_s": 100.0}
    changes = {**limit, **(overrides or {}), **make_overrides(**more)}
    return lambda: load_scenario(name, changes)


PUSH = [{"kind": "recorded", "points": [[0.0, 3.0, 0.0], [1e3, 3.0, 0.0]]}]


def _pairs(first: Any, second: Any, across: float = 0.0) -> Callable[[], Scenario]:
    return lambda: two_pairs((first, second), APART if across else WIDE, across)


def _wall(kilonewtons: float, *, sampled: bool = True, **more: Any) -> Callable[[], Scenario]:
    return _load(
        "windup", {SAMPLED: sampled, STIFFNESS: 1e3 * kilonewtons, "duration_s": 24.0, **more}
    )


def _free(overrides: Mapping[str, Any] | None = None, /, **more: Any) -> Callable[[], Scenario]:
    return _load("free", {"rate_hz": 100, "duration_s": 40.0, **(overrides or {})}, **more)


def _margin(
    overrides: Mapping[str, Any] | None = None,
    /,
    d: float = 5.0,
    T_ms: float = 200.0,
    **more: Any,
) -> Callable[[], Scenario]:
    keys = {
        "control.d": d,
        "link.delay_ms": T_ms,
        "rate_hz": 100,
        "duration_s": 40.0,
        **(overrides or {}),
    }
    return _load("p_d_margin", keys, **more)


WIDER = [make_swinging_hand([(0.0, 0.0), (39.98, 12.0)])]
EARLY = [make_swinging_hand([(0.0, 0.0), (10.0, 6.0)])]
LASTING = [make_swinging_hand([(0.0, 5.0), (40.0, 5.0)])]
WIDE = (0.9, -0.9, 1e-3, -1e-3)
APART = (0.35, 0.25, -0.15, -0.25)
LEARNT = ({"law": "adaptive", "theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0]},) * 2
CYCLE = {"rate_hz": 100, "scheme": "digital", "link.delay_ms": 0.0, "duration_s": 200.0}
PARAMETRIC = {
    "link.model": "sine",
    "link.delay_ms": 200.0,
    "link.amplitude_ms": 200.0,
    "link.period_s": 1 / 1.7,
    "duration_s": 60.0,
}

HANGS = {
    "control.Gamma": [1.0, 1.0, 1.0, 0.01, 0.01],
    "control.theta_hat0": [3.0, 1.0, 1.0, 1.6, 0.8],
}
NUDGE = [{"kind": "pulse", "start_s": 20.0, "end_s": 39.9, "peak_nm": [8.0, 8.0]}]

LOSSY = {"link.loss": 1e-6}
CLOSE = {
    "sites.m1.q0_rad": [0.1, 0.2],
    "sites.m2.q0_rad": [0.102, 0.199],
    "sites.s.q0_rad": [0.099, 0.203],
}
STIFF = {"control.K": 100.0, "control.d": 200.0, "rate_hz": 1000, "duration_s": 20.0}


def _slower_from(at_s: float, d: float) -> Callable[[], Scenario]:
    """Returns P+d whose delay becomes longer, on links that lose a sample now and then."""
    to = {"delay_ms": 900.0, "loss": 1e-6}
    later = [
        {"at_s": at_s, "link": link, "to": to} for link in load_scenario("p_d_margin").links
    ]
    return _margin(LOSSY | {"timeline": later}, d=d)


def _touched(across: float) -> Callable[[], Scenario]:
    """Returns two pairs of arms, one of which a hand touches weakly."""
    hand = {"kind": "spring", "to_rad": [0.9, 0.9], "stiffness_nm_rad": 0.01}
    return lambda: load_scenario(two_pairs(LEARNT, APART, across), {"sites.a.hands": [hand]})


def _swinging(
    name: str, d: float, period_s: float, swing_ms: float = 195.0, **more: Any
) -> Callable[[], Scenario]:
    """Returns P+d whose delay of 200 ms swings, from starts that are 1e-9 rad apart."""
    names = ("m1", "m2", "s") if name == "p_d_margin" else ("m", "s")
    starts = {
        f"sites.{site}.q0_rad": [0.1 + 1e-9 * (n > 0), 0.2 + 1e-9 * (n == 1)]
        for n, site in enumerate(names)
    }
    link = {
        "link.model": "sine",
        "link.delay_ms": 200.0,
        "link.amplitude_ms": swing_ms,
        "link.period_s": period_s,
    }
    return _load(
        name, {**starts, **link, "control.d": d, "rate_hz": 200, "duration_s": 20.0}, **more
    )


def _turntables(
    d: float, period_s: float, c: tuple[float, float] = (0.88, 0.12)
) -> Callable[[], Scenario]:
    """Returns three arms of one joint about an upright axis, 0.3 rad apart; `c` has the shares
    of the last.
    """
    rows = {
        "a": {"b": 0.12, "c": 0.88},
        "b": {"a": 0.53, "c": 0.47},
        "c": {"a": c[0], "b": c[1]},
    }
    sites = {
        name: {"role": "slave" if n else "master", "q0_rad": [0.3 * n]}
        for n, name in enumerate(rows)
    }
    link = {"model": "sine", "delay_ms": 200.0, "amplitude_ms": 199.0, "period_s": period_s}
    arm = {"urdf": "arm6.urdf", "tip": "shoulder", "armature_kg_m2": 2.5}
    law = {"law": "p_d", "K": 5.0, "d": d}
    keys = {"rate_hz": 100, "duration_s": 60.0}
    return lambda: make_experiment(
        "turntables", arm=arm, control=law, link=link, sites=sites, dominance=rows, **keys
    )


def make_pair_scenario(first: Any, second: Any, **more: Any) -> Scenario:
    """Returns two sites that follow each other."""
    sites = {"a": {"role": "master", "q0_rad": [0.3, 0.4], **first}}
    sites["b"] = {"role": "slave", "q0_rad": [0.3, 0.4], **second}
    keys = {
        "scheme": "digital",
        "sites": sites,
        "dominance": {"a": {"b": 1.0}, "b": {"a": 1.0}},
    }
    return make_experiment("pair", **{**keys, **more})


def _unlike_rates(rates_hz: tuple[int, int], K: float, d: float) -> Callable[[], Scenario]:
    """Returns P+d without delay between sites that tick at two rates."""
    first, second = ({"rate_hz": rate_hz} for rate_hz in rates_hz)
    law = {"law": "p_d", "K": K, "d": d}
    return lambda: make_pair_scenario(
        first, second | {"q0_rad": [0.5, 0.4]}, control=law, link={"delay_ms": 0.0}
    )


def _reserve(
    reserve_J: float, K: float, B: float, damped: float = 0.0, apart_rad: float = 1e-10
) -> Callable[[], Scenario]:
    """Returns passivity control with a reserve, from starts next to each other; something
    resists the arms.
    """
    law = {"law": "tdpa", "K": K, "B": B, "reserve_J": reserve_J}
    around = (
        {"environment": [{"kind": "viscous", "damping_nm_s_rad": damped}]} if damped else {}
    )
    keys = {"control": law, "link": {"delay_ms": 136.0}, "rate_hz": 500, "duration_s": 20.0}
    return lambda: load_scenario(
        make_pair_scenario(around, around, **keys), {"sites.b.q0_rad": [0.3 + apart_rad, 0.4]}
    )


def _held_apart(stiffness_nm_rad: float, by_rad: float) -> Callable[[], Scenario]:
    """Returns two pairs that are hardly coupled; a hand holds one arm of each pair at its start."""

    def make() -> Scenario:
        starts = tuple(q if q > 0.0 else q - by_rad for q in APART)
        hands = {
            f"sites.{name}.hands": [
                {
                    "kind": "spring",
                    "to_rad": [q, q],
                    "stiffness_nm_rad": stiffness_nm_rad,
                    "damping_nm_s_rad": 4.0,
                }
            ]
            for name, q in zip("ac", starts[::2], strict=True)
        }
        return load_scenario(two_pairs(LEARNT, starts, 1e-6), hands)

    return make


def _wave(b: float, K: float, damped: float = 0.0) -> Callable[[], Scenario]:
    """Returns wave variables between arms that start at rest, next to each other; something
    resists the arms.
    """
    law = {"law": "wave", "b": b, "K": K, "B": 0.1 * K}
    around = (
        {"environment": [{"kind": "viscous", "damping_nm_s_rad": damped}]} if damped else {}
    )
    keys = {"control": law, "link": {"delay_ms": 50.0}, "rate_hz": 200}
    return lambda: make_pair_scenario(around, around, **keys)


def _coasting(follows: dict[str, float], law: str = "tdpa") -> Callable[[], Scenario]:
    """Returns a run in which a user lets go of an arm that no spring holds, and the slave follows the arm."""
    gains = {"K": 40.0, "B": 5.0}
    push = {"kind": "pulse", "start_s": 1.0, "end_s": 4.0, "peak_nm": [0.4, 0.2]}
    keys = {"link": {"delay_ms": 34.0}, "rate_hz": 200, "duration_s": 40.0}
    gains = gains if law in ("wave", "tdpa") else {**follows}
    return lambda: make_pair_scenario(
        {"control": {"law": law, **follows}, "hands": [push]},
        {"control": {"law": law, **gains}},
        **keys,
    )


def _free_swinging(
    period_s: float, swing_ms: float = 200.0, duration_s: float = 60.0
) -> Callable[[], Scenario]:
    """Returns the paper's law over a delay that swings about 200 ms."""
    link = {
        "link.model": "sine",
        "link.delay_ms": 200.0,
        "link.amplitude_ms": swing_ms,
        "link.period_s": period_s,
    }
    return _free(link, duration_s=duration_s)


ROWS = (
    Row(
        "C1", "three sites, swinging at 1.4 s", _swinging("p_d_margin", 1.1, 1.4), NEVER_STABLE
    ),
    Row("C1", "the same, d 1.05", _swinging("p_d_margin", 1.05, 1.4), NEVER_STABLE),
    Row(
        "C1",
        "two sites, swinging at 1.25 s",
        _swinging("p_d_margin_two", 2.1, 1.25),
        NEVER_STABLE,
        "this rest: unstable",
    ),
    Row(
        "C1",
        "the same, d 2",
        _swinging("p_d_margin_two", 2.0, 1.25),
        NEVER_STABLE,
        "this rest: unstable",
    ),
    Row(
        "C1",
        "and by 199 ms",
        _swinging("p_d_margin_two", 2.1, 1.25, 199.0),
        NEVER_STABLE,
        "this rest: unstable",
    ),
    Row("C1=", "three sites, d 2", _swinging("p_d_margin", 2.0, 1.4), AT_REST),
    Row(
        "C1=", "a quarter of the swing, d 1.4", _swinging("p_d_margin", 1.4, 1.4, 50.0), AT_REST
    ),
    Row("C1=", "two sites, d 4", _swinging("p_d_margin_two", 4.0, 1.25), AT_REST),
    Row("C2", "one joint, swinging at 2.5 s", _turntables(0.902, 2.5), NEVER_STABLE),
    Row("C2", "at 2.6 s", _turntables(0.902, 2.6), NEVER_STABLE),
    Row("C2", "at 1.75 s, other shares", _turntables(0.902, 1.75, (0.12, 0.88)), NEVER_STABLE),
    Row("C2=", "one joint, d 2.5", _turntables(2.5, 2.5), AT_REST),
    Row(
        "C3",
        "40 and 30 Hz, K 50",
        _unlike_rates((40, 30), 50.0, 2.0),
        NEVER_STABLE,
        "this rest: unstable",
    ),
    Row("C3", "50 and 30 Hz, K 60", _unlike_rates((50, 30), 60.0, 2.0), NEVER_STABLE, "twins"),
    Row("C3", "40 and 25 Hz", _unlike_rates((40, 25), 50.0, 2.0), NEVER_STABLE, "twins"),
    Row("C3=", "40 and 30 Hz, d 5", _unlike_rates((40, 30), 50.0, 5.0), AT_REST),
    Row("C3=", "50 and 30 Hz, K 20", _unlike_rates((50, 30), 20.0, 4.0), AT_REST),
    Row("C4", "a reserve of 100 J", _reserve(100.0, 100.0, 5.0), NEVER_STABLE),
    Row("C4", "of 1000 J, stiffer", _reserve(1000.0, 200.0, 5.0), NEVER_STABLE),
    Row("C4", "of 1 J, softer", _reserve(1.0, 50.0, 2.0), NEVER_STABLE, "twins"),
    Row("C4=", "arms that something resists", _reserve(100.0, 40.0, 10.0, 15.0), AT_REST),
    Row("C4=", "a reserve of 1 J, the same", _reserve(1.0, 20.0, 5.0, 8.0), AT_REST),
    Row("C6", "wave without motion, b too large", _wave(120.0, 0.0), NEVER_STABLE, "twins"),
    Row("C6", "b 200", _wave(200.0, 0.0), NEVER_STABLE, "twins"),
    Row("C6=", "without motion, arms that something resists", _wave(5.0, 20.0, 4.0), AT_REST),
    Row("C6=", "the same, b 60", _wave(60.0, 20.0, 2.0), AT_REST),
    # The arms leave their first rest and come to another, where the roots are stable (`find_truth`).
    Row(
        "C7",
        "the paper's law, swinging at 0.5831 s",
        _free_swinging(0.5831),
        ("stable",),
        "decaying",
    ),
    Row(
        "C7",
        "for 150 s",
        _free_swinging(0.5831, duration_s=150.0),
        ("open",),
        "no operator pushed",
    ),
    Row("C7", "at 0.55 s", _free_swinging(0.55), NEVER_STABLE, "no operator pushed"),
    Row("C7=", "at 1.3 s", _free_swinging(1.3), AT_REST),
    Row("C7=", "by 20 ms", _free_swinging(0.5831, 20.0), AT_REST),
    Row(
        "S1",
        "a wave line that nobody holds",
        _coasting({"b": 5.0}, "wave"),
        ("open",),
        "coasting",
    ),
    Row(
        "S1",
        "all follow, and nobody holds",
        _coasting({"K": 40.0, "B": 5.0}),
        NEVER_STABLE,
        "coasting",
    ),
    # it coasts, and pushes grow at +2.7 /s (`find_wide_truth`) to the 3 mrad that the reserve of tdpa holds
    Row(
        "S1=", "both follow, and are damped", _coasting({"K": 40.0, "d": 6.0}, "pd_d"), AT_REST
    ),
    Row("S4", "a hand at one arm only", _touched(1e-6), NEVER_STABLE, "apart"),
    Row("S4=", "two hands hold 0.4 rad apart", _held_apart(30.0, 0.0), AT_REST),
    Row("S4=", "weaker ones, 0.5 rad apart", _held_apart(12.0, 0.1), AT_REST),
    Row(
        "F1",
        "the wide group decays, the small one grows",
        _pairs(p_d(2.4), p_d(1.7)),
        NEVER_STABLE,
        "joint",
    ),
    Row(
        "F1",
        "and of that only one joint",
        _pairs(p_d(4.0), p_d([1.2, 4.0])),
        NEVER_STABLE,
        "joint",
    ),
    Row("F1=", "both groups decay", _pairs(p_d(4.0), p_d(4.0)), AT_REST),
    Row("F2", "a sampled wall of 20 kN/m", _wall(20.0), NEVER_STABLE, "this rest: unstable"),
    Row("F2", "a sampled wall of 28 kN/m", _wall(28.0), NEVER_STABLE, "this rest: unstable"),
    Row("F2", "a sampled wall of 5 kN/m at 100 Hz", _wall(5.0, rate_hz=100), NEVER_STABLE),
    Row("F2=", "a sampled wall of 8 kN/m", _wall(8.0), AT_REST),
    Row("F2=", "a wall of 28 kN/m that is not sampled", _wall(28.0, sampled=False), AT_REST),
    Row("F4", "the delay swings at 1.7 Hz", _load("free", PARAMETRIC), NEVER_STABLE, "v rises"),
    Row(
        "F4=", "by a tenth of that", _load("free", PARAMETRIC, link__amplitude_ms=20.0), AT_REST
    ),
    Row(
        "F5",
        "P+d, 1.6 s, d 2.7",
        _margin(d=2.7, T_ms=1600.0, duration_s=60.0),
        NEVER_STABLE,
        "unstable",
    ),
    Row(
        "F5",
        "P+d, 0.8 s, d 2",
        _margin(d=2.0, T_ms=800.0, duration_s=60.0),
        NEVER_STABLE,
        "unstable",
    ),
    Row("F5=", "P+d, 1.6 s, d 16", _margin(d=16.0, T_ms=1600.0, duration_s=120.0), AT_REST),
    Row("F5", "at its edge, if a sample is lost", _margin(CLOSE | LOSSY, d=0.96), NEVER_STABLE),
    Row("F5=", "beyond its edge, the same", _margin(CLOSE | LOSSY, d=1.2), AT_REST),
    Row(
        "F5",
        "1.56 s, d 2.6, if a sample is lost",
        _margin(LOSSY, d=2.6, T_ms=1560.0, duration_s=120.0),
        NEVER_STABLE,
        "of the delays in use",
    ),
    Row(
        "F5=",
        "1.56 s, d 16, the same",
        _margin(LOSSY, d=16.0, T_ms=1560.0, duration_s=120.0),
        AT_REST,
    ),
    Row(
        "F6",
        "two pairs that hardly hear of each other",
        _pairs(*LEARNT, 1e-6),
        NEVER_STABLE,
        "apart",
    ),
    Row("F6=", "two pairs that do", _pairs(*LEARNT, 0.3), AT_REST),
    Row("F6", "a hand that cannot hold them apart", _touched(1e-6), NEVER_STABLE, "apart"),
    Row(
        "F7",
        "20 ms of free motion",
        _free({"sites.m1.hands": WIDER}),
        NEVER_STABLE,
        "operator acts",
    ),
    Row(
        "F7",
        "100 ms of it, after a push",
        _free({"sites.m1.hands": NUDGE}),
        NEVER_STABLE,
        "operator acts",
    ),
    Row("F7=", "30 s of it", _free({"sites.m1.hands": EARLY}), AT_REST),
    Row(
        "F8",
        "force reflection hammers",
        _load("contact", duration_s=60.0),
        ("not stable",),
        "bounded",
    ),
    Row(
        "F8=",
        "a fifth of the force",
        _load("contact", {"sites.m.control.k_f": 0.2}, duration_s=60.0),
        AT_REST,
    ),
    Row("F8", "100 Hz, no delay: a limit cycle", _load("free", CYCLE), NEVER_STABLE, "v rises"),
    Row("F8=", "500 Hz, no delay", _load("free", CYCLE, rate_hz=500, duration_s=60.0), AT_REST),
    Row("F8", "a push without end", _margin({"sites.m1.hands": PUSH}), NEVER_STABLE, "drift"),
    Row(
        "F9",
        "gravity known to 80 %",
        _margin({"control.gravity": 0.8}, duration_s=60.0),
        NEVER_STABLE,
        "hang",
    ),
    Row("F9", "gravity hardly learnt", _free(HANGS, duration_s=60.0), NEVER_STABLE),
    Row(
        "F9",
        "a torque limit of 15 N m",
        _free(limits__tau_limit_nm=15.0),
        NEVER_STABLE,
        "v ends",
    ),
    Row("F9=", "a torque limit of 100 N m", _free(limits__tau_limit_nm=100.0), AT_REST),
    Row("F9=", "gravity known", _margin(duration_s=60.0), AT_REST),
    Row(
        "F9", "arms that sink slowly", _margin(STIFF | {"control.gravity": 0.99}), NEVER_STABLE
    ),
    Row("F9=", "arms that do not", _margin(STIFF), AT_REST),
    Row(
        "W",
        "a hand swings ever wider",
        _margin({"sites.m1.hands": WIDER}),
        ("open",),
        "operator acts",
    ),
    Row(
        "W",
        "a hand swings on at the slave",
        _margin({"sites.s.hands": LASTING}),
        ("open",),
        "operator acts",
    ),
    Row(
        "W",
        "a delay that is too long in the end",
        _slower_from(39.9, 2.0),
        NEVER_STABLE,
        "the loop changes",
    ),
    Row("W=", "a longer delay since long", _slower_from(15.0, 5.0), AT_REST),
    Row("W=", "the hand lets go", _margin({"sites.m1.hands": EARLY}), AT_REST),
)


def under_noise(scenario: Scenario) -> Scenario:
    """Returns an experiment with its delays, on links as of a live run: jitter of 1.5 ms, 1 %
    of samples lost.
    """
    noise = {"model": "uniform", "half_width_ms": 1.5, "loss": 0.01}
    links = {
        f"links.{link}.{key}": value for link in scenario.links for key, value in noise.items()
    }
    delays = {f"links.{link}.delay_ms": spec.delay_ms for link, spec in scenario.links.items()}
    return load_scenario(scenario, links | delays)


class Truth(NamedTuple):
    """The truth about a run: whether it is unstable, its rightmost root, 1/s, and whether an
    edge is near.
    """

    unstable: bool
    root_per_s: float | None
    near: bool


def find_truth(drawn: Drawn) -> Truth:
    """Returns the truth by the rightmost root and by a run eight times as long, in which
    operators let go.

    For random links the longer run alone decides. `find_wide_truth` decides for widely drawn
    runs.
    """
    if drawn.wide:
        return find_wide_truth(drawn.scenario)
    scenario = drawn.scenario
    ends_s = drawn.scenario.duration_s
    run = FusedRun(extend_scenario(scenario, LONGER * ends_s))
    states = []
    for t_s in np.linspace(0.75, 1.0, 100) * ends_s if has_sampled_wall(scenario) else ():
        run.advance_to(float(t_s))
        states.append((run.q, run.theta_hat))
    run.advance_to(ends_s)
    in_contact = (
        find_contact_growth(scenario, *map(np.array, zip(*states, strict=True)))
        if states
        else -1.0
    )
    run.advance_to(LONGER * ends_s)
    at = Equilibrium(run.q, run.theta_hat, "", 0.0)
    if run.diverged_s is not None:
        at = at._replace(q=np.array([spec.q0_rad for spec in scenario.sites.values()]))
    root = _find_rightmost(scenario, at)
    near = False
    if drawn.key and root is not None:
        beside = [_find_rightmost(_scale_key(drawn, factor), at) for factor in NEAR_AN_EDGE]
        near = any(
            exponent is not None and (exponent > 0.0) != (root > 0.0) for exponent in beside
        )
    if run.diverged_s is not None:
        return Truth(True, root, near)
    early = _peak_speeds(run, 0.75 * ends_s, ends_s)
    late = _peak_speeds(run, (LONGER - 1.0) * ends_s)
    slow = root is not None and -SLOW_PER_S < root < 0.0
    lasts = bool((late > np.maximum((1.2 if slow else 0.5) * early, SEEN)).any())
    grows = root is not None and root > 0.0 and not scenario.links_random
    return Truth(lasts or grows or in_contact > 0.0, root, near)


def find_wide_truth(scenario: Scenario) -> Truth:
    """The truth of any run: whether its motion lasts, or a small push in it grows, to eight times its length.

    The exponent is that of a push in the last three quarters. One so small that it does not double or halve
    a motion within the judged half of the run itself is near an edge, and so is a motion that dies although a
    push in it grows, for the while that it lasts, and one slower than `AT_REST_RAD_S` that drawn delays keep
    up although every push in it dies.
    """
    whole = extend_scenario(scenario, LONGER * scenario.duration_s)
    ends_s = scenario.duration_s
    run = run_fused(whole, LONGER * ends_s)
    if run.diverged_s is not None:
        return Truth(True, None, False)
    early, late = (_largest_speed(run, end_s) for end_s in (ends_s, LONGER * ends_s))
    exponent = measure_exponent(whole, LONGER * ends_s)
    lasts = late > max(0.5 * early, DEAD_RAD_S)
    near = abs(exponent) * 0.5 * ends_s < np.log(2.0) or (exponent > GROWS_PER_S and not lasts)
    near |= scenario.links_random and lasts and exponent < -GROWS_PER_S and late < AT_REST_RAD_S
    return Truth(lasts or exponent > GROWS_PER_S, exponent, bool(near))


def _largest_speed(run: FusedRun, until_s: float) -> float:
    """Returns the largest speed of any joint in the quarter of a run's own length before a time, rad/s."""
    last = round(until_s * BUCKETS_PER_S)
    first = last - round(run.ran_s * BUCKETS_PER_S / LONGER / 4.0)
    return max(float(np.split(site[first:last], 3, axis=1)[1].max()) for site in run.buckets)


def measure_exponent(scenario: Scenario, until_s: float) -> float:
    """The rate at which a push of 1e-8 rad grows in the last three quarters of a run, 1/s.

    The speeds of a run and of one that was pushed are compared in windows; their difference is made small
    again when it is large, and pushed anew when it is lost in the rounding of the numbers. The rate is that
    of the later half of its windows, in which what decays faster is gone; of one that is lost, over its life.
    """
    run = FusedRun(scenario)
    pushed = FusedRun(scenario)
    for either in (run, pushed):
        either.plan([round(until_s * spec.rate_hz) for spec in scenario.sites.values()])
    joints = max(scenario.layout(name).joints for name in scenario.names)
    by = NUDGE_RAD * np.random.default_rng(1).uniform(-1.0, 1.0, (len(scenario.names), joints))
    scale = 0.0
    sizes = []
    lost = []
    for start_s in np.arange(0.25 * until_s, until_s - 1e-9, WINDOW_S):
        run.step_to(round(start_s * NS_PER_S))
        if not sizes:
            pushed.copy_state(run)
            pushed.displace("q", by)
            scale = 0.0
        size = _largest_difference(run, pushed, start_s)
        if not np.isfinite(size) or pushed.diverged_s is not None or run.diverged_s is not None:
            return np.inf
        sizes.append(np.log(max(size, LOST_RAD_S)) + scale)
        if size < LOST_RAD_S:
            lost.append((sizes[-1] - np.log(NUDGE_RAD)) / (WINDOW_S * len(sizes)))
            sizes = []
        elif size > LINEAR_RAD_S:
            pushed.scale_difference(run, NUDGE_RAD / size)
            scale += np.log(size / NUDGE_RAD)
    late = sizes[len(sizes) // 2 :]
    if len(late) < LEAST_WINDOWS:
        return float(np.mean(lost)) if lost else 0.0
    return float(np.polyfit(WINDOW_S * np.arange(len(late)), late, 1)[0])


def _largest_difference(run: FusedRun, pushed: FusedRun, start_s: float) -> float:
    """Returns the largest difference of the speeds of two runs in a window, rad/s; both runs
    are continued.
    """
    differences = []
    for t_s in np.linspace(start_s, start_s + WINDOW_S, 21)[1:]:
        for either in (run, pushed):
            either.step_to(round(t_s * NS_PER_S))
        differences.append(pushed.measure_distance(run, "qd"))
    return max(differences)


def has_sampled_wall(scenario: Scenario) -> bool:
    """True if a wall is held over a tick."""
    return any(
        environment.actor.sampled
        for spec in scenario.sites.values()
        for environment in spec.environment
    )


def _peak_speeds(run: FusedRun, from_s: float, to_s: float = np.inf) -> Array:
    """Returns the largest |qd| of every joint over a span, shape (N, 2), in rad/s."""
    first, last = (round(t_s * BUCKETS_PER_S) for t_s in (from_s, min(to_s, run.ran_s)))
    return np.array([site[first:last, JOINTS : 2 * JOINTS].max(axis=0) for site in run.buckets])


def _find_rightmost(scenario: Scenario, at: Equilibrium) -> float | None:
    """Returns the real part of the rightmost root at the rest next to a pose, or None without such a rest."""
    if scenario.links_random:
        # ages are counted sample by sample
        scenario = load_scenario(scenario, {"duration_s": 4.0})
    try:
        rest = follow_equilibrium(scenario, at)
        root = find_rightmost_root(OperatingConditions.derive(scenario), rest, sampled=True)
    except (ScenarioError, np.linalg.LinAlgError):
        return None
    return None if root is None else root.s.real


def _scale_key(drawn: Drawn, factor: float) -> Scenario:
    """Returns the experiment with its key times a factor."""
    if drawn.key == STIFFNESS:
        value = drawn.scenario.sites["s"].environment[0].stiffness_n_m
        return load_scenario(drawn.scenario, {STIFFNESS: factor * value})
    sites = drawn.scenario.sites.items()
    damping = {
        f"sites.{name}.control.d": [factor * d for d in spec.control.d] for name, spec in sites
    }
    return load_scenario(drawn.scenario, damping)


def say_of(log: Log) -> str:
    """Returns the word of `trilat certify`."""
    return str(trilat_net.certify(log).stability)


def say_of_run(scenario: Scenario) -> str:
    """The word of `trilat certify` on a scenario's run, and no log is made where none is needed.

    V, if the law has one, takes all records.
    """
    if not MissingFunctional.list_of_scenario(scenario):
        return say_of(trilat_net.simulate(scenario))
    run = run_fused(scenario)
    return str(VirtualRun(scenario, run).decision.stability)


def say_of_sweep(scenario: Scenario) -> str:
    """Returns the word of a cell of `trilat sweep`."""
    return classify_cell(scenario.text, LONGER * scenario.duration_s).stability


class Judged(NamedTuple):
    """A drawn experiment, its truth, and the words of `certify` and of a sweep."""

    drawn: Drawn
    truth: Truth
    certified: str = ""
    swept: str = ""


def judge_experiment(seed: int, *, stored: bool = True) -> Judged:
    """Judges the experiment of a seed; its truth is read from `TRUTHS` if it is stored there."""
    drawn = draw_experiment(seed)
    truth = read_truth(seed, drawn) if stored else find_truth(drawn)
    return Judged(drawn, truth, say_of_run(drawn.scenario), say_of_sweep(drawn.scenario))


def judge_hidden(seed: int) -> Judged:
    """Judges a loop that hides its growth, with permission to run its law."""
    hidden, rate_per_s = draw_hidden(seed)
    drawn = Drawn(hidden.kind, write_scenario(hidden), has="hidden")
    truth = Truth(rate_per_s > 0.0, rate_per_s, abs(rate_per_s) < NEAR_PER_S)
    log = trilat_net.simulate(drawn.scenario)
    certificate = trilat_net.certify(log, own_laws=hidden.own_law)
    return Judged(drawn, truth, str(certificate.stability))


def read_truth(seed: int, drawn: Drawn) -> Truth:
    """Returns the truth of a seed, as stored for exactly this scenario."""
    digest, unstable, root_per_s, near = _read_rows()[seed]
    anew = "python -m tests.certificate.adversaries --find-truths"
    assert digest == _compute_digest(drawn), (
        f"seed {seed} draws another scenario than its truth is of: run {anew}"
    )
    return Truth(unstable == "1", float(root_per_s) if root_per_s else None, near == "1")


@cache
def _read_rows() -> list[list[str]]:
    return [row.split(",")[1:] for row in TRUTHS.read_text().splitlines()[1:]]


def count_stored() -> int:
    """Returns how many seeds have a stored truth."""
    return len(_read_rows())


def _compute_digest(drawn: Drawn) -> str:
    return drawn.scenario.sha256[:12]


def write_truth(seed: int) -> str:
    """Returns the row of a seed with its truth computed anew."""
    drawn = draw_experiment(seed)
    unstable, root, near = find_truth(drawn)
    root_per_s = "" if root is None else f"{root:.6g}"
    return f"{seed},{_compute_digest(drawn)},{unstable:d},{root_per_s},{near:d}"


class Tally(NamedTuple):
    """The counts of the judgements of some experiments."""

    runs: int
    unstable: int
    near: int
    false_ok: int
    false_alarm: int
    settled: int
    undecided: int


def count_judgements(judged: Iterable[Judged], by: str = "certified") -> Tally:
    """Returns the counts of the words of `by`: wrongly stable, wrongly not, settled, and open."""
    rows = [(entry.truth, getattr(entry, by)) for entry in judged]
    return Tally(
        len(rows),
        sum(truth.unstable for truth, _ in rows),
        sum(truth.near for truth, _ in rows),
        sum(truth.unstable and word == "stable" for truth, word in rows),
        sum(not truth.unstable and word == "not stable" for truth, word in rows),
        sum(word == "settled" for _, word in rows),
        sum(word == "open" for _, word in rows),
    )


def tally_clear(judged: Iterable[Judged], by: str = "certified") -> Tally:
    """Returns the same counts for experiments that are not near an edge."""
    return count_judgements((entry for entry in judged if not entry.truth.near), by)


def main() -> None:
    """Prints the table of docs/reference/stability.md."""
    parser = argparse.ArgumentParser(
        description="What is said of random experiments whose truth is known."
    )
    parser.add_argument("--seeds", type=int, help="only so many of each kind")
    parser.add_argument("--jobs", type=int, help="processes")
    parser.add_argument(
        "--find-truths", action="store_true", help="write those of truths.csv anew"
    )
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        if arguments.find_truths:
            _write_truths(pool.map(write_truth, range(count_stored()), chunksize=8))
            return
        drawn = DRAWN[: arguments.seeds]
        hidden = HIDDEN[: arguments.seeds]
        judged = [
            *pool.map(judge_by_certify, drawn, chunksize=8),
            *pool.map(judge_hidden, hidden, chunksize=8),
        ]
    print_table(judged)
    for seed, verdict in zip((*drawn, *hidden), judged, strict=True):
        counts = count_judgements([verdict])
        if counts.false_ok or counts.false_alarm:
            print(f"seed {seed}: {verdict.drawn.kind}, {verdict.truth}: {verdict.certified}")


def judge_by_certify(seed: int) -> Judged:
    """Returns the word of `certify` alone on the experiment of a seed."""
    drawn = draw_experiment(seed)
    return Judged(drawn, read_truth(seed, drawn), say_of_run(drawn.scenario))


def _write_truths(rows: Iterable[str]) -> None:
    """Writes rows of truths as they are found, a hundred at a time."""
    lines = TRUTHS.read_text().splitlines()
    for n, row in enumerate(rows, 1):
        lines[n : n + 1] = [row]
        if n % 100 == 0 or n == len(lines) - 1:
            TRUTHS.write_text("\n".join([*lines, ""]))


def print_table(judged: list[Judged]) -> None:
    """Prints a row for each kind and for all kinds, and the upper bound on the rate of errors that did not occur."""
    columns = "runs | unstable | near an edge | false ok | false alarms | settled | open"
    print(f"| experiments | {columns} |")
    print("|---|" + " --: |" * len(Tally._fields))
    kinds = sorted({(entry.drawn.has == "hidden", entry.drawn.kind) for entry in judged})
    for hides, kind in kinds:
        groups = [
            entry
            for entry in judged
            if (entry.drawn.has == "hidden", entry.drawn.kind) == (hides, kind)
        ]
        print(f"| {kind} | " + " | ".join(map(str, count_judgements(groups))) + " |")
    total = count_judgements(judged)
    print("| all | " + " | ".join(map(str, total)) + " |")
    print(
        f"{total.false_ok} of {total.unstable} unstable runs are called stable: with 95 % confidence "
        f"fewer than {3.0 / max(total.unstable, 1):.2%} are, by the rule of three"
    )


if __name__ == "__main__":
    main()
