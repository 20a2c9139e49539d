"""Import paths that documentation of earlier versions named; they work for one release, with a warning.

Invariant: no code of this program uses them.
"""

import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

RENAMED = {
    "core.own": {
        "Facts": "core.user_law.LawContext",
        "Now": "core.user_law.LawInput",
        "OwnLaw": "core.user_law.UserLaw",
    },
    "linear": {
        "Analysis": "theory.LinearAnalysis",
        "Delayed": "theory.DelayedTerm",
        "Edge": "theory.LinearEdge",
        "Loop": "theory.LinearLoop",
        "Rest": "theory.Equilibrium",
        "analyse": "theory.analyse_linear_loop",
        "edge": "theory.find_linear_edge",
        "edges": "theory.iterate_linear_edges",
        "linearised": "theory.linearise_scenario",
        "rest_of": "theory.find_equilibrium",
    },
    "linear.rest": {"rest_of": "theory.find_equilibrium"},
    "ports": {},
    "ports.figure": {
        "impedance_figure": "reporting.figures.haptic_ports.draw_port_impedance",
        "passivity_figure": "reporting.figures.haptic_ports.draw_port_passivity",
    },
    "ports.section": {"port_section": "theory.port_analysis.analyse_ports"},
    "ports.words": {"port_lines": "reporting.port_text.describe_ports"},
    "scenario": {"load": "scenario.load_scenario"},
    "sweep": {
        "Plan": "studies.sweep.SweepPlan",
        "Results": "studies.sweep.SweepResults",
        "Swept": "studies.sweep.FinishedSweep",
        "new_folder": "studies.sweep.prepare_sweep_folder",
        "old_folder": "studies.sweep.open_sweep_folder",
        "plan": "studies.sweep.plan_sweep",
        "read_results": "studies.sweep.read_results",
        "run": "studies.sweep.run_sweep",
    },
    "tuning": {
        "Plan": "studies.tuning.TuningPlan",
        "Tuned": "studies.tuning.TuningResult",
        "plan": "studies.tuning.plan_tuning",
    },
}
"""The names of each old module, and where each is now."""


def lookup_of(module: str) -> Callable[[str], Any]:
    """Returns a module's `__getattr__` that finds its old names where they are now, with a warning."""

    def look_up(name: str) -> Any:
        new = RENAMED[module].get(name)
        if new is None:
            raise AttributeError(f"module '{__package__}.{module}' has no attribute {name!r}")
        warnings.warn(
            f"{__package__}.{module}.{name} is now {__package__}.{new}; the next release drops the old path",
            FutureWarning,
            stacklevel=2,
        )
        place, _, new_name = new.rpartition(".")
        return getattr(import_module(f"{__package__}.{place}"), new_name)

    return look_up


class _Finder(MetaPathFinder, Loader):
    """Finds the old modules, which hold nothing but the look-up of their names."""

    def find_spec(self, fullname: str, *_others: object) -> ModuleSpec | None:
        """Returns a specification for an old path, None for any other."""
        package, _, module = fullname.partition(".")
        if package != __package__ or module not in RENAMED:
            return None
        return ModuleSpec(fullname, self, is_package=True)

    def exec_module(self, module: ModuleType) -> None:
        """Gives an old module its look-up."""
        module.__dict__["__getattr__"] = lookup_of(module.__name__.partition(".")[2])


def install() -> None:
    """Lets Python find the old paths."""
    sys.meta_path.append(_Finder())
