"""Registry of all figures of a log, drawn by name for a paper or written with the report.

    trilat_net.figure(log, "settling").savefig("settling.pdf")

Invariant: a figure is a function of a log and a figure size; equal logs give equal bytes.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ...analysis.certificate.observed_energy import ObservedEnergy, observe_energies
from ...analysis.certificate.premises import check_scenario_premises
from ...analysis.certificate.stability_certificate import certify
from ...analysis.run_end import classify_log_end
from ...analysis.site_signals import sites_with_operator
from ...analysis.twin_growth import PushedTwins, TwinGrowth, measure_twins
from ...errors import UsageError
from ...execution.log_inputs import explain_no_repetition
from ...files import make_folder, refuse_existing
from ...log.log_reader import Log, open_log
from ...log.mcap_reader import Progress
from ...scenario.law_consent import find_user_laws
from ..figure_size import COLUMN_IN, REPORT_SIZE, FigureSize, make_print_size
from ..style import FIGURE_FORMATS, write_figure
from . import joint_motion
from .age_and_lateness import (
    draw_delay_distributions,
    draw_loop_timing,
    draw_sample_age,
    explain_missing_loop_times,
    has_varying_delay,
)
from .arm_poses import draw_arms
from .certificate_energy import draw_functional, draw_observed_energy
from .run_overview import draw_overlay, draw_overview
from .twin_differences import draw_twins

NO_OPERATOR = "no site has an operator in this run"

Draw = Callable[[Log, FigureSize], Figure]
Absent = Callable[[Log], str]


class FigureEntry(NamedTuple):
    """A figure: what is in it, what draws it, and what returns why a log has nothing to show in it, or ""."""

    about: str
    draw: Draw
    absent: Absent = lambda _: ""
    in_report: bool = False


def _unless(shows: Callable[[Log], object], reason: str) -> Absent:
    return lambda log: "" if shows(log) else reason


explain_absent_operator = _unless(sites_with_operator, NO_OPERATOR)
"""Returns why there is no torque of an operator to draw; "" if there is one."""


def _explain_no_twin(log: Log) -> str:
    """Returns why there is no run without operators, which runs the laws of the log."""
    withheld = (str(law) for law in find_user_laws(log.scenario) if not law.allowed)
    return next(withheld, "") if any(site.hands for site in log.scenario.sites.values()) else NO_OPERATOR


def _no_functional(log: Log) -> str:
    law = check_scenario_premises(log.scenario)[0]
    return "" if law.holds else law.text


def _observed_energy(log: Log) -> ObservedEnergy | None:
    found = observe_energies(log)
    return found if found is not None and found.curves else None


def _draw_observed(log: Log, form: FigureSize) -> Figure:
    found = observe_energies(log)
    assert found is not None
    return draw_observed_energy(log, found, form)


def _learns(log: Log) -> bool:
    return any(len(log[site]) and np.ptp(log[site].theta_hat, axis=0).any() for site in log.sites)


_ReportEntry = partial(FigureEntry, in_report=True)

FIGURES = {
    "overview": FigureEntry("errors, speeds, torques and ages of a run at a glance", draw_overview),
    "operation": FigureEntry(
        "torque on the arms above their angles", joint_motion.draw_operation, explain_absent_operator
    ),
    "operator_torques": _ReportEntry(
        "torque on the arms (Fig. 3)", joint_motion.draw_operator_torques, explain_absent_operator
    ),
    "positions": _ReportEntry("actual and desired angles (Fig. 4)", joint_motion.draw_positions),
    "tracking_errors": _ReportEntry(
        "errors, and the largest one still to come (Fig. 5)",
        joint_motion.draw_tracking_errors,
    ),
    "settling": FigureEntry("size of the errors on a log axis, settling times", joint_motion.draw_settling),
    "phase": FigureEntry("errors against their rates", joint_motion.draw_phase_portrait),
    "parameter_estimates": _ReportEntry(
        "estimates and true values (Fig. 6)",
        joint_motion.draw_parameter_estimates,
        _unless(_learns, "no estimate changed in this run"),
    ),
    "control_torques": FigureEntry("torque of the controllers", joint_motion.draw_control_torques),
    "hands_moved": _ReportEntry(
        "the log minus the same run without operators",
        joint_motion.draw_operator_displacement,
        _explain_no_twin,
    ),
    "contact": FigureEntry(
        "force of the walls, and depth in them",
        joint_motion.draw_contact,
        _unless(joint_motion.sites_with_walls, "no site has a wall in this run"),
    ),
    "authority": FigureEntry(
        "shares that change, and the motion of the arms",
        joint_motion.draw_authority,
        _unless(joint_motion.sites_with_changing_dominance, "the shares of all sites are constant"),
    ),
    "certificate": _ReportEntry(
        "V, its parts, who changed it, the energy balance",
        lambda log, form: draw_functional(log, certify(log), form),
        _no_functional,
    ),
    "observed_energy": _ReportEntry(
        "energies that the control laws declare: lines, observers, tanks",
        _draw_observed,
        _unless(_observed_energy, "the laws of this run declare no energies"),
    ),
    "twins": _ReportEntry(
        "what became of small pushes of the run",
        lambda log, form: draw_twins(PushedTwins(log, 0.0, measure_twins(log, classify_log_end(log))), form),
        explain_no_repetition,
    ),
    "arms": _ReportEntry("the arms at a few instants", draw_arms),
    "paths": _ReportEntry(
        "paths of the end effectors in three planes",
        joint_motion.draw_end_effector_paths,
        _unless(lambda log: all(arm.chain for arm in log.scenario.arms.values()), "its arms are planar"),
    ),
    "sample_age": _ReportEntry("age of the samples in use, per link", draw_sample_age),
    "delay_distributions": _ReportEntry(
        "distributions of delays and ages",
        draw_delay_distributions,
        _unless(has_varying_delay, "every link is stated as one constant delay"),
    ),
    "loop_timing": _ReportEntry(
        "lateness and computing time of the loops", draw_loop_timing, explain_missing_loop_times
    ),
}
"""By name, in the order in which a paper has them."""


def figure(log: str | Path | Log, name: str, width_in: float = COLUMN_IN) -> Figure:
    """Returns a figure of a log for a paper, one of `FIGURES`: 3.5 or 7 in wide, type 8 pt.

    The command is `trilat figure`.

    >>> drawn = tn.figure(tn.simulate("two_sites", duration_s=0.1), "positions")
    >>> drawn.savefig("positions.pdf")

    Raises:
        UsageError: there is no such figure or width, or the log has nothing to show in it.
    """
    form = make_print_size(width_in)
    opened = log if isinstance(log, Log) else open_log(log)
    return _find_figure(opened, name).draw(opened, form)


def list_drawable_figures(log: Log) -> list[str]:
    """Returns the names of the figures for which a log has something to show."""
    return [name for name, entry in FIGURES.items() if not entry.absent(log)]


def write_figures(
    log: Log,
    folder: Path,
    names: Sequence[str] = (),
    *,
    width_in: float = COLUMN_IN,
    formats: Sequence[str] = FIGURE_FORMATS[:2],
    force: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Writes figures of a log into a folder, which is made if it does not exist, and returns the paths.

    Without names these are all for which the log has something to show. They are 3.5 or 7 in wide;
    `progress` is called with the number of figures that are drawn, and of all.

    Raises:
        UsageError: there is no such figure, width or format, the log has nothing to show in it, or a file
            exists.
    """
    form, wanted = make_print_size(width_in), list(dict.fromkeys(names)) or list_drawable_figures(log)
    kinds = _check_formats(formats)
    chosen = {name: partial(_find_figure(log, name).draw, log, form) for name in wanted}
    _refuse_figures(folder, chosen, kinds, force=force)
    return _write(chosen, folder, form, kinds, progress)


