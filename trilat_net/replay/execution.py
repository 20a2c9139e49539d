"""One site, executed from its records.

Law (L3): two records in a row, and what waits in the links, suffice to resume; what cannot be known is
counted, and is never a difference.
"""

from collections.abc import Callable, Mapping, Sequence

from ..core.site import MAX_COMMANDS, Site
from ..core.tick import MAX_ARRIVALS, Arrival, Command, Output, Tick
from ..errors import LawFailed, ScenarioError
from ..log.reader import SiteLog
from ..net.messages import State
from ..scenario import Scenario, command_from
from .difference import Difference, close, first_difference, identical, law_failed, same_bits
from .resumption import Resumption, measured, recorded_output
from .verdict import Verdict

TOLD_EVERY = 256
"""Records after which one is told how many are done."""


class Execution:
    """One site, executed from its records.

    While it is `assured`, the site's state follows from the records before. It is lost at a gap, and when a
    sample comes into use that the log lacks; two records in a row bring it back. What arrived inside a gap
    is not known: samples that no record lists are taken to have come in it (`assumed`), and as long as one
    of them is in use a difference counts as unjudged. So it does when the sample in use is one that
    arrived but whose own record is missing (`lacking`).
    """

    def __init__(
        self,
        scenario: Scenario,
        site_log: SiteLog,
        changes: Mapping[int, Sequence[str]],
        by_tick: Mapping[str, Mapping[int, State]],
        ends: Mapping[str, int],
        verdict: Verdict,
    ) -> None:
        self._site = Site(scenario.setup(site_log.name))
        self._scenario, self._log = scenario, site_log
        self._external = site_log.name in scenario.external
        self._law_failed = False
        self._changes = sorted(changes.items())
        self._peers = site_log.peers
        self._by_tick = [by_tick[peer] for peer in site_log.peers]
        self._ends = [ends[peer] for peer in site_log.peers]
        self._own_end = ends[site_log.name]
        self._verdict = verdict
        self._same = same_bits if verdict.whole_run else close
        self._assured = True
        self._resumption = Resumption(site_log, self._by_tick, self._ends)

    def run(self, told: Callable[[int], None] | None = None) -> None:
        """Executes every record.

        Args:
            told: told now and then how many are done.
        """
        verdict, states = self._verdict, self._log.states
        expected = 0
        for n, state in enumerate(states):
            if told is not None and n % TOLD_EVERY == 0:
                told(n)
            verdict.records += 1
            if state.tick == expected - 1:
                verdict.differ(Difference(state.site, state.tick, "tick", state.tick, expected))
                continue
            if state.tick != expected:
                verdict.gaps.append((self._log.name, expected, state.tick - 1))
                self._assured = False
            expected = state.tick + 1
            try:
                if self._law_failed or (not self._assured and not self._resume(n)):
                    verdict.unjudged += 1
                    continue
                self._judge(n, state)
            except LawFailed as failed:
                self._law_failed = True
                verdict.differ(law_failed(failed)._replace(tick=state.tick))
        if expected <= self._own_end:
            verdict.gaps.append((self._log.name, expected, self._own_end))

    def _judge(self, n: int, state: State) -> None:
        """Steps one tick and compares."""
        verdict = self._verdict
        states = self._log.states
        if not verdict.whole_run and n >= 2 and states[n - 2].tick == state.tick - 2:
            before, last = (recorded_output(states[m], self._peers) for m in (n - 2, n - 1))
            self._site.resume(before, last)
        arrivals, missing = self._arrivals(state)
        commands, strange = self._commands(state.tick)
        tick = Tick(state.tick, arrivals, commands, measured(state) if self._external else None)
        if missing is not None and missing.field != "":
            strange = strange or missing
        if strange is not None:
            verdict.differ(strange)
            self._site.step(tick)
            return
        output = self._site.step(tick)
        if missing is not None:  # the log lacks a sample that came in: its CRC cannot be checked
            output = output._replace(rx_crc=state.rx_crc)
        if state.boot != states[0].boot:
            verdict.differ(Difference(self._log.name, state.tick, "boot", state.boot, states[0].boot))
        elif state.site != self._log.name:
            verdict.differ(Difference(self._log.name, state.tick, "site", state.site, self._log.name))
        elif identical(state, output, self._peers):
            verdict.identical += 1
        elif difference := first_difference(state, output, self._peers, self._same):
            self._book(state, output, difference)
        else:
            verdict.identical += 1

    def _commands(self, tick: int) -> tuple[list[Command], Difference | None]:
        """Returns the changes up to a tick that have not been ordered yet; one that is none differs."""
        commands: list[Command] = []
        while self._changes and self._changes[0][0] <= tick:
            named, texts = self._changes.pop(0)
            for text in texts:
                try:
                    commands.append(command_from(self._scenario, self._log.name, text))
                except ScenarioError:
                    valid = "a change of one of its links or of its shares"
                    return commands, Difference(self._log.name, named, "cmd", text, valid)
        return commands[:MAX_COMMANDS], None

    def _book(self, state: State, output: Output, difference: Difference) -> None:
        if self._resumption.in_doubt(state, output):
            self._verdict.unjudged += 1
            self._assured = False
        else:
            self._verdict.differ(difference)

    def _arrivals(self, state: State) -> tuple[list[Arrival], Difference | None]:
        """Returns what a record says came in, with the samples of its peers' records.

        A sample that no record of the log can be is a difference; one whose record is merely missing is
        told by a difference without a field.
        """
        arrivals: list[Arrival] = []
        lacking = None
        for peer, tick, latency_us in state.rx:
            if not 0 <= peer < len(self._peers):
                return arrivals, Difference(state.site, state.tick, "rx (peer)", peer, "an index of a peer")
            sample = self._by_tick[peer].get(tick)
            if sample is not None:
                arrivals.append(Arrival(peer, tick, sample.q, sample.qd, latency_us, sample.tau_x))
            elif 0 <= tick <= self._ends[peer]:
                self._resumption.lacking[peer].add(tick)
                lacking = Difference(state.site, state.tick, "", tick, None)
            else:
                valid = f"a tick from 0 to {self._ends[peer]}"
                return arrivals, Difference(state.site, state.tick, f"rx[{self._peers[peer]}]", tick, valid)
        return arrivals[:MAX_ARRIVALS], lacking

    def _resume(self, n: int) -> bool:
        """Brings the site to where record n finds it, if the two records before it stand in a row."""
        if not self._resumption.possible(n):
            return False
        for command in self._commands(self._log.states[n].tick - 1)[0]:  # given in the gap
            self._site.order(command)
        self._resumption.place(self._site, n)
        self._assured = True
        return True
