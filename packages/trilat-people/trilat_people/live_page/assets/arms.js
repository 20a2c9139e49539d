// One card for each arm: where it is, where its peers want it, what its hand and its wall do, and its alarms.
// Bodies are painted by three.js, or on a plain canvas where there is no WebGL; arrows and marks lie on top.
import { PlainPainter } from "./painter2d.js";

const colours = new Map(); // computing a style takes longer than drawing with it
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => colours.clear());
export function css(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return colours.get(name);
}
const sizes = new WeakMap(); // asking an element for its size makes the browser lay out the page at once
const sizer = new ResizeObserver((entries) => { for (const { target, contentRect } of entries) sizes.set(target, contentRect); });
export function sizeOf(element) {
  if (!sizes.has(element)) { sizes.set(element, { width: element.clientWidth, height: element.clientHeight }); sizer.observe(element); }
  return sizes.get(element);
}
export const WORDS_MS = 200; // nobody reads numbers that change more often, and each makes the browser lay out the page
export const siteColour = (about) => css(`--site-${about.colour}`);
const FADE = 15;
const SLOW_MS = 45;
const SLOW_FRAMES = 40;
const MODES = { hold: "HOLDS: peer stale", brake: "BRAKED: peer stale", return: "RETURNS", waiting: "WAITS FOR PEERS", fault: "FAULT", stopped: "STOPPED", diverged: "DIVERGED" };
const element = (parent, tag, name = "") => {
  const made = document.createElement(tag);
  if (name) made.className = name;
  return parent.appendChild(made);
};

export function arrow(g, from, to, colour, width) {
  const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
  const length = Math.hypot(dx, dy);
  if (length < 3) return;
  const head = Math.min(4.2 * width, 0.6 * length);
  const [ux, uy] = [dx / length, dy / length];
  const base = [to[0] - head * ux, to[1] - head * uy];
  g.strokeStyle = g.fillStyle = colour;
  g.lineWidth = width;
  g.lineCap = "butt";
  g.beginPath(); g.moveTo(...from); g.lineTo(...base); g.stroke();
  g.beginPath();
  g.moveTo(...to);
  g.lineTo(base[0] - 0.45 * head * uy, base[1] + 0.45 * head * ux);
  g.lineTo(base[0] + 0.45 * head * uy, base[1] - 0.45 * head * ux);
  g.fill();
}

class ArmCard {
  constructor(parent, name, about, n, count) {
    Object.assign(this, { name, about, n });
    this.card = element(parent, "article", "card arm watched");
    this.card.tabIndex = 0;
    this.card.setAttribute("aria-label", `arm ${name}, ${about.role}`);
    this.canvas = element(this.card, "canvas");
    const head = element(this.card, "div", "head");
    const swatch = element(head, "span", "swatch");
    swatch.style.background = `var(--site-${about.colour})`;
    element(head, "b").textContent = name;
    element(head, "span", "soft").textContent = about.role;
    this.alarms = element(head, "span");
    this.alarms.setAttribute("role", "status");
    this.alarms.style.cssText = "display:contents";
    this.foot = element(this.card, "div", "foot");
    this.foot.dataset.name = name;
    this.card.style.setProperty("--n", n);
    this.card.style.setProperty("--up", count - 1 - n);
    this.view = { centre: this.middle(), half: 0 };
    this.hold = null; // what this page's hand does: { at, to } in the arm's frame
    this.trail = [];
    this.under = true;
    this.nextWords = 0;
  }

  middle() {
    const { start, reach } = this.about;
    const tip = start[start.length - 1];
    const size = Math.hypot(...tip) || 1;
    return tip.map((x) => 0.3 * reach * (x / size));
  }

  chips(site, holds) {
    const list = [];
    if (site.mode === "diverged") list.push([MODES.diverged, "bad"]);
    else if (site.ended) list.push(["ended", ""]);
    else if (site.mode in MODES) list.push([MODES[site.mode], "bad"]);
    if (site.clamped && !site.ended) list.push(["TORQUE LIMIT", "bad"]);
    if (site.hand_limited && !site.ended) list.push(["FORCE LIMIT", "bad"]);
    if (site.silent_s) list.push([`SILENT ${Math.floor(site.silent_s)} s`, "bad"]);
    if (holds && !site.ended) list.push(["you hold it", "good"]);
    else if (site.holder && !site.ended) list.push([this.hold ? `REFUSED: ${site.holder} holds it` : `held by ${site.holder}`, this.hold ? "bad" : "warn"]);
    const text = JSON.stringify(list);
    if (text !== this.shown) {
      this.shown = text;
      this.alarms.replaceChildren(...list.map(([words, kind]) => {
        const chip = document.createElement("span");
        chip.className = `chip ${kind}`;
        chip.textContent = words;
        return chip;
      }));
    }
    this.card.classList.toggle("alarm", list.some(([, kind]) => kind === "bad"));
  }

