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
    "PlantState",
    "TickInput",
    "describe_mode",
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
    "LinkSetup",
    "MotionLimits",
    "RecordedRows",
    "RestGains",
    "Site",
    "SiteArrays",
    "SiteSetup",
    "StaleRule",
    "TaskSetup",
    "TickRepeater",
    # Numbers and vectors
    "Array",
    "IntArray",
    "Pair",
    "Points",
    "Vector",
    "sincos",
    "tanh",
    # Compiled functions
    "compiling_notice",
    "compute_fingerprint",
    "is_core_cached",
    "leaf",
    "loop_leaf",
    # Arms
    "COULOMB_SPEED",
    "LINK_PARAMETERS",
    "POSE",
    "POSITION",
    "ArmLinks",
    "ChainDynamics",
    "ChainJoint",
    "FramePose",
    "Matrix",
    "Three",
    "chain_stages",
    "forward_kinematics",
    "regressor",
    "two_link_stages",
    # Torques of operators and environments
    "LIVE_KINDS",
    "OWN_KINDS",
    "SCRIPTED_KINDS",
    "TorqueKind",
    "TorqueSource",
    # Links and dominance
    "AHEAD_LIMIT_NS",
    "LOST",
    "MAX_DELAY_US",
    "ROW_SUM_TOLERANCE",
    "DominanceMatrix",
    "LinkModel",
    "LinkSchedule",
    "draw_pair",
    "link_key",
    # Live hands and hands of users
    "GRIP_NS",
    "SILENCE_NS",
    "TAKEN",
    "HandCommand",
    "HandContext",
    "HandInForce",
    "HandProgram",
    "HandReach",
    "HandRules",
    "HandView",
    "OwnHand",
    # Safeguards and rest
    "BLEND_S",
    "HELD_OVERRUN_TICKS",
    "REST_RATE_1_S",
    # Control laws of users
    "MAX_SENT",
    "LawChannel",
    "LawContext",
    "LawEnergies",
    "LawInput",
    "LawRecords",
    "PeerView",
    "SentVector",
    "UserLaw",
    "UserLawFactory",
    "compiled",
    "plug_law",
    # Runs of several sites, alone and side by side
    "CompiledRun",
    "LaneEpisodes",
    "RunGroup",
    "RunInputs",
    "TwinLanes",
]

