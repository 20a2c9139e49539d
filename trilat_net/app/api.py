"""Python functions for the commands that need no network.

For example, `trilat_net.simulate("paper")` runs the same simulation as `trilat sim paper` and
returns its log. Wherever a function takes a scenario (the description of an experiment), it
accepts the name of a shipped scenario, the path of a TOML file, a TOML string, a mapping of its
tables, or a `Scenario`. A log can be given as a `Log` or as the path of an MCAP file. The
functions that need a network are in other modules.

Invariant:
    - These functions only convert their arguments and call the packages that do the work.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..analysis import Certificate, LogMetrics
from ..entry_points import find_viewer
from ..errors import UsageError
from ..execution import LogCheckReport, SimulatedLog
from ..files import make_results_folder
from ..log import MIN_COVERAGE, Log, open_log
from ..scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from ..analysis import LinearAnalysis, PushedTwins
    from ..presentation import Conclusion

AnyScenario = str | Path | Mapping[str, Any] | Scenario
AnyLog = str | Path | Log
Overrides = Mapping[str, Any] | Sequence[str]


def _open(log: AnyLog) -> Log:
    """Opens a log unless it is open already, and returns it."""
    return log if isinstance(log, Log) else open_log(log)


def simulate(
    scenario: AnyScenario,
    set: Overrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    duration_s: float | None = None,
    seed: int | None = None,
) -> SimulatedLog:
    """Simulates a scenario in virtual time, as `trilat sim` does, and returns the log.

    In virtual time, a single process simulates all arms and the network as fast as possible. A
    run that diverges triggers a warning, and `log.diverged_s` holds the time of divergence.

    >>> log = tn.simulate("two_sites", duration_s=0.1)
    >>> log["m"].q.shape
    (100, 2)

    Args:
        scenario: Name of a shipped scenario, path of a TOML file, TOML string, mapping of its
            tables, or `Scenario`.
        set: Overrides of scenario settings, for example `{"control.Kd": 5}` or
            `["control.Kd=5"]`.
        duration_s: Duration of the run, in s. Default: the scenario's duration.
        seed: Random seed for message delays and losses. Default: the scenario's seed.

    Returns:
        The log, with one record per site and control period.

    Raises:
        ScenarioError: The scenario or an override is invalid.
    """
    resolved = load_scenario(scenario, set, duration_s=duration_s, seed=seed)
    log = SimulatedLog(resolved)
    log.warn_of_failures()
    return log


def export(
    log: AnyLog | Sequence[AnyLog],
    to: str,
    out: str | Path,
    *,
    force: bool = False,
    **settings: Any,
) -> Path:
    """Exports a log to a format that other tools can read, and returns the output path.

    The command `trilat log export` does the same.

    >>> tn.export(tn.simulate("two_sites", duration_s=0.1), "npz", "run.npz").name
    'run.npz'

    Args:
        log: The log, or its path. The lerobot format also accepts a list of logs, or a folder
            of logs.
        to: Format: ros2, parquet, csv, npz, mat or lerobot.
        out: Path of the output file, or of the output folder for parquet, csv and lerobot.
        force: True to replace an existing file or folder.
        settings: Format-specific settings, such as `fps=30`, `observations="plugin"` and
            `task="grasp"` for lerobot (docs/studies/lerobot.md).

    Raises:
        UsageError: The format or a setting is unknown, a required package is missing, or the
            output path already exists.
    """
    from ..presentation import Exporter

    exporter = Exporter(to, Path(out), force=force, settings=settings)
    all_logs = [log] if isinstance(log, str | Path | Log) else log
    open_already = [entry for entry in all_logs if isinstance(entry, Log)]
    paths = [entry for entry in all_logs if not isinstance(entry, Log)]
    exporter.export(*open_already, *Log.open_sessions(*paths))
    return Path(out)


def verify(
    log: AnyLog,
    *,
    virtual: bool = False,
    min_coverage: float = MIN_COVERAGE,
    resume_every: int = 0,
) -> LogCheckReport:
    """Recomputes a run from its log and checks that every computed number matches bit for bit.

    The command `trilat verify` does the same.

    >>> tn.verify(tn.simulate("two_sites", duration_s=0.1)).passed
    True

    Args:
        log: The log, or its path.
        virtual: True to also compare the log with a run in virtual time, in which a single
            process simulates all arms and the network.
        min_coverage: Minimum fraction of each site's ticks (control periods) that must be
            compared for the check to pass.
        resume_every: Interval, in ticks, at which the state of each site is restored from the
            log. This reveals any state of a user-written control law that is missing from the
            log. If 0, the state is never restored.

    Returns:
        The result of the comparison. Its property `passed` is True if all numbers match, enough
        ticks were compared, and the log has not been modified since it was written.

    Raises:
        LogError: The log cannot be read.
    """
    return LogCheckReport.of_log(
        _open(log), virtual=virtual, min_coverage=min_coverage, resume_every=resume_every
    )


def certify(
    log: AnyLog,
    *,
    min_coverage: float = MIN_COVERAGE,
    own_laws: bool = False,
    twins: int | None = None,
) -> Certificate:
    """Decides whether a recorded run was stable, as `trilat certify` does.

    The verdict is "stable", "settled", "not stable", or "open" if none of the other three could
    be established.

    >>> print(tn.certify(tn.simulate("free")).stability)
    stable

    Args:
        log: The log, or its path.
        min_coverage: Minimum fraction of each site's ticks (control periods) that must be
            assessed before the run can be called stable.
        own_laws: True to allow user-written control laws to be executed. Their code is needed
            to check the energies that a law reports, and to repeat the run.
        twins: Number of times to repeat the run with a small disturbance ("twins"), which shows
            whether disturbances grow.

    Returns:
        The verdict and the reasons for it.

    Raises:
        LogError: The log cannot be read, or contains no records of any site.
    """
    from ..analysis import certify_run

    log_of_run = _open(log)
    log_of_run.require_records()
    return certify_run(log_of_run, min_coverage=min_coverage, own_laws=own_laws, twins=twins)


def twin(
    log: AnyLog,
    at_s: float = 0.0,
    push: Mapping[str, float] | Sequence[str] = (),
    delta: str = "",
) -> "PushedTwins":
    """Repeats a recorded run with small pushes at a given time, as `trilat twin` does.

    A twin is a repeated run in which the state received a small push. The result shows how the
    difference between each twin and the run develops.

    >>> found = tn.twin(tn.simulate("two_sites", duration_s=4), at_s=1, push={"m.q1": 1e-6})
    >>> found.growth.pushes[0].rate_per_s < 0.0
    True

    Args:
        log: The log, or its path.
        at_s: Time of the pushes, in s.
        push: Size of each push, keyed by its target, as in `{"m1.q1": 1e-6}`. There is one twin
            per push. A target is a joint's angle, `m1.q1`, a joint's speed, `m1.qd1`, an
            estimate, `m1.theta1`, or several quantities in a random direction, `m1.q` or `q`.
            By default the pushes are those of `certify`. If these default pushes are made at
            0 s, the growth of their effects is judged as in `certify`.
        delta: Range of sizes for a single push, as in "1e-9:1e-3", with one twin per decade.

    Raises:
        UsageError: A target does not exist, or the time or the range of sizes is invalid.
        LogError: The log cannot be read, or its run cannot be repeated.
        CodeWithheld: The run uses a control law whose code may not be executed.
    """
    from ..analysis import PushedTwins

    return PushedTwins.of_log(_open(log), at_s, push, delta)


def metrics(log: AnyLog) -> LogMetrics:
    """Computes metrics of a run: tracking, effort, energy, force sharing and network.

    The command `trilat metrics` does the same. docs/reference/metrics.md has the formula of
    every metric.

    >>> found = tn.metrics(tn.simulate("two_sites", duration_s=0.1))
    >>> found.sites["m"]["rms_error_rad"].value > 0.0
    True

    Args:
        log: The log, or its path.

    Returns:
        The metrics of the run, of each site and of each link, with their units.

    Raises:
        LogError: The log cannot be read, or contains no records of any site.
    """
    log_of_run = _open(log)
    log_of_run.require_records()
    return LogMetrics.of_log(log_of_run)


def choose_report_folder(log: Path) -> Path:
    """Returns the default folder for the report of a log, located next to the log.

    For example, the report of "run.mcap" goes into the folder "run".

    Args:
        log: Path of the log. If it has no suffix, "-report" is appended to form the folder
            name.
    """
    return log.with_suffix("") if log.suffix else log.with_name(f"{log.name}-report")


def report(
    log: AnyLog, out: str | Path | None = None, *, force: bool = False, png: bool = False
) -> "Conclusion":
    """Writes a report of a log, with figures and a summary, as `trilat report` does.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("run.mcap")
    >>> tn.report(path, "report").passed
    True

    Args:
        log: Path of the log, or a log that was opened from a file.
        out: Folder for the report. Default: the path of the log without .mcap.
        force: True to allow a folder that is not empty.
        png: True to also save every figure as a PNG file.

    Returns:
        The result of the log checks, the stability verdict, and the paths of the files written.

    Raises:
        UsageError: The folder is not empty, or the log is not in a file.
        LogError: The log cannot be read, or contains no records of any site.
    """
    from ..presentation import conclude

    open_log_of_run = _open(log)
    open_log_of_run.require_records()
    first_file = Path(open_log_of_run.sources[0])
    if not first_file.is_file():
        raise UsageError(
            "a report needs a log in a file: save the log first, as in log.save('run.mcap')"
        )

    folder = choose_report_folder(first_file) if out is None else Path(out)
    return conclude(open_log_of_run, make_results_folder(folder, "", force=force), png=png)


def linear(
    scenario: AnyScenario | Log,
    set: Overrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    pose: Sequence[float] | None = None,
    roots: int = 6,
    over: Sequence[str] = (),
    ports: bool = True,
    operators: Sequence[str | Path] = (),
) -> "LinearAnalysis":
    """Linearises the closed loop of all arms about its equilibrium and analyses its stability.

    The analysis covers the characteristic roots, the stability margins, passivity, and the
    impedances that operators feel. The command `trilat linear` does the same.

    >>> tn.linear("p_d_margin", {"control.d": 0.9}, ports=False).verdict
    'unstable'

    Args:
        scenario: Name of a shipped scenario, path of a TOML file, TOML string, mapping of its
            tables, `Scenario`, or log. For a log, the loop is analysed as it was at the end of
            the run, after all commands.
        set: Overrides of scenario settings, for example `{"control.d": 0.9}`.
        pose: Joint angles, in rad, of an equilibrium that all arms share. Default: the
            equilibrium nearest to the end of the run.
        roots: Number of characteristic roots to compute (the complex exponents of the loop's
            modes).
        over: Ranges of settings to search for stability boundaries (values at which the
            stability changes), for example `["control.d=0.1:3"]`.
        ports: True to analyse passivity and the impedances that operators feel.
        operators: Paths of measured operator models, written by `trilat identify hand --json`.

    Returns:
        The analysis, including its verdict.

    Raises:
        ScenarioError: The scenario is invalid, or cannot be linearised.
        UsageError: Another argument is invalid.
    """
    from ..analysis import LinearAnalysis

    try:
        angles = None if pose is None else tuple(map(float, pose))
    except (TypeError, ValueError):
        raise UsageError(
            f"a pose must consist of angles in rad, as in (0.1, 0.3), but is {pose!r}"
        ) from None

    source: Scenario | Log = load_scenario(scenario, set)
    if isinstance(scenario, Log) and not set:
        source = scenario
    return LinearAnalysis.compute(
        source,
        pose=angles,
        roots=roots,
        over=over,
        ports=ports,
        operators=operators,
    )


def view(
    *files: str | Path,
    full: bool = False,
    save: str | Path | None = None,
    foxglove: bool = False,
    rviz: bool = False,
    viewer: str | None = None,
) -> None:
    """Opens a log in the Rerun viewer, as `trilat log view` does.

    Blocks until the viewer is closed.

    >>> tn.view("run.mcap")  # doctest: +SKIP

    Args:
        files: Path of the log, or the paths of its parts.
        full: True to show the record of every control period, False to show an evenly spaced
            subset.
        save: Path of a Rerun file to write instead of opening the viewer.
        foxglove: True to write a layout for Foxglove and Lichtblick next to the log
            (run.foxglove.json) instead of opening Rerun.
        rviz: True to write an RViz configuration for the session's ROS 2 topics next to the log
            (run.rviz) instead of opening Rerun.
        viewer: Name of a viewer, provided by another package, to open instead of Rerun.

    Raises:
        UsageError: Rerun is not installed, there is no display, an output file already exists,
            or the viewer is unknown.
        LogError: The log cannot be read.
    """
    from ..log.ros2 import write_rviz_config
    from ..presentation import ViewerOptions, open_rerun, write_foxglove_layout

    paths = [Path(file) for file in files]
    if viewer is not None:
        if full or save is not None or foxglove or rviz:
            raise UsageError("viewer cannot be combined with full, save, foxglove or rviz")
        find_viewer(viewer)(paths)
        return

    if foxglove or rviz:
        if full or save is not None:
            raise UsageError("foxglove and rviz cannot be combined with full or save")
        if foxglove:
            print(write_foxglove_layout(paths[0]))
        if rviz:
            print(write_rviz_config(paths[0]))
        return

    save_path = None if save is None else Path(save)
    viewer_options = ViewerOptions(full=full, web=False, save=save_path)
    open_rerun(paths, lambda: open_log(*paths), viewer_options, print)
