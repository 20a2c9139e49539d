"""The text of links, changes, modes and clocks on a terminal.

Text tables: the same cells on a terminal, in Markdown and as lines.
"""

from io import StringIO

import pytest
from rich.console import Console

import trilat_net
from tests.analysis.builders import make_busy_run, make_short_log
from tests.core.guarded_runs import make_stopped_log
from tests.log.builders import rewrite_log
from trilat_net.analysis.link_summary import ClockSummary
from trilat_net.core.step.site_setup import Layout
from trilat_net.core.step.ticks import LifeAlarm, LifeReason
from trilat_net.net.messages import Event, LinkStats
from trilat_net.presentation import log_text
from trilat_net.presentation.log_text import MOST_LINE_CHARACTERS, format_run_lines
from trilat_net.presentation.page_summary import render_alarms
from trilat_net.presentation.result_text import TextTable


def list_lines(log, start):
    return [line for line in format_run_lines(log) if line.startswith(start)]


def test_constant_links_without_loss_get_no_line():
    for name in ("paper", "free", "two_sites", "four"):
        assert format_run_lines(make_short_log(name)) == []


def test_links_give_stated_and_measured_values():
    link = {"link.model": "uniform", "link.delay_ms": 200, "link.half_width_ms": 50}
    log = trilat_net.simulate("two_sites", {"duration_s": 2, **link})
    line = list_lines(log, "link ")[0]
    assert line.startswith("link s->m: stated uniform 150 to 250 ms; effective 16")
    assert " superseded " in line
    assert "lost" not in line


def test_events_are_reported_once():
    lines = format_run_lines(make_busy_run().log)
    link = "the link c->a was set to uniform 0 to 60 ms, from 3 s on"
    shares = "the shares of c were set to a 0.9, b 0.1 within 1 s, from 4 s on"
    assert f"change: {link} (applied at tick 500)" in lines
    assert f"change: {shares} (by the scenario)" in lines
    assert "b: braked 2.200-3.053 s, returned 3.053-3.553 s" in lines
    (link,) = (line for line in lines if line.startswith("link b->a"))
    assert "loss 20 % in bursts of 5" in link
    assert "in a row" in link


def test_stopped_arms_are_reported_first():
    log = make_stopped_log()
    assert format_run_lines(log)[0] == "*** s STOPPED 2.000-3.500 s: it was ordered to stop"
    assert (
        "<strong>s STOPPED</strong>2.000 s to 3.500 s: it was ordered to stop"
        in render_alarms(log)
    )
    assert render_alarms(make_short_log("two_sites")) == ""


@pytest.mark.parametrize(
    ("mode", "reason", "advice"),
    [
        (
            "fault",
            LifeReason.LIMIT_Q,
            "back within its limits, then trilat reset --session x s",
        ),
        ("fault", LifeReason.OVERRUN, "trilat reset --session x s"),
        ("stopped", LifeReason.STOP, "trilat enable --session x s"),
        ("stopped", LifeReason.RELEASED, "hold the switch"),
        (
            "hold",
            LifeReason.PEER_SILENT,
            "continues by itself once samples arrive from all its peers",
        ),
        ("hold", LifeReason.ARM_SILENT, "continues by itself once its arm sends again"),
        ("waiting", LifeReason.ALIGN_LIMIT, "bring the arms closer together"),
        ("waiting", LifeReason.START, None),
        ("run", LifeReason.ALIGNED, None),
    ],
)
def test_alarms_say_what_to_do(mode, reason, advice):
    alarm = LifeAlarm.find("x", "s", mode, [0.0, 0.0, 0.0, 0.0, 0.0, float(reason)], 2)
    assert (alarm is None) == (advice is None)
    assert alarm is None or alarm.advice.endswith(advice)


def test_continuing_without_a_peer_is_reported():
    layout = Layout()
    mem = [0.0] * layout.count_life_memory(2) + [0.0, -1.0]
    assert layout.list_lost_peers(mem, ("m1", "m2")) == ["m2"]
    alarm = LifeAlarm.find("x", "s", "run", mem, 2, layout.list_lost_peers(mem, ("m1", "m2")))
    assert alarm.word == "WITHOUT m2"
    assert LifeAlarm.find("x", "s", "fault", mem, 2, ["m2"]).word == "FAULT"
    assert layout.list_lost_peers(mem[:4], ("m1", "m2")) == []


@pytest.mark.parametrize("mem", [[], [0.0] * 5, [0.0] * 5 + [1e9], [0.0] * 5 + [-1.0]])
def test_foreign_records_raise_no_alarm(mem):
    assert LifeAlarm.find("x", "s", "fault", mem, 2) is None


