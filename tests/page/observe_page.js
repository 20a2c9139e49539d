// Observes a page from before its first script: every chart that it builds, every frame that it shows, and every
// field that it reads of data which its server or its program did not send.
(() => {
  "use strict";
  const ANY_OBJECT = new Set(["toJSON", "then"]); // asked of any object by the browser itself
  const charts = [];
  const unsent = new Set();

  let library;
  Object.defineProperty(window, "uPlot", {
    configurable: true,
    get: () => library,
    set: (loaded) => {
      library = new Proxy(loaded, {
        construct: (target, options) => {
          const chart = new target(...options);
          charts.push(chart);
          return chart;
        },
      });
    },
  });

  const guard = (value, path) => {
    if (value === null || typeof value !== "object") return value;
    for (const key of Object.keys(value)) value[key] = guard(value[key], Array.isArray(value) ? `${path}[]` : `${path}.${key}`);
    if (Array.isArray(value)) return value;
    return new Proxy(value, {
      get: (target, key) => {
        if (typeof key === "string" && !(key in target) && !ANY_OBJECT.has(key)) unsent.add(`${path}.${key}`.slice(1));
        return target[key];
      },
    });
  };
  const parse = JSON.parse;
  JSON.parse = (text, ...rest) => guard(parse(text, ...rest), "");

  const pixelsOf = (source) => {
    const [width, height] = [source.naturalWidth ?? source.width, source.naturalHeight ?? source.height];
    if (!width || !height) return null;
    const copy = new OffscreenCanvas(width, height).getContext("2d");
    copy.drawImage(source, 0, 0);
    return new Uint32Array(copy.getImageData(0, 0, width, height).data.buffer);
  };
  const isDrawn = (source) => {
    const pixels = pixelsOf(source);
    return pixels !== null && pixels.some((pixel) => pixel !== pixels[0]);
  };
  const isVisible = (element) => element.checkVisibility({ visibilityProperty: true }) && element.getClientRects().length > 0;
  const nameOf = (element) => {
    const frame = element.closest("figure, [data-section], section, article");
    const words = element.getAttribute("aria-label") || element.alt || frame?.querySelector("figcaption, h2")?.textContent || frame?.getAttribute("aria-label");
    return `${element.tagName.toLowerCase()}${element.id ? `#${element.id}` : ""} (${words || element.outerHTML.slice(0, 60)})`;
  };

  const SHAPES = "path, polyline, polygon, line, circle, ellipse, rect, text";
  const isPainted = (shape) => {
    const style = getComputedStyle(shape);
    return style.visibility === "visible" && (style.stroke !== "none" || style.fill !== "none");
  };
  const showsShape = (svg) => {
    const frame = svg.getBoundingClientRect();
    return [...svg.querySelectorAll(SHAPES)].filter(isPainted).some((shape) => {
      const box = shape.getBoundingClientRect();
      const inside = box.right > frame.left && box.left < frame.right && box.bottom > frame.top && box.top < frame.bottom;
      return inside && Math.max(box.width, box.height) > 0;
    });
  };

  // A frame in which something must be drawn, by its kind, and whether something is.
  const FRAMES = {
    canvas: isDrawn,
    img: (image) => image.complete && isDrawn(image),
    svg: showsShape,
    figure: (figure) => [...figure.querySelectorAll("canvas, img, svg")].some(isVisible) || Boolean(figure.querySelector("p:not([hidden])")?.textContent),
    "[data-section]": (section) => section.querySelector("figure") !== null,
    "#arms .row": (row) => row.querySelector("svg") !== null,
    table: (table) => table.querySelector("td") !== null,
  };
  const findEmptyFrames = () => Object.entries(FRAMES).flatMap(([kind, holds]) =>
    [...document.querySelectorAll(kind)].filter((frame) => isVisible(frame) && !holds(frame)).map((frame) => `nothing is drawn in ${nameOf(frame)}`));

  // Draws a chart with all of its lines in no colour but one, so that axes, scales and marks stay as they are.
  async function drawOnly(chart, shown) {
    chart.series.slice(1).forEach((series, n) => {
      for (const owner of [series, series.points]) {
        owner.keptStroke ??= owner.stroke;
        owner.keptFill ??= owner.fill;
        owner.stroke = n === shown ? owner.keptStroke : () => "transparent";
        owner.fill = n === shown ? owner.keptFill : () => "transparent";
      }
    });
    chart.redraw(false, false);
    await Promise.resolve();
    return pixelsOf(chart.ctx.canvas);
  }
  async function restore(chart) {
    for (const series of chart.series.slice(1)) for (const owner of [series, series.points]) Object.assign(owner, { stroke: owner.keptStroke, fill: owner.keptFill });
    chart.redraw(false, false);
    await Promise.resolve();
  }
  async function findUndrawnLines() {
    const faults = [];
    for (const chart of charts.filter(({ root }) => root.isConnected && isVisible(root))) {
      const title = nameOf(chart.root);
      const without = await drawOnly(chart, -1);
      for (const [n, { label, show }] of chart.series.slice(1).entries()) {
        if (!show) continue;
        const pixels = await drawOnly(chart, n);
        if (!pixels.some((pixel, place) => pixel !== without[place])) faults.push(`line ${n + 1} (${label ?? "no name"}) of ${title} has no drawn point`);
      }
      await restore(chart);
    }
    return faults;
  }

  window.observed = {
    charts: () => charts.filter(({ root }) => root.isConnected).length,
    unsent: () => [...unsent].sort(),
    faults: async () => [...findEmptyFrames(), ...await findUndrawnLines()],
  };
})();
