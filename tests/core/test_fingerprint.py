"""The fingerprint of a platform's arithmetic (L5)."""

import pytest

from tests.programs import run_python
from trilat_net.core.step.fingerprint import compute_fingerprint

PROGRAM = "from trilat_net.core.step.fingerprint import compute_fingerprint; print(compute_fingerprint())"


@pytest.mark.parametrize("compiled", [False, True])
def test_fingerprints_are_sixteen_digits_in_every_process(compiled: bool) -> None:
    assert f"{int(compute_fingerprint(), 16):016x}" == compute_fingerprint()
    assert run_python(PROGRAM, compiled=compiled).strip() == compute_fingerprint()
