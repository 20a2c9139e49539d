"""`trilat metrics`: the metrics of a run, by group, with statics and rendered impedance."""

from ..reporting import terminal_output as terminal
from . import options


def metrics_command(file: options.LogsArgument, as_json: options.JsonOption = False) -> None:
    """Measures a run: tracking, effort, energies, force sharing, impedance, walls, learning, network.

    Sites, links and walls are columns. A dash is a missing number; if the run could have one, the reason is
    given below the table. docs/metrics.md has every formula.
    """
    from ..analysis.metrics.log_metrics import compute_log_metrics

    log = terminal.open_with_progress(*file)
    terminal.print_result(compute_log_metrics(log), as_json=as_json)
