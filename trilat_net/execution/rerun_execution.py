"""Runs arms of a log again with changed settings, and rejects changes that have no effect.

A log has one record per tick for each arm. `what_if` uses this module to run some or all arms
again, for example with a different gain at the slave. A setting that affects only arms that are
not run again is rejected, because it would have no effect. A setting that affects both kinds of
arms changes only those that are run again, and the result reports this.

Invariant:
    - A site advances only through `Site.step`.
    - A site receives the new samples of the sites that are run again, and the recorded samples
      of all other sites. Each sample arrives in the tick in which it arrived according to the
      log.
    - Without changed settings, a tick is not executed if its inputs are unknown because records
      are missing. After a gap, execution resumes as soon as two consecutive records exist. If a
      tick has a record but cannot be executed, the recorded result is used.
    - With changed settings, ticks without a record are executed too. The arrivals of samples in
      these ticks are estimated.
"""

import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec

from ..core import MAX_ARRIVALS, Site, TickInput
from ..errors import LogError, ScenarioError, UsageError
from ..log import Log, Progress
from ..net import LinkStats, LoopStats, encode_state
from ..records import NS_PER_S, Arrival, Mode, TickRecord
from ..scenario import (
    Scenario,
    describe_law,
    describe_value,
    flatten_table,
    load_scenario,
    parse_scenario,
)
from .resumption import ReceivedMotion, RecordedInputs, find_recorded_hand, make_arrival
from .verification import PROGRESS_EVERY, RecordDifference, equal_record
from .virtual_network import Deliveries

RerunOverrides = Mapping[str, Any] | Sequence[str]
"""Changed settings: a mapping from key to value, or strings of the form "KEY=VALUE"."""

_TEXT_KEYS = ("name", "title", "about", "assumed", "expect")
"""Keys that describe a scenario and have no effect on a run."""


class _ChangedValue(NamedTuple):
    """One setting, such as a gain, that differs between a recorded run and its rerun.

    Attributes:
        key: Dotted path of the setting in the resolved scenario.
        before: Value with which the log was recorded.
        after: Value used in the rerun.
    """

    key: str
    before: Any
    after: Any


