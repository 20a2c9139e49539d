"""A log repeats the hold of an arm by a person: verified, in fed virtual time, and executed again."""

import numpy as np
import pytest

from tests.execution.circling_hand import CirclingHand
from tests.log.builders import Record, edit_log_bytes, open_bytes, simulate_bytes
from trilat_net.analysis.aligned import AlignedRecords
from trilat_net.analysis.certificate.energy_balance import EnergyBalance, SiteEnergy
from trilat_net.analysis.torque_sources import SourceRows, TorqueSplit
from trilat_net.errors import ScenarioError
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual import SimulatedLog
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.execution.what_if import rerun
from trilat_net.log.log_reader import Log
from trilat_net.scenario import load_scenario

SECONDS = 1.2


@pytest.fixture(scope="module", params=["tip", "joint", "force"])
def held_log(request: pytest.FixtureRequest) -> Log:
    """Returns a run in which a person held m1 in each way."""
    live = [{"kind": "live", "mode": request.param}]
    scenario = load_scenario("paper", {"duration_s": SECONDS, "sites.m1.hands": live})
    return SimulatedLog(scenario, hands={"m1": CirclingHand(scenario, "m1")})


def test_logs_of_people_are_verified_and_repeated(held_log: Log) -> None:
    verification = verify_log(held_log)
    assert verification.passed
    assert verification.identical == verification.records == 3 * round(SECONDS * 1000)
    compared = compare_with_virtual(held_log)
    assert compared.fed.identical == compared.plain.identical == verification.records
    again = rerun(held_log, replace=["m1"])
    assert again.sites["m1"].identical == round(SECONDS * 1000)
    assert np.abs(held_log["m1"].tau_x).max() > 1.0


def test_the_force_is_zero_at_both_ends(held_log: Log) -> None:
    """The torque by the definition, from the log's own numbers, equals the record's, to rounding."""
    part = held_log["m1"]
    grip = part.hand[:, 0]
    torque = np.abs(part.tau_x).max(axis=1)
    assert not torque[grip == 0.0].any()
    assert part.t_s[grip > 0.0].max() == pytest.approx(0.7 + 0.2 + 0.1, abs=0.03)
    records = AlignedRecords.by_site(held_log)["m1"]
    split = TorqueSplit.of_records(records, held_log.scenario)
    source = held_log.scenario.sites["m1"].hands[0].actor
    expected = SourceRows(source).compute_live_torque(
        records.hand, records.q, records.qd, split.end_effector
    )
    assert expected == pytest.approx(-records.tau_x, abs=1e-9)
    assert split.operator == pytest.approx(expected, abs=1e-9)


def test_record_tables_name_the_hands_values(held_log: Log) -> None:
    table = held_log.table("m1")
    mode = held_log.scenario.sites["m1"].hands[0].mode
    first = {
        "tip": "hand_target_x_m",
        "joint": "hand_target_q1_rad",
        "force": "hand_force_x_n",
    }[mode]
    column = table[first]
    assert column.known is not None
    assert np.array_equal(column.known, held_log["m1"].hand[:, 2] == 7)
    assert np.array_equal(column.values, held_log["m1"].hand[:, 3])
    assert table["hand_number"].rows(300, 301) == [289]


@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
def test_a_changed_hand_is_found(mode: str) -> None:
    """A nanometre of a target in a record, or a nanonewton of a force, is another run."""

    def change(record: Record) -> Record:
        if record["site"] == "m1" and record["tick"] == 400:
            record["hand"][3] += 1e-9
        return record

    live = [{"kind": "live", "mode": mode}]
    scenario = load_scenario("paper", {"duration_s": SECONDS, "sites.m1.hands": live})
    data = simulate_bytes(scenario, hands={"m1": CirclingHand(scenario, "m1")})
    first = verify_log(open_bytes(edit_log_bytes(data, record=change))).first
    assert first is not None
    assert (first.site, first.tick) == ("m1", 400)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            {"sites.m1.hands": [{"kind": "live"}, {"kind": "live"}]},
            "an arm can have only one live hand",
        ),
        (
            {"sites.m1.hands": [{"kind": "live"}], "sites.m1.plant": "external"},
            "applies only to a simulated arm",
        ),
        (
            {"sites.m1.hands": [{"kind": "live", "mode": "tip", "torque_limit_nm": 2.0}]},
            "with mode 'joint'",
        ),
        ({"sites.m1.hands": [{"kind": "live", "mode": "foot"}]}, "must be one of"),
    ],
)
def test_an_invalid_live_hand_is_refused(changes: dict[str, object], problem: str) -> None:
    with pytest.raises(ScenarioError, match=problem):
        load_scenario("paper", changes)


def test_certificates_book_peoples_work_like_scripts(held_log: Log) -> None:
    """V changes by its booked terms, to 2e-5 of its largest value: `paper` itself closes to 1e-5."""
    balance = EnergyBalance.of_energies(SiteEnergy.by_site(held_log))
    assert np.abs(balance.external_work).max() > 0.1
    assert np.abs(balance.residual).max() < 2e-5 * balance.V.max()
