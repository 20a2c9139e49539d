"""Reports what happens at an arm: events for the log and other processes, lines for the user.

While the control loop of the arm is running, a `SiteNews` publishes an event for each change
that took effect, such as a new delay or a new mode, and prints alarms and a status line.

Invariant:
    - Every event is published after the record of the tick to which it belongs.
    - An event or alarm that would repeat in every tick is issued at most once per second.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from trilat_net.core import LifeAlarm, describe_mode, tick_ns
from trilat_net.errors import count_nouns
from trilat_net.log import compute_task_errors, count_skipped_ticks
from trilat_net.net import MODE_WORDS, EventPublisher
from trilat_net.records import NS_PER_S, Mode, TickRecord
from trilat_net.scenario import Change

from .site_parts import SiteParts

_STATUS_PERIOD_S = 5
"""Interval between status lines for the user, in s."""


class SiteNews:
    """Publishes the events of a running site, and prints lines for its user.

    Events inform the recorder and the other processes of what happened at this arm, for example
    that it stopped because the network was interrupted.

    The control loop calls `report_tick` after ticks in which something changed, and
    `publish_news` ten times per second.

    Args:
        parts: Parts of the site.
        publisher: Publishes the events of the site.
    """

    def __init__(self, parts: SiteParts, publisher: EventPublisher) -> None:
        self._parts = parts
        self._publisher = publisher
        self._mode = Mode.RUN
        # Ranges of skipped ticks that are not published yet.
        self._skipped: list[str] = []
        # Seconds of the session in which a status line, a `waiting` event and an alarm were
        # last issued. They limit how often these are repeated.
        self._status_s = 0
        self._waiting_s = 0
        self._alarm_s = -1

    def report_tick(self, output: TickRecord) -> None:
        """Publishes an event for each change that took effect in a tick, such as a new delay.

        A new mode of the site, such as "fault", is also a change. Skipped ticks are only stored
        here; `publish_news` later publishes them together in one event.

        Args:
            output: Record of the tick.
        """
        parts = self._parts
        skipped = count_skipped_ticks(output.cmd)
        if skipped:
            self._skipped.append(f"{output.tick - skipped}-{output.tick - 1}")

        for change in output.cmd:
            if count_skipped_ticks([change]):
                continue
            source = parts.changes.sources.pop(change, "")
            sentence = msgspec.json.decode(change, type=Change).describe(source)
            self._publisher.publish(
                "change", sentence, command=change, t_ns=output.t_ns, ticks=output.tick
            )
            parts.say(sentence)

        if output.mode is not self._mode:
            self._mode = output.mode
            text = describe_mode(
                parts.name,
                output,
                glides=parts.setup.on_stale.glides,
                law_failure=parts.site.law_failure,
            )
            self._publisher.publish("mode", text, t_ns=output.t_ns, ticks=output.tick)
            self._raise_alarm(output)

    def _raise_alarm(self, output: TickRecord) -> None:
        """Prints an alarm with a reason and a remedy if the new mode requires one.

        Alarms exist only under the rule `glide` for interrupted connections. An arm that holds
        its position may change its mode many times, and raises at most one alarm per second.

        Args:
            output: Record of the tick in which the mode has changed.
        """
        parts = self._parts
        mode = output.mode
        rule = parts.setup.on_stale  # what the arm does while samples of a peer are missing
        if mode is Mode.HOLD:
            second = output.t_ns // NS_PER_S
            had_alarm_in_this_second = second <= self._alarm_s
            if had_alarm_in_this_second:
                return
            self._alarm_s = second

        if not rule.glides:
            return

        # Some arms continue without a lost peer. For them, an alarm is raised when they return
        # to the others.
        lost_peers: Sequence[str] = ()
        if rule.degrades and mode is Mode.RETURN:
            lost_peers = parts.site.layout.list_lost_peers(output.mem, parts.site.peers)

        alarm = LifeAlarm.find(
            session=parts.options.session,
            site=parts.name,
            mode=MODE_WORDS[mode],
            mem=output.mem,
            shared=len(output.q_des),
            lost=lost_peers,
        )
        if alarm is not None:
            parts.say(f"*** {alarm}")

    def publish_news(self, output: TickRecord) -> None:
        """Publishes events about what has happened since the last call, such as alarms.

        The control loop calls this method ten times per second, between two ticks. The status
        line for the user is also printed when it is due.

        Args:
            output: Record of the newest tick.
        """
        parts = self._parts
        if parts.hand is not None:  # who has started or stopped moving the arm
            for _, text in parts.hand.news:
                # `say` prints the name of the site itself.
                _, _, text_without_site = text.partition(": ")
                parts.say(text_without_site)
            self._publish_entries("hand", parts.hand.news)
        self._publish_entries("mark", parts.changes.marks)
        self.publish_skipped(output)
        self._publish_waiting(output)

        second = output.t_ns // NS_PER_S
        if second >= self._status_s + _STATUS_PERIOD_S:
            self._status_s = second
            parts.say(self._describe_status(output))

    def _publish_entries(self, kind: str, news: list[tuple[int, str]]) -> None:
        """Publishes one event for each entry of a list, and then empties the list.

        The control loop only appends to the list, because publishing would take too long there.

        Args:
            kind: Kind of the events, for example "mark".
            news: Pairs of the tick in which something happened and a sentence about it.
        """
        rate_hz = self._parts.site.rate_hz
        for tick, text in news:
            self._publisher.publish(kind, text, t_ns=tick_ns(tick, rate_hz), ticks=tick)
        news.clear()

    def publish_skipped(self, output: TickRecord) -> None:
        """Publishes one event about all ticks skipped since the last call.

        Ticks are skipped only if the arm is external and the loop was late, because a real
        robot cannot catch up.

        Args:
            output: Record of the newest tick.
        """
        if self._skipped:
            ticks = " ".join(self._skipped)
            self._skipped = []
            text = f"{self._parts.name} skipped ticks {ticks}"
            self._publisher.publish(
                "overrun", text, t_ns=output.t_ns, ticks=output.tick + 1, command=ticks
            )

    def _publish_waiting(self, output: TickRecord) -> None:
        """Reports once per second that the arm is too far from its peers to approach them.

        This can happen only if the scenario lets an arm glide back to its peers after an
        interrupted connection. The arm then waits until its operator moves it closer.

        Args:
            output: Record of the newest tick.
        """
        if output.mode not in (Mode.WAITING, Mode.HOLD):
            return
        if not self._parts.setup.on_stale.glides:
            return

        second = output.t_ns // NS_PER_S
        if self._parts.site.is_too_far and second > self._waiting_s:
            self._waiting_s = second
            text = describe_mode(self._parts.name, output, glides=True)
            self._publisher.publish("waiting", text, t_ns=output.t_ns, ticks=output.tick)
            self._parts.say(text)

    def _describe_status(self, output: TickRecord) -> str:
        """Returns the status line that is printed for the user every few seconds.

        It contains the time, the mode, the largest synchronisation error and torque of any
        joint, and the numbers of late ticks and dropped messages.
        """
        parts = self._parts
        position = np.array([output.shared()[0]])
        desired = np.array([output.q_des])
        if output.x:
            unit = "m or rad"
            error = compute_task_errors(position, desired, parts.scenario.arms[parts.name].axes)
        else:
            unit = "rad"
            error = position - desired

        largest_error = np.abs(error).max()
        torque_nm = max(map(abs, output.tau))
        dropped = sum(parts.stats.dropped.values())

        late = f"{count_nouns(parts.stats.late_ticks, 'tick')} late"
        if parts.stats.skipped:
            late += f", {parts.stats.skipped} skipped"

        return (
            f"t = {output.t_ns / NS_PER_S:.0f} s, {MODE_WORDS[output.mode]}, "
            f"|e| {largest_error:.3g} {unit}, torque {torque_nm:.3g} N m, "
            f"{late}, {count_nouns(dropped, 'message')} dropped"
        )
