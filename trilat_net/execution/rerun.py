"""What-if on a log: executes one or more sites again with changed settings and compares them with the log.

    again = rerun("run.mcap", replace=["s"], set={"control.Kd": 5})
    again.sites["s"].error_rms_rad, again.after["s"].q

Invariants: in open loop the recorded sites do not react; in closed loop every site is executed over the
network of the log. Without changes both give the log, bit for bit. Both sides of every figure cover the
same instants: records of the log that the rerun executed too.
"""

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import process
from ..core.fingerprint import compute_fingerprint
from ..core.ticks import NS_PER_S, Mode
from ..core.vectors import Array
from ..log.log_file import open_new_log
from ..log.log_reader import Log, open_log
from ..log.mcap_reader import Progress
from ..log.mcap_writer import Sink
from ..log.record_columns import Ints
from ..log.ros2.viz_channels import VIZ_HZ
from ..log.site_log import SiteLog
from .difference import RecordDifference
from .rerun_execution import RerunExecution, RerunSite, RerunTick
from .rerun_log import write_rerun_log
from .rerun_request import RerunOverrides, RerunRequest, describe_rerun_changes, resolve_rerun_request
from .verify import find_executed_sites, find_user_laws
from .virtual_network import Deliveries


class LogAndRerun(NamedTuple):
    """One figure in the log and in the rerun."""

    before: float
    after: float


class SiteEffect(NamedTuple):
    """What became of one site. Figures are None where nothing could be compared.

    Attributes:
        site: which site.
        executed: ticks that were executed.
        compared: of those, the ones of whose time there is a record in the log.
        identical: of those, the ones of which every computed field has the same bits (where something is
            changed: but for the sum of what arrived).
        stands: records of the log that stand, since too little is known to execute them.
        assumed: ticks executed that have no record: what arrived then is assumed.
        lacking: samples that arrived and are not in the log: without them.
        first: the first difference, or None; where rates changed there is none to tell.
        diverged_at_s: when it left its limits; None where it did not.
        q_rms_rad: root mean square of q here minus q in the log, of the joint where it is largest.
        q_max_rad: the largest such difference.
        q_max_at_s: when that was.
        error_rms_rad: root mean square of e, Eq. (9), of the joint where it is largest.
        error_max_rad: largest |e|.
        torque_max_nm: largest |tau|, Eq. (13).
    """

    site: str
    executed: int
    compared: int
    identical: int
    stands: int
    assumed: int
    lacking: int
    first: RecordDifference | None
    diverged_at_s: float | None
    q_rms_rad: float | None = None
    q_max_rad: float | None = None
    q_max_at_s: float | None = None
    error_rms_rad: LogAndRerun | None = None
    error_max_rad: LogAndRerun | None = None
    torque_max_nm: LogAndRerun | None = None


class LinkEffect(NamedTuple):
    """How old the sample in use was on one link of a site that was executed, where both had one.

    Attributes:
        link: as in "m1->s".
        age_mean_ms: averaged over the ticks, ms.
        age_max_ms: the largest, ms.
    """

    link: str
    age_mean_ms: LogAndRerun
    age_max_ms: LogAndRerun

    @property
    def differs(self) -> bool:
        """True where samples were of another age than in the log."""
        return any(pair.before != pair.after for pair in (self.age_mean_ms, self.age_max_ms))


def compare_site_rerun(
    log: Log, premise: RerunRequest, actor: RerunSite, came: Deliveries, made: Sequence[RerunTick]
) -> tuple[SiteEffect, list[LinkEffect]]:
    """Returns what became of one site, and of the links that it receives over.

    Args:
        log: the log.
        premise: what was asked of it.
        actor: the site, at the end.
        came: what came to it.
        made: its ticks, in order.
    """
    before, executed = log[actor.name], [one for one in made if not one.stands]
    rate_hz = premise.scenario.sites[actor.name].rate_hz
    after = SiteLog(actor.name, before.peers, rate_hz, [one.payload for one in executed], "rerun")
    _, rows, rows_here = np.intersect1d(before.t_ns, after.t_ns, return_indices=True)
    last = executed[-1] if executed else None
    counted = SiteEffect(
        actor.name,
        executed=len(executed),
        compared=len(rows),
        identical=sum(one.same for one in executed),
        stands=len(made) - len(executed),
        assumed=sum(one.tick in came.unrecorded for one in executed),
        lacking=actor.lacking,
        first=actor.first,
        diverged_at_s=last.t_ns / NS_PER_S if last is not None and last.mode is Mode.DIVERGED else None,
    )
    if not len(rows):
        return counted, []
    links = _link_effects(log, premise, before, after, rows, rows_here)
    with np.errstate(over="ignore"):  # a stranger's log holds any finite numbers
        return _with_figures(counted, before, after, rows, rows_here), links


