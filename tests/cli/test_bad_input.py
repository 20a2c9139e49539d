"""Bad input gives one line on stderr and exit code 2: the error, its place, and the valid choice."""

import contextlib
import errno
import io
import json
import os
import re
from pathlib import Path
from unittest import mock

import pytest
from rich.table import Table

from tests.log.builders import edit_log_bytes, make_log_bytes
from tests.scenario.builders import planar_task_text, six_joint_text
from trilat_net.presentation.terminal_output import TextConsole, print_json, print_line
from trilat_net.scenario.named_files import SHIPPED_FOLDER

from .running import trilat

ARM6 = Path(str(SHIPPED_FOLDER)) / "arm6.urdf"

OVERRIDES = {
    "control.Kq=5": ("control.Kq", "Kp"),
    "control.Kp=nan": ("Kp", "finite"),
    'control.Kp="text"': ("Kp",),
    "limits.tau_limit_nm=0": ("tau_limit_nm",),
    "no_equals_sign": ("no_equals_sign", "="),
    "control.Kp=": ("control.Kp",),
}


@pytest.mark.parametrize("override", OVERRIDES)
def test_an_invalid_override_is_named(override: str, tmp_path: Path) -> None:
    done = trilat("scenario", "check", "paper", "--set", override, cwd=tmp_path)
    done.refuses(*OVERRIDES[override])


FILES = {
    "nothing": (b"", ("is missing",)),
    "no text": (b"\xff\xfe\x00", ("UTF-8",)),
    "unknown key": (
        b'name="x"\nduratoin_s=1\n[sites]\n[dominance]\n',
        ("duratoin_s", "duration_s"),
    ),
}


@pytest.mark.parametrize("kind", FILES)
def test_an_invalid_scenario_file_is_named(kind: str, tmp_path: Path) -> None:
    content, facts = FILES[kind]
    (tmp_path / "bad.toml").write_bytes(content)
    trilat("scenario", "check", "bad.toml", cwd=tmp_path).refuses("bad.toml", *facts)


COMMANDS = {
    "a scenario file that is not there": (
        ["sim", "./none.toml"],
        ["none.toml", "No such file"],
    ),
    "a directory as a scenario": (["sim", "./"], ["is a folder"]),
    "an unknown site": (["site", "m9", "--scenario", "paper"], ["m9", "m1"]),
    "a session's name that is no key": (
        ["site", "m1", "--scenario", "paper", "--session", "a/*"],
        ["session", "a/*"],
    ),
    "no session's name": (["record", "--session", ""], ["session"]),
    "a malformed endpoint": (
        ["site", "m1", "--scenario", "paper", "--listen", "nonsense"],
        ["nonsense"],
    ),
    "an endpoint of an unknown kind": (
        ["record", "--session", "x", "--connect", "pigeon/1:2"],
        ["pigeon/1:2"],
    ),
    "an endless duration": (["sim", "paper", "--duration", "inf"], ["duration_s"]),
    "a negative seed": (["sim", "paper", "--seed", "-1"], ["seed"]),
    "an output that cannot be made": (
        ["sim", "paper", "-o", "no/where.mcap"],
        ["no/where.mcap"],
    ),
    "a directory as output": (["sim", "paper", "-o", ".", "--force"], ["."]),
    "a recording that cannot be made": (
        ["record", "--session", "x", "-o", "no/where.mcap", "--join-timeout", "1"],
        ["no/where.mcap"],
    ),
    "a recording onto a directory": (["record", "--session", "x", "-o", ".", "--force"], ["."]),
    "an endless wait": (
        ["site", "m1", "--scenario", "paper", "--join-timeout", "inf"],
        ["join-timeout"],
    ),
    "a negative wait": (["record", "--session", "x", "--join-timeout", "-1"], ["join-timeout"]),
    "a clock that is nowhere": (
        ["site", "m1", "--scenario", "paper", "--clock-offset-s", "nan"],
        ["--clock-offset-s", "seconds"],
    ),
    "a clock that runs away": (
        ["record", "--session", "x", "--clock-drift-ppm", "201"],
        ["--clock-drift-ppm", "-200 to 200"],
    ),
    "a ping of no session": (["ping", "--session", "a/*"], ["session", "a/*"]),
    "too few pings": (["ping", "--count", "0"], ["--count", "5 to 10000"]),
}


@pytest.mark.parametrize("kind", COMMANDS)
def test_bad_input_exits_2_with_one_line(kind: str, tmp_path: Path) -> None:
    arguments, facts = COMMANDS[kind]
    trilat(*arguments, cwd=tmp_path).refuses(*facts)
    assert list(tmp_path.iterdir()) == []  # and nothing is left behind


SEVEN = [0.0, -0.3, 0.0, -1.6, 0.0, 1.4, 0.0]
ARMS: dict[str, tuple[str, dict[str, object], list[str]]] = {
    "a singular task pose": (
        "planar",
        {"sites.s.q0_rad": [0.1, 0.0]},
        ["sites.s.q0_rad", "singular pose"],
    ),
    "a joint beyond its stop": (
        "six",
        {"sites.s.q0_rad": [0, 0, 9, 0, 0, 0]},
        ["q0_rad[2]", "joint elbow"],
    ),
    "arms of different joints": (
        "six",
        {
            "sites.m1.arm.urdf": "arm7.urdf",
            "sites.m1.arm.armature_kg_m2": 0.2,
            "sites.m1.q0_rad": SEVEN,
        }
        | {f"sites.m1.control.{gain}": 1.0 for gain in ("Kp", "Kd")},
        ["sites.m2.arm", "6 joints", "7"],
    ),
    "a body that none can be": ("heavy", {}, ["arm.urdf", "link 'forearm'", "mass"]),
}
"""Scenarios that no command may run: what is wrong with them, and what an error must name."""
TAKERS = [
    "sim",
    "demo",
    "test",
    "linear",
    "scenario check",
    "sweep --over link.delay_ms=0,1",
    "compare --tune",
    "site m1",
]


