"""The documentation: every number has a test or a command beside it; commands, tests and limits exist."""

import ast
import csv
import math
import re
from functools import cache
from pathlib import Path
from typing import get_args

import pytest
from trilat_people.devices import haply_inverse3, spacemouse
from trilat_studies.bench import bench_plan, bench_results, bench_run
from trilat_studies.sweep import margin_search, sweep_cell, sweep_plan, sweep_run
from trilat_studies.tuning import candidate, search_space, tuning_plan

from recorder import backfill, record_process, site_reception
from sites import change_server, code_watchdog, external_arm, retransmit_buffer, site_end
from trilat_net.analysis import (
    arm_rows,
    delay_period,
    run_end,
    site_signals,
    stability_decision,
)
from trilat_net.analysis.certificate import functional_judgements, observed_energy, premises
from trilat_net.analysis.metrics import measured_impedance, motion_metrics, static_windows
from trilat_net.analysis.theory import (
    characteristic_roots,
    equilibrium,
    floquet,
    linear_analysis,
    linear_edge,
    port_response,
)
from trilat_net.analysis.twins import envelope_trend, twin_growth, twin_runs
from trilat_net.app import machine_load
from trilat_net.app.play import player
from trilat_net.core.life import live_hand, session_life
from trilat_net.core.links import delay, link
from trilat_net.core.plug import user_law
from trilat_net.core.step import site_arrays, ticks
from trilat_net.execution import verification
from trilat_net.files import find_page
from trilat_net.log import accounting, log_file, mcap_reader, mcap_records, site_log
from trilat_net.net import arm_client, offset, requests, session, timing, zenoh_config
from trilat_net.scenario import laws, link_presets, operators, written_tables
from trilat_net.scenario.delay_models import DELAY_MODELS
from trilat_net.work import dask_cluster, executor

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
UNITS = r"%|rad|N m|N/m|N\b|J\b|s\b|ms\b|us\b|Hz|kHz|[MkG]i?B|dB|/s\b|ppm|min\b"
NUMBER = re.compile(rf"(?<![\w.-])\d+(?:\.\d+)?(?:e-?\d+)? ?(?:{UNITS})")
PROGRAMS = "trilat|make|python|docker"
EVIDENCE = re.compile(
    rf"tests/[\w/]+|\btest_\w+|^(?: {{4}}|\$ |)(?:\$ )?(?:{PROGRAMS}) |`(?:{PROGRAMS}|--set) ?[^`]*`",
    re.MULTILINE,
)

