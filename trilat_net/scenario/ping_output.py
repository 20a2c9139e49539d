"""What `ping` printed, as probes: iputils, BSD and macOS, busybox, fping and Windows, in any
language.

Invariant:
- A probe without an answer counts as lost, also before the first answer and after the last one:
  sequence numbers, lines about a missing answer and the number of packets in the summary tell
  what was sent.
- Numbers are read and words are not, so that the language of the program does not matter. A
  decimal comma is a decimal point.
- Output that contradicts its own summary is refused. Where the output does not tell how the run
  began or ended, `PingProbes` says so.

    64 bytes from 192.0.2.5: icmp_seq=6 ttl=64 time=5.00 ms           iputils, BSD, macOS
    64 bytes from 192.0.2.5: seq=0 ttl=64 time=3.000 ms               busybox
    Antwort von 192.0.2.7: Bytes=32 Zeit=21ms TTL=53                  Windows
    192.0.2.5 : [0], 64 bytes, 5.00 ms (5.00 avg, 0% loss)            fping
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
"""After so many probes `ping` counts from 0 again."""
_MOST_PROBES = 2**24
"""More probes than this are a summary that nobody's ping has printed."""

_NUMBER = re.compile(r"(?:\bicmp_(?:seq|req)|\bseq)[= ]\s*(\d+)\b")
_ROUND_TRIP = re.compile(r"[=<]\s?(\d+(?:[.,]\d+)?)\s?ms?\b")
"""Spanish Windows prints "tiempo<1m"; French Windows prints "temps=21 ms"."""
_STAMP = re.compile(r"\[(\d+[.,]\d+)\]")
_HEADER = re.compile(r"ping6?\b.*\d", re.IGNORECASE)
_COUNTS_FROM_0 = re.compile(r": \d+ \w+ \w+|=\d+\+\d+")
"""Headers of busybox, BSD and macOS: "PING host (192.0.2.5): 56 data bytes", "PING6(56=40+8+8
bytes) ...".
"""
_SUMMARY = re.compile(r"\s*(\d+) [^\d,]+, (\d+)\b.*%")
"""As in "40 packets transmitted, 25 received, 37.5% packet loss, time 39000ms"."""

_FPING = re.compile(
    r"(?:\[(\d+[.,]\d+)\] )?(\S+)\s+: \[(\d+)\], (?:\d+ bytes, (\d+(?:[.,]\d+)?) ms)?"
)
_FPING_SUMMARY = re.compile(r"\S+\s+: \S+ = (\d+)/(\d+)/\d+%")

_WINDOWS_REPLY = re.compile(
    r"[=<]\s?\d+\s?ms?\b.*\bTTL=\d+|^\D*[\w.:%]+: \w+[=<]\d+\s?ms?\s*$", re.IGNORECASE
)
"""IPv6 answers have no TTL: "Reply from 2001:db8::1: time=21ms"."""
_WINDOWS_COUNTS = re.compile(r"[^=]*=\s*(\d+),[^=\d]+=\s*(\d+),[^=\d]+=\s*(\d+)\s*(?:[(,]|$)")
"""As in "Packets: Sent = 30, Received = 29, Lost = 1 (3% loss)"."""
_WINDOWS_BREAK = re.compile(r"\^C|\S+[-+]C")

_SEVERAL_RUNS = "it has several runs of ping: import each by itself"


class PingProbes(NamedTuple):
    """The probes of one run, in the order of sending.

    Attributes:
        sent_s: times of sending, s, on whatever clock.
        rtt_ms: round-trip times, ms; infinite where no answer came.
        begin_known: False if probes may have been sent before the first one here.
        end_known: False if probes may have been sent after the last one here.
    """

    sent_s: Sequence[float]
    rtt_ms: Sequence[float]
    begin_known: bool
    end_known: bool


class _Answer(NamedTuple):
    rtt_ms: float
    printed_s: float | None


