"""Read the output of `ping` as probes: iputils, BSD and macOS, busybox, fping and Windows.

    64 bytes from 192.0.2.5: icmp_seq=6 ttl=64 time=5.00 ms           iputils, BSD, macOS
    64 bytes from 192.0.2.5: seq=0 ttl=64 time=3.000 ms               busybox
    Antwort von 192.0.2.7: Bytes=32 Zeit=21ms TTL=53                  Windows
    192.0.2.5 : [0], 64 bytes, 5.00 ms (5.00 avg, 0% loss)            fping

Invariant:
    - A probe without an answer counts as lost, also before the first answer and after the last
      one. Sequence numbers, lines about a missing answer and the number of packets in the
      summary tell which probes were sent.
    - Numbers are read and words are not, so that the language of the program does not matter. A
      decimal comma is a decimal point.
    - Output that contradicts its own summary is refused. If the output does not tell how the
      run began or ended, `PingProbes` says so.
"""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array
from ..errors import count_nouns

_SEQUENCE_NUMBERS = 2**16
"""Number of probes after which `ping` counts from 0 again."""
_MAX_PROBES = 2**24
"""Largest number of probes that a summary may count: 194 days at one probe per second."""

_NUMBER = re.compile(r"(?:\bicmp_(?:seq|req)|\bseq)[= ]\s*(\d+)\b")
_ROUND_TRIP = re.compile(r"[=<]\s?(\d+(?:[.,]\d+)?)\s?ms?\b")
"""Spanish Windows prints "tiempo<1m"; French Windows prints "temps=21 ms"."""
_STAMP = re.compile(r"\[(\d+[.,]\d+)\]")
_HEADER = re.compile(r"ping6?\b.*\d", re.IGNORECASE)
_COUNTS_FROM_0 = re.compile(r": \d+ \w+ \w+|=\d+\+\d+")
"""Headers of busybox, BSD and macOS, which count from 0.

Examples: "PING host (192.0.2.5): 56 data bytes", "PING6(56=40+8+8 bytes) ...".
"""
_SUMMARY = re.compile(r"\s*(\d+) [^\d,]+, (\d+)\b.*%")
"""An example is "40 packets transmitted, 25 received, 37.5% packet loss, time 39000ms"."""

_FPING = re.compile(
    r"(?:\[(\d+[.,]\d+)\] )?(\S+)\s+: \[(\d+)\], (?:\d+ bytes, (\d+(?:[.,]\d+)?) ms)?"
)
_FPING_SUMMARY = re.compile(r"\S+\s+: \S+ = (\d+)/(\d+)/\d+%")

_WINDOWS_REPLY = re.compile(
    r"[=<]\s?\d+\s?ms?\b.*\bTTL=\d+|^\D*[\w.:%]+: \w+[=<]\d+\s?ms?\s*$", re.IGNORECASE
)
"""IPv6 answers have no TTL: "Reply from 2001:db8::1: time=21ms"."""
_WINDOWS_COUNTS = re.compile(r"[^=]*=\s*(\d+),[^=\d]+=\s*(\d+),[^=\d]+=\s*(\d+)\s*(?:[(,]|$)")
"""An example is "Packets: Sent = 30, Received = 29, Lost = 1 (3% loss)"."""
_WINDOWS_BREAK = re.compile(r"\^C|\S+[-+]C")

_SEVERAL_RUNS = "it has several runs of ping: import each by itself"


class PingProbes(NamedTuple):
    """The probes of one run, in the order of sending.

    Attributes:
        sent_s: times of sending, s, on any clock.
        rtt_ms: round-trip times, ms; infinite if no answer came.
        begin_known: False if probes may have been sent before the first one here.
        end_known: False if probes may have been sent after the last one here.
    """

    sent_s: Sequence[float]
    rtt_ms: Sequence[float]
    begin_known: bool
    end_known: bool


class _Answer(NamedTuple):
    """An answer to a probe.

    Attributes:
        rtt_ms: the round-trip time, ms.
        printed_s: the time at which the line was printed, s; None: the line has no time.
    """

    rtt_ms: float
    printed_s: float | None


class _Summary(NamedTuple):
    """The counts in a summary: packets sent, and answers received."""

    sent: int
    received: int


def read_ping(text: str, every_s: float) -> PingProbes:
    """Returns the probes in the output of one run of `ping` or `fping`.

    Args:
        text: the output.
        every_s: the interval between probes, s, if the lines bear no times.

    Raises:
        ValueError: the output is not of ping, has several runs, or contradicts its summary.
    """
    lines = [line.rstrip() for line in text.splitlines()]
    if any(_NUMBER.search(line) for line in lines):
        return _read_numbered(lines, every_s)
    if any(_FPING.match(line) for line in lines):
        return _read_fping(lines, every_s)
    if any(_WINDOWS_REPLY.search(line) or _WINDOWS_COUNTS.match(line) for line in lines):
        return _read_windows(lines, every_s)
    for line in lines:
        summary = _parse_summary(_SUMMARY, line)
        if summary is not None:
            # Nothing was answered: the summary alone tells how many probes were sent.
            return _arrange_probes(
                answers={}, mentioned=set(), first=1, summary=summary, every_s=every_s
            )
    raise ValueError("no line tells of an answer, as in 'icmp_seq=1 ttl=63 time=60.6 ms'")


