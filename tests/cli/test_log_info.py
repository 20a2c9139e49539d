"""`trilat log info`, `trilat log check`, and the message of every reading command about an
incomplete file.
"""

import io
import json
from pathlib import Path

import pytest
from mcap.writer import Writer

from tests.cli.running import trilat
from tests.log.builders import drop_records, edit_log_bytes, make_log_bytes, write_log
from trilat_net.presentation.untrusted_text import sanitize

WHOLE = make_log_bytes("paper")


def make_foreign_bytes() -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    channel = writer.register_channel(
        "/t", "json", writer.register_schema("s", "jsonschema", b"{}")
    )
    for n in range(3):
        writer.add_message(channel, n * 10_000_000, b"{}", n)
    writer.finish()
    return stream.getvalue()


def test_info_shows_session_sites_links_and_channels(tmp_path: Path) -> None:
    text = trilat("log", "info", write_log(tmp_path, WHOLE), cwd=tmp_path).succeeds()
    for fact in (
        "paper, virtual",
        "seed 1",
        "0.119 s of 0.12 s",
        "360, none missing",
        "m2->m1",
        "m1/state",
    ):
        assert fact in text
    assert all(len(line) <= 120 for line in text.splitlines() if not line.startswith("file")), (
        text
    )


def test_info_in_json_has_the_same_numbers(tmp_path: Path) -> None:
    path = write_log(tmp_path, edit_log_bytes(WHOLE, record=drop_records("m1", {5, 6, 90})))
    facts = json.loads(trilat("log", "info", "--json", path, cwd=tmp_path).succeeds())
    assert facts["kind"] == "trilat"
    assert facts["session"]["scenario"]["name"] == "paper"
    assert facts["sites"]["m1"]["missing"] == 3
    state = facts["channels"]["/trilat/paper/m1/state"]
    assert (state["messages"], state["missing"], state["gaps"]) == (117, 3, [[5, 6], [90, 90]])
    assert state["between_ms"]["p50"] == pytest.approx(1.0)
    assert state["between_ms"]["max"] == pytest.approx(3.0)
    assert facts["links"]["m2->m1"]["age_ms"]["p50"] == pytest.approx(20.0)
    (file,) = facts["files"]
    assert file["size_bytes"] == path.stat().st_size
    assert file["finished"]


def test_info_of_a_foreign_file_shows_channels(tmp_path: Path) -> None:
    path = write_log(tmp_path, make_foreign_bytes())
    facts = json.loads(trilat("log", "info", "--json", path, cwd=tmp_path).succeeds())
    assert facts["kind"] == "mcap"
    assert facts["session"] is None
    assert facts["channels"]["/t"]["messages"] == 3
    assert facts["channels"]["/t"]["rate_hz"] == pytest.approx(100.0)
    assert "/t" in trilat("log", "info", path, cwd=tmp_path).succeeds()


def test_info_of_an_unreadable_log_gives_reasons(tmp_path: Path) -> None:
    path = write_log(tmp_path, edit_log_bytes(WHOLE, scenario=lambda _: "not toml ["))
    text = trilat("log", "info", path, cwd=tmp_path).succeeds()
    assert "cannot be opened" in text
    assert "is not TOML" in text
    assert "/trilat/paper/m1/state" in text


def test_a_sound_log_passes_every_check(tmp_path: Path) -> None:
    text = trilat("log", "check", write_log(tmp_path, WHOLE), cwd=tmp_path).succeeds()
    assert [line.split()[0] for line in text.splitlines()] == ["ok"] * 11


def test_a_log_that_lacks_records_fails(tmp_path: Path) -> None:
    path = write_log(tmp_path, edit_log_bytes(WHOLE, record=drop_records("s", {7, 8, 9, 40})))
    done = trilat("log", "check", path, cwd=tmp_path)
    assert done.code == 1
    assert "FAIL sequence" in done.out
    assert "missing s/state 7-9" in done.out
    facts = json.loads(trilat("log", "check", "--json", path, cwd=tmp_path).out)
    assert not facts["sound"]
    (sequence,) = (each for each in facts["checks"] if each["check"] == "sequence")
    assert {gap["text"] for gap in sequence["places"]} == {
        "missing s/state 7-9",
        "missing s/state 40",
    }


def test_foreign_mcap_files_are_checked_for_structure(tmp_path: Path) -> None:
    done = trilat("log", "check", write_log(tmp_path, make_foreign_bytes()), cwd=tmp_path)
    assert done.code == 0
    assert len(done.out.splitlines()) == 4
    assert "not a trilat-net log" in done.err


def test_a_foreign_file_fails_the_check(tmp_path: Path) -> None:
    path = write_log(tmp_path, b"text")
    assert trilat("log", "check", path, cwd=tmp_path).code == 1