MOST_RANDOM_ERROR = math.sqrt(
    (measured_impedance.MIN_COHERENCE**-2 - 1.0) / (2.0 * measured_impedance.MIN_SEGMENTS)
)
STATED: list[tuple[str, str, float, float]] = [
    ("bench-method.md", "16 candidates per gain", 16, bench_plan.TUNING_BUDGET),
    ("bench-method.md", "with 1.5 times the delay", 1.5, bench_plan.TUNING_MARGIN),
    ("data/bench-columns.csv", "faster than 5 rad/s", 5, bench_run.BOUND_RAD_S),
    ("data/bench-columns.csv", "is at least -1 mJ", -1, 1e3 * bench_results.PASSIVE_J),
    ("data/bench-columns.csv", "less than 2 s before the end", 2, bench_run.REST_S),
    ("bench-method.md", "limit of 3 million", 3, 1e-6 * bench_run.MAX_RUN_TICKS),
    ("data/bench-columns.csv", "what the user feels of the wall 2 s", 2, bench_run.STIFFNESS_S),
    ("data/bench-columns.csv", "averaged over 0.2 s", 0.2, bench_run.STIFFNESS_WINDOW_S),
    ("data/bench-columns.csv", "of the wall at 1 Hz", 1, bench_run.IMPEDANCE_HZ),
    ("data/bench-columns.csv", "over 4 periods", 4, bench_run.IMPEDANCE_PERIODS),
    ("data/bench-columns.csv", "A sine of 0.5 N", 0.5, bench_run.SHAKING_N),
    (
        "data/bench-tasks.csv",
        "the laws get 90 %",
        90,
        100 * bench_plan.TASKS["gravity-90"].gravity,
    ),
    ("bench-method.md", "40 round trips", 40, bench_plan.ROUND_TRIPS),
    ("bench-method.md", "less than 1 N", 1, bench_results.LEAST_CONTACT_N),
    ("bench-method.md", "none of fewer than 20 seeds", 20, bench_results.LEAST_SEEDS),
    (
        "bench-method.md",
        "round trips of 68, 272 and 1088 ms",
        1088,
        bench_plan.TUNED_ROUND_TRIPS_MS[-1],
    ),
    ("twins.md", "end of each of 16 windows", 16, twin_runs.WINDOWS),
    ("twins.md", "a difference above 1e-4 is made small again", 1e-4, twin_runs.LARGEST),
    ("twins.md", "a run within 1e-7 of its records has twins", 1e-7, twin_runs.SAME_RUN),
    ("twins.md", "A difference below 1e-12 is rounding", 1e-12, twin_runs.SMALLEST),
    ("stability.md", "(`FLOOR_RAD`, 1e-12)", 1e-12, envelope_trend.FLOOR_RAD),
    ("data/summary-numbers.csv", "exceeds 0.01 rad", 0.01, site_signals.SETTLED_ERROR_RAD),
    ("design.md", "at most 200 ppm", 200.0, timing.SLEW_LIMIT / 1e3),
    ("design.md", "more than 10 s ahead", 10, link.AHEAD_LIMIT_S),
    ("session-protocol.md", "an epoch 500 ms ahead", 500, session.EPOCH_AHEAD_NS / 1e6),
    ("session-protocol.md", "150 ms before the epoch", 150, session.DECIDE_NS / 1e6),
    (
        "session-protocol.md",
        "at most 10 s from the last question",
        10,
        site_end.LINGER_NS / 1e9,
    ),
    ("session-protocol.md", "takes effect 100 ms later", 100, change_server.AHEAD_MS),
    ("data/zenoh-settings.csv", "The lease is 5 s", 5, zenoh_config.LEASE_MS / 1e3),
    ("session-protocol.md", "silent for 0.2 s", 0.2, external_arm.SILENCE_LIMIT_NS / 1e9),
    ("devices.md", "silent for 150 ms", 150, 1e3 * haply_inverse3.SILENCE_S),
    ("devices.md", "nothing for 0.1 s", 0.1, spacemouse.STILL_NS / 1e9),
    ("devices.md", "the force grows within 100 ms", 100, live_hand.GRIP_NS / 1e6),
    ("devices.md", "older than 100 ms", 100, arm_client.FRESH_NS / 1e6),
    ("external-arm.md", "silent for 0.2 s", 0.2, external_arm.SILENCE_LIMIT_NS / 1e9),
    ("external-arm.md", "silent for 0.03 s", 0.03, external_arm.HELD_SILENCE_NS / 1e9),
    ("external-arm.md", "more than 20 ticks", 20, session_life.HELD_OVERRUN_TICKS),
    ("external-arm.md", "more than 200", 200, session_life.FAULT_OVERRUN_TICKS),
    ("external-arm.md", "at most 64 wait", 64, external_arm.MEASUREMENTS_KEPT),
    ("external-arm.md", "older than 0.1 s", 0.1, arm_client.FRESH_NS / 1e9),
    ("live-hands.md", "silent for 200 ms lets go", 200.0, live_hand.SILENCE_NS / 1e6),
    ("live-hands.md", "from 0 to 1 within 100 ms", 100.0, live_hand.GRIP_NS / 1e6),
    ("live-hands.md", "two, at most 50 ms", 50.0, live_hand.GLIDE_NS / 1e6),
    ("tuning-procedure.md", "`--budget`, 64 per law", 64, tuning_plan.DEFAULT_BUDGET),
    (
        "tuning-procedure.md",
        "steps of 12, 8, 5, 3 %",
        3,
        100 * tuning_plan.REFINEMENT_STEPS[-1],
    ),
    ("tuning-procedure.md", "at least 10 %", 10, 100 * search_space.MIN_BOX),
    ("tuning-procedure.md", "more than 0.2 rad from q", 0.2, candidate.STRAYED_RAD),
    ("tuning-procedure.md", "more than 0.02 rad from q", 0.02, candidate.TOGETHER_RAD),
    ("fair-comparison.md", "drift by less than 0.05 rad", 0.05, run_end.DRIFT_RAD),
    ("data/linear-rests.csv", "slower than 0.01 rad/s", 0.01, run_end.SETTLED_SPEED_RAD_S),
    ("data/linear-words.csv", "within 1e-6/s", 1e-6, characteristic_roots.STABILITY_EDGE_PER_S),
    ("data/linear-words.csv", "a scan of 24 values", 24, linear_edge.EDGE_SCAN_POINTS),
    ("links.md", "No delay is longer than 10 s", 10, delay.MAX_DELAY_US / 1e6),
    (
        "links.md",
        "round trips (8, 68, 136, 272, 544, 1088 ms)",
        1088,
        link_presets.GRID_ROUND_TRIPS_MS[-1],
    ),
    ("links.md", "losses (0, 10, 25, 50 %)", 50, link_presets.GRID_LOSSES_PERCENT[-1]),
    ("felt-forces.md", "faster than 2e-3 rad/s", 2e-3, run_end.STATIC_SPEED_RAD_S),
    (
        "felt-forces.md",
        "by more than 1 % of the largest",
        1,
        100 * static_windows.MAX_TORQUE_VARIATION,
    ),
    ("felt-forces.md", "from 0.05 N m", 0.05, static_windows.MIN_LOAD_NM),
    ("felt-forces.md", "and 2 % of the largest", 2, 100 * static_windows.MIN_LOAD_SHARE),
    ("felt-forces.md", "Hann windows of 4 s", 4, measured_impedance.SEGMENT_S),
    ("felt-forces.md", "0.5 to 20 Hz", 20, measured_impedance.HIGHEST_HZ),
    ("felt-forces.md", "coherence of 0.9", 0.9, measured_impedance.MIN_COHERENCE),
    ("ports.md", "over 0.1-10 Hz", 10, port_response.TRANSPARENCY_BAND_HZ[1]),
    ("data/recording-limits.csv", "of the last 60 s", 60, retransmit_buffer.KEPT_S),
    (
        "data/recording-limits.csv",
        "records up to 120 000",
        120_000,
        retransmit_buffer.RECORDS_KEPT,
    ),
    ("data/recording-limits.csv", "at most 64 messages", 64, requests.BACKFILL_MESSAGES),
    ("data/recording-limits.csv", "or 40 kB", 40, requests.BACKFILL_BYTES / 1e3),
    (
        "data/recording-limits.csv",
        "looks for answers every 10 ms",
        10,
        record_process.POLL_NS / 1e6,
    ),
    (
        "data/recording-limits.csv",
        "up to 6400 records per second",
        6400,
        requests.BACKFILL_MESSAGES * 10**9 // record_process.POLL_NS,
    ),
    ("recording.md", "nice value of -5", -5, record_process.NICE),
    ("data/recording-limits.csv", "a gap after 50 ms", 50, backfill.GRACE_NS / 1e6),
    ("data/recording-limits.csv", "after a silence of 1 s", 1, backfill.SILENT_NS / 1e9),
    ("data/recording-limits.csv", "repeated after 0.3 s", 0.3, backfill.ANSWER_NS[0] / 1e9),
    ("data/recording-limits.csv", "doubling to 3 s", 3, backfill.ANSWER_NS[1] / 1e9),
    ("data/recording-limits.csv", "if 20 answers in a row", 20, backfill.MAX_VAIN_REQUESTS),
    ("data/recording-limits.csv", "does not send it for 10 s", 10, backfill.GIVE_UP_NS / 1e9),
    (
        "data/recording-limits.csv",
        "Of more than 50 000 in one channel",
        50_000,
        accounting.MAX_GAPS,
    ),
    ("recording.md", "synced once a second", 1, log_file.SYNC_PERIOD_NS / 1e9),
    ("stability.md", "by 0.05 rad or more", 0.05, run_end.DRIFT_RAD),
    ("stability.md", "differ by more than 0.02 rad", 0.02, run_end.AGREEMENT_RAD),
    ("stability.md", "within 0.3 rad of straight down", 0.3, arm_rows.HANGING_RAD),
    ("stability.md", "left alone for 2 s or more", 2, run_end.LEAST_JUDGED_S),
    (
        "stability.md",
        "an error $`|e|`$ of 2 % of the difference",
        2,
        100 * run_end.HELD_SHARE,
    ),
    ("certificate-premises.md", "they let go 1 s and five times", 1, premises.MIN_FREE_S),
    ("observed-energy.md", "(to -1e-9 J and", -1e-9, observed_energy.LEAST_ENERGY_J),
    ("observed-energy.md", "at most 1 % of", 1, 100 * observed_energy.SAMPLING_SHARE),
    ("stability.md", "within 0.02 rad of that rest", 0.02, stability_decision.NEAR_REST_RAD),
    ("data/push-rules.csv", "fewer than 100 bursts", 100, stability_decision.LEAST_BURSTS),
    ("twins.md", "at most 32", 32, twin_runs.MAX_PUSHES),
    ("twins.md", "for 5 s or more", 5, twin_growth.LEAST_LEFT_S),
    ("sweep.md", "eight times the duration", 8, sweep_plan.MAX_EXTENSION),
    ("data/sweep-ends.csv", "by more than 2 %", 2, 100 * sweep_cell.FLAT_LOG_CHANGE),
    (
        "certificate-energy.md",
        "unexplained than 2e-4 of the largest energy",
        2e-4,
        functional_judgements.BROKEN_BALANCE_SHARE,
    ),
    (
        "certificate-energy.md",
        "less than 1e-3 is unexplained",
        1e-3,
        functional_judgements.CLEAR_BREAK_SHARE,
    ),
    (
        "certificate-premises.md",
        "up to 1e-4 of the largest energy",
        1e-4,
        premises.SAMPLING_RISE_SHARE,
    ),
    (
        "certificate-premises.md",
        "more than 1e-2 of the largest energy",
        1e-2,
        functional_judgements.COARSE_TOLERANCE_SHARE,
    ),
    ("certificate.md", "to 1e-6 (1 + |tau|)", 1e-6, functional_judgements.TORQUE_TOLERANCE),
    ("certificate.md", "`--min-coverage` (0.999)", 0.999, accounting.MIN_COVERAGE),
    ("stability.md", r"\le 0.01`$ rad/s in", 0.01, run_end.SETTLED_SPEED_RAD_S),
    ("stability.md", "and a tenth of the run", 0.1, run_end.LEAST_JUDGED_SHARE),
    ("stability.md", "largest values of 50 ms", 50, 1e3 / ticks.BUCKETS_PER_S),
    (
        "stability.md",
        "less than 99.9 % of a site's ticks",
        99.9,
        100 * accounting.MIN_COVERAGE,
    ),
    ("data/zenoh-settings.csv", "queue of 16 batches", 16, zenoh_config.BATCHES),
    ("session-protocol.md", "waits 15 s for them", 15, site_reception.AWAY_NS / 1e9),
    ("recording.md", "for 10 s after its last question", 10, site_end.LINGER_NS / 1e9),
    ("recording.md", "until nothing comes for 10 s", 10, record_process.END_NS / 1e9),
    ("recording.md", "or 60 s after the signal", 60, record_process.LONGEST_END_NS / 1e9),
    ("recording.md", "busy for 80 % of the time", 80, 100 * machine_load.BUSY_SHARE),
    ("linear-method.md", "the shorter span, at most 60 s", 60, delay_period.MAX_NEAR_PERIOD_S),
    ("linear-method.md", "30 s of the draws", 30, floquet.DRAWN_SPAN_S),
    (
        "data/linear-rests.csv",
        "at most eight times the duration",
        8,
        equilibrium.MAX_PROLONGATION,
    ),
    ("linear.md", "to a residual of 1e-10", 1e-10, equilibrium.MAX_EQUILIBRIUM_RESIDUAL),
    (
        "data/linear-methods.csv",
        "1e-12 of the terms' size",
        1e-12,
        characteristic_roots.ROOT_RESIDUAL_TOLERANCE,
    ),
    ("data/linear-words.csv", "regula falsi to 1e-6", 1e-6, linear_edge.EDGE_TOLERANCE),
    (
        "data/linear-words.csv",
        "if it differs by more than 1 %",
        1,
        100 * linear_analysis.SAMPLED_ROOT_DIFFERENCE,
    ),
    ("log-checks.md", "After 100 such places", 100, mcap_records.MAX_DAMAGED_PARTS),
    (
        "data/reader-limits.csv",
        "max(32 MiB, 32 x its own size)",
        32,
        mcap_records.MAX_UNPACKED_BYTES / 2**20,
    ),
    ("data/reader-limits.csv", "32 x its own size", 32, mcap_records.MAX_UNPACKED_RATIO),
    (
        "data/reader-limits.csv",
        "max(64 MiB, 300 x the file's size)",
        64,
        mcap_reader.KEPT_BYTES / 2**20,
    ),
    ("data/reader-limits.csv", "300 x the file's size", 300, mcap_reader.KEPT_RATIO),
    ("data/reader-limits.csv", "at most 32 sites", 32, written_tables.MAX_SITES),
    (
        "data/reader-limits.csv",
        "links of a site up to 64 MiB",
        64,
        site_arrays.MAX_LINKS_BYTES / 2**20,
    ),
    (
        "data/log-expressions.csv",
        "of more than 65 536 only",
        65_536,
        site_log.MAX_DECODED_RECORDS,
    ),
    ("verify.md", "agree to 1e-9 (1 + |a|)", 1e-9, verification.TOLERANCE),
    ("replay.md", "sleeps until 150 us before", 150, player.SPIN_NS / 1e3),
    ("maps/README.md", "nine values first", 9, margin_search.SCAN_POINTS),
    ("maps/README.md", "[--tolerance 0.005]", 0.005, margin_search.MARGIN_TOLERANCE),
    ("felt-forces.md", "at least 4 independent stretches", 4, measured_impedance.MIN_SEGMENTS),
    ("felt-forces.md", "at most 17.2 %", 17.2, math.ceil(1e3 * MOST_RANDOM_ERROR) / 10),
    ("data/metrics.csv", "the same of the last 5 s", 5, motion_metrics.LONG_END_S),
    ("law-interface.md", "at most 1024 numbers", 1024, user_law.MAX_LAW_MEMORY),
    ("data/law-failures.csv", "three quarters of the period", 0.75, code_watchdog.SHARE),
    ("session-protocol.md", "Each window of 1 s", 1, timing.WINDOW_NS / 1e9),
    ("session-protocol.md", "over all floors of 60 windows", 60, offset.WINDOWS_KEPT),
    ("session-protocol.md", "less than 500 ppm", 500, offset.DRIFT_LIMIT / 1e3),
    ("session-protocol.md", "follow a line to 1 ppm", 1, offset.WANDER / 1e3),
    (
        "data/law-failures.csv",
        "at half a second of overtime",
        0.5,
        code_watchdog.OVERTIME_LIMIT_NS / 1e9,
    ),
    ("data/law-failures.csv", "for 50 ms at most", 50, code_watchdog.HICCUP_NS / 1e6),
    (
        "data/port-details.csv",
        "a circle of 0.001 1/s",
        0.001,
        port_response.ZERO_ROOT_RADIUS_PER_S,
    ),
    ("recording.md", "it flushes every 65 ms", 65, record_process.FLUSH_NS / 1e6),
    ("data/recording-limits.csv", "the last 4096 events", 4096, retransmit_buffer.EVENTS_KEPT),
    ("sweep.md", "More than a million runs", 1e6, sweep_run.MAX_RUNS),
    ("sweep.md", "or more than a day", 1, sweep_run.MAX_SWEEP_S / 86_400),
    ("sweep.md", "after 10 s, exit code 2", 10, dask_cluster.CONNECT_S),
    ("sweep.md", "without a worker for a minute", 60, dask_cluster.NO_WORKER_S),
    ("sweep.md", "three of them is named", 3, executor.MAX_LOSSES),
]
"""Page, words, the number in them, and the program's own."""


