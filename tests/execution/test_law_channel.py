"""What laws send to their peers: it comes to whom it is for, stands in the records, and is executed again."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.execution.deliveries import SITES, TICKS
from tests.execution.logs import OTHER_PLATFORM, without_records
from tests.log_editing import Record, edited, opened, recorded
from trilat_net.errors import LogError
from trilat_net.execution import virtual
from trilat_net.execution.rerun import rerun
from trilat_net.execution.verify import verify
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import open_log
from trilat_net.log.ros2.ros2_messages import read_ros2_channels
from trilat_net.log.view_rates import FULL_RATE_HZ
from trilat_net.presentation.rerun_viewer import build_plot_layout
from trilat_net.scenario import load_scenario

LAW = "tests.channel_law:Talking"
DELAY_TICKS = 20
SHORT: dict[str, Any] = {"duration_s": 0.12, "link.delay_ms": 20.0, "control.law": LAW}


def talk(**more: Any) -> bytes:
    return recorded("paper", {**SHORT, **more})


def test_each_peer_gets_its_own_vector_and_the_common_one() -> None:
    """The energy that a site states, from the records of its peers alone: what is for others is not in it."""
    log = opened(talk())
    alpha = log.scenario.dominance
    for site in SITES:
        energy = np.zeros(TICKS)
        for peer in log[site].peers:
            used = log[site].used[peer]
            assert used[-1] == TICKS - 1 - DELAY_TICKS
            heard = np.where(used[:, None] >= 0, log[peer].sent[f"target[{site}]"][used], 0.0)
            energy += (
                10.0 * alpha[site].get(peer, 0.0) * ((heard - log[site].q) ** 2).sum(axis=1)
            )
        assert log[site].sent["energy"][:, 0] == pytest.approx(energy, rel=1e-12)
        told = [log[site].sent[f"target[{peer}]"] - log[site].q for peer in log[site].peers]
        # the same for both joints
        assert all(np.ptp(one, axis=1).max() < 1e-12 for one in told)
        assert np.abs(told[0] - told[1]).min() > 5e-3  # and other for each peer


def test_it_is_executed_again_and_equals_virtual_time() -> None:
    log = opened(talk())
    verdict = verify(log)
    assert verdict.whole_run
    assert verdict.identical == verdict.records == 3 * TICKS
    twins = compare_with_virtual(log)
    assert twins.fed.identical == twins.plain.identical == 3 * TICKS
    again = rerun(log, ["m1", "s"])
    assert again.identical
    assert [effect.identical for effect in again.sites.values()] == [TICKS, TICKS]


@pytest.mark.parametrize("session", [None, OTHER_PLATFORM])
def test_behind_a_gap_it_goes_on_from_records(session: dict[str, str] | None) -> None:
    """As much can be judged as without a word between laws, and all of it agrees."""
    verdict = verify(without_records({"s": range(50, 61)}, talk(), session))
    assert verdict.gaps == [("s", 50, 60)]
    assert verdict.agreed
    data = recorded("paper", {**SHORT, "control.law": "tests.laws:Adaptive"})
    silent = verify(without_records({"s": range(50, 61)}, data, session))
    assert (verdict.identical, verdict.unjudged) == (silent.identical, silent.unjudged)


@pytest.mark.parametrize("session", [None, OTHER_PLATFORM])
@pytest.mark.parametrize(
    ("place", "name"),
    [(0, "energy[0]"), (1, "target[m1][0]"), (2, "target[m1][1]"), (4, "target[s][1]")],
)
def test_a_changed_number_shows_at_its_own_tick(
    place: int, name: str, session: dict[str, str] | None
) -> None:
    def record(r: Record) -> Record:
        if (r["site"], r["tick"]) == ("m2", 40):
            r["ch"][place] += 1e-3
        return r

    first = verify(opened(edited(talk(), record=record, session=session))).first
    assert first is not None
    assert first[:3] == ("m2", 40, f"ch.{name}")


@pytest.mark.parametrize(("place", "differing"), [(0, 3), (1, 2), (3, 2)])
def test_the_sum_of_arrivals_covers_exactly_what_a_site_gets(
    place: int, differing: int
) -> None:
    """A number that comes too late to be used shows where it came: at both peers, or at the one."""

    def record(r: Record) -> Record:
        if (r["site"], r["tick"]) == ("m2", TICKS - 2):
            r["ch"][place] += 1e-3
        return r

    assert verify(opened(edited(talk(), record=record))).differing == differing


def test_record_whose_law_sent_more_or_less_cannot_be_read() -> None:
    def record(r: Record) -> Record:
        return {**r, "ch": r["ch"][:-1]}

    log = opened(edited(talk(), record=record))
    with pytest.raises(LogError, match="ch has 4 numbers, not 5"):
        log["m1"].ch  # noqa: B018


def test_viewers_get_a_channel_per_vector_with_its_unit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    virtual.record_virtual(load_scenario("paper", SHORT), path, views_hz=FULL_RATE_HZ)
    channels = read_ros2_channels(path)
    about = {
        topic.rpartition("/")[2]: one.about
        for topic, one in channels.items()
        if "/viz/m2/" in topic
    }
    sent = {name: one["unit"] for name, one in about.items() if name.startswith("sent_")}
    assert sent == {"sent_energy": "J", "sent_target_to_m1": "rad", "sent_target_to_s": "rad"}
    log = open_log(path)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        shown = [
            [*one[3].data]
            for one in reader.iter_decoded_messages(topics=["/viz/m2/sent_target_to_s"])
        ]
    assert shown == log["m2"].sent["target[s]"].tolist()
    page = build_plot_layout(channels).pages["Sent by laws"]
    assert [plot.title for plot in page[0]] == [
        f"{site}: energy that the law sends to all (J)" for site in SITES
    ]
    assert page[1][0].curves[0].names == ("target1", "target2")


def test_tables_name_what_was_sent_with_its_unit() -> None:
    log = opened(talk())
    table = log.table("m2", "state")
    columns = {
        column.source: column for column in table.columns if column.source.startswith("ch.")
    }
    assert {source: (one.name, one.unit) for source, one in columns.items()} == {
        "ch.energy[0]": ("ch_energy_j", "J"),
        "ch.target[m1][0]": ("ch_target_m1_1_rad", "rad"),
        "ch.target[m1][1]": ("ch_target_m1_2_rad", "rad"),
        "ch.target[s][0]": ("ch_target_s_1_rad", "rad"),
        "ch.target[s][1]": ("ch_target_s_2_rad", "rad"),
    }
    assert [*columns["ch.target[s][1]"].values] == [state.ch[4] for state in log["m2"].states]
