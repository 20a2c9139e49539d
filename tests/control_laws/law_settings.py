"""A shipped scenario and suitable settings for each built-in law that is a plug-in."""

from typing import Any

LAWS: dict[str, tuple[str, dict[str, Any]]] = {
    "six_channel": ("paper", {"control.acceleration": 0.5, "control.force_own": 0.1}),
    "four_channel": ("two_sites", {"control.acceleration": 0.5}),
    "saturated_pd": ("paper", {}),
    "authority": ("paper", {"sites.s.control.leads": False}),
    "impedance": ("paper", {"sites.s.control.follows": True}),
    "sync": ("paper", {}),
    "smith": ("two_sites", {"sites.m.control.predicts": True}),
    "lee_spong": ("paper", {}),
    "adaptive_kinematics": ("paper", {}),
    "adaptive_robust": ("paper", {}),
}
