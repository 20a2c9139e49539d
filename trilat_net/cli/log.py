"""The group `trilat log`: commands that look into a file, mend it, and take it elsewhere."""

import typer

from . import log_export, log_info, log_recover, log_view

app = typer.Typer(no_args_is_help=True, help="Looks into a log, mends it, takes it to other tools.")
app.add_typer(log_info.app)
app.add_typer(log_recover.app)
app.add_typer(log_export.app)
app.add_typer(log_view.app)