  numbers(site) {
    if (performance.now() < this.nextWords) return;
    this.nextWords = performance.now() + WORDS_MS;
    const size = (force) => Math.hypot(...force);
    const parts = [];
    if (site.e !== undefined) {
      parts.push(["|e|", `${site.e.toFixed(3)} ${this.about.unit}`, "", "how far the arm is from where its peers want it"]);
      parts.push(["τ", `${Math.max(...site.tau.map(Math.abs)).toFixed(1)} N m`, "more", "largest torque of the law at a joint"]);
      if (site.pull.length) parts.push(["law", `${size(site.pull).toFixed(1)} N`, "", "force with which the law pulls the end of the arm, beyond what carries it: what a user feels"]);
      parts.push(["hand", `${size(site.hand).toFixed(1)} N`, "more", "force of its operator on the end of the arm"]);
      if (this.about.walls.length) parts.push(["wall", `${size(site.wall).toFixed(1)} N`, "", "force of the wall on the end of the arm"]);
    }
    if (site.age_ms !== undefined) parts.push(["age", site.age_ms === null ? "–" : `${site.age_ms.toFixed(0)} ms`, "", "how old what is drawn of this arm is"]);
    const text = parts.map(([key, value, kind, tip]) => `<span class="${kind}" data-tip="${tip}">${key} <b>${value}</b></span>`).join("");
    if (text === this.written) return;
    this.written = text;
    const spans = this.foot.children;
    if (spans.length !== parts.length) this.foot.innerHTML = text; // words stay, so that a tip that is read does too
    else parts.forEach(([, value], n) => { spans[n].lastChild.textContent = value; });
  }

  need(site) { // half of the height that the picture must span, m
    const { view } = this;
    const aspect = this.canvas.width / this.canvas.height;
    let needed = 0.56 * this.about.reach;
    const [cx, cy] = this.flat(view.centre);
    const room = 0.14 * this.about.reach; // for the ring at the end
    for (const point of [...site.points, ...(this.needs || []), ...(this.about.task ? [] : site.ghost), ...this.facing(site)]) {
      const [x, y] = this.flat(point);
      needed = Math.max(needed, 1.04 * Math.abs(y - cy) + room, (1.04 * Math.abs(x - cx) + room) / aspect);
    }
    return needed;
  }

  facing(site) { // where the walls that the arm can reach are nearest to its end
    const tip = site.points[site.points.length - 1];
    return this.about.walls.map(({ at, normal }) => {
      const depth = normal.reduce((sum, v, n) => sum + v * (tip[n] - at[n]), 0);
      return tip.map((x, n) => x - depth * normal[n]);
    }).filter((point) => Math.hypot(...point) < 1.1 * this.about.reach);
  }

  fit(needed) {
    const { view } = this;
    const now = performance.now();
    const share = view.half ? 1 - Math.exp((this.fitted - now) / (needed > view.half ? 120 : 4000)) : 1;
    this.fitted = now;
    view.half += share * (needed - view.half);
  }

  flat(point) { // seen from the front: planar arms as they are, chains along their floor
    if (this.about.planar) return point;
    const [ahead, side, up] = this.about.up.map((axis) => axis.reduce((sum, v, n) => sum + v * point[n], 0));
    const across = side * 0.64 + ahead * 0.77;
    return [across, 0.93 * up - 0.37 * (ahead * 0.64 - side * 0.77)];
  }

