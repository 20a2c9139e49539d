"""Predicts whether small motions of coupled arms decay, for a scenario or a log.

`LinearAnalysis.compute` implements the command `trilat linear`. It linearises the control loop
about an equilibrium, a pose in which all arms are at rest, and computes its characteristic
roots: the loop is stable if all roots have a negative real part. The roots are computed for the
sampled loop, whose controllers act once per tick, and for its continuous approximation. The
result also contains the delay margin and, if requested, the settings at the edge of stability
and what operators feel.

Without a given pose, the analysis uses the loop of `loop_roots`, as a stability certificate
does: the equilibrium nearest to the end of a run. For a log, this is the loop after all
commands, and the recorded run is not executed again. For a scenario, its run is simulated. Only
if this run diverges, or if there is no equilibrium near its end, the equilibrium is predicted,
or that of a longer run is used. If delays are random or measured, the sampled loop uses the
delays that occurred in the last quarter of the run, and the continuous loop uses their means.

Invariant:
    - The verdict is based on the sampled loop, or on the continuous loop if a control law can
      only be linearised in continuous time.
    - The verdict holds only for small motions about the equilibrium.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...core import Array
from ...errors import ScenarioError, UsageError
from ...execution import FusedRun
from ...log import Log
from ...results import Result
from ...scenario import IRREVERSIBLE_SHARES, Scenario, load_scenario
from ..blas_threads import limit_blas_threads
from ..stability_decision import NEAR_REST_RAD
from ..timeline import Timeline
from .characteristic_roots import CharacteristicRoot, Spectrum
from .delay_margin import DelayMargin
from .equilibrium import add_limit_notes, find_equilibrium
from .floquet import SampledLoop, SamplesInUse
from .linear_edge import EdgeScan
from .linear_loop import LinearLoop
from .loop_roots import EndLoop
from .numeric_law import NumericLaw
from .operating_point import Equilibrium, OperatingConditions
from .port_analysis import PortAnalysis
from .port_passivity import HandMatrices

DEFAULT_ROOTS = 6
"""Number of roots that are computed unless another number is requested."""
MAX_ROOTS = 60
"""Largest number of roots that can be requested."""
SAMPLED_ROOT_DIFFERENCE = 0.01
"""Largest difference between a continuous and a sampled root that is ignored, relative to
abs(s).
"""


@dataclass(frozen=True, repr=False)
class LinearAnalysis(Result):
    """Result of the linear stability analysis of coupled arms (see `LinearAnalysis.compute`).

    The arms are linearised about an equilibrium. The roots of the loop show whether small
    motions about it decay, and for which network delays.

    Attributes:
        scenario: The scenario.
        conditions: The data from which the loop is built: dominance factors, delays, operators
            and environments in effect.
        rest: The equilibrium about which the loop is linearised.
        loop: The loop linearised at the equilibrium.
        continuous: Characteristic roots of the continuous loop, a delay-differential equation.
        sampled: Characteristic roots of the loop with its ticks, or `None` if a law can only be
            linearised in continuous time.
        margin: The delays, common to all links, for which the continuous loop is stable.
        scans: For each requested key of the scenario, the values at which the loop becomes
            stable or unstable.
        ports: Analysis of the joints at which operators act (the haptic ports), or `None` if it
            was not requested.
        distance_rad: Largest difference between the final angle of a joint in the run and its
            angle at the equilibrium, in rad, or `None` if the equilibrium was not sought near
            the end of a run.
    """

    scenario: Scenario
    conditions: OperatingConditions
    rest: Equilibrium
    loop: LinearLoop
    continuous: Spectrum
    sampled: Spectrum | None
    margin: DelayMargin
    scans: tuple[EdgeScan, ...] = ()
    ports: PortAnalysis | None = None
    distance_rad: float | None = None

    @classmethod
    @limit_blas_threads()
    def compute(
        cls,
        source: str | Path | Scenario | Log,
        overrides: Mapping[str, Any] | Sequence[str] = (),
        *,
        pose: tuple[float, ...] | None = None,
        roots: int = DEFAULT_ROOTS,
        over: Sequence[str] = (),
        ports: bool = False,
        operators: Sequence[str | Path] = (),
    ) -> "LinearAnalysis":
        """Predicts whether small motions of the coupled arms of a scenario decay.

        The control loop is linearised about a pose in which all arms are at rest.

        Args:
            source: A scenario, its file, the name of a shipped scenario, or the log of a run.
            overrides: Settings of the scenario to replace. If there are any, only the scenario
                of a log is used, not its records.
            pose: Pose at rest that all arms share, in rad. If `None`, the final pose of a run
                is used.
            roots: Number of characteristic roots to compute.
            over: Ranges of settings in which to search for the values at which stability
                changes, such as "control.d=0.1:3".
            ports: True to also analyse what operators feel when they hold an arm.
            operators: Files of measured operators, from `trilat identify hand --json`. Any of
                them may hold the arm of any master.

        Raises:
            ScenarioError: The scenario is invalid, or cannot be linearised.
            UsageError: Another argument is invalid.
        """
        hands = [HandMatrices.read(Path(file)) for file in operators]
        ranges = [EdgeScan.parse(text) for text in over]
        if not 1 <= roots <= MAX_ROOTS:
            raise UsageError(f"--roots must be from 1 to {MAX_ROOTS}, not {roots}")

        scenario = load_scenario(source, overrides)
        if pose is None:
            log = source if isinstance(source, Log) and not overrides else None
            analysed = _find_end_loop(scenario, log)
        else:
            conditions = OperatingConditions.derive(scenario)
            analysed = _AnalysedLoop(scenario, conditions, find_equilibrium(scenario, pose))
        scenario = analysed.scenario
        conditions = analysed.conditions
        rest = analysed.rest
        loop = LinearLoop.of_conditions(conditions, rest)

        sampled = None
        if not conditions.has_forms:
            sampled = SampledLoop(conditions, analysed.uses).compute_spectrum(rest, roots)
        analysis = cls(
            scenario=scenario,
            conditions=conditions,
            rest=rest,
            loop=loop,
            continuous=Spectrum.of_loop(loop, roots),
            sampled=sampled,
            margin=DelayMargin.of_loop(loop),
            distance_rad=analysed.distance_rad,
        )

        scans = [edge_range.scan(scenario, rest) for edge_range in ranges]
        port_analysis = PortAnalysis.of_scenario(scenario, rest, hands=hands) if ports else None
        return replace(analysis, scans=tuple(scans), ports=port_analysis)

    @property
    def end_effectors(self) -> tuple[Array, ...]:
        """Pose of each arm's end effector at rest, if the arms follow with their end effectors.

        One array per arm. The arrays are empty if the arms follow joint by joint instead.
        """
        sites = self.conditions.sites
        if not sites[0].layout.task:
            return (np.zeros(0),) * len(sites)
        return tuple(self.conditions.compute_shared_poses(self.rest))

    @property
    def decisive(self) -> Spectrum:
        """The characteristic roots on which the stability verdict is based.

        These are the roots of the sampled loop, whose controllers act once per tick. If a
        control law can only be linearised in continuous time, they are the roots of the
        continuous loop.
        """
        return self.continuous if self.sampled is None else self.sampled

    @property
    def verdict(self) -> str:
        """The verdict on small motions of the arms: "stable", "unstable" or "at the edge".

        The verdict follows from the roots in `decisive`.
        """
        return self.decisive.verdict

    @property
    def is_far_from_rest(self) -> bool:
        """True if the run ends too far from the equilibrium for the analysis to apply to it.

        The limit is `NEAR_REST_RAD`. False for a scenario without a run, which has no final
        pose.
        """
        return self.distance_rad is not None and self.distance_rad > NEAR_REST_RAD

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user that qualify the verdict of the linear analysis.

        The remarks refer to the analysed conditions (such as delays and operators), the
        equilibrium about which the arms are linearised, and the characteristic roots.
        """
        notes = [*self.conditions.notes, *self.rest.notes]
        if self.is_far_from_rest:
            notes.append(
                f"the run of {self.scenario.duration_s:g} s ends {self.distance_rad:.3g} rad "
                "away from this rest: the verdict does not say whether the run would reach it"
            )
        if self.sampled is not None and self.sampled.verdict != self.continuous.verdict:
            decides = "ticks and delays decide"
            if self.sampled.span_s is None:
                decides = "the tick rate decides"
            notes.append(
                f"the continuous loop is {self.continuous.verdict}, the sampled loop is "
                f"{self.sampled.verdict}: {decides}"
            )

        if self.decisive.drifting:
            notes.append(
                f"{self.decisive.drifting} of the roots at zero only drift: "
                "their modes keep their speed"
            )
        if self.scenario.has_irreversible_shares:
            notes.append(IRREVERSIBLE_SHARES.removeprefix("note: "))
        ticks_grow = self.sampled is not None and self.sampled.verdict == "unstable"
        return (*notes, *self.scenario.describe_law_conditions(ticks_grow=ticks_grow))

    def headline(self) -> str:
        """One line for the user with the scenario, the verdict and the delay margin.

        The delay margin is the delay, common to all network links, up to which the arms stay
        stable.
        """
        return f"{self.scenario.name}: {self.verdict}; delay margin {self.margin.description}"

    def to_dict(self) -> dict[str, Any]:
        """Converts the analysis to the plain values that `trilat linear --json` prints.

        Results that were not requested, or that were not computed because of the kind of loop,
        are `None` or empty.
        """
        sampled = None
        if self.sampled is not None:
            sampled = _spectrum_to_json(self.sampled)
        ports = None
        if self.ports is not None:
            ports = self.ports.to_json()
        edges = {}
        for scan in self.scans:
            edges[scan.key] = [edge._asdict() for edge in scan.edges]

        return {
            "scenario": self.scenario.name,
            "scenario_sha256": self.scenario.sha256,
            "verdict": self.verdict,
            "rest": self._rest_to_json(),
            "delay_in_use_ms": self._delays_to_json(),
            "continuous": _spectrum_to_json(self.continuous),
            "as_computed": sampled,
            "margin": _margin_to_json(self.margin),
            "notes": list(self.notes),
            "ports": ports,
            "edges": edges,
        }

    def _rest_to_json(self) -> dict[str, Any]:
        """Returns the equilibrium as plain values, without the zeros that pad its arrays."""
        rest = self.rest
        q = {}
        theta_hat = {}
        for n, site in enumerate(self.conditions.sites):
            q[site.name] = rest.q[n][: site.layout.joints].tolist()
            # the memory of an imported law is not an estimate
            is_imported = isinstance(site.law_factory, NumericLaw)
            parameters = 0 if is_imported else site.layout.parameters
            theta_hat[site.name] = rest.theta_hat[n][:parameters].tolist()

        values: dict[str, Any] = {
            "how": rest.how,
            "residual": rest.residual,
            "run_ends_away_rad": self.distance_rad,
            "q_rad": q,
            "theta_hat": theta_hat,
        }
        if self.conditions.sites[0].layout.task:
            poses = [pose.tolist() for pose in self.end_effectors]
            values["x"] = dict(zip(self.scenario.names, poses, strict=True))
        return values

    def _delays_to_json(self) -> dict[str, float]:
        """Returns the age of the samples in use, in ms, by link."""
        conditions = self.conditions
        names = self.scenario.names
        receivers, senders = np.nonzero(conditions.alpha)
        delays_ms = {}
        for i, j in zip(receivers, senders, strict=True):
            link = f"{names[j]}->{names[i]}"
            delays_ms[link] = 1e3 * float(conditions.age_s[i, j])
        return delays_ms

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a table of the characteristic roots, with one row per root.

        The roots of the continuous loop come first, followed by those of the sampled loop
        (whose controllers act once per tick), if they were computed.
        """
        spectra = {"continuous": self.continuous, "as computed": self.sampled}
        rows: list[dict[str, Any]] = []
        for loop, spectrum in spectra.items():
            if spectrum is None:
                continue
            for root in _spectrum_to_json(spectrum)["roots"]:
                row = {"loop": loop, **root}
                row["states"] = ", ".join(root["states"])
                rows.append(row)
        return rows

    def find_sampled_root(self, root: CharacteristicRoot) -> CharacteristicRoot | None:
        """Finds the root of the sampled loop that corresponds to a root of the continuous loop.

        The nearest root is chosen. It is left out if the two roots are nearly equal, because
        showing both would then be redundant.

        Args:
            root: A root of the continuous loop.

        Returns:
            The sampled root, or `None` if the two roots differ by less than 1 % or there is no
            sampled root.
        """
        if self.sampled is None or not self.sampled.roots:
            return None
        nearest = min(self.sampled.roots, key=lambda sampled: abs(sampled.s - root.s))
        difference = abs(nearest.s - root.s)
        if difference <= SAMPLED_ROOT_DIFFERENCE * abs(root.s):
            return None
        return nearest


class _AnalysedLoop(NamedTuple):
    """Control loop of all arms that is linearised, with its pose of rest and its delays.

    Attributes:
        scenario: The scenario.
        conditions: The data from which the loop is built.
        rest: The equilibrium.
        uses: The samples in use in every tick. `None` if the scenario determines them.
        distance_rad: Distance of the end of the run from the equilibrium, in rad. `None` if the
            equilibrium was not sought next to the end of a run.
    """

    scenario: Scenario
    conditions: OperatingConditions
    rest: Equilibrium
    uses: SamplesInUse | None = None
    distance_rad: float | None = None


def _find_end_loop(scenario: Scenario, log: Log | None) -> _AnalysedLoop:
    """Finds the control loop at the end of a run, which the linear analysis examines.

    A stability certificate states the roots of the same loop. If the arms have no equilibrium
    near the end, the equilibrium of a longer run or a prediction is used.

    Args:
        scenario: The scenario of the run.
        log: The log of the run. `None` to simulate the run.
    """
    conditions = OperatingConditions.derive(scenario)
    try:
        if log is not None:
            scenario = Timeline(log).final_scenario
            end = EndLoop.of_log(log, own_laws=True)
        else:
            run = FusedRun(scenario)
            run.advance_to(scenario.duration_s)
            end = EndLoop.of_run(scenario, run)
    except ScenarioError:
        return _AnalysedLoop(scenario, conditions, find_equilibrium(scenario))

    if not end.has_mean_ages:
        conditions = end.conditions
    else:
        # The remarks on varying delays are kept, although the loop contains only their means.
        conditions = conditions._replace(age_s=end.conditions.age_s)
    rest = add_limit_notes(conditions, end.rest)
    return _AnalysedLoop(scenario, conditions, rest, end.uses, end.distance_rad)


def _margin_to_json(margin: DelayMargin) -> dict[str, Any]:
    """Converts the network delays for which the arms are stable to plain values for JSON.

    Args:
        margin: The delays at which the loop is stable.
    """
    intervals = []
    for interval in margin.intervals:
        ends = {"from_s": interval.low_s, "to_s": interval.high_s}
        intervals.append(ends)
    crossings = []
    for crossing in margin.crossings:
        values = {
            "delay_s": crossing.delay_s,
            "omega_rad_s": crossing.omega_rad_s,
            "pairs_to_the_right": crossing.pairs,
        }
        crossings.append(values)
    return {"words": margin.description, "stable": intervals, "crossings": crossings}


def _spectrum_to_json(spectrum: Spectrum) -> dict[str, Any]:
    """Converts the roots of a control loop to plain values for JSON output.

    Args:
        spectrum: The rightmost roots of the loop.
    """
    roots = []
    for root in spectrum.roots:
        values = {
            "re_per_s": root.s.real,
            "im_rad_s": root.s.imag,
            "damping": root.damping,
            "modes": root.multiplicity,
            "states": list(root.states),
        }
        roots.append(values)

    return {
        "verdict": spectrum.verdict,
        "roots": roots,
        "zeros_by_structure": spectrum.zeros,
        "of_those_drifting": spectrum.drifting,
        "dropped_candidates": spectrum.dropped,
        "order": spectrum.order,
        "span_s": spectrum.span_s,
        "deviation_per_s": spectrum.deviation_per_s,
    }
