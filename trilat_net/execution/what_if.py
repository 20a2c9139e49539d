"""Computes what would have happened in a recorded run with other settings.

For example, one can repeat a session with a higher damping at the slave:

    result = rerun("run.mcap", replace=["s"], set={"control.Kd": 5})
    result.sites["s"].error_rms_rad, result.after["s"].q

In open loop, only the replaced sites are run again. The other sites keep their records and do
not react. In closed loop, every site is run again, and each sample spends as much time in the
network as it did in the log.

Invariant:
    - Without changed settings, both modes reproduce the log bit for bit.
    - A quantity such as the mean error is computed from the log and from the rerun over the
      same ticks: those that have a record in the log and were executed in the rerun.
"""

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import process
from ..core import Array, compute_fingerprint
from ..errors import LogError, count_nouns
from ..files import digest_file
from ..hooks import find_hook
from ..log import (
    EXECUTED_SITES_KEY,
    MAX_TIME_NS,
    RERUN_DRIVER,
    VIZ_HZ,
    Ints,
    Log,
    LogFile,
    LogWriter,
    Progress,
    Sink,
    SiteLog,
    collect_provenance,
    open_log,
)
from ..net import READABLE, State, decode
from ..records import NS_PER_S, Mode
from ..results import Result, finite_or_none
from .rerun_execution import RerunExecution, RerunOverrides, RerunRequest, RerunTick
from .verification import RecordDifference
from .virtual import SiteChannels, SiteEntry, render_accounts


class LogAndRerun(NamedTuple):
    """A quantity, such as an error, in the recorded run and in its rerun.

    Attributes:
        before: Value in the log.
        after: Value in the rerun.
    """

    before: float
    after: float


