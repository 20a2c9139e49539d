"""Starts a session: its processes find each other and agree on a common start time.

The members of the session are sites, each of which runs one arm and its control loop, and
recorders. The first site of the scenario is the leader. A normal start has three steps, each
announced by an event that a member publishes:

1. `epoch`: Once all members are known, the leader proposes an epoch about half a second ahead.
   The epoch is the time of tick 0 of all control loops. The event also lists the members.
2. `ready`: Each member agrees.
3. `start`: If all members have agreed in time, the leader confirms the epoch. Otherwise it
   proposes another one.

A member may also join a session that is already running. A recorder simply reads the epoch from
the running sites. A site first asks for permission by publishing the event `coming`, which
states its first tick. It joins if every running site replies with the event `admit` before that
tick. If an earlier process of the same site exists, the running sites wait until it has
disappeared.

The epoch is a time on the leader's monotonic clock, which members on other machines convert to
their own clocks. They measure the offset between the clocks with pings, to within half a round
trip, and are ready only when they know all the clocks they need.

Invariant:
    - The members agree on a single epoch, whatever the order in which they were started.
    - No member starts without the event `start`, and no member joins late without a running
      site.
    - No decision depends on the time of day, which may differ between machines.
    - No method waits. The caller polls `SessionJoin` until the epoch is known.
"""

from collections.abc import Mapping, Sequence

from ..errors import SessionError
from ..records import NS_PER_S
from . import topics
from .bus import Bus
from .clock import Clock
from .membership import Epoch, EventPublisher, LateSites, Membership
from .messages import Event, Info
from .pinging import Pinger, answer_pings
from .wire import read_messages

EPOCH_AHEAD_NS = 500_000_000
"""Time from the proposal of an epoch to the epoch, in ns. Two round trips are added."""
DECIDE_NS = 150_000_000
"""Time before the epoch by which all members must have agreed, in ns. A round trip is added."""
LATE_GATHER_NS = 1_500_000_000
"""Time that a member waits for further sites of a running session to appear, in ns."""