@dataclass(frozen=True)
class RerunRequest:
    """A checked request for a rerun: the sites of a log to run again, and changed settings.

    Created by `RerunRequest.resolve`. All other sites keep the records of the log.

    Attributes:
        original: Scenario of the log.
        scenario: Scenario of the rerun. It contains the changed settings of the sites to run
            again, and the original settings of all other sites.
        replaced: Names of the sites to run again, in scenario order.
        recorded: Names of the other sites, in scenario order.
        changes: Changed settings, with their values in the log and in the rerun.
        without_effect: Requested changes that have no effect, because they concern only sites
            that are not run again.
    """

    original: Scenario
    scenario: Scenario
    replaced: tuple[str, ...]
    recorded: tuple[str, ...]
    changes: list[_ChangedValue]
    without_effect: list[_ChangedValue] = field(default_factory=list)

    @property
    def mode(self) -> str:
        """Kind of the rerun: "closed loop" if every site is run again, otherwise "open loop".

        In an open-loop rerun, the sites that are not run again keep their records, and
        therefore do not react to changes.
        """
        return "open loop" if self.recorded else "closed loop"

    def describe_changes(self) -> list[str]:
        """Describes the settings that the rerun changes, with one line per kind of change.

        Sites or links that are changed in the same way share a line. Empty if nothing is
        changed.
        """
        owners: dict[tuple[str, str], list[str]] = {}
        for subject, owner, change in _describe_changes(self):
            owners.setdefault((subject, change), []).append(owner)

        lines = []
        for (subject, change), names in owners.items():
            if subject == "link" and len(names) == len(self.scenario.links):
                lines.append(f"every link: {change}")
            elif subject == "link":
                lines.append(f"{', '.join(names)}: {change}")
            elif all(names):
                lines.append(f"{subject} of {', '.join(names)}: {change}")
            else:
                lines.append(f"{subject}: {change}")
        return lines

    @classmethod
    def resolve(
        cls, log: Log, replace: Sequence[str], overrides: RerunOverrides, *, closed_loop: bool
    ) -> "RerunRequest":
        """Checks a request for a rerun, and applies its changes to the scenario of the log.

        A rerun runs sites of a log again, usually with changed settings. In a closed-loop
        rerun, all sites are run again. Otherwise, some sites keep their records.

        Args:
            log: Log of a run, which contains its scenario.
            replace: Names of the sites to run again. Empty for a closed-loop rerun.
            overrides: Changed settings, in the form accepted by `load_scenario`.
            closed_loop: If True, all sites are run again.

        Raises:
            UsageError: Both `replace` and `closed_loop` are given, or neither is.
            ScenarioError: A site to run again does not exist, or a change is invalid or cannot
                have an effect.
        """
        original = log.scenario
        names = original.names
        if closed_loop and replace:
            raise UsageError(
                "--closed-loop executes every site: leave out either --replace or --closed-loop"
            )
        if not closed_loop and not replace:
            hint = f"--replace NAME (one of {', '.join(names)}), or --closed-loop for all sites"
            raise UsageError(f"name the sites to execute: give {hint}")

        for name in replace:
            original.find_site(name)
        replaced = tuple(name for name in names if closed_loop or name in replace)
        _refuse_external_sites(original, replaced)
        recorded = tuple(name for name in names if name not in replaced)

        for text in overrides:  # keys of a mapping, or texts like KEY=VALUE
            key = text if isinstance(overrides, Mapping) else text.partition("=")[0].strip()
            _check_key(key, replaced, recorded)

        requested = load_scenario(original, overrides)
        _check_recorded_limits(original, requested, recorded)
        scenario = requested
        if recorded:
            scenario = _join_scenarios(original, requested, recorded)
        changes = _find_changes(original, scenario)
        requested_changes = _find_changes(original, requested)
        return cls(
            original=original,
            scenario=scenario,
            replaced=replaced,
            recorded=recorded,
            changes=changes,
            without_effect=[change for change in requested_changes if change not in changes],
        )


def _refuse_external_sites(original: Scenario, replaced: Sequence[str]) -> None:
    """Raises ScenarioError if the arm of a site to be run again is external.

    The log does not show how a real robot or a user's program would have reacted to different
    torques.

    Raises:
        ScenarioError: A site that is to be run again has an external arm.
    """
    for name in original.external:
        if name not in replaced:
            continue
        problem = (
            "is external: the log does not show how it would have moved; execute other sites"
        )
        others = [other for other in original.names if other not in original.external]
        if others:
            problem += f", as in --replace {others[0]}"
        raise ScenarioError(problem, path=f"sites.{name}.plant")


def _check_key(key: str, replaced: Sequence[str], recorded: Sequence[str]) -> None:
    """Rejects a changed setting that cannot have an effect in a rerun.

    For example, a setting of a site whose records are copied has no effect.

    Args:
        key: Dotted path of the setting, such as "sites.m1.control.Kd".
        replaced: Names of the sites to run again.
        recorded: Names of the other sites.
    """
    section, _, path_in_section = key.partition(".")
    if section in _TEXT_KEYS:
        raise ScenarioError(
            "only describes the scenario and has no effect in a rerun", path=key
        )
    if section == "rate_hz" or path_in_section.endswith(".rate_hz"):
        return  # `_check_recorded_limits` checks the rates of the resolved scenario

    section_entry = path_in_section.partition(".")[0]
    if section == "links":
        affected_site = section_entry.partition("->")[2]
    elif section in ("sites", "dominance"):
        affected_site = section_entry
    else:
        return  # the setting concerns the whole scenario

    if affected_site in recorded:
        reason = f"{affected_site} stays as recorded"
        if section == "links":
            reason += ", and a link belongs to its receiver"
        executed = f"the rerun executes only {', '.join(replaced)}"
        raise ScenarioError(
            f"has no effect: {reason}; {executed}: add --replace {affected_site}", path=key
        )