@pytest.mark.parametrize(
    "command", [["log", "info"], ["log", "check"], ["verify"]], ids=" ".join
)
def test_every_command_names_the_repair(command: list[str], tmp_path: Path) -> None:
    data = edit_log_bytes(WHOLE, chunk_bytes=4096)
    path = write_log(tmp_path, data[: len(data) // 2], "run.mcap.active")
    done = trilat(*command, path, cwd=tmp_path)
    notes = [line for line in done.err.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1, done
    assert f"trilat log recover {path}" in notes[0]


def test_verify_names_every_gap_and_continues(tmp_path: Path) -> None:
    lost = {3 * n for n in range(10, 30)}
    path = write_log(tmp_path, edit_log_bytes(WHOLE, record=drop_records("m2", lost)))
    done = trilat("verify", path, cwd=tmp_path)
    assert done.code == 1, done  # nothing differs, and too much is missing
    assert f"m2 {', '.join(map(str, sorted(lost)))}" in done.out
    facts = json.loads(trilat("verify", "--json", path, cwd=tmp_path).out)
    assert not facts["passed"]
    assert facts["first_difference"] is None
    assert facts["coverage"] == facts["judged"]["m2"][0] / 120
    assert facts["integrity"] == "changed"  # no account tells of these gaps
    assert facts["gaps"] == [{"site": "m2", "first": n, "last": n} for n in sorted(lost)]
    assert facts["records"] == 360 - len(lost)
    assert facts["identical"] + facts["unjudged"] == facts["records"]
    assert 0 < facts["unjudged"] < 150


def test_file_contents_reach_terminals_only_escaped(tmp_path: Path) -> None:
    """An escape sequence in a name could clear the screen, or write text that was never there."""
    assert sanitize("\x1b[2Jred\r\n") == "\ufffd[2Jred\ufffd\ufffd"
    assert len(sanitize("x" * 10_000)) < 400
    path = write_log(
        tmp_path, edit_log_bytes(WHOLE, session={"platform": "\x1b[2J\x1b]0;owned\x07"})
    )
    done = trilat("log", "info", path, cwd=tmp_path)
    assert "\x1b" not in done.out + done.err
    assert "\x07" not in done.out + done.err


# Advice on files that do not end as a finished one does: every command gives the same.

PADDED = Path(__file__).parents[1] / "log" / "inputs" / "padded_after_end.mcap"
READING = (
    ["log", "info"],
    ["log", "check"],
    ["log", "recover"],
    ["verify"],
    ["certify"],
    ["report"],
)


@pytest.mark.parametrize("arguments", READING, ids=" ".join)
def test_an_empty_file_is_empty_to_every_command(arguments: list[str], tmp_path: Path) -> None:
    write_log(tmp_path, b"", "empty.mcap")
    done = trilat(*arguments, "empty.mcap", cwd=tmp_path)
    assert done.code != 0
    assert "is empty" in done.out + done.err
    assert "trilat log recover" not in done.out + done.err  # it could save nothing
    assert list(tmp_path.iterdir()) == [tmp_path / "empty.mcap"]


@pytest.mark.parametrize(
    ("data", "count"), [(PADDED.read_bytes(), 512), (WHOLE + bytes(4096), 4096)]
)
def test_trailing_bytes_lose_nothing(data: bytes, count: int, tmp_path: Path) -> None:
    write_log(tmp_path, data)
    reading = (["log", "info"], ["log", "check"], *([["verify"]] if count == 4096 else []))
    for command in reading:
        done = trilat(*command, "run.mcap", cwd=tmp_path)
        assert f"{count} bytes follow its end mark" in done.err, done
        assert "was not finished" not in done.out + done.err
        assert done.code == 0 or command == ["log", "check"], done
    done = trilat("log", "recover", "run.mcap", cwd=tmp_path)
    assert done.code == 0
    assert "which was finished" in done.out
    checked = trilat("log", "check", "run.recovered.mcap", cwd=tmp_path)
    assert checked.code == 0, checked
    assert f"{count} bytes" not in checked.out + checked.err


def without_ends(payload: bytes) -> bytes:
    """Returns an event that is no end, in the place of an end."""
    return payload.replace(b"\xa3end", b"\xa3law")


def test_an_unknown_end_is_reported_everywhere(tmp_path: Path) -> None:
    write_log(tmp_path, edit_log_bytes(WHOLE, event=without_ends))
    sentence = "the end of m1, m2 and s is unknown"
    for command in (["log", "info"], ["log", "check"], ["verify"]):
        done = trilat(*command, "run.mcap", cwd=tmp_path)
        assert sentence in done.out + done.err, done
    facts = json.loads(trilat("log", "info", "run.mcap", "--json", cwd=tmp_path).out)
    assert facts["session"]["unknown_ends"] == ["m1", "m2", "s"]
    trilat("report", "run.mcap", cwd=tmp_path)
    (summary,) = tmp_path.rglob("summary.json")
    assert json.loads(summary.read_text())["session"]["unknown_ends"] == ["m1", "m2", "s"]
    assert sentence in next(tmp_path.rglob("report.html")).read_text()
