"""The events of a run, as sentences in the order of time."""

from tests.analysis.builders import make_busy_run, make_diverged_log, make_short_log
from tests.core.guarded_runs import make_stopped_log
from trilat_net.analysis.file_overview import summarise_run
from trilat_net.log.log_reader import Log
from trilat_net.presentation.page_timeline import MAX_SHOWN, list_moments, render_timeline


def list_sentences(log: Log) -> list[str]:
    moments = list_moments(log, summarise_run(log))
    assert [moment.t_s for moment in moments] == sorted(moment.t_s for moment in moments)
    return [f"{moment.t_s:.3f} {moment.sentence}" for moment in moments]


def test_plain_run_begins_pushes_and_ends() -> None:
    texts = list_sentences(make_short_log("paper"))
    assert texts[0].startswith("0.000 The run starts; m1 follows m2 0.5, s 0.5; ")
    assert any(" An operator pushes m1 to the end, with at most " in line for line in texts)
    assert any(" has the largest error of the run, " in line for line in texts)
    assert texts[-1].endswith("The record ends.")


def test_changes_and_modes_have_their_origin() -> None:
    log = make_busy_run().log
    texts = list_sentences(log)
    assert "2.200 b braked until 3.053 s." in texts
    assert any("(command, applied at tick 500 of a)." in line for line in texts)
    assert any("(scenario)." in line for line in texts)
    html = render_timeline(log, summarise_run(log))
    visible, folded = html.split("<details>")
    assert visible.count("<li>") == MAX_SHOWN
    assert visible.count("<li>") + folded.count("<li>") == len(texts)
    assert [f"<b>{number}</b> " in html for number in (1, 2, 3)] == [True] * 3


def test_sites_that_act_together_share_a_sentence() -> None:
    texts = list_sentences(make_stopped_log())
    assert "0.000 m and s waited for the other sites until 0.100 s." in texts
    assert "2.000 s was stopped at 2.0 s (command, applied at tick 2000 of s)." in texts
    stop = "2.000 s stood by order until 3.500 s (STOPPED: it was ordered to stop)."
    assert stop in texts


def test_divergence_is_reported() -> None:
    log = make_diverged_log()
    assert any(
        f"diverged: {log.describe_divergence()}." in line for line in list_sentences(log)
    )
