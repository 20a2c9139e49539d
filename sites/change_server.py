"""Replies to change requests while the site runs.

Invariant:
    - Every request gets a reply: it is refused with a reason, or accepted by the very next
      tick, whose record names the change.
    - An accepted change holds for samples and ticks from `AHEAD_MS` later on, so it alters no
      decision that has been made.
    - In one tick a stop outweighs all other orders. `enable` and `reset` therefore wait for a
      tick without earlier orders, and so do all requests behind them.
    - A change of dominance takes at least `MIN_RAMP_S`, whatever the request says, so that no
      reference jumps. The record has the ramp that holds.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress

import msgspec
from msgspec import UNSET

from trilat_net.core.site_arrays import MAX_CHANGES, MAX_RAMPS
from trilat_net.core.ticks import CoreChange, Mode, first_tick_at, tick_ns
from trilat_net.errors import ScenarioError, WireError
from trilat_net.net.bus import Query, QueryInbox
from trilat_net.net.messages import MODE_WORDS
from trilat_net.net.requests import ChangeReply, ChangeRequest
from trilat_net.net.wire import decode, encode
from trilat_net.scenario import Scenario, find_owner
from trilat_net.scenario.run_changes import (
    LinkTables,
    make_site_order,
    resolve_change,
    to_core_change,
)
from trilat_net.scenario.scenario_types import SiteOrder

AHEAD_MS = 100
MIN_RAMP_S = 0.5
"""Shortest change of dominance."""
MARKS_WAITING = 16
"""Largest number of marks between two events of a site, which are 100 ms apart."""


_NEEDED_MODES = {"reset": Mode.FAULT, "enable": Mode.STOPPED}
"""The only mode in which an order has an effect."""


class ChangeServer:
    """The change requests to one site.

    Args:
        scenario: the scenario of the session.
        site: the name of the site.
        queries: requests from the operator.
        mode: returns the mode of the site after the last tick.
        held: returns True if the dead-man switch is held, or if there is none. Without it, the
            site refuses `enable` and `reset`.
        stops: requests from members that may only stop the site.

    Attributes:
        stopped: True once the site has executed the last tick before a requested end.
        marks: the marked moments that no event names yet: ticks and texts.
        sources: who requested an accepted change, by the change's text in the record, until an
            event names the source.
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
        self._deferred: Query | None = None
        self._accepted_counts: Counter[str] = Counter()
        self._pending_ramps_ns: deque[int] = deque()
        self._stop_tick: int | None = None
        self.stopped = False
        self.marks: list[tuple[int, str]] = []
        self.sources: dict[str, str] = {}

    def pop_changes(self, k: int) -> Sequence[CoreChange]:
        """Replies to all requests, and returns the accepted changes for the next tick, `k`."""
        if self._stop_tick is not None:
            self.stopped = k + 1 >= self._stop_tick
        changes: list[CoreChange] = []
        has_order = False
        while (query := self._poll()) is not None:
            try:
                request = decode(query.payload, ChangeRequest)
                if has_order and request.order in _NEEDED_MODES:
                    self._deferred = query
                    break
                text, tick, change = self._accept(request, k)
                if change is not None:
                    changes.append(change)
                    has_order = has_order or bool(request.order)
                if isinstance(request.source, str) and changes:
                    self.sources[changes[-1].text] = request.source
                reply = ChangeReply(member=self._site, accepted=True, text=text, tick=tick)
            except (WireError, ScenarioError) as error:
                reply = ChangeReply(member=self._site, accepted=False, text=str(error))
            query.reply(encode(reply))
        return changes

    def _accept(self, request: ChangeRequest, k: int) -> tuple[str, int, CoreChange | None]:
        """Returns the reply's text, the tick from which the request holds, and its change.

        Raises:
            ScenarioError: the site refuses the request.
        """
        if request.stop_s is not None:
            text, tick = self._schedule_stop(k, request.stop_s)
            return text, tick, None
        if request.mark:
            return self._add_mark(k, request.mark), k, None
        if request.order:
            change = self._make_order_change(k, request.order)
            return f"{self._site}: {request.order} at tick {k}", k, change
        start_ns = tick_ns(k, self._rate_hz) + AHEAD_MS * 1_000_000
        first = first_tick_at(start_ns, self._rate_hz)
        change = self._make_change(request, first)
        text = f"{self._site} takes it in at tick {k}; it holds from tick {first} on"
        return text, first, change

    def _poll(self) -> Query | None:
        """Returns the next request: a stop, else a deferred one, else the operator's next."""
        query = self._poll_stop()
        if query is None:
            query = self._deferred or self._queries.poll()
            self._deferred = None
        return query

    def _poll_stop(self) -> Query | None:
        """Returns the next request of a member that may only stop the site.

        Any other request of such a member is refused here.
        """
        while self._stops is not None and (query := self._stops.poll()) is not None:
            with suppress(WireError):
                request = decode(query.payload, ChangeRequest)
                if msgspec.structs.replace(request, source=UNSET) == ChangeRequest(
                    order="stop"
                ):
                    return query
            text = f"{self._site} can be asked to stop under this key, and nothing else"
            query.reply(encode(ChangeReply(member=self._site, accepted=False, text=text)))
        return None

    def _add_mark(self, k: int, text: str) -> str:
        if len(self.marks) >= MARKS_WAITING:
            raise ScenarioError(
                f"at most {MARKS_WAITING} marks wait to be published; mark again in 100 ms"
            )
        self.marks.append((k, text))
        return f"{self._site} marks tick {k}"

    def _make_order_change(self, k: int, order: SiteOrder) -> CoreChange:
        mode = self._read_mode()
        needed = _NEEDED_MODES.get(order)
        if needed is not None and mode is not needed:
            raise ScenarioError(
                f"{self._site} is in {MODE_WORDS[mode]}; "
                f"{order} is for a site in {MODE_WORDS[needed]}"
            )
        if needed is not None and not self._is_held():
            raise ScenarioError(
                f"the dead-man switch of {self._site} is not held; {order} it while it is"
            )
        change = make_site_order(self._scenario, self._site, order, tick_ns(k, self._rate_hz))
        return to_core_change(self._scenario, change)

    def _schedule_stop(self, k: int, stop_s: float) -> tuple[str, int]:
        """Sets the tick before which the site ends, unless an earlier one is set."""
        requested = first_tick_at(round(stop_s * 1e9), self._rate_hz)
        self._stop_tick = min(max(requested, k + 1), self._stop_tick or self._ticks)
        self.stopped = k + 1 >= self._stop_tick
        text = f"{self._site} ends at t = {self._stop_tick / self._rate_hz:.3f} s"
        return text, self._stop_tick

    def _make_change(self, request: ChangeRequest, first: int) -> CoreChange:
        """Returns the requested change of a link or of dominance, valid from tick `first` on.

        Raises:
            ScenarioError: the change is invalid, comes too late, or exceeds a limit.
        """
        from_ns = tick_ns(first, self._rate_hz)
        self._links.advance_to(from_ns)  # applies the changes of the scenario's own timeline
        if first >= self._ticks:
            raise ScenarioError(f"the run ends at tick {self._ticks}, before it could hold")
        if self._accepted_counts[request.link] >= MAX_CHANGES:
            raise ScenarioError(f"a run takes at most {MAX_CHANGES} changes of a link")
        pending_ns = self._pending_ramps_ns
        while pending_ns and pending_ns[0] <= from_ns - AHEAD_MS * 1_000_000:
            pending_ns.popleft()
        if request.dominance and len(pending_ns) >= MAX_RAMPS:
            raise ScenarioError(
                f"at most {MAX_RAMPS} changes of shares wait to begin; "
                f"ask again in {AHEAD_MS} ms"
            )
        settings = {
            key: value
            for key in ("link", "dominance", "ramp_s")
            if (value := getattr(request, key))
        }
        if request.dominance and request.ramp_s >= 0.0:
            settings["ramp_s"] = max(request.ramp_s, MIN_RAMP_S)
        change = resolve_change(
            self._scenario, self._links, {**settings, "to": request.to}, from_ns
        )
        if find_owner(change) != self._site:
            raise ScenarioError(f"{self._site} cannot do that; ask {find_owner(change)}")
        if change.link:
            self._accepted_counts[change.link] += 1
            self._links[change.link] = change.to
        else:
            pending_ns.append(from_ns)
        return to_core_change(self._scenario, change)