class SessionJoin:
    """Joins a session on behalf of one process, and determines the epoch (the time of tick 0).

    The process must declare its subscriptions before it creates this object, because the object
    announces the process and other members may send messages immediately. The process then
    calls `poll` regularly until it returns the epoch.

    The first site of the scenario is the leader, which decides when the session starts.

    Args:
        bus: Network connection of this member.
        clock: Clock of this member.
        session: Name of the session.
        publisher: Publishes the events of this member.
        sites: Names of the scenario's sites. The first one is the leader. Empty for a recorder.
        late: Rules for sites that join while the session is running.

    Attributes:
        refusal: Reason why a running site has rejected this site. Empty if no site has done so.
        membership: The other members of the session.
        pinger: Measures the offsets of the other members' clocks.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        publisher: EventPublisher,
        sites: Sequence[str],
        late: LateSites = LateSites(),  # noqa: B008
    ) -> None:
        """Announces this process to the members of a session, and starts to look for them."""
        self._clock = clock
        self._session = session
        self._publisher = publisher
        self._sites = tuple(sites)
        self._late = late

        # State of a request to join a running session.
        self.refusal = ""
        # The newest request of this site to join a running session: its event and its epoch.
        self._coming: tuple[Event, Epoch] | None = None
        self._admitted_by: set[str] = set()  # running sites that have granted that request
        self._admitted_boots: dict[str, int] = {}  # boots of other sites that joined since then

        # What this member receives from the others.
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)
        self.membership = Membership(
            bus=bus, clock=clock, session=session, publisher=publisher, sites=sites, late=late
        )
        self.pinger = Pinger(bus, clock, session)
        self._found_running_ns: int | None = None  # when a running session was found
        answer_pings(bus, clock, session, publisher.info)

        # Event `epoch` of the leader that this member has not agreed to yet.
        self._waiting_proposal: Event | None = None
        # Event `epoch` that this member has agreed to or, as the leader, has published. Its
        # epoch on the clock of this member, in ns.
        self._agreed_proposal: Event | None = None
        self._epoch_ns = 0

        # Number of the newest proposal or request of this member.
        self._attempt = 0
        self._ready_epochs: dict[str, int] = {}  # the epoch on each ready member's clock

        bus.announce(topics.presence_token(session, self._info.member, self._info.boot))

    @property
    def reason(self) -> str:
        """Explains why this site could not join a running session, for an error message.

        The explanation is either the message with which a running site has rejected this site,
        or a sentence that names the running sites that have not admitted this site. Empty if
        the reason is not known.
        """
        running = {info.member for info in self.membership.list_running()}
        silent_sites = sorted(running - self._admitted_by)
        if self.refusal:
            return self.refusal
        has_requested = self._coming is not None
        if not has_requested or not silent_sites:
            return ""
        names = ", ".join(silent_sites)
        return f"{names} did not admit {self._info.member} to the running session"

    @property
    def announced_first_tick(self) -> int:
        """First tick that this site announced when it asked to join a running session.

        The site executes its control loop from this tick onwards. 0 if the site has not asked
        to join.
        """
        if self._coming is None:
            return 0
        coming, _ = self._coming
        return coming.ticks

    @property
    def _info(self) -> Info:
        """Identity of this member as seen by others, with its boot, scenario and clock."""
        return self._publisher.info

    def poll(self) -> Epoch | None:
        """Receives and answers messages, and takes the next step towards the start.

        If the session is already running and this member may join late, it joins. A recorder
        may always join late, since it only receives. Otherwise, the leader, which is the first
        site of the scenario, proposes and confirms the epoch, and the other members agree to
        the proposal and wait for the confirmation.

        A member that has agreed to a proposal may see others already running because they
        received the confirmation earlier. It still waits for the confirmation until the
        proposed epoch has passed, and joins late only after that.

        Returns:
            The epoch once it is fixed, and None until then.

        Raises:
            SessionError: This member cannot be part of the session.
        """
        membership = self.membership
        now_ns = self._clock.monotonic_ns()
        self._publisher.answer_queries()
        # The leader knows whether it has confirmed a proposal. The others may miss the event.
        may_have_started = self._agreed_proposal is not None and not membership.is_leader
        membership.poll(may_have_started=may_have_started)
        self.pinger.poll(self._list_other_clocks(membership.boots(), membership.clocks()))

        epoch = self._read_events()
        if epoch is not None:
            return epoch
        self._reply_ready()
        running = membership.list_running()
        is_recorder = not self._sites
        may_join_running = self._late.may_join_late or is_recorder
        if running and may_join_running:
            # Until the proposed epoch has passed, its confirmation may still arrive.
            may_start_normally = self._agreed_proposal is not None and now_ns < self._epoch_ns
            if not may_start_normally:
                epoch = self._join_late(running, now_ns)
        elif membership.is_leader:
            epoch = self._lead()
        if not running:
            # The time that `_join_late` waits for further sites starts again.
            self._found_running_ns = None
        return epoch

    def _join_late(self, running: Sequence[Info], now_ns: int) -> Epoch | None:
        """Takes the next step to join a session that is already running.

        The following steps must be completed in order:

        1. All sites of the session that are present are known, or `LATE_GATHER_NS` have passed.
        2. A site (not a recorder) knows the clocks of all running sites on other machines.
        3. One running site is selected as the source of the epoch (the time of tick 0). Its
           clock is known, so that the epoch can be converted to the local clock.
        4. A site requests admission, and all running sites grant it. A recorder needs no
           admission and may start recording at once.

        Args:
            running: Identities of the running sites.
            now_ns: Present time on the local clock, in ns.

        Returns:
            The epoch of the session once this member may take part, and None until then.
        """
        if self._found_running_ns is None:
            self._found_running_ns = now_ns
        waited_ns = now_ns - self._found_running_ns
        if self._awaits_sites(running) and waited_ns < LATE_GATHER_NS:
            return None
        is_recorder = not self._sites
        local_clock = self._info.clock
        foreign_boots = {info.boot for info in running if info.clock != local_clock}
        if not is_recorder and not self.pinger.knows_clocks(foreign_boots):
            return None
        source = self._select_epoch_source(running)
        if source is None:
            return None

        # The site whose epoch is used may run on another clock. Convert with the present
        # offset. The offset at the epoch is not known, because the clocks have drifted since.
        # The offset is the other clock minus the local clock: local time = other time - offset.
        offset_ns = 0
        if source.clock != local_clock:
            offset_ns = self.pinger.estimate(source.boot).extrapolate_ns(now_ns)
        epoch = Epoch(source.epoch_mono_ns - offset_ns, source.epoch_unix_ns, source.boots)
        if is_recorder:
            return epoch

        # The running sites have adjusted their schedule since the start. `grid_ns` is the time
        # of tick 0 according to the present schedule, which this site follows.
        schedule_start_ns = (source.grid_ns or source.epoch_mono_ns) - offset_ns
        local_epoch = epoch._replace(mono_ns=schedule_start_ns)
        return self._request_admission(local_epoch, running, now_ns)

    def _awaits_sites(self, running: Sequence[Info]) -> bool:
        """Returns True if more sites of the running session are expected to reply.

        The running sites list the members of the session. Members that have disappeared or were
        restarted are not expected to reply.

        Args:
            running: Identities of the running sites that have replied.
        """
        membership = self.membership
        expected_sites = set()
        for name, boot in running[0].boots.items():
            is_gone = str(boot) in membership.gone or membership.has_restarted(name, boot)
            if not is_gone:
                expected_sites.add(name)
        expected_sites -= {topics.RECORDER, self._info.member}
        known_sites = {info.member for info in running}
        return known_sites < expected_sites  # a proper subset

    def _select_epoch_source(self, running: Sequence[Info]) -> Info | None:
        """Selects the running site from which this member takes the epoch.

        A site on this machine is the best choice, because its epoch needs no conversion between
        clocks. The next best is the first site of the scenario, whose schedule the others
        follow.

        Returns:
            The identity of the site, or None if the clock of no running site is known yet.
        """
        local_clock = self._info.clock
        indices = {name: index for index, name in enumerate(self._sites)}

        def rank(info: Info) -> tuple[bool, int]:
            """Returns a sort key: sites on this machine first, then in scenario order.

            A site on this machine has the same clock, so its start time needs no conversion.
            """
            return info.clock != local_clock, indices.get(info.member, -1)

        for info in sorted(running, key=rank):
            if info.clock == local_clock or self.pinger.knows_clocks([info.boot]):
                return info
        return None

    def _request_admission(
        self, epoch: Epoch, running: Sequence[Info], now_ns: int
    ) -> Epoch | None:
        """Requests admission to the running session, and checks if all running sites grant it.

        The request is the event `coming`, with a first tick about half a second ahead. If a
        site has not replied shortly before that tick, the request is repeated with a later
        tick.

        Args:
            epoch: The epoch of the session on the clock of this site.
            running: Identities of the running sites.
            now_ns: Present time on the local clock, in ns.

        Returns:
            The epoch and the first tick once all running sites have admitted this site, and
            None until then.
        """
        info = self._info
        rate_hz = self._late.rate_hz
        slowest_ns = self.pinger.slowest_ns()
        if self._coming is not None:
            coming, requested_epoch = self._coming
            first_tick_ns = requested_epoch.mono_ns + coming.ticks * NS_PER_S // rate_hz
            if now_ns < first_tick_ns - DECIDE_NS:
                running_names = {site.member for site in running}
                if not self._admitted_by >= running_names:
                    return None
                return self._make_late_epoch(coming, requested_epoch, running)

        since_epoch_ns = now_ns - epoch.mono_ns
        first_tick_after_ns = since_epoch_ns + EPOCH_AHEAD_NS + 2 * slowest_ns
        # The division of the negative number rounds up, so that no tick before that time is
        # chosen.
        first = -(-first_tick_after_ns * rate_hz // NS_PER_S)
        self._attempt += 1
        self._admitted_by = set()
        coming = self._publisher.publish(
            "coming",
            f"{info.member} comes to the running session, from tick {first} on",
            t_ns=since_epoch_ns,
            ticks=first,
            attempt=self._attempt,
            epoch_mono_ns=epoch.mono_ns,
            clock=info.clock,
            bound_ns=slowest_ns,
            boots={info.member: info.boot},
        )
        self._coming = coming, epoch
        return None

    def _make_late_epoch(self, coming: Event, epoch: Epoch, running: Sequence[Info]) -> Epoch:
        """Returns the start time and the members of a running session that this site joins.

        Args:
            coming: Request of this site (event `coming`) that all running sites have granted.
                It states the first tick of this site.
            epoch: Start of the session on the clock of this site.
            running: Identities of the running sites.

        Returns:
            The given epoch, extended by the boot of each member (which identifies the start of
            its process), the time of tick 0 on the clocks of the running sites and of this site
            in ns, the first tick of this site, and its request.
        """
        info = self._info
        # Later entries replace earlier ones: the members at the start of the session, those
        # that were admitted while this site waited, and this site.
        boots = {**running[0].boots, **self._admitted_boots, info.member: info.boot}
        epoch_times_ns = {site.member: site.epoch_mono_ns for site in running}
        epoch_times_ns[info.member] = epoch.mono_ns
        first_tick = coming.ticks
        return epoch._replace(
            boots=boots, epochs=epoch_times_ns, first=first_tick, coming=coming
        )

    def _list_other_clocks(
        self, boots: Mapping[str, int], clocks: Mapping[str, str]
    ) -> set[int]:
        """Returns the boots of sites on other machines, whose clock offsets are needed.

        Args:
            boots: Mapping from the name of each member to the number that identifies the start
                of its process.
            clocks: Mapping from the name of each member to the identity of its clock.
        """
        return {
            boot
            for name, boot in boots.items()
            if name != topics.RECORDER and clocks.get(name) != self._info.clock
        }

    def _read_events(self) -> Epoch | None:
        """Receives the events of all members, and acts on those about the start.

        The members agree on the epoch (the common time of tick 0) in three steps:

        1. `epoch`: The leader proposes an epoch. The event states the number of the proposal
           (`attempt`), and the boots of all members. A boot is a random number that identifies
           one start of a process.
        2. `ready`: Each member agrees, and states the epoch on its own clock.
        3. `start`: The leader confirms the proposal, and states the epochs of all members.

        The events `ready` and `start` repeat the number and the boots of their proposal. They
        are ignored if this member has agreed to a different proposal.

        Events about the admission of a site to a running session are passed to
        `_receive_admission`.

        Returns:
            The epoch once the leader has confirmed the proposal that this member agreed to, and
            None until then.
        """
        for event in read_messages(self._events, Event):
            # An event must list its own sender among the members, with the right boot.
            is_sender_listed = event.boots.get(event.member) == event.boot
            if not is_sender_listed:
                continue
            if event.kind == "epoch":
                self._receive_announcement(event)
                continue
            self._receive_admission(event)

            agreed = self._agreed_proposal
            if agreed is None:
                continue
            is_about_agreed = event.attempt == agreed.attempt and event.boots == agreed.boots
            if not is_about_agreed:
                continue
            is_from_leader = event.boot == agreed.boot
            if event.kind == "ready":
                self._ready_epochs[event.member] = event.epoch_mono_ns
            elif event.kind == "start" and is_from_leader:
                includes_all_members = event.epochs.keys() == agreed.boots.keys()
                if includes_all_members:
                    return self._make_epoch(event)
        return None

    def _receive_admission(self, event: Event) -> None:
        """Stores whether a running site admits this site, rejects it, or admits another site.

        A site that wants to join the running session publishes the request `coming`. Each
        running site replies with the event `admit` or `refused`. The event states which site it
        is about, the boot of that site (the number that identifies the start of its process),
        and the number of the request, because a request may be repeated.

        Other sites may be admitted while this site is waiting. Their boots are always stored,
        because they become members of the session.

        Args:
            event: An event from a running site. Events of other kinds are ignored.
        """
        joining_site = event.about
        if event.kind == "admit" and joining_site in event.boots:
            self._admitted_boots[joining_site] = event.boots[joining_site]

        info = self._info
        is_about_this_start = (
            joining_site == info.member and event.boots.get(info.member) == info.boot
        )
        has_requested = self._coming is not None
        if not has_requested or not is_about_this_start:
            return
        is_reply_to_newest_request = event.attempt == self._attempt
        if event.kind == "refused":
            self.refusal = event.text
        elif event.kind == "admit" and is_reply_to_newest_request:
            self._admitted_by.add(event.member)

    def _receive_announcement(self, event: Event) -> None:
        """Receives the proposal of an epoch, and agrees if it includes this member.

        The proposal lists the members of the session with their boots, the numbers that
        identify the starts of their processes. This member is included if its name and its boot
        are listed. If another boot is listed under its name, another process is acting as the
        same member.

        Proposals from sites other than the leader are ignored. A recorder does not know the
        leader, because it obtains the scenario from the identities of the sites. It ignores
        proposals until it has received the scenario from one of the listed sites.

        The member agrees (`_reply_ready`) as soon as it has measured the clocks of the others.

        Args:
            event: Event `epoch`, the proposal.

        Raises:
            SessionError: The proposal includes another process that acts as this site.
        """
        is_recorder = not self._sites
        is_from_leader = is_recorder or event.member == self._sites[0]
        if self.membership.is_leader or not is_from_leader:
            return
        knows_scenario = not is_recorder
        for name, info in self.membership.others.items():
            is_listed = event.boots.get(name) == info.boot
            if info.scenario and is_listed:
                knows_scenario = True
        if not knows_scenario:
            return

        local = self._info
        is_included = event.boots.get(local.member) == local.boot
        is_other_process_included = not is_included and local.member in event.boots
        # A proposal with another recorder is no error, because one of two recorders joins late.
        if is_other_process_included and not is_recorder:
            raise SessionError(
                f"session {self._session!r} continues with another process of {local.member}"
            )
        if is_included and not self._must_wait_for_other_leader(event):
            self._waiting_proposal = event
            self._reply_ready()

    def _must_wait_for_other_leader(self, event: Event) -> bool:
        """Returns True if this member has agreed to a proposal that may still be confirmed.

        If the leader was started twice, or was restarted, proposals from two processes arrive.
        A member that has agreed to one of them must not agree to the other until the epoch of
        the first has passed or its process has disappeared.

        Args:
            event: Proposal of an epoch that has just arrived.
        """
        agreed = self._agreed_proposal
        if agreed is None or agreed.boot == event.boot:
            return False
        has_leader_disappeared = str(agreed.boot) in self.membership.gone
        has_epoch_passed = self._clock.monotonic_ns() >= self._epoch_ns
        return not (has_leader_disappeared or has_epoch_passed)

    def _reply_ready(self) -> None:
        """Agrees to the leader's proposal of an epoch once this member has measured all clocks.

        If there is no pending proposal, or the offset of a clock is still unknown, nothing
        happens, and the caller tries again later. The reply (the event `ready`) states the
        proposed epoch on the clock of this member.
        """
        proposal = self._waiting_proposal
        if proposal is None:
            return
        other_clocks = self._list_other_clocks(proposal.boots, proposal.clocks)
        if not self.pinger.knows_clocks(other_clocks):
            return

        # Convert the epoch from the leader's clock: local time = leader's time - offset. The
        # offset drifts with local time, and is needed at the epoch, whose local time is the
        # result. As the drift is slow, the local time for the present offset is close enough.
        leader_clock = self.pinger.estimate(proposal.boot)
        approximate_epoch_ns = proposal.epoch_mono_ns - leader_clock.offset_ns
        offset_at_epoch_ns = leader_clock.extrapolate_ns(approximate_epoch_ns)
        self._epoch_ns = proposal.epoch_mono_ns - offset_at_epoch_ns

        self._waiting_proposal = None
        self._agreed_proposal = proposal
        self._publisher.publish(
            "ready",
            f"{self._info.member} is ready",
            attempt=proposal.attempt,
            boots=proposal.boots,
            epoch_mono_ns=self._epoch_ns,
            clock=self._info.clock,
        )

    def _lead(self) -> Epoch | None:
        """Takes the next step of the leader: proposes an epoch, or confirms or withdraws it.

        An epoch is proposed once all members are present and their clocks are known, and
        confirmed once all members have agreed. It is withdrawn if a member is too late, has
        disappeared, or has joined in the meantime. The next call then proposes another one.

        The decision must be made early enough for the confirmation to reach all members before
        the epoch, at least `DECIDE_NS` plus the slowest round trip in advance.

        Returns:
            The epoch once it is confirmed, and None until then.
        """
        now_ns = self._clock.monotonic_ns()
        membership = self.membership
        # For the leader, this is the proposal that it has published itself.
        proposal = self._agreed_proposal
        if proposal is None:
            other_clocks = self._list_other_clocks(membership.boots(), membership.clocks())
            if not membership.list_missing() and self.pinger.knows_clocks(other_clocks):
                self._announce(now_ns)
            return None

        decide_ns = self._epoch_ns - DECIDE_NS - self.pinger.slowest_ns()
        is_too_late = now_ns >= decide_ns
        have_members_changed = proposal.boots != membership.boots()
        if is_too_late or have_members_changed or membership.list_missing():
            self._agreed_proposal = None
            return None

        # The leader itself is always ready.
        ready_members = self._ready_epochs.keys() | {self._info.member}
        proposed_members = set(proposal.boots)
        are_all_ready = ready_members >= proposed_members
        if not are_all_ready:
            return None
        start = self._publisher.publish(
            "start",
            "all are ready",
            attempt=proposal.attempt,
            boots=proposal.boots,
            epochs={**self._ready_epochs, self._info.member: self._epoch_ns},
        )
        return self._make_epoch(start)

    def _announce(self, now_ns: int) -> None:
        """Proposes a common start time (epoch) to all members, as the leader of the session.

        Args:
            now_ns: Present time on the local clock, in ns.
        """
        boots = self.membership.boots()
        self._ready_epochs = {}
        self._attempt += 1

        ahead_ns = EPOCH_AHEAD_NS + 2 * self.pinger.slowest_ns()
        self._epoch_ns = now_ns + ahead_ns
        self._agreed_proposal = self._publisher.publish(
            "epoch",
            f"{', '.join(sorted(boots))}: tick 0 is {ahead_ns // 1_000_000} ms from now",
            attempt=self._attempt,
            epoch_mono_ns=self._epoch_ns,
            epoch_unix_ns=self._clock.unix_ns() + ahead_ns,
            clock=self._info.clock,
            clocks=self.membership.clocks(),
            boots=boots,
        )

    def _make_epoch(self, start: Event) -> Epoch:
        """Returns the common start time (epoch) of the session, as confirmed by its leader.

        Args:
            start: The leader's event `start`, which states the members and their epochs.
        """
        assert self._agreed_proposal is not None
        return Epoch(
            mono_ns=self._epoch_ns,
            unix_ns=self._agreed_proposal.epoch_unix_ns,
            boots=start.boots,
            epochs=start.epochs,
        )
