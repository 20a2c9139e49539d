"""The table: the worst of the runs, how many held, and no failed run without its command."""

from trilat_net.studies.trials.expectations import ExpectationResult
from trilat_net.studies.trials.trial_report import MAX_FAILURES_SHOWN, TrialReport, format_margin

from .results import result


def outcome(margin: float, key: str = "rms_error_max_rad") -> ExpectationResult:
    return ExpectationResult(key, margin >= 0.0, f"{0.1 * (1 - margin):.4g} rad", "≤ 0.1 rad", margin)


def test_a_row_shows_the_worst_of_its_runs_and_how_many_held() -> None:
    report = TrialReport([result(n, outcome(m)) for n, m in enumerate((0.5, -0.2, 0.1, -0.1))], 4.0)
    (row,) = report.rows()
    assert (row.worst.margin, row.held, row.runs) == (-0.2, 2, 4)
    assert row.cells() == ("FAIL", "quick.toml", "rms_error_max_rad", "≤ 0.1 rad", "0.12 rad", "-20 %", "2/4")
    assert not report.held


def test_what_failed_comes_before_the_smallest_margin() -> None:
    failed = ExpectationResult("stable", False, "grows", "true")
    (row,) = TrialReport(
        [result(1, ExpectationResult("stable", True, "decays", "true")), result(2, failed)], 1.0
    ).rows()
    assert row.worst is failed


def test_every_failed_run_is_named_and_the_first_ones_with_their_commands() -> None:
    report = TrialReport([result(n, outcome(-0.1)) for n in range(1, MAX_FAILURES_SHOWN + 4)], 1.0)
    lines = report.failures()
    for seed in range(1, MAX_FAILURES_SHOWN + 1):
        assert f"  again: trilat test quick.toml --seeds {seed}" in lines
        assert f"  look:  trilat sim quick.toml --seed {seed} -o quick-seed{seed}.mcap" in lines
    assert (
        lines[-1]
        == f"  and 3 more, seeds {MAX_FAILURES_SHOWN + 1}, {MAX_FAILURES_SHOWN + 2}, {MAX_FAILURES_SHOWN + 3}"
    )


def test_a_run_without_a_result_fails_and_says_why() -> None:
    report = TrialReport([result(1, outcome(0.5)), result(2, error="its process ended with code -9")], 1.0)
    assert not report.held
    assert [(row.key, row.held, row.runs) for row in report.rows()] == [
        ("rms_error_max_rad", 1, 1),
        ("a result", 1, 2),
    ]
    assert "code -9" in report.text()


def test_what_held_is_told_without_failures() -> None:
    report = TrialReport([result(1, outcome(0.5)), result(2, outcome(0.25))], 4.0)
    assert report.held
    assert report.failures() == []
    assert report.remarks() == ["2 runs, 40 s simulated in 4.0 s: 10x"]


def test_scenarios_of_one_name_are_told_apart() -> None:
    report = TrialReport([result(1, outcome(0.5), source=name) for name in ("a.toml", "b/a.toml")], 1.0)
    assert [row.scenario for row in report.rows()] == ["a.toml", "b/a.toml"]


def test_the_lines_of_a_table_are_aligned() -> None:
    report = TrialReport([result(1, outcome(0.5), outcome(-123.0, "end_error_max_rad"))], 1.0)
    heads, *rows = report.table()
    assert all(len(row) == len(heads) for row in rows)
    assert all(row.index("≤") == heads.index("limit") for row in rows)


def test_a_margin_is_a_percentage_with_its_sign() -> None:
    assert [format_margin(m) for m in (None, 0.0, 0.2, -0.05, 0.0012, -2192.87)] == [
        "",
        "+0.0 %",
        "+20 %",
        "-5.0 %",
        "+0.1 %",
        "-219,287 %",
    ]
