"""docs/data/laws-unit-arm.csv: every number names its test, and those of this file are recomputed here."""

import csv
import runpy
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import trilat_net as tn
from tests.energy_runs import make_energy_pair, sample_contact_run, sample_every_tick

ROOT = Path(__file__).parents[2]
WAVE = runpy.run_path(str(ROOT / "examples" / "wave_law.py"))["Wave"]
HERE = "tests/control_laws/test_numbers_of_the_unit_arm.py"
with (ROOT / "docs/data/laws-unit-arm.csv").open(encoding="utf-8", newline="") as file:
    ROWS = list(csv.DictReader(file))


class WaveOfVelocity(WAVE):  # type: ignore[misc, valid-type]
    """A wave line whose waves carry qd h instead of the arm's actual step."""

    sends: ClassVar = {"u": {"unit": "sqrt(W)", "length": "joints", "per_peer": True}}

    def push(self, now: tn.LawInput, j: int, i: int, v: float) -> tuple[float, float]:
        force, _ = super().push(now, j, i, v)
        sent_wave = self.c * now.qd[i] - v
        return force, sent_wave


def list_values(quantity: str, settings: str = "") -> list[float]:
    """Returns the numbers of the page that this file computes, in order."""
    return [
        float(row["value"])
        for row in ROWS
        if row["test"] == HERE
        and row["quantity"].startswith(quantity)
        and row["settings"].endswith(settings)
    ]


def run_free(law: Any) -> dict[str, Any]:
    """Returns five seconds of a free slave; its arms are farthest apart within them."""
    return sample_every_tick(make_energy_pair({"law": law}, clamped=False, duration_s=5.0))


def measure_distance(run: dict[str, Any]) -> float:
    return float(np.abs(run["m"].q - run["s"].q)[:, 0].max())


def felt_stiffness(run: dict[str, Any], to_s: int) -> float:
    """Returns torque over angle of the master, both averaged over the ten seconds before a time; N m/rad."""
    rows = slice(1000 * (to_s - 10), 1000 * to_s)
    return float(abs(run["m"].tau_x[rows, 0]).mean() / run["m"].q[rows, 0].mean())


def test_every_number_names_its_test() -> None:
    assert len(ROWS) > 80
    assert [row for row in ROWS if not (row["test"] and (ROOT / row["test"]).is_file())] == []


def test_distance_and_force_of_a_free_wave_line() -> None:
    run = run_free("wave")
    assert list_values("largest distance", "K = 100") == [
        pytest.approx(measure_distance(run), abs=6e-5)
    ]
    assert list_values("largest F") == [pytest.approx(-run["m"].tau[:, 0].min(), abs=6e-4)]


def test_distance_of_a_line_whose_waves_carry_velocity() -> None:
    run = run_free(f"{__name__}:WaveOfVelocity")
    assert list_values("largest distance", "qd h") == [
        pytest.approx(measure_distance(run), abs=6e-5)
    ]


@pytest.mark.long
def test_an_acceleration_margin_lowers_stiffness_while_active() -> None:
    run = sample_contact_run(120.0, duration_s=30.0, acceleration_rad_s2=100.0)
    assert list_values("stiffness felt") == [
        pytest.approx(felt_stiffness(run, to_s), abs=0.06) for to_s in (20, 30)
    ]


@pytest.mark.parametrize(
    ("loss", "row"), [(0.0, 0), pytest.param(0.5, 1, marks=pytest.mark.long)]
)
def test_books_of_steps_hardly_chatter(loss: float, row: int) -> None:
    tau = sample_contact_run(136.0, loss=loss)["m"].tau[10000:, 0]
    stated = list_values("chatter")[row]
    assert np.abs(np.diff(tau)).mean() == pytest.approx(stated, abs=6e-5)
