"""Plans the benchmark of control laws: which law runs in which task, over which link.

Tasks and links (the delay and loss between the arms) are overrides of a scenario that ships
with the program, so every run can be reproduced with `trilat sim`. A cell is one law in one
task over one link, and runs once per random seed.

The gains of all laws are tuned by the same procedure, `trilat bench --tune`, which stores them
in a file. It selects the gains with the smallest error among those that remain stable when all
delays grow by the factor `TUNING_MARGIN`.

Invariant:
    - Gains are never set by hand, but always come from `trilat bench --tune`.
    - Gains are stored with a fingerprint of the scenario in which they were tuned and of the
      motion under the law. If the fingerprint no longer matches, the user is told.
    - A law for which no tried gains remain stable with longer delays gets no gains and does not
      run.
    - A selection that cannot run is rejected before the first run.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from trilat_net.core import DominanceMatrix
from trilat_net.errors import UsageError, suggest_nearest
from trilat_net.files import write_whole
from trilat_net.scenario import BUILT_IN, GRID_LOSSES_PERCENT, GRID_ROUND_TRIPS_MS
from trilat_net.work import Progress, Workers

from ..run_commands import format_toml_value
from ..tuning.candidate import CandidateClass, CandidateScore, TuningScenario
from ..tuning.search_space import SEARCH_SPACES, ModelInformation, SearchSpace
from ..tuning.tuning_plan import CandidateSearch, plan_tuning

Settings = Mapping[str, Any]
"""Scenario overrides, by key."""

BASES = {"three": "_bench_three", "two": "_bench_two", "level": "_bench_two"}
"""Maps each kind of scenario in the suite to the name of the shipped scenario.

"three" has two masters and a slave; "two" has a master and a slave. "level" has the same two
sites, but with the arms in a horizontal plane, so gravity does not act on them.
"""
_OUT = (-0.4557864690179811, 1.3957985827210313)
"""Joint angles in rad at which the end effector is 0.30 m further out than at the start.

The height of the end effector is the same as at the start.
"""
_LESS_OUT = (-0.4901506797631161, 1.484043235051833)
"""Joint angles in rad at which the end effector is only 0.24 m further out.

