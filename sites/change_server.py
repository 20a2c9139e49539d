"""Answers change requests to a running site.

Invariant: every request gets a reply: refused with a reason, or accepted by the very next tick, whose record
names it. An accepted change holds for samples and ticks from AHEAD_MS later on, so it alters no decision
already made.
"""

from collections.abc import Sequence

from trilat_net.core.site_step import MAX_CHANGES
from trilat_net.core.ticks import CoreChange, first_tick_at, tick_ns
from trilat_net.errors import ScenarioError, WireError
from trilat_net.net.bus import Query, QueryInbox
from trilat_net.net.requests import ChangeReply, ChangeRequest
from trilat_net.net.wire import decode, encode
from trilat_net.scenario import (
    Scenario,
    find_owner,
    initial_link_tables,
    resolve_change,
    scheduled_link_tables,
    to_core_change,
)

AHEAD_MS = 100


class ChangeServer:
    """A site's ear for changes.

    Args:
        scenario: the experiment.
        site: the site's name.
        questions: the ring of what it is asked.
    """

    def __init__(self, scenario: Scenario, site: str, questions: QueryInbox) -> None:
        self._scenario, self._site, self._questions = scenario, site, questions
        self._rate_hz = scenario.sites[site].rate_hz
        self._ticks = scenario.ticks(site)
        self._links = initial_link_tables(scenario)
        self._planned = scheduled_link_tables(scenario)
        self._taken = 0

    def take(self, k: int) -> Sequence[CoreChange]:
        """Returns what has been asked for and is accepted, for tick k; answers every question.

        Args:
            k: the tick that is about to be stepped.
        """
        question = self._questions.poll()
        if question is None:
            return ()
        commands = []
        while question is not None:
            commands += self._consider(k, question)
            question = self._questions.poll()
        return commands

    def _consider(self, k: int, question: Query) -> list[CoreChange]:
        first = first_tick_at(tick_ns(k, self._rate_hz) + AHEAD_MS * 1_000_000, self._rate_hz)
        try:
            taken = self._command(decode(question.payload, ChangeRequest), first)
        except (WireError, ScenarioError) as error:
            question.answer(encode(ChangeReply(member=self._site, accepted=False, text=str(error))))
            return []
        text = f"{self._site} takes it in at tick {k}; it holds from tick {first} on"
        question.answer(encode(ChangeReply(member=self._site, accepted=True, text=text, tick=first)))
        return [taken]

    def _command(self, order: ChangeRequest, first: int) -> CoreChange:
        from_ns = tick_ns(first, self._rate_hz)
        for planned_ns, name, table in list(self._planned):
            if planned_ns <= from_ns:  # what the scenario has changed by then is the present
                self._links[name] = table
                self._planned.remove((planned_ns, name, table))
        if first >= self._ticks:
            raise ScenarioError(f"the run ends at tick {self._ticks}, before it could hold")
        if self._taken >= MAX_CHANGES:
            raise ScenarioError(f"a run takes at most {MAX_CHANGES} changes")
        written = {key: value for key in ("link", "dominance", "ramp_s") if (value := getattr(order, key))}
        change = resolve_change(self._scenario, self._links, {**written, "to": order.to}, from_ns)
        if find_owner(change) != self._site:
            raise ScenarioError(f"{self._site} cannot do that; ask {find_owner(change)}")
        self._taken += 1
        if change.link:
            self._links[change.link] = change.to
        return to_core_change(self._scenario, change)
