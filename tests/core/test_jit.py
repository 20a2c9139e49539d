"""Machine code in the cache: code of one process may be loaded by another, beside that of a third."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.programs import run_python

SYMBOLS = """
import numba, numpy as np
from numba.core.itanium_mangler import mangle
from trilat_net.core.step.site_arrays import site_dtype
from trilat_net.core.step.site_setup import Layout
for n in {}:
    site = numba.typeof(np.zeros(1, site_dtype(Layout(n, n, 10 * n, True))))
    print(n, mangle("leaf", [site, site.dtype]))
"""


def test_symbols_of_leaves_separate_layouts() -> None:
    """With Numba's numbering, the first layouts of all processes would have equal symbols."""
    first, other = (
        dict(
            line.split()
            for line in run_python(SYMBOLS.format(order), compiled=True).splitlines()
        )
        for order in ((6, 7), (7, 6))
    )
    assert first == other
    assert first["6"] != first["7"]


CLOSURES = """
import sys, numba, numpy as np
from trilat_net.core.step.jit import compile_named
for factor in map(float, sys.argv[1:]):
    def call(values):
        for i in range(values.shape[0]):
            values[i] *= factor
    made = compile_named(call, f"times_{factor}", numba.types.none(numba.float64[::1]))
    made(values := np.ones(1))
    print(values[0], made.stats.cache_hits.total())
"""


def test_equal_closures_of_two_processes_are_separate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Like built-in laws, they have equal signatures and different torques; one process loads
    all of them.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "closures.py"
    file.write_text(CLOSURES)
    run = [
        subprocess.run(
            [sys.executable, file, *factors], capture_output=True, text=True, check=True
        ).stdout
        for factors in ("2", "3", "23")
    ]
    assert [said.split() for said in run] == [
        ["2.0", "0"],
        ["3.0", "0"],
        ["2.0", "1", "3.0", "1"],
    ]


LEAVES = """
import sys
import numpy as np
from numba.core import event
from pathlib import Path
from trilat_net.core.step import jit
jit._SHIPPED = Path(sys.argv[1], jit._SHIPPED.name)
jit._ships = jit._SHIPPED.is_dir()

class Count(event.Listener):
    number = 0
    def on_start(self, _): self.number += 1
    def on_end(self, _): pass

event.register("numba:compile", count := Count())
from trilat_net.core.arms import elementary
from trilat_net.core.links import philox
for k in range(50):
    print(*(float(one).hex() for one in (
        philox.standard_gamma(np.uint64(5), k, 3, 1.5 + k),
        *elementary.sincos(0.3 * k), elementary.tanh(0.1 * k),
    )))
print(count.number)
"""


def run_leaves(folder: Path, cache: Path, **more: str) -> tuple[str, int]:
    """Returns the results of leaves with a wheel's folder and a user's cache, and how many were
    compiled.
    """
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache), **more}
    program = [sys.executable, "-c", LEAVES, folder]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
    *said, number = done.stdout.splitlines()
    return "\n".join(said), int(number)


def test_wheels_compile_nothing_and_keep_the_bits(tmp_path: Path) -> None:
    host, compiled = run_leaves(tmp_path / "none", tmp_path / "host")
    generic, _ = run_leaves(tmp_path / "none", tmp_path / "generic", NUMBA_CPU_NAME="generic")
    within = shutil.ignore_patterns("*-within*")
    shutil.copytree(tmp_path / "generic/trilat-net", tmp_path / "shipped", ignore=within)
    assert compiled > 0
    assert run_leaves(tmp_path / "shipped", tmp_path / "empty") == (host, 0)
    assert generic == host
    (tmp_path / "file").touch()  # no cache can be made there
    assert run_leaves(tmp_path / "shipped", tmp_path / "file") == (host, 0)


CALLERS = """
import sys, numba
from trilat_net.core.step.jit import leaf
@leaf
def double(x): return 2.0 * x
@numba.njit
def plain(x): return double(x) - 1.0
if "callees first" in sys.argv:
    double(1.5), plain(3.0)
@leaf
def caller(x): return plain(x) + double(x + 1.0)
print(caller(2.0), plain(3.0), double(1.5))
print(double.stats.cache_hits.total() > 0, caller.stats.cache_hits.total() > 0)
"""


def run_callers(file: Path, *arguments: str) -> list[str]:
    command = [sys.executable, file, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_loaded_machine_code_has_compiled_callers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second process compiles a caller beside machine code that it loaded, and the third
    process loads the caller alone.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "callers.py"
    file.write_text(CALLERS)
    results = "9.0 5.0 3.0"
    assert run_callers(file, "callees first") == [results, "False False"]
    for stored in tmp_path.rglob("callers.caller*"):
        stored.unlink()
    assert run_callers(file, "callees first") == [results, "True False"]
    assert run_callers(file) == [results, "True True"]