In contact, the pose is 0.09 m behind the wall, compared to 0.15 m for `_OUT`.
"""
_LEFT = (-0.4, 1.8)
"""Joint angles in rad to which the first of two users moves."""
_RIGHT = (-0.8, 1.8)
"""Joint angles in rad to which the second of two users moves."""
_HAND = {"kind": "spring", "stiffness_nm_rad": 50.0, "damping_nm_s_rad": 5.0}
"""Scenario table of an operator that pulls an arm with a spring and a damper."""
_WALL = {
    "kind": "wall",
    "point_m": [1.3376933693863516, 0.0],
    "normal": [-1.0, 0.0],
    "stiffness_n_m": 2000.0,
}
_CUT_S = (2.0, 5.0)
"""Start and end of the outage in the task `outage`, in s."""
_BURST_SAMPLES = 100.0
"""Mean number of consecutive samples that are lost."""
_FIRST = 0.75
"""Parameter a of `_build_dominance` while the first user dominates, as before a handover."""
_SECOND = 0.25
"""Parameter a of `_build_dominance` while the second user dominates, as after a handover."""


def _build_hand(
    to_rad: Sequence[float], move_start_s: float = 1.0, **keys: Any
) -> dict[str, Any]:
    """Returns the scenario table of an operator that moves an arm to a pose within 2 s.

    Args:
        to_rad: Joint angles of the pose, in rad.
        move_start_s: Time at which the motion starts, in s.
        keys: Additional keys for the table.
    """
    return {
        **_HAND,
        "to_rad": list(to_rad),
        "move_start_s": move_start_s,
        "move_end_s": move_start_s + 2.0,
        **keys,
    }


def _build_dominance(a: float) -> dict[str, dict[str, float]]:
    """Returns the scenario table of the dominance factors of two users and a slave.

    Args:
        a: Dominance factor of the first user over the slave. The second user has 1 - a.

    Returns:
        The nonzero factors, by the name of the arm and by the name of the arm that it follows.
    """
    names = ("m1", "m2", "s")
    matrix = DominanceMatrix.complementary(a).alpha.tolist()
    dominance = {}
    for name, factors in zip(names, matrix, strict=True):
        factors_by_peer = zip(names, factors, strict=True)
        dominance[name] = {peer: factor for peer, factor in factors_by_peer if factor}
    return dominance


class _BenchTask(NamedTuple):
    """A task of the benchmark: actions of the operators, and contacts of the slave arm.

    Attributes:
        about: Description of the task for the user.
        settings: Overrides that turn a shipped scenario into the task.
        users: Number of users that the task requires.
        cut_s: Time interval, in s, during which the slave arm is disconnected from all other
            arms. `None` if no connection fails.
        duration_s: Time from the start over which errors and efforts are measured, in s. A run
            lasts at least this long.
        gravity: Ratio of the gravity parameters that the laws get to the true gravity
            parameters.
    """

    about: str
    settings: Settings
    users: int = 1
    cut_s: tuple[float, float] | None = None
    duration_s: float = 20.0
    gravity: float = 1.0


_HANDOVER: dict[str, Any] = {
    "sites.m1.hands": [_build_hand(_LEFT, end_s=8.0)],
    "sites.m2.hands": [_build_hand(_RIGHT, 10.0, from_rad=list(_LEFT), start_s=8.0)],
    "dominance": _build_dominance(_FIRST),
    "timeline": [
        {"at_s": 7.0, "dominance": site, "to": row, "ramp_s": 2.0}
        for site, row in _build_dominance(_SECOND).items()
    ],
}
TASKS = {
    "free": _BenchTask(
        "a user moves the slave by 0.3 m", {"sites.m1.hands": [_build_hand(_OUT)]}
    ),
    "contact": _BenchTask(
        "like the task free, but half-way the slave hits a wall of 2000 N/m",
        {"sites.m1.hands": [_build_hand(_OUT)], "sites.s.environment": [_WALL]},
    ),
    "handover": _BenchTask(
        "the first user lets go while dominance passes to the second",
        _HANDOVER,
        users=2,
        duration_s=24.0,
    ),
    "disagree": _BenchTask(
        "two users hold poses 0.4 rad apart; the first user leads",
        {
            "sites.m1.hands": [_build_hand(_LEFT)],
            "sites.m2.hands": [_build_hand(_RIGHT)],
            "dominance": _build_dominance(_FIRST),
        },
        users=2,
    ),
    "outage": _BenchTask(
        "during free motion, all links of the slave fail for 3 s",
        {"sites.m1.hands": [_build_hand(_OUT)]},
        cut_s=_CUT_S,
    ),
    "gravity-90": _BenchTask(
        "like the task free, but the laws get 90 % of the true gravity parameters",
        {"sites.m1.hands": [_build_hand(_OUT)]},
        gravity=0.9,
    ),
}


def _build_constant_links() -> dict[str, Settings]:
    """Returns the links of the benchmark with a constant delay, with and without losses.

    Returns:
        The scenario keys of each link, by name. For example, "rtt68-loss50" has a round trip of
        68 ms and loses half of the samples.
    """
    links: dict[str, Settings] = {}
    for percent in GRID_LOSSES_PERCENT:
        for rtt_ms in GRID_ROUND_TRIPS_MS:
            name = f"rtt{rtt_ms}"
            # the delay of one direction is half of the round trip
            link_keys: dict[str, Any] = {"model": "constant", "delay_ms": rtt_ms / 2}
            if percent:
                name += f"-loss{percent}"
                # At 1 kHz, a single lost sample makes the reference only one tick older.
                link_keys |= {"loss": percent / 100, "loss_burst": _BURST_SAMPLES}
            links[name] = link_keys
    return links


LINKS: dict[str, Settings] = _build_constant_links()
"""Scenario overrides of each link, by name. Losses come in bursts of 0.1 s."""
LINKS |= {name: {"preset": name} for name in ("4g", "5g", "geo")}
LINKS["trace"] = {"model": "trace", "file": "busy_machine.csv", "at_end": "loop"}

_MEAN_MS = {"geo": 300.0}
"""Mean one-way delays of presets with long delays, in ms.

Over these links, `ROUND_TRIPS` round trips take longer than the tasks, so the runs are longer.
"""

SHORTER_REACH: Settings = {"sites.m1.hands": [_build_hand(_LESS_OUT)]}
"""Overrides that shorten the reach in the task `contact`.

The stiffness at the hand is computed from the difference between the two reaches.
"""

EQUAL_LAWS = {"six_channel": "four_channel"}
"""Laws that the suite omits, each mapped to the law of the suite that computes the same torque.

`six_channel` is `four_channel` with a check that all dominance factors are functions of one
parameter. This is true of every task, since a task has the same factors for all laws. Using
`six_channel` with other factors would amount to comparing it in a different task.
"""
_ROLES = ("master", "master", "slave")
_TUNED_LAWS = {
    name: law for name, law in BUILT_IN.items() if law.tune and name not in EQUAL_LAWS
}
LAWS_OF_ANY = tuple(name for name, law in _TUNED_LAWS.items() if not law.explain_misfit(_ROLES))
"""Names of the tuned laws that can be used with two users and a slave."""
LAWS_OF_TWO = tuple(name for name in _TUNED_LAWS if name not in LAWS_OF_ANY)
"""Names of the tuned laws that can be used with two sites only."""
TUNED_ROUND_TRIPS_MS = (68, 272, 1088)
"""Network round trips for which every law is tuned, in ms."""
TUNING_TASK = "contact"
"""The task in which laws are tuned.

