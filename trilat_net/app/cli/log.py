"""The commands `trilat log info`, `check`, `sign`, `recover`, `export` and `view`.

A log is an MCAP file that contains the scenario of a run and one record per site and control
period.

Invariant:
    - No command in this module repeats the run or executes code that a log refers to. The
      commands are therefore safe to use on untrusted logs.
"""

import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from ...entry_points import find_viewer
from ...errors import UsageError, count_nouns
from ...presentation import list_export_formats
from ...presentation import terminal_output as terminal
from . import options

_LOSSY_EXIT_CODE = 3
"""Exit code of `trilat log recover` if a part of the log was lost."""


@options.command("run.mcap", page="docs/logs/log-tools.md")
def log_info_command(files: options.LogsArgument, as_json: options.JsonOption = False) -> None:
    """Prints the session, sites, links and channels of a log, and any missing records."""
    from ...analysis import info

    with terminal.progress_bar(f"reading {files[0]}") as progress:
        overview = info(*files, progress=progress)
    terminal.print_result(overview, as_json=as_json)
    if not as_json:
        for path in files:
            terminal.warn_if_unfinished(path)


@options.command("run.mcap", "run.mcap --key lab.pub", page="docs/logs/log-checks.md")
def log_check_command(
    files: options.LogsArgument,
    key: Annotated[
        Path | None, options.value("--key", "PUB", "Also check FILE.sig with this public key.")
    ] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Checks that a log is well-formed, complete and consistent, without executing anything.

    Exit code 0: the log is sound. 1: the log is not sound. 2: the file does not exist. If
    another program wrote the file, only its structure is checked.
    """
    from ...log import check_file

    with terminal.progress_bar(f"checking {files[0]}") as progress:
        check = check_file(*files, progress=progress)
    if key is not None:
        with terminal.progress_bar(f"checking the signature of {files[0]}") as progress:
            check.check_signatures(key, progress)
    terminal.print_result(check, as_json=as_json)
    if not as_json:
        if not check.ours:
            terminal.print_note(
                "this is not a trilat-net log: only the structure of the file was checked"
            )
        for path in files:
            terminal.warn_if_unfinished(path)
    raise typer.Exit(check.exit_code)


@options.command("run.mcap --key lab.key", page="docs/logs/log-checks.md")
def log_sign_command(
    file: options.LogArgument,
    key: Annotated[
        Path, options.value("--key", "KEY", "Private key, created by `trilat keys pair`.")
    ],
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Signs a finished log with Ed25519: writes FILE.sig, and does not change FILE.

    The signature covers the digest chain, that is, all messages and their metadata. Check it
    with the public key: trilat log check FILE --key PUB
    """
    from ...log import sign_log

    with terminal.progress_bar(f"reading {file}") as progress:
        signature = sign_log(file, key, force=force, progress=progress)
    if as_json:
        terminal.print_json({"file": file.as_posix(), "signature": signature.as_posix()})
    else:
        terminal.print_text(f"{signature} contains the signature of {file}")


@options.command("run.mcap.active", page="docs/logs/log-checks.md")
def log_recover_command(
    file: options.LogArgument,
    output: Annotated[
        Path | None,
        options.value(
            "-o --out --output",
            "OUT",
            "File for the recovered log; default: the name of FILE without .active, or with "
            ".recovered.mcap in place of .mcap.",
        ),
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Recovers an unfinished or damaged log into a new, complete file.

    The original file is not changed. The command works with any MCAP file. Exit code 0: nothing
    was lost. 3: some data was lost, and is listed. 1: nothing could be recovered.
    """
    from ...log import recover

    with terminal.progress_bar(f"reading {file}") as progress:
        result = recover(file, output, force=force, progress=progress)
    terminal.print_result(result, as_json=as_json)
    if not result.lossless:
        raise typer.Exit(_LOSSY_EXIT_CODE)


@options.command(
    "run.mcap --to parquet",
    "runs/ --to lerobot -o grasps --set observations=plugin --set task=grasp",
    page="docs/logs/log-tools.md",
)
def log_export_command(
    files: options.LogsOrFoldersArgument,
    form: Annotated[str, options.value("--to", "|".join(list_export_formats()))],
    settings: Annotated[list[str] | None, options.value("--set", "KEY=VALUE")] = None,
    actions: Annotated[str, options.value("--actions", "tip|joints")] = "",
    output: Annotated[Path | None, options.value("-o --out", "OUT")] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Exports a log to files for other tools, with exact numbers and units in the column names.

    Options:
        form: Format. ros2: an MCAP file of standard messages at full rate; parquet or csv: a
            folder with one file per site and kind of record; npz or mat: a single file with one
            array per column; lerobot: a LeRobot dataset with one episode per log in FILE
            (docs/studies/lerobot.md).
        settings: Setting of the format; repeatable. For lerobot: fps=30; observations=slave,
            observations=reference with the reference that the slave follows, or
            observations=plugin for a policy run by the LeRobot plugin, with site=m1 if the
            plugin holds m1; environment_state=yes; actions, as --actions; task=TEXT;
            episodes=log, or episodes=marks for the episodes marked with session.episode;
            program=m2 if the user m2 is a program, or program=none. For ros2: names=crtk, or a
            file of names. csv, mat, npz and parquet have no settings.
        actions: For lerobot: store actions in the form that the LeRobot plugin accepts, as
            end-effector positions (tip) or joint angles (joints). Default: the values that the
            sites exchange.
        output: File or folder to write; default: next to FILE, with a name derived from it.
    """
    from ...log import Log
    from ...presentation import Exporter

    pairs = [text.partition("=") for text in settings or []]
    format_settings = {key: value for key, _, value in pairs}
    if actions:
        format_settings["actions"] = actions
    # Rejects wrong settings and an existing output before the log is read.
    exporter = Exporter(form, output, force=force, log=files[0], settings=format_settings)

    with terminal.progress_bar(f"reading {files[0]}") as progress:
        logs = Log.open_sessions(*files, progress=progress)
    for log in logs:
        terminal.warn_of_damage(log)
    with terminal.progress_bar(f"writing {exporter.path}") as progress:
        summary = exporter.export(*logs, progress=progress)

    records = {}
    for site in logs[0].sites:
        records[site] = sum(len(log[site]) for log in logs)
    if not summary:
        total_text = count_nouns(sum(records.values()), "record")
        summary = f"{total_text} of {', '.join(records)}"
    if as_json:
        terminal.print_json(
            {"file": exporter.path.as_posix(), "format": form, "records": records}
        )
    else:
        terminal.print_text(f"{exporter.path}: {summary}")


@options.command("run.mcap", "run.mcap --foxglove", page="docs/logs/log-tools.md")
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
        options.value("--save", "OUT.rrd", "Write a Rerun file instead of opening Rerun."),
    ] = None,
    foxglove: Annotated[
        bool,
        typer.Option(
            "--foxglove",
            help="Write a layout for Foxglove and Lichtblick next to FILE instead.",
        ),
    ] = False,
    rviz: Annotated[
        bool,
        typer.Option(
            "--rviz",
            help="Write an RViz configuration for the log's ROS 2 topics next to FILE instead.",
        ),
    ] = False,
    viewer: Annotated[
        str | None,
        options.value("--in", "NAME", "Open the log in a viewer that another package adds."),
    ] = None,
    force: options.ForceOption = False,
) -> None:
    """Opens a log in Rerun, with one column per site and a label on every curve.

    If a log lacks the standard channels (--views off), is unfinished or is split into parts, a
    temporary file that has these channels is written first. If Rerun is not installed, the
    log's page opens in a browser instead.
    """
    from importlib.util import find_spec

    from ...files import stage_output
    from ...presentation import ViewerOptions, open_rerun

    if viewer is not None:
        if full or web or save or foxglove or rviz or force:
            raise UsageError("--in cannot be combined with another option")
        return find_viewer(viewer)(files)

    if foxglove or rviz:
        if full or web or save:
            raise UsageError(
                "--foxglove and --rviz cannot be combined with --full, --web or --save"
            )
        return _write_viewer_files(files[0], foxglove=foxglove, rviz=rviz, force=force)

    needs_rerun = full or web or save
    if not needs_rerun and find_spec("rerun") is None:
        return _open_page(files)

    with stage_output(save, force=force) if save is not None else nullcontext() as output_path:
        open_rerun(
            files,
            lambda: terminal.open_with_progress(*files),
            ViewerOptions(full=full, web=web, save=output_path),
            terminal.print_text,
        )
    if save is not None:
        terminal.print_text(f"{save}: open it with: rerun {save}")
    return None


def _write_viewer_files(file: Path, *, foxglove: bool, rviz: bool, force: bool) -> None:
    """Writes layout files for the viewers Foxglove and RViz, and prints how to use them.

    A viewer then opens with the plots of all arms, which need not be arranged by hand.

    Args:
        file: The log, its first part, or an exported bag.
        foxglove: True to write a layout for Foxglove and Lichtblick.
        rviz: True to write a configuration of RViz.
        force: True to replace existing files.
    """
    from ...log.ros2 import write_rviz_config
    from ...presentation import write_foxglove_layout

    if foxglove:
        layout = write_foxglove_layout(file, force=force)
        terminal.print_text(
            f"{layout}: open {file} in Foxglove or Lichtblick, and import this file as a layout"
        )
    if rviz:
        config = write_rviz_config(file, force=force)
        command = f"rviz2 -d {shlex.quote(str(config))}"
        terminal.print_text(f"{config}: during a session with `trilat ros2`, run: {command}")
        terminal.print_text(
            f"  for a bag: ros2 bag play BAG --clock 100, and {command} --ros-args "
            "-p use_sim_time:=true"
        )


def _open_page(files: list[Path]) -> None:
    """Opens the report (web page) of a log in a browser.

    If the report is missing, it is written first, as by `trilat report`.

    Args:
        files: The log, or its parts.
    """
    import webbrowser
    from contextlib import suppress

    from ...files import Extra, make_results_folder, refuse_link
    from ...presentation import conclude
    from ..api import choose_report_folder

    command = Extra("view").install_command
    terminal.print_note(f"Rerun is not installed ({command}); the log's page is shown instead")

    folder = choose_report_folder(files[0])
    refuse_link(folder)
    page = folder / "report.html"
    if not page.is_file():
        log = terminal.open_with_progress(*files)
        results = make_results_folder(folder, "", force=None)
        with terminal.progress_bar("drawing") as progress:
            page = conclude(log, results, progress).page
    terminal.print_text(f"{page}: open it in a browser")
    with suppress(OSError, webbrowser.Error):
        webbrowser.open(page.resolve().as_uri())
