"""`trilat compare`: logs side by side, and laws tuned alike."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from study_builders import TRIO

import trilat_net as tn
from tests.cli.running import trilat
from tests.json_outline import is_documented
from trilat_net.analysis.metrics.measures import Metric, Quantity


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with logs of `free` and `two_sites`, and with a file that is no log."""
    folder = tmp_path_factory.mktemp("logs")
    quick = ["--set", "rate_hz=100", "--duration"]
    trilat("sim", "free", "-o", "a.mcap", *quick, "2", cwd=folder)
    trilat("sim", "free", "-o", "b.mcap", *quick, "2", "--set", "link.delay_ms=50", cwd=folder)

    hanging = ["--set", "control.law=pd_d", "--set", "control.gravity=0"]
    trilat("sim", "free", "-o", "hang.mcap", *quick, "12", *hanging, cwd=folder)
    trilat("sim", "two_sites", "-o", "c.mcap", *quick, "1", cwd=folder)

    (folder / "trio.toml").write_text(TRIO)
    (folder / "no.mcap").write_bytes(b"no log")
    return folder


def test_logs_are_compared_under_their_differing_settings(logs: Path) -> None:
    lines = trilat("compare", "a.mcap", "b.mcap", "--all", cwd=logs).succeeds().splitlines()
    link_row = next(line.split() for line in lines if "every link" in line)
    assert link_row[2:] == ["200", "ms", "50", "ms"]
    assert any("RMS spread, undelayed" in line and " rad " in line for line in lines)
    assert all(word not in " ".join(lines) for word in ("better", "best", "winner", "rank"))


def test_short_text_has_verdicts_metrics_and_conclusion(logs: Path) -> None:
    """The short text has ten of all metrics, each verdict once, and a conclusion."""
    files = ("a.mcap", "b.mcap")
    facts = json.loads(trilat("compare", *files, "--json", cwd=logs).succeeds())
    brief = trilat("compare", *files, cwd=logs).succeeds().splitlines()
    full = trilat("compare", *files, "--all", cwd=logs).succeeds().splitlines()

    indented = [line.split("  ")[1].strip() for line in brief if line.startswith("  ")]
    rows = [name for name in indented if name]
    names = [row["name"] for row in facts["rows"]]
    assert len(rows) == 10
    assert rows == [name for name in names if name in rows]
    assert all(any(name in line for line in full) for name in names)

    for log, (verdict, *_) in facts["remarks"].items():
        assert sum(f"{log}: {verdict}" in line for line in brief) == 1
    assert brief[-3].startswith(f"in short: a is {verdict.partition(':')[0]} and b is ")
    assert f"--all prints all {len(names)} metrics" in brief[-2]


def test_other_links_bring_the_undelayed_error(logs: Path) -> None:
    """Only if links differ, the short text says how far sites are from where their peers are."""
    facts = json.loads(trilat("compare", "a.mcap", "b.mcap", "--json", cwd=logs).succeeds())
    (row,) = [row for row in facts["rows"] if row["key"] == "undelayed_max_rad"]
    brief = trilat("compare", "a.mcap", "b.mcap", cwd=logs).succeeds().splitlines()
    assert any(line.strip().startswith(f"{row['name']}  ") for line in brief)

    first, second = row["values"]
    clause = f"delay included, a site is at most {first:.3g} rad in a and {second:.3g} rad in b"
    assert clause in brief[-3]

    other_law = trilat("compare", "a.mcap", "hang.mcap", cwd=logs).succeeds()
    assert "delay included" not in other_law


@pytest.mark.long
def test_the_same_log_twice_is_one_experiment(logs: Path) -> None:
    output = trilat("compare", "a.mcap", "a.mcap", cwd=logs).succeeds()
    assert "the same experiment" in output
    assert "1: a.mcap" in output


def test_comparing_logs_of_different_scenarios_is_reported(logs: Path) -> None:
    output = trilat("compare", "a.mcap", "c.mcap", cwd=logs).succeeds()
    assert "logs of different scenarios: free, two_sites" in output


def test_json_is_for_programs(logs: Path) -> None:
    facts = json.loads(trilat("compare", "a.mcap", "hang.mcap", "--json", cwd=logs).succeeds())
    assert facts["columns"] == ["a", "hang"]
    assert [log["scenario"] for log in facts["logs"]] == ["free", "free"]
    assert {"control", "duration_s"} <= {
        difference["key"] for difference in facts["differences"]
    }
    hanging = [
        log
        for log, remarks in facts["remarks"].items()
        if "hang at the end" in " ".join(remarks)
    ]
    assert hanging == ["hang"]
    assert all(len(row["values"]) == 2 for row in facts["rows"])