The tuning also runs it without the wall, as free motion.
"""
_OTHER_TUNING_TASKS = {("three", "sync"): "free"}
"""Laws that are tuned in another task, by kind of scenario and name of the law.

Under gravity, the arms can rest only at q = 0 with the law `sync`. The wall keeps the slave
away from this pose, so no gains bring the arms to rest in `contact`.
"""


class _BenchStudy(NamedTuple):
    """A named part of the benchmark: a selection of tasks, control laws and links.

    The study runs every law in every task over every link, except where a law is not suitable
    for a task.

    Attributes:
        about: Purpose of the study.
        tasks: Names of the tasks.
        laws: Names of the control laws, by the kind of scenario in which they run (a key of
            `BASES`, such as "two" for two arms).
        links: Names of the links, keys of `LINKS`.
        seeds: Number of runs of a law in a task over a link with random delays or losses. Over
            a link without randomness, the law runs once.
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
FULL_SEEDS = 1
"""Number of runs over a random link in the large studies, which take about an hour on two
cores.
"""
STUDIES = {
    "full": _BenchStudy(
        about="all laws in all tasks",
        tasks=tuple(TASKS),
        laws=_ALL_LAWS,
        links=_COARSE,
        seeds=FULL_SEEDS,
    ),
    "small": _BenchStudy(
        about="all laws in all tasks, over three links",
        tasks=tuple(TASKS),
        laws=_ALL_LAWS,
        links=("rtt68", "rtt136-loss50", "4g"),
        seeds=2,
    ),
    "round-trips": _BenchStudy(
        about="after Rodriguez-Seda, Lee and Spong (2009): wave variables, a Smith predictor, "
        "synchronisation, and P+d with its relatives, between two level arms, over a grid of "
        "round trips and losses",
        tasks=("free", "contact"),
        laws={"level": ("wave", "smith", "sync", "adaptive", "p_d", "pd_d", "lee_spong")},
        links=_GRID,
        seeds=FULL_SEEDS,
    ),
}


ROUND_TRIPS = 40
"""Minimum duration of a run, in round trips of its link."""


def build_settings(form: str, task: str, link: str, seed: int | None = None) -> dict[str, Any]:
    """Returns the scenario overrides for a benchmark run, excluding the control law.

    The overrides turn a shipped scenario into the requested task over the requested link, and
    set a duration of at least `ROUND_TRIPS` round trips of the link.

    Args:
        form: Kind of shipped scenario, a key of `BASES`, which determines the number of arms
            and whether gravity acts on them.
        task: Name of the task, a key of `TASKS`.
        link: Name of the network link, a key of `LINKS`.
        seed: Random seed of the run. If `None`, the scenario's own seed is kept.
    """
    bench_task = TASKS[task]
    link_keys = dict(LINKS[link])
    delay_ms = link_keys.get("delay_ms", _MEAN_MS.get(link, 0.0))
    # The factor 2e-3 converts a one-way delay in ms to a round trip in s.
    round_trips_s = 2e-3 * ROUND_TRIPS * delay_ms
    settings = {
        **bench_task.settings,
        "link": link_keys,
        "duration_s": max(bench_task.duration_s, round_trips_s),
    }

    if bench_task.cut_s is not None:
        link_keys["outages_s"] = [list(bench_task.cut_s)]
        if form == "three":
            # The outage concerns the slave only: the users still receive each other's samples.
            settings["links.m1->m2.outages_s"] = []
            settings["links.m2->m1.outages_s"] = []
    if form == "level":
        settings["arm.g_m_s2"] = 0.0
    if seed is not None:
        settings["seed"] = seed
    return settings


GAINS_FILE = Path(str(resources.files("trilat_studies.bench") / "bench_gains.json"))
"""File of the tuned gains, which ships with the program."""
KNOWLEDGE = ModelInformation()
"""Model information available to the laws in the tuning: all laws know gravity exactly."""
TUNING_BUDGET = 16
"""Number of candidates per gain of a law, at each round trip."""
TUNING_MARGIN = 1.5
"""Factor by which delays may grow without making the selected gains unstable."""
MARGIN_LENGTHS = 3.0
"""Ratio of the duration of the run with longer delays to that of the tuning run.

With equal durations, a law whose arms come to rest slowly would appear to be unstable.
"""


