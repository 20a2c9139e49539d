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
    - Files of every released schema version can be opened.
    - A sample counts as lost only if there is a record of every tick in which it could have
      arrived, up to the longest delay of the link. Samples whose arrival is unknown are left
      out.
"""

import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from ..errors import LogError, UnknownName, UsageError, count_nouns, suggest_nearest
from ..hooks import find_hook
from ..own_code import LawFiles, allow_logged_code
from ..package_names import describe_missing_library
from ..results import Result
from ..scenario import FAILED_HAND, PictureDelay, TracePoint
from .accounted_log import AccountedLog
from .accounting import describe_unknown_ends
from .data_tables import EVENTS_TABLE, SITE_TABLE_KINDS, Table
from .log_contents import LogContents
from .mcap_reader import Progress
from .record_columns import Ints

if TYPE_CHECKING:
    import pandas
    import polars


class Log(Result, AccountedLog):
    """A recorded session: a mapping from the name of each site to its records.

    For example, `log["m1"].q` contains the joint angles of the arm m1. Logs are created by
    `open_log`, from one file or from several files of one session.

    Args:
        contents: Contents of the file, or of all files together.

    Attributes:
        source: Name of the file. For several files, the name of the first and their number.
        sources: Names of the files, in the order of their messages.
        session: Metadata of the session: driver, seed, start time, versions, commit,
            fingerprint.
        driver: How the session ran: "live", "virtual" (simulated time) or "rerun".
        scenario: The scenario that was run.
        scenario_text: Text of the scenario, as stored in the file.
        scenario_sha256: SHA-256 hash of that text.
        sites: Names of the sites, in scenario order.
        events: Events of all members, grouped by member, in the order of their numbers.
        damaged: One sentence for each part of the file that cannot be read.
        chain: Result of comparing the contents with the digests stored in the file. For several
            files, the worst result.
        unreadable: One sentence for each channel with messages that cannot be decoded.

    Raises:
        LogError: The scenario cannot be read.
    """

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
        return [cls(contents) for contents in LogContents.of_sessions(files, progress)]

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
        """Raises LogError if the log contains no records, so that nothing can be evaluated.

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
        """Returns a summary of the session, with the same keys as `trilat sim --json`.

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

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.sites)

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
        """Issues Python warnings if an arm diverged, or if a program that moves an arm failed.

        Python reports the warnings for the line of code that called the caller of this method.
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
        """Computes the age of the peer's sample that a site used in each tick, in ns.

        The age exceeds the network delay if the next sample is late or lost.

        Args:
            peer: Name of the site that sent the samples.
            site: Name of the site that used them.

        Returns:
            The ages, in ns. Ticks before the site used its first sample are left out.
        """
        ages_ns = self[site].age_ns(peer, self.scenario.sites[peer].rate_hz)
        return ages_ns[self[site].used[peer] >= 0]

    @cached_property
    def link_delays(self) -> dict[str, list[TracePoint]]:
        """Maps the name of each link, such as "m1->s", to the measured delays of its samples.

        The delays of a link are a list of pairs (stamp in s, delay in ms), sorted by stamp. The
        stamp of a sample is the nominal time of the tick in which the sender computed it. The
        receiver stores the network delay of each sample in the field `rx` of its records.
        Delays injected by the scenario are not included. A negative delay results from clock
        errors and counts as 0. If a sample arrived twice, the shorter delay counts. A sample
        counts as sent if the log contains the sender's record of its tick. If such a sample
        never arrived, its delay is infinite. The list is empty if no sample arrived over the
        link.
        """
        delays = {}
        for site in self.sites:
            for peer in self.scenario.peers(site):
                sent_ticks = self[peer].tick.tolist() if peer in self.sites else []
                rate_hz = self.scenario.sites[peer].rate_hz
                samples = self[site].iterate_delays(peer, rate_hz, sent_ticks)
                delays[f"{peer}->{site}"] = list(samples)
        return delays

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
        law: Files of control laws that the log names and that are permitted to run, see
            docs/sessions/code-that-runs.md. Laws that this process has already run need no
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
    log = Log(LogContents.of_session((source, *more), progress))
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
