"""The gains of the suite: each law tuned by the one procedure at three delays, and kept in a file.

Invariant: gains come from `trilat bench --tune` alone. Each entry has the fingerprint of what it was tuned
for, the resolved scenario and the sources of the law: a stale one is named wherever it is used. A law of
which no candidate keeps the margin has none, and no runs.
"""

import hashlib
import inspect
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from ...core import control
from ...files import write_whole
from ..commands import format_toml_value
from ..executor import Progress, Workers, ignore_progress
from ..tuning.candidate import TuningScenario, load_tuning_scenario, measure_candidate
from ..tuning.final_posture import CandidateClass
from ..tuning.pareto_search import CandidateSearch
from ..tuning.search_space import SEARCH_SPACES, ModelInformation
from ..tuning.tuning_plan import plan_tuning
from .bench_tasks import BASES, TUNED_ROUND_TRIPS_MS, TUNING_TASK, Settings, build_settings

GAINS_FILE = Path(str(resources.files("trilat_net.studies.bench") / "bench_gains.json"))
KNOWLEDGE = ModelInformation()
"""All laws know gravity exactly."""
TUNING_BUDGET = 16
"""Candidates per gain of a law, at each delay."""
TUNING_MARGIN = 1.5
"""With the gains that are kept, the run is stable at the pose with so many times the delay, too, and"""
MARGIN_LENGTHS = 3.0
"""so many times as long: what is slow is not taken for what lacks the margin."""


class TunedGains(msgspec.Struct, frozen=True):
    """The gains of a law in a form of the tasks at a round trip.

    Attributes:
        gains: by name: of the stable candidates at the pose that have the margin those with the least error;
            none if there is no such candidate.
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
    """Returns the fingerprint of what a law is tuned for: the scenario, the law's sources and its ranges."""
    space = SEARCH_SPACES[law]
    assert space.kind is not None
    sources = [module for module in (control, inspect.getmodule(space.kind)) if module is not None]
    source = "".join(map(inspect.getsource, sources))
    ranges = json.dumps([knob._asdict() for knob in space.knobs])
    text = load_tuning_task(form, round_trip_ms).scenario.text
    return hashlib.sha256(
        "\0".join((text, source, ranges, f"{TUNING_BUDGET} {TUNING_MARGIN} {MARGIN_LENGTHS}")).encode()
    ).hexdigest()[:16]


def read_gains(path: Path = GAINS_FILE) -> dict[tuple[str, str, int], TunedGains]:
    """Returns all tuned gains, by form, law and round trip."""
    entries = msgspec.json.decode(path.read_bytes(), type=list[TunedGains]) if path.exists() else []
    return {(one.form, one.law, one.round_trip_ms): one for one in entries}


def find_stale(entries: Iterable[TunedGains]) -> list[str]:
    """Returns the gains that were tuned for another scenario, or for another text of the law."""
    return [
        str(one)
        for one in entries
        if fingerprint_tuning(one.form, one.law, one.round_trip_ms) != one.fingerprint
    ]


def choose_round_trip(mean_ms: float) -> int:
    """Returns at which round trip the gains for a link were tuned: the next one that is no shorter."""
    longer = [tuned_ms for tuned_ms in TUNED_ROUND_TRIPS_MS if tuned_ms >= mean_ms]
    return longer[0] if longer else TUNED_ROUND_TRIPS_MS[-1]


def list_candidates(search: CandidateSearch) -> list[int]:
    """Returns the places of the candidates that are stable at the pose, those with the least error first."""
    settled = [n for n, score in enumerate(search.scores) if score.outcome is CandidateClass.SETTLED]
    return sorted(settled, key=lambda n: search.scores[n].error_rad or 0.0)


def _has_margin(form: str, round_trip_ms: int, search: CandidateSearch, place: int) -> bool:
    """Returns whether a candidate, as it is, is stable at the pose if delays are longer by the margin."""
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
    """Tunes laws at every delay, and returns their gains.

    Args:
        wanted: per form the laws.
        jobs: processes of this machine.
        on: what runs the candidates instead.
        progress: called with the tunings that are done, and their number.
        budget: candidates per gain of a law, at each delay.
    """
    found: list[TunedGains] = []
    total = len(TUNED_ROUND_TRIPS_MS) * sum(map(len, wanted.values()))
    for form, laws in wanted.items():
        for round_trip_ms in TUNED_ROUND_TRIPS_MS:
            settings = name_settings(build_settings(form, TUNING_TASK, f"rtt{round_trip_ms}"))
            for size in sorted({len(SEARCH_SPACES[law].knobs) for law in laws}):
                alike = [law for law in laws if len(SEARCH_SPACES[law].knobs) == size]
                plan = plan_tuning(BASES[form], settings, laws=alike, budget=size * budget)
                found += [_keep(form, round_trip_ms, one) for one in plan.run(jobs, on=on).found]
                progress(len(found), total)
    return found


def _keep(form: str, round_trip_ms: int, search: CandidateSearch) -> TunedGains:
    law, candidates = search.space.law, list_candidates(search)
    passed = 0
    while passed < len(candidates) and not _has_margin(form, round_trip_ms, search, candidates[passed]):
        passed += 1
    place = candidates[passed] if passed < len(candidates) else None
    return TunedGains(
        form=form,
        law=law,
        round_trip_ms=round_trip_ms,
        gains={} if place is None else search.tried[place],
        settled=len(candidates),
        tried=len(search.tried),
        passed=passed,
        error_rad=None if place is None else search.scores[place].error_rad,
        effort_nm=None if place is None else search.scores[place].effort_nm,
        fingerprint=fingerprint_tuning(form, law, round_trip_ms),
    )


def write_gains(found: Sequence[TunedGains], path: Path = GAINS_FILE) -> None:
    """Writes gains into the file of the suite, in place of those of the same law, form and delay."""
    kept: dict[Any, TunedGains] = read_gains(path) | {
        (one.form, one.law, one.round_trip_ms): one for one in found
    }
    rows = [json.dumps(msgspec.to_builtins(kept[key])) for key in sorted(kept)]
    write_whole(path, "[\n" + ",\n".join(rows) + "\n]\n")