def _rms(values: Array) -> float:
    """Returns the root mean square of the column where it is largest; squares of no number overflow."""
    largest = _largest(values)
    if not 0.0 < largest < np.inf:
        return largest
    return largest * float(np.sqrt(np.mean(np.square(values / largest), axis=0)).max())


def _largest(values: Array) -> float:
    return float(np.abs(values).max())


def _with_figures(
    counted: SiteEffect, before: SiteLog, after: SiteLog, rows: Ints, rows_here: Ints
) -> SiteEffect:
    """Returns a site's effect with its figures, of the rows of both that are of the same times."""
    moved = after.q[rows_here] - before.q[rows]
    place = int(np.abs(moved).max(axis=1).argmax())
    errors = (before.e[rows], after.e[rows_here])
    return counted._replace(
        q_rms_rad=_rms(moved),
        q_max_rad=_largest(moved),
        q_max_at_s=float(before.t_s[rows[place]]),
        error_rms_rad=LogAndRerun(*map(_rms, errors)),
        error_max_rad=LogAndRerun(*map(_largest, errors)),
        torque_max_nm=LogAndRerun(_largest(before.tau[rows]), _largest(after.tau[rows_here])),
    )


def _link_effects(
    log: Log, premise: RerunRequest, before: SiteLog, after: SiteLog, rows: Ints, rows_here: Ints
) -> list[LinkEffect]:
    """Returns how old samples were on the links of a site; nothing of one that had none in use."""
    found = []
    for peer in before.peers:
        then_ms = 1e3 * before.age_s(peer, log.scenario.sites[peer].rate_hz)[rows]
        now_ms = 1e3 * after.age_s(peer, premise.scenario.sites[peer].rate_hz)[rows_here]
        both = ~(np.isnan(then_ms) | np.isnan(now_ms))
        if not both.any():
            continue
        mean = LogAndRerun(float(then_ms[both].mean()), float(now_ms[both].mean()))
        largest = LogAndRerun(float(then_ms[both].max()), float(now_ms[both].max()))
        found.append(LinkEffect(f"{peer}->{before.name}", mean, largest))
    return found


_REPR_LENGTH = 120


@dataclass(frozen=True, repr=False)
class Rerun:
    """A log and what became of it.

    Attributes:
        before: the log.
        premise: what was asked of it.
        made: every tick that was made, in the order in which they were.
        sites: per site that was executed what it changed.
        links: the same of the links that these sites receive over.
    """

    before: Log
    premise: RerunRequest
    made: list[RerunTick]
    sites: dict[str, SiteEffect]
    links: dict[str, LinkEffect]

    def __repr__(self) -> str:
        asked = self.premise
        changed = "; ".join(describe_rerun_changes(asked)) or "nothing changed"
        words = f"{asked.mode}, {', '.join(asked.replaced)} executed afresh, {changed}"
        return f"<Rerun of {self.before.source}: {words[:_REPR_LENGTH]}>"

    @cached_property
    def after(self) -> Log:
        """The rerun as a log: the sites that were executed, and the others as they were recorded."""
        stream = io.BytesIO()
        self.write(stream)
        stream.seek(0)
        return open_log(stream)

    def write(self, stream: Sink) -> None:
        """Writes the same into a stream, which stays open.

        Raises:
            LogRefused: the disk refused.
        """
        write_rerun_log(self.before, self.premise, self.made, stream)

    def save(self, path: Path, *, force: bool = False) -> None:
        """Writes the same into a file, with the channels that viewers read.

        Args:
            path: the file.
            force: whether it may replace one.

        Raises:
            UsageError: the file exists, or cannot be made.
            LogRefused: the disk refused.
        """
        with open_new_log(path, force=force) as stream:
            write_rerun_log(self.before, self.premise, self.made, stream, VIZ_HZ)

    @property
    def diverged(self) -> bool:
        """True where a site left its limits that had not left them in the log."""
        return any(
            effect.diverged_at_s is not None and self.before[name].states[-1].mode != "diverged"
            for name, effect in self.sites.items()
        )

    @property
    def identical(self) -> bool:
        """True where every record that was compared has the same bits as in the log."""
        return all(effect.identical == effect.compared for effect in self.sites.values())

    @property
    def broken(self) -> bool:
        """True where it should have been the log, bit for bit, and is not."""
        same_platform = self.before.session.get("fingerprint") == compute_fingerprint()
        whole = set(self.premise.replaced) <= set(find_executed_sites(self.before))
        return same_platform and whole and not self.premise.changes and not self.identical

    @property
    def notes(self) -> list[str]:
        """What limits the answer, a sentence each."""
        return list(_notes(self))

    def facts(self) -> dict[str, Any]:
        """Returns all that there is to say of it, ready for JSON; keys end in their unit."""
        return {
            "log": self.before.source,
            "mode": self.premise.mode,
            "replaced": list(self.premise.replaced),
            "recorded": list(self.premise.recorded),
            "changes": [changed._asdict() for changed in self.premise.changes],
            "without_effect": [changed.key for changed in self.premise.without_effect],
            "identical": self.identical,
            "diverged": self.diverged,
            "sites": {name: _site_facts(effect) for name, effect in self.sites.items()},
            "links": {name: _pairs(effect._asdict()) for name, effect in self.links.items()},
            "notes": self.notes,
        }


