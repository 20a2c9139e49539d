"""Opens the log of a run, and provides the states of each arm as arrays.

    log = open_log("run.mcap")
    log["m1"].t_s, log["m1"].q

Here "m1" is the name of an arm, t_s contains the time of each tick, and q the joint angles of
the arm, with one row per tick. A run may have several files, because a recorder can split its
log, and because several recorders can each record part of one session. Such files are read as
one log.

`Log.link_delays` contains the measured network delays between two arms, which a scenario with
`model = "trace"` can reproduce.

Invariant:
    - Files of every released schema version can be opened. A truncated file is read up to its
      end, and `Log.complete` is False.
    - Messages are decoded when they are accessed. An invalid record raises an error that names
      the file. An invalid event or statistics message is skipped and reported in
      `Log.unreadable`.
    - Channels of other sessions and members are ignored.
    - A sample counts as lost only if there is a record of every tick in which it could have
      arrived, up to the longest delay of the link. Samples whose arrival is unknown are left
      out.
"""

import hashlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

import numpy as np

from ..core import CoreChange
from ..errors import (
    LogError,
    ScenarioError,
    UnknownName,
    UsageError,
    WireError,
    count_nouns,
    suggest_nearest,
)
from ..hooks import find_hook
from ..net import (
    READABLE,
    Event,
    LinkStats,
    RecorderStats,
    count_under_way,
    decode,
    topics,
)
from ..own_code import LawFiles, allow_logged_code
from ..package_names import describe_missing_library
from ..results import Result
from ..scenario import (
    FAILED_HAND,
    PictureDelay,
    Scenario,
    TracePoint,
    parse_embedded,
)
from .accounting import LAST, Account, describe_unknown_ends
from .data_tables import EVENTS_TABLE, SITE_TABLE_KINDS, Table
from .log_layout import (
    ACCOUNTS,
    EXECUTED_SITES_KEY,
    PART,
    RERUN_DRIVER,
    ChannelFilter,
)
from .mcap_reader import ChannelMessages, LogContents, Progress
from .merge import read_session, read_sessions
from .record_columns import Ints
from .running_digest import DigestState, Integrity
from .session_accounts import SessionAccounts
from .site_log import SiteLog, TimedMessages

if TYPE_CHECKING:
    import pandas
    import polars


M = TypeVar("M", Event, LinkStats, RecorderStats)


