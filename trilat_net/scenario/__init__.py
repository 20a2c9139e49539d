"""Describes experiments as scenarios: reads them from files, completes them and checks them.

A scenario describes one experiment: the robot arms, the control law of each arm, the network
links between the arms with their delays, and the people or programs that move the arms. Its
author writes it as a TOML file. The program converts it to typed objects that cannot be changed
afterwards.

Invariant:
    - A scenario that loads also runs. Every mistake that a person can make is refused when the
      scenario is loaded, with the path of the key and the nearest valid name.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # Reading a scenario
    "ExperimentText",
    "SimulatedArm",
    "TracePoint",
    "check_outside_arms",
    "embedded_names_reader",
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
    "reseed_scenario",
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
    "SiteSpec",
    "check_finite",
    "is_distribution",
    "is_number",
    # Links and delays
    "ConstantDelay",
    "LinkBase",
    "PictureDelay",
    "draw_used_samples",
    # Operators and environments
    "FAILED_HAND",
    "POLICY",
    "DeviceSettings",
    "HandPlayer",
    "HandSite",
    "JointSpring",
    "LiveHand",
    "Multisine",
    "OwnPlant",
    "PlantContext",
    "PlantPlayer",
    "ViscousEnvironment",
    "Wall",
    "make_hand_players",
    "make_plant_players",
    # Changes during a run
    "LinkTables",
    "find_requester",
    "parse_core_change",
    "resolve_change",
    # Expectations
    "ALL_SITES_QUANTITIES",
    "END_WINDOW_S",
    "Expect",
    # Descriptions
    "IRREVERSIBLE_SHARES",
    "ScenarioDifference",
    "compare_scenarios",
    "describe_event",
    "describe_law",
    "describe_law_conditions",
    "describe_scenario",
    "describe_value",
    "flatten_table",
    "list_arm_notes",
    "list_law_situations",
]

if TYPE_CHECKING:
    from .arms import TASK_AXES, ArmModel
    from .change import Change, describe_event, find_requester
    from .delay_models import LinkBase
    from .delay_models.kernel_delays import ConstantDelay
    from .delay_traces import TracePoint, import_trace
    from .describe import (
        IRREVERSIBLE_SHARES,
        ScenarioDifference,
        compare_scenarios,
        describe_law,
        describe_law_conditions,
        describe_scenario,
        describe_value,
        flatten_table,
        list_arm_notes,
        list_law_situations,
    )
    from .expect import ALL_SITES_QUANTITIES, END_WINDOW_S, Expect
    from .key_checks import check_finite, is_distribution, is_number
    from .laws import BUILT_IN, LAWS
    from .link_presets import GRID_LOSSES_PERCENT, GRID_ROUND_TRIPS_MS
    from .operators.kernel_operators import (
        DeviceSettings,
        JointSpring,
        LiveHand,
        Multisine,
        ViscousEnvironment,
        Wall,
    )
    from .operators.program_hand import (
        FAILED_HAND,
        POLICY,
        HandPlayer,
        HandSite,
        make_hand_players,
    )
    from .override import split_assignment
    from .own_plant import OwnPlant
    from .plant_player import PlantContext, PlantPlayer, make_plant_players
    from .run_changes import LinkTables, parse_core_change, resolve_change
    from .sample_uses import PictureDelay, draw_used_samples
    from .scenario_reader import (
        ExperimentText,
        embedded_names_reader,
        list_shipped,
        load_scenario,
        parse_embedded,
        parse_scenario,
        read_template,
        reseed_scenario,
    )
    from .scenario_types import Scenario
    from .simulated_arm import SimulatedArm
    from .site_spec import SiteSpec
    from .skeletons import name_skeleton_class, new_hand, new_law, new_plant
    from .validate import check_outside_arms
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "arms": "ArmModel TASK_AXES",
            "change": "Change describe_event find_requester",
            "delay_models": "LinkBase",
            "delay_models.kernel_delays": "ConstantDelay",
            "delay_traces": "TracePoint import_trace",
            "describe": (
                "IRREVERSIBLE_SHARES ScenarioDifference compare_scenarios describe_law "
                "describe_law_conditions describe_scenario describe_value flatten_table "
                "list_arm_notes list_law_situations"
            ),
            "expect": "ALL_SITES_QUANTITIES END_WINDOW_S Expect",
            "key_checks": "check_finite is_distribution is_number",
            "laws": "BUILT_IN LAWS",
            "link_presets": "GRID_LOSSES_PERCENT GRID_ROUND_TRIPS_MS",
            "operators.kernel_operators": (
                "DeviceSettings JointSpring LiveHand Multisine ViscousEnvironment Wall"
            ),
            "operators.program_hand": (
                "FAILED_HAND HandPlayer HandSite POLICY make_hand_players"
            ),
            "override": "split_assignment",
            "own_plant": "OwnPlant",
            "plant_player": "PlantContext PlantPlayer make_plant_players",
            "run_changes": "LinkTables parse_core_change resolve_change",
            "sample_uses": "PictureDelay draw_used_samples",
            "scenario_reader": (
                "ExperimentText embedded_names_reader list_shipped load_scenario "
                "parse_embedded parse_scenario read_template reseed_scenario"
            ),
            "scenario_types": "Scenario",
            "simulated_arm": "SimulatedArm",
            "site_spec": "SiteSpec",
            "skeletons": "name_skeleton_class new_hand new_law new_plant",
            "validate": "check_outside_arms",
        },
    )
