"""The table docs/data/log-states.csv: the state of a log, a command, and its message."""

import csv
from collections.abc import Callable, Iterator
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import msgpack
import pytest

from tests.log.builders import edit_log_bytes, make_log_bytes, write_log
from tests.log.split_logs import write_late_parts
from tests.log.surgery import repack_message, take_apart
from trilat_net.log.log_reader import open_log
from trilat_net.presentation import page
from trilat_net.presentation.conclusion import conclude

from .running import trilat

ROOT = Path(__file__).parents[2]
RUN = {"duration_s": 60.0, "rate_hz": 50, "link.delay_ms": 200.0}
TABLE = (ROOT / "docs" / "data" / "log-states.csv").read_text(encoding="utf-8")
ROWS = {row["state"]: row for row in csv.DictReader(TABLE.splitlines())}
COMMANDS = ("log check", "verify", "certify", "report", "log recover")


def make_whole_bytes() -> bytes:
    return make_log_bytes("free", RUN)


def make_torn_bytes() -> bytes:
    return make_whole_bytes()[: len(make_whole_bytes()) * 2 // 3]


def make_sparse_bytes() -> bytes:
    """Returns a log of an older recorder that missed every tenth record of m1, and says so."""
    taken = take_apart(make_whole_bytes()).without_chain()
    topics = taken.topics()
    accounts = taken.metadata("trilat.accounts")
    taken.messages = [
        m
        for m in taken.messages
        if topics[m.channel] != "/trilat/free/m1/state" or m.sequence % 10 != 5
    ]
    text = accounts["/trilat/free/m1/state"]
    accounts["/trilat/free/m1/state"] = text.replace(
        "received 3000, missing 0", "received 2700, missing 300"
    )
    return taken.bytes()


def make_spliced_bytes() -> bytes:
    """Returns two runs over a gap, under the starts of the first."""
    first = take_apart(make_whole_bytes()).without_chain()
    other = take_apart(make_log_bytes("free", {**RUN, "control.Kd": 3.5}))
    topics = first.topics()
    boots = {m.channel: m for m in first.messages if topics[m.channel].endswith("/state")}
    first.messages = [m for m in first.messages if m.channel not in boots or m.sequence < 1500]
    for message in other.messages:
        if message.channel in boots and message.sequence >= 1502:
            boot = msgpack.unpackb(boots[message.channel].payload)["boot"]
            first.messages.append(repack_message(message, boot=boot))
    return first.bytes()


def make_older_bytes() -> bytes:
    return edit_log_bytes(make_whole_bytes())


def make_forged_bytes() -> bytes:
    """Returns a log in which the torque of m1 and m2 is zeroed, and the metadata claim that
    only s was executed.
    """
    claims = {"driver": "rerun", "rerun_executed": "s"}
    zeroed = {"tau": [0.0, 0.0]}
    return edit_log_bytes(
        make_whole_bytes(),
        record=lambda r: r if r["site"] == "s" else {**r, **zeroed},
        session=claims,
    )


def make_changed_bytes() -> bytes:
    pieces = take_apart(make_whole_bytes())
    pieces.metadata("trilat.session")["commit"] = "0" * 40
    return pieces.bytes()


def make_newer_bytes() -> bytes:
    return edit_log_bytes(
        make_whole_bytes(), record=lambda r: {**r, "v": 9}, session={"schema_version": "9"}
    )


STATES: dict[str, Callable[[], bytes]] = {
    "whole": make_whole_bytes,
    "torn": cache(make_torn_bytes),
    "sparse": cache(make_sparse_bytes),
    "spliced": cache(make_spliced_bytes),
    "older": cache(make_older_bytes),
    "forged": cache(make_forged_bytes),
    "changed": cache(make_changed_bytes),
    "newer": cache(make_newer_bytes),
}
"""The makers of logs, by the state that the table names."""


def table_cells() -> Iterator[Any]:
    """Yields every cell; on a push some states are skipped, and only a torn log gets a report."""
    for state, command in product([*STATES, "part"], COMMANDS):
        slow = state in ("older", "changed", "part") or (
            command == "report" and state != "torn"
        )
        yield pytest.param(state, command, marks=pytest.mark.long if slow else ())


@pytest.mark.parametrize(("state", "command"), list(table_cells()))
def test_the_table_has_the_printed_messages(state: str, command: str, tmp_path: Path) -> None:
    code, _, text = ROWS[state][command].partition(": ")
    file = tmp_path / "run.mcap"
    if state == "part":
        file = write_late_parts(tmp_path, refilled=range(0))[1]
    else:
        file.write_bytes(STATES[state]())
    done = trilat(*command.split(), file, cwd=tmp_path)
    assert done.code == int(code), done
    assert text.strip("`") in (done.out + done.err).replace("\n", " "), done


def test_the_table_has_every_state() -> None:
    assert ROWS.keys() == {*STATES, "part"}


@pytest.mark.long
def test_reports_use_the_requested_coverage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine tenths of the records of m1 exist: enough if half is requested."""
    monkeypatch.setattr(page, "write_report", lambda *_, **__: [])
    file = write_log(tmp_path, STATES["sparse"]())
    conclusion = conclude(open_log(file), tmp_path, min_coverage=0.5)
    assert {line.check: line.passed for line in conclusion.findings}["records"]
    assert not any("less than 99.9 %" in note for note in conclusion.notes)
