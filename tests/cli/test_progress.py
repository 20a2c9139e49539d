"""The progress bar is shown to people during long work, and removed afterwards."""

import io
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from tests.cli.running import simulate_by_command
from trilat_net.presentation import terminal_output

from .running import trilat


def make_terminal(monkeypatch: pytest.MonkeyPatch, *, interactive: bool) -> io.StringIO:
    stream = io.StringIO()
    console = Console(
        file=stream, force_terminal=interactive, force_interactive=interactive, width=80
    )
    monkeypatch.setattr(terminal_output, "err", console)
    return stream


def show_progress() -> None:
    with terminal_output.progress_bar("reading run.mcap") as bar:
        for done in range(0, 101, 20):
            bar(done, 100)


@pytest.mark.parametrize(("interactive", "patience_s"), [(False, 1e6), (True, 1e6)])
def test_no_bar_off_a_terminal_or_at_once(
    interactive: bool, patience_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = make_terminal(monkeypatch, interactive=interactive)
    monkeypatch.setattr(terminal_output, "PATIENCE_S", patience_s)
    monkeypatch.setattr(terminal_output, "LINES_AFTER_S", patience_s)
    show_progress()
    assert stream.getvalue() == ""


def test_lines_off_terminals_tell_work_and_progress(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stream = make_terminal(monkeypatch, interactive=False)
    monkeypatch.setattr(terminal_output, "LINES_AFTER_S", 0.0)
    monkeypatch.setattr(terminal_output, "LINES_PERIOD_S", 0.01)
    with terminal_output.progress_bar("judging run.mcap") as bar:
        bar(1, 4)
        for _ in range(1000):
            if stream.getvalue().count("%") >= 2:
                break
            threading.Event().wait(0.01)
    # On a busy machine a line may precede the first progress, and has no percent then.
    first, *others = stream.getvalue().splitlines()
    assert first == "judging run.mcap ..."
    assert all(re.fullmatch(r"  (25 %, )?\d+ s elapsed", line) for line in others)
    assert re.fullmatch(r"  25 %, \d+ s elapsed", others[-1])


def test_progress_lines_end_with_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = make_terminal(monkeypatch, interactive=False)
    monkeypatch.setattr(terminal_output, "LINES_AFTER_S", 0.01)
    monkeypatch.setattr(terminal_output, "LINES_PERIOD_S", 0.01)
    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt), terminal_output.progress_lines("judging"):
        raise KeyboardInterrupt
    assert threading.active_count() == before
    printed = stream.getvalue()
    threading.Event().wait(0.05)
    assert stream.getvalue() == printed


WORKING = [
    (["sim", "paper", "--duration", "0.2", "-o", "again.mcap", "--json"], "running paper"),
    (["certify", "run.mcap", "--json"], "judging run.mcap"),
    (["report", "run.mcap", "-o", "page", "--json"], "checking run.mcap and drawing"),
    (["compare", "run.mcap", "run.mcap", "--json"], "comparing 2 logs"),
    (["linear", "p_d_margin", "--no-ports", "--json"], "linearising p_d_margin"),
]


@pytest.mark.parametrize(("arguments", "line"), WORKING, ids=lambda value: str(value[0]))
def test_progress_off_terminals_goes_to_stderr(
    arguments: list[str], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate_by_command(tmp_path, "paper", seconds="0.2")

    @contextmanager
    def announce(label: str) -> Iterator[Callable[[int, int], None]]:
        terminal_output.err.print(f"{label} ...")
        yield lambda _done, _total: None

    monkeypatch.setattr(terminal_output, "progress_lines", announce)
    done = trilat(*arguments, cwd=tmp_path)
    assert line in done.err
    assert json.loads(done.out)


def test_work_that_grows_prints_further_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep is refined in steps, each of which adds runs to those that were planned."""
    make_terminal(monkeypatch, interactive=False)
    lines: list[str] = []
    with terminal_output.show_progress("sweeping", lines.append) as show:
        for first, total in ((0, 100), (100, 300)):
            for done in range(first, total + 1):
                show(done, total)
    totals = [re.findall(r"\d+", line)[1] for line in lines]
    assert totals == 9 * ["100"] + 6 * ["300"]


def test_long_work_has_a_bar_that_disappears(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = make_terminal(monkeypatch, interactive=True)
    monkeypatch.setattr(terminal_output, "PATIENCE_S", -1.0)
    monkeypatch.setattr(terminal_output, "_REDRAW_PERIOD_S", -1.0)
    show_progress()
    text = stream.getvalue()
    assert "reading run.mcap" in text
    assert "100%" in text
    assert text.rstrip().endswith("\x1b[2K"), "the line is erased, the cursor is back"