def _check_recorded_limits(
    original: Scenario, requested: Scenario, recorded: Sequence[str]
) -> None:
    """Rejects changes to a rerun that are not covered by the recorded arrivals of samples.

    These are different sites, a longer duration, and different tick rates if some sites are not
    run again.

    Args:
        original: Scenario of the log.
        requested: Scenario with the changes.
        recorded: Names of the sites that are not run again.
    """
    if requested.names != original.names:
        raise ScenarioError(
            f"a rerun must have the same sites as the log: {', '.join(original.names)}",
            path="sites",
        )
    if requested.duration_s > original.duration_s:
        raise ScenarioError(
            f"the experiment in the log lasts {original.duration_s:g} s; how the network would "
            f"behave from then until {requested.duration_s:g} s is not known",
            path="duration_s",
        )
    if not recorded:
        return
    for name in original.names:
        if requested.sites[name].rate_hz != original.sites[name].rate_hz:
            raise ScenarioError(
                "cannot change in an open-loop rerun, because samples arrive at the ticks that "
                "the log contains; use --closed-loop",
                path=f"sites.{name}.rate_hz",
            )


def _join_scenarios(
    original: Scenario, requested: Scenario, recorded: Sequence[str]
) -> Scenario:
    """Returns the requested scenario, but with the original settings of the recorded sites.

    The sites to run again use the requested settings. The recorded sites keep their own
    settings, which include the links over which they receive, and the planned changes of these
    links and of their dominance factors.

    Args:
        original: Scenario of the log.
        requested: Scenario with the changes.
        recorded: Names of the sites that are not run again, and keep their records.
    """

    def choose(site: str) -> Scenario:
        return original if site in recorded else requested

    timeline = [change for change in original.timeline if change.owner in recorded]
    timeline += [change for change in requested.timeline if change.owner not in recorded]
    links = {}
    for link in original.links:
        receiver = link.partition("->")[2]
        links[link] = choose(receiver).links[link]
    joined = msgspec.structs.replace(
        requested,
        sites={name: choose(name).sites[name] for name in original.names},
        dominance={name: choose(name).dominance[name] for name in original.names},
        links=links,
        timeline=tuple(sorted(timeline, key=lambda change: change.at_s)),
    )
    return parse_scenario(joined.text, original.name)


def _find_changes(original: Scenario, other: Scenario) -> list[_ChangedValue]:
    """Returns the settings that differ between two scenarios, with both of their values."""
    before = dict(flatten_table(msgspec.to_builtins(original)))
    after = dict(flatten_table(msgspec.to_builtins(other)))
    return [
        _ChangedValue(key, before.get(key), after.get(key))
        for key in before | after
        if before.get(key) != after.get(key)
    ]


def _describe_changes(request: RerunRequest) -> Iterator[tuple[str, str, str]]:
    """Yields the parts of a description for every change.

    The keys of changed values have the form group.owner.key, for example "sites.m1.control.Kd",
    "links.m1->s.delay_ms" or "dominance.s.m1". Keys with no owner, such as "duration_s", apply
    to the whole scenario. If a link model or control law is replaced, several values of the
    same owner differ. They are described once, together.

    Yields:
        The subject ("link" or the name of a key), its owner (a link or site, or empty for the
        whole scenario), and the change as a string.
    """
    replaced_objects: set[str] = set()  # as group.owner
    for change in request.changes:
        group, _, path_in_group = change.key.partition(".")
        owner, _, key = path_in_group.partition(".")
        replacement = _describe_replacement(request, group, owner, key)
        if replacement is None:  # the change concerns a single value
            values = f"{_shorten(change.before)} -> {_shorten(change.after)}"
            if group == "sites":
                yield key, owner, values
            else:
                yield change.key, "", values
        elif f"{group}.{owner}" not in replaced_objects:
            replaced_objects.add(f"{group}.{owner}")
            yield replacement


