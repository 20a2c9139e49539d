"""Commands without disk, memory or help texts, or interrupted while compiling: each reports the
cause plainly.
"""

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.cli.running import COMMAND, PLAIN, trilat
from tests.log.builders import write_log
from trilat_net.core.step.jit import COMPILING
from trilat_net.signals import ENDING_SIGNALS, Interrupt, end_process_at_signals

LOG = Path(__file__).parents[1] / "golden" / "v3.mcap"
WITHOUT_COMPILING = {**PLAIN, "NUMBA_DISABLE_JIT": "1", "PYTHONDONTWRITEBYTECODE": "1"}
"""Of short files Python would keep modules that are cut off."""


def run_limited(
    kind: int, most: int, *arguments: str | Path, cwd: Path
) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [*COMMAND, *map(str, arguments)],
        cwd=cwd,
        env=WITHOUT_COMPILING,
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(kind, (most, most)),
    )


@pytest.mark.long
@pytest.mark.parametrize(
    "form", ["pdf", *(pytest.param(form, marks=pytest.mark.long) for form in ("svg", "png"))]
)
def test_figures_refused_by_disk_leave_no_file(form: str, tmp_path: Path) -> None:
    done = run_limited(
        resource.RLIMIT_FSIZE,
        1000,
        "figure",
        LOG,
        "positions",
        "--format",
        form,
        "-o",
        "f",
        cwd=tmp_path,
    )
    assert done.returncode == 5
    *progress, error = done.stderr.splitlines()
    assert error == f"error: f/positions.{form} cannot be written: File too large"
    assert set(progress) <= {"drawing ..."}  # on a busy machine
    assert list((tmp_path / "f").iterdir()) == []


def test_keys_refused_by_disk_leave_no_file(tmp_path: Path) -> None:
    done = run_limited(resource.RLIMIT_FSIZE, 100, "keys", "new", "k", "m1", cwd=tmp_path)
    assert done.returncode == 5
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        "error: k cannot be written: File too large; no partial file was left"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("mib", "arguments"), [(40, ("log", "check")), (420, ("certify",)), (900, ("verify",))]
)
def test_too_little_memory_is_one_line(
    mib: int, arguments: Sequence[str], tmp_path: Path
) -> None:
    """With `ulimit -v` libraries cannot be loaded, or retry for ever."""
    done = run_limited(resource.RLIMIT_AS, mib << 20, *arguments, LOG, cwd=tmp_path)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "error: there is too little memory" in done.stderr


