"""`trilat certify`: the Lyapunov certificate of a run: V, its energy balance, premises, growth."""

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


def certify_command(files: options.LogsArgument, as_json: options.JsonOption = False) -> None:
    """Judges the stability of a run: V and its energy balance, the theorem's premises, growth.

    Nothing is executed; docs/certificate.md defines every word and every key of the JSON.

    Exit code 0: V bounds the run, whether the theorem covers it or not, or e and qd show that nothing grows.
    1: it diverged or grows; the energy balance is broken; or neither V nor growth decides (record longer).
    2: no log.
    """
    from ..analysis.certificate.stability_certificate import certificate_to_json
    from ..analysis.certificate.stability_certificate import certify as certified

    found = certified(terminal.open_with_progress(*files))
    if as_json:
        terminal.print_json(certificate_to_json(found))
    else:
        _show(found)
    if not found.passed:
        raise typer.Exit(1)


def _show(found: "Certificate") -> None:
    from ..reporting.certificate_text import describe_certificate, list_energies

    for line in describe_certificate(found):
        terminal.out.print(f"{_MARKS[line.mark]} {escape(line.text)}", soft_wrap=True)
    rows = [(premise.name, _HOLDS[premise.holds], premise.text) for premise in found.premises]
    terminal.out.print()
    terminal.print_table(TextTable(("premise", "", "found"), rows), {"holds": "green", "fails": "yellow"})
    if found.balance is None:
        return
    energies = [(name, f"{amount:.4g}") for name, amount in list_energies(found.balance)]
    terminal.out.print()
    terminal.print_table(TextTable(("energy", "J"), energies, align="lr"))