class TunedGains(msgspec.Struct, frozen=True):
    """Gains of a control law, tuned for one kind of scenario and one round-trip time.

    The tuning tries `tried` candidates. Of those that come to rest at the pose of the task even
    when delays grow by the factor `TUNING_MARGIN`, it selects the one with the smallest error.

    Attributes:
        form: Kind of scenario in which the law runs, a key of `BASES`.
        law: Name of the control law.
        round_trip_ms: Round trip for which the gains were tuned, in ms.
        gains: The selected gains by name. Empty if no candidate stayed stable with longer
            delays.
        settled: Number of candidates that came to rest at the pose.
        tried: Number of all candidates.
        passed: Number of candidates that had a smaller error than the selected one but were
            rejected because they do not stay stable with longer delays.
        error_rad: Error of the selected candidate, in rad. `None` if no candidate was selected.
        effort_nm: Effort of the selected candidate, in N m. `None` if no candidate was
            selected.
        fingerprint: Fingerprint of the scenario and the law, see `fingerprint_tuning`.
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

    @property
    def key(self) -> tuple[str, str, int]:
        """Identifies these gains in the gains file: scenario kind, law and round trip in ms."""
        return self.form, self.law, self.round_trip_ms

    @property
    def is_stale(self) -> bool:
        """True if the law or the scenario has changed since these gains were tuned.

        A law with stale gains must be tuned again, see `fingerprint_tuning`.
        """
        return fingerprint_tuning(*self.key) != self.fingerprint

    def __str__(self) -> str:
        return f"{self.law} ({self.form}, {self.round_trip_ms} ms)"


def format_settings(settings: Settings) -> list[str]:
    """Converts scenario overrides to KEY=VALUE strings for the command line.

    Args:
        settings: Mapping from scenario key to value.
    """
    return [f"{key}={format_toml_value(value)}" for key, value in settings.items()]


def load_tuning_task(form: str, law: str, round_trip_ms: int) -> TuningScenario:
    """Loads the scenario in which the benchmark tunes a law for a given network round trip.

    Args:
        form: Kind of scenario, a key of `BASES`, such as "two" for two arms.
        law: Name of the control law. The returned scenario does not contain it yet.
        round_trip_ms: Round trip of the links between the arms, in ms.
    """
    task = _OTHER_TUNING_TASKS.get((form, law), TUNING_TASK)
    settings = build_settings(form, task, f"rtt{round_trip_ms}")
    return TuningScenario.load(BASES[form], format_settings(settings))


TUNING_VERSION = 2
"""Version of the tuning procedure. Gains tuned with an earlier version are out of date.

