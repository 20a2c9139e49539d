"""Tables and data frames have every number of their records, under names that end in their units."""

import re
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.analysis.builders import make_busy_run, make_short_log
from tests.log.builders import edit_log_bytes, make_log, make_log_bytes, open_bytes, rewrite_log
from tests.log.split_logs import change_message, make_bytes_of_messages, read_messages
from trilat_net.core.step.site_setup import Layout
from trilat_net.core.step.ticks import NS_PER_S
from trilat_net.errors import LogError, UsageError
from trilat_net.files import Extra
from trilat_net.log.data_tables import UNIT_SUFFIXES, Column, Table, read_field_docs
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import Event, LinkStats, RecorderStats, State

STATE_VECTORS = Layout().lengths()


@cache
def make_paper_log() -> Log:
    return make_log("paper")


LOGS = {
    "paper": make_paper_log,
    "busy": lambda: make_busy_run().log,
    "four": lambda: make_short_log("four"),
}


@pytest.mark.parametrize("which", LOGS)
def test_column_names_are_unique_with_units(which: str) -> None:
    log = LOGS[which]()
    for table in log.tables():
        names = [column.name for column in table.columns]
        assert len(set(names)) == len(names)
        for column in table.columns:
            assert re.fullmatch(r"[a-z][a-z0-9_]{0,62}", column.name)
            assert len(column.values) == len(table)
            assert len(column.meaning) > 5
            assert column.source
            if column.unit and column.unit != "tick":
                assert (
                    column.name.split("_", 1)[-1].endswith(UNIT_SUFFIXES[column.unit])
                    or column.name in UNIT_SUFFIXES
                )


@pytest.mark.parametrize(
    ("live", "said"),
    [
        (False, "the age of its stamp; in virtual time"),
        (True, "its one-way delay, computed with"),
    ],
)
def test_delays_of_arrivals_state_their_kind(*, live: bool, said: str) -> None:
    """In virtual time the delay of a sample is not that of a network."""
    table = Table.of_arrivals(make_paper_log()["m1"], "run.mcap", live=live)
    (delay,) = (column for column in table.columns if column.name == "delay_us")
    assert delay.meaning.startswith(said)


@pytest.mark.parametrize("which", LOGS)
def test_a_row_of_states_is_its_record(which: str) -> None:
    log = LOGS[which]()
    units = dict.fromkeys(("q", "q_des"), "rad") | dict.fromkeys(("qd", "qd_des"), "rad_s")
    units |= dict.fromkeys(("tau", "tau_x"), "nm")
    for site in log.sites:
        table = log.table(site)
        assert table.label == f"{site}_state"
        rows = {column.name: column.rows(0, len(table)) for column in table.columns}
        for n, state in enumerate(log[site].states):
            assert (rows["tick"][n], rows["mode"][n]) == (state.tick, state.mode)
            assert (rows["late_us"][n], rows["busy_us"][n]) == (state.late_us, state.busy_us)
            assert rows["t_s"][n] == state.t_ns / NS_PER_S
            for field, unit in units.items():
                assert [rows[f"{field}{k + 1}_{unit}"][n] for k in range(2)] == getattr(
                    state, field
                )
            theta = [
                rows[f"theta_hat{k + 1}_{'kg_m2' if k < 3 else 'kg_m'}"][n] for k in range(5)
            ]
            assert theta == state.theta_hat
            for peer in log[site].peers:
                used = state.used[peer]
                stamp = used * NS_PER_S // log.scenario.sites[peer].rate_hz
                assert rows[f"used_{peer}_tick"][n] == (used if used >= 0 else None)
                assert rows[f"age_{peer}_ms"][n] == (
                    (state.t_ns - stamp) / 1e6 if used >= 0 else None
                )
    assert set(STATE_VECTORS) == {*units, "theta_hat"}


