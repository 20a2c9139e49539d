"""Five round trips that irtt measured, and the file that irtt wrote (README of clarkzjw/LENS)."""

import gzip
import json
from pathlib import Path
from typing import Any

RTT_NS = (17291970, 16870863, 16064572, 16259053, 16597560)
SENT_NS = (22211105, 1022856655, 2022029432, 3022256680, 4022643932)


def make_round_trip(number: int, lost: str = "false") -> dict[str, Any]:
    """Returns an entry of the file; `lost` is irtt's word for the loss."""
    times = {"client": {"send": {"wall": 1707277440772833721, "monotonic": SENT_NS[number]}}}
    delay = (
        {}
        if lost != "false"
        else {"rtt": RTT_NS[number], "send": 10486437967, "receive": -10470921269}
    )
    return {"seqno": number, "lost": lost, "timestamps": times, "delay": delay}


def write_irtt_file(folder: Path, *lost: int, zipped: bool = False) -> Path:
    trips = [make_round_trip(n, "true_up" if n in lost else "false") for n in range(5)]
    text = json.dumps({"stats": {}, "round_trips": trips}).encode()
    path = folder / ("run.json.gz" if zipped else "run.json")
    path.write_bytes(gzip.compress(text) if zipped else text)
    return path