  size() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const box = sizeOf(this.canvas);
    const [width, height] = [Math.max(1, Math.round(box.width * ratio)), Math.max(1, Math.round(box.height * ratio))];
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    return ratio;
  }

  draw(painter, site, scale, holds, shared) {
    const ratio = this.size();
    if (this.canvas.width < 2) return;
    if (shared) this.view = shared;
    else this.fit(this.need(site));
    const g = this.canvas.getContext("2d");
    const tip = site.points[site.points.length - 1];
    this.trail.push(tip);
    if (this.trail.length > 90) this.trail.shift();
    painter.paint(this, site, g);
    this.project = (point) => painter.project(this, point);
    this.over(g, site, ratio, scale);
    this.chips(site, holds);
    this.numbers(site);
  }

  over(g, site, ratio, scale) {
    const tip = site.points[site.points.length - 1];
    const at = this.project(tip);
    this.tip = at;
    this.extra?.(g, ratio, tip); // of an experiment: its target
    g.lineJoin = "round";
    g.strokeStyle = siteColour(this.about);
    g.lineWidth = 1.5 * ratio;
    const way = this.trail.map((point) => this.project(point));
    for (let n = 1; n < way.length; n += FADE) { // a few paths are drawn sooner than one for each step
      g.globalAlpha = (0.5 * n) / way.length;
      g.beginPath(); g.moveTo(...way[n - 1]);
      for (const point of way.slice(n, n + FADE)) g.lineTo(...point);
      g.stroke();
    }
    g.globalAlpha = 1;
    const said = []; // where words stand: none over another
    const push = (force, colour, label) => {
      const size = Math.hypot(...force);
      if (size < 0.02 * scale) return;
      const length = Math.min(1.6, size / scale) * 0.55 * this.about.reach;
      const end = this.project(tip.map((x, n) => x + (length * (force[n] || 0)) / size));
      arrow(g, at, end, colour, 3.2 * ratio);
      g.textAlign = "left";
      g.font = `600 ${11.5 * ratio}px system-ui, sans-serif`;
      g.fillStyle = colour;
      const words = `${label} ${size.toFixed(size < 10 ? 1 : 0)} N`;
      const wide = g.measureText(words).width;
      const x = end[0] < at[0] ? end[0] - wide - 16 * ratio : end[0] + 16 * ratio;
      let y = Math.max(52 * ratio, end[1] + 4 * ratio);
      while (said.some((other) => Math.abs(other - y) < 13 * ratio)) y += 14 * ratio;
      said.push(y);
      g.fillText(words, Math.max(6 * ratio, Math.min(this.canvas.width - wide - 6 * ratio, x)), y);
    };
    push(site.pull, css("--warn"), "law");
    push(site.wall, css("--bad"), "wall");
    push(site.hand, css("--good"), "hand");
    const around = Math.max(13 * ratio, Math.min(30 * ratio, (0.0325 * this.about.reach * this.canvas.height) / this.view.half)); // its end, as it is drawn
    if (this.scene) { // of arms over each other each says which it is
      const above = around + (5 + 15 * this.n) * ratio;
      g.font = `700 ${12.5 * ratio}px system-ui, sans-serif`;
      g.textAlign = "center";
      g.strokeStyle = siteColour(this.about);
      g.lineWidth = 1.5 * ratio;
      g.beginPath(); g.moveTo(at[0], at[1] - 8 * ratio); g.lineTo(at[0], at[1] - above); g.stroke();
      g.strokeStyle = css("--card");
      g.lineWidth = 3.5 * ratio;
      g.strokeText(this.name, at[0], at[1] - above);
      g.fillStyle = css("--ink");
      g.fillText(this.name, at[0], at[1] - above);
    }
    const target = this.hold?.to || site.target;
    if (target) {
      const to = this.project(target);
      g.strokeStyle = css("--good");
      g.lineWidth = 1.5 * ratio;
      g.setLineDash([4 * ratio, 3 * ratio]);
      g.beginPath(); g.moveTo(...at); g.lineTo(...to); g.stroke();
      g.setLineDash([]);
      g.beginPath(); g.arc(...to, 8 * ratio, 0, 2 * Math.PI); g.stroke();
    } else if (this.graspable) {
      g.beginPath(); g.arc(...at, around, 0, 2 * Math.PI);
      g.lineWidth = (this.near ? 6 : 4) * ratio; // a rim, so that it is seen on the arm too
      g.strokeStyle = css("--card");
      g.stroke();
      g.lineWidth = (this.near ? 3 : 1.5) * ratio;
      g.strokeStyle = css("--ink");
      g.stroke();
    }
  }
}

