"""Determines which ticks the sites of a run executed, and which of their records a log lacks.

The sites and the recorder state numbers of ticks and messages, which are compared with the
records in the log.

Invariant:
    - A truncated file is read up to its end, and `AccountedLog.complete` is then False.
    - A tick that a site did not execute is not missing.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..errors import count_nouns
from ..net import count_under_way, topics
from .accounting import LAST, Account, Coverage
from .decoded_log import DecodedLog
from .log_layout import ACCOUNTS, EXECUTED_SITES_KEY, PART, RERUN_DRIVER, ChannelFilter
from .running_digest import DigestState, Integrity
from .session_accounts import SessionAccounts


class LogQuality(NamedTuple):
    """How much of a run was recorded, and whether its log can be trusted.

    Attributes:
        coverage: Numbers of recorded and expected ticks of every site.
        integrity: Whether the log was modified after it was written.
        copied_sites: Sites that did not react to the other sites, because the run is a
            repetition in which their motion was copied from an earlier run.
    """

    coverage: Coverage
    integrity: Integrity
    copied_sites: tuple[str, ...]


class AccountedLog(DecodedLog):
    """The recorded messages of a session, and which messages are missing.

    See `Log`, the public class, for the arguments and attributes.
    """

    @cached_property
    def complete(self) -> bool:
        """True if the recording was finished properly, so that its end cannot be missing.

        A recorder that crashes leaves an unfinished file. A log of several files is complete if
        all of them were finished. It is also complete if the last file was finished and no
        record is missing, since another recorder may have recorded the messages that an
        unfinished file lacks.
        """
        if self._contents.complete or len(self.sources) == 1:
            return self._contents.complete
        has_all_records = all(
            site in self._stated_ticks and not self.missing(site) for site in self.sites
        )
        return self._contents.ended and has_all_records

    @property
    def part(self) -> int:
        """Number of this file, counted from 1, if a long log was split into several files.

        0 for a log in a single file, for several files that were opened together, and for a
        file without a valid number.
        """
        if len(self.sources) > 1:
            return 0
        number = self._contents.metadata.get(PART, {}).get("index", "0")
        is_number = number.isdecimal() and len(number) < 10
        return int(number) if is_number else 0

    @property
    def executed_sites(self) -> tuple[str, ...]:
        """Names of the sites whose records can be recomputed from this file.

        These are all sites, except in an open-loop rerun, which repeats only some of the sites.
        The records of the other sites are copied from the original log and depend on samples
        that this file does not contain.
        """
        executed = self.session.get(EXECUTED_SITES_KEY)
        if self.driver != RERUN_DRIVER or executed is None:
            return tuple(self.sites)
        return tuple(name for name in self.sites if name in executed.split())

    @cached_property
    def accounts(self) -> dict[str, str]:
        """Maps each topic to a line of text with its numbers of received and missing messages.

        The recorder writes these lines when it finishes a file, so the mapping is empty for an
        unfinished file. If the log consists of several files, no single file states the totals,
        so the records, statistics and events of all files are counted again. Counts without a
        topic, such as the number of dropped messages, cannot be recomputed. They are added up
        over all files by `LogContents.of_session`.
        """
        written_counts = self._contents.metadata.get(ACCOUNTS, {})
        has_one_file = len(self.sources) == 1
        if has_one_file:
            return written_counts

        accounts = SessionAccounts(self.session["session"], self.scenario)
        for site in self.sites:
            record_topic = self._topic(site, topics.STATE)
            link_topic = self._topic(site, topics.LINK)
            accounts.open_channel(record_topic)
            accounts.open_channel(link_topic)
            accounts.open_channel(self._topic(site, topics.EVENT))
            # The sequence number of records and of statistics in a log is their tick.
            for tick in self[site].tick.tolist():
                accounts.receive(record_topic, tick)
            for stats in self.link_stats(site):
                accounts.receive(link_topic, stats.tick)
        for event in self.events:
            has_number = event.n >= 0  # events of the oldest logs have no number
            if event.member in self.sites and has_number:
                accounts.receive_event(self._topic(event.member, topics.EVENT), event.n, event)
        # The sites state in their "end" events how many ticks they executed. Records of these
        # ticks that are not in the log are missing.
        for site, ticks in self._stated_ticks.items():
            accounts.add_expected_ticks(site, ticks)
        # The recomputed counts come first, followed by counts without a topic, such as those of
        # dropped messages.
        return {**accounts.format_accounts(), **written_counts}

    def account(self, site: str) -> str:
        """Returns the recorder's counts of received and missing records for a site.

        The counts may disagree with the contents of a damaged file.

        Args:
            site: Name of the site.

        Returns:
            The counts as a line of text, see `accounts`. Empty if the file was not finished.
        """
        return self.accounts.get(self._topic(site, topics.STATE), "")

    def count_messages(self, topic: str, sequence: Sequence[int]) -> Account | None:
        """Counts the received and missing messages of a channel.

        Ticks that the site did not execute do not count as missing.

        Args:
            topic: Topic of the channel.
            sequence: Tick of each message, in file order.

        Returns:
            The account of the channel. None unless the channel contains the records or the link
                statistics of a site of this session, whose sequence numbers are ticks.
        """
        key = topics.parse_key(topic.removeprefix("/"))
        if (
            key is None
            or key.session != self.session["session"]
            or key.member not in self.sites
        ):
            return None
        if key.channel not in (topics.STATE, topics.LINK):
            return None
        rate_hz = self.scenario.sites[key.member].rate_hz
        absences = self.find_unexecuted_ticks(key.member)
        return Account.of_ticks(key.channel, sequence, rate_hz, absences)

    @cached_property
    def unknown_ends(self) -> tuple[str, ...]:
        """Names of the sites whose shutdown was not recorded.

        A site publishes the event "end" when it shuts down. Without this event, the site may
        have executed more ticks than the log shows. Empty if the recorder was configured not to
        record events.
        """
        is_one_of_several_parts = bool(self.part) and len(self.sources) == 1
        if is_one_of_several_parts:
            return ()  # the events may be in a later part
        channel_filter = ChannelFilter.parse_facts(self.session)
        ended_sites = {event.member for event in self.events if event.kind == "end"}
        unknown_ends = []
        for site in self.sites:
            event_topic = topics.key(self.session["session"], site, topics.EVENT)
            are_events_recorded = channel_filter.accepts(event_topic)
            if are_events_recorded and site not in ended_sites:
                unknown_ends.append(site)
        return tuple(unknown_ends)

    @cached_property
    def _stated_ticks(self) -> dict[str, int]:
        """Maps each site to the number of ticks that it states when it ends.

        A site states the number in its "end" event. Sites without such an event are left out. A
        number greater than that of the scenario is reduced to the number of the scenario.
        """
        ticks = {}
        for event in self.events:
            if event.kind == "end" and event.member in self.scenario.sites:
                largest = self.scenario.ticks(event.member)
                ticks[event.member] = min(max(event.ticks, 0), largest)
        return ticks

    @cached_property
    def starts(self) -> dict[str, list[tuple[int, int]]]:
        """Lists the late starts of each site that joined late or was restarted.

        Each start is given by its first tick and the random number (boot) that identifies this
        start of the process. Sites that were present from the beginning and never restarted
        have no entry.
        """
        starts: dict[str, list[tuple[int, int]]] = {}
        for event in self.events:
            if event.kind != "join" or event.member not in self.scenario.sites:
                continue
            if 0 < event.ticks < self.scenario.ticks(event.member):
                starts.setdefault(event.member, []).append((event.ticks, event.boot))
        return {site: sorted(site_starts) for site, site_starts in starts.items()}

    @cached_property
    def absences(self) -> dict[str, list[tuple[int, int]]]:
        """Ranges of ticks that each site did not execute because its process was not running.

        This happens when a process is killed and restarted, or joins a session late. Each start
        in `starts` is preceded by a range (first tick, last tick) of such ticks. The range
        begins after the last earlier tick that the site is known to have executed. A tick is
        known to have been executed if there is a record of it, if the "end" event of the
        earlier process includes it, or if another site received the sample sent in that tick.
        """
        return {site: self._find_absences(site, starts) for site, starts in self.starts.items()}

    def _find_absences(self, site: str, starts: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Finds the ranges of ticks that a site did not execute because it was not running.

        A process that is restarted while the session runs joins at a later tick. The absence
        before a start ends just before its first tick. It begins after the last tick that the
        earlier process is known to have executed, from one of three sources:

        - a record,
        - the "end" event of the earlier process, which states its number of ticks,
        - events of the kind `LAST`, in which the other sites state how many ticks they had
          received before this start.

        Args:
            site: Name of the site.
            starts: Its starts in ascending order, each with its first tick and its boot (the
                random number that identifies the start).

        Returns:
            The absences, as (first tick, last tick), in ascending order.
        """
        end_events = [event for event in self.events if event.kind == "end"]
        # The ticks are counted from 0, so the last tick is one less than their number.
        last_ticks = [event.ticks - 1 for event in end_events if event.member == site]
        executed_ticks = [*self[site].tick.tolist(), *last_ticks]
        executed = np.array(executed_ticks, dtype=np.int64)
        most_in_transit = count_under_way(topics.STATE, self[site].rate_hz)
        absences: list[tuple[int, int]] = []
        for start_tick, boot in starts:
            last_executed = int(executed[executed < start_tick].max(initial=-1))
            absence_begin = last_executed + 1

            reported_ticks = 0
            for event in self.events:
                if event.kind == LAST and event.boots.get(site) == boot:
                    reported_ticks = max(reported_ticks, event.ticks)
            reported_ticks = min(start_tick, reported_ticks)
            # Some ticks may be reported but not recorded, because their records were still in
            # transit to the recorder when the process was killed. Such ticks count as not
            # executed. If more ticks are reported than can have been in transit, they were
            # executed, and their records are missing.
            unrecorded_ticks = reported_ticks - absence_begin
            if unrecorded_ticks > most_in_transit:
                absence_begin = reported_ticks

            if absences:
                previous_begin, _ = absences[-1]
                if absence_begin == previous_begin:
                    # Nothing was executed since the previous absence began, although the site
                    # was started in between. The new absence replaces the previous one.
                    absences.pop()
            if absence_begin < start_tick:
                absences.append((absence_begin, start_tick - 1))
        return absences

    def find_unexecuted_ticks(self, site: str) -> list[tuple[int, int]]:
        """Finds the ticks that a site did not execute although the session was running.

        These are the ticks between two starts of the site (`absences`), and the ticks that its
        records report as skipped because the site was late. The site published nothing in these
        ticks, so their records and samples do not count as missing.

        Args:
            site: Name of the site.

        Returns:
            Ranges (first tick, last tick).
        """
        return [*self.absences.get(site, ()), *self[site].skipped_ranges]

    def absent_ticks(self, site: str) -> int:
        """Counts the ticks that a site did not execute during the session.

        These are the ticks in the ranges that `find_unexecuted_ticks` returns.

        Args:
            site: Name of the site.
        """
        return sum(last - first + 1 for first, last in self.find_unexecuted_ticks(site))

    def expected_ticks(self, site: str) -> int:
        """Returns the number of ticks that a site should have executed in this run.

        The "end" event of the site states this number. Without the event, it is the number of
        ticks up to the last record if the site was lost for good, and the number of ticks in
        the scenario otherwise. Ticks that the site did not execute (`absent_ticks`) are
        subtracted.
        """
        recorded = self[site].last_tick + 1
        ticks = self._stated_ticks.get(site)
        if ticks is None:
            ticks = self.scenario.ticks(site)
            if recorded and self._is_gone(site):
                ticks = recorded
        return max(ticks, recorded) - self.absent_ticks(site)

    def _is_gone(self, site: str) -> bool:
        """Returns True if a site was lost or left, according to the latest event about it.

        Such events are published by other sites. The site may have come back after an earlier
        loss.
        """
        kinds = ("lost", "left", "back", "admit")
        events = [event for event in self.events if event.about == site and event.kind in kinds]
        if not events:
            return False
        last = max(events, key=lambda event: event.t_ns)
        return last.kind in ("lost", "left")

    def missing(self, site: str) -> int:
        """Returns the number of a site's records that are missing from the log.

        The "end" event of the site states how many ticks it executed. Without the event, only
        records before the last one in the log can be known to be missing.

        Args:
            site: Name of the site.
        """
        site_log = self[site]
        after_last = max(0, self._stated_ticks.get(site, 0) - (site_log.last_tick + 1))
        return max(0, site_log.missing + after_last - self.absent_ticks(site))

    @cached_property
    def last_ticks(self) -> dict[str, int]:
        """Maps each site to the last tick that it is known to have executed.

        The "end" event of a site states this tick. Without the event, it is the tick of the
        site's last record or of its last sample that another site received, whichever is later.
        -1 if no such tick is known.
        """
        stated = self._stated_ticks
        last_ticks = {}
        for name in self.sites:
            ticks = stated.get(name, self[name].last_tick + 1)
            last_ticks[name] = ticks - 1

        for name in self.sites:
            peers = self[name].peers
            peers_without_end = {
                index: peer for index, peer in enumerate(peers) if peer not in stated
            }
            if not peers_without_end:
                continue  # avoids decoding all arrivals
            _, arrivals = self[name].arrivals
            for index, peer in peers_without_end.items():
                received_ticks = arrivals[arrivals[:, 0] == index, 1]
                possible_ticks = received_ticks[received_ticks < self.scenario.ticks(peer)]
                last_ticks[peer] = int(possible_ticks.max(initial=last_ticks[peer]))
        return last_ticks

    def judge_quality(self) -> LogQuality:
        """Determines how much of the run was recorded, and whether the log was modified.

        Raises:
            LogError: A message cannot be decoded.
        """
        recorded_ticks = {site: len(np.unique(self[site].tick)) for site in self.sites}
        expected_ticks = {site: self.expected_ticks(site) for site in self.sites}
        executed_sites = self.executed_sites
        return LogQuality(
            coverage=Coverage(recorded_ticks, expected_ticks),
            integrity=self.judge_integrity(),
            copied_sites=tuple(site for site in self.sites if site not in executed_sites),
        )

    def judge_integrity(self) -> Integrity:
        """Determines whether the log was modified after it was recorded.

        The contents are compared with the digests stored in the log, and the records with the
        recorder's message counts and statistics. The second comparison also reveals
        modifications to a log that was rewritten with new digests.

        Returns:
            The result, with an explanation.

        Raises:
            LogError: A message cannot be decoded.
        """
        if self.chain.passed:
            for site in self.sites:
                change = self._describe_unexplained_gap(site)
                if change:
                    return Integrity(DigestState.CHANGED, change)
        return self.chain

    def _describe_unexplained_gap(self, site: str) -> str:
        """Describes missing or additional records of a site that the log does not explain.

        The recorder states how many records it received and missed, both in the account of the
        site at the end of the file and in its statistics during the recording. Any other gap
        shows that records were removed, or that two logs were joined. There are two tests:

        1. The account must match the records. Not tested if there is no account (the file was
           not finished), if the file is only a part of a log (the account includes other
           parts), or if the log consists of several files (see below).
        2. The ticks must be consecutive, except for ticks that the site did not execute, and
           for the number of records that the recorder states as missing. Not tested if the
           digests, checksums of all messages, show that nothing was changed.

        Args:
            site: Name of the site.

        Returns:
            The description. Empty if the records match the statements of the recorder, or if a
            part of the file cannot be read, because records may then be missing.
        """
        if self.damaged:
            return ""
        ticks = self[site].tick  # in ascending order
        records = 1 + int(np.count_nonzero(np.diff(ticks))) if len(ticks) else 0
        # The counts of several files were computed from their records, and prove nothing.
        has_one_file = len(self.sources) == 1
        stated = Account.parse_counts(self.account(site)) if has_one_file else {}
        counted = {"received": records, "missing": self.missing(site)}
        has_account = stated != {}
        if not self.part and has_account and stated != counted:
            stated_text = " and ".join(f"{stated.get(name, 0)} {name}" for name in counted)
            counted_text = " and ".join(f"{count} {name}" for name, count in counted.items())
            return (
                f"records of {site} were removed or added: the account of {site} states "
                f"{stated_text}, but the file has {counted_text}"
            )

        # Number of ticks without a record between the first and the last record.
        ticks_without_record = int(ticks[-1] - ticks[0]) + 1 - records if records else 0
        not_executed = min(ticks_without_record, self.absent_ticks(site))
        missing = ticks_without_record - not_executed
        if not missing or self.chain.state is DigestState.INTACT:
            return ""
        missing_in_account = stated.get("missing", 0)
        missing_in_statistics = [
            stats.missing.get(f"{site}/state", 0) for stats in self.recorder_stats()
        ]
        largest_stated = max([missing_in_account, *missing_in_statistics])
        if missing <= largest_stated:
            return ""
        missing_text = count_nouns(missing, f"record of {site} is", f"records of {site} are")
        return f"{missing_text} missing in between, and nothing in the log explains it"
