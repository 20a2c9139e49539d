"""Computes results from the log of a run: delays, events, metrics and a stability judgement.

A log is the file that a run leaves behind. It has a record of the state of every arm for each
period of the control loop. For example, `metrics` computes the RMS tracking error of an arm
from these records, and `certificate` judges whether the run was stable.

Invariant:
    - Nothing in this package draws, formats or prints. The package `presentation` does so.
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
    "find_hanging_sites",
    "judge_virtual_run",
    "reduce_to_buckets",
    "run_remarks",
    # The certificate
    "KEPT_S",
    "ZERO_ENERGY_J",
    "Certificate",
    "EnergyBalance",
    "EnergyCourse",
    "ObservedEnergy",
    "ObservedFinding",
    "RecordWindow",
    "RunningEnergy",
    "certify_log",
    "find_missing_functionals",
    "find_unjudged_spans",
    "premise_quantities",
    "verdict_facts",
    # Twins
    "MOST_LOG",
    "EnvelopeTrend",
    "PushGrowth",
    "PushedTwins",
    "TwinGrowth",
    "fit_envelopes",
    "measure_amplitude",
    "twin",
    # Metrics
    "FrequencyResponse",
    "LogMetrics",
    "Metric",
    "Quantity",
    "compute_log_metrics",
    "find_quantity",
    "measure_run",
    "measure_undelayed_error",
    "quantities",
    # The linearised loop
    "MAX_COMMON_DELAY_S",
    "QUOTED_AT_HZ",
    "CharacteristicRoot",
    "Complex",
    "EdgeScan",
    "Equilibrium",
    "FrequencyBand",
    "GrowthColumn",
    "LinearAnalysis",
    "Minima",
    "OperatingConditions",
    "Passivity",
    "PortAnalysis",
    "Spectrum",
    "Transparency",
    "TwoPort",
    "analyse_linear_loop",
    "find_rightmost_root",
    "find_root_crossings",
    "find_run_roots",
    "find_samples_in_use",
    "read_hands",
    # Signals of a run
    "SETTLED_ERROR_RAD",
    "AlignedRecords",
    "BodyTurns",
    "Bools",
    "EndEffectorRows",
    "JointError",
    "PlacedArm",
    "RunView",
    "TorqueSplit",
    "align_records",
    "build_arm_rows",
    "compute_operator_script",
    "compute_target_motion",
    "joint_positions_m",
    "largest_magnitude",
    "list_walls",
    "settling_time_of_all_s",
    "site_signals",
    "upright_axes",
    "wall_depth",
    "wall_force",
    # Links, leaders and events
    "DelayDistribution",
    "FileOverview",
    "StatedModel",
    "find_closed_groups",
    "find_mode_intervals",
    "find_program",
    "find_user_shares",
    "find_users",
    "has_one_constant_delay",
    "info",
    "left_perron_vector",
    "link_summary",
    "list_alarms",
    "list_changes",
    "list_ramps",
    "list_stated_models",
    "measure_delay_distributions",
    "plan_dominance",
    "recorded_end_s",
    "sample_ages_ns",
    "summarise_run",
    "trace_dominance",
]

if TYPE_CHECKING:
    from . import decision_facts, link_summary, run_remarks, site_signals
    from .aligned import AlignedRecords, Bools, align_records
    from .arm_rows import (
        EndEffectorRows,
        PlacedArm,
        build_arm_rows,
        joint_positions_m,
        upright_axes,
    )
    from .body_turns import BodyTurns
    from .certificate import premise_quantities, verdict_facts
    from .certificate.certificate_result import Certificate
    from .certificate.energy_balance import ZERO_ENERGY_J, EnergyBalance
    from .certificate.observed_energy import ObservedEnergy, ObservedFinding
    from .certificate.premises import find_missing_functionals, find_unjudged_spans
    from .certificate.running_energy import KEPT_S, EnergyCourse, RecordWindow, RunningEnergy
    from .certificate.stability_certificate import certify_log
    from .dominance_history import (
        find_closed_groups,
        find_program,
        find_user_shares,
        find_users,
        left_perron_vector,
        list_ramps,
        plan_dominance,
        trace_dominance,
    )
    from .file_overview import FileOverview, info, summarise_run
    from .judge import certify_run, judge_virtual_run
    from .link_summary import (
        DelayDistribution,
        has_one_constant_delay,
        measure_delay_distributions,
        sample_ages_ns,
    )
    from .metrics.log_metrics import LogMetrics, compute_log_metrics, find_quantity, measure_run
    from .metrics.measured_impedance import FrequencyResponse
    from .metrics.measures import Metric, Quantity, quantities
    from .metrics.motion_metrics import measure_undelayed_error
    from .run_end import (
        FORCE_NM,
        NO_BUCKETS,
        THROWN_RAD,
        EndBehaviour,
        RunEnd,
        RunTrace,
        Stability,
        find_hanging_sites,
        reduce_to_buckets,
    )
    from .run_view import RunView
    from .site_signals import (
        SETTLED_ERROR_RAD,
        JointError,
        largest_magnitude,
        settling_time_of_all_s,
    )
    from .theory.characteristic_roots import CharacteristicRoot, Complex, Spectrum
    from .theory.delay_margin import MAX_COMMON_DELAY_S
    from .theory.floquet import find_samples_in_use
    from .theory.frequency_search import FrequencyBand, Minima
    from .theory.hand_files import read_hands
    from .theory.linear_analysis import LinearAnalysis, analyse_linear_loop
    from .theory.linear_edge import (
        EdgeScan,
        GrowthColumn,
        find_rightmost_root,
        find_root_crossings,
    )
    from .theory.loop_roots import find_run_roots
    from .theory.operating_point import Equilibrium, OperatingConditions
    from .theory.port_analysis import PortAnalysis, TwoPort
    from .theory.port_passivity import Passivity
    from .theory.port_response import QUOTED_AT_HZ, Transparency
    from .timeline import (
        StatedModel,
        find_mode_intervals,
        list_alarms,
        list_changes,
        list_stated_models,
        recorded_end_s,
    )
    from .torque_sources import (
        TorqueSplit,
        compute_operator_script,
        compute_target_motion,
        list_walls,
        wall_depth,
        wall_force,
    )
    from .twins.envelope_trend import EnvelopeTrend, fit_envelopes
    from .twins.twin_growth import (
        MOST_LOG,
        PushedTwins,
        PushGrowth,
        TwinGrowth,
        measure_amplitude,
        twin,
    )
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "aligned": "AlignedRecords Bools align_records",
            "arm_rows": (
                "EndEffectorRows PlacedArm build_arm_rows joint_positions_m upright_axes"
            ),
            "body_turns": "BodyTurns",
            "certificate.certificate_result": "Certificate",
            "certificate.energy_balance": "EnergyBalance ZERO_ENERGY_J",
            "certificate.observed_energy": "ObservedEnergy ObservedFinding",
            "certificate.premise_quantities": "premise_quantities",
            "certificate.premises": "find_missing_functionals find_unjudged_spans",
            "certificate.running_energy": "EnergyCourse KEPT_S RecordWindow RunningEnergy",
            "certificate.stability_certificate": "certify_log",
            "certificate.verdict_facts": "verdict_facts",
            "decision_facts": "decision_facts",
            "dominance_history": (
                "find_closed_groups find_program find_user_shares find_users "
                "left_perron_vector list_ramps plan_dominance trace_dominance"
            ),
            "file_overview": "FileOverview info summarise_run",
            "judge": "certify_run judge_virtual_run",
            "link_summary": (
                "DelayDistribution has_one_constant_delay link_summary "
                "measure_delay_distributions sample_ages_ns"
            ),
            "metrics.log_metrics": "LogMetrics compute_log_metrics find_quantity measure_run",
            "metrics.measured_impedance": "FrequencyResponse",
            "metrics.measures": "Metric Quantity quantities",
            "metrics.motion_metrics": "measure_undelayed_error",
            "run_end": (
                "EndBehaviour FORCE_NM NO_BUCKETS RunEnd RunTrace Stability THROWN_RAD "
                "find_hanging_sites reduce_to_buckets"
            ),
            "run_remarks": "run_remarks",
            "run_view": "RunView",
            "site_signals": (
                "JointError SETTLED_ERROR_RAD largest_magnitude settling_time_of_all_s "
                "site_signals"
            ),
            "theory.characteristic_roots": "CharacteristicRoot Complex Spectrum",
            "theory.delay_margin": "MAX_COMMON_DELAY_S",
            "theory.floquet": "find_samples_in_use",
            "theory.frequency_search": "FrequencyBand Minima",
            "theory.hand_files": "read_hands",
            "theory.linear_analysis": "LinearAnalysis analyse_linear_loop",
            "theory.linear_edge": (
                "EdgeScan GrowthColumn find_rightmost_root find_root_crossings"
            ),
            "theory.loop_roots": "find_run_roots",
            "theory.operating_point": "Equilibrium OperatingConditions",
            "theory.port_analysis": "PortAnalysis TwoPort",
            "theory.port_passivity": "Passivity",
            "theory.port_response": "QUOTED_AT_HZ Transparency",
            "timeline": (
                "StatedModel find_mode_intervals list_alarms list_changes "
                "list_stated_models recorded_end_s"
            ),
            "torque_sources": (
                "TorqueSplit compute_operator_script compute_target_motion list_walls "
                "wall_depth wall_force"
            ),
            "twins.envelope_trend": "EnvelopeTrend fit_envelopes",
            "twins.twin_growth": (
                "MOST_LOG PushGrowth PushedTwins TwinGrowth measure_amplitude twin"
            ),
        },
    )
