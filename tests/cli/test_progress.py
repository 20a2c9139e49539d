"""The bar: for people, while it takes long, and gone afterwards."""

import io

import pytest
from rich.console import Console

from trilat_net.reporting import terminal_output


def terminal(monkeypatch: pytest.MonkeyPatch, *, interactive: bool) -> io.StringIO:
    stream = io.StringIO()
    console = Console(
        file=stream, force_terminal=interactive, force_interactive=interactive, width=80
    )
    monkeypatch.setattr(terminal_output, "err", console)
    return stream


def work() -> None:
    with terminal_output.progress_bar("reading run.mcap") as told:
        for done in range(0, 101, 20):
            told(done, 100)


@pytest.mark.parametrize(("interactive", "patience_s"), [(False, -1.0), (True, 1e6)])
def test_no_bar_is_drawn_off_a_terminal_or_at_once(
    interactive: bool, patience_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = terminal(monkeypatch, interactive=interactive)
    monkeypatch.setattr(terminal_output, "PATIENCE_S", patience_s)
    work()
    assert stream.getvalue() == ""


def test_what_takes_long_has_a_bar_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = terminal(monkeypatch, interactive=True)
    monkeypatch.setattr(terminal_output, "PATIENCE_S", -1.0)
    monkeypatch.setattr(terminal_output, "_REDRAW_PERIOD_S", -1.0)
    work()
    text = stream.getvalue()
    assert "reading run.mcap" in text
    assert "100%" in text
    assert text.rstrip().endswith("\x1b[2K"), "the line is erased, the cursor is back"
