"""Machine code of the cache: what one process has compiled another may load, beside that of a third."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.core.compiled import printed

SYMBOLS = """
import numba, numpy as np
from numba.core.itanium_mangler import mangle
from trilat_net.core.site_arrays import site_dtype
from trilat_net.core.site_setup import Layout
for n in {}:
    site = numba.typeof(np.zeros(1, site_dtype(Layout(n, n, 10 * n, True))))
    print(n, mangle("leaf", [site, site.dtype]))
"""


def test_symbols_of_leaves_tell_layouts_apart() -> None:
    """As Numba numbers them, the first layout of any process has the symbols of any other's."""
    one, other = (
        dict(line.split() for line in printed(SYMBOLS.format(order), compiled=True).splitlines())
        for order in ((6, 7), (7, 6))
    )
    assert one == other
    assert one["6"] != one["7"]


CLOSURES = """
import sys, numba, numpy as np
from trilat_net.core.jit import compile_named
for factor in map(float, sys.argv[1:]):
    def call(values):
        for i in range(values.shape[0]):
            values[i] *= factor
    made = compile_named(call, f"times_{factor}", numba.types.none(numba.float64[::1]))
    made(values := np.ones(1))
    print(values[0], made.stats.cache_hits.total())
"""


def test_equal_closures_of_two_processes_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As built-in laws are: the same numbers in and out, another torque; one process loads them all."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "closures.py"
    file.write_text(CLOSURES)
    run = [
        subprocess.run([sys.executable, file, *factors], capture_output=True, text=True, check=True).stdout
        for factors in ("2", "3", "23")
    ]
    assert [said.split() for said in run] == [["2.0", "0"], ["3.0", "0"], ["2.0", "1", "3.0", "1"]]
