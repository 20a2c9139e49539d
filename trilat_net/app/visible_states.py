"""Selects the records of a running session that the user of one site sees.

The user of a site sees the other arms with a delay: in the sample that the site uses, or in a
picture with a delay of its own (`[sites.NAME.view]`).
"""

from collections import deque

from trilat_net.scenario import parse_embedded

from ..net import Bus, Clock, SessionMembers, State
from ..scenario import PictureDelay
from .session_search import SessionSearch

STATES_KEPT = 4096
"""Number of records of each site that are kept.

The record of a peer's sample in use is found among them by its tick.
"""


class VisibleStates:
    """Newest record of each site, or the records that the user of one site sees.

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of this process.
        session: Name of the session.
        as_site: Name of the site whose user's view is returned. If empty, the newest records
            are returned.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, as_site: str) -> None:
        self._search = SessionSearch(bus, clock, session)
        self._session = session
        self._as_site = as_site
        members = SessionMembers(bus, clock, session)
        self._read_records = members.subscribe(State, capacity=STATES_KEPT)
        self._records: dict[str, deque[State]] = {}
        self._picture_delay: PictureDelay | None = None  # created when the first record arrives

    def read(self) -> dict[str, State]:
        """Returns the latest visible record of each site, keyed by site name.

        The user of a site may see older records than the latest ones. The dictionary is empty
        until the first record has arrived.
        """
        as_site = self._as_site
        for record in self._read_records():
            if record.site not in self._records:
                self._records[record.site] = deque(maxlen=STATES_KEPT)
            self._records[record.site].append(record)
        newest_records = {site: records[-1] for site, records in self._records.items()}
        if not as_site:
            return newest_records
        if as_site not in newest_records:
            return {}

        if self._picture_delay is None:
            # The site runs, because a record of it has arrived, and sends its scenario.
            info = self._search.find_running(as_site)
            scenario = parse_embedded(info.scenario, self._session)
            self._picture_delay = PictureDelay(scenario, as_site)

        user_record = newest_records[as_site]
        visible_records = {as_site: user_record}
        # The field `used` states which sample of each peer the control law used.
        visible_ticks = self._picture_delay.advance_to(user_record.tick, user_record.used)
        for peer, visible_tick in visible_ticks.items():
            for record in reversed(self._records.get(peer, deque())):
                if record.tick == visible_tick:
                    visible_records[peer] = record
                    break
        return visible_records