export class Arms {
  constructor(parent, hello, say) {
    const sites = Object.entries(hello.sites);
    this.cards = sites.map(([name, about], n) => new ArmCard(parent, name, about, n, sites.length));
    this.byName = Object.fromEntries(this.cards.map((card) => [card.name, card]));
    const slave = sites.find(([, about]) => about.role === "slave")?.[0];
    const main = (hello.stage && slave) || hello.as || slave || sites.at(-1)[0];
    this.byName[main].card.classList.add("main"); // where an experiment's task is, a user's own arm, or where the work is done
    parent.classList.toggle("three", sites.length === 3 && !hello.stage);
    parent.classList.toggle("task", Boolean(hello.stage) && sites.length > 1);
    parent.style.setProperty("--others", Math.max(1, sites.length - 1));
    this.parent = parent;
    this.shared = null;
    for (const kind of ["pointermove", "pointerdown"]) parent.addEventListener(kind, (event) => this.raise(event), true);
    this.painter = new PlainPainter();
    this.scale = 10;
    say("drawn flat until WebGL is there");
    this.say = say;
    this.wishes = new URLSearchParams(location.search); // ?flat, or ?webgl however slow it is
    if (this.wishes.has("flat")) return say("drawn flat, as asked");
    import("./painter3d.js").then(({ makeScenePainter }) => {
      const painter = makeScenePainter(this.cards, this.wishes.has("webgl"));
      if (painter) this.painter = painter;
      say(painter ? "drawn with WebGL" : "no WebGL, or none with a graphics card: drawn flat");
    }).catch((error) => say(`no WebGL here (${error.message}): drawn flat`));
  }

  together(on) { // all arms in one frame, their fields over each other
    this.parent.classList.toggle("together", on);
    this.shared = on ? { centre: [], half: 0 } : null;
    for (const card of this.cards) {
      card.scene = on;
      card.under = !on || card.n === 0; // the ground is drawn once
      card.card.style.zIndex = "";
      card.trail = [];
      if (!on) card.view = { centre: card.middle(), half: 0 };
    }
  }

  fitAll(frame) {
    const middles = this.cards.map((card) => card.middle());
    this.shared.centre = middles[0].map((_, axis) => middles.reduce((sum, middle) => sum + middle[axis], 0) / middles.length);
    for (const card of this.cards) { card.view = this.shared; card.size(); }
    this.cards[0].fit(Math.max(...this.cards.map((card) => card.need(frame.sites[card.name]))));
  }

  raise(event) { // in one scene a pointer means the arm whose end is nearest
    if (!this.shared || event.buttons > (event.type === "pointerdown" ? 1 : 0) || this.passing || this.cards.some((card) => card.hold)) return;
    const way = (card) => {
      const box = card.canvas.getBoundingClientRect();
      const ratio = card.canvas.width / box.width;
      const [x, y] = card.tip || [0, 0];
      return Math.hypot((event.clientX - box.left) * ratio - x, (event.clientY - box.top) * ratio - y) + (card.graspable ? 0 : 1e6);
    };
    const [nearest] = [...this.cards].sort((a, b) => way(a) - way(b));
    for (const card of this.cards) card.card.style.zIndex = card === nearest ? 1 : "";
    if (event.type !== "pointerdown" || nearest.canvas === event.target || event.target.tagName !== "CANVAS") return;
    event.stopPropagation(); // a finger has not moved there before
    this.passing = true;
    nearest.canvas.dispatchEvent(new PointerEvent("pointerdown", event));
    this.passing = false;
  }

  pace(took) { // a machine without a graphics card draws bodies too slowly to feel an arm
    this.slow = took > SLOW_MS ? (this.slow || 0) + 1 : 0;
    if (this.slow < SLOW_FRAMES || this.painter instanceof PlainPainter || this.wishes.has("webgl")) return;
    this.painter = new PlainPainter();
    this.say("WebGL is slow here: drawn flat");
  }

  draw(frame) {
    // one scale for all forces, so that they compare: the largest of late, in round steps
    const sizes = Object.values(frame.sites).flatMap((site) => [Math.hypot(...site.hand), Math.hypot(...site.wall), Math.hypot(...site.pull)]);
    this.most = Math.max(5, ...sizes, 0.995 * (this.most || 0));
    this.scale = [5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 1e4].find((step) => step >= 0.9 * this.most) || 1e4;
    const begun = performance.now();
    this.painter.begin?.();
    if (this.shared) this.fitAll(frame);
    for (const card of this.cards) card.draw(this.painter, frame.sites[card.name], this.scale, frame.holds.includes(card.name), this.shared);
    this.pace(performance.now() - begun);
  }
}
