"""Text tables: the same cells on a terminal, in Markdown and as lines."""

from io import StringIO

from rich.console import Console

from trilat_net.reporting.result_text import TextTable

TABLE = TextTable(
    ("site", "delay", "note"),
    [["energies"], ["m1", "40.5", "|e| [red]"], ["long name", "7", "\x1b[2J"]],
    align="lrl",
    units=("", "ms"),
)


def test_lines_are_aligned_and_short_rows_stay_short() -> None:
    assert TABLE.lines() == [
        "site       delay ms  note",
        "energies",
        "m1             40.5  |e| [red]",
        "long name         7  \x1b[2J",
    ]


def test_markdown_escapes_bars_and_marks_numbers() -> None:
    heads, rule, group, first, _ = TABLE.markdown().splitlines()
    assert heads == "| site | delay ms | note |"
    assert rule == "| --- | --: | --- |"
    assert group == "| energies |  |  |"
    assert first == r"| m1 | 40.5 | \|e\| [red] |"


def test_a_terminal_gets_every_cell_and_no_control_characters() -> None:
    console = Console(file=StringIO(), width=12)
    console.print(TABLE._replace(styles={"7": "green"}).rich())
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "\x1b" not in text
    assert "".join(text.split()).count("[red]") == 1
    console = Console(file=StringIO(), width=40)
    console.print(TextTable(("", ""), [("a", "b")]).rich())  # without headers, without their line
    assert console.file.getvalue().split() == ["a", "b"]  # type: ignore[attr-defined]
