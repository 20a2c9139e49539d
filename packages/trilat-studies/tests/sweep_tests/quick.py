"""Sweeps that take milliseconds (three sites, half a second, 100 Hz), and a judge that only reads texts."""

import hashlib
from pathlib import Path

from trilat_studies.sweep.sweep_cell import CellClass, CellResult
from trilat_studies.sweep.sweep_plan import SweepPlan, plan_sweep
from tuning_tests.experiments import TRIO

from trilat_net.analysis.run_end import EndBehaviour

SHORT = TRIO.replace("duration_s = 2.0", "duration_s = 0.5")
DELAYS = "link.delay_ms=0:40:20"
DAMPING = "control.Kd=1:4:1"


def plan_quick_sweep(folder: Path, *overrides: str, **settings: object) -> SweepPlan:
    """Returns a request for a sweep of the quick scenario, as a file."""
    path = folder / "trio.toml"
    if not path.exists():
        path.write_text(SHORT)
    return plan_sweep(path, overrides, **{"over": (DELAYS, DAMPING), **settings})  # type: ignore[arg-type]


class Judge:
    """Stands for the judge: outcomes are a function of the text, and every question is kept."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def __call__(self, text: str, longest_s: float) -> CellResult:
        self.texts.append(text)
        return outcome_of(text, longest_s)


def outcome_of(text: str, longest_s: float = 4.0) -> CellResult:
    """Returns an outcome that differs for nearly every text."""
    digest = hashlib.sha256(text.encode()).digest()
    number = int.from_bytes(digest[:6], "big") / 2**48
    verdict = list(CellClass)[digest[7] % 4]
    diverged_s = 0.25 if verdict is CellClass.DIVERGED else None
    return CellResult(
        verdict=verdict,
        motion=list(EndBehaviour)[digest[8] % 6],
        ran_s=diverged_s or longest_s,
        extended=digest[9] % 4,
        end_error_rad=number,
        end_speed_rad_s=number / 3.0,
        error_rate_per_s=None if digest[10] % 2 else -number,
        speed_rate_per_s=number * 1e-300,
        peak_error_rad=1.0 / 3.0 + number,
        settled_s=None if digest[11] % 2 else number,
        diverged_s=diverged_s,
    )
