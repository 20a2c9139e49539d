"""Logs of arms of six joints: the numbers of every joint are read and compared."""

import io
import math
from functools import cache

import numpy as np
import pytest

from tests.log.builders import Record, edit_log_bytes, open_bytes
from tests.scenario.builders import six_joint_text
from trilat_net.errors import LogError
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual import SimulatedLog, write_virtual_log
from trilat_net.log.log_reader import Log
from trilat_net.scenario.scenario_reader import load_scenario, parse_scenario

N = 6
TICKS = 80


@cache
def make_chain_bytes() -> bytes:
    """Returns a run in which every link delays by 20 ms."""
    stream = io.BytesIO()
    write_virtual_log(parse_scenario(six_joint_text(TICKS / 1000)), stream)
    return stream.getvalue()


def make_changed_log(field: str, numbers: int) -> Log:
    """Returns the log whose slave has that many numbers in a vector of one record."""

    def change(record: Record) -> Record:
        if (record["site"], record["tick"]) == ("s", 40):
            record[field] = (record[field] * 2)[:numbers]
        return record

    return open_bytes(edit_log_bytes(make_chain_bytes(), record=change))


@pytest.mark.parametrize(
    ("field", "numbers"), [("q", 5), ("q", 7), ("tau", 2), ("theta_hat", 5)]
)
def test_records_with_other_joints_are_refused(field: str, numbers: int) -> None:
    log = make_changed_log(field, numbers)
    with pytest.raises(
        LogError, match=f"a record of s cannot be read: .*{field} has {numbers} numbers, not"
    ):
        verify_log(log)
    with pytest.raises(LogError, match="a record of s cannot be read"):
        getattr(log["s"], field)


def test_one_bit_of_the_last_joint_is_found() -> None:
    def change(record: Record) -> Record:
        if (record["site"], record["tick"]) == ("m1", 50):
            record["qd"][N - 1] = math.nextafter(record["qd"][N - 1], math.inf)
        return record

    first = verify_log(open_bytes(edit_log_bytes(make_chain_bytes(), record=change))).first
    assert first is not None
    assert (first.site, first.tick, first.field) == ("m1", 50, f"qd[{N - 1}]")


TWO_LINKS = """<robot name="two">
  <link name="base"/>
  <joint name="q1" type="continuous"><parent link="base"/><child link="link1"/><axis xyz="0 0 1"/></joint>
  <link name="link1"><inertial><origin xyz="0.4 0 0"/><mass value="1.5"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.12"/></inertial></link>
  <joint name="q2" type="continuous"><parent link="link1"/><child link="link2"/><origin xyz="1.1 0 0"/>
    <axis xyz="0 0 1"/></joint>
  <link name="link2"><inertial><origin xyz="0.3 0 0"/><mass value="0.8"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.07"/></inertial></link>
  <joint name="end" type="fixed"><parent link="link2"/><child link="tip"/><origin xyz="0.9 0 0"/></joint>
  <link name="tip"/>
</robot>"""
PLANAR = {"l1_m": 1.1, "m1_kg": 1.5, "lc1_m": 0.4, "I1_kg_m2": 0.12}
PLANAR |= {"l2_m": 0.9, "m2_kg": 0.8, "lc2_m": 0.3, "I2_kg_m2": 0.07}


@pytest.mark.long
def test_a_planar_arm_equals_its_chain() -> None:
    """Unrolled and recursive leaves: every angle, speed and torque of both laws, with operators
    that push.
    """
    for law in ({"law": "adaptive", "Gamma": 0.0}, {"law": "p_d", "K": 30.0, "d": 4.0}):
        logs = []
        for arm in (PLANAR, {"urdf": "two.urdf", "down": [0.0, -1.0, 0.0]}):
            settings = {
                "arm": arm,
                "control": law,
                "duration_s": 2.0,
                "expect": {},
                "limits.qd_limit_rad_s": 100.0,
            }
            settings |= {"limits.tau_limit_nm": 200.0} | (
                {"urdf": {"two.urdf": TWO_LINKS}} if "urdf" in arm else {}
            )
            plain = load_scenario("paper", settings)
            if law["law"] == "adaptive":
                settings["control"] = {**law, "theta_hat0": plain.arms["s"].theta.tolist()}
            logs.append(SimulatedLog(load_scenario("paper", settings)))
        for site in logs[0].sites:
            for name in ("q", "qd", "tau", "q_des"):
                planar, chain = (getattr(log[site], name) for log in logs)
                assert np.abs(planar - chain).max() <= 1e-12 * (1.0 + np.abs(planar).max()), (
                    site,
                    name,
                )
        assert np.ptp(logs[0]["m1"].q, axis=0).min() > 0.05
