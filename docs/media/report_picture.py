"""Draws the picture of a report in docs/tutorials/first-result.md: the first screen of the page.

python docs/media/report_picture.py [FILE]

The report is that of the shipped scenario `two_people`, in virtual time. A headless Chromium opens
the page and draws it. FILE is the picture, by default docs/img/report.png.

Invariant:
    - Without Chromium no picture is written, and the error says how to install it.
    - The page is the one that a reader's own commands write.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import trilat_net as tn

SCENARIO = "two_people"
PICTURE = Path(__file__).resolve().parents[1] / "img" / "report.png"
WIDTH, HEIGHT = 1200, 800
"""Size of the window of the browser, in px of the page."""
SCALE = 0.75
"""Size of a px of the page, in px of the picture."""
SHOWN_SHARE = 1.5 / 9.0
"""Time at which the picture shows the arms, as a share of the run."""
MOVE_SLIDER = f"""<script>
const slider = document.querySelector("#arms input");
slider.value = Number(slider.min) + {SHOWN_SHARE} * (Number(slider.max) - Number(slider.min));
slider.dispatchEvent(new Event("input", {{ bubbles: true }}));
</script>"""
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def find_browser() -> str:
    """Returns the path of an installed Chromium.

    Raises:
        SystemExit: There is none.
    """
    for name in BROWSERS:
        path = shutil.which(name)
        if path:
            return path
    sys.exit(f"report_picture.py needs one of {', '.join(BROWSERS)}: apt-get install chromium")


def write_report(folder: Path) -> Path:
    """Simulates the run, writes its report into a folder, and returns the page."""
    log = folder / "run.mcap"
    tn.simulate(SCENARIO).save(log)
    command = [sys.executable, "-m", "trilat_net", "report", "run.mcap"]
    subprocess.run(command, cwd=folder, check=True)
    page = folder / "run" / "report.html"
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace("</body>", f"{MOVE_SLIDER}</body>"), encoding="utf-8")
    return page


def draw_page(browser: str, page: Path, picture: Path) -> None:
    """Draws the first screen of a page into a picture.

    Args:
        browser: Path of the browser.
        page: The page, a file.
        picture: The picture, a PNG file.
    """
    with tempfile.TemporaryDirectory() as profile:
        options = [
            "--headless",
            "--no-sandbox",  # the page is a file that this program has just written
            "--disable-gpu",
            "--hide-scrollbars",
            f"--user-data-dir={profile}",
            f"--window-size={WIDTH},{HEIGHT}",
            f"--force-device-scale-factor={SCALE}",
            # The arms stand still where MOVE_SLIDER puts them, whatever the speed of the machine.
            "--force-prefers-reduced-motion",
            # The time of the page, in ms, so that scripts have drawn the arms.
            "--virtual-time-budget=5000",
            f"--screenshot={picture.resolve()}",
        ]
        command = [browser, *options, page.resolve().as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=300)


def main() -> None:
    """Draws the picture into the file that the command line names."""
    picture = Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURE
    browser = find_browser()
    with tempfile.TemporaryDirectory() as folder:
        draw_page(browser, write_report(Path(folder)), picture)
    print(f"{picture.name}: {picture.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