@pytest.mark.long
def test_without_docstrings_commands_work_but_have_no_help(tmp_path: Path) -> None:
    program = [sys.executable, "-OO", "-m", "trilat_net"]
    for arguments, said in (
        (["keys", "new", "--help"], "left out by python -OO"),
        (["keys", "new", "k", "m"], "k/m"),
    ):
        done = subprocess.run(
            [*program, *arguments],
            cwd=tmp_path,
            env=PLAIN,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert said in done.stdout


def test_recovering_blames_the_unwritable_file(tmp_path: Path) -> None:
    """An earlier recovery left a file there that cannot be removed; the source can be read."""
    write_log(tmp_path, LOG.read_bytes(), "run.mcap.active")
    (tmp_path / "run.mcap.recovering").mkdir()
    trilat("log", "recover", "run.mcap.active", cwd=tmp_path).refuses(
        "run.mcap.recovering cannot be written"
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ("scenario", "check"),
        ("trace", "import", "irtt"),
        ("trace", "import", "ping"),
        ("trace", "import", "csv"),
        ("record", "--session", "x", "--zenoh-config"),
        ("log", "check", str(LOG), "--key"),
        ("keys", "info"),
    ],
    ids=lambda arguments: " ".join(Path(word).name for word in arguments),
)
def test_contents_of_foreign_files_are_not_repeated(
    arguments: tuple[str, ...], tmp_path: Path
) -> None:
    """The reader of the error may not be allowed to read that file."""
    for text in (
        "root:secret:19000:0\n",
        "secret, words\n1, 2\n",
        '["secret"]\n',
        "t_s,delay_ms\nsecret,1\n",
    ):
        (tmp_path / "foreign").write_text(text)
        more = ("-o", "made.csv") if arguments[0] == "trace" else ()
        done = trilat(*arguments, "foreign", *more, cwd=tmp_path)
        assert done.code == 2, done
        assert "foreign" in done.err
        assert "secret" not in done.err + done.out


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.long)]
)
@pytest.mark.parametrize(
    "arguments", [("site", "m1", "-s", "paper"), ("sim", "paper", "-o", "x.mcap")], ids=" ".join
)
def test_cold_starts_say_they_compile_and_stop(
    arguments: tuple[str, ...], number: signal.Signals, tmp_path: Path
) -> None:
    """Python handles a signal between two instructions, and one call of the compiler takes minutes."""
    cold = {**PLAIN, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    started = subprocess.Popen(
        [*COMMAND, *arguments], cwd=tmp_path, env=cold, stderr=subprocess.PIPE, text=True
    )
    assert started.stderr is not None
    try:
        assert started.stderr.readline().strip() == COMPILING  # this is no terminal
        started.send_signal(number)
        assert started.wait(60.0) in (-number, 128 + number)
    finally:
        started.kill()
        started.wait()
        started.stderr.close()


AT_AN_INSTANT = """
import os, sys, threading, time
instant_s, number = float(sys.argv[1]), int(sys.argv[2])
def end() -> None:
    pause = threading.Event()
    while time.process_time() < instant_s:
        pause.wait(0.01)
    os.kill(os.getpid(), number)
threading.Thread(target=end, daemon=True).start()
from trilat_net.__main__ import main
sys.argv[:] = ["trilat", *sys.argv[3:]]
main()
"""
"""A command that gets a signal when it has used so much of a processor, s."""


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(n, marks=pytest.mark.long) for n in range(2, 16))]
)
def test_signals_end_cold_starts_in_every_phase(seed: int, tmp_path: Path) -> None:
    """The signal arrives during imports, reading, compilation or caching."""
    draw = random.Random(seed)
    number = draw.choice(ENDING_SIGNALS)
    instant_s = draw.uniform(0.2, 8.0)
    arguments = draw.choice([("sim", "paper", "-o", "x.mcap"), ("demo", "--out", "x")])
    command = [
        sys.executable,
        "-c",
        AT_AN_INSTANT,
        f"{instant_s:.3f}",
        str(int(number)),
        *arguments,
    ]
    cold = {**PLAIN, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run(
        command, cwd=tmp_path, env=cold, capture_output=True, text=True, timeout=300
    )
    assert done.returncode in (-number, 128 + number), done.stderr


def test_signals_end_a_containers_compiling_process(tmp_path: Path) -> None:
    """The kernel delivers no signal to such a process unless the process has a handler for it."""
    first = ["unshare", "--user", "--map-root-user", "--pid", "--fork", "--kill-child"]
    if (
        shutil.which("unshare") is None
        or subprocess.run([*first, "true"], capture_output=True).returncode
    ):
        pytest.skip("no process can be the first of a namespace here")
    instant_s = "4.0"
    number = signal.SIGTERM
    command = [*first, sys.executable, "-c", AT_AN_INSTANT, instant_s, str(int(number))]
    cold = {**PLAIN, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run(
        [*command, "sim", "paper", "-o", "x.mcap"], cwd=tmp_path, env=cold, timeout=300
    )
    assert done.returncode == 128 + number


def test_signals_kill_compiling_only_where_safe() -> None:
    # as under nohup
    ours = [name for name in ENDING_SIGNALS if signal.getsignal(name) is not signal.SIG_IGN]

    def handlers() -> list[object]:
        return [signal.getsignal(name) for name in ours]

    def released() -> bool:
        before = handlers()
        restore = end_process_at_signals()
        during = handlers()
        restore()
        assert handlers() == before
        return during == [signal.SIG_DFL] * len(before)

    with Interrupt() as orderly:
        assert not released()
        with orderly.raising():
            assert released()
        with Interrupt():  # as where a session has children
            assert not released()
    with Interrupt(compiles=True):
        assert released()


def test_signal_in_inner_part_sets_outer_exit_code() -> None:
    with Interrupt() as outer:
        with pytest.raises(KeyboardInterrupt), Interrupt() as inner, inner.raising():
            os.kill(os.getpid(), signal.SIGTERM)
        assert outer.exit_code == 128 + signal.SIGTERM
