"""Writes docs/data/json-keys.csv: the keys and types of every result's JSON, as samples have them.

python -m tests.json_samples
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

import trilat_net as tn
from tests.experiments import REACH, answer_form, write_hurried_pair, write_protocol
from tests.json_outline import TABLE, gather_types
from tests.sites.far_end import answering_far_end
from tests.sites.visits import ping_publishers, ping_sites
from trilat_net.results import Result

GOLDEN = Path(__file__).parent / "golden"
LOGS = (GOLDEN / "live-4g.mcap", GOLDEN / "live-paper.mcap", GOLDEN / "v3.mcap")
OF_LOGS: dict[str, Callable[[Path], Result]] = {
    "certify": tn.certify,
    "metrics": tn.metrics,
    "verify": tn.verify,
    "log info": tn.info,
    "log check": tn.check_file,
    "sim": tn.open_log,
    "compare": lambda file: tn.compare(file, LOGS[0]),
    "rerun": lambda file: tn.rerun(file, ["s"], {"control.Kd": 5}),
}
EXTERNAL = GOLDEN.parents[1] / "examples" / "external_arm.toml"
"""A scenario of which theory knows no delay margin."""
OTHERS: dict[str, Callable[[Path], list[Result]]] = {
    "linear": lambda _: [
        tn.linear("p_d_margin", over=["control.d=0.3:1"]),
        tn.linear("jitter", {"rate_hz": 200}, pose=(0.1, 0.2), over=["control.d=0.1:0.4"]),
    ],
    "tune": lambda _: [
        tn.tune_arm("arm6.urdf", delay, law, poses=1, curve=True)
        for delay, law in ((20, "pd_d"), (0, "p_d"))
    ],
    "twin": lambda _: [tn.twin(LOGS[1]), tn.twin(LOGS[1], delta="1e-9:1e-3")],
    "test": lambda _: [tn.check("free", jobs=1)],
    "sweep": lambda folder: [
        tn.sweep(
            "contact", ["link.delay_ms=20,200"], laws=["p_f"], out=folder / "contact", jobs=1
        ),
        tn.sweep("p_d_margin", ["control.d=1,2"], judge="twins", out=folder / "twins", jobs=1),
        tn.sweep(
            "jitter", ["control.d=0,3"], seeds=2, duration_s=20, out=folder / "jitter", jobs=1
        ),
    ],
    "sweep --margin": lambda _: [
        tn.margin("p_d_margin", f"control.d={span}", tolerance=0.2, duration_s=4, jobs=1)
        for span in ("0.2:3", "2:3")
    ],
    "compare --tune": lambda _: [
        tn.tune("jitter", ["p_d", "pd_d"], budget=12, seeds=2, duration_s=20, jobs=1)
    ],
    "bench": lambda folder: [
        tn.bench(
            tasks=["free", "contact"],
            laws=["p_d", "wave"],
            links=["rtt68-loss10"],
            seeds=2,
            out=folder / "bench",
            jobs=1,
        )
    ],
    "ping": lambda _: [ping_sites()],
    "ping --ros2": lambda _: [ping_publishers()],
    "ping --benchmark": lambda _: [
        tn.ping_benchmark("p_d_margin", duration_s=2),
        tn.ping_benchmark(EXTERNAL, duration_s=2),
        _benchmark_far_end(),
    ],
}
SINES = [
    {"kind": "multisine", "amplitude_nm": amplitude_nm, "frequencies_hz": frequencies_hz}
    for amplitude_nm, frequencies_hz in (
        ([2.0, 0.0], [0.5, 1.5, 3.0]),
        ([0.0, 2.0], [0.75, 1.75, 3.25]),
    )
]
HAND = {"kind": "tip_spring", "stiffness_n_m": [220.0, 150.0], "damping_n_s_m": [12.0, 9.0]}


def _benchmark_far_end() -> Result:
    """Returns the benchmark of a network whose far end is another program."""
    with answering_far_end() as endpoint:
        return tn.ping_benchmark("p_d_margin", duration_s=2, connect=[endpoint])


def _analyse_hurried_pair(folder: Path) -> Result:
    """Returns the analysis of a pair that ran into the time limit, and left questions without an answer."""
    hurried = folder / "hurried"
    hurried.mkdir()
    experiment = tn.run_experiment(write_hurried_pair(hurried), hurried / "out", jobs=1)
    for n, (number, who) in enumerate([(2, "P1"), (2, "P2"), (4, "P1"), (4, "P2")]):
        answer_form(
            experiment, f"q{n}", number, who, "tlx", [10.0, None, 30.0, 40.0, 50.0, 60.0]
        )
    return tn.analyse_experiment(experiment.folder)


def _analyse_hurried_users(folder: Path) -> Result:
    """Returns the analysis of users of whom some ran into the time limit in one of two conditions."""
    hurried = folder / "users"
    hurried.mkdir()
    file = write_protocol(hurried, task=REACH.replace("timeout_s = 6.0", "timeout_s = 2.6"))
    return tn.analyse_experiment(tn.run_experiment(file, hurried / "out", jobs=1).folder)


OF_PEOPLE: dict[str, Callable[[Path], list[Result]]] = {
    "identify hand": lambda _: [
        tn.identify_hand(
            tn.simulate(
                "free", {"rate_hz": 250, "duration_s": 28.0, "sites.m1.hands": [HAND, *SINES]}
            )
        )
    ],
    "experiment check": lambda folder: [tn.check_experiment(write_protocol(folder))],
    "experiment run": lambda folder: [
        tn.run_experiment(write_protocol(folder), folder / "experiment", jobs=1)
    ],
    "experiment analyse": lambda folder: (
        [
            tn.analyse_experiment(folder / "experiment", exclude=left)
            for left in ({}, {"P2": "left"})
        ]
        + [_analyse_hurried_pair(folder), _analyse_hurried_users(folder)]
    ),
    "experiment power": lambda _: [
        tn.compute_experiment_power(0.5, people) for people in (None, 20)
    ],
}


def build_table() -> str:
    """Returns the table."""
    samples = {name: [find(log).to_dict() for log in LOGS] for name, find in OF_LOGS.items()}
    for name in ("contact", "force_sharing"):
        log = tn.simulate(name)
        samples["metrics"].append(tn.metrics(log).to_dict())
        samples["certify"].append(tn.certify(log).to_dict())
    with tempfile.TemporaryDirectory() as folder:
        others = {**OTHERS, **OF_PEOPLE}
        samples |= {
            name: [result.to_dict() for result in find(Path(folder))]
            for name, find in others.items()
        }
    lines = ["command,key,type"]
    for name, results in samples.items():
        lines += [
            f"trilat {name},{path},{kind}" for path, kind in gather_types(results).items()
        ]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    TABLE.write_text(build_table(), encoding="utf-8")