class Log(Result, Mapping[str, SiteLog]):
    """A recorded session: a mapping from the name of each site to its records.

    For example, `log["m1"].q` contains the joint angles of the arm m1. Logs are created by
    `open_log`, from one file or from several files of one session.

    Args:
        contents: Contents of the file, or of all files together.

    Attributes:
        source: Name of the file. For several files, the name of the first and their number.
        sources: Names of the files, in message order.
        session: Metadata of the session: driver, seed, start time, versions, commit,
            fingerprint.
        driver: How the session ran: "live", "virtual" (simulated time) or "rerun".
        scenario: The scenario that was run.
        scenario_text: Text of the scenario, as stored in the file.
        scenario_sha256: SHA-256 hash of that text.
        sites: Names of the sites, in scenario order.
        events: Events of all members, grouped by member, in numerical order.
        damaged: One sentence for each part of the file that cannot be read.
        chain: Result of comparing the contents with the digests stored in the file. For several
            files, the worst result.
        unreadable: One sentence for each channel with messages that cannot be decoded.

    Raises:
        LogError: The scenario cannot be read.
    """

    def __init__(self, contents: LogContents) -> None:
        """Reads the scenario and the events of a log. Records are decoded on first access."""
        self.source = contents.source
        self.sources = contents.sources
        self.session = contents.session
        self.damaged = contents.damaged
        self.chain = contents.chain
        self.driver = self.session["driver"]

        self.scenario_sha256 = hashlib.sha256(contents.scenario).hexdigest()
        try:
            self.scenario_text = contents.scenario.decode()
            self.scenario: Scenario = parse_embedded(
                self.scenario_text, f"{self.source}: scenario"
            )
        except (ScenarioError, UnicodeDecodeError) as error:
            raise LogError(
                f"{self.source}: the scenario in this log cannot be read: {error}"
            ) from None
        self.sites = self.scenario.names

        self._contents = contents
        self._sites: dict[str, SiteLog] = {}
        self.unreadable: list[str] = []
        self.events: list[Event] = []
        for topic in self._event_topics():
            self.events += self._read_events(topic)

    @classmethod
    def open_sessions(
        cls, *sources: str | Path, progress: Progress | None = None
    ) -> list["Log"]:
        """Opens all logs in the given files and folders, see `open_log`.

        Args:
            sources: Paths of logs, or of folders that contain logs.
            progress: Function that is called repeatedly with the number of bytes read and the
                total over all files.

        Returns:
            One log per session. Files of the same session are read as one log.

        Raises:
            LogError: A folder contains no log, or a file cannot be read.
        """
        files: list[Path] = []
        for path in map(Path, sources):
            if not path.is_dir():
                files.append(path)
                continue
            logs = sorted(path.glob("*.mcap"))
            if not logs:
                raise LogError(f"{path}: this directory contains no log")
            files += logs
        return [cls(contents) for contents in read_sessions(files, progress)]

    def headline(self) -> str:
        """Summarises the session in one line for the user.

        The line states how the session ran, its sites, its duration and its number of records.
        It ends with "not finished" if the end of the log is missing.
        """
        try:
            summary = self._describe_records()
        except LogError:
            summary = "with records that cannot be read"
        kind = f"{self.driver} session {self.session['session']} of {', '.join(self.sites)}"
        state = "" if self.complete else "; not finished"
        return f"{self.source}: {kind}; {summary}{state}"

    @property
    def why_empty(self) -> str:
        """Clause for an error message, saying that no site has a record in this log.

        Empty if at least one site has a record.
        """
        has_records = any(len(self[name]) for name in self.sites)
        return "" if has_records else "no site has a record in this log"

    def require_records(self) -> None:
        """Raises LogError if the log contains no records, as there is then nothing to judge.

        Raises:
            LogError: No site has a record.
        """
        if self.why_empty:
            raise LogError(f"{self.source}: {self.why_empty}, so there is nothing to judge")

    def _describe_records(self) -> str:
        """Returns a description of the session's duration and numbers of records."""
        last_times_s = [float(self[name].t_s[-1]) for name in self.sites if len(self[name])]
        length_s = max(last_times_s, default=0.0)
        records = sum(len(self[name]) for name in self.sites)
        missing = sum(self.missing(name) for name in self.sites)
        text = (
            f"{length_s:.3f} s, {count_nouns(records, 'record')}, {missing or 'none'} missing"
        )
        if self.unknown_ends:
            text += f"; {describe_unknown_ends(self.unknown_ends)}"
        if self.diverged_s is not None:
            text += f"; DIVERGED at {self.diverged_s:.3f} s"
        return text

    def to_dict(self) -> dict[str, Any]:
        """Returns a summary of the session, with the keys of `trilat sim --json`.

        The entry "sites" maps the name of each site to its summary figures. The records
        themselves are not included.
        """
        return {
            "files": list(self.sources),
            "session": dict(self.session),
            "scenario": self.scenario.name,
            "scenario_sha256": self.scenario_sha256,
            "seed": self.scenario.seed,
            "duration_s": self.scenario.duration_s,
            "complete": self.complete,
            "unknown_ends": list(self.unknown_ends),
            "diverged": [event.member for event in self.events if event.kind == "diverged"],
            "sites": {str(row.pop("site")): row for row in self.to_rows()},
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a table of the sites as plain values, with one row per site.

        A row contains the tick rate of the site, the numbers of its recorded and missing
        records, and the time of its last record in s.
        """
        rows = []
        for name, site_log in self.items():
            row = {
                "site": name,
                "rate_hz": site_log.rate_hz,
                "records": len(site_log),
                "missing": self.missing(name),
                "last_s": float(site_log.t_s[-1]) if len(site_log) else None,
            }
            rows.append(row)
        return rows

    def to_frame(self, name: str = "", kind: str = "") -> "pandas.DataFrame":
        """Returns a table of the log as a pandas data frame, for example the records of a site.

        Args:
            name: Name of the table, see `table`. If empty, the frame has one row per site.
            kind: Kind of the table, see `table`.
        """
        return self.table(name, kind).to_pandas() if name else super().to_frame()

    def plot(
        self,
        *columns: str,
        sites: str | Sequence[str] | None = None,
        joints: int | str | Sequence[int | str] | None = None,
        from_s: float | None = None,
        until_s: float | None = None,
    ) -> Any:
        """Plots the run, or selected columns of the records over time, with one line per site.

        Without arguments, the figure is the overview of the run: errors, speeds, torques and
        ages. Each column has its own panel.

        >>> log = tn.simulate("two_sites", duration_s=0.1)
        >>> figure = log.plot("q", "tau", sites="s", joints=1, from_s=0.05)
        >>> [panel.get_title() for panel in figure.axes]
        ['q1 (rad)', 'tau1 (N m)']

        Args:
            columns: Quantities such as "q", "tau", "theta_hat", "age" and "mode", the error
                "e", or single columns of `table`, such as "q1_rad" or "q1". If another argument
                is given, the default is "q", "e" and "tau".
            sites: The sites to plot. If None, all sites.
            joints: The joints to plot, by name or by number counted from 1. If None, all
                joints. Columns that do not belong to a joint are not affected.
            from_s: Start of the plotted interval, in s. If None, the start of the run.
            until_s: End of the plotted interval, in s. If None, the end of the run.

        Returns:
            A Matplotlib figure. A notebook displays it, and its method `savefig` writes it to a
            file.

        Raises:
            UnknownName: There is no such column, site or joint.
            UsageError: There are no records in the interval, or Matplotlib is not installed.
            LogError: The records cannot be read.
        """
        try:
            plot_log = find_hook("plot a log")
        except ModuleNotFoundError as error:
            raise UsageError(describe_missing_library("plot", error)) from None
        return plot_log(
            self, columns, sites=sites, joints=joints, from_s=from_s, until_s=until_s
        )

    __eq__ = object.__eq__  # logs are not compared record by record
    __hash__ = object.__hash__

    def __iter__(self) -> Iterator[str]:
        return iter(self.sites)

    def __len__(self) -> int:
        return len(self.sites)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.sites)

    def _topic(self, member: str, channel: str) -> str:
        """Returns the topic of a member's channel."""
        return "/" + topics.key(self.session["session"], member, channel)

    def _event_topics(self) -> list[str]:
        """Returns the event topics of the members that occur in the log, sorted."""
        members = (*self.sites, topics.RECORDER)
        event_topics = {self._topic(member, topics.EVENT) for member in members}
        return sorted(event_topics & self._contents.channels.keys())

    def _channel(self, topic: str) -> ChannelMessages:
        """Returns all messages of one topic of the log, for example the records of one site.

        Empty if the log does not contain the topic.
        """
        return self._contents.channels.get(topic) or ChannelMessages()

    def _decode(self, topic: str, kind: type[M]) -> list[M]:
        """Decodes the messages of a channel, skipping those that are damaged.

        Messages that cannot be decoded are removed from the channel, so that `unreadable`
        reports them only once even if the channel is decoded again. The log then counts as
        incomplete.

        Args:
            topic: Topic of the channel.
            kind: Class of the messages.

        Returns:
            The messages that can be decoded, in file order.
        """
        channel = self._channel(topic)
        readable = ChannelMessages()
        first_problem = ""
        messages: list[M] = []
        for index, payload in enumerate(channel.payloads):
            try:
                messages.append(decode(payload, kind, READABLE))
                readable.add(payload, channel.log_ns[index], channel.publish_ns[index])
            except WireError as error:
                first_problem = first_problem or str(error)
        if first_problem:
            lost_count = count_nouns(len(channel) - len(messages), "message")
            self.unreadable.append(
                f"{self.source}: {lost_count} on {topic} cannot be read: {first_problem[:200]}"
            )
            self._contents.channels[topic] = readable
            self._contents.complete = False
        return messages

    def _read_events(self, topic: str) -> list[Event]:
        """Returns the events of one process of the session, such as "lost".

        A process that is restarted numbers its events from 0 again. The starts are in the order
        in which they first appear in the file, and the events of each start in numerical order.
        """
        events = self._decode(topic, Event)
        boots = list(dict.fromkeys(event.boot for event in events))
        starts = {boot: start for start, boot in enumerate(boots)}
        return sorted(events, key=lambda event: (starts[event.boot], event.n))

    @cached_property
    def diverged_s(self) -> float | None:
        """Time at which the first arm exceeded a safety limit, which ended the run, in s.

        None if all arms stayed within their limits.
        """
        times_s = [part.diverged_s for part in self.values()]
        known_times_s = [time_s for time_s in times_s if time_s is not None]
        return min(known_times_s, default=None)

    def describe_divergence(self, site: str = "") -> str:
        """Describes for the user which joint exceeded its speed limit, by how much, and when.

        If several joints of the arm exceeded their limits, the joint with the largest ratio of
        speed to limit is described.

        Args:
            site: Name of the site whose arm diverged. If empty, the arm that diverged first.

        Returns:
            A clause such as "m1 joint 2 reached 21.3 rad/s (limit 20 rad/s) at 3.344 s". Empty
            if the arm did not diverge.
        """
        diverged_first = [name for name in self if self[name].diverged_s == self.diverged_s]
        name = site or diverged_first[0]
        diverged_s = self[name].diverged_s
        if diverged_s is None:
            return ""
        limits_rad_s = np.asarray(self.scenario.sites[name].limits.qd_limit_rad_s)
        speeds_rad_s = np.abs(self[name].qd[-1])
        limits_rad_s = np.broadcast_to(limits_rad_s, speeds_rad_s.shape)
        # argmax selects NaN if there is one, which also counts as a speed beyond every limit.
        joint = int(np.argmax(speeds_rad_s / limits_rad_s))
        speed = f"{speeds_rad_s[joint]:.3g} rad/s (limit {limits_rad_s[joint]:g} rad/s)"
        return f"{name} joint {joint + 1} reached {speed} at {diverged_s:.3f} s"

    @property
    def may_run_user_laws(self) -> bool:
        """True if all user-defined control laws of the run have permission to run.

        This permission also covers analyses that repeat the run, such as twins (copies of the
        run started with a small displacement).
        """
        return all(law.allowed for law in self.scenario.inspect_user_laws())

    @property
    def failed_hands(self) -> list[str]:
        """Sentences for reports, one for each program that failed while it moved an arm.

        Each sentence states which program failed, when, and why. Empty if no program failed.
        """
        return [
            event.text
            for event in self.events
            if event.kind == "hand" and FAILED_HAND in event.text
        ]

    def warn_of_failures(self) -> None:
        """Issues a Python warning if an arm exceeded its limits or a user's program failed.

        The program is one that moves an arm. The warning points to the line that called the
        caller of this method.
        """
        for failure in self.failed_hands:
            warnings.warn(failure, RuntimeWarning, stacklevel=3)
        if self.diverged_s is not None:
            warnings.warn(
                f"the run diverged at {self.diverged_s:.3f} s, and ends there: "
                f"{self.describe_divergence()}",
                RuntimeWarning,
                stacklevel=3,
            )

    @cached_property
    def complete(self) -> bool:
        """True if the recording was finished properly, so that its end cannot be missing.

        A recorder that crashes leaves an unfinished file. A log of several files is complete if
        all of them were finished. It is also complete if the last file was finished and no
        record is missing, since another recorder may have recorded what an unfinished file
        lacks.
        """
        if self._contents.complete or len(self.sources) == 1:
            return self._contents.complete
        has_all_records = all(
            site in self._stated_ticks and not self.missing(site) for site in self.sites
        )
        return self._contents.ended and has_all_records

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

    @property
    def executed_sites(self) -> tuple[str, ...]:
        """Names of the sites whose records can be recomputed from this file.

        These are all sites, except in an open-loop rerun, where some sites are not executed.
        The records of those sites are copied from the original log and depend on samples that
        this file does not contain.
        """
        executed = self.session.get(EXECUTED_SITES_KEY)
        if self.driver != RERUN_DRIVER or executed is None:
            return tuple(self.sites)
        return tuple(name for name in self.sites if name in executed.split())

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

    @cached_property
    def accounts(self) -> dict[str, str]:
        """Maps each topic to a line of text with its numbers of received and missing messages.

        The recorder writes these lines when it finishes a file, so the mapping is empty for an
        unfinished file. If the log consists of several files, no single file states the totals,
        so the records, statistics and events of all files are counted again. Counts without a
        topic, such as that of dropped messages, cannot be recomputed. For these, `merge` has
        added up the counts of the files.
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

        They may disagree with the contents of a damaged file.

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
            The account of the channel. None if the channel is not numbered consecutively: only
                the records and the link statistics of a site are.
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
        """Maps each site that joined while the session was running to the list of its starts.

        A start is a pair of its first tick and the random number (boot) that identifies this
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
        """Ticks that a site did not execute because its process was not running.

        This happens when a process is killed and restarted, or joins a session late. Each start
        in `starts` is preceded by a range (first tick, last tick) of such ticks. The range
        begins after the last earlier tick that is known to have been executed, from a record,
        from the "end" event of the earlier process, or because another site received the sample
        sent in that tick.
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

        The process may have started late or ended early, see `find_unexecuted_ticks`.

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

    def __getitem__(self, site: str) -> SiteLog:
        if site not in self.scenario.sites:
            raise UnknownName(
                f"there is no site {site!r} in {self.source}; the sites are "
                f"{', '.join(self.sites)}"
            )
        if site not in self._sites:
            self._sites[site] = self._read_site(site)
        return self._sites[site]

    def _read_site(self, site: str) -> SiteLog:
        """Creates the object with all records of one arm that `log[name]` returns.

        Raises:
            LogError: A tick is beyond the duration of the scenario.
        """
        channel = self._channel(self._topic(site, topics.STATE))
        site_log = SiteLog(
            name=site,
            peers=self.scenario.peers(site),
            rate_hz=self.scenario.sites[site].rate_hz,
            payloads=channel.payloads,
            source=self.source,
            times=channel.times(),
            layout=self.scenario.layout(site),
            channel=self.scenario.channel(site),
            axes=self.scenario.arms[site].axes,
        )
        ticks = self.scenario.ticks(site)
        last_tick = site_log.last_tick
        # Counts and arrays grow with the last tick, so a damaged tick number could fill the
        # memory.
        if last_tick >= ticks:
            raise LogError(
                f"{self.source}: {site} has a record of tick {last_tick}, but the scenario has "
                f"only {count_nouns(ticks, 'tick')}"
            )
        return site_log

    def changes(self, site: str) -> dict[int, list[str]]:
        """Lists the parameter changes that a site applied during the run.

        The site stores its changes in its records. If a record is missing, its changes are
        taken from the "change" events of the site.

        Args:
            site: Name of the site.

        Returns:
            Maps each tick with changes to the changes as JSON strings.
        """
        changes = self[site].changes()
        change_events = [event for event in self.events if event.kind == "change"]
        site_events = [event for event in change_events if event.member == site]
        if site_events:
            recorded = set(self[site].tick.tolist())
            for event in site_events:
                if event.ticks not in recorded:
                    changes.setdefault(event.ticks, []).append(event.command)
        return dict(sorted(changes.items()))

    def commands(self, site: str) -> dict[int, list[CoreChange]]:
        """Lists the changes that a site applied, decoded so that the run can be repeated.

        `changes` returns the same changes as JSON strings.

        Args:
            site: Name of the site.

        Returns:
            Maps each tick with changes to the changes in the form expected by `Site.step`.

        Raises:
            LogError: A JSON string is not a valid change of the scenario.
        """
        commands = {}
        try:
            for tick, texts in self.changes(site).items():
                changes = [self.scenario.parse_core_change(site, text) for text in texts]
                commands[tick] = changes
        except ScenarioError as error:
            raise LogError(f"{self.source}: {error}") from None
        return commands

    def shown(self, site: str) -> dict[str, Ints]:
        """Returns which states of the other arms the user of a site saw on the screen.

        The user usually sees the state that the control law uses. If the scenario has a table
        `[sites.NAME.view]`, the picture has its own delay, like a video stream that arrives
        later than the control signals. The user then sees the newest state that has arrived
        with that delay.

        Args:
            site: Name of the user's site.

        Returns:
            Maps each peer to the ticks of its visible states, shape (K,), with one entry per
            record of the site. The tick is -1 before the first state.
        """
        site_log = self[site]
        delayed_pictures = PictureDelay(self.scenario, site).list_shown_samples(
            site_log.last_tick + 1
        )
        shown_ticks = dict(site_log.used)
        for peer, peer_ticks in delayed_pictures.items():
            shown_ticks[peer] = np.minimum(peer_ticks[site_log.tick], self[peer].last_tick)
        return shown_ticks

    def sample_ages_ns(self, peer: str, site: str) -> Ints:
        """Computes how old the peer's sample was that a site used in each tick, in ns.

        The age exceeds the network delay if the next sample is late or lost.

        Args:
            peer: Name of the site that sent the samples.
            site: Name of the site that used them.

        Returns:
            The ages, in ns. Ticks before the first sample came into use are left out.
        """
        ages_ns = self[site].age_ns(peer, self.scenario.sites[peer].rate_hz)
        return ages_ns[self[site].used[peer] >= 0]

    def link_stats(self, site: str) -> list[LinkStats]:
        """Returns the statistics that a site published about its network links, such as losses.

        Args:
            site: Name of the site.

        Returns:
            The messages, sorted by tick. Empty if the log contains none.
        """
        return self.timed_link_stats(site).messages

    def timed_link_stats(self, site: str) -> TimedMessages[LinkStats]:
        """Returns a site's network link statistics with their sending and arrival times.

        Args:
            site: Name of the site.

        Returns:
            The messages in tick order, each with the time at which it was sent and the time at
            which it arrived at the recorder.
        """
        topic = self._topic(site, topics.LINK)
        stats = self._decode(topic, LinkStats)
        order = sorted(range(len(stats)), key=lambda n: stats[n].tick)
        log_ns, publish_ns = self._channel(topic).times()
        return TimedMessages([stats[n] for n in order], log_ns[order], publish_ns[order])

    def timed_events(self) -> TimedMessages[Event]:
        """Returns the events of all processes of the session, in order of arrival.

        An event is a notable occurrence, such as a lost connection. Each is returned with the
        time it was sent and the time it arrived at the recorder.
        """
        events: list[Event] = []
        log_times = [np.zeros(0, np.int64)]
        publish_times = [np.zeros(0, np.int64)]
        for topic in self._event_topics():
            events += self._decode(topic, Event)
            topic_log_ns, topic_publish_ns = self._channel(topic).times()
            log_times.append(topic_log_ns)
            publish_times.append(topic_publish_ns)
        log_ns = np.concatenate(log_times)
        publish_ns = np.concatenate(publish_times)
        order = np.argsort(log_ns, kind="stable")
        ordered_events = [events[n] for n in order.tolist()]
        return TimedMessages(ordered_events, log_ns[order], publish_ns[order])

    @cached_property
    def link_delays(self) -> dict[str, list[TracePoint]]:
        """Maps the name of each link, such as "m1->s", to the measured delays of its samples.

        Each delay is a pair (stamp in s, delay in ms), sorted by stamp. The stamp of a sample
        is the nominal time of the tick in which the sender computed it. The receiver stores the
        network delay of each sample in the field `rx` of its records. Delays injected by the
        scenario are not included. A negative delay results from clock errors and counts as 0.
        If a sample arrived twice, the shorter delay counts. A sample counts as sent if the
        sender has a record of its tick. A lost sample has an infinite delay. The list is empty
        if no sample arrived over the link.
        """
        delays = {}
        for site in self.sites:
            for peer in self.scenario.peers(site):
                sent_ticks = self[peer].tick.tolist() if peer in self.sites else []
                rate_hz = self.scenario.sites[peer].rate_hz
                samples = self[site].iterate_delays(peer, rate_hz, sent_ticks)
                delays[f"{peer}->{site}"] = list(samples)
        return delays

    def recorder_stats(self) -> list[RecorderStats]:
        """Decodes the statistics that the recorder published about itself while recording.

        They show, for example, how many messages of each channel were missing.

        Returns:
            The messages, in file order. Empty if the log contains none.
        """
        return self._decode(self._topic(topics.RECORDER, topics.STATS), RecorderStats)

    def table(self, name: str, kind: str = "") -> Table:
        """Returns a table of the log, such as an arm's records, with named columns and units.

        Args:
            name: Name of a site, or "events".
            kind: Kind of a site's table: "state" (the default) has one row per record, "link"
                one row per statistics message, and "arrivals" one row per sample that arrived.

        Raises:
            UnknownName: The log has no such table.
            LogError: The messages cannot be read.
        """
        if name == EVENTS_TABLE and name not in self.sites:
            return Table.of_events(self.timed_events(), self.source)
        site = self[name]
        match kind:
            case "" | "state":
                return Table.of_states(site, self.scenario)
            case "link":
                return Table.of_link_stats(site, self.timed_link_stats(name), self.source)
            case "arrivals":
                return Table.of_arrivals(site, self.source, live=self.driver == "live")
        raise UnknownName(
            f"{name} has no table {kind!r}; the tables of a site are "
            f"{', '.join(SITE_TABLE_KINDS)}"
        )

    def tables(self) -> Iterator[Table]:
        """Yields every table of the log, such as the joint angles of one arm, for exports.

        The tables of the sites come first, then the table of events. Only one table is in
        memory at a time.
        """
        for site in self.sites:
            for kind in SITE_TABLE_KINDS:
                yield self.table(site, kind)
        yield Table.of_events(self.timed_events(), self.source)

    def frame(self, name: str, kind: str = "") -> "polars.DataFrame":
        """Returns a table of the log as a polars data frame.

        For a pandas data frame, use `to_frame`.

        Args:
            name: Name of a site, or "events".
            kind: Kind of a site's table, see `table`.

        Raises:
            UsageError: polars is not installed.
        """
        return self.table(name, kind).to_data_frame()


def open_log(
    source: str | Path | BinaryIO,
    *more: str | Path | BinaryIO,
    progress: Progress | None = None,
    law: LawFiles = (),
    other_version: bool = False,
    remember: bool = False,
) -> Log:
    """Opens a log from a single file, or from several files that are parts of one session.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("run.mcap")
    >>> tn.open_log(path)["m"].t_s[-1]
    np.float64(0.099)

    Args:
        source: A path, or a binary file opened for reading.
        more: Further parts of the session, in any order.
        progress: Function that is called repeatedly with the number of bytes read and the
            total.
        law: Files of control laws that the log names and that may run when the log is executed,
            see docs/sessions/code-that-runs.md. Laws that this process has already run need no
            permission.
        other_version: True to accept files whose hashes differ from those in the log.
        remember: True to permit these laws for other logs too, if they name the same hashes and
            settings.

    Raises:
        UsageError: One of the files in `law` is not named in the log.
        LogError: A file is missing, is not an MCAP file or is not a log of trilat-net. Also
            raised if the files belong to different sessions or contain different versions of a
            message.
    """
    log = Log(read_session((source, *more), progress))
    allow_logged_code(log.scenario, law, other_version=other_version, remember=remember)
    return log


def read_link_delays(path: Path, link: str) -> list[TracePoint]:
    """Returns the measured delays of the samples of one link in a log, see `Log.link_delays`.

    Args:
        path: Path of the log.
        link: Name of the link, such as "m1->s".

    Returns:
        Pairs (stamp in s, delay in ms).

    Raises:
        OSError: The file cannot be opened.
        ValueError: The file is not a log or has no such link, or no sample arrived over the
            link.
    """
    status = path.stat()  # raises the same errors as opening the file
    links = _read_links(path, status.st_mtime_ns, status.st_size)
    if link not in links:
        hint = suggest_nearest(link, list(links)) or "."
        raise ValueError(f"has no link {link!r}{hint} The links are {', '.join(links)}")
    if not links[link]:
        raise ValueError(f"no sample arrived over {link}")
    return links[link]


@lru_cache(maxsize=1)
def _read_links(path: Path, modified_ns: int, size: int) -> dict[str, list[TracePoint]]:  # noqa: ARG001
    """Reads the measured network delays of all links of a log.

    Maps the name of each link ("m1->s") to its delays. The result for the last file is cached,
    because a scenario reads the links of a log one after another. `modified_ns` and `size` are
    only used as part of the cache key: if the file is rewritten, they change and the file is
    read again.
    """
    try:
        return open_log(path).link_delays
    except LogError as error:
        raise ValueError(str(error).removeprefix(f"{path}: ")) from None