Since the second version, a law may define its own objective.
"""


def _probe_law(task: TuningScenario, space: SearchSpace) -> str:
    """Runs a law in its tuning task with fixed gains, and formats its error and effort.

    The string reveals whether the law still moves the arms as it did when its gains were tuned.
    A digest of the source code would not do, because it also changes with a comment, a name or
    an import.

    Args:
        task: The task in which the law was tuned.
        space: The law and the ranges of its gains. Each gain is set to the middle of its range,
            on a logarithmic scale unless the range begins at zero.
    """
    gains = {}
    for gain in space.knobs:
        geometric_mean = math.sqrt(gain.low * gain.high)
        gains[gain.name] = geometric_mean if gain.low > 0 else 0.5 * gain.high
    candidate = task.with_gains(space, KNOWLEDGE, gains)
    score = CandidateScore.measure(*candidate.texts)
    if score.error_rad is None or score.effort_nm is None:  # the run diverged
        return f"{score.outcome.name} at {score.diverged_s} s"
    return f"{score.outcome.name}: {score.error_rad:.9g} rad, {score.effort_nm:.9g} N m"


@cache
def fingerprint_tuning(form: str, law: str, round_trip_ms: int) -> str:
    """Returns a digest of everything that determines the tuned gains of a law.

    The digest covers the scenario, the error and effort of the law in a test run, the ranges in
    which the gains are searched, and the tuning procedure. Stored gains with a different
    fingerprint were tuned for another experiment or another version of the law.

    Args:
        form: Kind of scenario in which the law runs, a key of `BASES`.
        law: Name of the control law.
        round_trip_ms: Round trip for which the law is tuned, in ms.
    """
    space = SEARCH_SPACES[law]
    task = load_tuning_task(form, law, round_trip_ms)
    ranges = json.dumps([knob._asdict() for knob in space.knobs])
    procedure = f"{TUNING_VERSION} {TUNING_BUDGET} {TUNING_MARGIN} {MARGIN_LENGTHS}"
    content = "\0".join([task.scenario.text, _probe_law(task, space), ranges, procedure])
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def read_gains(path: Path = GAINS_FILE) -> dict[tuple[str, str, int], TunedGains]:
    """Reads the tuned gains of the benchmark from their file.

    Args:
        path: Path of the gains file.

    Returns:
        The gains, keyed by scenario kind, law and round trip in ms. Empty if the file does not
        exist.
    """
    if not path.exists():
        return {}
    entries = msgspec.json.decode(path.read_bytes(), type=list[TunedGains])
    return {gains.key: gains for gains in entries}


def choose_round_trip(mean_ms: float) -> int:
    """Selects the round-trip time whose tuned gains a link should use, in ms.

    This is the shortest round-trip time with tuned gains that is at least as long as the mean
    round trip of the link, or the longest if all of them are shorter.

    Args:
        mean_ms: Mean round trip of the link, in ms.
    """
    for tuned_ms in TUNED_ROUND_TRIPS_MS:
        if tuned_ms >= mean_ms:
            return tuned_ms
    return TUNED_ROUND_TRIPS_MS[-1]


def _has_margin(form: str, round_trip_ms: int, search: CandidateSearch, candidate: int) -> bool:
    """Returns True if a candidate still comes to rest at the pose with longer delays.

    Delays are multiplied by `TUNING_MARGIN`, and the run lasts `MARGIN_LENGTHS` times as long.

    Args:
        form: Kind of scenario in which the law runs, a key of `BASES`.
        round_trip_ms: Round trip for which the law is tuned, in ms.
        search: The search that tried the candidate.
        candidate: Index of the candidate in the search. Its gains are used unchanged.
    """
    task = load_tuning_task(form, search.space.law, round_trip_ms)
    control_tables = search.space.controls(task.scenario, KNOWLEDGE, search.tried[candidate])
    longer_delays = {
        "link.delay_ms": 0.5 * TUNING_MARGIN * round_trip_ms,
        "duration_s": MARGIN_LENGTHS * task.scenario.duration_s,
    }
    overrides = (*task.overrides, *format_settings(longer_delays))
    longer_task = TuningScenario.load(task.source, overrides)
    candidate_task = longer_task.with_controls(control_tables)
    score = CandidateScore.measure(*candidate_task.texts)
    return score.outcome is CandidateClass.SETTLED


def tune_laws(
    laws_by_form: Mapping[str, Sequence[str]],
    jobs: int | None = None,
    on: Workers = None,
    progress: Progress | None = None,
    budget: int = TUNING_BUDGET,
    known: Iterable[TunedGains] = (),
    store: Callable[[TunedGains], None] = lambda _: None,
) -> list[TunedGains]:
    """Tunes control laws for the benchmark, once for each round trip in `TUNED_ROUND_TRIPS_MS`.

    Known gains that are up to date are not tuned again, so an interrupted tuning can be
    continued.

    Args:
        laws_by_form: Mapping from kind of scenario (a key of `BASES`, such as "two" for two
            arms) to the names of the laws to tune in it.
        jobs: Number of processes, as for `trilat_net.tune`.
        on: Cluster that evaluates the gains, as for `trilat_net.tune`.
        progress: Called with the number of completed tunings and the total number of tunings.
        budget: Number of gain vectors to try per gain of a law. A law with three gains gets
            three times this number.
        known: Gains from earlier tunings. Stale gains are ignored.
        store: Called with the gains of a law at one round trip as soon as they are tuned. Not
            called for known gains.

    Returns:
        The gains of every law at every round trip.
    """
    known_by_key = {gains.key: gains for gains in known if not gains.is_stale}
    tuned: list[TunedGains] = []
    total = len(TUNED_ROUND_TRIPS_MS) * sum(map(len, laws_by_form.values()))
    for form, laws in laws_by_form.items():
        for round_trip_ms in TUNED_ROUND_TRIPS_MS:
            for law in laws:
                gains = known_by_key.get((form, law, round_trip_ms))
                if gains is None:
                    gains = _tune_law(form, law, round_trip_ms, jobs, on, budget)
                    store(gains)
                tuned.append(gains)
                if progress is not None:
                    progress(len(tuned), total)
    return tuned


def _tune_law(
    form: str, law: str, round_trip_ms: int, jobs: int | None, on: Workers, budget: int
) -> TunedGains:
    """Tunes the gains of one control law for one network round trip.

    Args:
        form: Kind of scenario in which the law runs, a key of `BASES`.
        law: Name of the law.
        round_trip_ms: Round trip of the links, in ms.
        jobs: Number of processes.
        on: Cluster that evaluates the gains.
        budget: Number of gain vectors to try, per gain of the law.
    """
    base = load_tuning_task(form, law, round_trip_ms)
    gain_count = len(SEARCH_SPACES[law].knobs)
    plan = plan_tuning(
        base.source,
        base.overrides,
        laws=[law],
        budget=gain_count * budget,
    )
    (search,) = plan.run(jobs, on=on).found
    return _select_gains(form, round_trip_ms, search)


def _select_gains(form: str, round_trip_ms: int, search: CandidateSearch) -> TunedGains:
    """Selects the candidate with the smallest error that stays stable with longer delays.

    Args:
        form: Kind of scenario in which the law runs, a key of `BASES`.
        round_trip_ms: Round trip for which the law is tuned, in ms.
        search: The finished search of one law.
    """
    law = search.space.law
    scores = search.scores
    settled = []
    for index, score in enumerate(scores):
        if score.outcome is CandidateClass.SETTLED:
            settled.append(index)
    settled.sort(key=lambda index: scores[index].error_rad or 0.0)

    # Checking the margin takes another run. Candidates are therefore checked in the order of
    # their errors until one has the margin.
    selected = None
    rejected = 0
    for candidate in settled:
        if _has_margin(form, round_trip_ms, search, candidate):
            selected = candidate
            break
        rejected += 1

    return TunedGains(
        form=form,
        law=law,
        round_trip_ms=round_trip_ms,
        gains={} if selected is None else search.tried[selected],
        settled=len(settled),
        tried=len(search.tried),
        passed=rejected,
        error_rad=None if selected is None else scores[selected].error_rad,
        effort_nm=None if selected is None else scores[selected].effort_nm,
        fingerprint=fingerprint_tuning(form, law, round_trip_ms),
    )


def write_gains(tuned: Sequence[TunedGains], path: Path = GAINS_FILE) -> None:
    """Merges newly tuned gains into the gains file.

    Args:
        tuned: The gains to write. They replace gains in the file that have the same kind of
            scenario, control law and round trip. All others are kept.
        path: Path of the JSON file.
    """
    entries = read_gains(path)
    for gains in tuned:
        entries[gains.key] = gains
    rows = [json.dumps(msgspec.to_builtins(entries[key])) for key in sorted(entries)]
    write_whole(path, "[\n" + ",\n".join(rows) + "\n]\n")


MAX_BENCH_SEEDS = 1000
"""Largest number of seeds that a user may request."""


class BenchCell(NamedTuple):
    """One cell of the benchmark: a control law in one task over one link, with gains and seeds.

    Attributes:
        task: A key of `TASKS`.
        law: Name of the control law.
        link: A key of `LINKS`.
        form: Kind of scenario in which the law runs, a key of `BASES`.
        tuned: Gains of the law for this link.
        seeds: Random seeds, one run each.
    """

    task: str
    law: str
    link: str
    form: str
    tuned: TunedGains
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of this cell in results: task, law and link, as in "contact/wave/rtt272"."""
        return f"{self.task}/{self.law}/{self.link}"

    @property
    def inputs(self) -> str:
        """Hash of everything that determines these simulations: scenario, task, link and gains.

        Stored results with a different hash are out of date and are ignored.
        """
        parts = (
            _load_base_text(self.form),
            build_settings(self.form, self.task, self.link),
            TASKS[self.task].gravity,
            self.tuned,
        )
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]

    @property
    def key(self) -> str:
        """Name of this cell in the journal of finished runs.

        The name contains the hash `inputs`, so runs with different gains are not mistaken for
        runs of this cell.
        """
        return f"{self.name} {self.inputs}"

    def build(self, seed: int) -> TuningScenario:
        """Returns the scenario of one run of this cell, with the tuned gains.

        Args:
            seed: Random seed of the run.
        """
        settings = build_settings(self.form, self.task, self.link, seed)
        base = TuningScenario.load(BASES[self.form], format_settings(settings))
        knowledge = ModelInformation(TASKS[self.task].gravity)
        return base.with_gains(SEARCH_SPACES[self.law], knowledge, self.tuned.gains)


