"""Every step of the real-time setup warns and continues, and reports the obtained settings."""

import json
import os
import subprocess
import sys

import pytest

from sites import realtime
from trilat_net import process

PROGRAM = """
import json, os, sys
from sites import realtime

{before}
obtained = realtime.prepare({cpu})
import gc
print(json.dumps([obtained, gc.isenabled(), sorted(os.sched_getaffinity(0))]))
"""


def run_prepared(
    cpu: object = None, before: str = ""
) -> tuple[dict[str, str], bool, list[int]]:
    program = PROGRAM.format(before=before, cpu=cpu)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return tuple(json.loads(done.stdout))


def test_steps_report_settings_and_pin_processes() -> None:
    cpu = min(os.sched_getaffinity(0))
    obtained, collecting, cpus = run_prepared(cpu)
    assert list(obtained) == ["affinity", "timer_slack", "memory", "scheduling", "collector"]
    assert all(obtained.values())
    assert not collecting
    assert obtained["collector"] == "frozen and off"
    assert cpus == [cpu]
    assert obtained["affinity"] == f"cpu {cpu}"


@pytest.mark.parametrize("cpu", [-1, 1023, 2**80])
def test_a_missing_processor_is_a_warning(cpu: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "request_real_time_scheduling", lambda: "")
    for step in ("_call_libc", "_stop_collector"):
        monkeypatch.setattr(realtime, step, lambda *_, **__: "")
    assert realtime.prepare(cpu)["affinity"].startswith("not obtained (")


REFUSE = "def refuse(*_): raise PermissionError(1, 'Operation not permitted')\n"


def test_without_privileges_the_loop_still_runs() -> None:
    refuse = f"{REFUSE}os.sched_setscheduler = os.setpriority = realtime._call_libc = refuse"
    obtained, collecting, _ = run_prepared(before=refuse)
    assert obtained["scheduling"].startswith("normal (")
    assert (
        obtained["memory"]
        == obtained["timer_slack"]
        == "not obtained (Operation not permitted)"
    )
    assert not collecting


def test_another_priority_is_better_than_none() -> None:
    refuse = f"{REFUSE}os.sched_setscheduler = refuse\nos.setpriority = lambda *_: None"
    assert (
        run_prepared(before=refuse)[0]["scheduling"]
        == "nice -10 (SCHED_FIFO was not permitted)"
    )


@pytest.mark.parametrize(("sites", "crowded"), [(4, False), (5, True)])
def test_many_sites_leave_processors_to_recorders(
    sites: int, crowded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "request_real_time_scheduling", lambda: "as asked")
    for step in ("_call_libc", "_set_affinity", "_stop_collector"):
        monkeypatch.setattr(realtime, step, lambda *_, **__: "as asked")
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    expected = "normal (5 sites share 2 processors)" if crowded else "as asked"
    assert realtime.prepare(None, sites)["scheduling"] == expected


BESIDE = """
import threading
for wait in [threading.Event().wait] * 2:
    threading.Thread(target=wait, daemon=True).start()
"""
POLICIES = """
def policy(thread):
    return os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority
beside = [int(thread) for thread in os.listdir("/proc/self/task") if int(thread) != os.getpid()]
print(json.dumps([policy(0), [policy(thread) for thread in beside]]))
"""


def test_other_threads_return_the_interpreter_at_once() -> None:
    """No other thread precedes the loop; otherwise it would keep the interpreter while the loop waits."""
    program = f"{PROGRAM.format(before=BESIDE, cpu=None)}{POLICIES}"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    obtained, policies = map(json.loads, done.stdout.splitlines())
    if obtained[0]["scheduling"] != "SCHED_FIFO 50":
        pytest.skip("needs the right to use SCHED_FIFO")
    assert policies == [[os.SCHED_FIFO, 50], [[os.SCHED_FIFO, 49]] * 2]


def test_other_platforms_have_less_and_go_on() -> None:
    lack = (
        "sys.platform = 'darwin'\n"
        "for name in ('sched_setaffinity', 'sched_setscheduler', 'SCHED_FIFO', 'setpriority'):\n"
        "    delattr(os, name)"
    )
    obtained, _, _ = run_prepared(0, before=lack)
    assert obtained["affinity"] == "not obtained (not on this platform)"
    assert obtained["memory"] == "not obtained (not on this platform)"
    assert obtained["scheduling"].startswith("normal (")
