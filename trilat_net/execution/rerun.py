"""What-if on a log: executes one or more sites again with changed settings and compares them
with the log.

    again = rerun("run.mcap", replace=["s"], set={"control.Kd": 5})
    again.sites["s"].error_rms_rad, again.after["s"].q

Invariants: in open loop the recorded sites do not react; in closed loop every site is executed
over the network of the log. Without changes both give the log, bit for bit. Both sides of every
figure cover the same instants: records of the log that the rerun executed too.
"""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import process
from ..core.fingerprint import compute_fingerprint
from ..core.ticks import NS_PER_S, Mode
from ..core.vectors import Array
from ..errors import LogError, count_nouns
from ..files import digest_file
from ..log.log_file import LogFile
from ..log.log_layout import EXECUTED_SITES_KEY, MAX_TIME_NS, RERUN_DRIVER
from ..log.log_reader import Log, open_log
from ..log.log_writer import LogWriter
from ..log.mcap_reader import Progress
from ..log.mcap_writer import Sink
from ..log.record_columns import Ints
from ..log.ros2.viz_channels import VIZ_HZ
from ..log.site_log import SiteLog
from ..net.messages import READABLE, State
from ..net.wire import decode
from ..results import Result, finite_or_none
from ..scenario.code_consent import find_user_laws
from .rerun_execution import (
    RerunExecution,
    RerunOverrides,
    RerunRequest,
    RerunSite,
    RerunTick,
    describe_rerun_changes,
    resolve_rerun_request,
)
from .resumption import read_output
from .verify import RecordDifference
from .virtual import SiteChannels, SiteEntry, describe_accounts


class LogAndRerun(NamedTuple):
    """One figure in the log and in the rerun."""

    before: float
    after: float


