"""Progress display for commands that execute many runs.

A sweep or a tuning may take hours. In a terminal, `show_progress` displays a progress bar. When
the output goes to a file or a pipe, it prints at most ten lines with the remaining time
instead, and up to ten more if the total number of items grows, as in a sweep that is refined.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ...errors import format_wall_time
from ...net import SystemClock
from ...presentation import terminal_output as terminal

_PROGRESS_LINES = 10
"""Number of lines that show progress if the output is not a terminal."""


@contextmanager
def show_progress(
    label: str, print_line: Callable[[str], None], items: str = "runs"
) -> Iterator[Callable[[int, int], None]]:
    """Shows the progress of a long computation as a bar in a terminal.

    If the output is not a terminal (a log file, for example), a few lines are printed instead.

    Args:
        label: Label of the bar.
        print_line: Function that prints a line.
        items: What is being counted, as a plural noun.

    Yields:
        A function to call with the number of finished items and the total number of items.
    """
    if terminal.err.is_interactive:
        with terminal.progress_bar(label) as show:
            yield show
        return

    clock = SystemClock()
    first_call_ns = -1  # time of the first call of `show_line`, -1 before it
    done_at_first_call = 0
    printed_tenths = 0  # tenths of the items that were finished at the last printed line
    last_total = 0

    def show_line(done: int, total: int) -> None:
        """Prints a line with the remaining time, about once per tenth of the items.

        The remaining time is estimated from the mean duration per item since the first call.
        The first call prints no line because this duration is not known yet, and no line is
        printed after the last item.

        Args:
            done: Number of finished items.
            total: Total number of items.
        """
        nonlocal first_call_ns, done_at_first_call, printed_tenths, last_total
        if first_call_ns < 0:
            # The time before the first item is the start of the processes, which does not
            # count towards the duration of an item.
            first_call_ns = clock.monotonic_ns()
            done_at_first_call = done
        finished_tenths = done * _PROGRESS_LINES // total
        if total != last_total:
            last_total = total
            printed_tenths = finished_tenths
        has_no_remaining_time = done in (total, done_at_first_call)
        if has_no_remaining_time or finished_tenths <= printed_tenths:
            return

        printed_tenths = finished_tenths
        elapsed_s = (clock.monotonic_ns() - first_call_ns) * 1e-9
        remaining_s = elapsed_s / (done - done_at_first_call) * (total - done)
        print_line(f"  {done} of {total} {items}, about {format_wall_time(remaining_s)} left")

    yield show_line
