"""The plan of the suite: tasks, links and laws, cells, and the gains that one procedure tuned
for each law.

Invariant: gains come from `trilat bench --tune` alone and are kept in a file. Each entry has
the fingerprint of what it was tuned for, the resolved scenario and the sources of the law: a
stale one is named wherever it is used. A law of which no candidate keeps the margin has none,
and no runs. A plan is a function of the study, what is chosen of it, and the tuned gains; what
cannot be right is refused before the first run.

A task and a link are overrides of one of two shipped scenarios, with and without a second user;
so every run of the suite is a command of `trilat sim`.
"""

import hashlib
import inspect
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ...core import control
from ...errors import UsageError
from ...fields import suggest_nearest
from ...files import write_whole
from ...laws.six_channel import complementary_shares
from ...scenario.laws import BUILT_IN
from ...scenario.resolve import GRID_LOSSES_PERCENT, GRID_ROUND_TRIPS_MS
from ..executor import Progress, Workers, ignore_progress
from ..study_folder import format_toml_value
from ..tuning.candidate import (
    CandidateClass,
    TuningScenario,
    load_tuning_scenario,
    measure_candidate,
)
from ..tuning.search_space import SEARCH_SPACES, ModelInformation
from ..tuning.tuning_plan import CandidateSearch, plan_tuning

Settings = Mapping[str, Any]
"""Overrides by key."""

BASES = {"three": "_bench_three", "two": "_bench_two", "level": "_bench_two"}
"""Per form the scenario: three sites, two sites, and two sites whose arms lie in a level plane.
"""
_START = (-0.6, 1.8)
_OUT = (-0.4557864690179811, 1.3957985827210313)
"""The pose whose end effector is 0.30 m further out, at the same height."""
_LESS_OUT = (-0.4901506797631161, 1.484043235051833)
"""The same 0.24 m further out: 0.09 m instead of 0.15 m behind the wall."""
_LEFT = (-0.4, 1.8)
_RIGHT = (-0.8, 1.8)
_HAND = {"kind": "spring", "stiffness_nm_rad": 50.0, "damping_nm_s_rad": 5.0}
_WALL = {
    "kind": "wall",
    "point_m": [1.3376933693863516, 0.0],
    "normal": [-1.0, 0.0],
    "stiffness_n_m": 2000.0,
}
_CUT_S = (2.0, 5.0)
_BURST_SAMPLES = 100.0
_FIRST = 0.75
_SECOND = 0.25
"""The share a of the first user, before a handover and after it."""


def _hand(to: Sequence[float], begin_s: float = 1.0, **more: Any) -> dict[str, Any]:
    return {
        **_HAND,
        "to_rad": list(to),
        "move_start_s": begin_s,
        "move_end_s": begin_s + 2.0,
        **more,
    }


def _shares(a: float) -> dict[str, dict[str, float]]:
    names = ("m1", "m2", "s")
    rows = zip(names, complementary_shares(a).tolist(), strict=True)
    return {
        name: {peer: share for peer, share in zip(names, row, strict=True) if share}
        for name, row in rows
    }