class _SiteEffect(NamedTuple):
    """Effect of changed settings on one arm: how a rerun differs from the log.

    The figures are computed from the ticks for which both the log and the rerun have a record,
    and are None if there is no such tick.

    Attributes:
        site: Name of the site.
        executed: Number of executed ticks.
        compared: Number of executed ticks for whose time the log contains a record.
        identical: Number of compared ticks in which all computed fields are bit-identical to
            the log. If settings were changed, the checksum of the arrivals is not compared.
        stands: Number of ticks whose record was copied from the log, because the log does not
            contain enough data to execute them.
        assumed: Number of executed ticks without a record in the log. The samples that arrived
            in these ticks were estimated.
        lacking: Number of samples that arrived, but whose content is missing from the log.
        first: First difference from the log. None if there is no difference, or if tick rates
            were changed.
        diverged_at_s: Time at which the arm left its limits, in s. None if the arm stayed
            within them.
        q_rms_rad: Root mean square of the change of the joint angles q, for the joint with the
            largest value, in rad.
        q_max_rad: Largest absolute change of q of any joint, in rad.
        q_max_at_s: Time of this largest change, in s.
        error_rms_rad: Root mean square of the synchronisation error e, Eq. (9), for the joint
            with the largest value, in rad. e is the difference between the joint angles and
            their reference.
        error_max_rad: Largest |e| of any joint, in rad.
        torque_max_nm: Largest absolute control torque of any joint, Eq. (13), in N m.
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


class _LinkEffect(NamedTuple):
    """Effect of a rerun on one link: how old the samples are when they are used.

    Ages are computed from the ticks in which the receiver uses a sample both in the log and in
    the rerun.

    Attributes:
        link: Name of the link, for example "m1->s".
        age_mean_ms: Mean age in the log and in the rerun, in ms.
        age_max_ms: Largest age in the log and in the rerun, in ms.
    """

    link: str
    age_mean_ms: LogAndRerun
    age_max_ms: LogAndRerun

    @property
    def differs(self) -> bool:
        """True if the delays on the network link differ between the recorded run and the rerun.

        The delay is measured as the age of the received data when they are used. The mean and
        the maximum are compared.
        """
        return any(pair.before != pair.after for pair in (self.age_mean_ms, self.age_max_ms))


class _CommonRecords(NamedTuple):
    """Records of a site in a log and in its rerun, paired by time.

    The tick rate of a rerun may differ from that of the log. Only records with equal times can
    be compared.

    Attributes:
        before: Records of the log.
        after: Records of the rerun.
        before_rows: Rows of `before` whose times also occur in `after`, shape (K,).
        after_rows: Rows of `after` with the same times, shape (K,).
    """

    before: SiteLog
    after: SiteLog
    before_rows: Ints
    after_rows: Ints

    def compare(self, figure: Callable[[Array], float], field: str) -> LogAndRerun:
        """Computes the same quantity from the records of the log and of the rerun.

        Only ticks that have a record in both the log and the rerun are used.

        Args:
            figure: Function that computes the quantity from an array of shape (K, n), for K
                records with n values each.
            field: Name of the field of the records that contains the values.
        """
        before = figure(getattr(self.before, field)[self.before_rows])
        after = figure(getattr(self.after, field)[self.after_rows])
        return LogAndRerun(before, after)


def _compare_site_rerun(
    log: Log,
    request: RerunRequest,
    execution: RerunExecution,
    name: str,
    ticks: Sequence[RerunTick],
) -> tuple[_SiteEffect, list[_LinkEffect]]:
    """Computes how a rerun differs at one arm, and on the links to this arm.

    Args:
        log: The log whose sites were run again.
        request: Sites to run again, and changed settings.
        execution: The rerun, after its last tick.
        name: Name of a site that was run again.
        ticks: All ticks of this site in the rerun, in order of time.

    Returns:
        The effect on the site, and the effects on the links that end at it.
    """
    # Copied records are neither executed nor compared.
    executed = [tick for tick in ticks if not tick.kept]
    records = _pair_records(log, request, name, executed)
    diverged_at_s = None
    if executed and executed[-1].mode is Mode.DIVERGED:
        diverged_at_s = executed[-1].t_ns / NS_PER_S
    site = execution.sites[name]
    effect = _SiteEffect(
        name,
        executed=len(executed),
        compared=len(records.before_rows),
        identical=sum(tick.same for tick in executed),
        stands=len(ticks) - len(executed),
        assumed=sum(tick.tick in site.deliveries.unrecorded for tick in executed),
        lacking=site.lacking,
        first=site.first,
        diverged_at_s=diverged_at_s,
    )
    if not len(records.before_rows):
        return effect, []

    links = _compare_links(log, request, records)
    with np.errstate(over="ignore"):  # a damaged log may contain any finite numbers
        before_q = records.before.q[records.before_rows]
        after_q = records.after.q[records.after_rows]
        differences = after_q - before_q
        largest = int(np.abs(differences).max(axis=1).argmax())
        effect = effect._replace(
            q_rms_rad=_compute_rms(differences),
            q_max_rad=_find_largest(differences),
            q_max_at_s=float(records.before.t_s[records.before_rows[largest]]),
            error_rms_rad=records.compare(_compute_rms, "e"),
            error_max_rad=records.compare(_find_largest, "e"),
            torque_max_nm=records.compare(_find_largest, "tau"),
        )
    return effect, links


def _pair_records(
    log: Log, request: RerunRequest, name: str, executed: Sequence[RerunTick]
) -> _CommonRecords:
    """Pairs the records of a site in a log with those of its rerun, for comparison.

    Records with the same time form a pair. The tick rates may differ.

    Args:
        log: The log.
        request: Sites and settings of the rerun.
        name: Name of the site.
        executed: Executed ticks of the site.
    """
    log_records = log[name]
    rerun_records = SiteLog(
        name=name,
        peers=log_records.peers,
        rate_hz=request.scenario.sites[name].rate_hz,
        payloads=[tick.payload for tick in executed],
        source="rerun",
        layout=request.scenario.layout(name),
        axes=request.scenario.arms[name].axes,
    )
    _, before_rows, after_rows = np.intersect1d(
        log_records.t_ns, rerun_records.t_ns, return_indices=True
    )
    return _CommonRecords(log_records, rerun_records, before_rows, after_rows)


def _compute_rms(values: Array) -> float:
    """Returns the root mean square of the column for which it is largest.

    Args:
        values: Values, shape (K, n), with one column per joint.
    """
    largest = _find_largest(values)
    if not 0.0 < largest < np.inf:
        return largest
    # The values are scaled by the largest one, so that no square overflows.
    mean_squares = np.mean(np.square(values / largest), axis=0)
    return largest * float(np.sqrt(mean_squares).max())


def _find_largest(values: Array) -> float:
    """Returns the largest absolute value in an array."""
    return float(np.abs(values).max())


def _compare_links(
    log: Log, request: RerunRequest, records: _CommonRecords
) -> list[_LinkEffect]:
    """Compares the delays on the links to an arm between the log and its rerun.

    Args:
        log: The log.
        request: Sites and settings of the rerun.
        records: Paired records of the receiver.
    """
    effects = []
    for peer in records.before.peers:
        before_hz = log.scenario.sites[peer].rate_hz
        after_hz = request.scenario.sites[peer].rate_hz
        before_ms = 1e3 * records.before.age_s(peer, before_hz)[records.before_rows]
        after_ms = 1e3 * records.after.age_s(peer, after_hz)[records.after_rows]
        # NaN means that no sample is in use yet.
        has_ages = ~(np.isnan(before_ms) | np.isnan(after_ms))
        if not has_ages.any():
            continue
        before_ms = before_ms[has_ages]
        after_ms = after_ms[has_ages]
        mean = LogAndRerun(float(before_ms.mean()), float(after_ms.mean()))
        largest = LogAndRerun(float(before_ms.max()), float(after_ms.max()))
        effects.append(_LinkEffect(f"{peer}->{records.before.name}", mean, largest))
    return effects


@dataclass(frozen=True, repr=False)
class Rerun(Result):
    """A log and the result of running some or all of its sites again.

    Created by the function `rerun`. The result can be displayed, written as a log of its own,
    or converted to plain values.

    Attributes:
        before: The log whose sites were run again.
        request: Sites that were run again, and changed settings.
        ticks: Every tick of these sites, in order of execution.
        sites: Effect of the rerun on each of these sites, keyed by the name of the site.
        links: Effect of the rerun on each link that ends at one of these sites, keyed by the
            name of the link.
    """

    before: Log
    request: RerunRequest
    ticks: list[RerunTick]
    sites: dict[str, _SiteEffect]
    links: dict[str, _LinkEffect]

    def headline(self) -> str:
        """Returns a one-line description of the rerun for the user.

        It names the log, the kind of rerun, the sites run again and the changed settings.
        """
        changes = "; ".join(self.request.describe_changes()) or "nothing changed"
        executed = f"{self.request.mode}, {', '.join(self.request.replaced)} executed"
        return f"{self.before.source}: {executed}, {changes}"

    @cached_property
    def after(self) -> Log:
        """The rerun as a log, which can be analysed like any other log.

        Sites that were run again appear with their new records, and all other sites as
        recorded.
        """
        stream = io.BytesIO()
        self.write(stream)
        stream.seek(0)
        return open_log(stream)

    def write(self, stream: Sink, views_hz: float = 0.0) -> None:
        """Writes the rerun to a stream as a log.

        The log can be read, displayed and checked like the log of a run. The new records
        contain no measured values, such as computing times and round-trip times. The records of
        sites that were not run again are copied byte for byte. The file states the SHA-256 hash
        of its source log, the sites run again and the changed settings. Its scenario is that of
        the rerun.

        Args:
            stream: Stream to which the log is written. It is not closed.
            views_hz: Rate of the additional channels for viewers, in Hz, see `offer_views`. 0
                means none.

        Raises:
            LogError: The start time stated in the log is not a valid time.
            LogRefused: Writing to the disk failed.
        """
        log = self.before
        request = self.request
        session = log.session["session"]
        epoch_unix_ns = _parse_epoch(log)
        writer = LogWriter(
            stream=stream,
            scenario=request.scenario,
            session=session,
            driver=RERUN_DRIVER,
            epoch_unix_ns=epoch_unix_ns,
            provenance=collect_provenance(),
            facts=_collect_rerun_metadata(log, request),
            make_views=find_hook("offer the views of a log")(request.scenario, views_hz),
        )

        channels: dict[str, SiteChannels] = {}
        entries = []
        for name in log.sites:
            boot = log[name].states[0].boot if len(log[name]) else 0
            channels[name] = SiteChannels(request.scenario, session, name, boot)
            if name in request.recorded:
                entries.append(_copy_recorded(log, name, channels[name]))
            else:
                site_ticks = [tick for tick in self.ticks if tick.site == name]
                entries.append(_make_executed_entries(site_ticks, channels[name]))

        for entry in merge(*entries, key=lambda entry: entry.t_ns):
            channels[entry.site].write(entry, writer, epoch_unix_ns)
        writer.finish(render_accounts(channels.values()))

    def save(self, path: Path, *, force: bool = False) -> None:
        """Writes the rerun to a file as a log, including channels for viewers.

        Args:
            path: File to which the log is written.
            force: If True, an existing file is replaced.

        Raises:
            UsageError: The file exists, or cannot be created.
            LogRefused: Writing to the disk failed.
        """
        with LogFile(path, force=force) as stream:
            self.write(stream, VIZ_HZ)

    @property
    def diverged(self) -> bool:
        """True if an arm left its limits in the rerun, but not in the recorded run."""
        return any(
            effect.diverged_at_s is not None and self.before[name].states[-1].mode != "diverged"
            for name, effect in self.sites.items()
        )

    @property
    def identical(self) -> bool:
        """True if every compared record of the rerun is bit-identical to the log."""
        return all(effect.identical == effect.compared for effect in self.sites.values())

    @property
    def broken(self) -> bool:
        """True if the rerun differs from the log although it should be bit-identical.

        This indicates a program error or a damaged log. The rerun should be bit-identical if
        all of the following hold:

        - The log was written on this platform.
        - No setting was changed.
        - The log contains everything that its sites received. This is not the case if the log
          is itself a rerun in which some sites were copied from another log.
        """
        same_platform = self.before.session.get("fingerprint") == compute_fingerprint()
        are_executable = set(self.request.replaced) <= set(self.before.executed_sites)
        must_be_equal = same_platform and are_executable and not self.request.changes
        return must_be_equal and not self.identical

    @property
    def notes(self) -> list[str]:
        """Sentences that tell the user about the limitations of the rerun.

        For example, records may have been copied because the log was incomplete. Empty if there
        are no limitations.
        """
        return list(_describe_limits(self))

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a table of differences between the rerun and the recorded run, for JSON.

        The table has one row per site that was run again.
        """
        return list(self.to_dict()["sites"].values())

    def to_dict(self) -> dict[str, Any]:
        """Converts the result to plain JSON values, with the keys of `trilat rerun --json`."""
        return {
            "log": self.before.source,
            "mode": self.request.mode,
            "replaced": list(self.request.replaced),
            "recorded": list(self.request.recorded),
            "changes": [change._asdict() for change in self.request.changes],
            "without_effect": [change.key for change in self.request.without_effect],
            "identical": self.identical,
            "diverged": self.diverged,
            "sites": {name: _to_plain_value(effect) for name, effect in self.sites.items()},
            "links": {name: _to_plain_value(effect) for name, effect in self.links.items()},
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
    """Runs sites of a log again, usually with changed settings, and compares the results.

    The corresponding command is `trilat rerun`.

    >>> result = tn.rerun(tn.simulate("two_sites", duration_s=0.1), ["s"], {"control.Kd": 5})
    >>> result.identical
    False

    Args:
        log: Log of a run, or the path of its file.
        replace: Names of the sites to run again. All other sites keep their records and do not
            react.
        set: Changed settings of these sites, for example `{"control.Kd": 5}`.
        closed_loop: If True, all sites are run again, and `replace` must be empty.
        progress: Function that is called from time to time with the number of executed ticks,
            and an upper bound on their total.

    Raises:
        LogError: The log cannot be read, or lacks data that is needed to run the sites again.
        UsageError: Both `replace` and `closed_loop` are given, or neither is.
        ScenarioError: A site to run again does not exist, or a change is invalid or cannot have
            an effect.
        CodeWithheld: The control law of a site to run again is code that is not allowed to run.
    """
    before = log if isinstance(log, Log) else open_log(log)
    names = [replace] if isinstance(replace, str) else list(replace)
    request = RerunRequest.resolve(before, names, set, closed_loop=closed_loop)
    sites: dict[str, _SiteEffect] = {}
    links: dict[str, _LinkEffect] = {}
    with process.pause_gc():
        execution = RerunExecution(before, request)
        ticks = list(execution.run(progress))
        for name in execution.sites:
            site_ticks = [tick for tick in ticks if tick.site == name]
            sites[name], effects = _compare_site_rerun(
                before, request, execution, name, site_ticks
            )
            links.update({effect.link: effect for effect in effects})
    return Rerun(before, request, ticks, sites, links)


def _parse_epoch(log: Log) -> int:
    """Returns the Unix time of the start of a log's session, in ns.

    Raises:
        LogError: The time stated in the log is invalid.
    """
    text = log.session.get("epoch_unix_ns", "0")
    if not text.isdecimal() or int(text) > MAX_TIME_NS:
        raise LogError(f"{log.source}: epoch_unix_ns is not a valid time: {text[:40]!r}")
    return int(text)


def _collect_rerun_metadata(log: Log, request: RerunRequest) -> dict[str, str]:
    """Returns the metadata that states the origin of a rerun in its log.

    Args:
        log: The log whose sites were run again.
        request: Sites that were run again, and changed settings.

    Returns:
        A mapping from key to string: the source log, the sites run again and the changes.
    """
    digests = {}
    for source in log.sources:
        path = Path(source)
        if path.is_file():  # a log in memory has no file
            digests[path] = digest_file(path)
    return {
        "rerun_mode": request.mode,
        "rerun_of": " ".join(path.name for path in digests),
        "rerun_of_sha256": " ".join(digests.values()),
        "rerun_of_driver": log.driver,
        EXECUTED_SITES_KEY: " ".join(request.replaced),
        "rerun_changes": "; ".join(request.describe_changes()),
    }


def _copy_recorded(log: Log, name: str, channels: SiteChannels) -> Iterator[SiteEntry]:
    """Yields the messages of a site that a rerun copies from the source log, in order of time.

    The log of the rerun also contains the records, statistics and events of sites that were not
    run again.
    """
    site_log = log[name]
    site_events = [event for event in log.events if event.member == name]
    site_events.sort(key=lambda event: event.t_ns)  # events before the epoch come first
    record_entries = (
        channels.make_record_entry(state, payload)
        for state, payload in zip(site_log.states, site_log.payloads, strict=True)
    )
    stats_entries = map(channels.make_stats_entry, log.link_stats(name))
    event_entries = (
        channels.make_event_entry(event, number) for number, event in enumerate(site_events)
    )
    return merge(record_entries, stats_entries, event_entries, key=lambda entry: entry.t_ns)


def _make_executed_entries(
    ticks: Sequence[RerunTick], channels: SiteChannels
) -> Iterator[SiteEntry]:
    """Yields the entries of a site that was run again, in order of time."""
    for tick in ticks:
        state = decode(tick.payload, State, READABLE)
        yield channels.make_record_entry(state, tick.payload)
        output = state.to_tick_record(channels.peers)
        yield from channels.make_tick_entries(output, tick.stats)
    yield channels.make_end_entry()


def _to_plain_value(value: Any) -> Any:
    """Converts a value to types that JSON can represent.

    A named tuple becomes a dictionary. Infinite values and NaN become None, since JSON cannot
    represent them.
    """
    if hasattr(value, "_asdict"):
        return {key: _to_plain_value(item) for key, item in value._asdict().items()}
    return finite_or_none(value) if isinstance(value, float) else value


def _describe_limits(result: Rerun) -> Iterator[str]:
    """Yields sentences for the user about the limitations of a rerun.

    Args:
        result: The log and its rerun.
    """
    log = result.before
    request = result.request
    if request.recorded and request.changes:
        sites = " and ".join(request.recorded)
        if len(request.recorded) > 1:
            yield f"{sites} are as recorded: nothing is changed there, and they do not react"
        else:
            yield f"{sites} is as recorded: nothing is changed there, and it does not react"

    foreign_sites = [name for name in request.replaced if name not in log.executed_sites]
    if foreign_sites:
        yield (
            f"this file is itself a rerun: {', '.join(foreign_sites)} received samples that "
            "the file does not contain"
        )

    other_platform = log.session.get("fingerprint") != compute_fingerprint()
    if other_platform and not request.changes and not result.identical:
        yield (
            "the log was made with another platform's arithmetic: equal bits cannot be expected"
        )
    if not log.complete:
        yield "the log is incomplete: it is executed up to its last record"
    for law in request.scenario.inspect_user_laws():
        if law.changed and any(site in request.replaced for site in law.sites):
            yield f"the law is executed as its file is now: {law}"
    yield from _describe_later_changes(result)
    for effect in result.sites.values():
        yield from _describe_site_limits(effect, log.absent_ticks(effect.site))


def _describe_site_limits(effect: _SiteEffect, absent_ticks: int) -> Iterator[str]:
    """Yields sentences about missing data in the log that limit the rerun of one site.

    There is one sentence for each of the following that applies:

    - Ticks could not be executed because the log contains too little data. The recorded results
      of these ticks were copied.
    - Ticks have no record. They were executed with estimated arrivals of samples.
    - The site had left the live session for some ticks, which are executed nevertheless.
    - Samples arrived that the log does not contain. The ticks were executed without them.
    - No tick could be executed.

    Args:
        effect: Effect of the rerun on the site, with the numbers of these ticks and samples.
        absent_ticks: Number of ticks that the site did not execute in the live session, because
            it had left.
    """
    name = effect.site
    if effect.stands:
        copied = count_nouns(
            effect.stands, "record is copied unchanged", "records are copied unchanged"
        )
        yield f"{name}: {copied}, because the log lacks inputs to execute more"
    if effect.assumed:
        unrecorded = count_nouns(effect.assumed, "tick has", "ticks have")
        yield f"{name}: {unrecorded} no record in the log: their arrivals are assumed"
    if absent_ticks:
        ticks = count_nouns(absent_ticks, "tick")
        yield (
            f"{name}: it did not execute {ticks} of the run, because it had left; they are "
            "executed as if it had been there"
        )
    if effect.lacking:
        missing = count_nouns(
            effect.lacking, "sample that arrived is", "samples that arrived are"
        )
        yield f"{name}: {missing} not in the log, and therefore missing in the rerun"
    if not effect.executed:
        yield f"{name}: nothing could be executed"


def _describe_later_changes(result: Rerun) -> Iterator[str]:
    """Yields sentences about settings of the rerun that were changed again during the run.

    A link, or the dominance factors of a site, can change at certain times: through the
    timeline of the scenario, or through commands stored in the log. The rerun repeats these
    changes. A setting changed by the user of the rerun therefore applies only until the first
    of them.

    Args:
        result: The log and its rerun.
    """
    keys_set_by_user = [change.key for change in result.request.changes]

    # A changed object is a link, such as "m1->s", or a site whose dominance factors change.
    timeline = result.request.scenario.timeline
    changed_objects = [change.link or change.dominance for change in timeline]
    for name in result.request.replaced:  # only the executed sites
        for commands in result.before.commands(name).values():
            for command in commands:
                is_order = command.order is not None  # for example to stop; changes no setting
                if is_order:
                    continue
                changes_dominance = command.peer < 0
                if changes_dominance:
                    changed_objects.append(name)
                else:
                    sender = result.before[name].peers[command.peer]
                    changed_objects.append(f"{sender}->{name}")

    # The dictionary removes duplicates and keeps the order.
    for owner in dict.fromkeys(changed_objects):
        is_link = "->" in owner
        prefix = f"links.{owner}." if is_link else f"dominance.{owner}."
        if any(key.startswith(prefix) for key in keys_set_by_user):
            yield (
                f"{owner} changes during the run, in the log and in the rerun: the new setting "
                "applies only until its first change"
            )
