"""A view of a session reports silent sites, and the end of the session."""

from trilat_people.live_page.session_view import SessionView, SiteView

from recorder.site_reception import AWAY_NS
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from trilat_net.analysis.certificate.running_energy import RunningEnergy
from trilat_net.core.step.ticks import NS_PER_S
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.messages import Event
from trilat_net.net.wire import encode
from trilat_net.scenario import load_scenario

BOOT = 7


class WatchedSession:
    """A session of two running sites, from each of which a message has just arrived."""

    def __init__(self) -> None:
        self.clock = ManualClock(1)
        self._network = LocalNetwork()
        scenario = load_scenario("two_sites")
        self.view = SessionView(self._network.join(), self.clock, "t")
        self.view.scenario = scenario
        energy = RunningEnergy(scenario)
        for name in scenario.names:
            self.view.sites[name] = SiteView(self.view.bus, "t", scenario, name, BOOT, energy)
            self.publish_event(name, "setup", n=0)

    def publish_event(self, name: str, kind: str, *, n: int) -> None:
        """Publishes an event of a site, which arrives at once."""
        event = Event(member=name, boot=BOOT, kind=kind, text=f"{name}: {kind}", n=n)
        self._network.join().publisher(f"trilat/t/{name}/event")(encode(event))
        self.view.poll()

    def join(self) -> Bus:
        """Returns a network connection of another member."""
        return self._network.join()

    def wait(self, seconds: float) -> None:
        """Advances the clock. No message arrives in this time."""
        self.clock.sleep_until(self.clock.monotonic_ns() + int(seconds * NS_PER_S))


def test_silence_is_no_end() -> None:
    session = WatchedSession()
    session.wait(600.0)
    assert not session.view.ended
    assert session.view.session_silence_s == 600.0
    session.publish_event("s", "hand", n=1)  # on a busy machine messages come again
    assert session.view.session_silence_s == 0.0
    assert session.view.silence_s(session.view.sites["m"]) == 600.0


def test_the_last_end_message_ends_a_session() -> None:
    session = WatchedSession()
    session.publish_event("m", "end", n=1)
    assert session.view.sites["m"].ended
    assert not session.view.ended
    session.publish_event("s", "end", n=1)
    assert session.view.ended
    session.wait(60.0)
    assert [session.view.silence_s(site) for site in session.view.sites.values()] == [0.0, 0.0]


def test_members_running_sites_may_report_the_end() -> None:
    """Sites that were killed send no end message."""
    session = WatchedSession()
    session.wait(60.0)
    session.view.finish()
    assert session.view.ended
    assert session.view.session_silence_s == 60.0


def test_sessions_end_when_all_sites_have_left() -> None:
    """The network reports that a killed site has left. The token of a recorder does not count."""
    session = WatchedSession()
    site = session.join()
    recorder = session.join()
    site.announce(topics.presence_token("t", "s", BOOT))
    recorder.announce(topics.presence_token("t", topics.RECORDER, BOOT))
    session.wait(2.0 * AWAY_NS / NS_PER_S)
    session.view.poll()
    site.close()
    session.view.poll()
    assert not session.view.ended
    session.wait(1.01 * AWAY_NS / NS_PER_S)
    assert session.view.has_left
    assert session.view.ended


def test_sites_that_come_back_have_not_left() -> None:
    session = WatchedSession()
    for _ in range(2):
        site = session.join()
        site.announce(topics.presence_token("t", "s", BOOT))
        session.view.poll()
        site.close()
        session.wait(0.6 * AWAY_NS / NS_PER_S)
        session.view.poll()
    assert not session.view.ended