if TYPE_CHECKING:
    from .arms import chain_stages, two_link_stages
    from .arms.chain import COULOMB_SPEED, LINK_PARAMETERS, ChainJoint, Matrix, Three
    from .arms.chain_dynamics import ChainDynamics
    from .arms.elementary import sincos, tanh
    from .arms.exogenous import LIVE_KINDS, OWN_KINDS, SCRIPTED_KINDS, TorqueKind, TorqueSource
    from .arms.frame_pose import FramePose
    from .arms.task_space import POSE, POSITION
    from .arms.two_link_arm import ArmLinks, forward_kinematics, regressor
    from .lanes.lane_episodes import LaneEpisodes
    from .lanes.run_groups import RunGroup
    from .lanes.twin_lanes import TwinLanes
    from .life.live_hand import (
        GRIP_NS,
        SILENCE_NS,
        TAKEN,
        HandCommand,
        HandInForce,
        HandReach,
        HandRules,
    )
    from .life.own_hand import HandContext, HandProgram, HandView, OwnHand
    from .life.resting import REST_RATE_1_S
    from .life.safeguards import BLEND_S
    from .life.session_life import HELD_OVERRUN_TICKS
    from .links.channel import LOST
    from .links.delay import MAX_DELAY_US, LinkModel, draw_pair
    from .links.dominance import ROW_SUM_TOLERANCE, DominanceMatrix
    from .links.link import AHEAD_LIMIT_NS
    from .links.link_schedule import LinkSchedule
    from .links.philox import link_key
    from .plug.compiled_law import compiled, plug_law
    from .plug.law_channel import MAX_SENT, LawChannel, SentVector
    from .plug.law_energy import LawEnergies, LawRecords
    from .plug.user_law import LawContext, LawInput, PeerView, UserLaw, UserLawFactory
    from .step.compiled_run import CompiledRun
    from .step.control import ROBUST_RESIDUE
    from .step.fingerprint import compute_fingerprint
    from .step.jit import compiling_notice, is_core_cached, leaf, loop_leaf
    from .step.recorded_ticks import RecordedRows, TickRepeater
    from .step.run_inputs import RunInputs
    from .step.site_arrays import MAX_CHANGES, MAX_LINKS_BYTES, MAX_RAMPS, SiteArrays
    from .step.site_setup import (
        ChainSetup,
        Gains,
        Law,
        LinkSetup,
        MotionLimits,
        RestGains,
        SiteSetup,
        StaleRule,
        TaskSetup,
    )
    from .step.site_step import Site
    from .step.ticks import (
        BUCKETS_PER_S,
        MAX_ARRIVALS,
        RELEASE_REASONS,
        CoreChange,
        DominanceRamp,
        LifeAlarm,
        PlantState,
        TickInput,
        describe_mode,
        first_tick_at,
        tick_ns,
    )
    from .step.vectors import Array, IntArray, Pair, Points, Vector
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "arms.chain": "COULOMB_SPEED ChainJoint LINK_PARAMETERS Matrix Three",
            "arms.chain_dynamics": "ChainDynamics",
            "arms.chain_stages": "chain_stages",
            "arms.elementary": "sincos tanh",
            "arms.exogenous": "LIVE_KINDS OWN_KINDS SCRIPTED_KINDS TorqueKind TorqueSource",
            "arms.frame_pose": "FramePose",
            "arms.task_space": "POSE POSITION",
            "arms.two_link_arm": "ArmLinks forward_kinematics regressor",
            "arms.two_link_stages": "two_link_stages",
            "lanes.lane_episodes": "LaneEpisodes",
            "lanes.run_groups": "RunGroup",
            "lanes.twin_lanes": "TwinLanes",
            "life.live_hand": (
                "GRIP_NS HandCommand HandInForce HandReach HandRules SILENCE_NS TAKEN"
            ),
            "life.own_hand": "HandContext HandProgram HandView OwnHand",
            "life.resting": "REST_RATE_1_S",
            "life.safeguards": "BLEND_S",
            "life.session_life": "HELD_OVERRUN_TICKS",
            "links.channel": "LOST",
            "links.delay": "LinkModel MAX_DELAY_US draw_pair",
            "links.dominance": "DominanceMatrix ROW_SUM_TOLERANCE",
            "links.link": "AHEAD_LIMIT_NS",
            "links.link_schedule": "LinkSchedule",
            "links.philox": "link_key",
            "plug.compiled_law": "compiled plug_law",
            "plug.law_channel": "LawChannel MAX_SENT SentVector",
            "plug.law_energy": "LawEnergies LawRecords",
            "plug.user_law": "LawContext LawInput PeerView UserLaw UserLawFactory",
            "step.compiled_run": "CompiledRun",
            "step.control": "ROBUST_RESIDUE",
            "step.fingerprint": "compute_fingerprint",
            "step.jit": "compiling_notice is_core_cached leaf loop_leaf",
            "step.recorded_ticks": "RecordedRows TickRepeater",
            "step.run_inputs": "RunInputs",
            "step.site_arrays": "MAX_CHANGES MAX_LINKS_BYTES MAX_RAMPS SiteArrays",
            "step.site_setup": (
                "ChainSetup Gains Law LinkSetup MotionLimits RestGains SiteSetup StaleRule "
                "TaskSetup"
            ),
            "step.site_step": "Site",
            "step.ticks": (
                "BUCKETS_PER_S CoreChange DominanceRamp LifeAlarm MAX_ARRIVALS PlantState "
                "RELEASE_REASONS TickInput describe_mode first_tick_at tick_ns"
            ),
            "step.vectors": "Array IntArray Pair Points Vector",
        },
    )
