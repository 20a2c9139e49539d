"""The command that says whether a run was stable, and why: certify."""

import json
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from .options import LogArgument, out

if TYPE_CHECKING:
    from ..certificate.certificate import Certificate

app = typer.Typer()

_MARKS = {True: "[green]holds[/green]", False: "[red]fails[/red]", None: "not told"}


@app.command(epilog="Example: trilat certify run.mcap")
def certify(
    file: LogArgument,
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON, for programs.")] = False,
) -> None:
    """Says whether a run was stable, and why: the theorem's premises, V and its energy balance, growth.

    Ends with 0 where V bounds the run, covered by the theorem or not, or where nothing grows; with 1 where
    the run diverged or grows, where that is undecided and V does not tell (record longer; `stable` of
    `trilat test` is the same), or where the energy balance is broken; with 2 where FILE is no log.
    """
    from ..certificate.certificate import certify as certified
    from ..certificate.facts import facts
    from ..experiment import open_log

    found = certified(open_log(file))
    if as_json:
        typer.echo(json.dumps(facts(found), indent=2, ensure_ascii=False, allow_nan=False))
    else:
        _show(found)
    if not found.passed:
        raise typer.Exit(1)


def _show(found: "Certificate") -> None:
    """Prints a certificate: premises, energies, sentences."""
    from ..certificate.words import sentences

    premises = Table("premise", "", "found", box=None, pad_edge=False)
    for premise in found.premises:
        premises.add_row(premise.name, _MARKS[premise.holds], escape(premise.text))
    out.print(premises)
    if found.balance is not None:
        out.print(_energies(found))
    for line in sentences(found):
        out.print(escape(line), soft_wrap=True)


def _energies(found: "Certificate") -> Table:
    """Returns what V was at both ends, what was taken from it and given to it, J."""
    balance = found.balance
    assert balance is not None
    table = Table("energy", "J", box=None, pad_edge=False)
    table.columns[1].justify = "right"
    entries = {
        "V at the start": balance.V[0],
        "V at the end": balance.V[-1],
        **{f"taken: {name}": -values[-1] for name, values in balance.taken.items()},
        **{f"given: {name}": values[-1] for name, values in balance.given.items() if values.any()},
        "given: sampling": balance.sampling[-1],
    }
    for name, value in entries.items():
        table.add_row(escape(name), f"{value:.4g}")
    return table
