"""Runs live sessions, in which several robot arms are coupled over a network.

Each arm is controlled by its own process, the site. A site joins the session together with the
other sites, runs the control loop of its arm at a fixed rate, exchanges the state of the arm
with the other sites in every tick, and leaves at the end. The package also contains programs
that start a session, move an arm, or measure the network.
"""

from typing import TYPE_CHECKING

from trilat_net.hooks import import_on_use

__all__ = [
    "SiteOptions",
    "rehearse_loop",
    "run_hand",
    "run_site",
    "warm_up",
]

if TYPE_CHECKING:
    from .hand_process import run_hand
    from .loop_rehearsal import rehearse_loop
    from .site_parts import SiteOptions, warm_up
    from .site_process import run_site
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "hand_process": "run_hand",
            "loop_rehearsal": "rehearse_loop",
            "site_parts": "SiteOptions warm_up",
            "site_process": "run_site",
        },
    )
