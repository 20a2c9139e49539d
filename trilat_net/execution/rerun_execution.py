"""Executes the sites of a rerun in turn, each against the samples that arrived at it.

Invariants: a site advances by `Site.step` alone. It receives the samples of recorded peers as
logged and those of executed peers as computed now, each at the tick at which the log says that
it arrived. Without changes a site resumes after a gap from two consecutive records, and the
record stands where too little is known; with changes its own steps carry it through gaps.

Only executed sites can be changed. A key that affects no executed site is refused; one that
affects recorded sites too changes nothing of theirs, and the result reports it.
"""

import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec

from ..core.site_step import Site
from ..core.ticks import MAX_ARRIVALS, NS_PER_S, Arrival, Mode, TickInput, TickRecord
from ..errors import LogError, ScenarioError, UsageError
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from ..net.messages import LinkStats
from ..net.timing import LoopStats
from ..net.wire import encode_state
from ..scenario import Scenario, find_owner, find_site, load_scenario, parse_scenario
from ..scenario.describe import describe_law, describe_value, flatten_table
from .resumption import (
    ReceivedMotion,
    RecordedInputs,
    find_recorded_hand,
    make_arrival,
    read_output,
)
from .verify import (
    PROGRESS_EVERY,
    RecordDifference,
    equal_bits,
    equal_record,
    find_first_difference,
)
from .virtual_network import (
    Deliveries,
    complete_deliveries,
    read_deliveries,
    retime_deliveries,
)

RerunOverrides = Mapping[str, Any] | Sequence[str]

_TEXT_KEYS = ("name", "title", "about", "assumed", "expect")


class ChangedValue(NamedTuple):
    """One value that the rerun changes, by its dotted path in the resolved scenario."""

    key: str
    before: Any
    after: Any


@dataclass(frozen=True)
class RerunRequest:
    """A rerun: its sites, its scenario and its changes.

    Attributes:
        scenario: the scenario of the rerun: changed for the executed sites, the log's for the
            others.
        replaced: the executed sites, in scenario order.
        without_effect: requested changes of recorded sites, which change nothing.
    """

    original: Scenario
    scenario: Scenario
    replaced: tuple[str, ...]
    recorded: tuple[str, ...]
    changes: list[ChangedValue]
    without_effect: list[ChangedValue] = field(default_factory=list)

    @property
    def mode(self) -> str:
        """The mode in words: "closed loop" if every site is executed, so that each reacts to
        the others.
        """
        return "open loop" if self.recorded else "closed loop"


def resolve_rerun_request(
    log: Log, replace: Sequence[str], overrides: RerunOverrides, *, closed_loop: bool
) -> RerunRequest:
    """Checks a request for a rerun and resolves its scenario, with overrides as `load_scenario`
    takes them.

    Raises:
        UsageError: the sites are not named, or in two ways.
        ScenarioError: there is no such site, or an override is not valid or cannot have an
            effect.
    """
    original = log.scenario
    names = original.names
    if closed_loop and replace:
        raise UsageError(
            "--closed-loop executes every site: leave out --replace, or --closed-loop"
        )
    if not closed_loop and not replace:
        hint = f"--replace NAME (of {', '.join(names)}), or --closed-loop for all of them"
        raise UsageError(f"which sites shall be executed? Give {hint}")
    for name in replace:
        find_site(original, name)
    replaced = tuple(name for name in names if closed_loop or name in replace)
    for name in [name for name in original.external if name in replaced]:
        others = [other for other in names if other not in original.external]
        raise ScenarioError(
            "is external: how that arm would have moved otherwise is not known; execute other sites"
            + (f", as in --replace {others[0]}" if others else ""),
            path=f"sites.{name}.plant",
        )
    recorded = tuple(name for name in names if name not in replaced)
    for text in overrides:  # keys of a mapping, or texts like KEY=VALUE
        key = text if isinstance(overrides, Mapping) else text.partition("=")[0].strip()
        _check_key(key, replaced, recorded)
    wanted = load_scenario(original, overrides)
    _check_frame(original, wanted, recorded)
    scenario = _join_scenarios(original, wanted, recorded) if recorded else wanted
    changes = _find_changes(original, scenario)
    without = [changed for changed in _find_changes(original, wanted) if changed not in changes]
    return RerunRequest(
        original=original,
        scenario=scenario,
        replaced=replaced,
        recorded=recorded,
        changes=changes,
        without_effect=without,
    )