def rerun(
    log: str | Path | Log,
    replace: Sequence[str] = (),
    set: RerunOverrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    closed_loop: bool = False,
    progress: Progress | None = None,
) -> Rerun:
    """Executes sites of a log afresh and compares them with it.

    Args:
        log: the log, or where it is.
        replace: which sites; the others stand as recorded and do not react.
        set: what is otherwise for them, as in `{"control.Kd": 5}`.
        closed_loop: executes all of them.
        progress: told now and then how many ticks are made, and how many there will be at most.

    Raises:
        LogError: the log cannot be read, or does not tell enough.
        UsageError: it is not said which sites, or in two ways.
        ScenarioError: there is no such site, or an override is not valid or cannot have an effect.
    """
    before = log if isinstance(log, Log) else open_log(log)
    names = [replace] if isinstance(replace, str) else list(replace)
    asked = resolve_rerun_request(before, names, set, closed_loop=closed_loop)
    with process.pause_gc():
        performance = RerunExecution(before, asked)
        made = list(performance.run(progress))
        by_site: dict[str, list[RerunTick]] = {name: [] for name in asked.replaced}
        for one in made:
            by_site[one.site].append(one)
        sites: dict[str, SiteEffect] = {}
        links: dict[str, LinkEffect] = {}
        for name, ticks in by_site.items():
            site, over = compare_site_rerun(
                before, asked, performance.actors[name], performance.came[name], ticks
            )
            sites[name] = site
            links |= {link.link: link for link in over}
    return Rerun(before, asked, made, sites, links)


def _site_facts(effect: SiteEffect) -> dict[str, Any]:
    first = effect.first
    return {**_pairs(effect._asdict()), "first": None if first is None else first._asdict()}


def _known(value: Any) -> Any:
    """Returns a figure as JSON can hold it: one beyond all numbers is not known."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _pairs(facts: dict[str, Any]) -> dict[str, Any]:
    """Returns facts with every pair spelt out."""
    return {
        key: _pairs(value._asdict()) if hasattr(value, "_asdict") else _known(value)
        for key, value in facts.items()
    }


def _notes(again: Rerun) -> Iterator[str]:
    log, asked = again.before, again.premise
    if asked.recorded and asked.changes:
        sites = " and ".join(asked.recorded)
        are, do = ("are", "they do") if len(asked.recorded) > 1 else ("is", "it does")
        yield f"{sites} {are} as recorded: nothing is changed there, and {do} not react"
    if others := [name for name in asked.replaced if name not in find_executed_sites(log)]:
        yield f"this file is a rerun itself: its {', '.join(others)} met samples that are not in it"
    if not asked.changes and not again.identical and log.session.get("fingerprint") != compute_fingerprint():
        yield "the log was made with another platform's arithmetic: equal bits cannot be expected"
    if not log.complete:
        yield "the log was not finished: executed as far as it goes"
    for law in find_user_laws(asked.scenario):
        if law.changed and any(site in asked.replaced for site in law.sites):
            yield f"executed as its file is now: {law}"
    yield from _later_changes(again)
    for effect in again.sites.values():
        yield from _execution_notes(effect)


def _later_changes(again: Rerun) -> Iterator[str]:
    """Says where a link or a row that is otherwise is changed during the run: then that counts."""
    keys = [changed.key for changed in again.premise.changes]
    changes = [c.link or c.dominance for c in again.premise.scenario.timeline]
    for name in again.premise.replaced:
        for commands in again.before.commands(name).values():
            for command in commands:
                peer = again.before[name].peers[command.peer]
                changes.append(name if command.peer < 0 else f"{peer}->{name}")
    for about in dict.fromkeys(changes):
        prefix = f"links.{about}." if "->" in about else f"dominance.{about}."
        if any(key.startswith(prefix) for key in keys):
            yield f"{about} is changed during the run, in the log as here: from then on that counts"


def _execution_notes(effect: SiteEffect) -> Iterator[str]:
    if effect.stands:
        yield f"{effect.site}: {effect.stands} records stand as they are: too little is known to execute them"
    if effect.assumed:
        yield f"{effect.site}: {effect.assumed} ticks have no record in the log: what arrived then is assumed"
    if effect.lacking:
        yield f"{effect.site}: {effect.lacking} samples that arrived are not in the log: done without them"
    if not effect.executed:
        yield f"{effect.site}: nothing could be executed"
