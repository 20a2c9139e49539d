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
    "Stability",
    "VirtualRun",
    "certify_run",
    "stability_decision",
    "run_remarks",
    # The certificate
    "KEPT_S",
    "ZERO_ENERGY_J",
    "Certificate",
    "EnergyBalance",
    "ObservedEnergy",
    "RunningEnergy",
    "premise_quantities",
    "verdict_facts",
    # Twins
    "EnvelopeTrend",
    "SMALLEST",
    "PushGrowth",
    "PushedTwins",
    "TwinGrowth",
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
    # Signals of a run
    "SETTLED_ERROR_RAD",
    "AlignedRecords",
    "Bools",
    "JointError",
    "TorqueSplit",
    "build_arm_rows",
    "SourceRows",
    "VirtualWall",
    "settling_time_of_all_s",
    "site_signals",
    # Links, leaders and events
    "DelayDistribution",
    "info",
    "link_summary",
    "SharedSlave",
    "Timeline",
    "summarise_run",
    "DominanceHistory",
]

if TYPE_CHECKING:
    from . import link_summary, run_remarks, site_signals, stability_decision
    from .aligned import AlignedRecords, Bools
    from .arm_rows import build_arm_rows
    from .certificate import premise_quantities, verdict_facts
    from .certificate.energy_balance import ZERO_ENERGY_J, EnergyBalance
    from .certificate.observed_energy import ObservedEnergy
    from .certificate.running_energy import KEPT_S, RunningEnergy
    from .certificate.stability_certificate import Certificate
    from .dominance_history import DominanceHistory
    from .file_overview import info, summarise_run
    from .judge import VirtualRun, certify_run
    from .link_summary import DelayDistribution
    from .metrics.log_metrics import LogMetrics
    from .metrics.measures import Metric, Quantity
    from .run_end import FORCE_NM, NO_BUCKETS, THROWN_RAD, EndBehaviour, RunEnd, Stability
    from .shared_slave import SharedSlave
    from .site_signals import SETTLED_ERROR_RAD, JointError, settling_time_of_all_s
    from .theory.characteristic_roots import Complex
    from .theory.delay_margin import MAX_COMMON_DELAY_S
    from .theory.linear_analysis import LinearAnalysis
    from .theory.linear_edge import GrowthColumn
    from .theory.port_analysis import PortAnalysis
    from .theory.port_passivity import Passivity
    from .theory.port_response import QUOTED_AT_HZ
    from .theory.resting_loop import RestingLoop
    from .timeline import Timeline
    from .torque_sources import SourceRows, TorqueSplit, VirtualWall
    from .twins.envelope_trend import EnvelopeTrend
    from .twins.twin_growth import PushedTwins, PushGrowth, TwinGrowth
    from .twins.twin_runs import SMALLEST
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "aligned": "AlignedRecords Bools",
            "arm_rows": "build_arm_rows",
            "certificate.energy_balance": "EnergyBalance ZERO_ENERGY_J",
            "certificate.observed_energy": "ObservedEnergy",
            "certificate.premise_quantities": "premise_quantities",
            "certificate.running_energy": "KEPT_S RunningEnergy",
            "certificate.stability_certificate": "Certificate",
            "certificate.verdict_facts": "verdict_facts",
            "dominance_history": "DominanceHistory",
            "file_overview": "info summarise_run",
            "judge": "VirtualRun certify_run",
            "link_summary": "DelayDistribution link_summary",
            "metrics.log_metrics": "LogMetrics",
            "metrics.measures": "Metric Quantity",
            "run_end": "EndBehaviour FORCE_NM NO_BUCKETS RunEnd Stability THROWN_RAD",
            "run_remarks": "run_remarks",
            "shared_slave": "SharedSlave",
            "site_signals": "JointError SETTLED_ERROR_RAD settling_time_of_all_s site_signals",
            "stability_decision": "stability_decision",
            "theory.characteristic_roots": "Complex",
            "theory.delay_margin": "MAX_COMMON_DELAY_S",
            "theory.linear_analysis": "LinearAnalysis",
            "theory.linear_edge": "GrowthColumn",
            "theory.port_analysis": "PortAnalysis",
            "theory.port_passivity": "Passivity",
            "theory.port_response": "QUOTED_AT_HZ",
            "theory.resting_loop": "RestingLoop",
            "timeline": "Timeline",
            "torque_sources": "SourceRows TorqueSplit VirtualWall",
            "twins.envelope_trend": "EnvelopeTrend",
            "twins.twin_growth": "PushGrowth PushedTwins TwinGrowth",
            "twins.twin_runs": "SMALLEST",
        },
    )
