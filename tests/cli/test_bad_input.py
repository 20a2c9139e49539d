"""Input that no file of cases can hold: long and odd words, usage errors and full disks."""

import contextlib
import errno
import io
import json
import re
from pathlib import Path
from unittest import mock

import pytest
from rich.table import Table

from trilat_net.presentation.terminal_output import TextConsole, print_json, print_line

from .running import trilat


@pytest.mark.parametrize(
    "arguments",
    [
        ["fly"],
        ["sim"],
        ["sim", "paper", "--fast"],
        ["sim", "paper", "--seed", "x"],
        ["scenario"],
    ],
)
def test_usage_errors_exit_with_2_without_a_traceback(
    arguments: list[str], tmp_path: Path
) -> None:
    done = trilat(*arguments, cwd=tmp_path)
    assert done.code == 2, done
    assert "Traceback" not in done.err


ODD = ("$*", "9" * 5000, "\x1b[31m\u202e[/red]", "nan", "/dev/zero", "0x" + "f" * 5000)
TAKING = {
    "no name": ["log", "recover", "."],
    "no name of a recovered log": ["log", "recover", "run.mcap", "-o", "."],
    "no name of keys": ["keys", "pair", "."],
    "set": ["set", "--session", "{}/", "link", "m1->s", "--delay", "1ms"],
    "set dominance": ["set", "--session", "x/y", "dominance", "s", "m1={}"],
    "override": ["scenario", "check", "paper", "--set", "control.Kd={}"],
    "scenario": ["scenario", "check", "{}"],
    "log": ["log", "check", "{}"],
    "stop": ["stop", "--session", "{}/"],
}


@pytest.mark.parametrize("arguments", TAKING.values(), ids=TAKING)
def test_refusals_of_odd_words_hide_control_characters(
    arguments: list[str], tmp_path: Path
) -> None:
    for odd in ODD:
        done = trilat(*(word.replace("{}", odd) for word in arguments), cwd=tmp_path)
        done.refuses()
        assert done.err[:-1].isprintable()
        assert len(done.err) < 4100


@pytest.mark.parametrize("number", ["9" * 4000, "0x" + "f" * 5000])
def test_numbers_too_long_to_send_are_refused(number: str, tmp_path: Path) -> None:
    order = ["link", "m1->s", "--to", f"deviation_ms={number}"]
    trilat("set", "--session", "x", *order, cwd=tmp_path).refuses("to.deviation_ms: must be a")


def test_a_session_has_a_short_name(tmp_path: Path) -> None:
    trilat("stop", "--session", "9" * 5000, cwd=tmp_path).refuses(
        "must have 1 to 80 characters"
    )


def test_foreign_text_cannot_control_a_terminal() -> None:
    """Texts, cells, titles and JSON contain letters alone, whatever a peer or a file put into them."""
    stream = io.StringIO()
    attack = "a\x1b]0;title\x07\x9b31m\u202eb\r\ud800"
    console = TextConsole(file=stream, force_terminal=True, width=200)
    table = Table(title=attack)
    table.add_column(attack)
    table.add_row(attack)
    for hostile in (attack, table):
        console.print(hostile)
    with contextlib.redirect_stdout(stream):
        print_line(attack)
        print_json({"text": attack})
    plain_text = re.sub(r"\x1b\[[\d;]*m", "", stream.getvalue())  # the console's own colours
    assert all(letter.isprintable() or letter == "\n" for letter in plain_text)
    assert json.loads("{" + stream.getvalue().rpartition("{")[2]) == {"text": attack}


@pytest.mark.parametrize("command", ["figure", pytest.param("report", marks=pytest.mark.long)])
def test_a_full_disk_has_one_exit_code(command: str, tmp_path: Path, short_log: bytes) -> None:
    (tmp_path / "run.mcap").write_bytes(short_log)
    full = OSError(errno.ENOSPC, "No space left on device")
    names = ["positions"] if command == "figure" else []
    with mock.patch("matplotlib.figure.Figure.savefig", side_effect=full):
        trilat(command, "run.mcap", *names, cwd=tmp_path).refuses("No space left", code=5)