@pytest.mark.parametrize("which", LOGS)
def test_arrival_rows_equal_a_records_list(which: str) -> None:
    log = LOGS[which]()
    for site in log.sites:
        table = log.table(site, "arrivals")
        names = ("tick", "peer", "sample_tick", "delay_us")
        rows = zip(*(table[name].rows(0, len(table)) for name in names), strict=True)
        peers = log[site].peers
        assert list(rows) == [
            (state.tick, peers[peer], tick, delay_us)
            for state in log[site].states
            for peer, tick, delay_us in state.rx
        ]


def test_a_row_of_statistics_is_its_message() -> None:
    log = make_busy_run().log
    stats = LinkStats(
        v=3, site="a", boot=1, tick=20, t_ns=100_000_000, mode="hold", accepted={"b": 4, "c": 5}, late={},
        age_us={"b": -1, "c": 7}, duplicate={}, refused={}, dropped={"not finite": 2, "malformed": 1},
        late_max_us=8, busy_max_us=9, overruns=10, offset_us={"b": -1}, delay_us={"b": -1, "c": 12},
    )  # fmt: skip
    later = msgspec.structs.replace(stats, tick=40, dropped={})
    table = rewrite_log(log, keep=lambda s: s.tick < 3, others=[later, stats]).table(
        "a", "link"
    )
    first = {column.name: column.rows(0, 1)[0] for column in table.columns}
    assert first["tick"] == 20
    assert (first["t_s"], first["mode"], first["late_max_us"], first["overruns"]) == (
        0.1,
        "hold",
        8,
        10,
    )
    assert (first["age_b_us"], first["age_c_us"]) == (None, 7)  # -1: none yet
    # an offset of -1 us; none known
    assert (first["offset_b_us"], first["offset_c_us"]) == (
        -1,
        None,
    )
    assert (first["delay_b_us"], first["delay_c_us"]) == (None, 12)
    assert (first["accepted_b_count"], first["late_b_count"]) == (4, None)
    assert table["dropped_not_finite_count"].rows(0, 2) == [2, 0]
    assert table["dropped_malformed_count"].rows(0, 2) == [1, 0]


def test_empty_statistics_have_the_same_columns() -> None:
    some = make_log("paper")
    none = open_bytes(make_bytes_of_messages(make_log_bytes("paper"), []))
    for kind in ("state", "link", "arrivals"):
        assert [c.name for c in none.table("m1", kind).columns] == [
            c.name for c in some.table("m1", kind).columns
        ]
        assert len(none.table("m1", kind)) == 0
    assert len(none.table("events")) == 0


def test_events_are_in_their_order_of_arrival() -> None:
    log = make_paper_log()
    events = [
        Event(member="s", boot=2**64 - 1, kind="epoch", text="an epoch", boots={"m1": 5}, n=0),
        Event(member="m1", boot=1, kind="mode", text="holds, and says so", t_ns=7_000_000, n=0),
    ]
    table = rewrite_log(log, keep=lambda s: s.tick < 2, others=events).table("events")
    rows = {column.name: column.rows(0, 2) for column in table.columns}
    assert table.label == "events"
    assert sorted(zip(rows["member"], rows["t_s"], rows["boot"], strict=True)) == [
        ("m1", 0.007, 1),
        ("s", None, 2**64 - 1),
    ]
    assert sorted(rows["boots"]) == ["", '{"m1": 5}']
    messages = read_messages(make_log_bytes("paper"))
    ends = [m for m in messages if m[0].endswith("/event")]
    late = [
        (topic, payload, 10**9 - n, sent, number)
        for n, (topic, payload, _, sent, number) in enumerate(ends)
    ]
    assert open_bytes(make_bytes_of_messages(make_log_bytes("paper"), late)).table("events")[
        "member"
    ].rows(0, 3) == [
        "s",
        "m2",
        "m1",
    ]


def test_missing_tables_name_the_existing_ones() -> None:
    log = make_paper_log()
    with pytest.raises(KeyError, match="m1, m2, s"):
        log.table("m3")
    with pytest.raises(KeyError, match="state, link, arrivals"):
        log.table("m1", "links")
    with pytest.raises(KeyError, match="q1_rad, q2_rad"):
        log.table("m1")["q1"]