def test_of_many_lines_the_first_are_shown(monkeypatch):
    monkeypatch.setattr(log_text, "MOST_LINES", 2)
    log = make_busy_run().log
    assert len(list_lines(log, "link ")) == 2
    assert "and 4 more of this kind: see summary.json" in format_run_lines(log)


def make_statistics(tick, **clock):
    none = {"m1": 0, "s": 0}
    counts = dict.fromkeys(("accepted", "late", "duplicate", "refused", "age_us"), none)
    zeros = dict.fromkeys(("late_max_us", "busy_max_us", "overruns"), 0)
    facts = {
        "v": 2,
        "site": "m2",
        "boot": 1,
        "tick": tick,
        "t_ns": tick * 5_000_000,
        "mode": "run",
    }
    return LinkStats(**facts, **counts, **zeros, dropped={}, **clock)


def make_clock_statistics():
    """Returns two statistics and an estimate of m2: m1 has another clock, s its own."""
    first = {
        "offset_us": {"m1": 3_000_000, "s": 0},
        "bound_us": {"m1": 200, "s": 0},
        "rtt_us": {"m1": -1},
    }
    last = {
        "offset_us": {"m1": 3_000_100, "s": 0},
        "bound_us": {"m1": 60, "s": 0},
        "rtt_us": {"m1": 180},
    }
    faults = {"clock_faults": {"m1": 2}}
    drift = {"drift_ppb": 50_000, "drift_bound_ppb": 900}
    estimate = Event(member="m2", boot=1, kind="clock", text="", about="m1", ticks=20, **drift)
    others = [make_statistics(20, **first), estimate, make_statistics(380, **last, **faults)]
    return rewrite_log(make_short_log("paper"), driver="live", others=others)


def test_clocks_are_reported_as_at_the_end():
    use = ClockSummary.of_link(make_clock_statistics(), "m1", "m2")
    assert (use.offset_first_us, use.offset_us) == (3_000_000, 3_000_100)
    assert (use.bound_p50_us, use.bound_max_us, use.rtt_min_us, use.faults) == (
        130.0,
        200,
        180,
        2,
    )
    assert (use.drift_ppm, use.drift_bound_ppm) == (50.0, 0.9)
    (line,) = list_lines(make_clock_statistics(), "clock of ")
    assert line == (
        "clock of m1 seen by m2: +3000.100 ms at the end, known to 60 us (p50 130, max 200), "
        "drift +50.00 ppm, 2 samples arrived before they were sent: a clock has stepped"
    )


def test_shared_clocks_get_no_line():
    shared = ClockSummary.of_link(make_clock_statistics(), "s", "m2")
    assert shared is not None
    assert shared.shared
    assert ClockSummary.of_link(make_clock_statistics(), "m2", "m1") is None
    assert list_lines(make_short_log("paper"), "clock of ") == []


def test_the_cause_of_the_end_is_one_line() -> None:
    long = "the law a:B of s failed at tick 3: \x1b[31m" + "x" * 1000
    said = [
        Event(member="s", boot=1, kind=kind, text=text)
        for kind, text in (
            ("ready", "s is ready"),
            ("failed", long),
            ("law", "slow"),
            ("arm", "off"),
        )
    ]
    failed, law, arm = format_run_lines(rewrite_log(make_short_log("paper"), others=said))
    assert (law, arm) == ("slow", "off")
    assert failed.startswith("the law a:B of s failed at tick 3:  [31mxxx")
    assert len(failed) == MOST_LINE_CHARACTERS


TABLE = TextTable(
    ("site", "delay", "note"),
    [["energies"], ["m1", "40.5", "|e| [red]"], ["long name", "7", "\x1b[2J"]],
    align="lrl",
    units=("", "ms"),
)


def test_lines_are_aligned_and_short_rows_stay_short() -> None:
    assert TABLE.lines() == [
        "site       delay ms  note",
        "energies",
        "m1             40.5  |e| [red]",
        "long name         7  \x1b[2J",
    ]


def test_markdown_escapes_bars_and_marks_numbers() -> None:
    heads, rule, group, first, _ = TABLE.markdown().splitlines()
    assert heads == "| site | delay ms | note |"
    assert rule == "| --- | --: | --- |"
    assert group == "| energies |  |  |"
    assert first == r"| m1 | 40.5 | \|e\| [red] |"


def test_terminals_get_all_cells_without_control_characters() -> None:
    console = Console(file=StringIO(), width=12)
    console.print(TABLE._replace(styles={"7": "green"}).rich())
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "\x1b" not in text
    assert "".join(text.split()).count("[red]") == 1
    console = Console(file=StringIO(), width=40)
    # without headers, without their line
    console.print(TextTable(("", ""), [("a", "b")]).rich())
    assert console.file.getvalue().split() == ["a", "b"]  # type: ignore[attr-defined]
