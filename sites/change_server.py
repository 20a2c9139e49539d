"""Answers change requests to a running site.

Invariant: every request gets a reply: refused with a reason, or accepted by the very next tick,
whose record names it. An accepted change holds for samples and ticks from AHEAD_MS later on, so
it alters no decision already made. In one tick a stop outweighs all other orders, so `enable`
and `reset` wait for a tick in which nothing was ordered before them, and what came after them
waits too. Dominance is ramped over `MIN_RAMP_S` at least, whatever is asked for, so that no
reference jumps; the record has the ramp that holds.
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
"""Marks between two events of a site, which are a tenth of a second apart."""


_NEEDED_MODES = {"reset": Mode.FAULT, "enable": Mode.STOPPED}
"""Orders that have no effect in other modes."""


class ChangeServer:
    """The change requests to one site, whose mode after the last tick `mode` returns.

    Who may ask for nothing else asks it to stop by `stops`. While its dead-man switch is not
    `held` it takes up no work again and ends no fault.

    Attributes:
        stopped: True once the site has made the last tick that it was asked for.
        marks: moments that somebody marked and that no event names yet: ticks, and texts.
        sources: who asked for an accepted change, by its text in the record, until an event
            says it.
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
        self._mode = mode
        self._held = held
        self._rate_hz = scenario.sites[site].rate_hz
        self._ticks = scenario.ticks(site)
        self._links = LinkTables(scenario.links, scenario.timeline)
        self._held_up: Query | None = None
        self._accepted: Counter[str] = Counter()
        self._waiting: deque[int] = deque()
        self._stop_tick: int | None = None
        self.stopped = False
        self.marks: list[tuple[int, str]] = []
        self.sources: dict[str, str] = {}

    def take(self, k: int) -> Sequence[CoreChange]:
        """Replies to every request; returns the accepted changes, for the next tick, k."""
        if self._stop_tick is not None:
            self.stopped = k + 1 >= self._stop_tick
        changes: list[CoreChange] = []
        ordered = False
        while (query := self._poll()) is not None:
            try:
                request = decode(query.payload, ChangeRequest)
                first = first_tick_at(
                    tick_ns(k, self._rate_hz) + AHEAD_MS * 1_000_000, self._rate_hz
                )
                if ordered and request.order in _NEEDED_MODES:
                    self._held_up = query
                    break
                if request.stop_s is not None:
                    text, tick = self._stop(k, request.stop_s)
                elif request.mark:
                    text = self._mark(k, request.mark)
                    tick = k
                elif request.order:
                    changes.append(self._order(k, request.order))
                    ordered = True
                    text = f"{self._site}: {request.order} at tick {k}"
                    tick = k
                else:
                    changes.append(self._resolve(request, first))
                    text = (
                        f"{self._site} takes it in at tick {k}; it holds from tick {first} on"
                    )
                    tick = first
                if isinstance(request.source, str) and changes:
                    self.sources[changes[-1].text] = request.source
                reply = ChangeReply(member=self._site, accepted=True, text=text, tick=tick)
            except (WireError, ScenarioError) as error:
                reply = ChangeReply(member=self._site, accepted=False, text=str(error))
            query.reply(encode(reply))
        return changes

    def _poll(self) -> Query | None:
        if (query := self._poll_stop()) is None:
            query = self._held_up or self._queries.poll()
            self._held_up = None
        return query

    def _poll_stop(self) -> Query | None:
        """Returns the next question of somebody who may ask the site to stop, and nothing else."""
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

    def _mark(self, k: int, text: str) -> str:
        if len(self.marks) >= MARKS_WAITING:
            raise ScenarioError(
                f"at most {MARKS_WAITING} marks wait to be published; mark again in 100 ms"
            )
        self.marks.append((k, text))
        return f"{self._site} marks tick {k}"

    def _order(self, k: int, order: SiteOrder) -> CoreChange:
        mode = self._mode()
        needed = _NEEDED_MODES.get(order)
        if needed is not None and mode is not needed:
            doing = MODE_WORDS[mode]
            only = MODE_WORDS[needed]
            raise ScenarioError(f"{self._site} is in {doing}; {order} is for a site in {only}")
        if needed is not None and not self._held():
            raise ScenarioError(
                f"the dead-man switch of {self._site} is not held; {order} it while it is"
            )
        change = make_site_order(self._scenario, self._site, order, tick_ns(k, self._rate_hz))
        return to_core_change(self._scenario, change)

    def _stop(self, k: int, stop_s: float) -> tuple[str, int]:
        asked = first_tick_at(round(stop_s * 1e9), self._rate_hz)
        self._stop_tick = min(max(asked, k + 1), self._stop_tick or self._ticks)
        self.stopped = k + 1 >= self._stop_tick
        return (
            f"{self._site} ends at t = {self._stop_tick / self._rate_hz:.3f} s",
            self._stop_tick,
        )

    def _resolve(self, request: ChangeRequest, first: int) -> CoreChange:
        from_ns = tick_ns(first, self._rate_hz)
        self._links.advance_to(from_ns)  # the scenario has changed them by then
        if first >= self._ticks:
            raise ScenarioError(f"the run ends at tick {self._ticks}, before it could hold")
        if self._accepted[request.link] >= MAX_CHANGES:
            raise ScenarioError(f"a run takes at most {MAX_CHANGES} changes of a link")
        while self._waiting and self._waiting[0] <= from_ns - AHEAD_MS * 1_000_000:
            self._waiting.popleft()
        if request.dominance and len(self._waiting) >= MAX_RAMPS:
            raise ScenarioError(
                f"at most {MAX_RAMPS} changes of shares wait to begin; ask again in {AHEAD_MS} ms"
            )
        written = {
            key: value
            for key in ("link", "dominance", "ramp_s")
            if (value := getattr(request, key))
        }
        if request.dominance and request.ramp_s >= 0.0:
            written["ramp_s"] = max(request.ramp_s, MIN_RAMP_S)
        change = resolve_change(
            self._scenario, self._links, {**written, "to": request.to}, from_ns
        )
        if find_owner(change) != self._site:
            raise ScenarioError(f"{self._site} cannot do that; ask {find_owner(change)}")
        if change.link:
            self._accepted[change.link] += 1
            self._links[change.link] = change.to
        else:
            self._waiting.append(from_ns)
        return to_core_change(self._scenario, change)
