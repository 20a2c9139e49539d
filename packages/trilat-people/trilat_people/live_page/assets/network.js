// The links: samples under way, numbers, and how to change them.
import { css, siteColour, sizeOf } from "./arms.js";

const $ = (id) => document.getElementById(id);
const PRESETS = [["none", 0], ["100 ms", 100], ["300 ms", 300], ["900 ms", 900]];
const NETWORKS = ["lan", "wifi", "5g", "4g", "geo", "frankfurt-newyork", "frankfurt-bangalore", "london-sydney", "sf-shanghai", "sf-bangalore", "sf-buenos_aires"];
const number = (value, digits = 0) => (value === null || value === undefined ? "–" : value.toFixed(digits));

function describeLink({ model, delay_ms: delay, deviation_ms: deviation, loss, floor_ms: floor, fast_ms: fast, slow_ms: slow, slow_share: share }) {
  let text = model;
  if (model === "constant") text = `${delay} ms`;
  else if (model === "none") text = "none";
  else if (delay !== undefined) text = deviation ? `${delay} ± ${deviation} ms` : `${delay} ms, ${model}`;
  else if (floor !== undefined) text = `≥ ${floor} ms, mean ${number(floor + (1 - share) * fast + share * slow)} ms`;
  return loss ? `${text}, ${(100 * loss).toFixed(0)} % lost` : text;
}

export class Network {
  constructor(hello, send, page) {
    Object.assign(this, { hello, send, page });
    this.sites = Object.keys(hello.sites);
    this.links = Object.keys(hello.links);
    this.rows = Object.fromEntries(this.links.map((name) => {
      const row = $("link-table").tBodies[0].insertRow();
      return [name, Array.from({ length: 6 }, () => row.insertCell())];
    }));
    this.canvas = $("links");
    this.form();
  }

