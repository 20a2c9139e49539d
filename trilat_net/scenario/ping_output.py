"""Parses the output of `ping`: when each probe was sent and how long its round trip took.

A probe is one packet that `ping` sends. The formats of iputils, BSD, macOS, busybox, fping and
Windows are supported:

    64 bytes from 192.0.2.5: icmp_seq=6 ttl=64 time=5.00 ms           iputils, BSD, macOS
    64 bytes from 192.0.2.5: seq=0 ttl=64 time=3.000 ms               busybox
    Antwort von 192.0.2.7: Bytes=32 Zeit=21ms TTL=53                  Windows
    192.0.2.5 : [0], 64 bytes, 5.00 ms (5.00 avg, 0% loss)            fping

Invariant:
    - A probe with no reply counts as lost, even before the first reply or after the last. The
      list of probes sent is derived from the sequence numbers, from lines about missing
      replies, and from the packet count in the final summary.
    - Only numbers and units are read, so the language of the program does not matter. A decimal
      comma is read as a decimal point.
    - Output that contradicts its own summary is rejected. If the output does not show how the
      measurement began or ended, this is recorded in the result.
"""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import Array
from ..errors import count_nouns

_SEQUENCE_NUMBERS = 2**16
"""Number of probes after which `ping` restarts its sequence numbers at 0."""
_MAX_PROBES = 2**24
"""Maximum number of probes in a summary: 194 days at one probe per second."""

_NUMBER = re.compile(r"(?:\bicmp_(?:seq|req)|\bseq)[= ]\s*(\d+)\b")
"""Matches the sequence number of a probe."""
_ROUND_TRIP = re.compile(r"[=<]\s?(\d+(?:[.,]\d+)?)\s?ms?\b")
"""Matches the round-trip time. Spanish Windows prints "tiempo<1m", French "temps=21 ms"."""
_STAMP = re.compile(r"\[(\d+[.,]\d+)\]")
"""Matches the time at which a line was printed, as added by the option -D."""
_HEADER = re.compile(r"ping6?\b.*\d", re.IGNORECASE)
"""Matches the first line of a run."""
_COUNTS_FROM_0 = re.compile(r": \d+ \w+ \w+|=\d+\+\d+")
"""Matches the headers of busybox, BSD and macOS, whose sequence numbers start at 0.

Examples: "PING host (192.0.2.5): 56 data bytes", "PING6(56=40+8+8 bytes) ...".
"""
_SUMMARY = re.compile(r"\s*(\d+) [^\d,]+, (\d+)\b.*%")
"""Matches, for example, "40 packets transmitted, 25 received, 37.5% packet loss, time 39000ms".
"""

_FPING = re.compile(
    r"(?:\[(\d+[.,]\d+)\] )?(\S+)\s+: \[(\d+)\], (?:\d+ bytes, (\d+(?:[.,]\d+)?) ms)?"
)
"""Matches a line of `fping`: timestamp, host, sequence number and round trip."""
_FPING_SUMMARY = re.compile(r"\S+\s+: \S+ = (\d+)/(\d+)/\d+%")
"""Matches, for example, "192.0.2.5 : xmt/rcv/%loss = 3/3/0%"."""

_WINDOWS_REPLY = re.compile(
    r"[=<]\s?\d+\s?ms?\b.*\bTTL=\d+|^\D*[\w.:%]+: \w+[=<]\d+\s?ms?\s*$", re.IGNORECASE
)
"""Matches a reply. IPv6 replies have no TTL: "Reply from 2001:db8::1: time=21ms"."""
_WINDOWS_COUNTS = re.compile(r"[^=]*=\s*(\d+),[^=\d]+=\s*(\d+),[^=\d]+=\s*(\d+)\s*(?:[(,]|$)")
"""Matches, for example, "Packets: Sent = 30, Received = 29, Lost = 1 (3% loss)"."""
_WINDOWS_BREAK = re.compile(r"\^C|\S+[-+]C")
"""Matches the line printed after the user interrupts the program, such as "Control-C"."""

