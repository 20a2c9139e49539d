// Draws the arms of a report at a time: that of the slider, or of the pointer in any chart.
(() => {
  "use strict";
  const { page, tables } = window.trilat;
  const EDGES = 32; // numbers of the path along the edges of a body
  const SVG = "http://www.w3.org/2000/svg";
  const row = document.querySelector("#arms .row");
  if (!row) return; // no site has a record
  const slider = document.querySelector("#arms input");
  const clock = document.querySelector("#arms output");
  const button = document.querySelector("#arms button");
  const [left, right, bottom, top] = page.bounds_m;
  row.style.gridTemplateColumns = `repeat(${page.arms.length}, minmax(0, 1fr))`;
  const element = (parent, name, attributes) => {
    const made = document.createElementNS(SVG, name);
    Object.entries(attributes).forEach(([key, value]) => made.setAttribute(key, value));
    parent.append(made);
    return made;
  };
  const drawn = page.arms.map((arm) => {
    const cell = document.createElement("div");
    const name = document.createElement("span");
    name.textContent = arm.caption;
    cell.append(name);
    row.append(cell);
    const svg = element(cell, "svg", { viewBox: `${left} ${-top} ${right - left} ${top - bottom}`, role: "img",
      "aria-label": arm.caption });
    if (arm.kind === "planar") element(svg, "line", { class: "ground", x1: left, x2: right, y1: 0, y2: 0 });
    const shadow = element(svg, "polyline", { class: "shadow" });
    const desired = element(svg, "polyline", { class: "desired" });
    const actual = element(svg, "polyline", { class: `arm site-${arm.colour}` });
    const bodies = Array.from({ length: arm.bodies }, () => element(svg, "polyline", { class: "body" }));
    const joints = Array.from({ length: arm.kind === "planar" ? 2 : arm.points }, () => element(svg, "circle", { class: `joint fill-${arm.colour}`, r: 0.055 }));
    element(svg, "rect", { class: "base", x: -0.05, y: -0.05, width: 0.1, height: 0.1 });
    return { arm, shadow, desired, actual, joints, bodies };
  });
  const at = (table, time) => {
    const { t, columns } = tables[table];
    if (!t.length || time < t[0]) return null;
    let low = 0;
    let high = t.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (t[middle] <= time) low = middle; else high = middle - 1;
    }
    const next = Math.min(low + 1, t.length - 1);
    const share = next > low ? (time - t[low]) / (t[next] - t[low]) : 0;
    const values = columns.map((column) => column[low] + share * (column[next] - column[low]));
    return columns.some((column) => column[low] === null || column[next] === null) ? null : values;
  };
  const bends = ([l1, l2], q1, q2) => {  // elbow and tip, in SVG whose y grows downwards
    const [x, y] = [l1 * Math.cos(q1), -l1 * Math.sin(q1)];
    return [[x, y], [x + l2 * Math.cos(q1 + q2), y - l2 * Math.sin(q1 + q2)]];
  };
  const places = (arm, q) => {  // of the arm's joints, of its reference's, and of the shadows of a chain
    if (arm.kind === "planar") return [bends(arm.links_m, q[0], q[1]), bends(arm.links_m, q[2], q[3]), []];
    const point = (first, n) => [q[first + 2 * n], -q[first + 2 * n + 1]];
    return [0, 1, 2].map((part) => Array.from({ length: arm.points }, (_, n) => point(2 * arm.points * part, n)));
  };
  const bars = [...document.querySelectorAll(".lead .bar")].map((bar, n) => ({
    lead: page.leads[n], line: bar.querySelector(".now"), words: bar.querySelector("output"),
  }));
  const shareAt = (t, values, time) => { // linear between the points
    const next = t.findIndex((point) => point > time);
    if (next < 1) return values[next < 0 ? values.length - 1 : 0];
    const part = (time - t[next - 1]) / (t[next] - t[next - 1]);
    return values[next - 1] + part * (values[next] - values[next - 1]);
  };
  function showLeads(now) {
    for (const { lead, line, words } of bars) {
      line.setAttribute("x1", now);
      line.setAttribute("x2", now);
      const shares = lead.peers.map((peer, n) => `${peer} ${Math.round(100 * shareAt(lead.t, lead.shares[n], now))} %`);
      words.textContent = shares.join(", ");
    }
  }
  function show(time) {
    const now = Math.max(0, Math.min(page.end_s, time));
    slider.value = (1000 * now) / page.end_s;
    clock.textContent = `${now.toFixed(3)} s`;
    showLeads(now);
    for (const { arm, shadow, desired, actual, joints, bodies } of drawn) {
      const q = at(arm.table, now);
      const known = q !== null;
      const [points, reference, shadows] = known ? places(arm, q) : [[], [], []];
      actual.setAttribute("points", known ? `0,0 ${points.join(" ")}` : "");
      desired.setAttribute("points", known ? `0,0 ${reference.join(" ")}` : "");
      shadow.setAttribute("points", shadows.length ? `0,0 ${shadows.join(" ")}` : "");
      bodies.forEach((body, n) => {
        const edges = known ? q.slice(q.length - EDGES * (bodies.length - n)).slice(0, EDGES) : [];
        body.setAttribute("points", edges.map((v, place) => (place % 2 ? -v : v)).join(" "));
      });
      joints.forEach((joint, n) => {
        joint.setAttribute("visibility", known ? "visible" : "hidden");
        if (known) { joint.setAttribute("cx", points[n][0]); joint.setAttribute("cy", points[n][1]); }
      });
    }
  }
  let started = null;
  function frame(stamp) {
    if (started === null) return;
    const time = (stamp - started) / 1000;
    show(time);
    if (time < page.end_s) requestAnimationFrame(frame); else stop();
  }
  function stop() {
    started = null;
    button.textContent = "play";
  }
  function play() {
    const from = (slider.value / 1000) * page.end_s;
    started = performance.now() - 1000 * (from >= 0.999 * page.end_s ? 0 : from);
    button.textContent = "stop";
    requestAnimationFrame(frame);
  }
  button.addEventListener("click", () => (started === null ? play() : stop()));
  slider.addEventListener("input", () => { stop(); show((slider.value / 1000) * page.end_s); });

  window.trilat.show = (time) => { if (started === null) show(time); };
  show(0);
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) play();
})();
