"""Computes delays, events, metrics and a stability verdict from the log of a run.

A log contains one record per site and tick. For example, `metrics` computes the RMS tracking
error of an arm from these records, and `certificate` judges whether the run was stable.

Invariant:
    - Nothing in this package draws, formats or prints. That is the task of the package
      `presentation`.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # The judgement
    "FORCE_NM",
    "NO_BUCKETS",
    "THROWN_RAD",
    "EndBehaviour",
    "RunEnd",
    "RunTrace",
    "Stability",
    "certify_run",
    "decision_facts",
    "judge_virtual_run",
    "run_remarks",
    # The certificate
    "KEPT_S",
    "ZERO_ENERGY_J",
    "Certificate",
    "EnergyBalance",
    "ObservedEnergy",
    "ObservedFinding",
    "RunningEnergy",
    "premise_quantities",
    "verdict_facts",
    # Twins
    "EnvelopeFit",
    "EnvelopeTrend",
    "SMALLEST",
    "PushGrowth",
    "PushedTwins",
    "TwinGrowth",
    "twin",
    # Metrics
    "LogMetrics",
    "Metric",
    "Quantity",
    # The linearised loop
    "MAX_COMMON_DELAY_S",
    "QUOTED_AT_HZ",
    "Complex",
    "GrowthColumn",
    "LinearAnalysis",
    "RestingLoop",
    "Passivity",
    "PortAnalysis",
    "analyse_linear_loop",
    "find_run_roots",
    # Signals of a run
    "SETTLED_ERROR_RAD",
    "AlignedRecords",
    "Bools",
    "JointError",
    "TorqueSplit",
    "build_arm_rows",
    "SourceRows",
    "largest_magnitude",
    "VirtualWall",
    "settling_time_of_all_s",
    "site_signals",
    # Links, leaders and events
    "DelayDistribution",
    "FileOverview",
    "info",
    "link_summary",
    "SharedSlave",
    "Timeline",
    "summarise_run",
    "DominanceHistory",
]

if TYPE_CHECKING:
    from . import decision_facts, link_summary, run_remarks, site_signals
    from .aligned import AlignedRecords, Bools
    from .arm_rows import build_arm_rows
    from .certificate import premise_quantities, verdict_facts
    from .certificate.energy_balance import ZERO_ENERGY_J, EnergyBalance
    from .certificate.observed_energy import ObservedEnergy, ObservedFinding
    from .certificate.running_energy import KEPT_S, RunningEnergy
    from .certificate.stability_certificate import Certificate
    from .dominance_history import DominanceHistory
    from .file_overview import FileOverview, info, summarise_run
    from .judge import certify_run, judge_virtual_run
    from .link_summary import DelayDistribution
    from .metrics.log_metrics import LogMetrics
    from .metrics.measures import Metric, Quantity
    from .run_end import (
        FORCE_NM,
        NO_BUCKETS,
        THROWN_RAD,
        EndBehaviour,
        RunEnd,
        RunTrace,
        Stability,
    )
    from .shared_slave import SharedSlave
    from .site_signals import (
        SETTLED_ERROR_RAD,
        JointError,
        largest_magnitude,
        settling_time_of_all_s,
    )
    from .theory.characteristic_roots import Complex
    from .theory.delay_margin import MAX_COMMON_DELAY_S
    from .theory.linear_analysis import LinearAnalysis, analyse_linear_loop
    from .theory.linear_edge import GrowthColumn
    from .theory.loop_roots import find_run_roots
    from .theory.port_analysis import PortAnalysis
    from .theory.port_passivity import Passivity
    from .theory.port_response import QUOTED_AT_HZ
    from .theory.resting_loop import RestingLoop
    from .timeline import Timeline
    from .torque_sources import SourceRows, TorqueSplit, VirtualWall
    from .twins.envelope_trend import EnvelopeFit, EnvelopeTrend
    from .twins.twin_growth import PushedTwins, PushGrowth, TwinGrowth, twin
    from .twins.twin_runs import SMALLEST
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "aligned": "AlignedRecords Bools",
            "arm_rows": "build_arm_rows",
            "certificate.energy_balance": "EnergyBalance ZERO_ENERGY_J",
            "certificate.observed_energy": "ObservedEnergy ObservedFinding",
            "certificate.premise_quantities": "premise_quantities",
            "certificate.running_energy": "KEPT_S RunningEnergy",
            "certificate.stability_certificate": "Certificate",
            "certificate.verdict_facts": "verdict_facts",
            "decision_facts": "decision_facts",
            "dominance_history": "DominanceHistory",
            "file_overview": "FileOverview info summarise_run",
            "judge": "certify_run judge_virtual_run",
            "link_summary": "DelayDistribution link_summary",
            "metrics.log_metrics": "LogMetrics",
            "metrics.measures": "Metric Quantity",
            "run_end": "EndBehaviour FORCE_NM NO_BUCKETS RunEnd RunTrace Stability THROWN_RAD",
            "run_remarks": "run_remarks",
            "shared_slave": "SharedSlave",
            "site_signals": (
                "JointError SETTLED_ERROR_RAD largest_magnitude settling_time_of_all_s "
                "site_signals"
            ),
            "theory.characteristic_roots": "Complex",
            "theory.delay_margin": "MAX_COMMON_DELAY_S",
            "theory.linear_analysis": "LinearAnalysis analyse_linear_loop",
            "theory.linear_edge": "GrowthColumn",
            "theory.loop_roots": "find_run_roots",
            "theory.port_analysis": "PortAnalysis",
            "theory.port_passivity": "Passivity",
            "theory.port_response": "QUOTED_AT_HZ",
            "theory.resting_loop": "RestingLoop",
            "timeline": "Timeline",
            "torque_sources": "SourceRows TorqueSplit VirtualWall",
            "twins.envelope_trend": "EnvelopeFit EnvelopeTrend",
            "twins.twin_growth": "PushGrowth PushedTwins TwinGrowth twin",
            "twins.twin_runs": "SMALLEST",
        },
    )
