"""`trilat log`: info, check, sign, recover, export, view. None of them executes the log."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..reporting import terminal_output as terminal
from ..reporting.overview_tables import print_overview
from ..reporting.text_table import TextTable
from . import options

if TYPE_CHECKING:
    from ..log.recover import Recovery
    from ..log.session_check import LogCheckResult


_MAX_PLACES = 10
"""Places of a failed check that are printed; the JSON has all."""
_MAX_LOSSES = 10
"""Losses that are printed."""
_LOSSY_EXIT_CODE = 3


def log_info_command(files: options.LogsArgument, as_json: options.JsonOption = False) -> None:
    """Prints the contents of a log: session, sites, links and channels, and missing records."""
    from ..analysis.file_overview import describe_files

    with terminal.progress_bar(f"reading {files[0]}") as progress:
        facts = describe_files(files, progress)
    if as_json:
        terminal.print_json(facts)
        return
    print_overview(facts)
    for path in files:
        terminal.warn_if_unfinished(path)


def log_check_command(
    files: options.LogsArgument,
    key: Annotated[
        Path | None,
        typer.Option("--key", metavar="PUB", help="Check FILE.sig by this public key, too."),
    ] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Checks that a log is well-formed, complete and consistent; executes nothing.

    Exit code 0: sound; 1: not; 2: no such file. Files of other programs: structure only.
    """
    from ..log.session_check import check_log

    with terminal.progress_bar(f"checking {files[0]}") as progress:
        found = check_log(files, progress)
    if key is not None:
        from ..log.log_signature import check_signatures

        with terminal.progress_bar(f"checking the signature of {files[0]}") as progress:
            found.findings.append(check_signatures(files, key, progress))
    if as_json:
        checks = [{**one._asdict(), "places": [at._asdict() for at in one.places]} for one in found.findings]
        facts = {"files": [str(path) for path in files], "kind": "trilat" if found.ours else "mcap"}
        terminal.print_json({**facts, "sound": found.passed, "checks": checks})
    else:
        _print_check(files, found)
    if not found.passed:
        raise typer.Exit(1)


def _print_check(files: list[Path], found: "LogCheckResult") -> None:
    for finding in found.findings:
        terminal.print_check(finding.passed, f"{finding.check:<9}  {finding.text}")
        if finding.wrong == 1 and str(finding.places[0]) in finding.text:
            continue
        for place in finding.places[:_MAX_PLACES]:
            where = f"{place.file}: " if len(files) > 1 and place.file else ""
            terminal.print_text(f"       {where}{place}")
        if finding.wrong > _MAX_PLACES:
            terminal.out.print(
                f"       and {finding.wrong - _MAX_PLACES} more; --json names {len(finding.places)}"
            )
    if not found.ours:
        terminal.print_note("this is no log of trilat-net: only its structure was checked")
    for path in files:
        terminal.warn_if_unfinished(path)


def log_sign_command(
    file: options.LogArgument,
    key: Annotated[
        Path, typer.Option("--key", metavar="KEY", help="Private key, as trilat keys pair makes one.")
    ],
    force: options.ForceOption = False,
) -> None:
    """Signs a finished log with Ed25519: writes FILE.sig, and leaves FILE as it is.

    What is signed is its digest chain: all messages and all that describes them. Whoever has the public key
    checks it with: trilat log check FILE --key PUB
    """
    from ..log.log_signature import sign_log

    with terminal.progress_bar(f"reading {file}") as progress:
        made = sign_log(file, key, force=force, progress=progress)
    terminal.print_text(f"{made}: signs {file}")