def write_overlay(
    logs: Mapping[str, Log],
    folder: Path,
    *,
    width_in: float = COLUMN_IN,
    formats: Sequence[str] = FIGURE_FORMATS[:2],
    force: bool = False,
) -> list[Path]:
    """Writes several logs over one another, by their names in the legend, as overlay.pdf and so on.

    Raises:
        UsageError: there is no such width or format, the logs differ in kind, or a file exists.
    """
    form, kinds = make_print_size(width_in), _check_formats(formats)
    chosen = {"overlay": partial(draw_overlay, logs, form)}
    _refuse_figures(folder, chosen, kinds, force=force)
    return _write(chosen, folder, form, kinds)


def _refuse_figures(folder: Path, names: Iterable[str], kinds: Sequence[str], *, force: bool) -> None:
    for path in (folder / f"{name}.{kind}" for name in names for kind in kinds):
        refuse_existing(path, force=force)


def _check_formats(formats: Sequence[str]) -> list[str]:
    kinds = list(dict.fromkeys(formats))
    for kind in kinds:
        if kind not in FIGURE_FORMATS:
            raise UsageError(f"a figure is written as {', '.join(FIGURE_FORMATS)}, not as {kind!r}")
    return kinds


def write_report_figures(
    log: Log,
    folder: Path,
    twin: Log | None,
    progress: Progress | None = None,
    pushed: TwinGrowth | None = None,
) -> list[Path]:
    """Writes the figures of the report for which a log has something to show, and returns the paths.

    Earlier figures in the folder are replaced. Without `twin`, the same experiment without operators,
    `hands_moved` is left out. Twins that are given are not made again.
    """
    chosen: dict[str, Callable[[], Figure]] = {
        name: partial(FIGURES[name].draw, log, REPORT_SIZE)
        for name in list_drawable_figures(log)
        if FIGURES[name].in_report
    }
    if twin is None:
        chosen.pop("hands_moved", None)
    else:
        chosen["hands_moved"] = partial(joint_motion.draw_operator_displacement, log, twin=twin)
    if pushed is not None and "twins" in chosen:
        chosen["twins"] = partial(draw_twins, PushedTwins(log, 0.0, pushed))
    return _write(chosen, folder, REPORT_SIZE, ["png"], progress)


def _write(
    chosen: Mapping[str, Callable[[], Figure]],
    folder: Path,
    form: FigureSize,
    kinds: Sequence[str],
    progress: Progress | None = None,
) -> list[Path]:
    paths = []
    for n, (name, draw) in enumerate(chosen.items()):
        if progress is not None:
            progress(n, len(chosen))
        drawn = draw()
        make_folder(folder)
        for kind in kinds:
            paths.append(folder / f"{name}.{kind}")
            write_figure(drawn, paths[-1], form.dpi)
    return paths


def _find_figure(log: Log, name: str) -> FigureEntry:
    if name not in FIGURES:
        near = get_close_matches(name, FIGURES, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(FIGURES)}"
        raise UsageError(f"no figure {name!r}; {hint}")
    if why := FIGURES[name].absent(log):
        raise UsageError(f"{name}: nothing to show: {why}")
    return FIGURES[name]
