"""Commands that play a log again."""

import typer

app = typer.Typer()