def _parse_summary(pattern: re.Pattern[str], line: str) -> _Summary | None:
    match = pattern.match(line)
    return None if match is None else _Summary(int(match[1]), int(match[2]))


def _read_numbered(lines: Sequence[str], every_s: float) -> PingProbes:
    """Returns the probes in lines with a sequence number each.

    A line of an answer has a round-trip time as well.
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
        # iputils counts from 1. A number 0 shows that this program does not.
        first = 1
    return _arrange_probes(
        answers=answers, mentioned=mentioned, first=first, summary=summary, every_s=every_s
    )


def _unwrap_number(previous: int, number: int) -> int:
    """Returns a sequence number as if `ping` never counted from 0 again.

    Args:
        previous: the unwrapped number of the previous line; -1: there is no such line.
        number: the printed number.
    """
    if previous < 0:
        return number
    half = _SEQUENCE_NUMBERS // 2
    return previous + (number - previous + half) % _SEQUENCE_NUMBERS - half


def _parse_decimal(text: str) -> float:
    return float(text.replace(",", "."))


def _read_fping(lines: Sequence[str], every_s: float) -> PingProbes:
    """Returns the probes in the output of `fping`, which counts from 0 and never wraps."""
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
            f"it has {len(hosts)} hosts, {', '.join(sorted(hosts)[:3])}: keep the lines of one"
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
) -> PingProbes:
    """Returns the probes of a run in the order of their numbers.

    Args:
        answers: the answers by number.
        mentioned: all numbers in the output, also of lines without an answer.
        first: the number of the first probe by the header or the summary; None: the output does
            not tell.
        summary: the counts in the summary; None: there is no summary.
        every_s: the interval between probes without times, s.
    """
    lowest = min(mentioned, default=first or 0)
    highest = max(mentioned, default=(first or 0) - 1)
    begin = lowest if first is None else min(first, lowest)
    end = highest + 1
    if summary is not None:
        end = begin + summary.sent
        if highest >= end:
            raise ValueError(
                f"its summary counts {summary.sent} packets, but its lines reach number "
                f"{highest}"
            )
        if summary.received > len(answers):
            raise ValueError(
                f"its summary counts {count_nouns(summary.received, 'answer')}, but its lines "
                f"have {len(answers)}: it was printed with -q, or lines are missing"
            )
    if end - begin > _MAX_PROBES:
        raise ValueError(
            f"its summary counts {end - begin} packets, at most {_MAX_PROBES} are read"
        )
    numbers = np.arange(begin, end)
    rtt_ms = [answers[n].rtt_ms if n in answers else math.inf for n in numbers.tolist()]
    return PingProbes(
        sent_s=_find_sending_times(numbers, answers, every_s).tolist(),
        rtt_ms=rtt_ms,
        begin_known=first is not None or lowest <= 1,
        end_known=summary is not None,
    )


def _find_sending_times(
    numbers: NDArray[np.int64], answers: dict[int, _Answer], every_s: float
) -> Array:
    """Returns when probes were sent, s, from the times that the lines of all answers bear.

    `ping` prints no time of sending, so a probe with an answer was sent a round trip before its
    line was printed. Between two answers the times are interpolated; before the first answer
    and after the last one they continue at the mean interval. If a line bears no time, the
    interval is `every_s`.
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
    if not mean_s > 0.0:
        mean_s = every_s
    before = np.minimum(numbers - timed_numbers[0], 0.0)
    after = np.maximum(numbers - timed_numbers[-1], 0.0)
    return np.asarray(np.interp(numbers, timed_numbers, sent_s) + mean_s * (before + after))


def _read_windows(lines: Sequence[str], every_s: float) -> PingProbes:
    """Returns the probes in the output of Windows.

    It has a header, a line per probe without a sequence number, and then the counts.
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
            continue
        elif line.endswith(":"):
            # This line begins the header, or else the counts.
            is_over = has_header and bool(rtt_ms)
            has_header = True
        elif (has_header or rtt_ms) and not _WINDOWS_BREAK.fullmatch(line.strip()):
            if not line.endswith((".", "。")):
                raise ValueError(
                    f"line {n} is neither an answer nor the sentence of one that is missing"
                )
            rtt_ms.append(math.inf)
    if sent is not None and sent != len(rtt_ms):
        raise ValueError(
            f"its summary counts {sent} packets, but it has lines of {len(rtt_ms)}"
        )
    return PingProbes(
        sent_s=[n * every_s for n in range(len(rtt_ms))],
        rtt_ms=rtt_ms,
        begin_known=has_header or sent is not None,
        end_known=sent is not None,
    )