class SiteEffect(NamedTuple):
    """The effect of a rerun on one site. Figures are None if nothing could be compared.

    Attributes:
        executed: executed ticks.
        compared: of those, the ones at whose time the log has a record.
        identical: of those, the ones of which every computed field has the same bits (with
            changes: except the CRC of the arrivals).
        stands: records of the log that stand, since too little is known to execute them.
        assumed: executed ticks without a record: their arrivals are assumed.
        lacking: samples that arrived and are not in the log.
        first: the first difference, or None; also None if rates changed.
        diverged_at_s: time at which it left its limits, or None.
        q_rms_rad: root mean square of q minus q in the log, of the joint for which it is
            largest.
        q_max_rad: the largest such difference.
        q_max_at_s: its time.
        error_rms_rad: root mean square of e, Eq. (9), of the joint for which it is largest.
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
    """Age of the sample in use on one link of an executed site, over the ticks at which both
    had one.

    Attributes:
        link: as in "m1->s".
    """

    link: str
    age_mean_ms: LogAndRerun
    age_max_ms: LogAndRerun

    @property
    def differs(self) -> bool:
        """True if samples had another age than in the log."""
        return any(pair.before != pair.after for pair in (self.age_mean_ms, self.age_max_ms))


def compare_site_rerun(
    log: Log, request: RerunRequest, site: RerunSite, ticks: Sequence[RerunTick]
) -> tuple[SiteEffect, list[LinkEffect]]:
    """Returns the effect of a rerun on a site after its last tick, and on the links on which it
    receives.
    """
    before = log[site.name]
    executed = [tick for tick in ticks if not tick.kept]
    rate_hz = request.scenario.sites[site.name].rate_hz
    payloads = [tick.payload for tick in executed]
    layout = request.scenario.layout(site.name)
    axes = request.scenario.arms[site.name].axes
    after = SiteLog(
        name=site.name,
        peers=before.peers,
        rate_hz=rate_hz,
        payloads=payloads,
        source="rerun",
        layout=layout,
        axes=axes,
    )
    _, rows, rows_here = np.intersect1d(before.t_ns, after.t_ns, return_indices=True)
    last = executed[-1] if executed else None
    effect = SiteEffect(
        site.name,
        executed=len(executed),
        compared=len(rows),
        identical=sum(tick.same for tick in executed),
        stands=len(ticks) - len(executed),
        assumed=sum(tick.tick in site.deliveries.unrecorded for tick in executed),
        lacking=site.lacking,
        first=site.first,
        diverged_at_s=last.t_ns / NS_PER_S
        if last is not None and last.mode is Mode.DIVERGED
        else None,
    )
    if not len(rows):
        return effect, []
    links = _compare_links(
        log=log, request=request, before=before, after=after, rows=rows, rows_here=rows_here
    )
    with np.errstate(over="ignore"):  # a damaged log holds any finite numbers
        moved = after.q[rows_here] - before.q[rows]
        place = int(np.abs(moved).max(axis=1).argmax())
        errors = (before.e[rows], after.e[rows_here])
        torques = (before.tau[rows], after.tau[rows_here])
        return effect._replace(
            q_rms_rad=_rms(moved),
            q_max_rad=_largest(moved),
            q_max_at_s=float(before.t_s[rows[place]]),
            error_rms_rad=LogAndRerun(*map(_rms, errors)),
            error_max_rad=LogAndRerun(*map(_largest, errors)),
            torque_max_nm=LogAndRerun(*map(_largest, torques)),
        ), links


def _rms(values: Array) -> float:
    largest = _largest(values)
    if not 0.0 < largest < np.inf:
        return largest
    return largest * float(np.sqrt(np.mean(np.square(values / largest), axis=0)).max())


def _largest(values: Array) -> float:
    return float(np.abs(values).max())


def _compare_links(
    log: Log,
    request: RerunRequest,
    before: SiteLog,
    after: SiteLog,
    rows: Ints,
    rows_here: Ints,
) -> list[LinkEffect]:
    found = []
    for peer in before.peers:
        before_ms = 1e3 * before.age_s(peer, log.scenario.sites[peer].rate_hz)[rows]
        after_ms = 1e3 * after.age_s(peer, request.scenario.sites[peer].rate_hz)[rows_here]
        both = ~(np.isnan(before_ms) | np.isnan(after_ms))
        if both.any():
            mean = LogAndRerun(float(before_ms[both].mean()), float(after_ms[both].mean()))
            largest = LogAndRerun(float(before_ms[both].max()), float(after_ms[both].max()))
            found.append(LinkEffect(f"{peer}->{before.name}", mean, largest))
    return found


@dataclass(frozen=True, repr=False)
class Rerun(Result):
    """A log and its rerun: every executed tick, and the effects per executed site and per link
    to it.
    """

    before: Log
    request: RerunRequest
    ticks: list[RerunTick]
    sites: dict[str, SiteEffect]
    links: dict[str, LinkEffect]

    def headline(self) -> str:
        """Returns what was executed with which changes, in one line."""
        changed = "; ".join(describe_rerun_changes(self.request)) or "nothing changed"
        executed = f"{self.request.mode}, {', '.join(self.request.replaced)} executed"
        return f"{self.before.source}: {executed}, {changed}"

    @cached_property
    def after(self) -> Log:
        """The rerun as a log: the executed sites, and the others as recorded."""
        stream = io.BytesIO()
        self.write(stream)
        stream.seek(0)
        return open_log(stream)

    def write(self, stream: Sink, views_hz: float = 0.0) -> None:
        """Writes the rerun as a log into a stream, which stays open; see `LogWriter` for the
        views.

        Executed sites are written anew, recorded sites byte for byte. The file names its source
        log by SHA-256, the executed sites and the changes; its scenario is the one that holds
        in it. Executed sites have no measured values (timing, round trips).

        Raises:
            LogError: the log's epoch is no time.
            LogRefused: the disk refused.
        """
        log = self.before
        request = self.request
        session = log.session["session"]
        epoch = log.session.get("epoch_unix_ns", "0")
        if not epoch.isdecimal() or (epoch_unix_ns := int(epoch)) > MAX_TIME_NS:
            raise LogError(f"{log.source}: its epoch_unix_ns is no time: {epoch[:40]!r}")
        metadata = rerun_metadata(log, request)
        writer = LogWriter(
            stream=stream,
            scenario=request.scenario,
            session=session,
            driver=RERUN_DRIVER,
            epoch_unix_ns=epoch_unix_ns,
            facts=metadata,
            views_hz=views_hz,
        )
        channels = {}
        entries = []
        for name in log.sites:
            boot = log[name].states[0].boot if len(log[name]) else 0
            own = channels[name] = SiteChannels(request.scenario, session, name, boot)
            if name in request.recorded:
                entries.append(_copy_recorded(log, name, own))
            else:
                entries.append(
                    _encode_executed([tick for tick in self.ticks if tick.site == name], own)
                )
        for entry in merge(*entries, key=lambda entry: entry.t_ns):
            channels[entry.site].write(entry, writer, epoch_unix_ns)
        writer.finish(describe_accounts(channels.values()))

    def save(self, path: Path, *, force: bool = False) -> None:
        """Writes the rerun as a log with standard channels into a file; `force` lets it replace
        one.

        Raises:
            UsageError: the file exists, or cannot be made.
            LogRefused: the disk refused.
        """
        with LogFile(path, force=force) as stream:
            self.write(stream, VIZ_HZ)

    @property
    def diverged(self) -> bool:
        """True if a site left its limits that had not left them in the log."""
        return any(
            effect.diverged_at_s is not None and self.before[name].states[-1].mode != "diverged"
            for name, effect in self.sites.items()
        )

    @property
    def identical(self) -> bool:
        """True if every compared record has the same bits as in the log."""
        return all(effect.identical == effect.compared for effect in self.sites.values())

    @property
    def broken(self) -> bool:
        """True if the rerun must equal the log, bit for bit, and does not."""
        same_platform = self.before.session.get("fingerprint") == compute_fingerprint()
        whole = set(self.request.replaced) <= set(self.before.executed_sites)
        return same_platform and whole and not self.request.changes and not self.identical

    @property
    def notes(self) -> list[str]:
        """Limits of the answer, a sentence each."""
        return list(_describe_limits(self))

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per executed site."""
        return list(self.to_dict()["sites"].values())

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat rerun --json`; they end in their unit."""
        return {
            "log": self.before.source,
            "mode": self.request.mode,
            "replaced": list(self.request.replaced),
            "recorded": list(self.request.recorded),
            "changes": [changed._asdict() for changed in self.request.changes],
            "without_effect": [changed.key for changed in self.request.without_effect],
            "identical": self.identical,
            "diverged": self.diverged,
            "sites": {name: _nest(effect) for name, effect in self.sites.items()},
            "links": {name: _nest(effect) for name, effect in self.links.items()},
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
    """Executes sites of a log again and compares them with it; the command is `trilat rerun`.

    >>> again = tn.rerun(tn.simulate("two_sites", duration_s=0.1), ["s"], {"control.Kd": 5})
    >>> again.identical
    False

    Args:
        log: the log, or its path.
        replace: the sites to execute; the others stay as recorded and do not react.
        set: their changes, as in `{"control.Kd": 5}`.
        closed_loop: executes all sites.
        progress: called now and then with the ticks done and the most there will be.

    Raises:
        LogError: the log cannot be read, or does not tell enough.
        UsageError: the sites are not named, or in two ways.
        ScenarioError: there is no such site, or an override is not valid or cannot have an
            effect.
        CodeWithheld: the law of an executed site is code from outside that may not run.
    """
    before = log if isinstance(log, Log) else open_log(log)
    names = [replace] if isinstance(replace, str) else list(replace)
    request = resolve_rerun_request(before, names, set, closed_loop=closed_loop)
    sites: dict[str, SiteEffect] = {}
    links: dict[str, LinkEffect] = {}
    with process.pause_gc():
        execution = RerunExecution(before, request)
        ticks = list(execution.run(progress))
        for name, site in execution.sites.items():
            own = [tick for tick in ticks if tick.site == name]
            sites[name], over = compare_site_rerun(before, request, site, own)
            links |= {link.link: link for link in over}
    return Rerun(before, request, ticks, sites, links)


def rerun_metadata(log: Log, request: RerunRequest) -> dict[str, str]:
    """Returns the session metadata that name the source log and the changes."""
    files = filter(Path.is_file, map(Path, log.sources))  # a log in memory has none
    digests = {path: digest_file(path) for path in files}
    return {
        "rerun_mode": request.mode,
        "rerun_of": " ".join(path.name for path in digests),
        "rerun_of_sha256": " ".join(digests.values()),
        "rerun_of_driver": log.driver,
        EXECUTED_SITES_KEY: " ".join(request.replaced),
        "rerun_changes": "; ".join(describe_rerun_changes(request)),
    }


def _copy_recorded(log: Log, name: str, channels: SiteChannels) -> Iterator[SiteEntry]:
    part = log[name]
    events = [event for event in log.events if event.member == name]
    events.sort(key=lambda event: event.t_ns)  # those before the epoch come first
    return merge(
        (
            channels.record(state, payload)
            for state, payload in zip(part.states, part.payloads, strict=True)
        ),
        (channels.stats(stats) for stats in log.link_stats(name)),
        (channels.event(event, n) for n, event in enumerate(events)),
        key=lambda entry: entry.t_ns,
    )


def _encode_executed(ticks: Sequence[RerunTick], channels: SiteChannels) -> Iterator[SiteEntry]:
    for tick in ticks:
        state = decode(tick.payload, State, READABLE)
        yield channels.record(state, tick.payload)
        yield from channels.follow(read_output(state, channels.peers), tick.stats)
    yield channels.end()


def _nest(value: Any) -> Any:
    """Returns a value for JSON: every tuple with names spelt out, and every number beyond JSON
    as None.
    """
    if hasattr(value, "_asdict"):
        return {key: _nest(one) for key, one in value._asdict().items()}
    return finite_or_none(value) if isinstance(value, float) else value


def _describe_limits(again: Rerun) -> Iterator[str]:
    log = again.before
    request = again.request
    if request.recorded and request.changes:
        sites = " and ".join(request.recorded)
        are, do = ("are", "they do") if len(request.recorded) > 1 else ("is", "it does")
        yield f"{sites} {are} as recorded: nothing is changed there, and {do} not react"
    if others := [name for name in request.replaced if name not in log.executed_sites]:
        yield f"this file is a rerun itself: its {', '.join(others)} met samples that are not in it"
    foreign = log.session.get("fingerprint") != compute_fingerprint()
    if foreign and not request.changes and not again.identical:
        yield "the log was made with another platform's arithmetic: equal bits cannot be expected"
    if not log.complete:
        yield "the log was not finished: it is executed as far as it goes"
    for law in find_user_laws(request.scenario):
        if law.changed and any(site in request.replaced for site in law.sites):
            yield f"executed as its file is now: {law}"
    yield from _describe_later_changes(again)
    for effect in again.sites.values():
        name = effect.site
        if effect.stands:
            kept = count_nouns(
                effect.stands, "record stands as it is", "records stand as they are"
            )
            yield f"{name}: {kept}: too little is known to execute more"
        if effect.assumed:
            unknown = count_nouns(effect.assumed, "tick has", "ticks have")
            yield f"{name}: {unknown} no record in the log: the arrivals are assumed"
        if away := again.before.absent_ticks(name):
            yield f"{name}: {away} of them it did not make: it was away, and is executed as if it were not"
        if effect.lacking:
            lost = count_nouns(
                effect.lacking, "sample that arrived is", "samples that arrived are"
            )
            yield f"{name}: {lost} not in the log: executed without"
        if not effect.executed:
            yield f"{name}: nothing could be executed"


def _describe_later_changes(again: Rerun) -> Iterator[str]:
    keys = [changed.key for changed in again.request.changes]
    during = [change.link or change.dominance for change in again.request.scenario.timeline]
    for name in again.request.replaced:
        for commands in again.before.commands(name).values():
            for command in commands:
                peer = again.before[name].peers[command.peer]
                if command.order is None:
                    during.append(name if command.peer < 0 else f"{peer}->{name}")
    for owner in dict.fromkeys(during):
        prefix = f"links.{owner}." if "->" in owner else f"dominance.{owner}."
        if any(key.startswith(prefix) for key in keys):
            yield f"{owner} changes during the run, in the log as here: from then on that holds"
