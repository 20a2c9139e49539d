"""Describes experiments as scenarios: reads them from files, completes them and checks them.

A scenario describes one experiment: the robot arms, the control law of each arm, the network
links between the arms with their delays, and the people or programs that move the arms. Its
author writes it as a TOML file. The program converts it to typed objects that cannot be changed
afterwards.

Invariant:
    - A scenario that loads also runs. Every mistake that a person can make is refused when the
      scenario is loaded, with the path of the key and the nearest valid name.
"""

from .expect import Expect as Expect
from .override import apply_overrides as apply_overrides
from .run_changes import find_owner as find_owner
from .run_changes import parse_core_change as parse_core_change
from .scenario_reader import embedded_names_reader as embedded_names_reader
from .scenario_reader import find_site as find_site
from .scenario_reader import list_shipped as list_shipped
from .scenario_reader import load_scenario as load_scenario
from .scenario_reader import parse_embedded as parse_embedded
from .scenario_reader import parse_scenario as parse_scenario
from .scenario_reader import read_template as read_template
from .scenario_types import Scenario as Scenario
from .scenario_types import SiteSpec as SiteSpec
