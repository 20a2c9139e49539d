"""`trilat certify`: the judgement of a run, V and its energy balance, premises, roots at the end pose."""

import typer

from ..reporting import terminal_output as terminal
from . import options


def certify_command(
    files: options.LogsArgument,
    accept: options.AcceptOption = None,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    own_laws: options.OwnLawsOption = False,
    twins: options.TwinsOption = 8,
    law: options.LawFilesOption = None,
    other_version: options.OtherVersionOption = False,
    remember: options.RememberOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Judges a run: stable, not stable or open; V and its energy balance, premises, roots at the end pose.

    Executes the run again beside twins that get a small push, and no code of imported laws without --law or
    --own-laws.
    docs/certificate.md defines every word and every key of the JSON.

    Exit code 0: stable. 1: not stable (bounded oscillation, drifting, growing, diverged) or open, with
    the reasons. 2: no log.
    """
    from ..theory.end_pose import certify_run

    log = terminal.open_with_progress(*files, law=law, other_version=other_version, remember=remember)
    own_laws = own_laws or bool(law)
    if own_laws:
        terminal.warn_user_laws(log)
    found = certify_run(log, min_coverage=min_coverage, own_laws=own_laws, twins=twins)
    terminal.print_result(found, as_json=as_json)
    if not found.accepts(accept or ()):
        raise typer.Exit(1)
