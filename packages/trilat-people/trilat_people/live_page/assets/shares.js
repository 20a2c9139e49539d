// Dominance as a triangle: the row of each site is a point on the edge between the two others, and a point inside
// sets all three rows at once, by the lines through it (Ceva). Rows sum to 1 wherever one drags.
import { siteColour } from "./arms.js";

const SVG = "http://www.w3.org/2000/svg";
const CORNERS = [[-108, 88], [108, 88], [0, -98]];
const EVERY_MS = 120;
const KEEP = 0.02; // no corner is reached: a site that nobody follows has no weight in V

const element = (parent, tag, attributes = {}) => {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return parent.appendChild(made);
};

export class Shares {
  constructor(svg, rows, hello, send, page) {
    Object.assign(this, { svg, rows, send, page, about: hello.sites, sites: Object.keys(hello.sites), wanted: null, told: 0 });
    this.triangle = this.sites.length === 3;
    svg.toggleAttribute("hidden", !this.triangle);
    if (!this.triangle) svg.style.display = "none";
    rows.replaceChildren(...this.sites.map(() => document.createElement("span")));
    if (this.triangle) this.build();
  }

  build() {
    const { svg } = this;
    element(svg, "polygon", { class: "edge", points: CORNERS.map((corner) => corner.join(",")).join(" ") });
    this.rays = this.sites.map(() => element(svg, "line", { class: "ray" }));
    this.sites.forEach((site, n) => {
      const [x, y] = CORNERS[n];
      const text = element(svg, "text", { x: 1.09 * x, y: y + (y > 0 ? 18 : -8) });
      text.textContent = site;
      text.style.fill = siteColour(this.about[site]);
    });
    this.knobs = this.sites.map((site, n) => this.knob(`site-${n}`, 7, (at) => this.edge(n, at), `row of ${site}`));
    this.knobs.forEach((knob, n) => { knob.mark.style.fill = siteColour(this.about[this.sites[n]]); });
    this.all = this.knob("all", 9, (at) => this.inside(at), "all rows");
  }

