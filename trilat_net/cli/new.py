"""`trilat new`: law."""

from pathlib import Path
from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options


def new_law_command(
    file: Annotated[Path, typer.Argument(help="File to write, as in mylaw.py.")],
    force: options.ForceOption = False,
) -> None:
    """Writes a control law of your own, working and with comments, and its test."""
    from ..scenario.law_skeleton import name_skeleton_class, new_law

    law, test = new_law(file, force=force)
    code = f"{law.stem}:{name_skeleton_class(law.stem)}"
    there = "" if law.parent == Path() else f"cd {law.parent}, and "
    terminal.print_text(f"{law}: a law that works; {test.name}: its test. Change the law, {there}run")
    terminal.print_text(f"  trilat sim paper --set control.law={code} -o {law.stem}.mcap")
    terminal.print_text(f"  trilat certify {law.stem}.mcap")
    terminal.print_text(f"  pytest {test.name}")
