"""Numbers on the pages equal the results of the commands, runs and formulas beside them.

A row has a page's words with `{}` for each number, and the source of the numbers in that order,
or a text in which the same words stand. A number of the page must agree with its source to six
tenths of its last printed digit.
"""

import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import uniform
from trilat_studies.sweep.sweep_cell import CellClass, classify_cell
from trilat_studies.tuning.candidate import CandidateScore
from trilat_studies.tuning.search_space import SEARCH_SPACES, ModelInformation, SearchSpace

import trilat_net
from tests.analysis.ages_in_use import compute_ordered_moments, newest_wins
from tests.analysis.builders import make_run
from tests.cli.running import trilat
from tests.execution.builders import run_fused, sample_records
from tests.scenario.builders import make_overrides
from tests.theory import delay_equations, energy
from tests.theory.figures_of_runs import find_value, measure_run
from tests.theory.loops import RODS
from trilat_net.analysis.certificate.energy_balance import EnergyBalance
from trilat_net.analysis.run_end import EndBehaviour
from trilat_net.analysis.theory import LinearAnalysis, find_equilibrium, iterate_linear_edges
from trilat_net.analysis.theory.port_analysis import PortAnalysis
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario
from trilat_net.scenario.delay_models import DELAY_MODELS

ROOT = Path(__file__).parents[1]
NUMBER = r"([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)"
WORDS = {"Twenty-three": "23", "eleven": "11", "twelve": "12", "−": "-"}
G = 9.81
WALL = "sites.s.environment.0"
DIGITAL = {"scheme": "digital", "rate_hz": 100, "link.delay_ms": 0}
CONSTANT = {"link__model": "constant", "link__delay_ms": 200.0}
NO_BOX = {"control__law": "adaptive", "control__theta_hat0": [0.0, 0.0, 0.0, 1.9, 0.95]}
KNOWN = {"control__Gamma": 0.0, "control__theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0]}
SOFT = {"control.K": 2, "sites.m1.q0_rad": [0.25, 0.2], "sites.m2.q0_rad": [-0.05, 0.4]}
EQUAL_KD = {"sites__m1__control__Kd": 3.0, "sites__s__control__Kd": 3.0}
SHARES = {"m1": {"m2": 0.1, "s": 0.9}, "m2": {"m1": 0.8, "s": 0.2}, "s": {"m1": 0.8, "m2": 0.2}}
SHEET = {
    "link.delay_ms": 20,
    "control.d": 0.25,
    "dominance": SHARES,
    **{f"sites.m2.arm.{key}": mass_kg for key, mass_kg in (("m1_kg", 0.5), ("m2_kg", 0.5))},
    **{f"sites.m2.arm.I{n}_kg_m2": 0.0416667 for n in (1, 2)},
    **{f"sites.s.arm.m{n}_kg": 0.667 for n in (1, 2)},
    **{f"sites.s.arm.I{n}_kg_m2": 0.0555833 for n in (1, 2)},
}
ONE_WAY = {"control.d": 4, "dominance": {"m1": {"m2": 1}, "m2": {"s": 1}, "s": {"m1": 1}}}
PAPER_END = (-0.1729, 0.0874)
Pose = tuple[float, float]
Numbers = Iterable[float | None]
Make = Callable[[], Numbers | str]
Changes = dict[str, Any]


# -- the linear loop


def find_continuous_root(
    name: str, changes: Changes, pose: Pose | None = None
) -> tuple[float, float]:
    analysis = LinearAnalysis.compute(
        load_scenario(name, changes), pose=pose, roots=1
    ).continuous.rightmost
    assert analysis is not None
    return analysis.s.real, abs(analysis.s.imag)


def find_root(
    name: str, changes: Changes | None = None, pose: Pose | None = None
) -> tuple[float, float]:
    """Returns the rightmost root that decides, the upper one of a pair."""
    analysis = LinearAnalysis.compute(
        load_scenario(name, changes or {}), pose=pose, roots=1
    ).decisive.rightmost
    assert analysis is not None
    return analysis.s.real, abs(analysis.s.imag)


def find_margin(name: str, changes: Changes | None = None) -> tuple[float, float]:
    """Returns the largest common delay, ms, and the frequency there, rad/s."""
    high = (
        LinearAnalysis.compute(load_scenario(name, changes or {}), roots=1)
        .margin.intervals[0]
        .high
    )
    assert high is not None
    return 1e3 * high.delay_s, high.omega_rad_s


def find_edge(
    name: str, key: str, low: float, high: float, changes: Changes, pose: Pose | None = None
) -> float:
    scenario = load_scenario(name, changes)
    rest = None if pose is None else find_equilibrium(scenario, pose)
    edge_found = next(iterate_linear_edges(scenario, key, low, high, rest), None)
    assert edge_found is not None
    return edge_found.value


def edge_of_p_d(name: str, share: float, delay_ms: float) -> float:
    line = share * 10.0 * delay_ms / 1e3
    return find_edge(name, "control.d", 0.05 * line, 1.2 * line, {"link.delay_ms": delay_ms})


def common_motion() -> tuple[float, float, float]:
    """Returns the damping that the common motion needs, in K T: the largest -sin x / x; the
    mass there, and two factors of it.
    """
    x = brentq(lambda x: math.tan(x) - x, 4.4, 4.6)
    return -math.sin(x) / x, 1.0 - math.cos(x), x**2


# -- ports


def analyse_shipped_ports(name: str, **changes: Any) -> PortAnalysis:
    scenario = load_scenario(name, make_overrides(**changes))
    return PortAnalysis.of_scenario(scenario, find_equilibrium(scenario, (-0.6, 1.8)))


def find_felt_impedance(port_analysis: PortAnalysis) -> Any:
    return next(
        transparency
        for transparency in port_analysis.transparency
        if (transparency.operator_site, transparency.joint) == ("m", 1)
    )


def list_learning_numbers(delay_ms: float) -> Numbers:
    analysed = analyse_shipped_ports("two_sites", link__delay_ms=delay_ms)
    assert analysed.proof is not None
    assert analysed.proof.passive
    minima = analysed.velocity.minima
    (band,) = minima.below
    return (
        *band[:2],
        minima.least,
        minima.least_hz,
        *find_felt_impedance(analysed).interpolate_magnitudes(1.0),
        find_felt_impedance(analysed).ratio_db,
    )


def find_known_ratio_db(delay_ms: float) -> float:
    analysed = analyse_shipped_ports("two_sites", link__delay_ms=delay_ms, **KNOWN)
    assert analysed.velocity.passive
    return float(find_felt_impedance(analysed).ratio_db)


def list_lacking_numbers() -> Numbers:
    velocity = analyse_shipped_ports("p_d_margin_two", control__d=1.96).velocity
    (band,) = velocity.minima.below
    return (
        *band[:2],
        velocity.minima.least,
        velocity.minima.least_hz,
        velocity.lacking_nm_s_rad,
    )


def analyse_reflection(delay_ms: float, d: float) -> PortAnalysis:
    open_ends = {"sites__m__hands": [], "sites__s__environment": []}
    return analyse_shipped_ports(
        "contact", **open_ends, link__delay_ms=delay_ms, sites__m__control__d=d
    )


def stable_with_any(delay_ms: float, d: float) -> Numbers:
    network = analyse_reflection(delay_ms, d)
    assert not network.absolute.below
    return [find_felt_impedance(network).ratio_db]


# -- runs


def run_shipped(name: str, duration_s: float | None = None, **changes: Any) -> FusedRun:
    scenario = load_scenario(name, make_overrides(**changes))
    return run_fused(scenario, duration_s)


def rms_of_free(delay_ms: float) -> float:
    """Returns the RMS of e over 20 s, of all joints and sites together, rad."""
    records = sample_records(
        load_scenario("free", {"link.delay_ms": delay_ms}), np.arange(0.02, 20.01, 0.02)
    )
    return float(np.sqrt(((records[..., :2] - records[..., 4:6]) ** 2).mean()))


def measure_windows(
    name: str, quantity: str, *windows: tuple[float, float, str], **changes: Any
) -> list[float]:
    """Returns quantities of windows of a run, window by window."""
    values = measure_run(name, make_overrides(**changes), *windows)
    return [find_value(values, key, n) for n in range(len(windows)) for key in quantity.split()]


def measure_age(**changes: Any) -> float:
    """Returns the mean age of the samples in use in `jitter`, ms."""
    return float(
        np.mean(
            [
                ages.mean_ms
                for ages in measure_run("jitter", make_overrides(**changes)).ages.values()
            ]
        )
    )


def list_anchored_angles(delay_s: float, duration_s: float) -> Numbers:
    """Returns the final angle of the first joint in `paper`: predicted, and of a run."""
    predicted = math.asin(-2.0 / (G * (1.0 + delay_s)))
    return predicted, run_shipped("paper", duration_s, link__delay_ms=1e3 * delay_s).q[0, 0]


def compute_pi() -> Any:
    alpha = np.array([[SHARES[i].get(j, 0.0) for j in SHARES] for i in SHARES])
    values, vectors = np.linalg.eig(alpha.T)
    vector = vectors[:, values.real.argmax()].real
    return vector / vector.sum()


def compute_lyapunov_balance(ones: bool = False, **changes: Any) -> EnergyBalance:
    return EnergyBalance.of_energies(
        make_run("lyapunov", make_overrides(**changes)).energies, paper_weights=ones
    )


def list_rises(V: Any) -> Numbers:
    return (V - np.minimum.accumulate(V)).max(), V[0]


def energy_of_healing() -> Numbers:
    """Returns the energy that the links give to the slave of `outage` as they heal, J."""
    balance = make_run("outage").balance
    healed = slice(*np.searchsorted(balance.t_s, (6.19, 6.21)))
    return (float(np.ptp(balance.work[f"{peer}->s"][healed])) for peer in ("m1", "m2"))


@cache
def certify_paper(folder: Path) -> str:
    trilat("sim", "paper", "-o", "run.mcap", cwd=folder)
    return trilat("certify", "run.mcap", cwd=folder).out


def uniform_age(order: Any, low_ms: float, high_ms: float) -> float:
    """Returns the mean age in use by the sums of docs/data/age-in-use.txt, at 1 kHz, ms."""
    return float(order(uniform(low_ms, high_ms - low_ms).cdf, 1.0)[0])


def list_distances(scheme: str) -> list[float]:
    """Returns distances from the exact solution of `paper`, rad, at three rates, and the orders
    between them.
    """
    far = [
        delay_equations.measure_distance("paper", scheme, rate_hz)
        for rate_hz in (500, 1000, 2000)
    ]
    return [*far, *delay_equations.measure_orders("paper", scheme)]


def shipped_trials() -> list[Any]:
    """Returns the trials of `trilat test --seeds 1..20`."""
    return [trial for name in SHIPPED for trial in trilat_net.trials(name, seeds=range(1, 21))]


SHIPPED = sorted(path.stem for path in (ROOT / "trilat_net/scenarios").glob("[a-z0-9]*.toml"))
DELAYS_MS = (20, 100, 200, 400, 800, 1600)
SETTLING_MS = (0, 20, 50, 100, 200, 400, 800)

LINEAR_METHOD: dict[str, Make] = {
    "a delay decays at {}/s": lambda: [-find_root("jitter")[0]],
    "at 400 ms grows at {}/s": lambda: find_root("jitter", {"link.playout_ms": 400})[:1],
}
LINEAR: dict[str, Make] = {
    "| point masses | {} ± {} j | {} ± {} j | {} ± {} j |": lambda: [
        part
        for T in (0, 200, 400)
        for part in find_continuous_root("free", {"link.delay_ms": T})
    ],
    "| rods | {} ± {} j | {} ± {} j | {} ± {} j |": lambda: [
        part
        for T in (0, 200, 400)
        for part in find_continuous_root("free", {"link.delay_ms": T, **RODS})
    ],
    "for good at {}, {}, {}, {}, {}, {} and {} s": lambda: [
        run_shipped("free", link__delay_ms=T).settled_s for T in SETTLING_MS
    ],
    "with every delay, from {} to {} rad": lambda: [rms_of_free(T) for T in (0, 800)],
    "in e: {}/s at 0, {}/s at 200 ms, {}/s at 1.6 s": lambda: [
        find_root("free", {"link.delay_ms": T}, (-0.124, 0.337))[0] for T in (0, 200, 1600)
    ],
    "| 8 | | roots | {} | {} | {} | {} | {} | {} |": lambda: [
        edge_of_p_d("p_d_margin", 0.5, T) for T in DELAYS_MS
    ],
    "| 16 | | roots | {} | {} | {} | {} | {} | {} |": lambda: [
        edge_of_p_d("p_d_margin_two", 1.0, T) for T in DELAYS_MS
    ],
    "the continuous loop decays at {}/s": lambda: [
        -find_continuous_root("paper", DIGITAL, PAPER_END)[0]
    ],
    "as computed grows at {}/s": lambda: find_root("paper", DIGITAL, PAPER_END)[:1],
    "is stable from {} Hz on": lambda: [
        find_edge("paper", "rate_hz", 20, 400, DIGITAL, PAPER_END)
    ],
    "unstable, {} ± {} j": lambda: find_root("contact"),
    "the margin is {} ms ({} rad/s)": lambda: find_margin("contact"),
    "force gain for 200 ms is {}": lambda: [
        find_edge("contact", "sites.m.control.k_f", 0.01, 1.0, {})
    ],
    "and a margin of {} ms at them": lambda: find_margin("paper", {"link.delay_ms": 0})[:1],
}
PORTS: dict[str, Make] = {
    **{
        f"| {T} | {{}}-{{}} Hz | {{}} at {{}} Hz | yes | {{}} / {{}} | {{}} |": lambda T=T: (
            list_learning_numbers(T)
        )
        for T in (0, 50, 200, 800)
    },
    "it is {} dB at T = 0 and {} dB at 200 ms": lambda: [
        find_known_ratio_db(0),
        find_known_ratio_db(200),
    ],
    "make it unstable, at {}-{} Hz.": lambda: analyse_shipped_ports(
        "training", timeline=[], sites__m1__hands=[], sites__m2__hands=[]
    ).absolute.below[0][:2],
    **{
        f"| {T} | {d} | some make it unstable, {{}}-{{}} Hz": lambda T=T, d=d: (
            analyse_reflection(T, d).absolute.below[0][:2]
        )
        for T, d in ((20, 5), (200, 5), (200, 30))
    },
    **{
        f"| {T} | {d} | stable | stable | {{}} |": lambda T=T, d=d: stable_with_any(T, d)
        for T, d in ((20, 30), (200, 60))
    },
}
ERRATA: dict[str, Make] = {
    "with ones rises by {} J of {} J while": lambda: list_rises(
        compute_lyapunov_balance(ones=True).V
    ),
    "M = {}`$ kg m²": lambda: [3.0 + math.sqrt(8.0)],
    r"that is $`\dot T \le {}`$.": lambda: [6.0 / (6.0 + (6.0 + math.sqrt(8.0)) ** 2)],
}
DAMPING: dict[str, Make] = {
    r"$`x = 0`$, and $`{}\, K T`$ for $`a = 1`$, at $`\tan x = x = {}`$. So": lambda: [
        common_motion()[0],
        math.sqrt(common_motion()[2]),
    ],
    r"m = {}\, K T^2 / {}`$, equal": lambda: common_motion()[1:],
    "K T`$, grow by {}/s.": lambda: find_root("p_d_margin", SHEET, (-0.1, 0.4))[:1],
    "200 ms and $`d = 4`$ grows by {}/s": lambda: find_root("p_d_margin", ONE_WAY, (-0.1, 0.4))[
        :1
    ],
    "1/6 of $`K T`$ is {}, 0.2172 of it {})": lambda: [2.0 / 6.0, 2.0 * common_motion()[0]],
}
PORT_CONDITIONS: dict[str, Make] = {
    "slave it is {}, {} and {} N m s/rad at 20, 200": lambda: [
        (200 * T + 40) ** 2 / 160 for T in (0.02, 0.2, 1)
    ],
}
LAB: dict[str, Make] = {
    "of these arms are {}, {} and {}, so": lambda: [
        find_edge("p_d_margin", "control.d", 0.5, 1.5, {"control.K": 12.0}),
        find_edge("p_d_margin_two", "control.d", 1.0, 3.0, {"control.K": 12.0}),
        find_edge(
            "p_d_margin", "control.d", 0.8, 2.4, {"control.K": 12.0, "dominance": SHARES}
        ),
    ],
    "only the first decays: {} rad at 38 s": lambda: measure_windows(
        "jitter", "error_peak_rad", (38, 40, "")
    ),
    "against {} rad at a constant 200 ms": lambda: measure_windows(
        "jitter", "error_peak_rad", (38, 40, ""), **CONSTANT
    ),
    "the age in use is {} ms on average": lambda: [measure_age()],
    "the order makes it {} ms": lambda: [measure_age(link__order="in_order")],
    "to choose from: {} ms": lambda: [measure_age(rate_hz=100)],
    "so {} rad, and the run ends at {}.": lambda: list_anchored_angles(0.2, 20),
    "At 400 ms it is {}, and {}.": lambda: list_anchored_angles(0.4, 40),
    "(1 + Lambda T) = {} N m/rad": lambda: [G**2 * 1.2],
    "moves the slave to {} rad for good": lambda: [run_shipped("box").q[-1, 0]],
    "without the box it returns to {}.": lambda: [run_shipped("box", **NO_BOX).q[-1, 0]],
    "pi = ({}, {}, {}), so": compute_pi,
    "proportional to ({}, {}, {}).": lambda: compute_pi() / (10.0, 3.0, 0.3),
    "V falls from {} to {} J": lambda: compute_lyapunov_balance().V[[0, -1]],
    "With ones it rises by {} of {} J": lambda: list_rises(
        compute_lyapunov_balance(ones=True).V
    ),
    "ones still fail, by {} J": lambda: list_rises(
        compute_lyapunov_balance(True, **EQUAL_KD).V
    )[:1],
    "At 20 ms one hit, then {} N.": lambda: measure_windows(
        "contact", "wall_mean_n", (14, 15, "s"), link__delay_ms=20.0
    ),
    "{} +- {} N, peaks of {} N": lambda: measure_windows(
        "contact", "wall_mean_n wall_deviation_n wall_peak_n", (9, 15, "s")
    ),
    "A fifth of the force settles at {} N": lambda: measure_windows(
        "contact", "wall_mean_n", (14, 15, "s"), sites__m__control__k_f=0.2
    ),
    "integrate it: {} N at 6 s, {} N at 10 s, {} N at 20 s, {} N at 59 s": lambda: (
        measure_windows(
            "windup", "wall_mean_n", *[(t - 0.1, t + 0.1, "s") for t in (6, 10, 20, 59)]
        )
    ),
    "With gravity known it stays at {} N": lambda: measure_windows(
        "windup", "wall_mean_n", (58.9, 59.1, "s"), control__Gamma=[1.0, 1.0, 1.0, 0.0, 0.0]
    ),
    "feels 5 * {} / {} = {} N m": lambda: [(p := compute_pi())[2], p[0], 5 * p[2] / p[0]],
    "trainee 5 * {} / {} = {} N m": lambda: [(p := compute_pi())[2], p[1], 5 * p[2] / p[1]],
    "torques with it: {} rad/s and {} N m, where {} N m": lambda: [
        *measure_windows("outage", "speed_peak_rad_s torque_peak_nm", (6, 15, "s")),
        *measure_windows("outage", "torque_peak_nm", (6, 15, "s"), link__outages_s=[]),
    ],
    "smoothly takes {} N m": lambda: measure_windows(
        "outage", "torque_peak_nm", (6, 15, "s"), on_stale__action="hold"
    ),
    "from the link, {} and {} J at 6.2 s": energy_of_healing,
}
PAGES: dict[str, dict[str, Make]] = {
    "docs/theory/errata-proof.md": ERRATA,
    "docs/theory/damping-conditions.md": DAMPING,
    "docs/theory/port-conditions.md": PORT_CONDITIONS,
    "docs/tutorials/lab-answers.md": LAB,
    "docs/theory/port-results.md": PORTS,
    "docs/studies/ports.md": {
        "not passive at {}-{} Hz; least eigenvalue {} at {} Hz; adding {} N m s/rad": list_lacking_numbers,
    },
    "docs/reference/laws-adaptive.md": {"towards one pose: {} N m/rad": lambda: [G**2 * 1.2]},
    "docs/theory/linear-method.md": LINEAR_METHOD,
    "docs/theory/linear-examples.md": LINEAR,
    "docs/reference/metrics.md": {
        "± 50 ms gives {} ms and {} ms, uniform 0 to 400 ms gives {} ms and {} ms": lambda: [
            uniform_age(order, *ends)
            for ends in ((150, 250), (0, 400))
            for order in (newest_wins, compute_ordered_moments)
        ]
    },
    "docs/reference/certificate-premises.md": {
        "prints its edge, {} kN/m": lambda: [
            1e-3
            * find_edge("windup", f"{WALL}.stiffness_n_m", 1e3, 4e4, {f"{WALL}.sampled": True})
        ],
    },
    "docs/reference/stability.md": {
        "ever more for 200 s, to {} rad/s": lambda: [
            run_shipped("free", 200.0, **make_overrides(**DIGITAL)).maxima[0][-2400:, 1].max()
        ],
    },
    "docs/data/map-p_d-edges.csv": {
        **{
            f" 10,{T},{{}},": lambda T=T: [edge_of_p_d("p_d_margin", 0.5, T)]
            for T in (50, 100, 150, 200, 300, 400, 600, 800, 1000, 1200, 1400)
        },
        **{
            f" 2,{T},{{}},": lambda T=T: [
                find_edge("p_d_margin", "control.d", 0.02, 0.6, {**SOFT, "link.delay_ms": T})
            ]
            for T in (50, 100, 150, 200, 250, 300, 350, 400)
        },
    },
    "docs/theory/benchmarks.md": {
        "at 500 / 1000 / 2000 Hz | {} / {} / {} rad: orders {} and {}": lambda: list_distances(
            "second_order"
        ),
        "`digital` at the same rates | {} / {} / {} rad: orders {} and {}": lambda: (
            list_distances("digital")
        ),
        "part of max V | `paper` {}, `asymmetric` {}; orders {} and {}": lambda: [
            *[
                energy.compute_shipped_balance(name).residual
                for name in ("paper", "asymmetric")
            ],
            *[
                energy.measure_order("paper", "second_order", rate_hz)
                for rate_hz in (1000, 2000)
            ],
        ],
        "the same with `digital` | {}, order {} and {}": lambda: [
            energy.compute_shipped_balance("paper", "digital").residual,
            *[energy.measure_order("paper", "digital", rate_hz) for rate_hz in (1000, 2000)],
        ],
        "makes {} runs of the shipped": lambda: [len(shipped_trials())],
        "random once): {} s simulated": lambda: [
            sum(trial.scenario.duration_s for trial in shipped_trials())
        ],
    },
    "docs/overview.md": {
        "{} scenarios show one": lambda: [len(SHIPPED)],
        "seeded: {} delay models": lambda: [len(DELAY_MODELS)],
    },
}
CERTIFIED = (
    "hands supplied: {} J at 0 s, {} J at {} s",
    "a small disturbance halves every {} s",
    "converged: largest |e| {} rad of m1 joint 1 and |qd| {} rad/s of m2 joint 1 in the last second",
    "closes to {} of the largest energy, {} J; to {} once",
    "this rest: stable, {} /s at {} rad/s",
    "judged all {} ticks; the digest chain agrees over {} messages",
)
LONG = (
    "of these arms are",
    "| roots |",
    "prints its edge",
    "ones still fail",
    "rises by",
    "from the link",
    "integrate it",
    "gravity known",
    "the same with `digital`",
    "part of max V",
)
"""Beginnings of words whose numbers take more than 3 s; other tests have their facts."""
PUSHED = 12
PUSHED_PAGES = (
    "docs/theory/linear-examples.md",
    "docs/studies/ports.md",
    "docs/theory/errata.md",
)
"""One of `PUSHED` numbers of these pages is tested on a push; the long tests have all numbers of all pages."""


def list_rows() -> Iterator[Any]:
    """Yields the page, the phrase and the source of every number, with a mark if the test is long."""
    for page, entries in PAGES.items():
        for n, (phrase, make) in enumerate(entries.items()):
            is_pushed = n % PUSHED == 0 and page in PUSHED_PAGES
            is_long = not is_pushed or any(word in phrase for word in LONG)
            marks = pytest.mark.long if is_long else ()
            yield pytest.param(page, phrase, make, id=f"{page}: {phrase}", marks=marks)


def list_numbers(phrase: str, text: str) -> list[str]:
    """Returns the numbers in the single place of a text that has these words."""
    pattern = NUMBER.join(map(re.escape, phrase.split("{}")))
    matches = re.findall(pattern, " ".join(text.split()))
    assert len(matches) == 1, f"{len(matches)} places"
    return [matches[0]] if isinstance(matches[0], str) else list(matches[0])


def check_page(page: str, phrase: str, source: Numbers | str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for word, plain in WORDS.items():
        text = text.replace(word, plain)
    wanted = (
        list(map(float, list_numbers(phrase, source)))
        if isinstance(source, str)
        else list(source)
    )
    printed = list_numbers(phrase, text)
    digits = [
        10.0 ** (int(e or 0) - len(m.partition(".")[2]))
        for m, _, e in (p.partition("e") for p in printed)
    ]
    off = [
        number is None or abs(number - float(word)) > 0.6 * digit
        for number, word, digit in zip(wanted, printed, digits, strict=True)
    ]
    assert not any(off), f"{printed} on the page, made: {wanted}"


@pytest.mark.parametrize(("page", "phrase", "make"), list(list_rows()))
def test_page_numbers_equal_their_source(page: str, phrase: str, make: Make) -> None:
    check_page(page, phrase, make())


@pytest.mark.long
def test_the_printed_certificate_is_the_example(tmp_path: Path) -> None:
    for phrase in CERTIFIED:
        check_page("docs/logs/certificate.md", phrase, certify_paper(tmp_path))


TUNED = re.findall(
    r"^\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \| (\w+ \d.*) \|$",
    (ROOT / "docs/theory/fair-comparison-results.md").read_text(encoding="utf-8"),
    re.MULTILINE,
)
AS_PRINTED = {"": [0.0, 0.0, 0.0, 2.0, 1.0], ", told nothing": 0.0}
ENDS = [
    pytest.param(n, id=f"{law} {reached}", marks=pytest.mark.long if n < 4 else ())
    for n, (law, reached, _, _) in enumerate(TUNED)
]


def score_candidate(duration_s: float, changes: Changes) -> CandidateScore:
    scenario = load_scenario(
        "free", {"limits.tau_limit_nm": 60, "duration_s": duration_s, **changes}
    )
    return CandidateScore.measure(scenario.text, None)


def test_the_table_of_tuned_gains_has_every_range() -> None:
    rows = [
        [
            law,
            knob.name,
            f"{knob.low:g}",
            f"{knob.high:g}",
            knob.unit or "-",
            knob.where or "all",
        ]
        for law, space in SEARCH_SPACES.items()
        for knob in space.knobs
    ]
    assert [row[:6] for row in read_table("tuned-gains.csv")] == rows


@pytest.mark.parametrize("row", ENDS)
def test_gains_repeat_the_ends_of_fronts(row: int) -> None:
    """The rows with gains in docs/theory/fair-comparison-results.md have four gains for the error, then four for settling."""
    assert len(TUNED) == 8
    law, reached, effort_nm, gains = TUNED[row]
    (space,) = SearchSpace.select([law], load_scenario("free"))
    values = {
        name: float(number) for name, number in (gain.split() for gain in gains.split(", "))
    }
    controls = space.controls(load_scenario("free"), ModelInformation.of_gravity(100.0), values)
    scores = score_candidate(
        30.0 if row < 4 else 6.0,
        {f"sites.{name}.control": table for name, table in controls.items()},
    )
    digit = 10.0 ** -len(reached.partition(".")[2])
    assert (scores.error_rad if row < 4 else scores.settled_s) == pytest.approx(
        float(reached), abs=0.6 * digit
    )
    assert scores.effort_nm == pytest.approx(float(effort_nm), abs=0.006)
    assert scores.outcome == "settled"


@pytest.mark.long
@pytest.mark.parametrize("statement", AS_PRINTED)
def test_printed_gains_repeat_the_page(statement: str) -> None:
    score = score_candidate(30.0, {"control.theta_hat0": AS_PRINTED[statement]})
    check_page(
        "docs/theory/fair-comparison-results.md",
        f"| as printed{statement} | {{}} | {{}} |",
        [score.error_rad, score.effort_nm],
    )


def read_table(name: str) -> list[list[str]]:
    """Returns the rows of a table of docs/data, without its head."""
    with (ROOT / "docs" / "data" / name).open(newline="", encoding="utf-8") as stream:
        return list(csv.reader(stream))[1:]


EDGES = read_table("map-p_d-edges.csv")
LIVE_CELLS = read_table("map-p_d-live.csv")


def classify_shipped(longest_s: float, **changes: Any) -> CellClass:
    return classify_cell(
        load_scenario("p_d_margin", make_overrides(**changes)).text, longest_s
    ).verdict


@pytest.mark.long
@pytest.mark.parametrize("row", range(19))
def test_p_d_edges_lie_between_two_runs(row: int) -> None:
    """The table of edges of docs/maps/README.md: unstable below, stable above."""
    assert len(EDGES) == 19
    stiffness, delay_ms, _, low, high = map(float, EDGES[row][:5])
    soft, longest_s = (SOFT, 640.0) if stiffness == SOFT["control.K"] else ({}, 320.0)
    changes = {**soft, "link.delay_ms": delay_ms, "duration_s": longest_s / 16.0}
    assert classify_shipped(longest_s, **changes, control__d=low).stable is False
    assert classify_shipped(longest_s, **changes, control__d=high).stable is True


@pytest.mark.parametrize("row", range(len(LIVE_CELLS)))
def test_live_cells_have_their_class(row: int) -> None:
    """A cell of docs/maps/README.md ends in virtual time as it ended live."""
    number, delay_ms, d, virtual, live = LIVE_CELLS[row]
    assert virtual == live
    # 40 values of d each
    assert int(number) == 40 * (int(delay_ms) // 40) + round(10.0 * float(d)) - 1
    changes = {"link.delay_ms": float(delay_ms), "control.d": float(d), "duration_s": 20.0}
    result = classify_cell(load_scenario("p_d_margin", changes).text, 160.0)
    assert result.motion is not None
    assert result.motion.value == virtual


@pytest.mark.long
@pytest.mark.parametrize(("delay_ms", "d"), [(1560, 2.5), (1600, 2.7)])
def test_hardly_excited_modes_are_not_ignored(delay_ms: float, d: float) -> None:
    """As docs/maps/README.md says, the mode grows at 0.01 to 0.03 /s, which the motion does not show."""
    assert (
        0.005 < find_root("p_d_margin", {"link.delay_ms": delay_ms, "control.d": d})[0] < 0.035
    )
    changes = make_overrides(link__delay_ms=delay_ms, control__d=d, duration_s=20.0)
    result = classify_cell(load_scenario("p_d_margin", changes).text, 160.0)
    assert result.motion is EndBehaviour.UNDECIDED
    assert result.verdict.stable is False