class BenchTask(NamedTuple):
    """A task.

    Attributes:
        about: what it asks, in words.
        settings: what makes it of the scenario.
        users: how many it needs.
        cut_s: when the links of the slave are cut, s; None: never.
        duration_s: over which its errors and efforts are measured, s; a run lasts so long or
            longer.
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
        {"at_s": 7.0, "dominance": site, "to": row, "ramp_s": 2.0}
        for site, row in _shares(_SECOND).items()
    ],
}
TASKS = {
    "free": BenchTask("a user moves the slave by 0.3 m", {"sites.m1.hands": [_hand(_OUT)]}),
    "contact": BenchTask(
        "a wall of 2000 N/m is in the slave's way at half of that",
        {"sites.m1.hands": [_hand(_OUT)], "sites.s.environment": [_WALL]},
    ),
    "handover": BenchTask(
        "one user lets go while dominance goes to the other",
        _HANDOVER,
        users=2,
        duration_s=24.0,
    ),
    "disagree": BenchTask(
        "two users, of whom the first leads, hold poses that are 0.4 rad apart",
        {
            "sites.m1.hands": [_hand(_LEFT)],
            "sites.m2.hands": [_hand(_RIGHT)],
            "dominance": _shares(_FIRST),
        },
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
"""By name the keys of all links. Losses come in bursts of 0.1 s: single ones cost a tick at 1
kHz.
"""
LINKS |= {name: {"preset": name} for name in ("4g", "5g", "geo")}
LINKS["trace"] = {"model": "trace", "file": "busy_machine.csv", "at_end": "loop"}

_MEAN_MS = {"geo": 300.0}
"""Mean delays of presets for which `ROUND_TRIPS` take longer than the tasks do, ms."""

SHORTER_REACH: Settings = {"sites.m1.hands": [_hand(_LESS_OUT)]}
"""What makes of `contact` the same with a shorter reach: of both the stiffness at the hand is
found.
"""

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
    "full": BenchStudy(
        about="every law and task", tasks=tuple(TASKS), laws=_ALL_LAWS, links=_COARSE, seeds=20
    ),
    "small": BenchStudy(
        about="the same at three links",
        tasks=tuple(TASKS),
        laws=_ALL_LAWS,
        links=("rtt68", "rtt136-loss50", "4g"),
        seeds=2,
    ),
    "round-trips": BenchStudy(
        about="after Rodriguez-Seda, Lee and Spong (2009): wave variables, a Smith predictor, synchronisation and "
        "P+d with its relatives between two level arms, over round trips and losses",
        tasks=("free", "contact"),
        laws={"level": ("wave", "smith", "sync", "adaptive", "p_d", "pd_d", "lee_spong")},
        links=_GRID,
        seeds=20,
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


GAINS_FILE = Path(str(resources.files("trilat_net.studies.bench") / "bench_gains.json"))
KNOWLEDGE = ModelInformation()
"""All laws know gravity exactly."""
TUNING_BUDGET = 16
"""Candidates per gain of a law, at each delay."""
TUNING_MARGIN = 1.5
"""With the gains that are kept, the run is stable at the pose with so many times the delay,
too, and
"""
MARGIN_LENGTHS = 3.0
"""so many times as long: what is slow is not taken for what lacks the margin."""


class TunedGains(msgspec.Struct, frozen=True):
    """The gains of a law in a form of the tasks at a round trip.

    Attributes:
        gains: by name: of the stable candidates at the pose that have the margin those with the
            least error; none if there is no such candidate.
        settled: how many of the candidates were stable and at the pose.
        tried: how many there were.
        passed: how many of the stable ones with less error had not the margin.
        error_rad, effort_nm: of that candidate; None without one.
        fingerprint: of scenario and law.
    """

    form: str
    law: str
    round_trip_ms: int
    gains: dict[str, float]
    settled: int
    tried: int
    passed: int
    error_rad: float | None
    effort_nm: float | None
    fingerprint: str

    def __str__(self) -> str:
        return f"{self.law} ({self.form}, {self.round_trip_ms} ms)"


def name_settings(settings: Settings) -> list[str]:
    """Returns overrides as texts KEY=VALUE."""
    return [f"{key}={format_toml_value(value)}" for key, value in settings.items()]


def load_tuning_task(form: str, round_trip_ms: int) -> TuningScenario:
    """Returns the experiment in which the laws of a form are tuned."""
    return load_tuning_scenario(
        BASES[form], name_settings(build_settings(form, TUNING_TASK, f"rtt{round_trip_ms}"))
    )


@cache
def fingerprint_tuning(form: str, law: str, round_trip_ms: int) -> str:
    """Returns the fingerprint of what a law is tuned for: the scenario, the law's sources and
    its ranges.
    """
    space = SEARCH_SPACES[law]
    assert space.kind is not None
    sources = [
        module for module in (control, inspect.getmodule(space.kind)) if module is not None
    ]
    source = "".join(map(inspect.getsource, sources))
    ranges = json.dumps([knob._asdict() for knob in space.knobs])
    text = load_tuning_task(form, round_trip_ms).scenario.text
    return hashlib.sha256(
        "\0".join(
            (text, source, ranges, f"{TUNING_BUDGET} {TUNING_MARGIN} {MARGIN_LENGTHS}")
        ).encode()
    ).hexdigest()[:16]


def read_gains(path: Path = GAINS_FILE) -> dict[tuple[str, str, int], TunedGains]:
    """Returns all tuned gains, by form, law and round trip."""
    entries = (
        msgspec.json.decode(path.read_bytes(), type=list[TunedGains]) if path.exists() else []
    )
    return {(one.form, one.law, one.round_trip_ms): one for one in entries}


def find_stale(entries: Iterable[TunedGains]) -> list[str]:
    """Returns the gains that were tuned for another scenario, or for another text of the law."""
    return [
        str(one)
        for one in entries
        if fingerprint_tuning(one.form, one.law, one.round_trip_ms) != one.fingerprint
    ]


def choose_round_trip(mean_ms: float) -> int:
    """Returns at which round trip the gains for a link were tuned: the next one that is no
    shorter.
    """
    longer = (tuned_ms for tuned_ms in TUNED_ROUND_TRIPS_MS if tuned_ms >= mean_ms)
    return next(longer, TUNED_ROUND_TRIPS_MS[-1])


def _has_margin(form: str, round_trip_ms: int, search: CandidateSearch, place: int) -> bool:
    """Returns whether a candidate, as it is, is stable at the pose if delays are longer by the
    margin.
    """
    base = load_tuning_task(form, round_trip_ms)
    controls = search.space.controls(base.scenario, KNOWLEDGE, search.tried[place])
    longer = {
        "link.delay_ms": 0.5 * TUNING_MARGIN * round_trip_ms,
        "duration_s": MARGIN_LENGTHS * base.scenario.duration_s,
    }
    texts = (*base.overrides, *name_settings(longer))
    found = load_tuning_scenario(base.source, texts).with_controls(controls)
    return measure_candidate(*found.texts).outcome is CandidateClass.SETTLED


def tune_laws(
    wanted: Mapping[str, Sequence[str]],
    jobs: int | None = None,
    on: Workers = None,
    progress: Progress = ignore_progress,
    budget: int = TUNING_BUDGET,
) -> list[TunedGains]:
    """Tunes the laws of every form at every delay, with `budget` candidates per gain; returns
    their gains.

    `jobs` and `on` are those of `trilat_net.tune`; `progress` gets the tunings that are done,
    and all.
    """
    found: list[TunedGains] = []
    total = len(TUNED_ROUND_TRIPS_MS) * sum(map(len, wanted.values()))
    for form, laws in wanted.items():
        for round_trip_ms in TUNED_ROUND_TRIPS_MS:
            base = load_tuning_task(form, round_trip_ms)
            for size in sorted({len(SEARCH_SPACES[law].knobs) for law in laws}):
                alike = [law for law in laws if len(SEARCH_SPACES[law].knobs) == size]
                plan = plan_tuning(
                    base.source, base.overrides, laws=alike, budget=size * budget
                )
                found += [
                    _keep(form, round_trip_ms, one) for one in plan.run(jobs, on=on).found
                ]
                progress(len(found), total)
    return found


def _keep(form: str, round_trip_ms: int, search: CandidateSearch) -> TunedGains:
    law = search.space.law
    scores = search.scores
    settled = [n for n, score in enumerate(scores) if score.outcome is CandidateClass.SETTLED]
    candidates = sorted(settled, key=lambda n: scores[n].error_rad or 0.0)
    kept = (
        n for n, at in enumerate(candidates) if _has_margin(form, round_trip_ms, search, at)
    )
    passed = next(kept, len(candidates))
    place = candidates[passed] if passed < len(candidates) else None
    return TunedGains(
        form=form,
        law=law,
        round_trip_ms=round_trip_ms,
        gains={} if place is None else search.tried[place],
        settled=len(candidates),
        tried=len(search.tried),
        passed=passed,
        error_rad=None if place is None else scores[place].error_rad,
        effort_nm=None if place is None else scores[place].effort_nm,
        fingerprint=fingerprint_tuning(form, law, round_trip_ms),
    )


def write_gains(found: Sequence[TunedGains], path: Path = GAINS_FILE) -> None:
    """Writes gains into the file of the suite, in place of those of the same law, form and
    delay.
    """
    kept: dict[Any, TunedGains] = read_gains(path) | {
        (one.form, one.law, one.round_trip_ms): one for one in found
    }
    rows = [json.dumps(msgspec.to_builtins(kept[key])) for key in sorted(kept)]
    write_whole(path, "[\n" + ",\n".join(rows) + "\n]\n")


MAX_BENCH_SEEDS = 1000


class BenchCell(NamedTuple):
    """One law in a task over a link; with the gains that it has there."""

    task: str
    law: str
    link: str
    form: str
    tuned: TunedGains
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        """Its name in results."""
        return f"{self.task}/{self.law}/{self.link}"

    @property
    def inputs(self) -> str:
        """A digest of what its runs are made of: the scenario, task, link and gains."""
        parts = (
            _base_text(self.form),
            build_settings(self.form, self.task, self.link),
            self.tuned,
        )
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]

    @property
    def key(self) -> str:
        """What its runs are called in the journal, see `BenchRun.cell`."""
        return f"{self.name} {self.inputs}"

    def build(self, seed: int) -> TuningScenario:
        """Returns the experiment of one of its runs."""
        settings = name_settings(build_settings(self.form, self.task, self.link, seed))
        return load_tuning_scenario(BASES[self.form], settings).with_gains(
            SEARCH_SPACES[self.law], KNOWLEDGE, self.tuned.gains
        )


class BenchPlan(NamedTuple):
    """The suite, or a part of it, ready to run.

    Attributes:
        study: its name.
        cells: in the order in which they run.
        laws: all that were asked for, with their forms: those without cells have empty rows.
        without: of the gains in question those of which there are none.
    """

    study: str
    cells: list[BenchCell]
    laws: Sequence[tuple[str, str]]
    without: Sequence[TunedGains] = ()

    @property
    def tasks(self) -> list[str]:
        """The tasks that run, in order."""
        return list(dict.fromkeys(cell.task for cell in self.cells))

    @property
    def links(self) -> list[str]:
        """The links over which they run, in order."""
        return list(dict.fromkeys(cell.link for cell in self.cells))

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return sum(len(cell.seeds) for cell in self.cells)

    def cell(self, name: str) -> BenchCell:
        """Returns a cell by its name, as in contact/wave/rtt272.

        Raises:
            UsageError: there is none of that name.
        """
        names = {cell.name: cell for cell in self.cells}
        if name not in names:
            hint = suggest_nearest(name, list(names)) or f"; the first is {next(iter(names))}"
            raise UsageError(f"there is no cell {name!r}{hint}")
        return names[name]


@cache
def _base_text(form: str) -> str:
    return load_tuning_scenario(BASES[form]).scenario.text


def plan_bench(
    study: str = "full",
    *,
    tasks: Sequence[str] = (),
    laws: Sequence[str] = (),
    links: Sequence[str] = (),
    seeds: int | None = None,
) -> BenchPlan:
    """Returns the suite, checked and ready to run; its arguments are those of
    `trilat_net.bench`.

    Raises:
        UsageError: there is no such study, task, law or link, or no gains for a law.
    """
    asked = STUDIES[_choose("study", study, list(STUDIES))]
    if seeds is not None and not 1 <= seeds <= MAX_BENCH_SEEDS:
        raise UsageError(f"--seeds is how many, 1 to {MAX_BENCH_SEEDS}, not {seeds}")
    known = [law for laws_of_form in asked.laws.values() for law in laws_of_form]
    chosen_tasks = [_choose("task", name, list(asked.tasks)) for name in tasks] or list(
        asked.tasks
    )
    chosen_laws = [_choose("law", name, known) for name in laws] or known
    chosen_links = [_choose("link", name, list(LINKS)) for name in links] or list(asked.links)
    count = asked.seeds if seeds is None else seeds
    listed = list(
        _list_cells(
            study=asked, tasks=chosen_tasks, laws=chosen_laws, links=chosen_links, seeds=count
        )
    )
    cells = [cell for cell in listed if cell.tuned.gains]
    without = {str(cell.tuned): cell.tuned for cell in listed if not cell.tuned.gains}
    if not cells:
        names = ", ".join(chosen_tasks)
        why = (
            f"no candidate was stable for {', '.join(without)}"
            if without
            else f"{names} asks for two users"
        )
        raise UsageError(
            f"{', '.join(chosen_laws)}: {why}, or hands over; choose another task or link"
        )
    rows = [
        (law, form) for form, laws in asked.laws.items() for law in laws if law in chosen_laws
    ]
    return BenchPlan(study, cells, rows, list(without.values()))


def explain_no_cell(law: str, form: str, task: str) -> str:
    """Returns why a law does not run in a task, in the word of the tables; "no gains" if only
    they lack.
    """
    if TASKS[task].users > 1 and form != "three":
        return "-"
    fixed = "timeline" in TASKS[task].settings and BUILT_IN[law].Settings.fixed_shares
    return "no handover" if fixed else "no gains"


def _list_cells(
    study: BenchStudy,
    tasks: Sequence[str],
    laws: Sequence[str],
    links: Sequence[str],
    seeds: int,
) -> Iterator[BenchCell]:
    gains = read_gains()
    facts = {link: _describe_link(link) for link in links}
    for form, laws_of_form in study.laws.items():
        for law in (law for law in laws_of_form if law in laws):
            for task in (
                task for task in tasks if explain_no_cell(law, form, task) == "no gains"
            ):
                for link, (random, mean_ms) in facts.items():
                    at_ms = choose_round_trip(2.0 * mean_ms)
                    tuned = gains.get((form, law, at_ms))
                    if tuned is None:
                        remedy = f"make them: trilat bench --tune --law {law}"
                        raise UsageError(
                            f"there are no gains of {law} for {at_ms} ms; {remedy}"
                        )
                    chosen = tuple(range(1, 1 + (seeds if random else 1)))
                    yield BenchCell(
                        task=task, law=law, link=link, form=form, tuned=tuned, seeds=chosen
                    )


def _describe_link(link: str) -> tuple[bool, float]:
    """Returns if anything of a link is drawn, and its mean delay one way, ms."""
    scenario = load_tuning_scenario(
        BASES["two"], name_settings({"link": dict(LINKS[link])})
    ).scenario
    first = next(iter(scenario.links.values()))
    return scenario.random, first.moments().mean_ms


def _choose(option: str, name: str, known: Sequence[str]) -> str:
    if name not in known:
        hint = suggest_nearest(name, list(known)) or f"; there are {', '.join(known)}"
        raise UsageError(f"--{option}: there is no {option} {name!r} in it{hint}")
    return name
