"""`trilat certify`: the judgement of a run, V and its energy balance, premises, roots at the end pose."""

from typing import TYPE_CHECKING

import typer
from rich.markup import escape

from ..reporting import terminal_output as terminal
from ..reporting.text_table import TextTable
from . import options

if TYPE_CHECKING:
    from ..analysis.certificate.stability_certificate import Certificate


_HOLDS = {True: "holds", False: "fails", None: "not told"}
_MARKS = {
    "ok": "[green]ok  [/green]",
    "FAIL": "[red]FAIL[/red]",
    "open": "[yellow]open[/yellow]",
    "note": "note",
}


def certify_command(
    files: options.LogsArgument,
    accept: options.AcceptOption = None,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    own_laws: options.OwnLawsOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Judges a run: stable, not stable or open; V and its energy balance, premises, roots at the end pose.

    Nothing is executed, but with --own-laws the energies of laws from outside; docs/certificate.md defines
    every word and every key of the JSON.

    Exit code 0: stable. 1: not stable (bounded oscillation, drifting, growing, diverged), or open, each with
    its word and reasons. 2: no log.
    """
    from ..analysis.certificate.stability_certificate import certificate_to_json
    from ..theory.end_pose import certify_with_roots

    log = terminal.open_with_progress(*files)
    if own_laws:
        terminal.warn_user_laws(log)
    found = certify_with_roots(log, min_coverage=min_coverage, own_laws=own_laws)
    if as_json:
        terminal.print_json(certificate_to_json(found))
    else:
        _show(found)
    if not found.accepts(accept or ()):
        raise typer.Exit(1)


def _show(found: "Certificate") -> None:
    from ..reporting.certificate_text import describe_certificate, list_energies

    for line in describe_certificate(found):
        terminal.out.print(f"{_MARKS[line.mark]} {escape(line.text)}", soft_wrap=True)
    observed = found.observed
    premises = [*found.premises, *(() if observed is None else observed.premises)]
    rows = [(premise.name, _HOLDS[premise.holds], premise.text) for premise in premises]
    terminal.out.print()
    terminal.print_table(TextTable(("premise", "", "found"), rows), {"holds": "green", "fails": "yellow"})
    if observed is not None and observed.least:
        least = [(name, f"{amount_j:.4g}", f"{at_s:.4g}") for name, amount_j, at_s in observed.least]
        terminal.out.print()
        terminal.print_table(TextTable(("energy of the laws", "least J", "at s"), least, align="lrr"))
    if found.balance is None:
        return
    energies = [(name, f"{amount:.4g}") for name, amount in list_energies(found.balance)]
    terminal.out.print()
    terminal.print_table(TextTable(("energy", "J"), energies, align="lr"))