def _describe_replacement(
    request: RerunRequest, group: str, owner: str, key: str
) -> tuple[str, str, str] | None:
    """Describes a change that replaces an entire link or control law.

    The entire link is described if its short description differs, and the entire law if its
    kind differs.

    Args:
        request: The request.
        group: First part of the changed key, for example "links".
        owner: Second part of the key: a link or a site.
        key: Rest of the key.

    Returns:
        Subject, owner and text, see `_describe_changes`. None if only a single value is
        changed.
    """
    original = request.original
    changed = request.scenario
    if group == "links":
        original_text = original.links[owner].describe()
        changed_text = changed.links[owner].describe()
        if original_text != changed_text:
            return "link", owner, f"{original_text} -> {changed_text}"
    if group == "sites" and key.startswith("control."):
        original_law = msgspec.to_builtins(original.sites[owner].control)
        changed_law = msgspec.to_builtins(changed.sites[owner].control)
        if original_law["law"] != changed_law["law"]:
            return (
                "control",
                owner,
                f"{describe_law(original_law)} -> {describe_law(changed_law)}",
            )
    return None


def _shorten(value: object) -> str:
    """Formats a value as a string. For a list of tables, only its length is stated."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return f"{len(value)} {'entry' if len(value) == 1 else 'entries'}"
    return describe_value(value)


class RerunTick(NamedTuple):
    """One re-executed tick of a site, with the record that it produced.

    Attributes:
        site: Name of the site.
        tick: Number of the tick.
        t_ns: Nominal time of the tick, in ns after the epoch (the common start time).
        mode: Operating mode in which the site executed the tick, for example running or at
            rest.
        payload: Encoded record, as the site would publish it. If `kept`, the record from the
            log.
        same: True if the log contains a record of the tick, and all computed fields are
            bit-identical.
        kept: True if the record was copied, because the log does not contain enough data to
            execute the tick.
        stats: Statistics of the site's links. None if they are not due in this tick.
    """

    site: str
    tick: int
    t_ns: int
    mode: Mode
    payload: bytes
    same: bool
    kept: bool
    stats: LinkStats | None


class _RerunSite:
    """Runs one site of a log again, tick by tick.

    The state of the site is certain if it follows from the previous ticks. It becomes uncertain
    after a gap in the log. Records are then copied until two consecutive records determine the
    state again.

    Args:
        log: The log.
        request: Sites to run again, and changed settings.
        name: Name of the site.
        deliveries: The ticks in which samples from other sites arrive at this one.
        samples: Samples of all sites, keyed by site and tick. The samples of sites that are
            run again are added as they are computed.

    Attributes:
        name: Name of the site.
        k: Number of the next tick.
        output: Record of the last tick.
        deliveries: The ticks in which samples from other sites arrive at this one.
        first: First difference from the records of the log. None if no record differs so far.
        lacking: Number of samples that arrived, but whose content is missing from the log.
        diverged: True after the arm of the site has left its limits.
    """

    output: TickRecord

    def __init__(
        self,
        log: Log,
        request: RerunRequest,
        name: str,
        deliveries: Deliveries,
        samples: Mapping[str, Mapping[int, ReceivedMotion]],
    ) -> None:
        """Creates a site in its initial state, and collects its inputs from the log."""
        site_log = log[name]
        scenario = request.scenario
        setup = scenario.setup(name)
        self.name = name
        self.k = deliveries.first
        self.deliveries = deliveries
        self.first: RecordDifference | None = None
        self.lacking = 0
        self.diverged = False

        # The executed site, and its inputs according to the log.
        self._site = Site(setup)
        self._channel = setup.channel
        self._site_log = site_log
        self._changed = bool(request.changes)
        self._inputs = RecordedInputs(
            site_log=site_log,
            samples=samples,
            ends=log.last_ticks,
            changes=log.commands(name),
            links=setup.links,
        )
        self._last_tick = min(deliveries.last, scenario.ticks(name) - 1)

        # At another rate, records and ticks have different times and cannot be compared.
        has_same_rate = self._site.rate_hz == site_log.rate_hz
        self._recorded_ticks: list[int] = site_log.tick.tolist() if has_same_rate else []
        self._rows = {tick: row for row, tick in enumerate(self._recorded_ticks)}

        self._boot = site_log.states[0].boot if len(site_log) else 0
        self._stats = LoopStats(self._site, self._boot)
        self._certain = deliveries.first == 0  # whether the state of the site is known

    @property
    def is_done(self) -> bool:
        """True if the site has executed its last tick."""
        return self.diverged or self.k > self._last_tick

    @property
    def t_ns(self) -> int:
        """Nominal time of the next tick to execute, in ns after the epoch (common start)."""
        return self.k * NS_PER_S // self._site.rate_hz

    def execute_tick(self) -> RerunTick:
        """Executes the next tick of the site, or copies its record if execution is impossible.

        A tick can be executed only if the state of the site before it is certain. There are
        three cases:

        - The state follows from the previous tick: the tick is executed.
        - The state is uncertain, for example after a gap in the log, but is determined by the
          two records before the tick: the state is restored, and the tick is executed.
        - The state remains uncertain: the record of the tick is copied from the log.

        Afterwards, `k` is the next tick. A gap in the log contains no records to copy or
        compare. If settings were changed, the ticks of the gap are executed, because they then
        have new results. Otherwise, the gap is skipped.

        Returns:
            The tick with its record.

        Raises:
            LogError: The log lists more changes than a site accepts, or contains an impossible
                record.
        """
        row = self._rows.get(self.k)  # None: the log has no record of the tick
        try:
            if row is not None and not self._certain and self._inputs.can_resume(row):
                changes_in_gap = [change for _, change in self._inputs.pop_changes(self.k - 1)]
                self._inputs.resume(self._site, row, changes_in_gap)
                self._certain = True
            if self._certain or row is None:
                tick = self._execute(row)
            else:
                tick = self._keep_record(row)
        except (ValueError, OverflowError) as error:
            raise LogError(f"{self.name}, tick {self.k}: {error}") from None

        self.diverged = tick.mode is Mode.DIVERGED
        self.k += 1
        executes_gaps = self._changed and self._certain
        is_gap = self.k not in self._rows
        if is_gap and not executes_gaps:
            self._skip_gap()
        return tick

    def _skip_gap(self) -> None:
        """Continues at the next record of an incomplete log, skipping the ticks before it.

        If there are no more records, the site is done.
        """
        index = bisect.bisect_right(self._recorded_ticks, self.k)
        self.k = self._last_tick + 1
        if index < len(self._recorded_ticks):
            self.k = self._recorded_ticks[index]
        self._certain = False

    def _execute(self, row: int | None) -> RerunTick:
        """Executes the next tick, and compares it with the record in the log.

        The inputs of the tick are the samples that arrive according to `deliveries`, together
        with the changes and the operator's actions in the log.

        Args:
            row: Index of the record. None if the log does not contain a record of the tick.
        """
        arrivals, missing = self._inputs.find_arrivals(self.deliveries.entries.get(self.k, ()))
        arrivals = arrivals[:MAX_ARRIVALS]
        self._inputs.add_lacking(missing)
        self.lacking += len(missing)
        changes = [change for _, change in self._inputs.pop_changes(self.k)]
        hand: Sequence[float] = ()
        if self._site.layout.hand == self._site_log.layout.hand:
            hand = find_recorded_hand(self._site_log, self._site, self.k)

        output = self._site.step(TickInput(self.k, arrivals, changes, hand=hand))
        stats = self._stats.pop_stats(output) if self._stats.is_due(self.k) else None

        same = False
        if row is not None:
            state = self._site_log.states[row]
            comparable = output
            if self._changed or missing:
                # The checksum covers samples that have changed, or that the log lacks.
                comparable = output._replace(rx_crc=state.rx_crc)
            same = equal_record(state, comparable, self._site_log.peers)
            if not same and not self._changed and self._inputs.is_uncertain(state, output):
                return self._keep_record(row)
            if not same and self.first is None:
                self.first = RecordDifference.find(
                    logged=state,
                    computed=comparable,
                    peers=self._site_log.peers,
                    channel=self._channel,
                )

        self.output = output
        payload = encode_state(
            site=self.name,
            boot=self._boot,
            peers=self._site_log.peers,
            output=output,
            arrivals=arrivals,
            late_us=0,
            busy_us=0,
        )
        return RerunTick(
            site=self.name,
            tick=output.tick,
            t_ns=output.t_ns,
            mode=output.mode,
            payload=payload,
            same=same,
            kept=False,
            stats=stats,
        )

    def _keep_record(self, row: int) -> RerunTick:
        """Copies the record of the next tick from the log, because it cannot be executed.

        The state of the site is unknown afterwards.

        Args:
            row: Index of the record in the log.
        """
        self._certain = False
        output = self._site_log.states[row].to_tick_record(self._site_log.peers)
        self.output = output
        return RerunTick(
            site=self.name,
            tick=output.tick,
            t_ns=output.t_ns,
            mode=output.mode,
            payload=self._site_log.payloads[row],
            same=False,
            kept=True,
            stats=None,
        )


_MEMORY_S = 120
"""Time for which computed samples are kept for delivery, in s.