def read_ping(text: str, every_s: float) -> PingProbes:
    """Returns the probes in the output of one run of `ping` or `fping`.

    Args:
        text: the output.
        every_s: the interval between probes, s, where the lines bear no times.

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
    if counts := next((found for line in lines if (found := _SUMMARY.match(line))), None):
        return _arrange_probes(
            answers={},
            mentioned=set(),
            first=1,
            counts=(int(counts[1]), int(counts[2])),
            every_s=every_s,
        )
    raise ValueError("no line tells of an answer, as in 'icmp_seq=1 ttl=63 time=60.6 ms'")


def _read_numbered(lines: Sequence[str], every_s: float) -> PingProbes:
    """Reads lines that have a sequence number, with a round-trip time if an answer came."""
    answers: dict[int, _Answer] = {}
    mentioned: set[int] = set()
    counts: tuple[int, int] | None = None
    first: int | None = None
    number = -1
    for line in lines:
        found = _NUMBER.search(line)
        if found is None:
            if summary := _SUMMARY.match(line):
                counts = int(summary[1]), int(summary[2])
            elif _HEADER.match(line):
                if first is not None or mentioned:
                    raise ValueError(_SEVERAL_RUNS)
                first = 0 if _COUNTS_FROM_0.search(line) else 1
            continue
        number = _unwrap_number(number, int(found[1]))
        mentioned.add(number)
        rtt = _ROUND_TRIP.search(line)
        if rtt is not None and number not in answers:  # a second answer is a duplicate
            stamp = _STAMP.match(line)
            printed_s = None if stamp is None else _read_decimal(stamp[1])
            answers[number] = _Answer(_read_decimal(rtt[1]), printed_s)
    if first is None and counts is not None:
        first = 1  # as iputils counts; a number 0 shows that this one does not
    return _arrange_probes(
        answers=answers, mentioned=mentioned, first=first, counts=counts, every_s=every_s
    )


def _unwrap_number(last: int, number: int) -> int:
    """Returns a sequence number as if ping never counted from 0 again; `last` is the one
    before, or -1.
    """
    if last < 0:
        return number
    half = _SEQUENCE_NUMBERS // 2
    return last + (number - last + half) % _SEQUENCE_NUMBERS - half


def _read_decimal(text: str) -> float:
    return float(text.replace(",", "."))


def _read_fping(lines: Sequence[str], every_s: float) -> PingProbes:
    answers: dict[int, _Answer] = {}
    mentioned: set[int] = set()
    hosts: set[str] = set()
    counts: tuple[int, int] | None = None
    for line in lines:
        if found := _FPING.match(line):
            stamp, host, number, rtt = found.groups()
            hosts.add(host)
            mentioned.add(int(number))
            if rtt is not None and int(number) not in answers:
                printed_s = None if stamp is None else _read_decimal(stamp)
                answers[int(number)] = _Answer(_read_decimal(rtt), printed_s)
        elif found := _FPING_SUMMARY.match(line):
            counts = int(found[1]), int(found[2])
    if len(hosts) > 1:
        raise ValueError(
            f"it has {len(hosts)} hosts, {', '.join(sorted(hosts)[:3])}: keep the lines of one"
        )
    return _arrange_probes(
        answers=answers, mentioned=mentioned, first=0, counts=counts, every_s=every_s
    )


def _arrange_probes(
    answers: dict[int, _Answer],
    mentioned: set[int],
    first: int | None,
    counts: tuple[int, int] | None,
    every_s: float,
) -> PingProbes:
    """Returns the probes of a run by their numbers.

    Args:
        answers: the answers by number.
        mentioned: all numbers in the output, also of lines without an answer.
        first: the number of the first probe by the header or the summary; None: the output does
            not tell.
        counts: packets sent and received by the summary; None: there is no summary.
        every_s: the interval between probes without times, s.
    """
    lowest = min(mentioned, default=first or 0)
    highest = max(mentioned, default=(first or 0) - 1)
    begin = lowest if first is None else min(first, lowest)
    end = highest + 1
    if counts is not None:
        sent, received = counts
        end = begin + sent
        if highest >= end:
            raise ValueError(
                f"its summary counts {sent} packets, but its lines reach number {highest}"
            )
        if received > len(answers):
            text = f"its summary counts {count_nouns(received, 'answer')}, but its lines have {len(answers)}"
            raise ValueError(f"{text}: it was printed with -q, or lines are missing")
    if end - begin > _MOST_PROBES:
        raise ValueError(
            f"its summary counts {end - begin} packets, at most {_MOST_PROBES} are read"
        )
    numbers = np.arange(begin, end)
    rtt_ms = [answers[n].rtt_ms if n in answers else math.inf for n in numbers.tolist()]
    sent_s = _find_sending_times(numbers, answers, every_s).tolist()
    return PingProbes(sent_s, rtt_ms, first is not None or lowest <= 1, counts is not None)


def _find_sending_times(
    numbers: NDArray[np.int64], answers: dict[int, _Answer], every_s: float
) -> Array:
    """Returns when probes were sent, s: by the times of the answers, which are on a line if all
    have them.

    Between two answers the times are interpolated; before the first and after the last answer
    they continue at the mean interval, since `ping` prints no time of sending.
    """
    known = [
        (n, answer.printed_s - answer.rtt_ms * 1e-3)
        for n, answer in sorted(answers.items())
        if answer.printed_s is not None
    ]
    if not known or len(known) < len(answers):
        return np.asarray(numbers * every_s)
    at, sent_s = np.array(known).T
    mean_s = (sent_s[-1] - sent_s[0]) / (at[-1] - at[0]) if len(known) > 1 else every_s
    mean_s = mean_s if mean_s > 0.0 else every_s
    beyond = np.minimum(numbers - at[0], 0.0) + np.maximum(numbers - at[-1], 0.0)
    return np.asarray(np.interp(numbers, at, sent_s) + mean_s * beyond)


def _read_windows(lines: Sequence[str], every_s: float) -> PingProbes:
    """Reads the output of Windows: a header, a line per probe, then counts; it has no sequence
    numbers.
    """
    rtt_ms: list[float] = []
    sent: int | None = None
    has_header = is_over = False
    for n, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        if _WINDOWS_REPLY.search(line):
            if is_over:
                raise ValueError(_SEVERAL_RUNS)
            rtt = _ROUND_TRIP.search(line)
            assert rtt is not None
            rtt_ms.append(_read_decimal(rtt[1]))
        elif counts := _WINDOWS_COUNTS.match(line):
            if sent is not None:
                raise ValueError(_SEVERAL_RUNS)
            sent = int(counts[1])
            is_over = True
        elif is_over:
            continue
        elif line.endswith(":"):  # of the header, or of the counts
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
    sent_s = [n * every_s for n in range(len(rtt_ms))]
    return PingProbes(sent_s, rtt_ms, has_header or sent is not None, sent is not None)
