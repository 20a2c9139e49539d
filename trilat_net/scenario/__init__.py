"""Reads scenario files, fills in the default values and validates the result.

A scenario is a TOML file that describes one experiment: the robot arms, the control law of each
arm, the network links between them with their delays, and the people or programs that move the
arms. It is converted to typed, immutable objects.

Invariant:
    - A scenario that loads also runs. Every mistake in a scenario is reported when the scenario
      is loaded, with the path of the key and the nearest valid name.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # Reading a scenario
    "ExperimentText",
    "SimulatedArm",
    "TracePoint",
    "import_trace",
    "list_shipped",
    "load_scenario",
    "name_skeleton_class",
    "new_hand",
    "new_law",
    "new_plant",
    "parse_embedded",
    "parse_scenario",
    "read_template",
    "split_assignment",
    # The parts of a scenario
    "BUILT_IN",
    "GRID_LOSSES_PERCENT",
    "GRID_ROUND_TRIPS_MS",
    "LAWS",
    "TASK_AXES",
    "ArmModel",
    "Change",
    "Scenario",
    "check_finite",
    "is_distribution",
    "is_number",
    # Links and delays
    "LinkBase",
    "PictureDelay",
    # Operators and environments
    "FAILED_HAND",
    "HAND_MODES",
    "POLICY",
    "HandPlayer",
    "HandSite",
    "LiveHand",
    "OwnPlant",
    "PlantContext",
    "PlantPlayer",
    # Changes during a run
    "LinkTables",
    "resolve_change",
    # Expectations
    "ALL_SITES_QUANTITIES",
    "END_WINDOW_S",
    "Expect",
    # Descriptions
    "IRREVERSIBLE_SHARES",
    "ScenarioDifference",
    "describe_law",
    "describe_scenario",
    "describe_value",
    "flatten_table",
]

if TYPE_CHECKING:
    from .arms import TASK_AXES, ArmModel
    from .change import Change
    from .delay_models import LinkBase
    from .delay_traces import TracePoint, import_trace
    from .describe import (
        IRREVERSIBLE_SHARES,
        ScenarioDifference,
        describe_law,
        describe_scenario,
        flatten_table,
    )
    from .expect import ALL_SITES_QUANTITIES, END_WINDOW_S, Expect
    from .key_checks import check_finite, is_distribution, is_number
    from .laws import BUILT_IN, LAWS
    from .link_presets import GRID_LOSSES_PERCENT, GRID_ROUND_TRIPS_MS
    from .operators.kernel_operators import HAND_MODES, LiveHand
    from .operators.program_hand import FAILED_HAND, POLICY, HandPlayer, HandSite
    from .override import split_assignment
    from .own_plant import OwnPlant
    from .picture_delay import PictureDelay
    from .plant_player import PlantContext, PlantPlayer
    from .run_changes import LinkTables, resolve_change
    from .scenario_reader import (
        ExperimentText,
        list_shipped,
        load_scenario,
        parse_embedded,
        parse_scenario,
        read_template,
    )
    from .scenario_types import Scenario
    from .simulated_arm import SimulatedArm
    from .skeletons import name_skeleton_class, new_hand, new_law, new_plant
    from .value_text import describe_value
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "arms": "ArmModel TASK_AXES",
            "change": "Change",
            "delay_models": "LinkBase",
            "delay_traces": "TracePoint import_trace",
            "describe": (
                "IRREVERSIBLE_SHARES ScenarioDifference describe_law describe_scenario "
                "flatten_table"
            ),
            "expect": "ALL_SITES_QUANTITIES END_WINDOW_S Expect",
            "key_checks": "check_finite is_distribution is_number",
            "laws": "BUILT_IN LAWS",
            "link_presets": "GRID_LOSSES_PERCENT GRID_ROUND_TRIPS_MS",
            "operators.kernel_operators": "HAND_MODES LiveHand",
            "operators.program_hand": "FAILED_HAND HandPlayer HandSite POLICY",
            "override": "split_assignment",
            "own_plant": "OwnPlant",
            "picture_delay": "PictureDelay",
            "plant_player": "PlantContext PlantPlayer",
            "run_changes": "LinkTables resolve_change",
            "scenario_reader": (
                "ExperimentText list_shipped load_scenario parse_embedded parse_scenario "
                "read_template"
            ),
            "scenario_types": "Scenario",
            "simulated_arm": "SimulatedArm",
            "skeletons": "name_skeleton_class new_hand new_law new_plant",
            "value_text": "describe_value",
        },
    )