def _check_key(key: str, replaced: Sequence[str], recorded: Sequence[str]) -> None:
    group, _, rest = key.partition(".")
    if group in _TEXT_KEYS:
        raise ScenarioError(
            "is nothing that is executed: it has no effect in a rerun", path=key
        )
    if group == "rate_hz" or rest.endswith(".rate_hz"):
        return  # `_check_frame` judges what comes of it
    member = rest.partition(".")[0]
    concerned = {"sites": member, "dominance": member, "links": member.partition("->")[2]}.get(
        group, ""
    )
    if concerned in recorded:
        why = f"{concerned} stays as recorded{', and a link belongs to its receiver' * (group == 'links')}"
        only = f"only {', '.join(replaced)} is executed"
        raise ScenarioError(
            f"has no effect: {why}; {only}: add --replace {concerned}", path=key
        )


def _check_frame(original: Scenario, wanted: Scenario, recorded: Sequence[str]) -> None:
    if wanted.names != original.names:
        raise ScenarioError(
            f"a rerun has the sites of the log, {', '.join(original.names)}", path="sites"
        )
    if wanted.duration_s > original.duration_s:
        raise ScenarioError(
            f"the experiment of the log lasts {original.duration_s:g} s: what the network would have done "
            f"until {wanted.duration_s:g} s is not known",
            path="duration_s",
        )
    for name in original.names if recorded else ():
        if wanted.sites[name].rate_hz != original.sites[name].rate_hz:
            raise ScenarioError(
                "cannot change in an open loop: samples come at the ticks of the log; use --closed-loop",
                path=f"sites.{name}.rate_hz",
            )


def _join_scenarios(original: Scenario, wanted: Scenario, recorded: Sequence[str]) -> Scenario:

    def source(name: str) -> Scenario:
        return original if name in recorded else wanted

    timeline = [change for change in original.timeline if find_owner(change) in recorded]
    timeline += [change for change in wanted.timeline if find_owner(change) not in recorded]
    joined = msgspec.structs.replace(
        wanted,
        sites={name: source(name).sites[name] for name in original.names},
        dominance={name: source(name).dominance[name] for name in original.names},
        links={name: source(name.partition("->")[2]).links[name] for name in original.links},
        timeline=tuple(sorted(timeline, key=lambda change: change.at_s)),
    )
    return parse_scenario(joined.text, original.name)


def _find_changes(original: Scenario, other: Scenario) -> list[ChangedValue]:
    before, after = (
        dict(flatten_table(msgspec.to_builtins(scenario))) for scenario in (original, other)
    )
    return [
        ChangedValue(key, before.get(key), after.get(key))
        for key in before | after
        if before.get(key) != after.get(key)
    ]


def describe_rerun_changes(request: RerunRequest) -> list[str]:
    """Returns the changes in words, a line for each, with all its owners."""
    owners: dict[tuple[str, str], list[str]] = {}
    for subject, owner, change in _describe_parts(request):
        owners.setdefault((subject, change), []).append(owner)
    lines = []
    for (subject, change), names in owners.items():
        if subject == "link":
            every = len(names) == len(request.scenario.links)
            lines.append(f"{'every link' if every else ', '.join(names)}: {change}")
        else:
            lines.append(
                f"{subject}{' of ' + ', '.join(names) if all(names) else ''}: {change}"
            )
    return lines


def _describe_parts(request: RerunRequest) -> Iterator[tuple[str, str, str]]:
    done: set[str] = set()
    for changed in request.changes:
        group, _, rest = changed.key.partition(".")
        owner, _, key = rest.partition(".")
        whole = _describe_whole(request, group, owner, key)
        if whole is None:
            values = f"{_shorten(changed.before)} -> {_shorten(changed.after)}"
            yield (key, owner, values) if group == "sites" else (changed.key, "", values)
        elif f"{group}.{owner}" not in done:
            done.add(f"{group}.{owner}")
            yield whole


def _describe_whole(
    request: RerunRequest, group: str, owner: str, key: str
) -> tuple[str, str, str] | None:
    """Describes a link, or a law of another kind, as a whole; None if single values say it all."""
    before = request.original
    after = request.scenario
    if group == "links":
        links = [scenario.links[owner].describe() for scenario in (before, after)]
        return None if links[0] == links[1] else ("link", owner, " -> ".join(links))
    if group == "sites" and key.startswith("control."):
        laws = [
            msgspec.to_builtins(scenario.sites[owner].control) for scenario in (before, after)
        ]
        same = laws[0]["law"] == laws[1]["law"]
        return None if same else ("control", owner, " -> ".join(map(describe_law, laws)))
    return None


