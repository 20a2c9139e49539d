"""The fingerprint of a platform's arithmetic (L5)."""

import os
import subprocess
import sys

from trilat_net.core.fingerprint import compute_fingerprint

_PROGRAM = "from trilat_net.core.fingerprint import compute_fingerprint; print(compute_fingerprint())"


def test_it_is_sixteen_digits_and_the_same_in_every_process_compiled_or_not() -> None:
    assert len(compute_fingerprint()) == 16
    int(compute_fingerprint(), 16)
    for disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        done = subprocess.run(
            [sys.executable, "-c", _PROGRAM], env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout.strip() == compute_fingerprint()
