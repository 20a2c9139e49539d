"""Stability maps: one scenario over a plane of its keys, in virtual time, on all cores.

From Python:

    from pathlib import Path
    from trilat_net.sweep import new_folder, plan, run

    asked = plan("p_d_margin", over=["link.delay_ms=0:400:50", "control.d=0.2:3:0.2"])
    results = run(new_folder(asked, Path("runs/mine"))).results
    [row["verdict"] for row in results.of_cell(17)]

In a folder that has the same sweep in it `run` goes on where that was left; `read_results` reads one that is
done. Processes begin by importing the script that asks for them: its own work stands under
`if __name__ == "__main__":`, or `run` gets `jobs=1`.
"""

from .folder import new_folder, old_folder
from .plan import Plan, plan
from .running import Swept, run
from .table import Results, read_results

__all__ = ["Plan", "Results", "Swept", "new_folder", "old_folder", "plan", "read_results", "run"]
