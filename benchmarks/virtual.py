"""Measures the speed of `trilat sim paper` with its full log, its parts, and then the speed of verify."""

import io

from trilat_net.execution import virtual
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.log.view_rates import VIZ_HZ
from trilat_net.net import topics
from trilat_net.net.wire import encode_state
from trilat_net.scenario import Scenario, load_scenario

from .stopwatch import best_s


def run() -> list[str]:
    scenario = load_scenario("paper")
    real = scenario.duration_s
    with_log = best_s(lambda: virtual.write_virtual_log(scenario, io.BytesIO()))
    with_views = best_s(
        lambda: virtual.write_virtual_log(scenario, io.BytesIO(), views_hz=VIZ_HZ)
    )
    alone = best_s(lambda: [None for _ in virtual.execute_virtual(scenario)])
    encoding, writing = time_writing(scenario)
    reading, checking = time_checking(scenario)
    return [
        f"sim paper with its full log: {real / with_log:.1f} x real time, best of 5 (bar: >= 15)",
        f"  stepping and the simulated network: {100 * alone / with_log:.0f} %",
        f"  encoding records: {100 * encoding / with_log:.0f} %",
        f"  writing MCAP: {100 * writing / with_log:.0f} %",
        f"with the standard channels of `trilat sim` beside it: {real / with_views:.1f} x real time",
        f"the same without a log: {real / alone:.0f} x real time",
        f"verify, from the file: {real / checking:.1f} x real time, best of 5 (bar: >= 15)",
        f"  of it reading and decoding: {100 * reading / checking:.0f} %",
    ]


def time_writing(scenario: Scenario) -> tuple[float, float]:
    """Returns the times to encode and to write all records of a run, in s."""
    steps = list(virtual.execute_virtual(scenario))

    def encode() -> list[tuple[str, bytes, int, int]]:
        return [
            (
                s.site.name,
                encode_state(s.site.name, 7, s.site.peers, s.output, s.arrivals, 0, 0),
                s.output.t_ns,
                s.output.tick,
            )
            for s in steps
        ]

    payloads = encode()

    def write() -> None:
        writer = LogWriter(
            io.BytesIO(), scenario, scenario.name, "virtual", 0, collect_provenance()
        )
        keys = {name: topics.key(scenario.name, name, topics.STATE) for name in scenario.names}
        for name, payload, t_ns, tick in payloads:
            writer.add(keys[name], payload, t_ns, t_ns, tick)
        writer.finish({})

    return best_s(encode), best_s(write)


def time_checking(scenario: Scenario) -> tuple[float, float]:
    """Returns the times to read and to verify a log, in s."""
    stream = io.BytesIO()
    virtual.write_virtual_log(scenario, stream)

    def read() -> None:
        stream.seek(0)
        log = open_log(stream)
        for name in log.sites:
            log[name].states  # noqa: B018 - the reading is measured

    def check() -> None:
        stream.seek(0)
        verify_log(open_log(stream))

    return best_s(read), best_s(check)
