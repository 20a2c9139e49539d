"""`trilat rerun`: executes sites of a log again with changed settings and prints the effect."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from ..reporting.text_table import TextTable
from . import options

if TYPE_CHECKING:
    from ..execution.rerun import LinkEffect, LogAndRerun, Rerun


def rerun_command(
    files: options.LogsArgument,
    replace: Annotated[
        list[str] | None,
        typer.Option("--replace", metavar="SITE", help="Execute this site again; repeatable."),
    ] = None,
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="Execute all sites, over the network of the log.")
    ] = False,
    overrides: options.SetOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write the result as a log.")
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Executes sites of a log again with changed settings, and compares the result with the log.

    Without --closed-loop the other sites stay as recorded and do not react.
    """
    from ..execution.rerun import rerun

    if output is not None:
        _check_output(output, files, force=force)
    log = terminal.open_with_progress(*files)
    terminal.warn_user_laws(log, needed=False)  # another law may take its place
    with terminal.progress_bar("executing") as progress:
        again = rerun(log, replace or [], overrides or [], closed_loop=closed_loop, progress=progress)
    if output is not None:
        again.save(output, force=force)
    if as_json:
        terminal.print_json({**again.to_json(), "file": str(output) if output else None})
    else:
        _show(again, output)
    if again.diverged or again.broken:
        raise typer.Exit(1)


def _check_output(output: Path, files: list[Path], *, force: bool) -> None:
    """Refuses a file that may not be written, before anything is executed."""
    from ..files import refuse_existing
    from ..log.log_layout import active_path

    if any(output.exists() and file.exists() and output.samefile(file) for file in files):
        raise UsageError(f"{output}: is the log itself; choose another name")
    refuse_existing(output, force=force, unfinished=active_path(output))


def _show(again: "Rerun", output: Path | None) -> None:
    from ..execution.rerun_request import describe_rerun_changes

    asked = again.request
    others = f"; {', '.join(asked.recorded)} as recorded" if asked.recorded else ""
    terminal.print_text(f"{asked.mode}: {', '.join(asked.replaced)} executed afresh{others}")
    for line in describe_rerun_changes(asked) or ["nothing is changed: this is the experiment of the log"]:
        terminal.print_text(f"  {line}")
    terminal.print_table(_tabulate_sites(again))
    for line in _lines(again):
        terminal.print_text(line)
    for note in again.notes:
        terminal.print_text(f"note: {note}")
    if output is not None:
        terminal.print_paths([output])


def _tabulate_sites(again: "Rerun") -> TextTable:
    headers = ("ticks", "identical", "rms e rad", "here", "max e rad", "here", "max tau N m", "here")
    rows = []
    for effect in again.sites.values():
        figures = (effect.error_rms_rad, effect.error_max_rad, effect.torque_max_nm)
        cells = [cell for pair in figures for cell in _cells(pair)]
        rows.append([effect.site, str(effect.executed), str(effect.identical), *cells])
    return TextTable(("site", *headers), rows, align="lr")


def _cells(pair: "LogAndRerun | None") -> list[str]:
    return ["", ""] if pair is None else [f"{value:#.3g}" for value in pair]


def _lines(again: "Rerun") -> list[str]:
    """Returns the other effects on sites and links, a sentence each."""
    lines = []
    for effect in again.sites.values():
        if effect.q_max_rad:
            most, at_s, rms = effect.q_max_rad, effect.q_max_at_s, effect.q_rms_rad
            lines.append(
                f"{effect.site}: q is up to {most:.3g} rad off the log, at {at_s:.3f} s; {rms:.3g} rad rms"
            )
        if effect.first is not None:
            first = effect.first
            at_s = first.tick / again.request.scenario.sites[effect.site].rate_hz
            was, now = _values(first.logged, first.computed)
            where = f"tick {first.tick} ({at_s:.3f} s)"
            lines.append(
                f"{effect.site}: the first difference is at {where}: {first.field} was {was}, is {now}"
            )
        if effect.diverged_at_s is not None:
            lines.append(f"{effect.site}: diverged at {effect.diverged_at_s:.3f} s and ends there")
    return lines + [_link_line(link) for link in again.links.values() if link.differs]


def _values(before: object, after: object) -> tuple[str, str]:
    """Returns two values, with as many digits as tell them apart."""
    short = tuple(f"{value:.6g}" if isinstance(value, float) else str(value) for value in (before, after))
    return (short[0], short[1]) if short[0] != short[1] else (repr(before), repr(after))


def _link_line(link: "LinkEffect") -> str:
    mean, largest = link.age_mean_ms, link.age_max_ms
    before, after = (
        f"{a:.4g} ms old on average, {b:.4g} ms at most" for a, b in zip(mean, largest, strict=True)
    )
    return f"link {link.link}: samples in use were {before}; are {after}"