  form() {
    const which = $("link-which");
    which.add(new Option("every link", ""));
    for (const name of this.links) which.add(new Option(name.replace("->", " → "), name));
    for (const name of NETWORKS) $("link-preset").add(new Option(name, name));
    for (const [label, delay] of PRESETS) {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: label });
      button.dataset.delay = delay;
      button.addEventListener("click", () => { $("link-delay").value = delay; $("link-preset").value = ""; this.shown(); this.order(); });
      $("link-presets").append(button);
    }
    for (const id of ["link-delay", "link-jitter", "link-loss"]) {
      $(id).addEventListener("input", () => { $("link-preset").value = ""; this.shown(); });
      $(id).addEventListener("change", () => this.order());
    }
    $("link-preset").addEventListener("change", () => { if ($("link-preset").value) this.order(); });
    which.addEventListener("change", () => this.follow(true));
    $("link-form").addEventListener("submit", (event) => event.preventDefault());
  }

  shown() {
    for (const [id, unit] of [["link-delay", "ms"], ["link-jitter", "ms"], ["link-loss", "%"]]) {
      $(id).nextElementSibling.textContent = `${$(id).value} ${unit}`;
    }
  }

  follow(always = false) { // the form shows what is, unless somebody is at it
    if (!always && (document.activeElement?.closest("#link-form") || performance.now() < (this.ordered || 0) + 1500)) return;
    const link = this.page.frame?.links[$("link-which").value || this.links[0]];
    if (!link) return;
    $("link-delay").value = link.stated.delay_ms ?? link.stated.floor_ms ?? 0;
    $("link-jitter").value = link.stated.deviation_ms ?? 0;
    $("link-loss").value = 100 * (link.stated.loss || 0);
    this.shown();
  }

  order() {
    this.ordered = performance.now();
    const preset = $("link-preset").value;
    const values = { delay_ms: Number($("link-delay").value), deviation_ms: Number($("link-jitter").value), loss: Number($("link-loss").value) / 100 };
    const chosen = $("link-which").value;
    for (const link of chosen ? [chosen] : this.links) this.send({ do: "link", link, to: preset ? { preset } : values });
  }

  place(n, width, height) { // as the triangle of dominance: the third on top
    const count = this.sites.length;
    const rx = Math.min(0.5 * width - 34, 1.1 * height);
    if (count === 2) return [width / 2 + (n ? rx : -rx), height / 2];
    if (count === 3) return n === 2 ? [width / 2, 24] : [width / 2 + (n ? rx : -rx), height - 40];
    const angle = Math.PI * (1.25 - (2 * n) / count);
    return [width / 2 + rx * Math.cos(angle), height / 2 - (0.5 * height - 26) * Math.sin(angle)];
  }

  draw(frame) {
    this.follow();
    const { canvas } = this;
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const { width, height } = sizeOf(canvas);
    if (canvas.width !== Math.round(width * ratio)) Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);
    for (const name of this.links) this.link(g, name, frame, width, height);
    this.sites.forEach((site, n) => {
      const [x, y] = this.place(n, width, height);
      g.fillStyle = siteColour(this.hello.sites[site]);
      g.beginPath(); g.arc(x, y, 17, 0, 2 * Math.PI); g.fill();
      g.fillStyle = css("--card");
      g.font = "600 12px system-ui, sans-serif";
      g.textAlign = "center";
      g.textBaseline = "middle";
      g.fillText(site.length > 4 ? site.slice(0, 4) : site, x, y);
    });
    if ((this.turn = ((this.turn ?? -1) + 1) % 6) === 0) for (const name of this.links) this.row(name, frame);
  }

  link(g, name, frame, width, height) {
    const link = frame.links[name];
    const [from, to] = this.hello.links[name].map((site) => this.sites.indexOf(site));
    const [a, b] = [this.place(from, width, height), this.place(to, width, height)];
    const length = Math.hypot(b[0] - a[0], b[1] - a[1]);
    const [ux, uy] = [(b[0] - a[0]) / length, (b[1] - a[1]) / length];
    const bow = 13; // the two directions of a pair lie side by side
    const point = (x) => [a[0] + ux * (20 + x * (length - 40)) - uy * bow, a[1] + uy * (20 + x * (length - 40)) + ux * bow];
    const share = Math.max(0, Math.min(1, link.share));
    const stale = !frame.ended && link.age_ms !== null && link.age_ms > 1.6 * (link.stated.delay_ms || 0) + 400;
    g.strokeStyle = stale ? css("--bad") : css("--line");
    g.lineWidth = 1.5 + 5 * share;
    g.globalAlpha = share > 0 ? 1 : 0.5;
    g.lineCap = "round";
    g.beginPath(); g.moveTo(...point(0)); g.lineTo(...point(1)); g.stroke();
    if (link.age_ms === null) { g.globalAlpha = 1; return; }
    const age = Math.max(link.age_ms / 1000, 0.001);
    const every = Math.max(0.02, age / 24); // a dot stands for the samples of at least 20 ms
    const loss = link.stated.loss || 0;
    g.fillStyle = siteColour(this.hello.sites[this.sites[from]]);
    for (let stamp = Math.ceil((frame.t - age) / every) * every; stamp <= frame.t; stamp += every) {
      const x = (frame.t - stamp) / age;
      const luck = Math.abs(Math.sin(12.9898 * Math.round(stamp / every) + from + 3 * to) * 43758.5453) % 1;
      const lost = luck < loss;
      if (lost && x > 0.5) continue;
      g.globalAlpha = (share > 0 ? 1 : 0.35) * (lost ? 1 - 2 * x : 1);
      g.beginPath(); g.arc(...point(Math.min(1, x)), 2.6, 0, 2 * Math.PI); g.fill();
    }
    g.globalAlpha = 1;
    g.font = "11px system-ui, sans-serif";
    g.fillStyle = stale ? css("--bad") : css("--soft");
    const [x, y] = point(0.5);
    g.textAlign = Math.abs(uy) < 0.3 ? "center" : uy < 0 ? "left" : "right";
    g.textBaseline = "middle";
    g.fillText(`${stale ? "stale, " : ""}${link.age_ms.toFixed(0)} ms`, x - 10 * uy, y + 13 * ux);
  }

  row(name, frame) {
    const link = frame.links[name];
    const lost = link.accepted ? `${((100 * link.lost) / (link.accepted + link.lost)).toFixed(1)} %` : "–";
    const cells = [name.replace("->", " → "), describeLink(link.stated), `${number(link.age_ms)} ms`, String(link.under_way), lost, number(link.share, 2)];
    cells.forEach((text, n) => { if (this.rows[name][n].textContent !== text) this.rows[name][n].textContent = text; });
  }
}
