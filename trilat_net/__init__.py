"""trilat-net: dual-user (trilateral) teleoperation over a real network.

    import trilat_net

    log = trilat_net.simulate("paper", set={"control.Kd": 5})
    log["m1"].t_s, log["m1"].q
    log = trilat_net.open_log("run.mcap")

One `Site.step`, three drivers: live over a network, in virtual time, and again from the log, the same code
gives the same numbers bit for bit.
"""

from .experiment import open_log, simulate, verify

__all__ = ["open_log", "simulate", "verify"]
