"""Files for readers of other programs: simulated, recorded, in parts, recovered and exported."""

from collections.abc import Mapping
from pathlib import Path

from tests.log.builders import simulate_bytes, write_log
from trilat_net.execution import virtual
from trilat_net.log.log_reader import open_log
from trilat_net.log.log_writer import LogParts, LogStorage, LogWriter
from trilat_net.log.mcap_writer import Sink
from trilat_net.log.provenance import collect_provenance
from trilat_net.log.recovery import recover
from trilat_net.log.ros2.viz_channels import offer_views
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.net.wire import decode, encode, encode_state
from trilat_net.presentation.export import Exporter
from trilat_net.scenario import load_scenario

EPOCH_NS = 1_700_000_000_000_000_000
SCENARIO = load_scenario("two_sites", {"duration_s": 0.5})
KINDS = ("virtual", "live", "first part", "last part", "recovered")
VIEWS_HZ = 100.0


def record_live_file(storage: LogStorage) -> None:
    """Writes a session as the recorder does, with records that were sent late and arrived later."""

    def begin(stream: Sink, part: Mapping[str, str]) -> LogWriter:
        return LogWriter(
            stream,
            SCENARIO,
            "lab",
            "live",
            EPOCH_NS,
            collect_provenance(),
            part=part,
            choice=storage.choice,
            make_views=offer_views(SCENARIO, VIEWS_HZ),
        )

    with LogParts(storage, begin) as log:
        for step in virtual.execute_virtual(SCENARIO):
            name = step.site.name
            k = step.output.tick
            t_ns = step.output.t_ns
            sent_ns = t_ns + 80_000
            log_ns = EPOCH_NS + t_ns + 300_000
            payload = encode_state(
                name, 7, step.site.peers, step.output, step.arrivals, 70, 20, sent_ns
            )
            state = decode(payload, State)
            log.add(f"trilat/lab/{name}/state", payload, sent_ns, log_ns, k, state)
            if k % 100 == 0:
                stats = make_link_stats(name, step.site.peers[0], k, t_ns)
                log.add(f"trilat/lab/{name}/link", encode(stats), t_ns, log_ns, k, stats)
                log.flush()
        for n, name in enumerate(SCENARIO.names):
            end = Event(
                member=name,
                boot=7,
                kind="end",
                text=f"{name} made 500 ticks",
                t_ns=5 * 10**8,
                n=0,
            )
            log.add(
                f"trilat/lab/{name}/event",
                encode(end),
                end.t_ns,
                EPOCH_NS + 6 * 10**8 + n,
                0,
                end,
            )
        log.finish({})


def make_link_stats(site: str, peer: str, tick: int, t_ns: int) -> LinkStats:
    """Returns the statistics of a site with one peer, as a live loop publishes them."""
    counts = {name: {peer: 0} for name in ("accepted", "late", "duplicate", "refused")}
    measured = {"offset_us": {peer: -120}, "bound_us": {peer: 40}, "rtt_us": {peer: 400}}
    facts = {
        "v": 3,
        "site": site,
        "boot": 7,
        "tick": tick,
        "t_ns": t_ns,
        "mode": "run",
        "dropped": {},
    }
    loop = {"age_us": {peer: 1000 + tick}, "late_max_us": 90, "busy_max_us": 30, "overruns": 0}
    delays = {"delay_us": {peer: 210 + tick}, "delay_max_us": {peer: 900}}
    return LinkStats(**facts, **loop, **delays, **measured, **counts)


def write_standard_files(folder: Path) -> dict[str, Path]:
    """Writes a file of every kind, and the bag of the live one, and returns the paths by kind."""
    whole = write_log(folder, simulate_bytes(SCENARIO, views_hz=VIEWS_HZ), "virtual.mcap")
    live = folder / "live.mcap"
    record_live_file(LogStorage(live))
    record_live_file(LogStorage(folder / "parts.mcap", split_ns=200_000_000))
    parts = sorted(folder.glob("parts-*.mcap"))
    torn = write_log(folder, live.read_bytes()[: live.stat().st_size * 7 // 10], "torn.mcap")
    recovered = folder / "recovered.mcap"
    recover(torn, recovered)
    bag = folder / "live-ros2.mcap"
    Exporter("ros2", bag).export(open_log(live))
    paths = (whole, live, parts[0], parts[-1], recovered)
    return {**dict(zip(KINDS, paths, strict=True)), "bag": bag}
