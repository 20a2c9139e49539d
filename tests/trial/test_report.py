"""The table: the worst of the runs, how many held, and no failed run without its command."""

from trilat_net.trial.judgement import Outcome
from trilat_net.trial.report import SHOWN, Report, margin_text

from .results import result


def outcome(margin: float, key: str = "rms_error_max_rad") -> Outcome:
    return Outcome(key, margin >= 0.0, f"{0.1 * (1 - margin):.4g} rad", "≤ 0.1 rad", margin)


def test_a_row_shows_the_worst_of_its_runs_and_how_many_held() -> None:
    report = Report([result(n, outcome(m)) for n, m in enumerate((0.5, -0.2, 0.1, -0.1))], 4.0)
    (row,) = report.rows()
    assert (row.worst.margin, row.held, row.runs) == (-0.2, 2, 4)
    assert row.cells() == ("FAIL", "quick.toml", "rms_error_max_rad", "≤ 0.1 rad", "0.12 rad", "-20 %", "2/4")
    assert not report.held


def test_what_failed_comes_before_the_smallest_margin() -> None:
    failed = Outcome("stable", False, "grows", "true")
    (row,) = Report([result(1, Outcome("stable", True, "decays", "true")), result(2, failed)], 1.0).rows()
    assert row.worst is failed


def test_every_failed_run_is_named_and_the_first_ones_with_their_commands() -> None:
    report = Report([result(n, outcome(-0.1)) for n in range(1, SHOWN + 4)], 1.0)
    lines = report.failures()
    for seed in range(1, SHOWN + 1):
        assert f"  again: trilat test quick.toml --seeds {seed}" in lines
        assert f"  look:  trilat sim quick.toml --seed {seed} -o quick-seed{seed}.mcap" in lines
    assert lines[-1] == f"  and 3 more, seeds {SHOWN + 1}, {SHOWN + 2}, {SHOWN + 3}"


def test_a_run_without_a_result_fails_and_says_why() -> None:
    report = Report([result(1, outcome(0.5)), result(2, error="its process ended with code -9")], 1.0)
    assert not report.held
    assert [(row.key, row.held, row.runs) for row in report.rows()] == [
        ("rms_error_max_rad", 1, 1),
        ("a result", 1, 2),
    ]
    assert "code -9" in report.text()


def test_what_held_is_told_without_failures() -> None:
    report = Report([result(1, outcome(0.5)), result(2, outcome(0.25))], 4.0)
    assert report.held
    assert report.failures() == []
    assert report.remarks() == ["2 runs, 40 s simulated in 4.0 s: 10x"]


def test_scenarios_of_one_name_are_told_apart() -> None:
    report = Report([result(1, outcome(0.5), source=name) for name in ("a.toml", "b/a.toml")], 1.0)
    assert [row.scenario for row in report.rows()] == ["a.toml", "b/a.toml"]


def test_the_lines_of_a_table_are_aligned() -> None:
    report = Report([result(1, outcome(0.5), outcome(-123.0, "end_error_max_rad"))], 1.0)
    heads, *rows = report.table()
    assert all(len(row) == len(heads) for row in rows)
    assert all(row.index("≤") == heads.index("limit") for row in rows)


def test_a_margin_is_a_percentage_with_its_sign() -> None:
    assert [margin_text(m) for m in (None, 0.0, 0.2, -0.05, 0.0012, -2192.87)] == [
        "",
        "+0.0 %",
        "+20 %",
        "-5.0 %",
        "+0.1 %",
        "-219,287 %",
    ]
