// Streaming plots of the last seconds: errors, torques, forces of hands and walls, ages, and V.
import { css, siteColour, sizeOf } from "./arms.js";

const SPAN_S = 20;
const KEPT = 1500;
const LEAST = { rad: 0.01, m: 0.001, "N m": 1, N: 1, ms: 10, J: 0.1 };
const EVERY_MS = 66;
const font = (ratio) => `600 ${11 * ratio}px system-ui, sans-serif`; // of labels

class Plot {
  constructor(parent, title, unit, series, note = "", words = "") {
    this.series = series;
    this.least = LEAST[unit] || 1e-3; // what is less is drawn as nothing
    this.card = document.createElement("figure");
    this.card.className = "card plot";
    this.card.setAttribute("aria-label", `${title}, ${unit}: ${series.map(({ label }) => label).join(", ")}`);
    const head = this.card.appendChild(document.createElement("h2"));
    head.textContent = `${title} (${unit})`;
    if (words) {
      const more = head.appendChild(document.createElement("span"));
      more.className = "soft";
      more.textContent = words;
    }
    this.box = this.card.appendChild(document.createElement("div"));
    this.note = this.card.appendChild(document.createElement("p"));
    this.note.className = "soft";
    this.say(note);
    parent.append(this.card);
    this.data = [[], ...series.map(() => [])];
    this.build();
  }

  say(text) { this.note.textContent = text; this.note.hidden = !text; this.box.hidden = Boolean(text); }

  build() {
    this.plot?.destroy();
    const axis = (size) => ({ stroke: css("--soft"), font: "11px system-ui, sans-serif", size, grid: { stroke: css("--grid"), width: 1 }, ticks: { show: false } });
    const range = (u, low, high) => {
      if (low === null || low === undefined) return [0, 1];
      const [bottom, top] = [Math.min(0, low), Math.max(high, this.least)];
      return [bottom < 0 ? bottom - 0.06 * (top - bottom) : 0, top + 0.1 * (top - bottom)];
    };
    this.plot = new uPlot({
      width: Math.max(sizeOf(this.box).width, 120), height: 132, padding: [6, this.room(), 0, 0], legend: { show: false }, cursor: { show: false },
      scales: { x: { time: false, range: () => [this.now - SPAN_S, this.now] }, y: { range } },
      axes: [{ ...axis(22), values: (u, splits) => splits.map((v) => (v < 0 ? "" : `${v} s`)) }, { ...axis(46), space: 20 }],
      series: [{}, ...this.series.map(({ colour, dash, width = 1.6 }) => ({
        stroke: css(colour), width, dash: dash ? [5, 3] : undefined, points: { show: false }, pxAlign: 0, spanGaps: false,
      }))],
      hooks: { draw: [(u) => this.label(u)] },
    }, this.data, this.box);
  }

  room() { // for the labels at the ends, px
    const ruler = document.createElement("canvas").getContext("2d");
    ruler.font = font(1);
    return 14 + Math.max(...this.series.map(({ label }) => ruler.measureText(label).width));
  }

  label(u) { // a line is named at its end, so that no colour has to tell it
    const ratio = devicePixelRatio || 1;
    const { ctx, bbox } = u;
    const ends = this.series.flatMap(({ label, colour }, n) => {
      const column = u.data[n + 1];
      const last = column.findLastIndex((value) => value !== null && value !== undefined);
      return last < 0 ? [] : [{ label, colour, y: u.valToPos(column[last], "y", true) }];
    }).sort((a, b) => a.y - b.y);
    const gap = 12 * ratio;
    ends.forEach((end, n) => { end.at = Math.max(end.y, n ? ends[n - 1].at + gap : -Infinity); });
    const over = ends.length ? ends.at(-1).at - (bbox.top + bbox.height) : 0;
    if (over > 0) for (let n = ends.length - 1, most = bbox.top + bbox.height; n >= 0; n--, most -= gap) ends[n].at = Math.min(ends[n].at, most);
    ctx.save();
    ctx.font = font(ratio);
    ctx.textAlign = "left";
    ctx.textBaseline = "middle";
    const x = bbox.left + bbox.width;
    for (const { label, colour, y, at } of ends) {
      ctx.strokeStyle = css(colour);
      ctx.lineWidth = ratio;
      ctx.beginPath(); ctx.moveTo(x, y); ctx.lineTo(x + 6 * ratio, at); ctx.stroke();
      ctx.fillStyle = css("--ink");
      ctx.fillText(label, x + 8 * ratio, at);
    }
    ctx.restore();
  }

