"""Changes that somebody asks a running site for.

Law: a change is answered, and either refused with a reason or taken in by the very next tick, whose
record names it; it holds for samples and ticks from `AHEAD_MS` later on, so that none of them has been
decided before.
"""

from collections.abc import Sequence

from trilat_net.core.grid import first_tick_at, tick_ns
from trilat_net.core.site import MAX_COMMANDS
from trilat_net.core.tick import Command
from trilat_net.errors import ScenarioError, WireError
from trilat_net.net.answers import Order, Reply
from trilat_net.net.bus import Question, Questions
from trilat_net.net.wire import decode, encode
from trilat_net.scenario import Scenario, command, later_tables, owner, present_links, resolve_change

AHEAD_MS = 100


class Changes:
    """A site's ear for changes.

    Args:
        scenario: the experiment.
        site: the site's name.
        questions: the ring of what it is asked.
    """

    def __init__(self, scenario: Scenario, site: str, questions: Questions) -> None:
        self._scenario, self._site, self._questions = scenario, site, questions
        self._rate_hz = scenario.sites[site].rate_hz
        self._ticks = scenario.ticks(site)
        self._links = present_links(scenario)
        self._planned = later_tables(scenario)
        self._taken = 0

    def take(self, k: int) -> Sequence[Command]:
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

    def _consider(self, k: int, question: Question) -> list[Command]:
        first = first_tick_at(tick_ns(k, self._rate_hz) + AHEAD_MS * 1_000_000, self._rate_hz)
        try:
            taken = self._command(decode(question.payload, Order), first)
        except (WireError, ScenarioError) as error:
            question.answer(encode(Reply(member=self._site, accepted=False, text=str(error))))
            return []
        text = f"{self._site} takes it in at tick {k}; it holds from tick {first} on"
        question.answer(encode(Reply(member=self._site, accepted=True, text=text, tick=first)))
        return [taken]

    def _command(self, order: Order, first: int) -> Command:
        from_ns = tick_ns(first, self._rate_hz)
        for planned_ns, name, table in list(self._planned):
            if planned_ns <= from_ns:  # what the scenario has changed by then is the present
                self._links[name] = table
                self._planned.remove((planned_ns, name, table))
        if first >= self._ticks:
            raise ScenarioError(f"the run ends at tick {self._ticks}, before it could hold")
        if self._taken >= MAX_COMMANDS:
            raise ScenarioError(f"a run takes at most {MAX_COMMANDS} changes")
        written = {key: value for key in ("link", "dominance", "ramp_s") if (value := getattr(order, key))}
        change = resolve_change(self._scenario, self._links, {**written, "to": order.to}, from_ns)
        if owner(change) != self._site:
            raise ScenarioError(f"{self._site} cannot do that; ask {owner(change)}")
        self._taken += 1
        if change.link:
            self._links[change.link] = change.to
        return command(self._scenario, change)
