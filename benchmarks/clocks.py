"""Compares measured delays with the true delays for a minute, between processes whose clocks differ and drift."""

import numpy as np

from tests.truth import Judged, judge_link, offset_errors
from trilat_net.log.log_reader import open_log

from .sessions import SITES, paper

SKEWS = {
    "m2": ("--clock-offset-s", "3", "--clock-drift-ppm", "100"),
    "s": ("--clock-offset-s", "-2", "--clock-drift-ppm", "-50"),
}
DURATION_S = 62


def run() -> list[str]:
    with paper(DURATION_S) as session:
        session.recorder()
        for name in SITES:
            session.site(name, "--needs-recorder", *SKEWS.get(name, ()))
        for process in session.processes.values():
            process.code(DURATION_S + 60.0)
        log = open_log(session.log)
        links = [(site, peer) for site in SITES for peer in log.scenario.peers(site)]
        samples = {link: judge_link(log, *link) for link in links}
        errors = np.concatenate([offset_errors(log, *link) for link in links])
    return [*_delays(list(samples.values())), *_clocks(errors)]


def _delays(links: list[Judged]) -> list[str]:
    error, bound, delay = (
        np.concatenate([getattr(link, name) for link in links])
        for name in ("error_us", "bound_us", "delay_us")
    )
    inside = float(np.mean(np.abs(error) <= bound + 1.0))
    p50, p99 = np.percentile(np.abs(error), (50, 99))
    return [
        f"one-way delay of {len(error)} samples: p50 {np.median(delay):.0f} us",
        f"  inside the bound: {100 * inside:.3f} % (bar: >= 99.9 %)",
        f"  bound: p50 {np.median(bound):.0f} us (bar: <= 200 us, idle)",
        f"  error: p50 {p50:.0f} us, p99 {p99:.0f} us",
    ]


def _clocks(errors: np.ndarray) -> list[str]:
    t_s, offset_us, drift_ppm = np.abs(errors).T
    lines = []
    for begin_s, bars in ((10.0, "bars: 100 us, 20 ppm"), (60.0, "bar: 5 ppm")):
        from_s = t_s >= begin_s
        lines.append(
            f"  after {begin_s:g} s: offset within {offset_us[from_s].max():.0f} us, "
            f"drift within {drift_ppm[from_s].max():.2f} ppm, at worst ({bars})"
        )
    return ["clocks 3 and -2 s ahead, drifting by 100 and -50 ppm:", *lines]