@pytest.mark.long
def test_search_reports_time_and_procedure_and_writes_folder(logs: Path) -> None:
    """A tuning prints its cost and its commands, writes four files, and overwrites only by force."""
    laws_and_budget = ["--law", "p_d,known", "--budget", "8"]
    options = [*laws_and_budget, "--jobs", "1", "--duration", "12", "--out", "fronts"]
    output = trilat("compare", "--tune", "trio.toml", *options, cwd=logs).succeeds()
    assert "18 runs on 1 core: about " in output
    assert "torques clamped at 60 N m" in output
    assert "trilat sim trio.toml --set duration_s=12.0 --set 'control={law = " in output

    written = sorted(path.name for path in (logs / "fronts").iterdir())
    assert written == ["front.json", "front.md", "front.pdf", "front.png"]

    again = trilat(
        "compare", "--tune", "trio.toml", *options, "--force", "--json", cwd=logs
    ).succeeds()
    assert json.loads(again) == json.loads((logs / "fronts" / "front.json").read_text())
    assert is_documented("compare --tune", json.loads(again))

    trilat("compare", "--tune", "trio.toml", *options, cwd=logs).refuses(
        "fronts is not empty", "--force"
    )


@pytest.mark.long
def test_a_shipped_law_is_called_by_its_name(tmp_path: Path) -> None:
    """Messages about a shipped law name it, and do not call it a user's own law."""
    for law in ("tdpa", "wave", "adaptive"):
        settings = ["--set", f"control.law={law}", "--set", "scheme=digital"]
        trilat(
            "sim",
            "two_sites",
            *settings,
            "--duration",
            "0.5",
            "-o",
            f"{law}.mcap",
            cwd=tmp_path,
        ).succeeds()

    logs = ["tdpa.mcap", "wave.mcap", "adaptive.mcap"]
    text = trilat("compare", "--all", *logs, cwd=tmp_path).succeeds()
    assert "the law tdpa does not say which part of its torque is due to a peer" in " ".join(
        text.split()
    )
    for word in ("somebody", "own law", "law own"):
        assert word not in text


def test_the_conclusion_names_a_relevant_difference() -> None:
    """Rounding errors and a torque that nobody feels are no largest difference."""
    log = tn.simulate("two_sites", duration_s=0.2)
    comparison = tn.compare(log, log)

    def conclude(**values_by_key: tuple[float, float]) -> str:
        """Returns the conclusion for some metrics with these values in the two runs."""
        rows = tuple(
            comparison.metrics.row(key)._replace(entries=tuple(map(Metric, values)))
            for key, values in values_by_key.items()
        )
        changed = replace(comparison, metrics=comparison.metrics._replace(rows=rows))
        texts = [str(block) for block in changed.brief_blocks()]
        (conclusion,) = (text for text in texts if text.startswith("in short"))
        return conclusion.partition("; ")[2]

    weak = {"mechanical_j": (1e-16, -2e-9), "peak_tau_nm": (0.0, 0.06)}
    assert conclude(**weak, rms_error_rad=(0.1, 0.4)).endswith("RMS e, 0.1 and 0.4 rad")
    assert conclude(**weak) == "no metric differs by more than a negligible amount"
    assert conclude(hands_j=(0.0, 0.2), peak_tau_nm=(0.0, 9.0)).endswith("0 and 9 N m")


def test_metrics_of_every_unit_are_ranked() -> None:
    """The short text of any two values of any metric has a conclusion."""
    log = tn.simulate("two_sites", duration_s=0.2)
    comparison = tn.compare(log, log)
    assert {"J", "rad", "N m"} < {quantity.unit for quantity in Quantity.list_all()}
    for quantity in Quantity.list_all():
        row = comparison.metrics.rows[0]._replace(
            quantity=quantity, entries=(Metric(0.0), Metric(1e6))
        )
        changed = replace(comparison, metrics=comparison.metrics._replace(rows=(row,)))
        text = " ".join(str(block) for block in changed.brief_blocks())
        is_rounding = quantity.key == "unaccounted_j"
        assert (f"difference: {quantity.name}" in text) is not is_rounding, quantity.key
