"""The recipe for pytest, as it stands in the documentation, run by pytest."""

import os
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as Xml
from pathlib import Path

import trilat_net.studies.trials

RECIPE = textwrap.dedent(str(trilat_net.studies.trials.__doc__).split("per seed:\n")[1].split("\nOr all")[0])


def test_the_recipe_gives_a_test_per_seed_that_fails_with_figures(quick_file: Path, tmp_path: Path) -> None:
    """The same lines on a scenario that holds, and on one that does not."""
    assert len(RECIPE.strip().splitlines()) <= 10
    for good in (True, False):
        source = tmp_path / f"scenario_{good}.toml"
        source.write_text(
            quick_file.read_text().replace("max_ms = 100.0", f"max_ms = {100.0 if good else 1.0}")
        )
        (tmp_path / f"test_{good}.py").write_text(RECIPE.replace('"jitter"', repr(str(source))))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--junitxml=out.xml"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(trilat_net.__path__[0]).parent)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    cases = list(Xml.parse(tmp_path / "out.xml").iter("testcase"))
    failed = {(case.get("classname"), case.get("name")) for case in cases if case.find("failure") is not None}
    assert len(cases) == 10
    assert failed == {("test_False", f"test_jitter[quick-seed{seed}]") for seed in range(1, 6)}
    assert "mean_age_max_ms: " in done.stdout
    assert "trilat sim " in done.stdout
