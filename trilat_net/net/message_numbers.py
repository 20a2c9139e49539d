"""Numbers of a site's messages: each record has its tick's, and statistics are numbered by themselves."""

from . import topics

STATS_PER_SECOND = 10


def ticks_per_stats(rate_hz: int) -> int:
    """Returns the ticks from one statistics message to the next, from tick 0 on."""
    return max(1, rate_hz // STATS_PER_SECOND)


def number_message(channel: str, tick: int, rate_hz: int) -> int:
    """Returns the number in its channel of the record or the statistics of a tick."""
    return tick // ticks_per_stats(rate_hz) if channel == topics.LINK else tick


def count_messages(channel: str, ticks: int, rate_hz: int) -> int:
    """Returns how many records or statistics a site publishes in so many ticks."""
    return -(-ticks // ticks_per_stats(rate_hz)) if channel == topics.LINK else ticks


def count_under_way(channel: str, rate_hz: int) -> int:
    """Returns how many messages that a site has sent may die with it when it is killed: those of 20 ms."""
    return 1 if channel == topics.LINK else rate_hz // 50


def skipped_numbers(channel: str, tick: int, skipped: int, rate_hz: int) -> tuple[int, int]:
    """Returns what a site does not publish that makes no ticks for so many before one, see `begin_anew`.

    That is the number of the message with that tick, or that stands for it, and that of the first not made.
    """
    return number_message(channel, tick, rate_hz), count_messages(channel, tick - skipped, rate_hz)
