import json

import msgspec
import numpy as np
import pytest

from trilat_net.analysis.summary import summarise

from . import logs


def strict(facts):
    """As another program reads it; NaN and arrays are errors."""
    return json.loads(json.dumps(facts, allow_nan=False))


def test_numbers_agree_with_the_records():
    log = logs.virtual("paper")
    facts = strict(summarise(log, logs.twin("paper")))
    for name in log.sites:
        states = log[name].states
        site = facts["sites"][name]
        errors = [max(abs(q - d) for q, d in zip(s.q, s.q_des, strict=True)) for s in states]
        assert site["records"] == site["expected_ticks"] == 400
        assert site["missing"] == 0
        assert site["q_end_rad"] == states[-1].q
        assert site["max_error_rad"] == max(errors)
        assert site["max_error_end_rad"] == max(errors[200:])  # the last second of two, at 200 Hz
        assert site["peak_tau_nm"] == max(abs(t) for s in states for t in s.tau)
        assert site["saturated_ticks"] == 0
        moved = [
            [abs(a - b) for a, b in zip(s.q, t.q, strict=True)]
            for s, t in zip(states, logs.twin("paper")[name].states, strict=True)
        ]
        assert site["hands_moved_max_rad"] == [max(joint) for joint in zip(*moved, strict=True)]
    assert facts["links"]["m2->s"]["age_ms"] == {"p50": 200.0, "min": 200.0, "max": 200.0}
    assert facts["links"]["m2->s"]["late_samples"] == 0
    assert facts["diverged"] is False
    assert facts["settle_s"] is None  # two seconds are not enough


def test_settling_is_the_last_time_above_the_limit():
    log = logs.virtual("paper")

    def settle_at_250(state):
        return msgspec.structs.replace(state, q=[q + 0.02 * (state.tick == 250) for q in state.q_des])

    facts = summarise(logs.rewritten(log, change=settle_at_250))
    assert [site["settle_s"] for site in facts["sites"].values()] == [250 / 200] * 3
    assert facts["settle_s"] == 250 / 200
    quiet = logs.rewritten(log, change=lambda s: msgspec.structs.replace(s, q=s.q_des))
    assert summarise(quiet)["settle_s"] == 0.0


def test_times_of_the_loop():
    facts = summarise(logs.timed(logs.virtual("four")))
    site = facts["sites"]["c"]  # 200 Hz: 400 ticks, late by 0 to 399 us
    assert site["late_us"]["p50"] == 199.5
    assert site["late_us"]["p99_9"] == pytest.approx(np.percentile(np.arange(400), 99.9))
    assert site["late_us"]["max"] == 399.0
    assert site["busy_us"] == {"p50": 7.0, "p99": 7.0, "max": 7.0}
    assert site["overruns"] == 0


def test_overruns_begin_at_a_whole_period():
    def late(state):
        return msgspec.structs.replace(state, late_us={10: 4999, 20: 5000, 30: 9000}.get(state.tick, 1))

    facts = summarise(logs.rewritten(logs.virtual("paper"), change=late))
    assert [site["overruns"] for site in facts["sites"].values()] == [2, 2, 2]  # 200 Hz: 5000 us


def test_saturation_is_counted():
    log = logs.virtual("paper")
    limit = log.scenario.sites["m1"].limits.tau_limit_nm

    def cut(state):
        return msgspec.structs.replace(state, tau=[0.0, -limit]) if state.tick < 5 else state

    assert summarise(logs.rewritten(log, change=cut))["sites"]["m1"]["saturated_ticks"] == 5


def test_a_run_that_diverged_says_so_and_misses_nothing():
    facts = strict(summarise(logs.diverged()))
    assert facts["diverged"] is True
    assert facts["missing"] == 0
    assert 0.0 < min(s["diverged_at_s"] for s in facts["sites"].values() if s["diverged_at_s"]) < 2.0


def test_missing_records_are_counted():
    log = logs.rewritten(logs.virtual("paper"), keep=lambda s: s.site != "m2" or not 100 <= s.tick < 150)
    facts = summarise(log)
    assert [site["missing"] for site in facts["sites"].values()] == [0, 50, 0]
    assert facts["missing"] == 50


@pytest.mark.parametrize("records", [0, 1, 2])
def test_short_logs_have_nulls_and_no_nan(records):
    log = logs.rewritten(logs.virtual("paper"), keep=lambda s: s.tick < records, finished=False)
    facts = strict(summarise(log, logs.twin("paper")))
    assert facts["session"]["complete"] is False
    for site in facts["sites"].values():
        assert site["records"] == records
        assert site["missing"] == 400 - records
        assert (site["q_end_rad"] is None) == (records == 0)
        assert (site["busy_us"]["max"] is None) == (records < 2)
    assert facts["links"]["s->m1"]["age_ms"]["p50"] is None
    assert facts["links"]["s->m1"]["late_samples"] is None