_SEVERAL_RUNS = "the output contains several runs of ping: import each run separately"


class _PingProbes(NamedTuple):
    """Round trips measured by one run of `ping`, in the order of sending.

    Attributes:
        sent_s: Time at which each probe was sent, in s. The zero of the clock is arbitrary.
        rtt_ms: Round-trip time of each probe, in ms; infinite if there was no reply.
        begin_known: False if earlier probes may be missing from the output.
        end_known: False if later probes may be missing from the output.
    """

    sent_s: Sequence[float]
    rtt_ms: Sequence[float]
    begin_known: bool
    end_known: bool


class _Answer(NamedTuple):
    """Reply to one probe, as received by `ping`.

    Attributes:
        rtt_ms: Round-trip time, in ms.
        printed_s: Time at which the reply was printed, in s, or None if the line has no
            timestamp.
    """

    rtt_ms: float
    printed_s: float | None


class _Summary(NamedTuple):
    """Counts in the summary printed by `ping`: packets sent and replies received."""

    sent: int
    received: int


def read_ping(text: str, every_s: float) -> _PingProbes:
    """Parses the output of a single run of `ping` or `fping`.

    The program that produced the output is detected automatically.

    Args:
        text: Output of the program.
        every_s: Interval between probes, in s. Used if the output contains no timestamps.

    Raises:
        ValueError: The text is not the output of `ping`, contains several runs, or contradicts
            its own summary.
    """
    lines = [line.rstrip() for line in text.splitlines()]
    if any(_NUMBER.search(line) for line in lines):
        return _read_numbered(lines, every_s)
    if any(_FPING.match(line) for line in lines):
        return _read_fping(lines, every_s)
    if any(_WINDOWS_REPLY.search(line) or _WINDOWS_COUNTS.match(line) for line in lines):
        return _read_windows(lines, every_s)

    # If no probe was answered, only the summary says how many probes were sent.
    for line in lines:
        summary = _parse_summary(_SUMMARY, line)
        if summary is not None:
            return _arrange_probes(
                answers={}, mentioned=set(), first=1, summary=summary, every_s=every_s
            )
    raise ValueError("no line reports a reply, such as 'icmp_seq=1 ttl=63 time=60.6 ms'")


def _parse_summary(pattern: re.Pattern[str], line: str) -> _Summary | None:
    """Parses the counts in a line of output, or returns None if it is not the summary line."""
    match = pattern.match(line)
    return None if match is None else _Summary(int(match[1]), int(match[2]))


def _read_numbered(lines: Sequence[str], every_s: float) -> _PingProbes:
    """Parses the output of programs that print the sequence number of each probe.

    A line with a sequence number and a round-trip time is a reply. A line with a sequence
    number alone reports a missing reply.

    Args:
        lines: Lines of the output.
        every_s: Interval between probes, in s, if the output has no timestamps.
    """
    answers: dict[int, _Answer] = {}
    mentioned: set[int] = set()
    summary: _Summary | None = None
    first: int | None = None
    number = -1
    for line in lines:
        number_match = _NUMBER.search(line)
        if number_match is None:
            line_summary = _parse_summary(_SUMMARY, line)
            if line_summary is not None:
                summary = line_summary
            elif _HEADER.match(line):
                if first is not None or mentioned:
                    raise ValueError(_SEVERAL_RUNS)
                first = 0 if _COUNTS_FROM_0.search(line) else 1
            continue

        number = _unwrap_number(number, int(number_match[1]))
        mentioned.add(number)
        rtt = _ROUND_TRIP.search(line)
        # A second answer to a probe is a duplicate.
        if rtt is not None and number not in answers:
            stamp = _STAMP.match(line)
            printed_s = None if stamp is None else _parse_decimal(stamp[1])
            answers[number] = _Answer(_parse_decimal(rtt[1]), printed_s)

    if first is None and summary is not None:
        # iputils counts from 1. If the number 0 occurs, `_arrange_probes` starts at 0 instead.
        first = 1
    return _arrange_probes(
        answers=answers, mentioned=mentioned, first=first, summary=summary, every_s=every_s
    )


