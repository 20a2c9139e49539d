"""Changes and modes over time."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.analysis.builders import make_busy_run, make_short_log, make_site_log
from tests.log.builders import replace_fields, rewrite_log
from trilat_net.analysis.timeline import Timeline
from trilat_net.errors import LogError
from trilat_net.net.messages import MODES


@given(st.lists(st.sampled_from(list(MODES)), max_size=60))
def test_spans_are_ticks_of_not_following(modes):
    part = make_site_log(modes)
    spans = [(mode, k) for k, mode in enumerate(modes) if not MODES[mode].follows]
    mode_intervals = Timeline({"m1": part}).find_mode_intervals("m1")
    intervals = [
        (span.mode, k)
        for span in mode_intervals
        for k in range(round(span.from_s * part.rate_hz), round(span.to_s * part.rate_hz))
    ]
    assert intervals == spans
    for before, after in pairwise(mode_intervals):
        # one span, not two in a row
        assert (before.mode, before.to_s) != (
            after.mode,
            after.from_s,
        )
    assert (part.diverged_s is None) == (modes[-1:] != ["diverged"])


def test_stated_link_settings_follow_changes():
    timeline = Timeline(make_busy_run().log)
    links = timeline.stated_links
    assert [(model.from_s, model.link.describe()) for model in links["a->c"].models] == [
        (0.0, "50 ms"),
        (1.0, "90 ms, loss 10 %"),
    ]
    assert [model.from_s for model in links["b->a"].models] == [0.0]
    assert timeline.end_s == 6.0


@pytest.mark.parametrize(
    "text", ["nonsense", '{"at_s": 1.0, "link": "a->c", "to": {"model": "none"}}']
)
def test_a_record_naming_a_foreign_change_is_refused(text):
    def spoiled(state):
        return replace_fields(
            state, cmd=[text] if (state.site, state.tick) == ("a", 3) else state.cmd
        )

    with pytest.raises(LogError):
        _ = Timeline(rewrite_log(make_busy_run().log, change=spoiled)).changes


def test_a_log_without_records_ends_as_planned():
    empty = rewrite_log(make_short_log("paper"), keep=lambda _: False, finished=False)
    timeline = Timeline(empty)
    assert timeline.end_s == 2.0
    assert timeline.find_mode_intervals("m1") == []