def _shorten(value: object) -> str:
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return f"{len(value)} {'entry' if len(value) == 1 else 'entries'}"
    return describe_value(value)


class RerunTick(NamedTuple):
    """One tick of an executed site.

    Attributes:
        payload: its record as it would be published; the log's own if `kept`.
        same: True if the log has a record of that tick of which every computed field has the
            same bits.
        kept: True if the log's record stands, because too little is known to execute it.
        stats: its statistics, at the ticks that have some.
    """

    site: str
    tick: int
    t_ns: int
    mode: Mode
    payload: bytes
    same: bool
    kept: bool
    stats: LinkStats | None


class RerunSite:
    """One site, executed again against its deliveries.

    Samples of executed peers appear in `samples` as they are computed.

    Attributes:
        deliveries: what arrives at it.
        first: the first difference from the log's records.
        lacking: number of samples that arrived and are not in the log.
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
        self.name = name
        scenario = request.scenario
        part = log[name]
        self.k = deliveries.first
        self.first: RecordDifference | None = None
        self.lacking = 0
        self.diverged = False
        setup = scenario.setup(name)
        self._site = Site(setup)
        self._channel = setup.channel
        self._part = part
        self.deliveries = deliveries
        self._changed = bool(request.changes)
        self._inputs = RecordedInputs(
            part=part,
            samples=samples,
            ends=log.last_ticks,
            changes=log.commands(name),
            links=setup.links,
        )
        self._last = min(deliveries.last, scenario.ticks(name) - 1)
        same_rate = self._site.rate_hz == part.rate_hz
        self._recorded: list[int] = part.tick.tolist() if same_rate else []
        self._places = {tick: n for n, tick in enumerate(self._recorded)}
        self._boot = part.states[0].boot if len(part) else 0
        self._stats = LoopStats(self._site, self._boot)
        self._certain = deliveries.first == 0

    @property
    def done(self) -> bool:
        """True if it makes no more ticks."""
        return self.diverged or self.k > self._last

    @property
    def t_ns(self) -> int:
        """Nominal time of its next tick, ns since the epoch."""
        return self.k * NS_PER_S // self._site.rate_hz

    def execute_tick(self) -> RerunTick:
        """Executes one tick.

        Raises:
            LogError: the log orders more changes than a site takes, or holds an impossible
                record.
        """
        n = self._places.get(self.k)
        try:
            if n is not None and not self._certain and self._inputs.can_resume(n):
                missed = self._inputs.pop_changes(self.k - 1)
                self._inputs.resume(self._site, n, [change for _, change in missed])
                self._certain = True
            made = self._execute(n) if self._certain or n is None else self._keep(n)
        except (ValueError, OverflowError) as error:
            raise LogError(f"{self.name}, tick {self.k}: {error}") from None
        self.diverged = made.mode is Mode.DIVERGED
        self.k += 1
        # on to the next record
        if not (self._changed and self._certain) and self.k not in self._places:
            place = bisect.bisect_right(self._recorded, self.k)
            self.k = self._recorded[place] if place < len(self._recorded) else self._last + 1
            self._certain = False
        return made

    def _execute(self, n: int | None) -> RerunTick:
        arrivals, missing = self._inputs.find_arrivals(self.deliveries.entries.get(self.k, ()))
        self._inputs.add_lacking(missing)
        self.lacking += len(missing)
        changes = [change for _, change in self._inputs.pop_changes(self.k)]
        fits = self._site.layout.hand == self._part.layout.hand
        hand = find_recorded_hand(self._part, self._site, self.k) if fits else ()
        output = self._site.step(TickInput(self.k, arrivals[:MAX_ARRIVALS], changes, hand=hand))
        stats = self._stats.pop_stats(output) if self._stats.is_due(self.k) else None
        same = False
        if n is not None:
            state = self._part.states[n]
            peers = self._part.peers
            # arrivals have another CRC if peers are changed or the log lacks a sample
            comparable = (
                output._replace(rx_crc=state.rx_crc) if self._changed or missing else output
            )
            same = equal_record(state, comparable, peers)
            if not same and not self._changed and self._inputs.is_uncertain(state, output):
                return self._keep(n)
            if not same and self.first is None:
                self.first = find_first_difference(
                    logged=state,
                    computed=comparable,
                    peers=peers,
                    equal=equal_bits,
                    channel=self._channel,
                )
        self.output = output
        payload = encode_state(
            site=self.name,
            boot=self._boot,
            peers=self._part.peers,
            output=output,
            arrivals=arrivals[:MAX_ARRIVALS],
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

    def _keep(self, n: int) -> RerunTick:
        self._certain = False
        self.output = output = read_output(self._part.states[n], self._part.peers)
        payload = self._part.payloads[n]
        return RerunTick(
            site=self.name,
            tick=output.tick,
            t_ns=output.t_ns,
            mode=output.mode,
            payload=payload,
            same=False,
            kept=True,
            stats=None,
        )


MEMORY_S = 120
"""Longest time that a computed sample may be under way, s: longer than any queue holds one."""


class RerunExecution:
    """The sites of a rerun, executed.

    Raises:
        LogError: the log does not tell enough.
    """

    def __init__(self, log: Log, request: RerunRequest) -> None:
        self._log = log
        self._request = request
        self._recent: dict[str, dict[int, Arrival]] = {name: {} for name in request.replaced}
        samples: dict[str, Mapping[int, ReceivedMotion]] = {
            name: log[name].by_tick for name in request.recorded
        }
        samples |= self._recent  # filled as they are computed
        self.sites = {
            name: RerunSite(
                log=log,
                request=request,
                name=name,
                deliveries=self._find_deliveries(name),
                samples=samples,
            )
            for name in request.replaced
        }

    def _find_deliveries(self, name: str) -> Deliveries:
        part = self._log[name]
        original = self._log.scenario
        scenario = self._request.scenario
        if not self._request.changes:
            return read_deliveries(part)
        before = [original.sites[peer].rate_hz for peer in part.peers]
        after = [scenario.sites[peer].rate_hz for peer in part.peers]
        found = complete_deliveries(
            part, before, [self._log.last_ticks[peer] for peer in part.peers]
        )
        rate_hz = scenario.sites[name].rate_hz
        if (part.rate_hz, before) == (rate_hz, after):
            return found
        if found.first > 0:
            raise LogError(
                f"{self._log.source}: the records of {name} begin at tick {found.first}: "
                "a site that begins in the middle keeps its rate, and so do its peers"
            )
        return retime_deliveries(
            deliveries=found,
            rate_hz=part.rate_hz,
            new_rate_hz=rate_hz,
            rates_hz=before,
            new_rates_hz=after,
        )

    def run(self, progress: Progress | None = None) -> Iterator[RerunTick]:
        """Yields every tick of every executed site, in order of time as far as arrivals allow.

        A site that left its limits makes no more ticks. With changes, the others end with it.
        """
        sites = list(self.sites.values())
        total = sum(site.deliveries.last + 1 - site.deliveries.first for site in sites)
        pending = sorted(
            (site.t_ns, place, site.k) for place, site in enumerate(sites) if not site.done
        )
        done = 0
        last_ns = None
        while pending and (last_ns is None or pending[0][0] <= last_ns):
            first = next(
                (n for n, (_, at, k) in enumerate(pending) if self._is_ready(at, k)), 0
            )
            t_ns, place, _ = pending.pop(first)
            site = sites[place]
            made = site.execute_tick()
            output = site.output
            recent = self._recent[site.name]
            recent[output.tick] = make_arrival(0, output.tick, output)
            if len(recent) > MEMORY_S * self._request.scenario.sites[site.name].rate_hz:
                del recent[next(iter(recent))]
            yield made
            if site.diverged and self._request.changes:
                last_ns = t_ns
            if not site.done:
                bisect.insort(pending, (site.t_ns, place, site.k))
            done += 1
            if progress is not None and done % PROGRESS_EVERY == 0:
                progress(done, total)

    def _is_ready(self, place: int, k: int) -> bool:
        """True if every sample of a site's next tick, k, has been computed, or never will be."""
        receiver = self._request.replaced[place]
        peers = self._log[receiver].peers
        for peer, tick, _ in self.sites[receiver].deliveries.entries.get(k, ()):
            sender = self.sites.get(peers[peer])
            if sender is not None and not sender.done and tick >= sender.k:
                return False
        return True
