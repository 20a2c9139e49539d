"""The tasks, the links and the laws of the suite, and its parts by name.

Invariant: a task and a link are overrides of one of two shipped scenarios, with and without a second user; so
every run of the suite is a command of `trilat sim`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ...laws.six_channel import complementary_shares
from ...scenario.laws import BUILT_IN
from ...scenario.resolve import GRID_LOSSES_PERCENT, GRID_ROUND_TRIPS_MS

Settings = Mapping[str, Any]
"""Overrides by key."""

BASES = {"three": "_bench_three", "two": "_bench_two", "level": "_bench_two"}
"""Per form the scenario: three sites, two sites, and two sites whose arms lie in a level plane."""
_START = (-0.6, 1.8)
_OUT = (-0.4557864690179811, 1.3957985827210313)
"""The pose whose end effector is 0.30 m further out, at the same height."""
_LESS_OUT = (-0.4901506797631161, 1.484043235051833)
"""The same 0.24 m further out: 0.09 m instead of 0.15 m behind the wall."""
_LEFT, _RIGHT = (-0.4, 1.8), (-0.8, 1.8)
_HAND = {"kind": "spring", "stiffness_nm_rad": 50.0, "damping_nm_s_rad": 5.0}
_WALL = {"kind": "wall", "point_m": [1.3376933693863516, 0.0], "normal": [-1.0, 0.0], "stiffness_n_m": 2000.0}
_CUT_S = (2.0, 5.0)
_BURST_SAMPLES = 100.0
_FIRST, _SECOND = 0.75, 0.25
"""The share a of the first user, before a handover and after it."""


def _hand(to: Sequence[float], begin_s: float = 1.0, **more: Any) -> dict[str, Any]:
    return {**_HAND, "to_rad": list(to), "move_start_s": begin_s, "move_end_s": begin_s + 2.0, **more}


def _shares(a: float) -> dict[str, dict[str, float]]:
    names = ("m1", "m2", "s")
    rows = zip(names, complementary_shares(a).tolist(), strict=True)
    return {
        name: {peer: share for peer, share in zip(names, row, strict=True) if share} for name, row in rows
    }


class BenchTask(NamedTuple):
    """A task.

    Attributes:
        about: what it asks, in words.
        settings: what makes it of the scenario.
        users: how many it needs.
        cut_s: when the links of the slave are cut, s; None: never.
        duration_s: over which its errors and efforts are measured, s; a run lasts so long or longer.
    """

    about: str
    settings: Settings
    users: int = 1
    cut_s: tuple[float, float] | None = None
    duration_s: float = 20.0


_HANDOVER: dict[str, Any] = {
    "sites.m1.hands": [_hand(_LEFT, end_s=8.0)],
    "sites.m2.hands": [_hand(_RIGHT, 10.0, from_rad=list(_LEFT), start_s=8.0)],
    "dominance": _shares(_FIRST),
    "timeline": [
        {"at_s": 7.0, "dominance": site, "to": row, "ramp_s": 2.0} for site, row in _shares(_SECOND).items()
    ],
}
TASKS = {
    "free": BenchTask("a user moves the slave by 0.3 m", {"sites.m1.hands": [_hand(_OUT)]}),
    "contact": BenchTask(
        "a wall of 2000 N/m is in the slave's way at half of that",
        {"sites.m1.hands": [_hand(_OUT)], "sites.s.environment": [_WALL]},
    ),
    "handover": BenchTask(
        "one user lets go while dominance goes to the other", _HANDOVER, users=2, duration_s=24.0
    ),
    "disagree": BenchTask(
        "two users, of whom the first leads, hold poses that are 0.4 rad apart",
        {"sites.m1.hands": [_hand(_LEFT)], "sites.m2.hands": [_hand(_RIGHT)], "dominance": _shares(_FIRST)},
        users=2,
    ),
    "outage": BenchTask(
        "the slave hears nothing, and is not heard, for 3 s of free motion",
        {"sites.m1.hands": [_hand(_OUT)]},
        cut_s=_CUT_S,
    ),
}

LINKS: dict[str, Settings] = {
    f"rtt{rtt_ms}" + (f"-loss{percent}" if percent else ""): {
        "model": "constant",
        "delay_ms": rtt_ms / 2,
        **({"loss": percent / 100, "loss_burst": _BURST_SAMPLES} if percent else {}),
    }
    for percent in GRID_LOSSES_PERCENT
    for rtt_ms in GRID_ROUND_TRIPS_MS
}
"""By name the keys of all links. Losses come in bursts of 0.1 s: single ones cost a tick at 1 kHz."""
LINKS |= {name: {"preset": name} for name in ("4g", "5g", "geo")}
LINKS["trace"] = {"model": "trace", "file": "busy_machine.csv", "at_end": "loop"}

_MEAN_MS = {"geo": 300.0}
"""Mean delays of presets for which `ROUND_TRIPS` take longer than the tasks do, ms."""

SHORTER_REACH: Settings = {"sites.m1.hands": [_hand(_LESS_OUT)]}
"""What makes of `contact` the same with a shorter reach: of both the stiffness at the hand is found."""

_ROLES = ("master", "master", "slave")
_TUNED_LAWS = {name: law for name, law in BUILT_IN.items() if law.tune}
LAWS_OF_ANY = tuple(name for name, law in _TUNED_LAWS.items() if not law.explain_misfit(_ROLES))
LAWS_OF_TWO = tuple(name for name in _TUNED_LAWS if name not in LAWS_OF_ANY)
TUNED_ROUND_TRIPS_MS = (68, 272, 1088)
"""The delays at which every law is tuned."""
TUNING_TASK = "contact"
"""The task in which it is; its twin without the wall is free motion."""


class BenchStudy(NamedTuple):
    """A part of the suite.

    Attributes:
        about: what it is for, in words.
        tasks, links: by name.
        laws: per form those that run in it.
        seeds: of runs in which anything is drawn.
    """

    about: str
    tasks: tuple[str, ...]
    laws: Mapping[str, tuple[str, ...]]
    links: tuple[str, ...]
    seeds: int


_ALL_LAWS = {"three": LAWS_OF_ANY, "two": LAWS_OF_TWO}
_GRID = tuple(name for name in LINKS if name.startswith("rtt"))
_LOSSY = ("rtt68-loss50", "rtt136-loss50", "rtt544-loss50")
_COARSE = tuple(name for name in LINKS if "-loss" not in name or name in _LOSSY)
STUDIES = {
    "full": BenchStudy("every law and task", tuple(TASKS), _ALL_LAWS, _COARSE, 20),
    "small": BenchStudy(
        "the same at three links", tuple(TASKS), _ALL_LAWS, ("rtt68", "rtt136-loss50", "4g"), 2
    ),
    "round-trips": BenchStudy(
        "after Rodriguez-Seda, Lee and Spong (2009): wave variables, a Smith predictor, synchronisation and "
        "P+d with its relatives between two level arms, over round trips and losses",
        ("free", "contact"),
        {"level": ("wave", "smith", "sync", "adaptive", "p_d", "pd_d", "lee_spong")},
        _GRID,
        20,
    ),
}


ROUND_TRIPS = 40
"""A run lasts for so many round trips or longer."""


def build_settings(form: str, task: str, link: str, seed: int | None = None) -> dict[str, Any]:
    """Returns the overrides of a form's scenario that make a run of the suite, its law aside."""
    asked = TASKS[task]
    keys = dict(LINKS[link])
    trips_s = 2e-3 * ROUND_TRIPS * keys.get("delay_ms", _MEAN_MS.get(link, 0.0))
    settings = {**asked.settings, "link": keys, "duration_s": max(asked.duration_s, trips_s)}
    if asked.cut_s is not None:
        keys["outages_s"] = [list(asked.cut_s)]
        if form == "three":  # the users hear each other all the time
            settings |= {f"links.{name}.outages_s": [] for name in ("m1->m2", "m2->m1")}
    if form == "level":
        settings["arm.g_m_s2"] = 0.0
    return settings if seed is None else {**settings, "seed": seed}
