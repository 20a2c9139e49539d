"""Computes one period of the control loop of a robot arm: the computing core of the program.

Live sessions, simulations and the verification of logs all call this package. It contains the
models of the arms, the simulated network links between them, and the function that computes one
period (called a tick). README.md in this folder describes the stages of a tick and each file.

Invariant:

- Nothing in this package reads a clock, opens a socket or logs. Equal inputs therefore give
  equal results.
- All random numbers follow from a seed in the scenario, the file that describes an experiment.
- Only `jit` and `plugged` use files, for compiled code.
- The package depends on the standard library, NumPy, Numba, `errors`, `hooks`, `process`,
  `records` and `signals` alone.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # Ticks, records and modes
    "BUCKETS_PER_S",
    "MAX_ARRIVALS",
    "RELEASE_REASONS",
    "CoreChange",
    "DominanceRamp",
    "LifeAlarm",
    "LifeOrder",
    "LifeReason",
    "PlantState",
    "TickInput",
    "describe_divergence",
    "describe_mode",
    "find_life_reason",
    "first_tick_at",
    "tick_ns",
    # Sites and their arrays
    "MAX_CHANGES",
    "MAX_LINKS_BYTES",
    "MAX_RAMPS",
    "ROBUST_RESIDUE",
    "ChainSetup",
    "Gains",
    "Law",
    "LinkRow",
    "LinkSetup",
    "MotionLimits",
    "RecordedRows",
    "RestGains",
    "Scheme",
    "Site",
    "SiteArrays",
    "SiteSetup",
    "StaleAction",
    "StaleRule",
    "TaskSetup",
    "TickRepeater",
    "apply_change",
    "links_bytes",
    "make_layout",
    "needed_pages",
    # Numbers and vectors
    "Array",
    "IntArray",
    "Pair",
    "Points",
    "Row",
    "RowArray",
    "Vector",
    "choose",
    "five",
    "holds_anywhere",
    "pair",
    "put_pair",
    "relative_rotation",
    "rotation_matrix",
    "round_down",
    "sincos",
    "tanh",
    "whole",
    # Compiled functions
    "compiling_notice",
    "compute_fingerprint",
    "find_lane_address",
    "is_core_cached",
    "is_lane_code_stored",
    "lane_leaf",
    "leaf",
    "loop_leaf",
    "read_lane_assembly",
    "set_lane_form",
    # The stages of a tick, for runs side by side
    "NEVER_NS",
    "PROGRESS_DTYPE",
    "LawArrays",
    "RecentRecords",
    "ReplayedInputs",
    "adapts",
    "channel_of",
    "emit_stage",
    "error_stages",
    "finish_advance",
    "finish_site",
    "first_sent_column",
    "guard_reference",
    "guard_torque",
    "hold_motor_torque",
    "max_over_joints",
    "run_until",
    "sense_site",
    "sum_trapezoid",
    "sums_dtype",
    "torque_stage",
    "update_peaks",
    "update_sums",
    "updates_estimate",
    # Arms
    "COULOMB_SPEED",
    "LINK_PARAMETERS",
    "POSE",
    "POSITION",
    "ArmLinks",
    "ChainJoint",
    "Matrix",
    "Three",
    "apply",
    "build_chain",
    "chain_stages",
    "dot",
    "find_acceleration",
    "forward_kinematics",
    "inverse_dynamics",
    "mass_matrix",
    "multiply",
    "parameter_gradient",
    "place_end_effector",
    "place_joints",
    "propagate_motion",
    "regressor",
    "rotate",
    "task_space",
    "theta_from_links",
    "three",
    "two_link_stages",
    # Torques of operators and environments
    "LIVE_KINDS",
    "NO_TORQUE",
    "OWN_KINDS",
    "SCRIPTED_KINDS",
    "SourceTorque",
    "TorqueKind",
    "TorqueSource",
    "TorqueTable",
    "add_source_torque",
    "torque_on_arm",
    # Links and dominance
    "AHEAD_LIMIT_NS",
    "DELAY",
    "LINK_MODEL_DTYPE",
    "LOSS",
    "LOST",
    "MAX_DELAY_US",
    "ROW_SUM_TOLERANCE",
    "ChannelArrays",
    "DelayKind",
    "DrawKey",
    "LinkArrays",
    "LinkModel",
    "TraceEnd",
    "accept_sample",
    "advance_losses",
    "clamp_delay_us",
    "delay_sample",
    "dominance",
    "draw_delay_us",
    "draw_pair",
    "find_balancing_weights",
    "find_delay_us",
    "find_due_ns",
    "find_reach",
    "is_irreducible",
    "link_dtype",
    "link_key",
    "loses_samples",
    "max_delay_us",
    "perron_vector",
    "release_sample",
    "schedule_deliveries",
    "select_model",
    "uniforms",
    "update_reference",
    # Live hands and hands of users
    "GRIP_NS",
    "SILENCE_NS",
    "TAKEN",
    "HandCommand",
    "HandContext",
    "HandInForce",
    "HandMemory",
    "HandProgram",
    "HandReach",
    "HandRules",
    "HandView",
    "OwnHand",
    "advance_hand",
    "empty_hand_vector",
    # Safeguards and rest
    "BLEND_S",
    "HELD_OVERRUN_TICKS",
    "REST_RATE_1_S",
    "SeveralHands",
    # Control laws of users
    "CHECKED",
    "MAX_RECORD_SENT",
    "MAX_SENT",
    "CompiledLaw",
    "LawChannel",
    "LawContext",
    "LawEnergies",
    "LawForm",
    "LawInput",
    "LawRecords",
    "PeerRecords",
    "PeerView",
    "PlainLaw",
    "SentVector",
    "UserLaw",
    "UserLawFactory",
    "call_address",
    "collect_law_input",
    "compile_to_address",
    "compiled",
    "digest_sibling_sources",
    "finish_law",
    "list_numbers",
    "list_remembered",
    "plug_law",
    "read_memory",
    "sum_work",
    "update_law_view",
]

if TYPE_CHECKING:
    from .arms import chain_stages, task_space, two_link_stages
    from .arms.chain import (
        COULOMB_SPEED,
        LINK_PARAMETERS,
        ChainJoint,
        Matrix,
        Three,
        apply,
        build_chain,
        dot,
        find_acceleration,
        inverse_dynamics,
        mass_matrix,
        multiply,
        parameter_gradient,
        place_end_effector,
        place_joints,
        propagate_motion,
        rotate,
        three,
    )
    from .arms.elementary import sincos, tanh
    from .arms.exogenous import (
        LIVE_KINDS,
        NO_TORQUE,
        OWN_KINDS,
        SCRIPTED_KINDS,
        SourceTorque,
        TorqueKind,
        TorqueSource,
        TorqueTable,
        add_source_torque,
        torque_on_arm,
    )
    from .arms.rotation import relative_rotation, rotation_matrix
    from .arms.task_space import POSE, POSITION
    from .arms.two_link_arm import ArmLinks, forward_kinematics, regressor, theta_from_links
    from .life.live_hand import (
        GRIP_NS,
        SILENCE_NS,
        TAKEN,
        HandCommand,
        HandInForce,
        HandMemory,
        HandReach,
        HandRules,
        advance_hand,
        empty_hand_vector,
    )
    from .life.own_hand import HandContext, HandProgram, HandView, OwnHand
    from .life.resting import REST_RATE_1_S
    from .life.safeguards import BLEND_S
    from .life.session_life import HELD_OVERRUN_TICKS
    from .life.several_hands import SeveralHands
    from .links import dominance
    from .links.channel import (
        LOST,
        advance_losses,
        delay_sample,
        find_delay_us,
        find_due_ns,
        loses_samples,
        schedule_deliveries,
        select_model,
    )
    from .links.delay import (
        DELAY,
        LINK_MODEL_DTYPE,
        LOSS,
        MAX_DELAY_US,
        DelayKind,
        LinkModel,
        TraceEnd,
        clamp_delay_us,
        draw_delay_us,
        draw_pair,
        max_delay_us,
    )
    from .links.dominance import (
        ROW_SUM_TOLERANCE,
        find_balancing_weights,
        find_reach,
        is_irreducible,
        perron_vector,
        update_reference,
    )
    from .links.link import (
        AHEAD_LIMIT_NS,
        ChannelArrays,
        LinkArrays,
        accept_sample,
        link_dtype,
        release_sample,
    )
    from .links.philox import DrawKey, link_key, uniforms
    from .plug.compiled_law import (
        CHECKED,
        CompiledLaw,
        LawForm,
        collect_law_input,
        compiled,
        finish_law,
        plug_law,
    )
    from .plug.law_channel import MAX_RECORD_SENT, MAX_SENT, LawChannel, SentVector
    from .plug.law_energy import LawEnergies, LawRecords, PeerRecords, sum_work
    from .plug.law_view import PlainLaw, update_law_view
    from .plug.plugged import (
        call_address,
        compile_to_address,
        digest_sibling_sources,
        list_numbers,
    )
    from .plug.user_law import (
        LawContext,
        LawInput,
        PeerView,
        UserLaw,
        UserLawFactory,
        list_remembered,
        read_memory,
    )
    from .step.control import ROBUST_RESIDUE
    from .step.fingerprint import compute_fingerprint
    from .step.fused_run import (
        NEVER_NS,
        PROGRESS_DTYPE,
        LawArrays,
        RecentRecords,
        ReplayedInputs,
        finish_site,
        first_sent_column,
        max_over_joints,
        run_until,
        sense_site,
        sums_dtype,
        update_peaks,
        update_sums,
    )
    from .step.jit import (
        compiling_notice,
        find_lane_address,
        is_core_cached,
        is_lane_code_stored,
        lane_leaf,
        leaf,
        loop_leaf,
        read_lane_assembly,
        set_lane_form,
    )
    from .step.kernel import (
        adapts,
        channel_of,
        emit_stage,
        error_stages,
        finish_advance,
        guard_reference,
        guard_torque,
        hold_motor_torque,
        sum_trapezoid,
        torque_stage,
        updates_estimate,
    )
    from .step.recorded_ticks import RecordedRows, TickRepeater
    from .step.row_fields import LinkRow
    from .step.site_arrays import (
        MAX_CHANGES,
        MAX_LINKS_BYTES,
        MAX_RAMPS,
        SiteArrays,
        apply_change,
        links_bytes,
        needed_pages,
    )
    from .step.site_setup import (
        ChainSetup,
        Gains,
        Law,
        LinkSetup,
        MotionLimits,
        RestGains,
        Scheme,
        SiteSetup,
        StaleAction,
        StaleRule,
        TaskSetup,
        make_layout,
    )
    from .step.site_step import Site
    from .step.ticks import (
        BUCKETS_PER_S,
        MAX_ARRIVALS,
        RELEASE_REASONS,
        CoreChange,
        DominanceRamp,
        LifeAlarm,
        LifeOrder,
        LifeReason,
        PlantState,
        TickInput,
        describe_divergence,
        describe_mode,
        find_life_reason,
        first_tick_at,
        tick_ns,
    )
    from .step.vectors import (
        Array,
        IntArray,
        Pair,
        Points,
        Row,
        RowArray,
        Vector,
        choose,
        five,
        holds_anywhere,
        pair,
        put_pair,
        round_down,
        whole,
    )
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "arms.chain": (
                "COULOMB_SPEED ChainJoint LINK_PARAMETERS Matrix Three apply build_chain "
                "dot find_acceleration inverse_dynamics mass_matrix multiply "
                "parameter_gradient place_end_effector place_joints propagate_motion rotate "
                "three"
            ),
            "arms.chain_stages": "chain_stages",
            "arms.elementary": "sincos tanh",
            "arms.exogenous": (
                "LIVE_KINDS NO_TORQUE OWN_KINDS SCRIPTED_KINDS SourceTorque TorqueKind "
                "TorqueSource TorqueTable add_source_torque torque_on_arm"
            ),
            "arms.rotation": "relative_rotation rotation_matrix",
            "arms.task_space": "POSE POSITION task_space",
            "arms.two_link_arm": "ArmLinks forward_kinematics regressor theta_from_links",
            "arms.two_link_stages": "two_link_stages",
            "life.live_hand": (
                "GRIP_NS HandCommand HandInForce HandMemory HandReach HandRules SILENCE_NS "
                "TAKEN advance_hand empty_hand_vector"
            ),
            "life.own_hand": "HandContext HandProgram HandView OwnHand",
            "life.resting": "REST_RATE_1_S",
            "life.safeguards": "BLEND_S",
            "life.session_life": "HELD_OVERRUN_TICKS",
            "life.several_hands": "SeveralHands",
            "links.channel": (
                "LOST advance_losses delay_sample find_delay_us find_due_ns loses_samples "
                "schedule_deliveries select_model"
            ),
            "links.delay": (
                "DELAY DelayKind LINK_MODEL_DTYPE LOSS LinkModel MAX_DELAY_US TraceEnd "
                "clamp_delay_us draw_delay_us draw_pair max_delay_us"
            ),
            "links.dominance": (
                "ROW_SUM_TOLERANCE dominance find_balancing_weights find_reach "
                "is_irreducible perron_vector update_reference"
            ),
            "links.link": (
                "AHEAD_LIMIT_NS ChannelArrays LinkArrays accept_sample link_dtype "
                "release_sample"
            ),
            "links.philox": "DrawKey link_key uniforms",
            "plug.compiled_law": (
                "CHECKED CompiledLaw LawForm collect_law_input compiled finish_law plug_law"
            ),
            "plug.law_channel": "LawChannel MAX_RECORD_SENT MAX_SENT SentVector",
            "plug.law_energy": "LawEnergies LawRecords PeerRecords sum_work",
            "plug.law_view": "PlainLaw update_law_view",
            "plug.plugged": (
                "call_address compile_to_address digest_sibling_sources list_numbers"
            ),
            "plug.user_law": (
                "LawContext LawInput PeerView UserLaw UserLawFactory list_remembered "
                "read_memory"
            ),
            "step.control": "ROBUST_RESIDUE",
            "step.fingerprint": "compute_fingerprint",
            "step.fused_run": (
                "LawArrays NEVER_NS PROGRESS_DTYPE RecentRecords ReplayedInputs finish_site "
                "first_sent_column max_over_joints run_until sense_site sums_dtype "
                "update_peaks update_sums"
            ),
            "step.jit": (
                "compiling_notice find_lane_address is_core_cached is_lane_code_stored "
                "lane_leaf leaf loop_leaf read_lane_assembly set_lane_form"
            ),
            "step.kernel": (
                "adapts channel_of emit_stage error_stages finish_advance guard_reference "
                "guard_torque hold_motor_torque sum_trapezoid torque_stage updates_estimate"
            ),
            "step.recorded_ticks": "RecordedRows TickRepeater",
            "step.row_fields": "LinkRow",
            "step.site_arrays": (
                "MAX_CHANGES MAX_LINKS_BYTES MAX_RAMPS SiteArrays apply_change links_bytes "
                "needed_pages"
            ),
            "step.site_setup": (
                "ChainSetup Gains Law LinkSetup MotionLimits RestGains Scheme SiteSetup "
                "StaleAction StaleRule TaskSetup make_layout"
            ),
            "step.site_step": "Site",
            "step.ticks": (
                "BUCKETS_PER_S CoreChange DominanceRamp LifeAlarm LifeOrder LifeReason "
                "MAX_ARRIVALS PlantState RELEASE_REASONS TickInput describe_divergence "
                "describe_mode find_life_reason first_tick_at tick_ns"
            ),
            "step.vectors": (
                "Array IntArray Pair Points Row RowArray Vector choose five holds_anywhere "
                "pair put_pair round_down whole"
            ),
        },
    )
