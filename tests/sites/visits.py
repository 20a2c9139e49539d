"""A visitor of a party: a ping of a session that is on its way or runs, on the party's clock."""

from sites.session_ping import PingReport, SessionPing
from tests.net.parties import SESSION, Party
from trilat_net.net import topics
from trilat_net.net.clock import SkewedClock
from trilat_net.net.messages import VERSION, LinkStats
from trilat_net.net.wire import encode

S = 1_000_000_000


class Visit:
    """A probe of a party, on the party's clock."""

    def __init__(self, party: Party, count: int = 10) -> None:
        self._party = party
        self.begun_ns = party.clock.monotonic_ns()
        self.probe = SessionPing(party.network.join(), party.clock, SESSION, count)

    def look(self, timeout_ns: int = S) -> SessionPing:
        """Looks until it is over, while the members do what they do."""
        for n in range(2_000_000_000):
            if self.probe.over(timeout_ns, self.begun_ns):
                break
            self.probe.poll()
            if n % 10 == 0:
                for member in self._party.members.values():
                    member.poll()
            self._party.clock.sleep_until(self._party.clock.monotonic_ns() + 2_000_000)
        return self.probe


def link_stats() -> LinkStats:
    """Statistics of the site m, which hears s."""
    counts = {name: {} for name in ("age_us", "accepted", "late", "duplicate", "refused", "dropped")}
    zeros = dict.fromkeys(("overruns", "late_max_us", "busy_max_us"), 0)
    own = {"v": VERSION, "site": "m", "boot": 1, "tick": 5, "t_ns": 5, "mode": "run"}
    return LinkStats(**own, **counts, **zeros, delay_us={"s": 120})


def ping_sites() -> PingReport:
    """Returns what `trilat ping` finds of two sites, one of them on another clock."""
    party = Party(("m", "s"))
    party.start("m")
    party.start("s", on_clock=SkewedClock(party.clock, 3 * S, 50_000))
    visit = Visit(party)
    party.say("m", encode(link_stats()), topics.LINK)
    return visit.look().report()
