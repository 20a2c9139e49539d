"""One run: its command repeats the judged run, and its text is kept as a difference."""

import json
import pickle
import re
import shlex
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import Judge, plan_quick_sweep
from trilat_studies.sweep import sweep_cell
from trilat_studies.sweep.sweep_cell import CellClass, apply_diff, diff_lines
from trilat_studies.sweep.sweep_run import CellItem

from tests.own_laws import CompiledPD
from trilat_net.app.cli.options import load_chosen_scenario
from trilat_net.scenario import load_scenario, parse_scenario


def test_an_entry_holds_the_text_that_was_judged(tmp_path: Path, judge: Judge) -> None:
    """The stored difference restores the judged scenario, and only draws make it random."""
    plan = plan_quick_sweep(tmp_path, "link.loss=0.1", seeds=2)
    entry = CellItem(plan, plan.cell(5), 2).run()
    (text,) = judge.texts
    assert apply_diff(entry.scenario, plan.base.text) == text
    assert entry.outcome == judge(text, plan.longest_s)
    assert (entry.cell, entry.seed, entry.random, entry.law) == (5, 2, True, "adaptive")
    same = plan_quick_sweep(tmp_path)
    assert not CellItem(same, same.cell(5), 1).run().random


def test_command_of_cell_runs_its_scenario_and_length(tmp_path: Path, judge: Judge) -> None:
    """The options of the printed command give the text that was judged."""
    overrides = ("link.loss=0.1", "duration_s=0.25")
    plan = plan_quick_sweep(tmp_path, *overrides, laws=["p_d"], over=["link.delay_ms=0,20"])
    cell = plan.cell(1)
    CellItem(plan, cell, 1).run()
    command = plan.build_sim_command(cell.overrides, 1, 0.25, "a b.mcap")
    arguments = shlex.split(command)
    assert arguments[:3] == ["trilat", "sim", str(tmp_path / "trio.toml")]
    assert arguments[-6:] == ["--seed", "1", "--duration", "0.25", "-o", "a b.mcap"]
    settings = arguments[3:-6]
    assert settings[::2] == ["--set"] * (len(settings) // 2)
    assert load_chosen_scenario(arguments[2], settings[1::2], 0.25, 1).text == judge.texts[0]


@pytest.mark.usefixtures("judge")
def test_a_task_makes_equal_entries_in_another_process(tmp_path: Path) -> None:
    plan = plan_quick_sweep(tmp_path, laws=["adaptive", "p_d"], over=["link.delay_ms=0,20"])
    task = CellItem(plan, plan.cell(3), 1)
    restored_task = pickle.loads(pickle.dumps(task))
    entry = restored_task.run()
    assert entry == task.run()
    scenario = parse_scenario(apply_diff(entry.scenario, plan.base.text))
    assert scenario.sites["s"].control.K


def test_a_cell_without_valid_scenario_is_refused(tmp_path: Path) -> None:
    plan = plan_quick_sweep(tmp_path)
    cell = plan.cell(7)._replace(overrides=("link.delay_ms=60", "control.Kd=-1"))
    outcome = CellItem(plan, cell, 1).run().outcome
    assert outcome.verdict is CellClass.REFUSED
    assert outcome.verdict.stable is None
    assert re.match(r"cell 7 \(link.delay_ms=60, control.Kd=-1\): .*Kd", outcome.reasons)


@pytest.mark.parametrize("damping", [1.9245, 1.926, 1.93])
def test_stable_own_laws_are_extended_not_refused(damping: float) -> None:
    """The exact edge of this loop is at d = 1.92; above, motion decays too slowly to show."""
    changes = {"control.law": CompiledPD, "control.d": damping, "duration_s": 20.0}
    scenario = load_scenario("p_d_margin_two", changes)
    cell = sweep_cell.classify_cell(scenario.text, longest_s=40.0)
    assert cell.verdict.stable is None
    assert (cell.extended, cell.ran_s) == (1, 40.0)


texts = st.text(alphabet="ab\n ", max_size=60) | st.text(max_size=40)


@given(text=texts, base=texts)
def test_a_text_is_restored_whatever_its_reference(text: str, base: str) -> None:
    parts = diff_lines(text, base)
    assert apply_diff(parts, base) == text
    assert apply_diff(json.loads(json.dumps(parts)), base) == text


@given(
    text=texts, line=st.integers(0, 10), other=st.text(alphabet="xy", min_size=1, max_size=5)
)
def test_only_the_changed_line_differs(text: str, line: int, other: str) -> None:
    lines = text.split("\n")
    lines[line % len(lines)] = other
    parts = [part for part in diff_lines("\n".join(lines), text) if isinstance(part, str)]
    assert parts in ([other], [])


def test_a_scenario_differs_in_what_an_override_changed() -> None:
    base = load_scenario("p_d_margin")
    changed = load_scenario("p_d_margin", ["sites.m1.control.d=2.5", "seed=7"])
    parts = [part for part in diff_lines(changed.text, base.text) if isinstance(part, str)]
    assert parts == ["seed = 7", "d = [2.5, 2.5]"]