  add(row) {
    this.data.forEach((column, n) => { column.push(row[n]); if (column.length > KEPT) column.splice(0, column.length - KEPT); });
  }

  draw(now) {
    if (this.box.hidden || !this.data[0].length) return;
    this.now = now;
    const width = Math.max(sizeOf(this.box).width, 120);
    if (width !== this.plot.width) this.plot.setSize({ width, height: 132 });
    this.plot.setData(this.data);
  }
}

export class Plots {
  constructor(parent, hello, page) {
    this.page = page;
    this.columns = hello.columns;
    const sites = Object.keys(hello.sites);
    const column = (name) => 1 + this.columns.indexOf(name);
    const per = (kind, extra = {}) => sites.map((site) => ({ label: site, colour: `--site-${hello.sites[site].colour}`, from: column(`${site}.${kind}`), ...extra }));
    const unit = hello.sites[sites[0]].unit;
    const walled = sites.filter((site) => hello.sites[site].walls.length);
    const walls = walled.map((site) => ({ label: `wall ${site}`, colour: `--site-${hello.sites[site].colour}`, dash: true, from: column(`${site}.wall`) }));
    const links = Object.entries(hello.links).map(([name, [from, to]]) => ({
      label: name.replace("->", "→"), colour: `--site-${hello.sites[from].colour}`, dash: sites.indexOf(to) > sites.indexOf(from), from: column(`${name}.age`),
    }));
    this.streams = [
      [new Plot(parent, "error |e|", unit, per("e")), per("e")],
      [new Plot(parent, "largest torque", "N m", per("tau")), per("tau")],
      [new Plot(parent, "force of hands", "N", [...per("hand"), ...walls]), [...per("hand"), ...walls]],
      [new Plot(parent, "age of samples in use", "ms", links), links],
    ].map(([plot, series]) => ({ plot, from: series.map((one) => one.from) }));
    this.energy = new Plot(parent, "V", "J", [
      { label: "V", colour: "--ink", width: 2 }, { label: "V − given", colour: "--accent", dash: true },
    ], "V follows from every record, a moment later", "dashed: less what hands and walls gave; it must not rise");
    this.energy.card.classList.add("wide");
    this.drawn = 0;
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      for (const { plot } of [...this.streams, { plot: this.energy }]) plot.build();
    });
  }

  take(frame) {
    for (const row of frame.points) for (const { plot, from } of this.streams) plot.add([row[0], ...from.map((n) => row[n])]);
    for (const [t, V, supplied] of frame.energies) {
      this.energy.add([t, V, V - supplied]);
      this.page.energies.push([t, V, supplied]);
    }
    if (this.page.energies.length > 4000) this.page.energies.splice(0, 1000);
    if (frame.energy) this.energy.say(`no V: ${frame.energy}`);
    else if (this.energy.box.hidden && frame.energies.length) this.energy.say("");
    this.now = frame.t;
  }

  clear() { for (const { plot } of [...this.streams, { plot: this.energy }]) plot.data = plot.data.map(() => []); }

  draw() {
    const now = performance.now();
    if (now - this.drawn < EVERY_MS) return;
    this.drawn = now;
    for (const { plot } of this.streams) plot.draw(this.now);
    this.energy.draw(this.now);
  }
}