def log_recover_command(
    file: options.LogArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="OUT", help="Default: FILE without .active, or FILE.recovered.mcap."
        ),
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Makes a whole file of a torn or damaged one, which stays as it is.

    Works on every MCAP file. Exit code 0: nothing was lost; 3: something was lost, and is listed; 1: nothing
    could be recovered.
    """
    from ..log.recover import recover_log

    with terminal.progress_bar(f"reading {file}") as progress:
        result = recover_log(file, output, force=force, progress=progress)
    if as_json:
        terminal.print_json(_recovery_json(result))
    else:
        _print_recovery(result)
    if not result.lossless:
        raise typer.Exit(_LOSSY_EXIT_CODE)


def _recovery_json(result: "Recovery") -> dict[str, object]:
    return {
        "file": str(result.path),
        "output": str(result.output),
        "finished": result.finished,
        "lossless": result.lossless,
        "messages": result.messages,
        "records": result.coverage.judged,
        "duration_s": result.duration_s,
        "salvaged_messages": result.salvaged,
        "lost_bytes": result.lost_bytes,
        "lost": result.lost,
        "missing": result.missing,
        "coverage": {
            site: {"records": there, "ticks": ticks}
            for site, (there, ticks) in result.coverage.to_json().items()
        },
        "digest_chain": str(result.chain) or None,
    }


def _print_recovery(result: "Recovery") -> None:
    how = "was finished" if result.finished else "was not finished"
    terminal.print_text(f"{result.output}: made of {result.path}, which {how}")
    rows = []
    if there := result.coverage.judged:
        rows.append(("records", ", ".join(f"{site} {count}" for site, count in there.items())))
        rows.append(("of the run", str(result.coverage)))
        rows.append(("source", f"digest chain {result.chain}"))
    rows.append(("messages", f"{result.messages} in {result.duration_s:.3f} s"))
    for name, lines in (("lost", result.lost), ("missing", result.missing)):
        rows += [("" if n else name, text) for n, text in enumerate(lines[:_MAX_LOSSES] or ["nothing"])]
        if len(lines) > _MAX_LOSSES:
            rows.append(("", f"and {len(lines) - _MAX_LOSSES} more; --json lists all"))
    terminal.print_table(TextTable(("", ""), [(f"  {name}", text) for name, text in rows]))


_FORMATS = ("ros2", "parquet", "csv", "npz", "mat")


def log_export_command(
    files: options.LogsArgument,
    form: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="|".join(_FORMATS),
            help="ros2: an MCAP file of standard messages at full rate; parquet, csv: a folder with a file "
            "per site and kind; npz, mat: one file with an array per column.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", metavar="OUT", help="File or folder; default: next to FILE, named after it."
        ),
    ] = None,
    force: options.ForceOption = False,
) -> None:
    """Exports a log to files for other tools: names end in their units, numbers are exact."""
    from ..errors import UsageError
    from ..reporting.export import Exporter, ExportFormat, default_export_path

    if form not in _FORMATS:
        raise UsageError(f"--to is one of {', '.join(_FORMATS)}, not {form!r}")
    chosen = ExportFormat(form)
    log = terminal.open_with_progress(*files)
    path = output if output is not None else default_export_path(chosen, files[0])
    exporter = Exporter(chosen, path, force=force)
    with terminal.progress_bar(f"writing {path}") as progress:
        exporter.export(log, progress)
    records = sum(len(log[site]) for site in log.sites)
    terminal.print_text(f"{path}: {records} records of {', '.join(log.sites)}")


def log_view_command(
    files: options.LogsArgument,
    full: Annotated[
        bool, typer.Option("--full", help="Show every record, not the decimated channels.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the viewer to a browser on this machine.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="OUT.rrd", help="Write a recording for Rerun instead of opening it."),
    ] = None,
    force: options.ForceOption = False,
) -> None:
    """Opens a log in Rerun: every curve with its name, a column per site.

    If a log lacks standard channels (--views off), was not finished or has parts, they are made first, in a
    temporary file.
    """
    from ..files import refuse_existing
    from ..reporting.rerun_viewer import ViewerOptions, open_rerun

    if save is not None:
        refuse_existing(save, force=force)
    open_rerun(
        files,
        lambda: terminal.open_with_progress(*files),
        ViewerOptions(full=full, web=web, save=save),
        terminal.print_text,
    )
    if save is not None:
        terminal.print_text(f"{save}: open it with: rerun {save}")
