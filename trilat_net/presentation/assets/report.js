// Draws the charts of a report from the data in the page. One time axis for all of them.
// Every field that is read here is declared in `page_data.py` and always sent.
(() => {
  "use strict";
  const page = JSON.parse(document.getElementById("data").textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const floats = (text) => Array.from(new Float32Array(bytes(text)), (v) => (Number.isNaN(v) ? null : v));
  const tables = page.tables.map((table) => ({
    t: Array.from(new Int32Array(bytes(table.tick)), (k) => k / table.rate_hz),
    columns: table.columns.map(floats),
  }));

  const darkQuery = matchMedia("(prefers-color-scheme: dark)");
  let printing = false;
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const isDark = () => darkQuery.matches && !printing;
  const colour = (index) => {
    if (index === "limit") return css("--soft");
    const palette = isDark() ? page.colours.dark : page.colours.light;
    return palette[index % palette.length];
  };
  const ink = () => css("--ink");
  const grid = () => css("--line");
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

  // Values between two gaps, through which no line leads: they are drawn as points.
  const isolated = (u, seriesIndex) => {
    const column = u.data[seriesIndex];
    const own = column.flatMap((value, index) => (value === undefined ? [] : [index]));
    const known = (place) => place >= 0 && place < own.length && column[own[place]] !== null;
    const alone = own.filter((_, place) => known(place) && !known(place - 1) && !known(place + 1));
    return alone.length ? alone : null;
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

  // Values of a linear axis: two at least, so that the scale of a low chart can be read.
  const levels = (u, index, min, max, increment) => {
    let step = increment;
    const first = () => Math.ceil(min / step - 1e-9);
    const count = () => Math.floor(max / step + 1e-9) - first() + 1;
    for (let halvings = 0; halvings < 4 && count() < 2; halvings += 1) step *= 0.5;
    return Array.from({ length: count() }, (_, n) => (first() + n) * step);
  };
  const written = (u, splits, index, space, increment) => { // as many digits as tell one from the next
    const step = splits[0] != null && splits[1] != null ? splits[1] - splits[0] : increment;
    let digits = 0;
    while (digits < 12 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6) digits += 1;
    return splits.map((v) => (v == null ? "" : v.toFixed(digits)));
  };
  const axis = (label, extra) => ({
    label, values: written, stroke: ink(), labelSize: 18, labelFont: "12px system-ui, sans-serif", font: "11px system-ui, sans-serif",
    grid: { stroke: grid(), width: 1 }, ticks: { stroke: grid(), width: 1, size: 4 }, ...extra,
  });

  const clipped = (u, paint) => {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.lineWidth = devicePixelRatio;
    paint(ctx, bbox, (t) => u.valToPos(t, "x", true));
    ctx.restore();
  };
  const stroke = (ctx, x0, y0, x1, y1) => {
    ctx.beginPath();
    ctx.moveTo(x0, y0);
    ctx.lineTo(x1, y1);
    ctx.stroke();
  };

  // Shades where sites do not follow their peers, and what was changed when.
  function marks(chart) {
    const changes = page.changes.filter((change) => chart.sites.includes(change.site) && (change.link || !chart.links));
    return (u) => clipped(u, (ctx, bbox, x) => {
      for (const [index, mode, from, to] of chart.sites.flatMap((site) => page.spans[site])) {
        ctx.globalAlpha = mode === "return" ? 0.1 : 0.25;
        ctx.fillStyle = colour(index);
        ctx.fillRect(x(from), bbox.top, x(to) - x(from), bbox.height);
      }
      ctx.globalAlpha = 1;
      ctx.setLineDash([devicePixelRatio, 2 * devicePixelRatio]);
      ctx.strokeStyle = ctx.fillStyle = colour("limit");
      ctx.font = `${10 * devicePixelRatio}px system-ui, sans-serif`;
      ctx.textBaseline = "top";
      ctx.textAlign = "left";
      for (const { t, n } of changes) {
        stroke(ctx, x(t), bbox.top, x(t), bbox.top + bbox.height);
        ctx.fillText(n, x(t) + 2 * devicePixelRatio, bbox.top + devicePixelRatio);
      }
    });
  }

  function horizontals(lines) {
    return (u) => clipped(u, (ctx, bbox, x) => {
      ctx.setLineDash([6 * devicePixelRatio, 3 * devicePixelRatio]);
      for (const { value, colour: index, from, to } of lines) {
        const y = u.valToPos(value, "y", true);
        ctx.strokeStyle = colour(index);
        stroke(ctx, x(from), y, x(to), y);
      }
    });
  }

  const EXPAND = 2; // of uPlot.join: nulls fill the rows of other tables beside them
  function timeData(chart) {
    const parts = new Map();
    for (const series of chart.series) {
      if (!parts.has(series.table)) parts.set(series.table, []);
      parts.get(series.table).push(series);
    }
    const aligned = [...parts].map(([table, members]) =>
      [tables[table].t, ...members.map((series) => tables[table].columns[series.column])]);
    const modes = aligned.map((columns) => columns.map(() => EXPAND)); // a gap of one site ends where its next value is
    return [aligned.length > 1 ? uPlot.join(aligned, modes) : aligned[0], [...parts.values()].flat()];
  }

  // Labels of a logarithmic axis: powers of ten, and 2 and 5 times these where there is room.
  const rungs = (u, index, min, max) => {
    const steps = max / min > 300 ? [1] : [1, 2, 5];
    const powers = Array.from({ length: 20 }, (_, n) => n - 9);
    const values = powers.flatMap((power) => steps.map((step) => step * 10 ** power));
    return values.filter((value) => value >= min && value <= max);
  };
  const rungLabels = (u, splits) => splits.map((value) => (value == null ? "" : value < 0.001 ? value.toExponential(0) : `${Number(value.toPrecision(1))}`));

  const tall = (box) => (box.closest(".small") ? 110 : box.closest("#overview") ? 165 : 124);

  function timeChart(chart, box) {
    const [data, order] = timeData(chart);
    const { lines } = chart;
    const range = (u, min, max) => {
      const values = lines.map((line) => line.value);
      if (chart.log) return [0.7 * Math.min(min ?? 1, ...values), 2 * Math.max(max ?? 1, ...values)];
      let low = Math.min(min ?? 0, ...values, ...(chart.zero ? [0] : []));
      let high = Math.max(max ?? 1, ...values);
      const pad = Math.max(0.06 * (high - low), chart.margin * high) || 0.1 * Math.abs(high) || 0.1;
      return [chart.zero ? low : low - pad, high + pad];
    };
    const shared = order.length > 1 && !order.some((series) => series.dash);
    const options = {
      width: box.clientWidth, height: tall(box), padding: [8, 20, 0, 0],
      scales: { x: { time: false, range: (u, min, max) => (min == null ? zoom : [min, max]) }, y: { range, distr: chart.log ? 3 : 1 } },
      cursor: {
        drag: { x: true, y: false }, points: { size: 6 }, dataIdx: nearest,
        sync: { key: "time", scales: ["x", null], setSeries: false,
          filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
        bind: { dblclick: () => () => { zoomAll(0, page.end_s); return null; } },
      },
      series: [
        { label: "t", value: (u, v) => (v == null ? "–" : `${v.toFixed(3)} s`) },
        ...order.map((series, n) => ({
          label: series.label, stroke: colour(series.colour), dash: dashOf(series), points: { show: false, filter: isolated }, pxAlign: 0,
          width: shared ? 2.4 - (1.3 * n) / (order.length - 1) : series.dash ? 1.1 : 1.8,
          value: (u, v) => number(v, chart.unit),
        })),
      ],
      axes: [axis("time (s)", { size: 30 }), axis(box.closest("#overview") ? chart.unit : null, { size: box.closest("#overview") ? 52 : 46, ...(box.closest(".small") ? { space: 16 } : {}), ...(chart.log ? { splits: rungs, values: rungLabels } : { splits: levels }) })],
      hooks: {
        drawAxes: [marks(chart), ...(chart.links ? [] : [horizontals(lines)])],
        draw: chart.links ? [horizontals(lines)] : [],
        setScale: [(u, key) => { if (key === "x" && u.ready) zoomAll(u.scales.x.min, u.scales.x.max); }],
        setCursor: [(u) => { if (u.cursor.event && u.cursor.left >= 0) window.trilat.show(u.posToVal(u.cursor.left, "x")); }],
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
      width: box.clientWidth, height: tall(box), padding: [8, 16, 0, 0],
      scales: {
        x: { time: false, ...log, range: [1, chart.edges[chart.edges.length - 1]] },
        y: { ...log, range: [0.7, top * 1.6] },
      },
      cursor: { drag: { x: false, y: false }, points: { show: false } },
      series: [
        { label: "from", value: (u, v) => (v == null ? "–" : `${Number(v.toPrecision(3))} ${chart.unit}`) },
        ...chart.series.map((series, n) => ({
          label: series.label, stroke: colour(series.colour), width: 2.2 - (1.2 * n) / Math.max(1, chart.series.length - 1),
          dash: dashOf({ colour: series.colour, dash: false }), paths: uPlot.paths.stepped({ align: 1 }), points: { show: false },
          value: (u, v) => (v == null ? "–" : `${v < 1 ? 0 : v} ticks`),
        })),
      ],
      axes: [axis(`${chart.unit}; dashed: one period`, { size: 30, values: decades }),
        axis("ticks (count)", { size: 52, values: decades })],
      hooks: { draw: [verticals] },
    }, [chart.edges, ...chart.series.map((series) => closed(series.counts))], box);
  }

  function distribution(chart, box) {
    return new uPlot({
      width: box.clientWidth, height: tall(box), padding: [8, 16, 0, 0],
      scales: { x: { time: false, distr: chart.log ? 3 : 1 }, y: { range: [0, 104] } },
      cursor: { drag: { x: false, y: false }, points: { size: 6 } },
      series: [
        { label: "up to", value: (u, v) => number(v, chart.unit) },
        ...chart.series.map((series) => ({
          label: series.label, stroke: colour(series.colour), width: series.dash ? 1.1 : 1.8, dash: dashOf(series),
          points: { show: false }, value: (u, v) => number(v, "%"),
        })),
      ],
      axes: [axis(`${chart.unit}; dashed: the delay of the samples`, { size: 30, ...(chart.log ? { splits: rungs, values: rungLabels } : {}) }), axis("cumulative (%)", { size: 52 })],
    }, [floats(chart.x), ...chart.series.map((series) => floats(series.values))], box);
  }

  const BUILDERS = { time: timeChart, histogram, distribution };
  const boxes = page.charts.map((chart) => {
    const figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    caption.textContent = `${chart.title} (${chart.unit})`;
    const box = document.createElement("div");
    figure.append(caption, box);
    if (chart.kind === "time" && chart.note) {
      const note = document.createElement("p");
      note.className = "note";
      note.textContent = chart.note;
      figure.append(note);
    }
    document.querySelector(`[data-section="${chart.section}"]`).append(figure);
    return box;
  });

  // A chart in a folded part of the page has no width yet. It is built once its part is unfolded.
  function buildVisible() {
    page.charts.forEach((chart, n) => {
      if (!plots[n] && boxes[n].clientWidth) plots[n] = BUILDERS[chart.kind](chart, boxes[n]);
    });
  }

  function build() {
    plots.forEach((plot) => plot.destroy());
    plots = [];
    timePlots = [];
    buildVisible();
  }

  function resize() {
    plots.forEach((plot, n) => {
      if (boxes[n].clientWidth) plot.setSize({ width: boxes[n].clientWidth, height: tall(boxes[n]) });
    });
  }

  window.trilat = { page, tables, plots: () => timePlots, show: () => {} }; // the arms join in
  build();
  document.addEventListener("toggle", buildVisible, true); // this event does not bubble
  let pending = 0;
  addEventListener("resize", () => {
    clearTimeout(pending);
    pending = setTimeout(resize, 120);
  });
  darkQuery.addEventListener("change", build);
  let unfolded = [];
  addEventListener("beforeprint", () => {
    printing = true;
    unfolded = [...document.querySelectorAll("details:not([open])")].filter((part) => part.querySelector("figure"));
    unfolded.forEach((part) => { part.open = true; });
    build();
  });
  addEventListener("afterprint", () => {
    printing = false;
    unfolded.forEach((part) => { part.open = false; });
    build();
  });
})();
