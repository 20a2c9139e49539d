"""Draws the moving picture of README.md from the log of a simulated run.

python docs/media/moving_picture.py [FOLDER]

The run is the shipped scenario `two_people`, in virtual time. The picture is an animated SVG: its
arms are the logged joint angles, its links carry samples as long as the logged samples took, and
its bar is the dominance that the slave used. A viewer that shows no animation shows the instant
STILL_S.

Invariant:
    - Equal logs give equal bytes: every number is rounded before it is written.
    - The picture loads nothing, and has its own background, so that it is readable on light and
      on dark pages.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np

import trilat_net as tn
from trilat_net.analysis.dominance_history import DominanceHistory
from trilat_net.core.step.vectors import Array
from trilat_net.log.log_reader import Log
from trilat_net.presentation.appearance import (
    DARK_SITE_COLOURS,
    SITE_COLOURS,
    list_site_colours,
)

HERE = Path(__file__).resolve().parent
SCENARIO = "two_people"
PICTURES = HERE.parent / "img"
PICTURE = "two-people.svg"

WIDTH, HEIGHT = 800, 500
FRAMES_PER_S = 20
STILL_S = 1.4
"""Time of the run that a viewer without animation shows, in s."""
LINK_PIXELS = 86.0
"""Length of a link of an arm; both links are equally long."""
PANEL_WIDTH, PANEL_HEIGHT, PANEL_TOP = 208, 224, 58
BASE_X, BASE_Y = 86, 196
"""Base of an arm within its panel."""
CHART_LEFT, CHART_RIGHT, CHART_TOP, CHART_BOTTOM = 54, 780, 370, 456
SAMPLES_PER_LINK = 3
"""Number of samples that are drawn on the way; a link at 1 kHz has hundreds."""


class Seat(NamedTuple):
    """Where a site stands in the picture.

    Attributes:
        site: Name of the site in the scenario.
        title: Name in the picture.
        left: Left edge of the panel.
    """

    site: str
    title: str
    left: int


SEATS = (
    Seat("m1", "Person 1", 16),
    Seat("s", "Remote robot", 296),
    Seat("m2", "Person 2", 576),
)
PEOPLE = (SEATS[0], SEATS[2])
ROBOT = SEATS[1]

STYLE = """
svg { --page: #ffffff; --card: #f4f6f9; --line: #d5dae1; --soft: #59616e; --ink: #1c1e21;
  --m1: %s; --m2: %s; --s: %s; }
