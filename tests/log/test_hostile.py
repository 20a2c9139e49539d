"""Nobody who reads a log believes it: a sentence or an answer, never a traceback, never much memory."""

import io
import json
import os
import random
import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode

from tests.log.builders import edit_log_bytes, make_log_bytes, open_bytes, write_log
from tests.log.hostility import CHANGES, make_chunk, mangle_log, read_by_all
from trilat_net.analysis.file_overview import info
from trilat_net.errors import LogError, ScenarioError
from trilat_net.execution.verification import verify_log
from trilat_net.log.mcap_records import RecordScanner, iterate_records, unpack_chunk
from trilat_net.scenario import load_scenario, parse_embedded

SHORT = {"duration_s": 0.04, "link.delay_ms": 5.0}
DATA = edit_log_bytes(make_log_bytes("paper", SHORT), chunk_bytes=4096)
WHOLE = make_log_bytes("paper", SHORT)
MEMORY_MIB = 256


@pytest.mark.parametrize("change", dict.fromkeys(CHANGES), ids=lambda change: change.__name__)
@settings(max_examples=4)
@given(seed=st.integers(0, 2**32), whole=st.booleans())
def test_any_change_gets_a_sentence_as_answer(
    change: Callable[[bytes, Any], bytes], seed: int, whole: bool
) -> None:
    """open_log and its arrays, verify, info, check, recover and replay: an answer or a `TrilatError`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "changed.mcap"
        path.write_bytes(change(WHOLE if whole else DATA, random.Random(seed)))
        for complaint in read_by_all(path).values():
            assert "Traceback" not in complaint


@settings(max_examples=6)
@given(st.integers(0, 2**32))
def test_several_changes_get_an_answer(seed: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "changed.mcap"
        path.write_bytes(mangle_log(DATA, random.Random(seed)))
        read_by_all(path)


def _make_file(messages: Iterator[bytes], most: int, seconds: float = 3600.0) -> bytes:
    """A log of a mebibyte whose site m1 has these records, and as many of them as a reader may be given."""
    log = edit_log_bytes(
        WHOLE,
        scenario=lambda text: text.replace("duration_s = 0.04", f"duration_s = {seconds}"),
    )
    framing = RecordScanner(io.BytesIO(log))
    first = next(frame for frame in framing.frames() if frame.opcode == Opcode.CHUNK)
    inside = unpack_chunk(framing.content(first))
    names = b""
    channel = 0
    for opcode, begin, end in iterate_records(inside):
        if opcode != Opcode.MESSAGE:
            names += inside[begin - 9 : end]
        elif not channel and b"/m1/state" in names:
            channel = struct.unpack_from("<H", inside, begin)[0]
    padding = os.urandom(1_000_000)
    content = struct.pack("<QQIIQ", 0, 0, 0, 0, len(padding)) + padding + bytes(4)
    records = [
        struct.pack("<BQHIQQ", 5, 22 + len(payload), channel, 0, 0, 0) + payload
        for _, payload in zip(range(most), messages, strict=False)
    ]
    packed = [
        make_chunk(names + b"".join(records[k : k + 20_000]))
        for k in range(0, len(records), 20_000)
    ]
    return (
        log[: first.offset] + struct.pack("<BQ", 9, len(content)) + content + b"".join(packed)
    )


def _make_records(**fields: Any) -> Iterator[bytes]:
    """Records of m1 that are valid, small, and say what is given besides."""
    zeros = {"q": 2, "qd": 2, "q_des": 2, "qd_des": 2, "tau": 2, "tau_x": 2, "theta_hat": 5}
    about = {
        "v": 3,
        "site": "m1",
        "boot": 1,
        "mode": "run",
        "used": {},
        "rx": [],
        "rx_crc": 0,
        "cmd": [],
    }
    plain = (
        {name: [0] * count for name, count in zeros.items()}
        | about
        | {"mem": [], "late_us": 0, "busy_us": 0}
    )
    k = 0
    while True:
        yield msgpack.packb({**plain, "tick": k, "t_ns": k * 1_000_000, **fields})
        k += 1


HUGE: dict[str, Callable[[], bytes]] = {
    "records that take in what nobody sent": lambda: _make_file(
        _make_records(rx=[[0, 0, 0]] * 30), 23_000
    ),
    "messages without a byte": lambda: _make_file(iter(lambda: b"", None), 100_000),
}


@pytest.mark.long
@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=pytest.mark.long if "records" in kind else ()) for kind in HUGE],
)
def test_a_mebibyte_never_takes_more_than_256(kind: str, tmp_path: Path) -> None:
    """Peak resident memory of a process that reads such a file in every way, the interpreter and all."""
    path = write_log(tmp_path, HUGE[kind](), "huge.mcap")
    assert path.stat().st_size < 1.3 * 2**20
    program = (
        "import sys; from pathlib import Path\n"
        "from tests.log.hostility import READERS\n"
        "from trilat_net.errors import TrilatError\n"
        "open('/proc/self/clear_refs', 'w').write('5')\n"
        "for name in sys.argv[2:]:\n"
        "    try: READERS[name](Path(sys.argv[1]))\n"
        "    except TrilatError: pass\n"
        "print(*(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))\n"
    )
    hungriest = ("arrays", "verify", "check", "recover")
    command = [sys.executable, "-c", program, str(path), *hungriest]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2]
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) / 1024 < MEMORY_MIB


def test_ticks_outside_the_scenario_are_refused() -> None:
    """Nobody counts up to a number that a stranger wrote, nor keeps a place for every one before it."""
    data = edit_log_bytes(
        DATA, record=lambda r: {**r, "tick": (1 << 40) - 1} if r["tick"] == 9 else r
    )
    log = open_bytes(data)
    with pytest.raises(
        LogError,
        match=r"has a record of tick 1099511627775, but the scenario has only 40\d* ticks",
    ):
        _ = log["m1"]


def test_claims_of_endless_ticks_are_refused() -> None:
    log = open_bytes(edit_log_bytes(WHOLE, record=lambda r: None if r["tick"] > 30 else r))
    endless = [
        msgspec.structs.replace(e, ticks=1 << 60) if e.kind == "end" else e for e in log.events
    ]
    log.events = endless
    assert verify_log(log).gaps == [(site, 31, 39) for site in log.sites]
    assert [log.missing(site) for site in log.sites] == [9] * 3


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a = " + "[" * 5000, "nested too deep"),
        ("a = " + "1" * 5000, "is not TOML"),
        ("seed = 0x" + "f" * 4000, "at most 64 bits, but has 16000 bits"),
        ("[" + "a." * 3000 + "a]", "more than 32 parts"),
        ("a" * 100 + " = {" + "a." * 20_000 + "a = 1}", "line 1: a key has more than 32 parts"),
        (
            "name = 'x'\n[dominance]\n" + "".join(f"[sites.a{n}]\n" for n in range(40)),
            "at most 32",
        ),
    ],
)
def test_foreign_scenarios_are_refused_in_a_sentence(text: str, problem: str) -> None:
    with pytest.raises(ScenarioError, match=problem):
        parse_embedded(text)


def test_a_scenario_in_a_log_names_no_file() -> None:
    """It is resolved; a name in it would have the reader open what a stranger likes."""
    constant = re.compile(r'model = "constant"\ndelay_ms = [0-9.]+\n')
    text = constant.sub(
        'model = "trace"\nfile = "/dev/zero"\n', load_scenario("paper").text, count=1
    )
    with pytest.raises(ScenarioError, match="no file may be named here"):
        parse_embedded(text)


def test_traces_of_too_many_links_are_refused() -> None:
    """Written out it would fill the memory; a scenario that ran has every link's own."""
    text = load_scenario("paper").text
    head, _, links = text.partition("[links.")
    points = ", ".join(f"{n} 1" for n in range(0, 90_000, 3))
    assert links
    text = head + f'[link]\nmodel = "trace"\ntrace = "{points}"\n'
    with pytest.raises(ScenarioError, match="not written out"):
        parse_embedded(text)


def test_links_that_would_fill_the_memory_are_refused() -> None:
    """A calendar of ten seconds at 20 kHz for each of many peers."""
    names = [f"a{n}" for n in range(6)]
    sites = "".join(f"[sites.{name}]\n" for name in names)
    rows = "".join(
        f"[dominance.{name}]\n{names[n - 1]} = 1.0\n" for n, name in enumerate(names)
    )
    text = f"name = 'x'\nrate_hz = 20000\n[link]\ndelay_ms = 9e3\n{sites}{rows}"
    assert parse_embedded(text.replace("20000", "1000")).names == tuple(names)
    assert parse_embedded(text.replace("9e3", "1.0")).names == tuple(names)
    with pytest.raises(
        ScenarioError,
        match=r"the links of this site would need \d+ MiB, but at most 64 MiB are allowed",
    ):
        parse_embedded(text)


def test_json_is_always_finite(tmp_path: Path) -> None:
    """What a machine is told can be read by it, whatever the file says."""
    path = tmp_path / "strange.mcap"
    path.write_bytes(
        edit_log_bytes(DATA, record=lambda r: {**r, "late_us": -(1 << 63), "t_ns": 1 << 62})
    )
    json.dumps(info(path).facts, allow_nan=False)