def test_arrivals_of_missing_peers_are_refused() -> None:
    log = open_bytes(
        edit_log_bytes(make_log_bytes("paper"), record=lambda r: {**r, "rx": [[5, 0, 0]]})
    )
    with pytest.raises(
        LogError, match="record of m1 lists a sample from a site that is not a peer"
    ):
        log.table("m1", "arrivals")


def test_numbers_beyond_64_bits_are_refused() -> None:
    messages = read_messages(make_log_bytes("paper"))
    event = next(m for m in messages if m[0].endswith("/event"))
    log = open_bytes(
        make_bytes_of_messages(
            make_log_bytes("paper"), [change_message(event, ticks=2**64 - 1)]
        )
    )
    with pytest.raises(LogError, match="ticks has a number that is out of range"):
        log.table("events")


def test_missing_numbers_in_columns_are_nan() -> None:
    known = np.array([True, False])
    column = Column("x_us", np.array([3, 4]), known=known)
    assert column.rows(0, 2) == [3, None]
    numbers = column.numbers()
    assert numbers[0] == 3
    assert np.isnan(numbers[1])
    assert Column("x_us", np.array([3, 4]), known=~known | known).numbers().dtype == np.int64


@pytest.mark.parametrize(
    ("name", "kind"), [("a", ""), ("a", "link"), ("b", "arrivals"), ("events", "")]
)
def test_a_frame_is_its_table(name: str, kind: str) -> None:
    log = make_busy_run().log
    table = log.table(name, kind)
    frame = log.frame(name, kind)
    assert frame.columns == [column.name for column in table.columns]
    assert frame.height == len(table)
    for column in table.columns:
        assert frame[column.name].to_list() == column.rows(0, len(table))


@pytest.mark.parametrize(
    ("library", "frame"),
    [
        ("polars", lambda log: log.frame("m1")),
        ("pandas", lambda log: log.to_frame("m1")),
        ("pandas", lambda log: log.to_frame()),
    ],
)
def test_missing_frame_libraries_name_their_installation(
    library: str, frame: Callable[[Log], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    hint = f"data frames need {library}: {Extra('frames').install_command}"
    with pytest.raises(UsageError, match=re.escape(hint)):
        frame(make_log("paper"))


ENDINGS = {"us": "us", "ns": "ns", "ppb": "ns/s", "bytes": "byte"}


@pytest.mark.parametrize("kind", [State, LinkStats, Event, RecorderStats])
def test_every_field_has_meaning_and_unit(kind: type[msgspec.Struct]) -> None:
    said = read_field_docs(kind)
    assert list(said) == list(kind.__struct_fields__)
    for field, (unit, text, json_type) in said.items():
        assert len(text) > 5, field
        assert "  " not in text
        assert json_type in ("integer", "string", "array", "object")
        if ending := ENDINGS.get(field.rpartition("_")[2]):
            assert unit == ending, field


@pytest.mark.parametrize("columns", [0, 1, 2])
def test_a_tables_length_is_its_columns(columns: int) -> None:
    column = Column("x_us", np.arange(5))
    assert len(Table("m", "", "", (column,) * columns)) == (5 if columns else 0)


@pytest.mark.parametrize(
    ("number", "expected"),
    [(0.0, 0), (2.0**53 - 1, 2**53 - 1), (1e300, 2**53), (-7.0, -1)],
)
def test_numbers_of_operators_stay_exact_integers(number: float, expected: int) -> None:
    """A number beyond the exact integers of floating-point numbers is stored as the last of these."""

    def change(record: dict[str, Any]) -> dict[str, Any]:
        return {**record, "hand": [1.0, number, number, *record["hand"][3:]]}

    log = open_bytes(edit_log_bytes(make_log_bytes("play"), record=change))
    for name in ("hand_number", "hand_source"):
        assert set(log.table("m1")[name].values.tolist()) == {expected}
