"""Answers users' requests for changes while an arm is running.

For example, `trilat set` changes the delay of a network link, and `trilat stop` stops an arm.
Such a command sends a request to the site. Before each tick of its control loop, the site
checks the requests that have arrived and replies to each of them.

Invariant:
    - Every request is answered: it is either accepted, or rejected with a reason. An accepted
      change is stored in the log, in the record of the tick that accepts it, so that the run
      can be reproduced.
    - A change of a link or of weights takes effect `AHEAD_MS` after it was accepted, because
      some decisions are made in advance. For example, the delay of a sample can no longer
      change once the sample has been sent.
    - A command to stop an arm is executed at once. The commands "enable" and "reset" are never
      executed in the same tick as another command, so that they cannot undo a stop. They wait
      for the next tick, as do the requests that arrived after them.
    - A change of weights is spread over at least `MIN_RAMP_S`, whatever the request says, so
      that the reference of the arm does not jump. The log contains the actual duration.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress

import msgspec
from msgspec import UNSET

from trilat_net.core import MAX_CHANGES, MAX_RAMPS, CoreChange, first_tick_at, tick_ns
from trilat_net.errors import ScenarioError, WireError
from trilat_net.net import (
    MODE_WORDS,
    ChangeReply,
    ChangeRequest,
    Query,
    QueryInbox,
    decode,
    encode,
)
from trilat_net.recorded_change import SiteOrder
from trilat_net.records import Mode
from trilat_net.scenario import LinkTables, Scenario, resolve_change

AHEAD_MS = 100
"""Time from accepting a change until it takes effect, in ms."""
MIN_RAMP_S = 0.5
"""Minimum duration of a change of weights, in s."""
MARKS_WAITING = 16
"""Maximum number of unpublished marks. A site publishes its marks every 100 ms."""


_NEEDED_MODES = {"reset": Mode.FAULT, "enable": Mode.STOPPED}
"""Mapping from each command that has an effect in only one mode to that mode."""


class ChangeServer:
    """Answers requests to a site, and keeps the accepted changes for its control loop.

    A request may, for example, change the delay of a link or tell the site to stop its arm. The
    control loop of the site calls `pop_changes` before each tick.

    Args:
        scenario: Scenario of the session.
        site: Name of the site.
        queries: Requests from the operator, who may change everything.
        mode: Function that returns the mode of the site after its last tick.
        held: Function that returns True if the dead-man switch is held or if there is none. If
            it returns False, the commands "enable" and "reset" are rejected.
        stops: Requests from other members, who may only stop the site. None if there are none.

    Attributes:
        stopped: True if the next tick is the last one before a requested end of the run.
        marks: Marks (notes for the log) that have not been published yet, as pairs of tick and
            text.
        sources: Mapping from each accepted change, as written in the record of the tick, to the
            name of its requester. An entry is removed when the change is published.
    """

    def __init__(
        self,
        scenario: Scenario,
        site: str,
        queries: QueryInbox,
        mode: Callable[[], Mode] = lambda: Mode.RUN,
        held: Callable[[], bool] = lambda: True,
        stops: QueryInbox | None = None,
    ) -> None:
        self._scenario = scenario
        self._site = site
        self._queries = queries
        self._stops = stops
        self._read_mode = mode
        self._is_held = held
        self._rate_hz = scenario.sites[site].rate_hz
        self._ticks = scenario.ticks(site)
        self._links = LinkTables(scenario.links, scenario.timeline)

        # Request that waits for a tick without other orders.
        self._deferred: Query | None = None

        # Accepted changes: their number per link, and the start times of weight changes.
        self._accepted_counts: Counter[str] = Counter()
        self._pending_ramps_ns: deque[int] = deque()

        # First tick after the end that a user has requested.
        self._stop_tick: int | None = None
        self.stopped = False

        self.marks: list[tuple[int, str]] = []
        self.sources: dict[str, str] = {}

    def pop_changes(self, next_tick: int) -> Sequence[CoreChange]:
        """Answers all pending requests from users, and returns the changes for the next tick.

        The control loop of the arm calls this method before each tick.

        Args:
            next_tick: Number of the next tick.

        Returns:
            The changes that the site applies in that tick. Empty if none were accepted since
            the last call.
        """
        self._update_stopped(next_tick)

        changes: list[CoreChange] = []
        has_order = False
        while (query := self._poll()) is not None:
            try:
                request = decode(query.payload, ChangeRequest)
                # "enable" and "reset" wait for a tick without earlier orders.
                must_wait = has_order and request.order in _NEEDED_MODES
                if must_wait:
                    self._deferred = query
                    break

                text, effect_tick, change = self._accept(request, next_tick)
                if change is not None:
                    changes.append(change)
                    has_order = has_order or bool(request.order)
                    if isinstance(request.source, str):
                        self.sources[change.text] = request.source
                reply = ChangeReply(
                    member=self._site, accepted=True, text=text, tick=effect_tick
                )
            except (WireError, ScenarioError) as error:
                reply = ChangeReply(member=self._site, accepted=False, text=str(error))

            query.reply(encode(reply))
        return changes

    def _accept(
        self, request: ChangeRequest, next_tick: int
    ) -> tuple[str, int, CoreChange | None]:
        """Carries out a user's request, or rejects it with an error.

        A request changes a setting, marks the present moment in the log, gives the arm a
        command such as "stop", or ends the run.

        Args:
            request: The request.
            next_tick: Number of the next tick.

        Returns:
            The text of the reply, the first tick in which the request has an effect, and the
            change to apply in that tick. The change is None for marks and for the end of the
            run.

        Raises:
            ScenarioError: The site rejects the request.
        """
        if request.stop_s is not None:
            text, end_tick = self._schedule_stop(next_tick, request.stop_s)
            return text, end_tick, None
        if request.mark:
            return self._add_mark(next_tick, request.mark), next_tick, None
        if request.order:
            change = self._make_order_change(next_tick, request.order)
            return (
                f"{self._site} executes {request.order} at tick {next_tick}",
                next_tick,
                change,
            )

        # A change of a link or of weights, which takes effect later.
        start_ns = tick_ns(next_tick, self._rate_hz) + AHEAD_MS * 1_000_000
        first = first_tick_at(start_ns, self._rate_hz)
        change = self._make_change(request, first)
        text = (
            f"{self._site} accepts the change at tick {next_tick}; "
            f"the change takes effect at tick {first}"
        )
        return text, first, change

    def _poll(self) -> Query | None:
        """Returns the next pending request from a user, or None if there is none.

        For safety, stop commands from other processes come first. They are followed by the
        request that had to wait for a tick with no other command, and then by the requests from
        the operator.
        """
        query = self._poll_stop()
        if query is None:
            query = self._deferred or self._queries.poll()
            self._deferred = None
        return query

    def _poll_stop(self) -> Query | None:
        """Returns the next stop command from a process that may send no other request.

        For safety, any process of a session may stop an arm, while only the operator may change
        settings. Other requests from such a process are rejected here. The command may name its
        source.
        """
        while self._stops is not None and (query := self._stops.poll()) is not None:
            with suppress(WireError):
                request = decode(query.payload, ChangeRequest)
                without_source = msgspec.structs.replace(request, source=UNSET)
                if without_source == ChangeRequest(order="stop"):
                    return query
            text = f"{self._site} accepts only requests to stop under this key"
            query.reply(encode(ChangeReply(member=self._site, accepted=False, text=text)))
        return None

    def _add_mark(self, next_tick: int, text: str) -> str:
        """Stores a mark (a text for the log) until its event is published.

        For example, a user marks the moment of a contact to find it in the log later.

        Args:
            next_tick: Next tick, at which the mark is placed.
            text: Text of the mark, for example "contact".

        Returns:
            The reply to the user, for example "s marks tick 1200".

        Raises:
            ScenarioError: Too many marks are waiting.
        """
        if len(self.marks) >= MARKS_WAITING:
            raise ScenarioError(
                f"at most {MARKS_WAITING} marks can be pending at once; try again in 100 ms"
            )
        self.marks.append((next_tick, text))
        return f"{self._site} marks tick {next_tick}"

    def _make_order_change(self, tick: int, order: SiteOrder) -> CoreChange:
        """Converts a user's command to the change that the control loop carries out.

        Such commands stop an arm, let it move again, or clear a fault.

        Args:
            tick: Number of the tick.
            order: The command: "stop", "enable" or "reset".

        Raises:
            ScenarioError: The site is not in the mode that the command requires, or the
                dead-man switch is not held.
        """
        mode = self._read_mode()
        needed = _NEEDED_MODES.get(order)  # None for the order to stop
        if needed is not None and mode is not needed:
            raise ScenarioError(
                f"{self._site} is in mode {MODE_WORDS[mode]}; "
                f"{order} is possible only in mode {MODE_WORDS[needed]}"
            )

        if needed is not None and not self._is_held():
            raise ScenarioError(
                f"the dead-man switch of {self._site} is not held; {order} the site while the "
                "switch is held"
            )

        change = self._scenario.make_site_order(self._site, order, tick_ns(tick, self._rate_hz))
        return self._scenario.to_core_change(change)

    def _schedule_stop(self, next_tick: int, stop_s: float) -> tuple[str, int]:
        """Schedules the end of the run at a requested time, unless an earlier end is scheduled.

        All arms of a session receive the same time, so that they stop together.

        Args:
            next_tick: Number of the next tick. It is always executed, so the run cannot end
                before it.
            stop_s: Requested end, in s since the epoch (the common start of the session).

        Returns:
            The text of the reply, and the first tick that will not be executed.
        """
        planned_end = self._ticks if self._stop_tick is None else self._stop_tick
        requested_end = first_tick_at(round(stop_s * 1e9), self._rate_hz)
        earliest_end = next_tick + 1
        self._stop_tick = min(max(requested_end, earliest_end), planned_end)

        self._update_stopped(next_tick)
        text = f"{self._site} ends at t = {self._stop_tick / self._rate_hz:.3f} s"
        return text, self._stop_tick

    def _update_stopped(self, next_tick: int) -> None:
        """Sets the flag `stopped` if a user has asked the run to end after the next tick."""
        if self._stop_tick is not None:
            self.stopped = next_tick + 1 >= self._stop_tick

    def _make_change(self, request: ChangeRequest, first: int) -> CoreChange:
        """Converts a user's request to a change of a network link or of dominance factors.

        Args:
            request: The request.
            first: First tick in which the change is in effect.

        Raises:
            ScenarioError: The change is invalid or comes too late, or there have been too many
                changes.
        """
        from_ns = tick_ns(first, self._rate_hz)
        self._links.advance_to(from_ns)  # applies the changes of the scenario's own timeline
        if first >= self._ticks:
            raise ScenarioError(
                f"the run ends at tick {self._ticks}, before the change could take effect"
            )
        if self._accepted_counts[request.link] >= MAX_CHANGES:
            raise ScenarioError(f"a run can have at most {MAX_CHANGES} changes of each link")

        # The kernel stores a limited number of weight changes that have not begun yet.
        pending_ns = self._pending_ramps_ns
        present_ns = from_ns - AHEAD_MS * 1_000_000
        while pending_ns and pending_ns[0] <= present_ns:
            pending_ns.popleft()
        if request.dominance and len(pending_ns) >= MAX_RAMPS:
            raise ScenarioError(
                f"at most {MAX_RAMPS} changes of shares can be pending at once; "
                f"try again in {AHEAD_MS} ms"
            )

        # The settings of a change in a scenario's timeline. Absent ones are left out.
        settings = {}
        for key in ("link", "dominance", "ramp_s"):
            value = getattr(request, key)
            if value:
                settings[key] = value
        if request.dominance and request.ramp_s >= 0.0:
            settings["ramp_s"] = max(request.ramp_s, MIN_RAMP_S)
        change = resolve_change(
            self._scenario, self._links, {**settings, "to": request.to}, from_ns
        )

        responsible_site = change.owner
        if responsible_site != self._site:
            raise ScenarioError(
                f"{self._site} cannot make this change; send the change to {responsible_site}"
            )

        if change.link:
            self._accepted_counts[change.link] += 1
            self._links[change.link] = change.to
        else:
            pending_ns.append(from_ns)
        return self._scenario.to_core_change(change)