@media (prefers-color-scheme: dark) { svg { --page: #16181c; --card: #22262c; --line: #424852;
  --soft: #abb2bd; --ink: #eceef1; --m1: %s; --m2: %s; --s: %s; } }
text { font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial,
  sans-serif; fill: var(--ink); font-size: 14px; }
.page { fill: var(--page); stroke: var(--line); }
.card { fill: var(--card); }
.headline { font-size: 21px; font-weight: 650; }
.title { font-size: 16px; font-weight: 650; }
.soft { fill: var(--soft); }
.share { font-weight: 650; fill: var(--page); }
.strong { font-weight: 650; }
.way, .axis { stroke: var(--line); stroke-width: 2; fill: none; }
.gap { stroke: var(--soft); stroke-width: 1.5; fill: none; }
.ground { fill: var(--soft); }
.joint { fill: var(--card); }
.arm { stroke-width: 13; stroke-linecap: round; fill: none; }
.ghost { stroke-width: 2.5; stroke-linecap: round; fill: none; stroke-dasharray: 7 6; }
.curve { stroke-width: 2.5; fill: none; stroke-linejoin: round; }
.hand { fill: var(--page); stroke: var(--ink); stroke-width: 1.8; stroke-linejoin: round; }
.now { stroke: var(--ink); stroke-width: 1.5; }
.line-m1 { stroke: var(--m1); } .line-m2 { stroke: var(--m2); } .line-s { stroke: var(--s); }
.fill-m1 { fill: var(--m1); } .fill-m2 { fill: var(--m2); } .fill-s { fill: var(--s); }
"""

HAND = (
    "M-9 10 L-9 -3 Q-9 -6 -6.5 -6 Q-4.5 -6 -4.5 -3 L-4.5 -10 Q-4.5 -13 -2 -13 Q0 -13 0 -10 "
    "L0 -11 Q0 -14 2.3 -14 Q4.6 -14 4.6 -11 L4.6 -9 Q4.6 -11.5 6.8 -11.5 Q9 -11.5 9 -9 "
    "L9 3 Q14 -3 16 -1 Q17.5 0.5 15.5 3 L10 11 Q7 16 1 16 L-2 16 Q-9 16 -9 10 Z"
)
"""Outline of an open hand, about 26 pixels wide, around its palm."""


def write_number(value: float) -> str:
    """Returns a number with at most one decimal place."""
    text = f"{value:.1f}".removesuffix(".0")
    return "0" if text == "-0" else text


def add(parent: ET.Element, tag: str, text: str = "", **attributes: object) -> ET.Element:
    """Adds an element.

    Args:
        parent: Element that contains it.
        tag: Kind of the element, as in "rect".
        text: Text within the element.
        attributes: Attributes. An underscore stands for a dash, and one at the end is dropped.
    """
    written = {
        name.removesuffix("_").replace("_", "-"): write_number(value)
        if isinstance(value, float)
        else str(value)
        for name, value in attributes.items()
    }
    element = ET.SubElement(parent, tag, written)
    element.text = text or None
    return element


class Film(NamedTuple):
    """The run at the times of the frames.

    Attributes:
        t_s: Times of the F frames, in s.
        q_deg: Joint angles of each site, shape (F, 2), in degrees.
        reach_m: Horizontal position of each site's end effector, shape (F,), in m.
        shares: Shares of both people in the slave's reference, shape (F, 2).
        delay_s: Age of the samples that the slave used.
        lags_s: Time by which the slave passes the middle of its way later than each leader, on
            the way there and on the way back.
        held_s: By site, the time in which a hand holds its arm, in s.
    """

    t_s: Array
    q_deg: dict[str, Array]
    reach_m: dict[str, Array]
    shares: Array
    delay_s: float
    lags_s: tuple[float, float]
    held_s: dict[str, tuple[float, float]]

    def add_motion(self, parent: ET.Element, name: str, values: Array) -> None:
        """Animates an attribute of an element; the attribute stands at STILL_S until then."""
        parent.set(name, write_number(self.at_still(values)))
        texts = ";".join(map(write_number, values))
        add(parent, "animate", attributeName=name, values=texts, **self._time())

    def add_turn(self, parent: ET.Element, angles_deg: Array) -> None:
        """Animates the rotation of a group, clockwise in degrees."""
        parent.set("transform", f"rotate({write_number(self.at_still(angles_deg))})")
        texts = ";".join(map(write_number, angles_deg))
        add(
            parent,
            "animateTransform",
            attributeName="transform",
            type="rotate",
            values=texts,
            **self._time(),
        )

    def show_between(self, parent: ET.Element, start_s: float, end_s: float) -> None:
        """Shows an element from one time of the run until another."""
        shown = (self.t_s >= start_s) & (self.t_s < end_s)
        edges = [0, *(np.flatnonzero(np.diff(shown)) + 1)]
        parent.set("opacity", str(int(self.at_still(shown))))
        add(
            parent,
            "animate",
            attributeName="opacity",
            calcMode="discrete",
            values=";".join(str(int(shown[edge])) for edge in edges),
            keyTimes=";".join(f"{self.t_s[edge] / self._end_s():.4f}" for edge in edges),
            **self._time(),
        )

    def at_still(self, values: Array) -> float:
        """Returns the value of the frame at STILL_S."""
        return float(values[round(STILL_S * FRAMES_PER_S)])

    def _end_s(self) -> float:
        return float(self.t_s[-1])

    def _time(self) -> dict[str, str]:
        return {"dur": f"{write_number(self._end_s())}s", "repeatCount": "indefinite"}


def read_film(log: Log) -> Film:
    """Reads the run at the times of the frames; the last frame is the last record."""
    scenario = log.scenario
    slave = log[ROBOT.site]
    count = round(scenario.duration_s * FRAMES_PER_S) + 1
    t_s = np.arange(count) / FRAMES_PER_S
    q_rad = {seat.site: sample(log, seat.site, t_s) for seat in SEATS}
    reach_m = {}
    for name, angles in q_rad.items():
        arm = scenario.sites[name].arm
        elbow_m = arm.l1_m * np.cos(angles[:, 0])
        reach_m[name] = elbow_m + arm.l2_m * np.cos(angles.sum(axis=1))
    leader = PEOPLE[0].site
    ages_s = slave.age_s(leader, scenario.sites[leader].rate_hz)
    hands = {seat.site: scenario.sites[seat.site].hands[0] for seat in PEOPLE}
    return Film(
        t_s=t_s,
        q_deg={name: np.degrees(angles) for name, angles in q_rad.items()},
        reach_m=reach_m,
        shares=DominanceHistory.of_log(log, ROBOT.site, t_s).alpha,
        delay_s=float(np.nanmedian(ages_s)),
        lags_s=measure_lags(t_s, reach_m),
        held_s={
            name: (hand.start_s, min(hand.end_s, scenario.duration_s + 1.0))
            for name, hand in hands.items()
        },
    )


def sample(log: Log, site: str, t_s: Array) -> Array:
    """Returns the joint angles of a site at the given times, shape (F, 2), in rad."""
    records = np.searchsorted(log[site].t_s, t_s)
    return log[site].q[np.minimum(records, len(log[site].q) - 1)]


def find_crossings(t_s: Array, reach_m: Array) -> tuple[float, float]:
    """Returns when a position first and last passes the middle of its range, in s."""
    from_middle_m = reach_m - float(reach_m.min() + reach_m.max()) / 2.0
    before = np.flatnonzero(np.diff(from_middle_m > 0.0))
    shares = from_middle_m[before] / (from_middle_m[before] - from_middle_m[before + 1])
    times_s = t_s[before] + shares / FRAMES_PER_S
    return float(times_s[0]), float(times_s[-1])


def measure_lags(t_s: Array, reach_m: dict[str, Array]) -> tuple[float, float]:
    """Returns how much later the slave passes the middle than each leader, in s."""
    slave_s = find_crossings(t_s, reach_m[ROBOT.site])
    first_s, _ = find_crossings(t_s, reach_m[PEOPLE[0].site])
    _, last_s = find_crossings(t_s, reach_m[PEOPLE[1].site])
    return slave_s[0] - first_s, slave_s[1] - last_s


def draw_film(log: Log) -> str:
    """Returns the moving picture of a run as the text of an SVG file.

    Args:
        log: Log of a run of `two_people`.
    """
    film = read_film(log)
    root = ET.Element(
        "svg",
        {
            "xmlns": "http://www.w3.org/2000/svg",
            "viewBox": f"0 0 {WIDTH} {HEIGHT}",
            "width": str(WIDTH),
            "height": str(HEIGHT),
            "role": "img",
        },
    )
    add(root, "title", "Two people lead one remote robot in turn, over a network with delay")
    scenario = log.scenario
    order = [list(scenario.sites).index(name) for name in ("m1", "m2", "s")]
    light, dark = (
        [list_site_colours(scenario, palette)[n] for n in order]
        for palette in (SITE_COLOURS, DARK_SITE_COLOURS)
    )
    add(root, "style", STYLE % (*light, *dark))
    add(root, "rect", class_="page", x=0.5, y=0.5, width=WIDTH - 1, height=HEIGHT - 1, rx=14)
    draw_headline(root, film)
    for seat in SEATS:
        draw_panel(root, film, seat)
    draw_links(root, film)
    draw_chart(root, film)
    ET.indent(root, " ")
    return ET.tostring(root, encoding="unicode") + "\n"


def find_handover(film: Film) -> tuple[float, float]:
    """Returns when the dominance begins to move, and when it has arrived, in s."""
    moving = np.flatnonzero(np.diff(film.shares[:, 0]))
    return float(film.t_s[moving[0]]), float(film.t_s[moving[-1] + 1])


def draw_headline(root: ET.Element, film: Film) -> None:
    """Draws the sentence that says what happens now."""
    begin_s, end_s = find_handover(film)
    there, back = (f"{write_number(lag_s)} s later" for lag_s in film.lags_s)
    for text, start_s, stop_s in (
        (f"Person 1 leads. The robot follows {there}.", 0.0, begin_s),
        ("The lead passes from person 1 to person 2.", begin_s, end_s),
        (f"Person 2 leads. The robot follows {back}.", end_s, film.t_s[-1] + 1.0),
    ):
        line = add(root, "text", text, class_="headline", x=18, y=38)
        film.show_between(line, start_s, stop_s)


def draw_panel(root: ET.Element, film: Film, seat: Seat) -> None:
    """Draws a site: its title, its arm, and what holds or leads the arm."""
    panel = add(root, "g", transform=f"translate({seat.left},{PANEL_TOP})")
    add(panel, "rect", class_="card", width=PANEL_WIDTH, height=PANEL_HEIGHT, rx=10)
    add(panel, "text", seat.title, class_="title", x=12, y=24)
    if seat is ROBOT:
        draw_shares(root, film)
        begin_s, end_s = find_handover(film)
        middle_s = (begin_s + end_s) / 2.0
        spans = ((0.0, middle_s), (middle_s, film.t_s[-1] + 1.0))
        for person, (start_s, stop_s) in zip(PEOPLE, spans, strict=True):
            ghost = add(panel, "g")
            draw_arm(ghost, film, person.site, f"ghost line-{person.site}")
            film.show_between(ghost, start_s, stop_s)
    tip = draw_arm(panel, film, seat.site, f"arm line-{seat.site}")
    add(panel, "path", class_="ground", d=f"M{BASE_X - 17} {BASE_Y + 16} h34 l-8 -16 h-18 Z")
    add(panel, "circle", class_="joint", cx=BASE_X, cy=BASE_Y, r=4)
    if seat in PEOPLE:
        upright = add(tip, "g")
        film.add_turn(upright, film.q_deg[seat.site].sum(axis=1))
        hand = add(upright, "path", class_="hand", d=HAND)
        film.show_between(hand, *film.held_s[seat.site])
        note = add(panel, "text", "guided by the robot", class_="soft", x=12, y=44)
        start_s, stop_s = film.held_s[seat.site]
        free = (stop_s, film.t_s[-1] + 1.0) if start_s == 0.0 else (0.0, start_s)
        film.show_between(note, *free)
        note = add(panel, "text", "holds this arm", class_="soft", x=12, y=44)
        film.show_between(note, start_s, stop_s)
    else:
        add(panel, "text", "dashed: the leader now", class_="soft", x=12, y=44)


def draw_arm(parent: ET.Element, film: Film, site: str, style: str) -> ET.Element:
    """Draws an arm with two links of equal length; returns the group at its end effector."""
    length = LINK_PIXELS
    base = add(parent, "g", transform=f"translate({BASE_X},{BASE_Y})")
    upper = add(base, "g")
    film.add_turn(upper, -film.q_deg[site][:, 0])
    add(upper, "line", class_=style, x2=length)
    elbow = add(upper, "g", transform=f"translate({write_number(length)},0)")
    fore = add(elbow, "g")
    film.add_turn(fore, -film.q_deg[site][:, 1])
    add(fore, "line", class_=style, x2=length)
    if style.startswith("arm"):
        add(fore, "circle", class_="joint", r=4)
    return add(fore, "g", transform=f"translate({write_number(length)},0)")


def draw_shares(root: ET.Element, film: Film) -> None:
    """Draws the bar of dominance below the robot: how much each person counts."""
    left, top, width, height = ROBOT.left, PANEL_TOP + PANEL_HEIGHT + 8, PANEL_WIDTH, 24
    add(root, "rect", class_="fill-m2", x=left, y=top, width=width, height=height, rx=5)
    bar = add(root, "rect", class_="fill-m1", x=left, y=top, height=height, rx=5)
    film.add_motion(bar, "width", width * film.shares[:, 0])
    word = {"class_": "soft", "x": left - 10, "text_anchor": "end"}
    add(root, "text", "dominance", y=top + 17, **word)
    begin_s, end_s = find_handover(film)
    first, last = film.shares[0], film.shares[-1]
    for shares, start_s, stop_s in (
        (first, 0.0, begin_s),
        (last, end_s, film.t_s[-1] + 1.0),
    ):
        middle = left + width * (shares[0] / 2.0 if shares[0] > 0.5 else (1 + shares[0]) / 2.0)
        text = f"{100 * shares.max():.0f} %"
        label = add(
            root, "text", text, class_="share", x=middle, y=top + 17, text_anchor="middle"
        )
        film.show_between(label, start_s, stop_s)


def draw_links(root: ET.Element, film: Film) -> None:
    """Draws the links between the people and the robot, with samples on their way."""
    label = f"{write_number(film.delay_s)} s"
    for person in PEOPLE:
        left, right = sorted((person.left, ROBOT.left))
        start, end = left + PANEL_WIDTH + 5, right - 5
        middle = (start + end) / 2.0
        add(
            root,
            "text",
            label,
            class_="title",
            x=middle,
            y=PANEL_TOP + 96,
            text_anchor="middle",
        )
        add(
            root,
            "text",
            "delay",
            class_="soft",
            x=middle,
            y=PANEL_TOP + 77,
            text_anchor="middle",
        )
        inwards = (start, end) if person is PEOPLE[0] else (end, start)
        draw_way(root, film, person.site, inwards, PANEL_TOP + 116)
        draw_way(root, film, ROBOT.site, inwards[::-1], PANEL_TOP + 142)


def draw_way(
    root: ET.Element, film: Film, sender: str, ends: tuple[int, int], height: int
) -> None:
    """Draws one direction of a link, and its samples in the sender's colour."""
    start, end = ends
    step = 6 if end > start else -6
    add(
        root,
        "path",
        class_="way",
        d=f"M{start} {height} H{end} m{-step} -5 l{step} 5 l{-step} 5",
    )
    for n in range(SAMPLES_PER_LINK):
        share = n / SAMPLES_PER_LINK
        dot = add(root, "circle", class_=f"fill-{sender}", cy=height, r=4.5)
        dot.set("cx", write_number(start + share * (end - start)))
        add(
            dot,
            "animate",
            attributeName="cx",
            values=f"{start};{end}",
            dur=f"{film.delay_s:.3f}s",
            begin=f"-{share * film.delay_s:.3f}s",
            repeatCount="indefinite",
        )


def draw_chart(root: ET.Element, film: Film) -> None:
    """Draws where the three end effectors are over time, with a line at the present time."""
    low_m = min(values.min() for values in film.reach_m.values())
    high_m = max(values.max() for values in film.reach_m.values())

    def place_time(t_s: float) -> float:
        """Returns the horizontal place of a time."""
        return CHART_LEFT + (CHART_RIGHT - CHART_LEFT) * t_s / float(film.t_s[-1])

    def place(reach_m: float) -> float:
        """Returns the vertical place of a position."""
        return CHART_BOTTOM - (CHART_BOTTOM - CHART_TOP) * (reach_m - low_m) / (high_m - low_m)

    begin_s, end_s = find_handover(film)
    left, right = place_time(begin_s), place_time(end_s)
    add(
        root,
        "rect",
        class_="card",
        x=left,
        y=CHART_TOP - 8,
        width=right - left,
        height=CHART_BOTTOM - CHART_TOP + 18,
    )
    middle = (left + right) / 2.0
    label = {"class_": "soft", "x": middle, "text_anchor": "middle"}
    add(root, "text", "handover", y=(CHART_TOP + CHART_BOTTOM) / 2.0 + 5.0, **label)
    draw_legend(root)
    for text, height in (("right", CHART_TOP + 5), ("left", CHART_BOTTOM + 5)):
        add(root, "text", text, class_="soft", x=CHART_LEFT - 8, y=height, text_anchor="end")
    for second in range(round(float(film.t_s[-1])) + 1):
        x = place_time(second)
        add(root, "path", class_="axis", d=f"M{write_number(x)} {CHART_BOTTOM + 10} v5")
        text = f"{second} s" if second else "0"
        anchor = "end" if x > CHART_RIGHT - 1 else "middle"
        add(root, "text", text, class_="soft", x=x, y=CHART_BOTTOM + 30, text_anchor=anchor)
    add(root, "path", class_="axis", d=f"M{CHART_LEFT} {CHART_BOTTOM + 10} H{CHART_RIGHT}")

    for seat in (SEATS[2], SEATS[0], SEATS[1]):
        values = film.reach_m[seat.site]
        points = " ".join(
            f"{write_number(place_time(t))},{write_number(place(v))}"
            for t, v in zip(film.t_s, values, strict=True)
        )
        add(root, "polyline", class_=f"curve line-{seat.site}", points=points)
    draw_gap(root, film, place_time, place)

    now = add(root, "line", class_="now", y1=CHART_TOP - 8, y2=CHART_BOTTOM + 10)
    places = np.array([place_time(t) for t in film.t_s])
    film.add_motion(now, "x1", places)
    film.add_motion(now, "x2", places)
    for seat in SEATS:
        dot = add(root, "circle", class_=f"fill-{seat.site}", r=5.5)
        film.add_motion(dot, "cx", places)
        film.add_motion(dot, "cy", np.array([place(v) for v in film.reach_m[seat.site]]))


def draw_legend(root: ET.Element) -> None:
    """Names the curves of the chart, above it."""
    add(root, "text", "Position over time", class_="title", x=18, y=CHART_TOP - 18)
    x = 206
    for seat in SEATS:
        add(root, "circle", class_=f"fill-{seat.site}", cx=x, cy=CHART_TOP - 23, r=5.5)
        add(root, "text", seat.title, class_="soft", x=x + 11, y=CHART_TOP - 18)
        x += 96 if seat in PEOPLE else 130


def draw_gap(
    root: ET.Element,
    film: Film,
    place_time: Callable[[float], float],
    place: Callable[[float], float],
) -> None:
    """Marks how much later the robot passes the middle of its way than person 1."""
    slave_m = film.reach_m[ROBOT.site]
    end_s, _ = find_crossings(film.t_s, slave_m)
    start, end = place_time(end_s - film.lags_s[0]), place_time(end_s)
    y = place(float(slave_m.min() + slave_m.max()) / 2.0)
    ends = f"M{write_number(start + 4)} {write_number(y)} H{write_number(end - 4)}"
    add(root, "path", class_="gap", d=ends)
    text = f"{write_number(film.lags_s[0])} s"
    middle = (start + end) / 2.0 + 3.0
    add(root, "text", text, class_="strong", x=middle, y=y - 5.0, text_anchor="middle")


def main() -> None:
    """Simulates the run, and writes its picture into a folder, by default docs/img."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURES
    path = folder / PICTURE
    path.write_text(draw_film(tn.simulate(SCENARIO)), encoding="utf-8")
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
