"""The output of `ping` on every system: each probe is an answer or a loss, and the text states the end."""

import math
import zipfile
from pathlib import Path

import numpy as np
import pytest

from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario
from trilat_net.scenario.delay_traces import MeasuredTrace, import_trace

PINGS = Path(__file__).parent / "pings"
IPUTILS = "PING host (192.0.2.5) 56(84) bytes of data.\n"
BSD = "PING host (192.0.2.5): 56 data bytes\n"
LOST = math.inf


def import_text(
    tmp_path: Path, text: str, encoding: str = "utf-8", every_s: float = 1.0
) -> MeasuredTrace:
    path = tmp_path / "ping.txt"
    path.write_bytes(text.encode(encoding))
    return import_trace(path, "ping", way="whole", every_s=every_s)


def list_delays(trace: MeasuredTrace) -> list[float]:
    return [ms for _, ms in trace.points]


def answer_lines(*numbers: int, key: str = "icmp_seq") -> str:
    return "".join(
        f"64 bytes from 192.0.2.5: {key}={n} ttl=64 time={n + 1}.0 ms\n" for n in numbers
    )


def summary_lines(sent: int, received: int) -> str:
    lost = 100.0 * (sent - received) / sent
    counts = f"{sent} packets transmitted, {received} received, {lost:g}% packet loss, time 9ms"
    return f"\n--- host ping statistics ---\n{counts}\n"


@pytest.mark.parametrize(
    ("name", "samples", "lost_percent", "first_ms", "last_ms", "end_known"),
    [
        ("ping_outage_at_both_ends", 40, 37.5, LOST, LOST, True),
        ("ping_busybox", 20, 0.0, 3.0, 4.9, False),
        ("ping_decimal_comma", 29, 0.0, 12.1, 14.9, False),
        ("ping_windows", 30, 100.0 / 30.0, 1.0, 49.0, True),
    ],
)
def test_every_probe_of_a_ping_counts(
    name: str,
    samples: int,
    lost_percent: float,
    first_ms: float,
    last_ms: float,
    end_known: bool,
) -> None:
    trace = import_trace(PINGS / f"{name}.txt", "ping", way="whole")
    facts = trace.to_dict()
    assert facts["samples"] == samples
    assert facts["lost_percent"] == pytest.approx(lost_percent)
    assert (list_delays(trace)[0], list_delays(trace)[-1]) == (first_ms, last_ms)
    assert facts["end_known"] == end_known
    assert ("does not tell how the measurement ended" in trace.summary()) != end_known


@pytest.mark.parametrize("head", [IPUTILS, BSD])
def test_losses_without_lines_count_at_both_ends(tmp_path: Path, head: str) -> None:
    """iputils counts from 1, BSD and busybox from 0; the summary tells the end."""
    first = 1 if head == IPUTILS else 0
    probes = import_text(tmp_path, head + answer_lines(3, 4) + summary_lines(8, 2))
    expected = [LOST] * 8
    expected[3 - first] = 4.0
    expected[4 - first] = 5.0
    assert list_delays(probes) == expected
    assert probes.begin_known
    assert probes.end_known


def test_times_continue_beyond_the_answered_probes(tmp_path: Path) -> None:
    lines = [
        f"[{100.005 + 0.2 * n:.6f}] 64 bytes: icmp_seq={n} ttl=64 time=5.0 ms"
        for n in (4, 5, 7)
    ]
    probes = import_text(tmp_path, IPUTILS + "\n".join(lines) + "\n" + summary_lines(9, 3))
    assert [t_s for t_s, _ in probes.points] == pytest.approx(0.2 * np.arange(9), abs=1e-6)


