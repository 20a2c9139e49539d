"""Commands of `trilat log`."""

import typer

app = typer.Typer()
