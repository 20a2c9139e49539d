"""What a person does with a scenario or a log, in Python; every command of `trilat` is one of these.

Law: no logic that is not the joining of parts: scenario, virtual time, log, execution, analysis.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from . import collector
from .core.tick import Output
from .log.chunks import Progress
from .log.logfile import new_log
from .log.reader import Log, open_log
from .log.views import VIEWS_HZ
from .log.writer import new_file
from .replay.comparison import Comparison, LateSample, compare, late_samples, measurements, schedule
from .replay.verify import Verdict, last_ticks, verify
from .scenario import Scenario, load
from .sim import virtual
from .sim.network import Network, RecordedNetwork

__all__ = [
    "Twins",
    "Verdict",
    "compare_with_virtual",
    "new_file",
    "open_log",
    "record_virtual",
    "simulate",
    "twin_without_hands",
    "verify",
]


def simulate(
    scenario: str | Path | Scenario,
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
) -> Log:
    """Runs a scenario in virtual time and returns its log.

    Args:
        scenario: the name of a shipped scenario, a path, or a scenario.
        set: overrides, as in `{"control.Kd": 5}`.

    Raises:
        ScenarioError: the scenario or an override is not valid.
    """
    stream = io.BytesIO()
    virtual.record(load(scenario, set), stream)
    stream.seek(0)
    return open_log(stream)


def record_virtual(
    scenario: Scenario,
    path: Path,
    *,
    force: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    views_hz: float = VIEWS_HZ,
) -> bool:
    """Runs a scenario in virtual time into a file; False where the run diverged.

    Args:
        scenario: the experiment.
        path: the file.
        force: whether it may replace one.
        stopped: True once the run was asked to end.
        views_hz: messages a second of the standard channels, see `log.views`; 0 for none.

    Raises:
        UsageError: the file exists, or cannot be made.
        LogRefused: the disk refused; says what is kept.
        ScenarioError: virtual time cannot run it; then there is no file.
        LawFailed: a law from outside did; the file is finished, with what was before.
    """
    with new_log(path, force=force) as stream:
        return virtual.record(scenario, stream, stopped=stopped, views_hz=views_hz)


class Twins(NamedTuple):
    """A log against virtual time.

    Attributes:
        fed: against virtual time fed with the log's arrivals; equal always.
        plain: against plain virtual time; equal until the first late sample. Of nothing where an arm is
            outside of the program: there is no such run.
        late: the samples that came after they were due.
    """

    fed: Comparison
    plain: Comparison
    late: list[LateSample]


def compare_with_virtual(log: Log, progress: Progress | None = None) -> Twins:
    """Runs a log's scenario again in virtual time, with its arrivals and without, and compares.

    Args:
        log: the log; what is behind its last record is not run.
        progress: told how many ticks are done, and how many there are.
    """
    scenario = _as_long_as(log)
    total = 2 * sum(map(scenario.ticks, scenario.names))
    peers = {name: scenario.peers(name) for name in scenario.names}
    arms = measurements(log)
    ends = last_ticks(log)
    with collector.paused():
        ordered = {name: log.commands(name) for name in scenario.names}

        def outputs(network: Network | None, before: int) -> Iterator[tuple[str, Output]]:
            ran = virtual.run(scenario, network, ordered, arms, ends)
            return _told(((site.name, output) for site, _, output in ran), progress, before, total)

        return Twins(
            compare(log, outputs(RecordedNetwork(schedule(log), peers), 0), arrivals=True),
            Comparison(0, 0, None) if arms else compare(log, outputs(None, total // 2), arrivals=False),
            late_samples(log),
        )


def _as_long_as(log: Log) -> Scenario:
    """Returns a log's scenario, as long as there are records: a torn log is a short run."""
    ends_s = [(int(log[name].tick[-1]) + 1) / log[name].rate_hz for name in log.sites if len(log[name])]
    duration_s = min(log.scenario.duration_s, max(ends_s, default=log.scenario.duration_s))
    return msgspec.structs.replace(log.scenario, duration_s=duration_s)


def _told(
    outputs: Iterator[tuple[str, Output]], progress: Progress | None, before: int, total: int
) -> Iterator[tuple[str, Output]]:
    """Yields the same, and tells now and then how many there were."""
    for n, output in enumerate(outputs):
        if progress is not None and n % 256 == 0:
            progress(before + n, total)
        yield output


def twin_without_hands(log: Log) -> Log:
    """Returns the log's experiment in virtual time with nobody at the arms."""
    stream = io.BytesIO()
    virtual.record(_as_long_as(log).without_hands(), stream, as_named=False)
    stream.seek(0)
    return open_log(stream)
