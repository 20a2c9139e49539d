"""A bar for what takes longer than a moment: on stderr, only on a terminal, gone when it is done.

Law: whoever works knows nothing of it; it calls a function with how much is done and how much there is.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from .options import err

PATIENCE_S = 1.0
"""How long nobody needs to be told that something goes on, s."""
_EVERY_S = 0.1


@contextmanager
def bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Yields a function to call with (done, total), as often as one likes; it draws when it is worth it.

    Args:
        label: what is going on, as in "reading run.mcap".
    """
    if not err.is_interactive:
        yield _nothing
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    display = Progress(*columns, console=err, transient=True, auto_refresh=False)
    task = display.add_task(label, total=None)
    began_s = display.get_time()
    drawn_s = began_s

    def show(done: int, total: int) -> None:
        nonlocal drawn_s
        now_s = display.get_time()
        if now_s - began_s < PATIENCE_S or now_s - drawn_s < _EVERY_S:
            return
        drawn_s = now_s
        display.start()
        display.update(task, completed=done, total=total, refresh=True)

    try:
        yield show
    finally:
        display.stop()


def _nothing(done: int, total: int) -> None:
    """Draws nothing, where nobody looks."""
