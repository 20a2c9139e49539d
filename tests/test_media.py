"""The moving picture of the README: its bytes are those of its run, and it loads nothing."""

import re
import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import matplotlib.image
import numpy as np
import pytest

import trilat_net as tn

ROOT = Path(__file__).parents[1]
MEDIA = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "media" / "moving_picture.py")))
GALLERY = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "media" / "make_media.py")))
REPORT = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "media" / "report_picture.py")))
GALLERY_TEXT = GALLERY.PAGE.read_text(encoding="utf-8")
ENTRIES = list(GALLERY.read_gallery(GALLERY_TEXT))
PICTURE = (MEDIA.PICTURES / MEDIA.PICTURE).read_text(encoding="utf-8")
LARGEST_BYTES = 1_500_000


@pytest.mark.long
def test_the_picture_is_that_of_its_run() -> None:
    assert MEDIA.draw_film(tn.simulate(MEDIA.SCENARIO)) == PICTURE


def test_hands_of_the_picture_push_as_people_do() -> None:
    """The README and the scenario state 8 N, a torque far from its limit, and 0.6 s."""
    log = tn.simulate(MEDIA.SCENARIO)
    for name in ("m1", "m2"):
        arm = log.scenario.sites[name].arm
        site = log[name]
        # Columns of the Jacobian of the end effector, from the positions of both links.
        upper_rad = site.q[:, 0]
        fore_rad = site.q.sum(axis=1)
        fore = arm.l2_m * np.stack([-np.sin(fore_rad), np.cos(fore_rad)], axis=1)
        upper = arm.l1_m * np.stack([-np.sin(upper_rad), np.cos(upper_rad)], axis=1)
        transposed = np.stack([upper + fore, fore], axis=1)
        forces_n = np.linalg.solve(transposed, site.tau_x[:, :, None])[:, :, 0]
        assert 2.0 < np.linalg.norm(forces_n, axis=1).max() < 8.0
        assert np.abs(site.tau).max() < 0.5 * log.scenario.sites[name].limits.tau_limit_nm
    assert MEDIA.read_film(log).lags_s == pytest.approx((0.6, 0.6), abs=0.05)


def test_the_picture_loads_nothing() -> None:
    assert len(PICTURE) < LARGEST_BYTES
    assert set(re.findall(r"https?://[^\"' )]+", PICTURE)) == {"http://www.w3.org/2000/svg"}
    assert not re.search(r"href|url\(|<script|@import", PICTURE)


def test_every_motion_lasts_as_long_as_the_run() -> None:
    duration_s = tn.load_scenario(MEDIA.SCENARIO).duration_s
    frames = round(duration_s * MEDIA.FRAMES_PER_S) + 1
    animated = [
        element
        for element in ElementTree.fromstring(PICTURE).iter()
        if element.tag.partition("}")[2].startswith("animate")
    ]
    counts = {
        len(element.attrib["values"].split(";"))
        for element in animated
        if element.attrib["dur"] == f"{duration_s:g}s" and "calcMode" not in element.attrib
    }
    assert len(animated) > 30
    assert counts == {frames}


def test_gallery_pictures_have_their_commands() -> None:
    assert len(ENTRIES) + GALLERY_TEXT.count(f"```sh\n{GALLERY.MAKE_ALL}\n") == 12
    names = [entry.path.parts[0] for entry in ENTRIES]
    assert len(set(names)) == len(names)
    for entry in ENTRIES:
        assert (GALLERY.PICTURES / entry.path).is_file(), entry.title


@pytest.mark.parametrize(
    "entry",
    [
        pytest.param(
            entry,
            id=entry.path.parts[0],
            marks=() if entry.path.parts[0] == "ports" else pytest.mark.long,
        )
        for entry in ENTRIES
    ],
)
def test_commands_of_gallery_make_its_pictures(entry: Any, tmp_path: Path) -> None:
    """The same version of the program draws the same picture, byte for byte."""
    picture = GALLERY.make_picture(entry, tmp_path)
    assert picture.read_bytes() == (GALLERY.PICTURES / entry.path).read_bytes()


def test_report_pictures_have_their_windows_size() -> None:
    pixels = matplotlib.image.imread(REPORT.PICTURE)
    height, width = pixels.shape[:2]
    assert (width, height) == (REPORT.SCALE * REPORT.WIDTH, REPORT.SCALE * REPORT.HEIGHT)


def test_report_pictures_name_their_missing_browser(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit, match="apt-get install chromium"):
        REPORT.find_browser()