def join_lines(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize(
    ("page", "phrase", "number", "limit"), STATED, ids=[f"{p}: {w}" for p, w, *_ in STATED]
)
def test_limits_on_pages_are_the_programs(
    page: str, phrase: str, number: float, limit: float
) -> None:
    assert phrase in join_lines(find_page(page).read_text(encoding="utf-8"))
    assert number == pytest.approx(limit, rel=1e-12)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_sections_with_numbers_have_their_source(page: Path) -> None:
    """A command, a test, or a row above that compares a limit with the program's."""
    limits = [phrase for name, phrase, *_ in STATED if name == page.name]
    lacking = [
        section.partition("\n")[0]
        for section in re.split(r"(?m)^(?=#{1,3} )", page.read_text(encoding="utf-8"))
        if NUMBER.search(section) and not EVIDENCE.search(section)
        if not any(phrase in join_lines(section) for phrase in limits)
    ]
    assert not lacking


@cache
def names_of(path: Path) -> tuple[str, ...]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return tuple(node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
@pytest.mark.push
def test_tests_named_on_pages_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    folders = (ROOT / "tests", *ROOT.glob("packages/*/tests"))
    files = {path.stem: path for folder in folders for path in folder.rglob("*.py")}
    functions = {name for path in files.values() for name in names_of(path)}
    for named in re.findall(r"`((?:packages/[\w-]+/)?tests/[\w/.]+)`", text):
        assert (ROOT / named).exists(), named
    names = re.findall(r"`(?:[\w/-]*tests/[\w/]*/)?(test_\w+?)(_?\.\.\.|\.py)?`", text)
    assert len(names) > 15 or page.name != "errata-proof.md"
    for name, rest in names:
        known = name in files or any(
            function.startswith(name) if rest else function == name for function in functions
        )
        assert known, name


def test_operators_environments_and_laws_stand_in_tables() -> None:
    pages = ("docs/reference/laws.md", "docs/reference/operators.md")
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in pages)
    kinds = [
        str(kind.__struct_config__.tag)
        for kind in get_args(operators.Operator | operators.Environment)
    ]
    assert [
        kind for kind in (*kinds, *laws.LAWS) if kind != "own" and f"| `{kind}` |" not in text
    ] == []


def test_delay_models_and_formats_stand_in_pages() -> None:
    links_page = (ROOT / "docs/reference/links.md").read_text(encoding="utf-8")
    with (ROOT / "docs/data/delay-models.csv").open(newline="", encoding="utf-8") as stream:
        listed_models = {row["model"] for row in csv.DictReader(stream)}
    assert [model for model in DELAY_MODELS if f"`{model}`" not in links_page] == []
    assert DELAY_MODELS.keys() - listed_models == set()

    tools_page = (ROOT / "docs/logs/log-tools.md").read_text(encoding="utf-8")
    exports = sorted((ROOT / "trilat_net/presentation/exports").glob("[!_]*.py"))
    assert exports
    assert [path.stem for path in exports if f"`{path.stem}`" not in tools_page] == []


def test_threats_of_the_security_page_name_tests() -> None:
    page = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    with (ROOT / "docs/data/threats.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert "[threats.csv](docs/data/threats.csv) lists thirty-six threats" in page
    assert len(rows) == 36
    for row in rows:
        assert row["threat"]
        assert row["answer"]
        for named in row["tests"].split(", "):
            file, _, name = named.partition("::")
            assert f"def {name}" in (ROOT / file).read_text(encoding="utf-8"), named


def test_links_that_name_a_page_reach_it() -> None:
    pattern = re.compile(r"\[([\w./-]+\.md)\]\(([^)#]+\.md)[^)]*\)")
    wrong = [
        (page.name, label, target)
        for page in (ROOT / "docs").rglob("*.md")
        for label, target in pattern.findall(page.read_text(encoding="utf-8"))
        if Path(label).name != Path(target).name
    ]
    assert wrong == []
