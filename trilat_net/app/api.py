"""The Python functions of the commands that need no network.

For example, `trilat_net.simulate("paper")` does what `trilat sim paper` does, and returns the
log of the run. Each function accepts a scenario (the description of an experiment) in any form:
the name of a shipped scenario, the path of a TOML file, a TOML text, its tables, or a
`Scenario`. A log is the path of an MCAP file, or a `Log`. Functions that need a network are in
other modules.

Invariant:
    - These functions only convert their arguments, and call the packages that do the work.
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
    from ..analysis import LinearAnalysis
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
    """Runs a scenario in virtual time and returns its log; the command is `trilat sim`.

    In virtual time, one process computes all arms and the network, as fast as possible. The
    function warns if the run diverged. The time of divergence is then in `log.diverged_s`.

    >>> log = tn.simulate("two_sites", duration_s=0.1)
    >>> log["m"].q.shape
    (100, 2)

    Args:
        scenario: The scenario, which describes the experiment: the name of a shipped scenario,
            a path, a TOML text, its tables, or a `Scenario`.
        set: Settings that replace those of the scenario ("overrides"), as in
            `{"control.Kd": 5}` or `["control.Kd=5"]`.
        duration_s: Duration of the run, in s. Default: the scenario's duration.
        seed: Seed of the random delays and losses of messages. Default: the scenario's seed.

    Returns:
        The log, which contains one record per control period and site.

    Raises:
        ScenarioError: The scenario or an override is not valid.
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
    """Exports a log to files that other tools can read, and returns their path.

    The command is `trilat log export`.

    >>> tn.export(tn.simulate("two_sites", duration_s=0.1), "npz", "run.npz").name
    'run.npz'

    Args:
        log: The log, or its path. The format lerobot also accepts several logs, or a folder of
            logs.
        to: Format: ros2, parquet, csv, npz, mat or lerobot.
        out: Path of the file, or of the folder for parquet, csv and lerobot.
        force: True to replace an existing file or folder.
        settings: Settings of the format, such as `fps=30`, `observations="plugin"` and
            `task="grasp"` for lerobot (docs/studies/lerobot.md).

    Raises:
        UsageError: There is no such format or setting, a package is missing, or the path
            exists.
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
    """Executes a run again from its log, and compares all computed numbers bit for bit.

    The command is `trilat verify`.

    >>> tn.verify(tn.simulate("two_sites", duration_s=0.1)).passed
    True

    Args:
        log: The log, or its path.
        virtual: True to compare the log also with a run in virtual time, in which one process
            computes all arms and the network.
        min_coverage: Smallest fraction of the ticks (control periods) of each site that must be
            compared for the check to pass.
        resume_every: Number of ticks after which the state of each site is restored from the
            log, again and again. This reveals state of a user's control law that the log lacks.
            If 0, the state is never restored.

    Returns:
        The result of the comparison. Its property `passed` is True if all numbers are equal, if
        enough ticks were compared, and if the log is unchanged since it was written.

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
    """Judges whether a recorded run is stable; the command is `trilat certify`.

    The judgement is "stable", "not stable", or "open" if neither can be shown.

    >>> print(tn.certify(tn.simulate("free")).stability)
    stable

    Args:
        log: The log, or its path.
        min_coverage: Smallest fraction of the ticks (control periods) of each site that must be
            judged before the run can be called stable.
        own_laws: True if the code of a user's control laws may be executed. The code is needed
            to check the energies that a law reports, and to repeat the run.
        twins: Number of repetitions of the run with a small disturbance ("twins"). They show
            whether disturbances grow.

    Returns:
        The judgement with its reasons.

    Raises:
        LogError: The log cannot be read, or no site has a record in it.
    """
    from ..analysis import certify_run

    log_of_run = _open(log)
    log_of_run.require_records()
    return certify_run(log_of_run, min_coverage=min_coverage, own_laws=own_laws, twins=twins)


