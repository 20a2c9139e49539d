"""The ten most important lines of a certificate and of metrics."""

from dataclasses import replace

from tests.analysis.builders import make_run, make_short_log
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.metrics.measures import Metric, Quantity
from trilat_net.presentation import brief_text
from trilat_net.presentation.certificate_text import CertificateLine, describe_certificate
from trilat_net.presentation.result_text import TextTable, compose


def key_rows(metrics: LogMetrics) -> dict[str, list[str]]:
    """Cells of the short table, by the name of the quantity."""
    table, last = compose(metrics, brief=True)
    assert isinstance(table, TextTable)
    assert len(table.rows) <= brief_text.MOST_LINES
    assert "--all" in last.lines()[0]
    return {row[0]: list(row[1:]) for row in table.rows}


def test_key_metrics_name_the_worst_subject() -> None:
    metrics = LogMetrics.of_log(make_short_log("paper"))
    rows = key_rows(metrics)
    errors = {site: values["max_error_rad"].value for site, values in metrics.sites.items()}
    worst = max(errors, key=lambda site: errors[site] or 0.0)
    largest, unit, subject = rows["peak |e|"]
    assert (largest, unit) == (f"{errors[worst]:.4g}", "rad")
    assert subject in (worst, "every site")
    assert rows["effective delay, mean"] == ["200", "ms", "every link"]
    assert rows["missing records"] == ["0", "", "all sites together"]


def test_missing_key_metric_has_its_reason() -> None:
    metrics = LogMetrics.of_log(make_short_log("paper"))
    assert metrics.sites["m1"]["settle_s"].value is None
    number, _, reason = key_rows(metrics)["settling time"]
    assert number == "–"
    assert reason.startswith("m1: ")


def test_every_key_metric_exists() -> None:
    known = {quantity.key for quantity in Quantity.list_all()}
    assert set(brief_text._KEY_METRICS) <= known


def test_short_table_never_exceeds_ten_lines() -> None:
    metrics = LogMetrics.of_log(make_short_log("paper"))
    filled = {key: Metric(1.0) for key in metrics.sites["m1"]}
    table, _ = compose(replace(metrics, sites={"m1": filled}), brief=True)
    assert isinstance(table, TextTable)
    assert len(table.rows) == brief_text.MOST_LINES


def test_short_certificate_keeps_evidence_against_stability() -> None:
    lines = [CertificateLine("ok", "judgement")]
    lines += [CertificateLine("note", f"note {n}") for n in range(12)]
    lines += [CertificateLine("FAIL", "grows"), CertificateLine("open", "short")]
    chosen = brief_text._choose_lines(lines)
    assert len(chosen) == brief_text.MOST_LINES
    assert chosen[0] == lines[0]
    assert chosen[-2:] == lines[-2:]


def test_short_certificates_begin_like_long_ones() -> None:
    certificate = make_run("paper", {"duration_s": 2.0, "rate_hz": 100}).certificate
    *blocks, last = compose(certificate, brief=True)
    lines = [line.print_form.lines() for line in describe_certificate(certificate)]
    assert [block.lines() for block in blocks] == lines
    pointer = "premises are what the theorem requires (docs/reference/certificate-premises.md)"
    assert last.lines() == [f"--all prints 9 premises and the energies too; {pointer}"]
