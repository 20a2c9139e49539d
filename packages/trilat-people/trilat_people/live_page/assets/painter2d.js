// Arms on a plain canvas: where there is no WebGL.
import { css, siteColour } from "./arms.js";

const EDGES = [0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4].map((n) => [0, 1, 2].map((axis) => 0.5 - ((n >> axis) & 1)));

function bodyPoses(about, site) { // of each body of a plant: its box's edges, and where a point of the body is
  return (site.bodies.length ? about.bodies : []).map((size, n) => {
    const [x, y, z, w, ...v] = site.bodies.slice(7 * n, 7 * n + 7);
    const cross = (a, b) => [0, 1, 2].map((i) => a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3]);
    const at = (p) => {
      const turned = cross(v, cross(v, p).map((c, i) => c + w * p[i])).map((c, i) => p[i] + 2 * c);
      return [x + turned[0], y + turned[1], z + turned[2]];
    };
    return { at, edges: EDGES.map((corner) => corner.map((c, i) => c * size[i])) };
  });
}

export class PlainPainter {
  project(card, point) {
    const { canvas, view } = card;
    const unit = canvas.height / (2 * view.half);
    const [x, y] = card.flat(point);
    const [cx, cy] = card.flat(view.centre);
    return [canvas.width / 2 + unit * (x - cx), canvas.height / 2 - unit * (y - cy)];
  }

  unproject(card, pixel, near) {
    const { canvas, view } = card;
    const unit = canvas.height / (2 * view.half);
    const [cx, cy] = card.flat(view.centre);
    const [x, y] = [cx + (pixel[0] - canvas.width / 2) / unit, cy - (pixel[1] - canvas.height / 2) / unit];
    if (card.about.planar) return [x, y];
    const [nx, ny] = card.flat(near); // in space: parallel to the picture, through where the arm is
    const [ahead, side, up] = card.about.up;
    const right = ahead.map((v, n) => 0.77 * v + 0.64 * side[n]);
    return near.map((v, n) => v + (x - nx) * right[n] + ((y - ny) * up[n]) / 0.93);
  }

  line(card, g, points, colour, width, dash = []) {
    g.strokeStyle = colour;
    g.lineWidth = width;
    g.lineCap = g.lineJoin = "round";
    g.setLineDash(dash);
    g.beginPath();
    points.forEach((point, n) => g[n ? "lineTo" : "moveTo"](...this.project(card, point)));
    g.stroke();
    g.setLineDash([]);
  }

  paint(card, site, g) {
    const { canvas, about } = card;
    const unit = canvas.height / (2 * card.view.half);
    const thick = 0.06 * about.reach * unit;
    g.clearRect(0, 0, canvas.width, canvas.height);
    for (const { at, normal } of about.walls) this.wall(card, g, at, normal);
    const base = about.planar ? [0, 0] : [0, 0, 0];
    if (card.scene) {
      // where arms lie over each other shadows only blur them
    } else if (about.task && site.ghost.length) {
      g.strokeStyle = css("--soft");
      g.lineWidth = 0.25 * thick;
      g.beginPath(); g.arc(...this.project(card, site.ghost[0]), 0.6 * thick, 0, 2 * Math.PI); g.stroke();
    } else {
      this.line(card, g, site.ghost, css("--soft"), 0.3 * thick, [0.8 * thick, 0.6 * thick]);
    }
    bodyPoses(about, site).forEach(({ at, edges }) => this.line(card, g, edges.map(at), css("--ink"), 0.18 * thick));
    const [bx, by] = this.project(card, base);
    g.fillStyle = css("--ink");
    if (card.under) g.fillRect(bx - 0.8 * thick, by - 0.8 * thick, 1.6 * thick, 1.6 * thick);
    g.globalAlpha = card.scene ? 0.8 : 1;
    this.line(card, g, site.points, siteColour(about), thick);
    g.globalAlpha = 1;
    g.fillStyle = css("--card");
    for (const point of site.points) {
      g.beginPath(); g.arc(...this.project(card, point), 0.27 * thick, 0, 2 * Math.PI); g.fill();
    }
  }

  wall(card, g, at, normal) {
    if (at.length !== 2) return;
    const along = [-normal[1], normal[0]];
    const far = 20;
    const corner = (a, b) => this.project(card, [at[0] + a * along[0] - b * normal[0], at[1] + a * along[1] - b * normal[1]]);
    g.fillStyle = css("--line");
    g.beginPath();
    [[-far, 0], [far, 0], [far, far], [-far, far]].forEach(([a, b], n) => g[n ? "lineTo" : "moveTo"](...corner(a, b)));
    g.fill();
  }
}