  knob(name, radius, take, label) {
    const group = element(this.svg, "g", { tabindex: 0, role: "slider", "aria-label": label, "aria-valuetext": "", "aria-valuemin": 0, "aria-valuemax": 1, "aria-valuenow": 0 });
    element(group, "circle", { class: "hit", r: 18 });
    const mark = element(group, "circle", { class: `knob ${name}`, r: radius });
    const word = element(group, "text", { class: "whose", x: 0, y: -11 });
    word.textContent = label.startsWith("row of ") ? label.slice(7) : "";
    const knob = { group, mark, at: [0, 0], held: false };
    const place = (event) => {
      const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
      return [point.x, point.y];
    };
    group.addEventListener("pointerdown", (event) => {
      if (!this.page.takesPart) return;
      knob.held = true;
      group.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    group.addEventListener("pointermove", (event) => { if (knob.held) { take(place(event)); this.tell(); } });
    for (const kind of ["pointerup", "pointercancel"]) {
      group.addEventListener(kind, () => { if (knob.held) { knob.held = false; this.tell(true); } });
    }
    group.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-6, 0], ArrowRight: [6, 0], ArrowUp: [0, -6], ArrowDown: [0, 6] }[event.key];
      if (!step || !this.page.takesPart) return;
      event.preventDefault();
      event.stopPropagation();
      take([knob.at[0] + step[0], knob.at[1] + step[1]]);
      this.tell(true);
    });
    return knob;
  }

  others(n) { return [0, 1, 2].filter((m) => m !== n); }

  edge(n, at) { // where on the edge between the two others
    const [j, k] = this.others(n);
    const [a, b] = [CORNERS[j], CORNERS[k]];
    const along = [b[0] - a[0], b[1] - a[1]];
    const x = ((at[0] - a[0]) * along[0] + (at[1] - a[1]) * along[1]) / (along[0] ** 2 + along[1] ** 2);
    this.want(n, Math.max(0, Math.min(1, 1 - x)));
  }

  inside(at) {
    const [a, b, c] = CORNERS;
    const area = (p, q, r) => (q[0] - p[0]) * (r[1] - p[1]) - (r[0] - p[0]) * (q[1] - p[1]);
    const whole = area(a, b, c);
    let weights = [area(at, b, c), area(a, at, c), area(a, b, at)].map((part) => Math.max(KEEP, part / whole));
    const sum = weights.reduce((x, y) => x + y);
    weights = weights.map((x) => x / sum);
    for (let n = 0; n < 3; n++) {
      const [j, k] = this.others(n);
      this.want(n, weights[j] / (weights[j] + weights[k]));
    }
  }

  want(n, first) {
    const share = Math.round(1e4 * first) / 1e4;
    const [j, k] = this.others(n);
    this.wanted = { ...(this.wanted || {}), [this.sites[n]]: { [this.sites[j]]: share, [this.sites[k]]: Math.round(1e4 * (1 - share)) / 1e4 } };
  }

  tell(now = false) {
    if (!this.wanted || (!now && performance.now() - this.told < EVERY_MS)) return;
    this.told = performance.now();
    for (const [site, to] of Object.entries(this.wanted)) this.send({ do: "shares", site, to });
    if (now) this.until = performance.now() + 700;
  }

  draw(frame) {
    const held = this.triangle && [...this.knobs, this.all].some((knob) => knob.held);
    if (!held && this.wanted && performance.now() > (this.until || 0)) this.wanted = null;
    const rows = { ...frame.shares, ...(this.wanted || {}) };
    const text = JSON.stringify(rows) + this.page.takesPart;
    if (text === this.shown) return;
    this.shown = text;
    this.sites.forEach((site, n) => {
      const parts = Object.entries(rows[site] || {}).filter(([, share]) => share > 0);
      this.rows.children[n].textContent = `${site} follows ${parts.map(([peer, share]) => `${peer} ${share.toFixed(2)}`).join(" + ") || "nobody"}`;
    });
    if (!this.triangle) return;
    this.svg.classList.toggle("fixed", !this.page.takesPart);
    const spots = this.sites.map((site, n) => {
      const [j, k] = this.others(n);
      const share = rows[site]?.[this.sites[j]] ?? 0;
      return CORNERS[j].map((x, axis) => share * x + (1 - share) * CORNERS[k][axis]);
    });
    this.knobs.forEach((knob, n) => {
      this.move(knob, spots[n], this.rows.children[n].textContent);
      knob.group.setAttribute("aria-valuenow", (rows[this.sites[n]]?.[this.sites[this.others(n)[0]]] ?? 0).toFixed(2));
    });
    this.rays.forEach((ray, n) => {
      const [[x1, y1], [x2, y2]] = [CORNERS[n], spots[n]];
      for (const [name, value] of Object.entries({ x1, y1, x2, y2 })) ray.setAttribute(name, value);
    });
    const meets = [[0, 1], [1, 2], [0, 2]].map(([n, m]) => cross(CORNERS[n], spots[n], CORNERS[m], spots[m])).filter(Boolean);
    const middle = meets.length ? [0, 1].map((axis) => meets.reduce((sum, point) => sum + point[axis], 0) / meets.length) : [0, 26];
    const loose = meets.some((point) => Math.hypot(point[0] - middle[0], point[1] - middle[1]) > 3) || meets.length < 3;
    this.all.mark.setAttribute("class", `knob all${loose ? " loose" : ""}`);
    this.move(this.all, middle, "");
  }

  move(knob, at, text) {
    knob.at = at;
    knob.group.setAttribute("transform", `translate(${at[0].toFixed(1)} ${at[1].toFixed(1)})`);
    knob.group.setAttribute("aria-valuetext", text);
  }
}

function cross(a, b, c, d) { // where the lines a-b and c-d meet
  const [rx, ry, sx, sy] = [b[0] - a[0], b[1] - a[1], d[0] - c[0], d[1] - c[1]];
  const turn = rx * sy - ry * sx;
  if (Math.abs(turn) < 1e-6) return null;
  const x = ((c[0] - a[0]) * sy - (c[1] - a[1]) * sx) / turn;
  return x < -0.01 || x > 1.01 ? null : [a[0] + x * rx, a[1] + x * ry];
}