def _unwrap_number(previous: int, number: int) -> int:
    """Returns the sequence number that `ping` would print if it never restarted at 0.

    This is the number closest to the previous one that agrees with the printed number modulo
    `_SEQUENCE_NUMBERS`.

    Args:
        previous: Unwrapped number of the previous line, or -1 for the first line.
        number: Printed number.
    """
    if previous < 0:
        return number
    half = _SEQUENCE_NUMBERS // 2
    return previous + (number - previous + half) % _SEQUENCE_NUMBERS - half


def _parse_decimal(text: str) -> float:
    """Converts a string to a number. The decimal separator may be a comma."""
    return float(text.replace(",", "."))


def _read_fping(lines: Sequence[str], every_s: float) -> _PingProbes:
    """Parses the output of `fping`, which numbers the probes from 0.

    Unlike those of `ping`, its numbers never restart at 0.

    Args:
        lines: Lines of the output.
        every_s: Interval between probes, in s, if the output has no timestamps.

    Raises:
        ValueError: The output contains probes to several hosts.
    """
    answers: dict[int, _Answer] = {}
    mentioned: set[int] = set()
    hosts: set[str] = set()
    summary: _Summary | None = None
    for line in lines:
        match = _FPING.match(line)
        if match is None:
            summary = _parse_summary(_FPING_SUMMARY, line) or summary
            continue

        stamp, host, number_text, rtt = match.groups()
        number = int(number_text)
        hosts.add(host)
        mentioned.add(number)
        if rtt is not None and number not in answers:
            printed_s = None if stamp is None else _parse_decimal(stamp)
            answers[number] = _Answer(_parse_decimal(rtt), printed_s)

    if len(hosts) > 1:
        raise ValueError(
            f"the output contains lines of {len(hosts)} hosts, "
            f"{', '.join(sorted(hosts)[:3])}: keep the lines of only one host"
        )
    return _arrange_probes(
        answers=answers, mentioned=mentioned, first=0, summary=summary, every_s=every_s
    )


def _arrange_probes(
    answers: dict[int, _Answer],
    mentioned: set[int],
    first: int | None,
    summary: _Summary | None,
    every_s: float,
) -> _PingProbes:
    """Returns all probes of a run of `ping` in the order of sending, including lost ones.

    Args:
        answers: Mapping from probe number to reply.
        mentioned: All probe numbers in the output, including those in lines about missing
            replies.
        first: Number of the first probe according to the header or summary, or None if the
            output does not show it.
        summary: Counts in the summary, or None if there is no summary.
        every_s: Interval between probes, in s, if the output has no timestamps.

    Raises:
        ValueError: The lines contradict the summary, or the summary counts too many packets.
    """
    # If there are no lines, the range of probes begins at the first number and is empty.
    assumed_first = first or 0
    lowest = min(mentioned, default=assumed_first)
    highest = max(mentioned, default=assumed_first - 1)
    begin = lowest if first is None else min(first, lowest)
    end = highest + 1

    if summary is not None:
        end = begin + summary.sent
        if highest >= end:
            raise ValueError(
                f"the summary counts {count_nouns(summary.sent, 'packet')}, but the lines "
                f"contain sequence numbers up to {highest}"
            )
        if summary.received > len(answers):
            raise ValueError(
                f"the summary counts {count_nouns(summary.received, 'answer')}, but the lines "
                f"contain {len(answers)}: ping was run with -q, or lines are missing"
            )
    if end - begin > _MAX_PROBES:
        raise ValueError(
            f"the output covers {end - begin} packets, but at most {_MAX_PROBES} can be read"
        )

    numbers = np.arange(begin, end)
    rtt_ms = [answers[n].rtt_ms if n in answers else math.inf for n in numbers.tolist()]
    return _PingProbes(
        sent_s=_find_sending_times(numbers, answers, every_s).tolist(),
        rtt_ms=rtt_ms,
        begin_known=first is not None or lowest <= 1,
        end_known=summary is not None,
    )