class BenchPlan(NamedTuple):
    """All simulations of the benchmark, or of part of it, ready to be executed.

    Attributes:
        study: Name of the study, which is a selection of tasks, laws and links.
        cells: The combinations of task, control law and link to run, in order of execution.
        laws: Pairs of a selected law and the kind of scenario in which it runs (a key of
            `BASES`). A law without any run still has a row in the tables, with no values.
        without: Tunings of selected laws that found no stable gains. These laws do not run over
            the links that would use those tunings.
    """

    study: str
    cells: list[BenchCell]
    laws: Sequence[tuple[str, str]]
    without: Sequence[TunedGains] = ()

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks to run, each listed once, in order of execution."""
        return list(dict.fromkeys(cell.task for cell in self.cells))

    @property
    def links(self) -> list[str]:
        """Names of the network links to simulate, in the order used in the figures."""
        return list(dict.fromkeys(cell.link for cell in self.cells))

    @property
    def runs(self) -> int:
        """Number of simulations: one per cell and random seed.

        Repetitions that confirm a result are not counted.
        """
        return sum(len(cell.seeds) for cell in self.cells)

    def cell(self, name: str) -> BenchCell:
        """Looks up a cell by name.

        Args:
            name: Task, law and link, as in "contact/wave/rtt272".

        Raises:
            UsageError: No cell has that name.
        """
        cells = {cell.name: cell for cell in self.cells}
        if name not in cells:
            hint = suggest_nearest(name, list(cells)) or f"; the first is {next(iter(cells))}"
            raise UsageError(f"there is no cell {name!r}{hint}")
        return cells[name]


@cache
def _load_base_text(form: str) -> str:
    """Returns the TOML text of a shipped scenario of the benchmark, with all defaults.

    The text is part of the fingerprint of tuned gains, because gains become out of date when a
    default changes.

    Args:
        form: Kind of scenario, a key of `BASES`.
    """
    return TuningScenario.load(BASES[form]).scenario.text


def plan_bench(
    study: str = "full",
    *,
    tasks: Sequence[str] = (),
    laws: Sequence[str] = (),
    links: Sequence[str] = (),
    seeds: int | None = None,
) -> BenchPlan:
    """Plans one of the benchmark's studies, or part of it.

    Args:
        study: A key of `STUDIES`.
        tasks: Names of the tasks to run. If empty, all tasks of the study.
        laws: Names of the laws to run. If empty, all laws of the study.
        links: Names of the links to run over, which may be any keys of `LINKS`. If empty, all
            links of the study.
        seeds: Number of random seeds. If `None`, the study's own number is used.

    Returns:
        The checked plan, ready to run.

    Raises:
        UsageError: A name is unknown, a law has not been tuned, or no cell can run.
    """
    bench_study = STUDIES[_check_name("study", study, list(STUDIES))]
    if seeds is None:
        seeds = bench_study.seeds
    elif not 1 <= seeds <= MAX_BENCH_SEEDS:
        raise UsageError(f"--seeds must be a number from 1 to {MAX_BENCH_SEEDS}, not {seeds}")
    all_laws = [law for form_laws in bench_study.laws.values() for law in form_laws]
    for law in laws:
        if law in EQUAL_LAWS:
            equal = EQUAL_LAWS[law]
            raise UsageError(
                f"--law: {law} computes the torque of {equal} in all tasks of the suite; "
                f"choose {equal}"
            )
    tasks = _select_names("task", tasks, default=bench_study.tasks)
    laws = _select_names("law", laws, default=all_laws)
    links = _select_names("link", links, default=bench_study.links, known=list(LINKS))

    tuned_cells = list(
        _list_cells(study=bench_study, tasks=tasks, laws=laws, links=links, seeds=seeds)
    )
    cells = [cell for cell in tuned_cells if cell.tuned.gains]
    # keyed by name, so that gains that several cells share are listed once
    without = {str(cell.tuned): cell.tuned for cell in tuned_cells if not cell.tuned.gains}
    if not cells:
        raise UsageError(_explain_no_cells(tasks, laws, list(without)))

    rows = []
    for form, form_laws in bench_study.laws.items():
        rows += [(law, form) for law in form_laws if law in laws]
    return BenchPlan(study, cells, rows, list(without.values()))


def _explain_no_cells(tasks: Sequence[str], laws: Sequence[str], without: list[str]) -> str:
    """Returns the error message for a selection of laws that run in none of the selected tasks.

    Args:
        tasks: Names of the selected tasks.
        laws: Names of the selected laws.
        without: Tunings of these laws that found no gains. Empty if the reason is that the laws
            are not suitable for the tasks.
    """
    law_names = ", ".join(laws)
    if without:
        return (
            f"{law_names}: no candidate was stable for {', '.join(without)}; "
            "choose another link or law"
        )
    return (
        f"{law_names} cannot run in {', '.join(tasks)}: two users, a handover or wrong gravity "
        "parameters are more than the law supports; choose another task or law"
    )


NO_GAINS = "no gains"
"""Reason for a missing cell: the tuning found no gains for the law."""


def explain_no_cell(law: str, form: str, task: str) -> str:
    """Returns the table entry that explains why a law is not simulated in a task.

    Args:
        law: Name of the control law.
        form: Kind of scenario in which the law runs, a key of `BASES`. For example, "three" has
            two users and a slave arm, and "two" has a single user.
        task: Name of the task, a key of `TASKS`.

    Returns:
        - "-" if the task needs two users and the scenario has only one.
        - "no handover" if one user hands over control to the other in this task and the law
          cannot change the users' shares.
        - "exact model" if this task gives the law wrong gravity parameters, but the law always
          uses the exact model of the arm.
        - `NO_GAINS` otherwise, which means that the tuning found no stable gains for the law.
    """
    bench_task = TASKS[task]
    if bench_task.users > 1 and form != "three":
        return "-"
    if "timeline" in bench_task.settings and BUILT_IN[law].Settings.fixed_shares:
        return "no handover"
    if bench_task.gravity != 1.0 and not _gets_gravity(form, law):
        return "exact model"
    return NO_GAINS


@cache
def _gets_gravity(form: str, law: str) -> bool:
    """Returns True if a law uses the gravity parameters that the benchmark passes to it.

    A law that takes the exact model of the arm cannot run in a task with wrong parameters.

    Args:
        form: Kind of scenario in which the law runs, a key of `BASES`.
        law: Name of the control law.
    """
    space = SEARCH_SPACES[law]
    scenario = TuningScenario.load(BASES[form]).scenario
    least_gains = {knob.name: knob.low for knob in space.knobs}
    with_exact_gravity = space.controls(scenario, KNOWLEDGE, least_gains)
    with_wrong_gravity = space.controls(scenario, ModelInformation(0.9), least_gains)
    return with_wrong_gravity != with_exact_gravity


def _list_cells(
    study: _BenchStudy,
    tasks: Sequence[str],
    laws: Sequence[str],
    links: Sequence[str],
    seeds: int,
) -> Iterator[BenchCell]:
    """Yields the cells for all combinations of the selected tasks, laws and links.

    Tasks for which a law is not suitable are skipped. Cells whose tuning found no gains are
    included.

    Args:
        study: The study.
        tasks: Names of the selected tasks.
        laws: Names of the selected laws.
        links: Names of the selected links.
        seeds: Number of runs of a cell whose link is random. Any other cell runs once.

    Raises:
        UsageError: A law has not been tuned for one of the links.
    """
    gains = read_gains()
    link_properties = {link: _analyse_link(link) for link in links}
    for form, form_laws in study.laws.items():
        for law in form_laws:
            if law not in laws:
                continue
            for task in tasks:
                if explain_no_cell(law, form, task) != NO_GAINS:
                    continue
                for link, (is_random, mean_ms) in link_properties.items():
                    # Without drawn delays or losses, further seeds would repeat the same run.
                    run_count = seeds if is_random else 1
                    yield BenchCell(
                        task=task,
                        law=law,
                        link=link,
                        form=form,
                        tuned=_find_gains(gains, form, law, mean_ms),
                        seeds=tuple(range(1, 1 + run_count)),
                    )


def _find_gains(
    gains: Mapping[tuple[str, str, int], TunedGains], form: str, law: str, delay_ms: float
) -> TunedGains:
    """Looks up the tuned gains that a law uses over a link.

    Args:
        gains: All tuned gains, by form, law and round trip in ms.
        form: Kind of scenario in which the law runs, a key of `BASES`.
        law: Name of the control law.
        delay_ms: Mean one-way delay of the link, in ms.

    Raises:
        UsageError: The law has not been tuned for that delay.
    """
    round_trip_ms = choose_round_trip(2.0 * delay_ms)
    tuned = gains.get((form, law, round_trip_ms))
    if tuned is None:
        raise UsageError(
            f"{law} has no gains for a round trip of {round_trip_ms} ms; tune the law with: "
            f"trilat bench --tune --law {law}"
        )
    return tuned


def _analyse_link(link: str) -> tuple[bool, float]:
    """Determines the mean delay of a link of the benchmark, and whether the link is random.

    Args:
        link: A key of `LINKS`.

    Returns:
        True if the delays or losses of the link are random; and its mean one-way delay, in ms.
    """
    settings = format_settings({"link": dict(LINKS[link])})
    scenario = TuningScenario.load(BASES["two"], settings).scenario
    first = next(iter(scenario.links.values()))
    return scenario.random, first.moments().mean_ms


def _select_names(
    option: str,
    names: Sequence[str],
    *,
    default: Sequence[str],
    known: Sequence[str] | None = None,
) -> list[str]:
    """Returns the names given for an option, or the default if the user gave none.

    Args:
        option: The option, without its dashes.
        names: Names from the user.
        default: Names to use if the user gave none.
        known: Valid names. If `None`, those in `default`.

    Raises:
        UsageError: A name is unknown.
    """
    if known is None:
        known = default
    return [_check_name(option, name, known) for name in names] or list(default)


def _check_name(option: str, name: str, known: Sequence[str]) -> str:
    """Returns the name given for an option, or raises UsageError if it is unknown.

    Raises:
        UsageError: The name is unknown. The message suggests a similar name.
    """
    if name not in known:
        hint = suggest_nearest(name, list(known)) or f"; available: {', '.join(known)}"
        raise UsageError(f"--{option}: no {option} {name!r} is available{hint}")
    return name