def metrics(log: AnyLog) -> LogMetrics:
    """Computes the metrics of tracking, effort, energy, force sharing and the network of a run.

    The command is `trilat metrics`. docs/reference/metrics.md has the formula of every metric.

    >>> found = tn.metrics(tn.simulate("two_sites", duration_s=0.1))
    >>> found.sites["m"]["rms_error_rad"].value > 0.0
    True

    Args:
        log: The log, or its path.

    Returns:
        The metrics of the run, of each site and of each link, with their units.

    Raises:
        LogError: The log cannot be read, or no site has a record in it.
    """
    log_of_run = _open(log)
    log_of_run.require_records()
    return LogMetrics.of_log(log_of_run)


def choose_report_folder(log: Path) -> Path:
    """Returns the folder in which the report of a log is stored, next to the log.

    For example, the report of "run.mcap" is in the folder "run".

    Args:
        log: File of the log. If its name has no suffix, the folder's name ends in "-report".
    """
    return log.with_suffix("") if log.suffix else log.with_name(f"{log.name}-report")


def report(
    log: AnyLog, out: str | Path | None = None, *, force: bool = False, png: bool = False
) -> "Conclusion":
    """Writes a report of a log, with figures and a summary; the command is `trilat report`.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("run.mcap")
    >>> tn.report(path, "report").passed
    True

    Args:
        log: Path of the log, or a log that was opened from a file.
        out: Folder of the report. By default the name of the file without .mcap.
        force: True to use a folder that is not empty.
        png: True to write every figure as a PNG file too.

    Returns:
        The conclusion of the report: the checks of the log, the judgement whether the run was
        stable, and the paths of the files.

    Raises:
        UsageError: The folder is not empty, or the log is not in a file.
        LogError: The log cannot be read, or no site has a record in it.
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
    """Linearises the closed loop of all arms about its equilibrium, and analyses it.

    The analysis contains the characteristic roots, the margins to instability, the passivity,
    and the impedances that operators feel. The command is `trilat linear`.

    >>> tn.linear("p_d_margin", {"control.d": 0.9}, ports=False).verdict
    'unstable'

    Args:
        scenario: The scenario, which describes the experiment: the name of a shipped scenario,
            a path, a TOML text, its tables, or a `Scenario`. For a log, the loop is analysed as
            it was at the end of the run, after all commands.
        set: Settings that replace those of the scenario, as in `{"control.d": 0.9}`.
        pose: Joint angles of all sites, in rad. Default: the angles at the end of a run.
        roots: Number of characteristic roots to compute. The roots are the exponents of the
            loop's motions.
        over: Ranges of settings in which to search for edges of stability (values at which the
            stability changes), as in `["control.d=0.1:3"]`.
        ports: True to analyse passivity and the impedances that operators feel.
        operators: Files of measured operators, from `trilat identify hand --json`.

    Returns:
        The analysis, with its verdict.

    Raises:
        ScenarioError: The scenario is not valid, or has no linear loop.
        UsageError: Another argument is not valid.
    """
    from ..analysis import analyse_linear_loop

    try:
        angles = None if pose is None else tuple(map(float, pose))
    except (TypeError, ValueError):
        raise UsageError(
            f"a pose must consist of angles in rad, as in (0.1, 0.3), but is {pose!r}"
        ) from None

    source: Scenario | Log = load_scenario(scenario, set)
    if isinstance(scenario, Log) and not set:
        source = scenario
    return analyse_linear_loop(
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
    """Opens a log in the viewer Rerun; the command is `trilat log view`.

    The function returns when the viewer is closed.

    >>> tn.view("run.mcap")  # doctest: +SKIP

    Args:
        files: Path of the log, or paths of its parts.
        full: True to show the record of every control period, False to show fewer, evenly
            spaced records.
        save: Path of a Rerun file to write instead of opening the viewer.
        foxglove: True to write a layout for the viewers Foxglove and Lichtblick beside the log,
            as run.foxglove.json, instead of opening Rerun.
        rviz: True to write a configuration of RViz for the ROS 2 topics of the session beside
            the log, as run.rviz, instead of opening Rerun.
        viewer: Name of a viewer, added by another package, that opens the log instead of Rerun.

    Raises:
        UsageError: Rerun is not installed, there is no display, a file exists, or there is no
            such viewer.
        LogError: The log cannot be read.
    """
    from ..log.ros2 import write_rviz_config
    from ..presentation import (
        ViewerOptions,
        open_rerun,
        write_foxglove_layout,
    )

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
