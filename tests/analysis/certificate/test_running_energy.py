"""V of a running session equals that of `certify`, in whatever blocks the records arrive."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import trilat_net
from tests.analysis.builders import make_run
from tests.log.builders import replace_fields
from trilat_net.analysis.certificate.running_energy import (
    EnergyCourse,
    RecordWindow,
    RunningEnergy,
)
from trilat_net.log.log_reader import Log
from trilat_net.presentation.verdict_text import describe_energy_obstacle
from trilat_net.scenario import load_scenario

BLOCK = 60


def compute_courses(
    log: Log, *, late: int = 0, without: frozenset[int] = frozenset()
) -> list[EnergyCourse]:
    """Returns V of a log whose records arrive block by block, those of its last site later;
    some are missing.
    """
    running = RunningEnergy(log.scenario, kept_s=4.0)
    windows = running.windows
    courses_found = []
    blocks = max(len(log[site]) for site in log.sites) // BLOCK + late + 1
    for n in range(blocks):
        for site in log.sites:
            first = (n - late if site == log.sites[-1] else n) * BLOCK
            records = log[site].states[max(first, 0) : max(first + BLOCK, 0)]
            for record in reversed(records):  # out of order
                if site != log.sites[-1] or record.tick not in without:
                    windows[site].receive(record)
        if (
            course := running.compute_next({site: windows[site].newest for site in log.sites})
        ) is not None:
            courses_found.append(course)
    assert describe_energy_obstacle(running) == ""
    return courses_found


def join_courses(courses: list[EnergyCourse]) -> EnergyCourse:
    return EnergyCourse(*(np.concatenate(columns) for columns in zip(*courses, strict=True)))


@pytest.mark.parametrize("late", [0, 7])
def test_v_while_running_equals_that_of_log(late: int) -> None:
    """The run has changes of shares, jitter, loss, an outage, a held stale peer, limits and a wall."""
    whole = make_run("rich").balance
    course = join_courses(compute_courses(make_run("rich").log, late=late))
    rows = np.searchsorted(whole.t_s, course.t_s - 1e-9)
    assert len(set(rows.tolist())) > 0.95 * len(whole.t_s)
    most = np.abs(whole.V).max()
    assert np.abs(course.V - whole.V[rows]).max() < 1e-12 * most
    assert np.abs(course.supplied - whole.external_work[rows]).max() < 1e-10 * most


def test_v_without_some_records_is_the_incomplete_logs() -> None:
    """Unavailable records are passed over as `certify` passes over them."""
    log = make_run("rich").log
    gap = frozenset(range(700, 760))
    whole = make_run("rich").balance
    course = join_courses(compute_courses(log, without=gap))
    rows = np.searchsorted(whole.t_s, course.t_s - 1e-9)
    # the gap and the samples of it that are in use
    far = (course.t_s < 1.3) | (course.t_s > 2.2)
    assert np.abs(course.V - whole.V[rows])[far].max() < 1e-6 * np.abs(whole.V).max()
    assert np.isfinite(course.V).all()


def test_v_begins_late_in_a_session_joined_late() -> None:
    log = make_run("rich").log
    whole = make_run("rich").balance
    running = RunningEnergy(log.scenario, kept_s=4.0)
    windows = running.windows
    blocks = []
    for first in range(1200, 2400, BLOCK):
        for site in log.sites:
            for record in log[site].states[first : first + BLOCK]:
                windows[site].receive(record)
        blocks.append(running.compute_next({site: windows[site].newest for site in log.sites}))
    assert blocks[0] is None
    course = join_courses([block for block in blocks if block is not None])
    assert 2.4 < course.t_s[0] < 3.2
    rows = np.searchsorted(whole.t_s, course.t_s - 1e-9)
    assert np.abs(course.V - whole.V[rows]).max() < 1e-12 * np.abs(whole.V).max()


def test_a_law_without_v_is_reported() -> None:
    log = make_run("jitter", {"duration_s": 0.3}).log
    running = RunningEnergy(log.scenario)
    obstacle = describe_energy_obstacle(running)
    assert "p_d" in obstacle or "law" in obstacle
    assert running.compute_next(dict.fromkeys(log.sites, 100)) is None


@pytest.fixture(scope="module")
def brief_log() -> Log:
    return trilat_net.simulate("paper", {"duration_s": 0.1, "rate_hz": 100})


@given(st.sets(st.integers(0, 9), min_size=1))
def test_a_gap_keeps_its_last_samples(brief_log: Log, received: set[int]) -> None:
    """A row has the samples in use of its record, or else of the last record before; rows
    before all records have those of the first.
    """
    window = RecordWindow(brief_log.scenario, "m1")
    states = brief_log["m1"].states
    for tick in received:
        used = {"m2": 7 * tick, "s": 3 * tick + 1}
        mode = "run" if tick % 2 else "hold"
        window.receive(replace_fields(states[tick], used=used, mode=mode))
    window.receive(replace_fields(states[0], tick=10, used={"m2": 70, "s": 31}, mode="hold"))
    rows = window.rows(0, 10)
    for row in range(11):
        earlier = [tick for tick in (*received, 10) if tick <= row]
        source = max(earlier, default=min(received))
        assert rows.used["m2"][row] == 7 * source
        assert rows.used["s"][row] == 3 * source + 1
        assert rows.follows[row] == bool(source % 2)
        assert rows.known[row] == (row in received or row == 10)


@settings(max_examples=20)
@given(st.sets(st.integers(0, 99), min_size=1), st.sampled_from(["glide", "brake"]))
def test_only_a_gliding_site_rests(brief_log: Log, resting: set[int], action: str) -> None:
    """A site that glides rests from a resting mode until 0.2 s later."""
    overrides = {"rate_hz": 100, "on_stale.action": action, "on_stale.age_ms": 450.0}
    window = RecordWindow(load_scenario("paper", overrides), "m1")
    states = brief_log["m1"].states
    for tick in range(100):
        mode = "hold" if tick in resting else "run"
        window.receive(replace_fields(states[tick % 10], tick=tick, mode=mode))
    expected = [
        action == "glide" and any(tick - 20 <= rest <= tick for rest in resting)
        for tick in range(100)
    ]
    assert window.rows(0, 99).rests.tolist() == expected


@given(st.sets(st.integers(0, 99), min_size=2))
@example(set(range(0, 99, 2)))
def test_a_full_window_knows_only_received_records(brief_log: Log, received: set[int]) -> None:
    """A record that never came stays missing after the window has moved on."""
    window = RecordWindow(brief_log.scenario, "m1", kept_s=0.1)
    states = brief_log["m1"].states
    for tick in sorted(received):
        assert window.receive(replace_fields(states[tick % 10], tick=tick))
    assert window.newest == max(received)
    stored = [tick for tick in range(110) if window.has_record(tick)]
    assert stored == sorted(tick for tick in received if tick >= window.first)
    kept = [tick for tick in received if tick > window.newest - 10]
    assert set(kept) <= set(stored)
