"""What `verify` and `report` print of links."""

from pathlib import Path

import pytest

from .running import trilat

JITTER = ("link.model=uniform", "link.delay_ms=50", "link.half_width_ms=40")


@pytest.mark.parametrize("settings", [(), JITTER], ids=["constant", "jitter"])
def test_a_link_is_told_of_where_it_is_not_constant(tmp_path: Path, settings: tuple[str, ...]) -> None:
    options = [word for setting in settings for word in ("--set", setting)]
    trilat("sim", "two_sites", "--duration", "1", "-o", "run.mcap", *options, cwd=tmp_path).succeeds()
    printed = trilat("verify", "run.mcap", cwd=tmp_path).succeeds()
    links = [line for line in printed.splitlines() if line.startswith("link ")]
    assert [line.split(":")[0] for line in links] == (["link s->m", "link m->s"] if settings else [])
    for line in links:
        assert "stated uniform 50 +- 23.1 ms; effective " in line
    assert links == [
        line
        for line in trilat("report", "run.mcap", cwd=tmp_path).succeeds().splitlines()
        if line.startswith("link ")
    ]