def _find_sending_times(
    numbers: NDArray[np.int64], answers: dict[int, _Answer], every_s: float
) -> Array:
    """Estimates when each probe was sent.

    `ping` prints the time of each reply, and the probe was sent one round trip earlier. The
    times of probes with no reply are interpolated between replies. Before the first reply and
    after the last, they are extrapolated using the mean interval.

    Args:
        numbers: Numbers of all probes.
        answers: Mapping from probe number to reply.
        every_s: Interval between probes, in s, used if a line has no timestamp.

    Returns:
        The times in s, in the order of `numbers`.
    """
    timed_answers = [
        (n, answer.printed_s - answer.rtt_ms * 1e-3)
        for n, answer in sorted(answers.items())
        if answer.printed_s is not None
    ]
    if not timed_answers or len(timed_answers) < len(answers):
        return np.asarray(numbers * every_s)

    timed_numbers, sent_s = np.array(timed_answers).T
    mean_s = every_s
    if len(timed_answers) > 1:
        mean_s = (sent_s[-1] - sent_s[0]) / (timed_numbers[-1] - timed_numbers[0])
    # The interval is not positive if the clock was set back, and may be NaN.
    if not mean_s > 0.0:
        mean_s = every_s

    # `np.interp` is constant beyond the ends. The extrapolation is added to this constant.
    before = np.minimum(numbers - timed_numbers[0], 0.0)
    after = np.maximum(numbers - timed_numbers[-1], 0.0)
    interpolated_s = np.interp(numbers, timed_numbers, sent_s)
    return np.asarray(interpolated_s + mean_s * (before + after))


def _read_windows(lines: Sequence[str], every_s: float) -> _PingProbes:
    """Parses the output of `ping` on Windows, which prints no sequence numbers.

    The output consists of a header that ends in a colon, one line per probe, and a summary
    whose first line also ends in a colon. A missing reply is reported as a sentence in the
    user's language, which is recognised by its full stop.

    Args:
        lines: Lines of the output.
        every_s: Interval between probes, in s.

    Raises:
        ValueError: There are several runs, a line cannot be read, or the lines contradict the
            summary.
    """
    rtt_ms: list[float] = []
    sent: int | None = None
    has_header = False
    is_over = False
    for n, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        counts = _WINDOWS_COUNTS.match(line)
        if _WINDOWS_REPLY.search(line):
            if is_over:
                raise ValueError(_SEVERAL_RUNS)
            rtt = _ROUND_TRIP.search(line)
            assert rtt is not None
            rtt_ms.append(_parse_decimal(rtt[1]))
        elif counts is not None:
            if sent is not None:
                raise ValueError(_SEVERAL_RUNS)
            sent = int(counts[1])
            is_over = True
        elif is_over:
            # further lines of the summary
            continue
        elif line.endswith(":"):
            # After the header and answers, this line begins the summary.
            is_over = has_header and bool(rtt_ms)
            has_header = True
        elif (has_header or rtt_ms) and not _WINDOWS_BREAK.fullmatch(line.strip()):
            # a sentence about a missing answer, which ends in a (Chinese or Japanese) full stop
            if not line.endswith((".", "。")):
                raise ValueError(f"line {n} reports neither an answer nor a missing answer")
            rtt_ms.append(math.inf)
    if sent is not None and sent != len(rtt_ms):
        raise ValueError(
            f"the summary counts {count_nouns(sent, 'packet')}, but there are lines for "
            f"{len(rtt_ms)}"
        )
    return _PingProbes(
        sent_s=[n * every_s for n in range(len(rtt_ms))],
        rtt_ms=rtt_ms,
        begin_known=has_header or sent is not None,
        end_known=sent is not None,
    )