No sample is in transit for longer.
"""


class RerunExecution:
    """Runs all requested sites of a log again, in one common simulation.

    These sites exchange newly computed samples. The samples of the other sites are taken from
    the log.

    Args:
        log: The log.
        request: Sites to run again, and changed settings.

    Attributes:
        sites: Sites that are run again, keyed by name.

    Raises:
        LogError: The log does not contain enough data to run the sites again.
    """

    def __init__(self, log: Log, request: RerunRequest) -> None:
        """Creates the sites that are run again, and connects them to each other.

        They exchange newly computed samples instead of those in the log.
        """
        self._log = log
        self._request = request
        self._recent: dict[str, dict[int, Arrival]] = {name: {} for name in request.replaced}
        samples: dict[str, Mapping[int, ReceivedMotion]] = {
            name: log[name].by_tick for name in request.recorded
        }
        # The computed samples are added to these dictionaries during the execution.
        samples |= self._recent
        self.sites = {
            name: _RerunSite(
                log=log,
                request=request,
                name=name,
                deliveries=self._find_deliveries(name),
                samples=samples,
            )
            for name in request.replaced
        }

    def _find_deliveries(self, name: str) -> Deliveries:
        """Determines in which tick of a site each sample from the other sites arrives.

        There are three cases:

        - No setting was changed: the samples arrive as listed in the records of the site.
        - Settings were changed: arrivals in ticks without a record are estimated.
        - Tick rates were changed: in addition, all arrivals are converted to the new rates.

        Raises:
            LogError: Too many records are missing, or a site that joined late has another rate.
        """
        site_log = self._log[name]
        original = self._log.scenario
        scenario = self._request.scenario
        if not self._request.changes:
            return Deliveries.read(site_log)

        rates_hz = [original.sites[peer].rate_hz for peer in site_log.peers]
        new_rates_hz = [scenario.sites[peer].rate_hz for peer in site_log.peers]
        new_rate_hz = scenario.sites[name].rate_hz
        last_ticks = [self._log.last_ticks[peer] for peer in site_log.peers]
        deliveries = Deliveries.complete(site_log, rates_hz, last_ticks)
        if site_log.rate_hz == new_rate_hz and rates_hz == new_rates_hz:
            return deliveries

        if deliveries.first > 0:
            raise LogError(
                f"{self._log.source}: the records of {name} begin at tick {deliveries.first}: "
                "if the records of a site begin after the start of the run, the rates of the "
                "site and of its peers cannot be changed"
            )
        return deliveries.retime(
            rate_hz=site_log.rate_hz,
            new_rate_hz=new_rate_hz,
            rates_hz=rates_hz,
            new_rates_hz=new_rates_hz,
        )

    def run(self, progress: Progress | None = None) -> Iterator[RerunTick]:
        """Executes all ticks of the requested sites, and yields the result of each tick.

        Ticks are executed in order of time, except that a site waits until the samples that it
        receives have been computed. A site stops when its arm leaves its limits. If settings
        were changed, all sites stop at this time.

        Args:
            progress: Function that is called from time to time with the number of executed
                ticks, and an upper bound on their total. If None, progress is not reported.

        Yields:
            The result of each tick.
        """
        sites = list(self.sites.values())
        total = sum(site.deliveries.last + 1 - site.deliveries.first for site in sites)
        # (t_ns, index of the site, tick) of each site's next tick, in order of time
        pending = sorted(
            (site.t_ns, index, site.k) for index, site in enumerate(sites) if not site.is_done
        )
        executed = 0
        last_ns = None

        while pending and (last_ns is None or pending[0][0] <= last_ns):
            t_ns, index, _ = pending.pop(self._find_ready(pending))
            site = sites[index]
            tick = site.execute_tick()
            self._keep_sample(site)
            yield tick
            if site.diverged and self._request.changes:
                last_ns = t_ns
            if not site.is_done:
                bisect.insort(pending, (site.t_ns, index, site.k))
            executed += 1
            if progress is not None and executed % PROGRESS_EVERY == 0:
                progress(executed, total)

    def _keep_sample(self, site: _RerunSite) -> None:
        """Stores the newest computed sample of a site, which its peers will receive.

        Samples that are too old to arrive are removed.
        """
        output = site.output
        recent = self._recent[site.name]
        recent[output.tick] = make_arrival(0, output.tick, output)
        if len(recent) > _MEMORY_S * self._request.scenario.sites[site.name].rate_hz:
            del recent[next(iter(recent))]

    def _find_ready(self, pending: Sequence[tuple[int, int, int]]) -> int:
        """Chooses the site that executes its next tick.

        A tick can be executed once all samples that arrive in it are known. The earliest such
        tick is chosen. If no tick is ready because every site is waiting for a sample from
        another site, the earliest tick is chosen anyway, since the execution must continue. The
        missing samples are then treated as not contained in the log.

        Args:
            pending: Next tick of each site that has not finished, as (time in ns, index of the
                site among those that are run again, tick), in order of time.

        Returns:
            Index of the chosen entry in `pending`.
        """
        for position, (_, site_index, k) in enumerate(pending):
            receiver = self._request.replaced[site_index]
            if self._is_ready(receiver, k):
                return position
        return 0  # the earliest

    def _is_ready(self, receiver: str, k: int) -> bool:
        """Returns True if all samples that arrive in a site's next tick are known.

        A sample is ready if the sender has executed the tick that produces it, or has finished
        and never will. The samples of a recorded sender are in the log, so they are always
        ready.

        Args:
            receiver: Name of the site.
            k: Number of its next tick.
        """
        sender_names = self._log[receiver].peers
        arrivals = self.sites[receiver].deliveries.entries.get(k, ())
        for peer_index, sent_tick, _ in arrivals:
            sender = self.sites.get(sender_names[peer_index])
            if sender is None or sender.is_done:
                continue
            is_computed = sent_tick < sender.k  # `sender.k` is the next tick of the sender
            if not is_computed:
                return False
        return True