def test_seeded_losses_are_counted_as_ping_counts_them(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    for loss in (0.05, 0.3, 0.6, 0.95):
        sent = int(random.integers(5, 200))
        answered = [n for n in range(1, sent + 1) if random.uniform() > loss]
        # some overtake others
        order = sorted(answered, key=lambda n: n + 3.0 * random.uniform())
        text = (
            IPUTILS
            + answer_lines(*order)
            + answer_lines(*order[:2])
            + summary_lines(sent, len(answered))
        )
        probes = import_text(tmp_path, text)
        assert probes.to_dict()["lost_percent"] == pytest.approx(
            100.0 * (sent - len(answered)) / sent
        )
        assert list_delays(probes) == [
            n + 1.0 if n in answered else LOST for n in range(1, sent + 1)
        ]


WINDOWS = {
    "German": (
        "Ping wird ausgeführt für host [192.0.2.7] mit 32 Bytes Daten:",
        "Antwort von 192.0.2.7: Bytes=32 Zeit={}ms TTL=53",
        "Zeitüberschreitung der Anforderung.",
        "Ping-Statistik für 192.0.2.7:\n"
        "    Pakete: Gesendet = 4, Empfangen = 3, Verloren = 1\n    (25% Verlust),",
    ),
    "French": (
        "Envoi d'une requête 'ping' sur host [192.0.2.7] avec 32 octets de données :",
        "Réponse de 192.0.2.7 : octets=32 temps={} ms TTL=53",
        "Délai d'attente de la demande dépassé.",
        "Statistiques Ping pour 192.0.2.7:\n    Paquets : envoyés = 4, reçus = 3, perdus = 1 (perte 25%),",
    ),
    "Spanish": (
        "Haciendo ping a host [192.0.2.7] con 32 bytes de datos:",
        "Respuesta desde 192.0.2.7: bytes=32 tiempo={}ms TTL=53",
        "Tiempo de espera agotado para esta solicitud.",
        "Estadísticas de ping para 192.0.2.7:\n"
        "    Paquetes: enviados = 4, recibidos = 3, perdidos = 1\n    (25% perdidos),",
    ),
    "English": (
        "Pinging host [2001:db8::7] with 32 bytes of data:",
        "Reply from 2001:db8::7: time={}ms",
        "Destination host unreachable.",
        "Ping statistics for 2001:db8::7:\n    Packets: Sent = 4, Received = 3, Lost = 1 (25% loss),",
    ),
}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "cp850", "cp1252"])
@pytest.mark.parametrize("language", WINDOWS)
def test_windows_speaks_any_language_and_encoding(
    tmp_path: Path, language: str, encoding: str
) -> None:
    head, reply, lost, counts = WINDOWS[language]
    lines = [
        "",
        head,
        lost,
        reply.format(7),
        reply.format(8),
        reply.format(9),
        "",
        counts,
        "    Minimum = 7ms, Maximum = 9ms, Average = 8ms",
        "^C",
    ]
    probes = import_text(tmp_path, "\r\n".join(lines), encoding, every_s=2.0)
    assert probes.points == ((0.0, LOST), (2.0, 7.0), (4.0, 8.0), (6.0, 9.0))
    assert probes.begin_known
    assert probes.end_known


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("64 Bytes von 192.0.2.5: icmp_seq=1 ttl=64 Zeit=12,5 ms\n"
         "3 Pakete übertragen, 1 empfangen, 67% Verlust",
         [12.5, LOST, LOST]),
        ("64 octets de 192.0.2.5 : icmp_seq=2 ttl=64 temps=12.5 ms\n"
         "3 paquets transmis, 1 reçus, 66,7% perdus",
         [LOST, 12.5, LOST]),
        (BSD + "Request timeout for icmp_seq 0\n64 bytes from h: icmp_seq=1 ttl=57 time=9.125 ms\n"
         "Request timeout for icmp_seq 2\n\n3 packets transmitted, 1 packets received, 66.7% packet loss",
         [LOST, 9.125, LOST]),
        (IPUTILS + "From 192.0.2.1 icmp_seq=1 Destination Host Unreachable\n" + answer_lines(2)
         + "2 packets transmitted, 1 received, +1 errors, 50% packet loss, time 1ms", [LOST, 3.0]),
        ("PING6(56=40+8+8 bytes) ::1 --> ::1\n16 bytes from ::1, icmp_seq=1 hlim=64 time=0.5 ms\n"
         "2 packets transmitted, 1 packets received, 50.0% packet loss", [LOST, 0.5]),
        (BSD + answer_lines(0, 2, key="seq") + "4 packets transmitted, 2 packets received, 50% packet loss",
         [1.0, LOST, 3.0, LOST]),
        ("[1.5] h : [0], timed out (NaN avg, 100% loss)\n"
         "[2.51] h : [1], 64 bytes, 10.0 ms (10 avg, 50% loss)\n"
         "h : xmt/rcv/%loss = 3/1/66%, min/avg/max = 10/10/10", [LOST, 10.0, LOST]),
        (IPUTILS + summary_lines(3, 0), [LOST, LOST, LOST]),
    ],
)  # fmt: skip
def test_other_forms_of_ping_are_read(tmp_path: Path, text: str, expected: list[float]) -> None:
    probes = import_text(tmp_path, text)
    assert list_delays(probes) == expected
    assert probes.end_known


@pytest.mark.parametrize(
    ("text", "begin_known", "expected"),
    [
        (answer_lines(4, 6), False, [5.0, LOST, 7.0]),
        (answer_lines(1, 2), True, [2.0, 3.0]),
        (IPUTILS + "no answer yet for icmp_seq=1\n" + answer_lines(2) + "no answer yet for icmp_seq=3\n", True,
         [LOST, 3.0, LOST]),
        ("Reply from 192.0.2.7: bytes=32 time<1ms TTL=53\n", False, [1.0]),
    ],
)  # fmt: skip
def test_unfinished_output_has_an_unknown_end(
    tmp_path: Path, text: str, begin_known: bool, expected: list[float]
) -> None:
    probes = import_text(tmp_path, text)
    assert list_delays(probes) == expected
    assert (probes.begin_known, probes.end_known) == (begin_known, False)
    assert ("before its first sample" in probes.summary()) != begin_known


@pytest.mark.parametrize("form", ["ping", "csv", "irtt", "link"])
@pytest.mark.parametrize(
    ("ending", "inside"),
    [
        ("xlsx", "xl/workbook.xml"),
        ("ods", "application/vnd.oasis.opendocument.spreadsheet"),
        ("zip", "a.txt"),
    ],
)
def test_spreadsheets_are_named(tmp_path: Path, form: str, ending: str, inside: str) -> None:
    path = tmp_path / f"table.{ending}"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mimetype" if ending == "ods" else inside, inside)
    kind = (
        "a ZIP archive"
        if ending == "zip"
        else f"a spreadsheet \\(.{ending}\\), not text: save the sheet as CSV"
    )
    link = {"link": {"model": "trace", "file": str(path)}}
    with pytest.raises(ScenarioError, match=f"is {kind}"):
        load_scenario("free", link) if form == "link" else import_trace(path, form)


@pytest.mark.parametrize("mark", [";", "\t", " "])
def test_a_table_may_have_decimal_commas(tmp_path: Path, mark: str) -> None:
    rows = [("t_s", "rtt_ms"), ("0,0", "20,5"), ("0,1", "lost"), ("0,2", "30")]
    path = tmp_path / "table.csv"
    path.write_bytes("\n".join(mark.join(row) for row in rows).encode("utf-16"))
    assert import_trace(path, "csv", way="whole").write_rows() == (
        "t_s,delay_ms\n0.000000,20.500\n0.100000,lost\n0.200000,30.000\n"
    )
