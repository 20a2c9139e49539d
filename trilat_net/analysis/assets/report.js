// Draws the charts and the arms of a report from the data in the page. One time axis for all of them.
(() => {
  "use strict";
  const page = JSON.parse(document.getElementById("data").textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const tables = page.tables.map((table) => ({
    t: Array.from(new Int32Array(bytes(table.tick)), (k) => k / table.rate_hz),
    columns: table.columns.map((column) =>
      Array.from(new Float32Array(bytes(column)), (v) => (Number.isNaN(v) ? null : v))),
  }));

  const darkQuery = matchMedia("(prefers-color-scheme: dark)");
  let printing = false;
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const isDark = () => darkQuery.matches && !printing;
  const colour = (index) => {
    if (index === "limit") return isDark() ? "#a0a7b3" : "#444444";
    const palette = isDark() ? page.colours.dark : page.colours.light;
    return palette[index % palette.length];
  };
  const ink = () => (isDark() ? "#e8eaed" : "#1c1e21");
  const grid = () => (isDark() ? "#33383f" : "#e3e5e9");
  const dashOf = (series) => {
    if (series.dash) return [5, 3];
    const round = Math.floor(series.colour / page.colours.light.length);
    return round ? [8 / round, 3] : undefined;
  };
  const number = (v, unit) => (v == null ? "–" : `${Number(v.toPrecision(4))} ${unit}`);

  // Where sites have rates of their own, a row of the joined table holds values of some series only.
  const nearest = (u, seriesIndex, index) => {
    const column = u.data[seriesIndex];
    if (seriesIndex === 0 || column[index] !== undefined) return index;
    for (let step = 1; step < 64; step++) {
      if (column[index - step] !== undefined) return index - step;
      if (column[index + step] !== undefined) return index + step;
    }
    return index;
  };

  let plots = [];
  let timePlots = [];
  let zoom = [0, page.end_s];
  let zooming = false;

  function zoomAll(min, max) {
    if (zooming) return;
    zooming = true;
    zoom = [min, max];
    timePlots.forEach((plot) => plot.setScale("x", { min, max }));
    zooming = false;
  }

  const axis = (label, extra) => ({
    label, stroke: ink(), labelSize: 18, labelFont: "12px system-ui, sans-serif", font: "11px system-ui, sans-serif",
    grid: { stroke: grid(), width: 1 }, ticks: { stroke: grid(), width: 1, size: 4 }, ...extra,
  });

  function horizontals(lines) {
    return (u) => {
      const { ctx, bbox } = u;
      ctx.save();
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
      ctx.setLineDash([6 * devicePixelRatio, 3 * devicePixelRatio]);
      ctx.lineWidth = devicePixelRatio;
      for (const line of lines) {
        const y = u.valToPos(line.value, "y", true);
        ctx.strokeStyle = colour(line.colour);
        ctx.beginPath();
        ctx.moveTo(bbox.left, y);
        ctx.lineTo(bbox.left + bbox.width, y);
        ctx.stroke();
      }
      ctx.restore();
    };
  }

  function timeData(chart) {
    const parts = new Map();
    for (const series of chart.series) {
      if (!parts.has(series.table)) parts.set(series.table, []);
      parts.get(series.table).push(series);
    }
    const aligned = [...parts].map(([table, members]) =>
      [tables[table].t, ...members.map((series) => tables[table].columns[series.column])]);
    return [aligned.length > 1 ? uPlot.join(aligned) : aligned[0], [...parts.values()].flat()];
  }

  function timeChart(chart, box) {
    const [data, order] = timeData(chart);
    const lines = chart.lines || [];
    const range = (u, min, max) => {
      const values = lines.map((line) => line.value);
      let low = Math.min(min ?? 0, ...values, ...(chart.zero ? [0] : []));
      let high = Math.max(max ?? 1, ...values);
      const pad = Math.max(0.06 * (high - low), (chart.margin || 0) * high) || 0.1 * Math.abs(high) || 0.1;
      return [chart.zero ? low : low - pad, high + pad];
    };
    const shared = order.length > 1 && !order.some((series) => series.dash);
    const options = {
      width: box.clientWidth, height: 210, padding: [8, 10, 0, 0],
      scales: { x: { time: false, range: (u, min, max) => (min == null ? zoom : [min, max]) }, y: { range } },
      cursor: {
        drag: { x: true, y: false }, points: { size: 6 }, dataIdx: nearest,
        sync: { key: "time", scales: ["x", null], setSeries: false,
          filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
        bind: { dblclick: () => () => { zoomAll(0, page.end_s); return null; } },
      },
      series: [
        { label: "t", value: (u, v) => (v == null ? "–" : `${v.toFixed(3)} s`) },
        ...order.map((series, n) => ({
          label: series.label, stroke: colour(series.colour), dash: dashOf(series), points: { show: false }, pxAlign: 0,
          width: shared ? 2.4 - (1.3 * n) / (order.length - 1) : series.dash ? 1.1 : 1.8,
          value: (u, v) => number(v, chart.unit),
        })),
      ],
      axes: [axis("time (s)", { size: 30 }), axis(`${chart.unit}`, { size: 52 })],
      hooks: {
        drawAxes: [horizontals(lines)],
        setScale: [(u, key) => { if (key === "x" && u.ready) zoomAll(u.scales.x.min, u.scales.x.max); }],
        setCursor: [(u) => { if (u.cursor.event && u.cursor.left >= 0) show(u.posToVal(u.cursor.left, "x")); }],
      },
    };
    const plot = new uPlot(options, data, box);
    plot.setScale("x", { min: zoom[0], max: zoom[1] });
    plot.ready = true;
    timePlots.push(plot);
    return plot;
  }

  function histogram(chart, box) {
    const log = { distr: 3 };
    const closed = (counts) => [...counts.map((c) => (c > 0 ? c : 0.5)), 0.5];
    const top = Math.max(1, ...chart.series.flatMap((series) => series.counts));
    const verticals = (u) => {
      const { ctx, bbox } = u;
      ctx.save();
      ctx.setLineDash([6 * devicePixelRatio, 3 * devicePixelRatio]);
      ctx.strokeStyle = colour("limit");
      ctx.lineWidth = devicePixelRatio;
      for (const period of chart.periods) {
        const x = u.valToPos(period, "x", true);
        if (x > bbox.left + bbox.width) continue;
        ctx.beginPath();
        ctx.moveTo(x, bbox.top);
        ctx.lineTo(x, bbox.top + bbox.height);
        ctx.stroke();
      }
      ctx.restore();
    };
    const decades = (u, splits) => splits.map((v) => (Number.isInteger(Math.log10(v)) ? v.toLocaleString("en") : ""));
    return new uPlot({
      width: box.clientWidth, height: 210, padding: [8, 16, 0, 0],
      scales: {
        x: { time: false, ...log, range: [1, chart.edges[chart.edges.length - 1]] },
        y: { ...log, range: [0.7, top * 1.6] },
      },
      cursor: { drag: { x: false, y: false }, points: { show: false } },
      series: [
        { label: "from", value: (u, v) => (v == null ? "–" : `${Number(v.toPrecision(3))} ${chart.unit}`) },
        ...chart.series.map((series, n) => ({
          label: series.label, stroke: colour(series.colour), width: 2.2 - (1.2 * n) / Math.max(1, chart.series.length - 1),
          dash: dashOf(series), paths: uPlot.paths.stepped({ align: 1 }), points: { show: false },
          value: (u, v) => (v == null ? "–" : `${v < 1 ? 0 : v} ticks`),
        })),
      ],
      axes: [axis(`${chart.unit}; dashed: one period`, { size: 30, values: decades }),
        axis("ticks (count)", { size: 52, values: decades })],
      hooks: { draw: [verticals] },
    }, [chart.edges, ...chart.series.map((series) => closed(series.counts))], box);
  }

  const boxes = page.charts.map((chart) => {
    const figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    caption.textContent = `${chart.title} (${chart.unit})`;
    const box = document.createElement("div");
    figure.append(caption, box);
    document.querySelector(`[data-section="${chart.section}"]`).append(figure);
    return box;
  });

  function build() {
    plots.forEach((plot) => plot.destroy());
    timePlots = [];
    plots = page.charts.map((chart, n) => (chart.edges ? histogram : timeChart)(chart, boxes[n]));
  }

  // ---- the arms at a time
  const SVG = "http://www.w3.org/2000/svg";
  const row = document.querySelector("#arms .row");
  const slider = document.querySelector("#arms input");
  const clock = document.querySelector("#arms output");
  const button = document.querySelector("#arms button");
  const [left, right, bottom, top] = page.bounds_m;
  row.style.gridTemplateColumns = `repeat(${page.arms.length}, 1fr)`;
  const element = (parent, name, attributes) => {
    const made = document.createElementNS(SVG, name);
    Object.entries(attributes).forEach(([key, value]) => made.setAttribute(key, value));
    parent.append(made);
    return made;
  };
  const drawn = page.arms.map((arm) => {
    const cell = document.createElement("div");
    const name = document.createElement("span");
    name.textContent = arm.site;
    cell.append(name);
    row.append(cell);
    const svg = element(cell, "svg", { viewBox: `${left} ${-top} ${right - left} ${top - bottom}`, role: "img",
      "aria-label": arm.site });
    element(svg, "line", { class: "ground", x1: left, x2: right, y1: 0, y2: 0 });
    const desired = element(svg, "polyline", { class: "desired" });
    const actual = element(svg, "polyline", { class: `arm site-${arm.colour}` });
    const joints = [0, 1].map(() => element(svg, "circle", { class: `joint fill-${arm.colour}`, r: 0.055 }));
    element(svg, "rect", { class: "base", x: -0.05, y: -0.05, width: 0.1, height: 0.1 });
    return { arm, desired, actual, joints };
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
  function show(time) {
    const now = Math.max(0, Math.min(page.end_s, time));
    slider.value = (1000 * now) / page.end_s;
    clock.textContent = `${now.toFixed(3)} s`;
    for (const { arm, desired, actual, joints } of drawn) {
      const q = at(arm.table, now) || [NaN, NaN, NaN, NaN];
      const known = !Number.isNaN(q[0]);
      const points = bends(arm.links_m, q[0], q[1]);
      actual.setAttribute("points", known ? `0,0 ${points.join(" ")}` : "");
      desired.setAttribute("points", known ? `0,0 ${bends(arm.links_m, q[2], q[3]).join(" ")}` : "");
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
  button.addEventListener("click", () => {
    if (started !== null) return stop();
    const from = (slider.value / 1000) * page.end_s;
    started = performance.now() - 1000 * (from >= 0.999 * page.end_s ? 0 : from);
    button.textContent = "stop";
    requestAnimationFrame(frame);
  });
  slider.addEventListener("input", () => { stop(); show((slider.value / 1000) * page.end_s); });

  build();
  show(0);
  let pending = 0;
  addEventListener("resize", () => {
    clearTimeout(pending);
    pending = setTimeout(() => plots.forEach((plot, n) => plot.setSize({ width: boxes[n].clientWidth, height: 210 })), 120);
  });
  darkQuery.addEventListener("change", build);
  addEventListener("beforeprint", () => { printing = true; build(); });
  addEventListener("afterprint", () => { printing = false; build(); });
  window.trilat = { plots: () => timePlots, show }; // for the console
})();
