"""`trilat twin`: a run executed again beside twins that get a small push, and their figure."""

from pathlib import Path
from typing import Annotated

from ..reporting import terminal_output as terminal
from . import options

_PUSHED = (
    "Push a twin: m1.q1=1e-6 (rad), m1.qd1, m1.theta1, all of m1.q or of q; repeatable, a twin each. "
    "Default: as certify does."
)


def twin_command(
    files: options.LogsArgument,
    at_s: Annotated[float, options.value("--at", "S", "The instant of the push, s.")] = 0.0,
    push: Annotated[
        list[str] | None,
        options.value("--push", "WHAT=SIZE", _PUSHED, autocompletion=options.complete_sites),
    ] = None,
    delta: Annotated[
        str, options.value("--delta", "LOW:HIGH", "Sizes of one push, as in 1e-9:1e-3: a twin per decade.")
    ] = "",
    picture: Annotated[
        Path | None, options.value("-o --out --output", "FILE", "Draw a figure: .png, .svg or .pdf.")
    ] = None,
    law: options.LawFilesOption = None,
    other_version: options.OtherVersionOption = False,
    remember: options.RememberOption = False,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Executes a run again, beside twins that get a small push at an instant: it dies away, or it grows.

    Nothing of the difference is a model: the twins get the arrivals, delays, hands and changes of the run
    (docs/certificate.md, "Twins"). Exit code 0 for any growth.
    """
    from ..analysis.twin_growth import twin

    if picture is not None:
        options.check_picture(picture, force=force)
    log = terminal.open_with_progress(*files, law=law, other_version=other_version, remember=remember)
    terminal.warn_user_laws(log)
    found = twin(log, at_s, push or (), delta)
    if picture is not None:
        from ..reporting.figures.twin_differences import draw_twins
        from ..reporting.style import REPORT_DPI, write_figure

        write_figure(draw_twins(found), picture, REPORT_DPI)
    terminal.print_result(found, as_json=as_json)
    if picture is not None and not as_json:
        terminal.print_paths([picture])