def write_arms(kind: str, folder: Path) -> list[str]:
    text, changes, _ = ARMS[kind]
    written = {"planar": planar_task_text()}.get(text, six_joint_text(1.0))
    (folder / "arms.toml").write_text(
        written.replace("arm6.urdf", "heavy.urdf") if text == "heavy" else written
    )
    forearm = ARM6.read_text().split('<link name="forearm">')
    (folder / "heavy.urdf").write_text(
        '<link name="forearm">'.join(
            [forearm[0], forearm[1].replace('<mass value="', '<mass value="-', 1)]
        )
    )
    return [
        "arms.toml",
        *(
            word
            for key, value in changes.items()
            for word in ("--set", f"{key}={json.dumps(value)}")
        ),
    ]


@pytest.mark.parametrize(
    "command", ["certify", "certify --accept open", "certify --json", "metrics", "report"]
)
def test_a_log_without_records_is_refused(command: str, tmp_path: Path) -> None:
    """Nothing is judged, measured or written if no site has a record."""
    (tmp_path / "run.mcap").write_bytes(
        edit_log_bytes(make_log_bytes("paper"), record=lambda _: None)
    )
    trilat(*command.split(), "run.mcap", cwd=tmp_path).refuses(
        "run.mcap: no site has a record in this log, so that there is nothing to judge"
    )
    assert list(tmp_path.iterdir()) == [tmp_path / "run.mcap"]


@pytest.mark.parametrize("kind", ARMS)
@pytest.mark.parametrize("command", TAKERS)
def test_bad_arms_are_named_by_every_command(command: str, kind: str, tmp_path: Path) -> None:
    settings = write_arms(kind, tmp_path)
    if command.startswith("site"):
        settings = ["--scenario", *settings]
    trilat(*command.split(), *settings, cwd=tmp_path).refuses(*ARMS[kind][2])
    assert {path.name for path in tmp_path.iterdir()} == {"arms.toml", "heavy.urdf"}


READERS = ["verify", "report", "rerun --closed-loop", "certify", "metrics", "replay", "figure"]
READERS += ["log export --to csv", "log view --save x.rrd"]


@pytest.mark.parametrize("command", READERS)
def test_an_invalid_log_is_named(command: str, tmp_path: Path) -> None:
    trilat(*command.split(), "none.mcap", cwd=tmp_path).refuses(
        "none.mcap: cannot be read: No such file"
    )
    trilat(*command.split(), ".", cwd=tmp_path).refuses("error: .: ")
    for content in (b"", b"garbage" * 100, b"\x89MCAP0\r\n", bytes(10_000)):
        (tmp_path / "bad.mcap").write_bytes(content)
        trilat(*command.split(), "bad.mcap", cwd=tmp_path).refuses("bad.mcap: is ")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.mcap"]


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


def test_a_demo_keeps_files_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("precious")
    trilat("demo", "two_sites", "--out", tmp_path, cwd=tmp_path).refuses(
        "is not empty", "--force"
    )
    trilat("demo", "two_sites", "--out", "precious", cwd=tmp_path).refuses(
        "precious", "Not a directory"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["precious"]


@pytest.mark.parametrize(
    "command",
    [
        *READERS,
        "log info",
        "log check",
        "log recover",
        "log sign --key k",
        "sim",
        "scenario check",
    ],
)
def test_a_pipe_is_refused_without_waiting(command: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "k").touch()
    name = "pipe.toml" if command in ("sim", "scenario check") else "./pipe.toml"
    trilat(*command.split(), name, cwd=tmp_path).refuses(
        "k:" if "--key" in command else "a pipe or a device"
    )


def test_pipes_are_refused_for_other_files_too(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    trilat("ping", "--zenoh-config", "pipe", cwd=tmp_path).refuses("a pipe or a device")
    for settings in (["arm.urdf=pipe"], ["link.model=trace", "link.file=pipe"]):
        options = [word for setting in settings for word in ("--set", setting)]
        trilat("scenario", "check", "two_sites", *options, cwd=tmp_path).refuses(
            "a pipe or a device"
        )


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


@pytest.mark.parametrize("number", ["nan", "inf", "9" * 4000, "0x" + "f" * 5000])
def test_unsendable_numbers_are_refused_before_sending(number: str, tmp_path: Path) -> None:
    order = ["link", "m1->s", "--to", f"deviation_ms={number}"]
    trilat("set", "--session", "x", *order, cwd=tmp_path).refuses("to.deviation_ms: must be a")


def test_a_session_has_a_short_name(tmp_path: Path) -> None:
    trilat("stop", "--session", "9" * 5000, cwd=tmp_path).refuses(
        "must have 1 to 80 characters"
    )


def test_foreign_text_cannot_control_a_terminal() -> None:
    """Texts, cells, titles and JSON contain letters alone, whatever a peer or a file put into them."""
    stream, attack = io.StringIO(), "a\x1b]0;title\x07\x9b31m\u202eb\r\ud800"
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


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    arguments = ["sim", "paper", "--duration", "0.05", "-o", "nowhere/run.mcap"]
    trilat(*arguments, cwd=tmp_path).refuses(
        "nowhere/run.mcap: cannot be written", "; the folder nowhere does not exist"
    )
