"""Arms of six joints with everything that a chain supports: friction, stops, an operator, a
wall in space, limits.
"""

from functools import cache
from importlib import resources

import trilat_net
from tests.scenario.builders import six_joint_text
from trilat_net.log.log_reader import Log
from trilat_net.scenario import parse_scenario

ROUGH = f"""{six_joint_text(4.0, 50.0, "rough.urdf")}
[[sites.m1.hands]]
kind = "tip_spring"
to_m = [-0.4, -0.2, 0.1]
move_start_s = 0.5
move_end_s = 2.0
stiffness_n_m = 100.0
damping_n_s_m = 20.0
end_s = 3.0
[[sites.m2.hands]]
kind = "pulse"
start_s = 0.1
end_s = 0.9
peak_nm = [0.0, 0.0, 60.0, 0.0, 1.0, 0.0]
[sites.s.limits]
tau_limit_nm = [150.0, 30.0, 150.0, 28.0, 28.0, 28.0]
[[sites.s.environment]]
kind = "wall"
point_m = [0.0, 0.0, 0.27]
normal = [0.1, 0.0, 1.0]
stiffness_n_m = 500.0
[[sites.s.environment]]
kind = "viscous"
damping_nm_s_rad = 0.5
sampled = true
[urdf]
"rough.urdf" = '''
"""
DYNAMICS = '<dynamics damping="0.8" friction="1.5"/>'


def rough_urdf() -> str:
    """Returns `arm6.urdf` with friction at every joint, and an elbow that stops at 1.55 rad."""
    text = (resources.files(trilat_net) / "scenarios" / "arm6.urdf").read_text(encoding="utf-8")
    rubbed = text.replace("<limit ", f"{DYNAMICS}<limit ")
    elbow = rubbed.index('<joint name="elbow"')
    stopped = rubbed[elbow:].replace('upper="6.283185307179586"', 'upper="1.55"', 1)
    return rubbed[:elbow] + stopped


@cache
def rough_log() -> Log:
    """Returns the log of the rough arm in virtual time."""
    return trilat_net.simulate(parse_scenario(f"{ROUGH}{rough_urdf()}'''\n"))
