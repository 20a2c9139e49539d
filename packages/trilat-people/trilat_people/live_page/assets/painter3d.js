// Arms as bodies with light and shadow, by three.js: one renderer paints every card in turn.
import * as THREE from "./three.module.min.js";
import { css, siteColour } from "./arms.js";

const Y = new THREE.Vector3(0, 1, 0);
const FIELD = 24; // degrees, of the camera
const vector = ([x, y, z = 0]) => new THREE.Vector3(x, y, z);

export class ArmScene {
  constructor(card, shadows) {
    this.card = card;
    const { about } = card;
    const size = about.reach;
    this.thick = 0.05 * size;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FIELD, 1, 0.05 * size, 60 * size);
    this.up = about.planar ? [new THREE.Vector3(1, 0, 0), new THREE.Vector3(0, 0, 1), Y.clone()] : about.up.map(vector);
    this.lights(shadows, size);
    this.bodyColour = new THREE.MeshStandardMaterial({ roughness: 0.5, metalness: 0.05 });
    this.jointColour = new THREE.MeshStandardMaterial({ roughness: 0.4, metalness: 0.1 });
    this.baseColour = new THREE.MeshStandardMaterial({ roughness: 0.7 });
    this.ghostColour = new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.34, depthWrite: false });
    this.wallColour = new THREE.MeshStandardMaterial({ roughness: 0.9, transparent: true, opacity: 0.85 });
    this.lineColour = new THREE.LineBasicMaterial();
    this.ground(size);
    const count = about.start.length;
    const thin = Math.max(0.55, 1 - 0.09 * (count - 3));
    this.links = Array.from({ length: count - 1 }, (_, n) => this.tube(this.bodyColour, this.thick * thin * (n ? 0.86 : 1)));
    this.joints = Array.from({ length: count }, (_, n) => this.ball(n === count - 1 ? this.bodyColour : this.jointColour, this.thick * thin * (n === count - 1 ? 1.05 : 1.22)));
    this.ghosts = about.task ? [] : this.links.map(() => this.tube(this.ghostColour, 0.62 * this.thick * thin, false));
    this.goal = this.ball(this.ghostColour, (about.task ? 1.6 : 0.9 * thin) * this.thick, false);
    this.bodyBoxColour = new THREE.MeshStandardMaterial({ roughness: 0.8 });
    this.bodies = about.bodies.map((size_m) => this.mesh(new THREE.BoxGeometry(...size_m), this.bodyBoxColour, true));
    for (const { at, normal } of about.walls) this.wall(vector(at), vector(normal), size);
    this.colour();
  }

  lights(shadows, size) {
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x9098a8, 2.1));
    const sun = new THREE.DirectionalLight(0xffffff, 1.9);
    const [ahead, side, up] = this.up;
    const from = this.card.about.planar ? new THREE.Vector3(-0.9, 1.6, 2.6) : ahead.clone().multiplyScalar(1.2).addScaledVector(side, -1).addScaledVector(up, 2.4);
    sun.position.copy(from.multiplyScalar(size));
    sun.castShadow = shadows;
    sun.shadow.mapSize.set(1024, 1024);
    sun.shadow.radius = 5;
    sun.shadow.bias = -0.0008;
    Object.assign(sun.shadow.camera, { left: -1.6 * size, right: 1.6 * size, top: 1.6 * size, bottom: -1.6 * size, near: 0.1 * size, far: 8 * size });
    this.scene.add(sun);
  }

  ground(size) { // a plate behind a planar arm, a floor below a chain
    const [ahead, side, up] = this.up;
    const normal = this.card.about.planar ? new THREE.Vector3(0, 0, 1) : up;
    const depth = this.card.about.planar ? -0.16 * size : 0;
    const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), normal);
    const plate = new THREE.Mesh(new THREE.PlaneGeometry(24 * size, 24 * size), new THREE.ShadowMaterial({ opacity: 0.2 }));
    plate.quaternion.copy(turn);
    plate.position.copy(normal).multiplyScalar(depth);
    plate.receiveShadow = true;
    this.scene.add(plate);
    this.below = [plate];
    const [a, b] = this.card.about.planar ? [ahead, Y] : [ahead, side];
    const points = [];
    const far = this.card.about.planar ? 3 : 1.5;
    for (let n = -far * 4; n <= far * 4; n++) {
      for (const [along, across] of [[a, b], [b, a]]) {
        for (const end of [-far, far]) points.push(along.clone().multiplyScalar(end * size).addScaledVector(across, (n / 4) * size).addScaledVector(normal, depth - 0.001 * size));
      }
    }
    this.below.push(new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(points), this.lineColour));
    this.scene.add(this.below[1]);
    const base = new THREE.Mesh(new THREE.CylinderGeometry(1.9 * this.thick, 2.3 * this.thick, this.card.about.planar ? 0.16 * size : 0.5 * this.thick, 32), this.baseColour);
    base.quaternion.setFromUnitVectors(Y, normal);
    base.position.copy(normal).multiplyScalar(this.card.about.planar ? depth / 2 : 0.2 * this.thick);
    base.castShadow = true;
    this.scene.add(base);
    this.below.push(base);
  }

  mesh(geometry, material, shadow) {
    const mesh = new THREE.Mesh(geometry, material);
    mesh.castShadow = shadow;
    this.scene.add(mesh);
    return mesh;
  }

  tube(material, radius, shadow = true) { return this.mesh(new THREE.CylinderGeometry(radius, radius, 1, 20, 1, false), material, shadow); }

  ball(material, radius, shadow = true) { return this.mesh(new THREE.SphereGeometry(radius, 24, 16), material, shadow); }

  wall(at, normal, size) {
    const block = this.mesh(new THREE.BoxGeometry(3 * size, 0.3 * size, this.card.about.planar ? 0.3 * size : 3 * size), this.wallColour, true);
    block.quaternion.setFromUnitVectors(Y, normal);
    block.position.copy(at).addScaledVector(normal, -0.15 * size);
    if (this.card.about.planar) return;
    block.scale.set(0.35, 0.2, 0.35);
    this.wallColour.opacity = 0.55;
  }

  colour() {
    this.bodyColour.color.set(siteColour(this.card.about));
    this.jointColour.color.set(css("--card")).lerp(new THREE.Color(siteColour(this.card.about)), 0.25);
    this.baseColour.color.set(css("--soft"));
    this.ghostColour.color.set(css("--ink"));
    this.bodyBoxColour.color.set(css("--soft"));
    this.wallColour.color.set(css("--line"));
    this.lineColour.color.set(css("--grid"));
  }

  span(tube, from, to) {
    const way = to.clone().sub(from);
    const length = way.length();
    tube.visible = length > 1e-6;
    if (!tube.visible) return;
    tube.position.copy(from).addScaledVector(way, 0.5);
    tube.scale.y = length;
    tube.quaternion.setFromUnitVectors(Y, way.divideScalar(length));
  }

  pose(site) {
    const points = site.points.map(vector);
    const wanted = this.card.scene ? [] : site.ghost.map(vector); // where arms lie over each other shadows only blur them
    for (const part of this.below) part.visible = this.card.under;
    this.links.forEach((tube, n) => this.span(tube, points[n], points[n + 1]));
    this.joints.forEach((ball, n) => ball.position.copy(points[n]));
    this.goal.visible = wanted.length > 0; // of a peer nobody knows where it ought to be
    this.ghosts.forEach((tube, n) => { if (wanted.length) this.span(tube, wanted[n], wanted[n + 1]); else tube.visible = false; });
    this.bodies.forEach((box, n) => {
      box.visible = site.bodies.length > 0;
      if (!box.visible) return;
      const [x, y, z, w, ...v] = site.bodies.slice(7 * n, 7 * n + 7);
      box.position.set(x, y, z);
      box.quaternion.set(...v, w);
    });
    if (wanted.length) this.goal.position.copy(wanted[wanted.length - 1]);
  }

  look(aspect) {
    const { card, camera } = this;
    const centre = vector(card.view.centre);
    const away = card.view.half / Math.tan((FIELD * Math.PI) / 360);
    const [ahead, side, up] = this.up;
    const from = card.about.planar ? new THREE.Vector3(-0.03, 0.1, 1) : ahead.clone().multiplyScalar(0.64).addScaledVector(side, -0.77).addScaledVector(up, 0.4);
    camera.position.copy(centre).addScaledVector(from.normalize(), away);
    camera.up.copy(up);
    camera.aspect = aspect;
    camera.lookAt(centre);
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
  }
}

class ScenePainter {
  constructor(renderer, cards, software) {
    Object.assign(this, { renderer, cards });
    renderer.shadowMap.enabled = !software;
    renderer.shadowMap.type = THREE.PCFSoftShadowMap;
    renderer.setClearColor(0x000000, 0);
    this.scenes = new Map(cards.map((card) => [card, new ArmScene(card, !software)]));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { for (const scene of this.scenes.values()) scene.colour(); });
    this.ray = new THREE.Raycaster();
  }

  begin() { // one buffer for all cards, as large as the largest
    const width = Math.max(...this.cards.map((card) => card.canvas.width));
    const height = Math.max(...this.cards.map((card) => card.canvas.height));
    if (width !== this.width || height !== this.height) {
      Object.assign(this, { width, height });
      this.renderer.setSize(width, height, false);
    }
    this.renderer.setScissorTest(true);
  }

  paint(card, site, g) {
    const { width, height } = card.canvas;
    const scene = this.scenes.get(card);
    scene.pose(site);
    scene.look(width / height);
    this.renderer.setViewport(0, 0, width, height);
    this.renderer.setScissor(0, 0, width, height);
    this.renderer.render(scene.scene, scene.camera);
    g.clearRect(0, 0, width, height);
    g.drawImage(this.renderer.domElement, 0, this.height - height, width, height, 0, 0, width, height);
  }

  project(card, point) {
    const at = vector(point).project(this.scenes.get(card).camera);
    return [(0.5 + 0.5 * at.x) * card.canvas.width, (0.5 - 0.5 * at.y) * card.canvas.height];
  }

  unproject(card, pixel, near) { // onto the plane of a planar arm; in space, parallel to the picture
    const { camera } = this.scenes.get(card);
    this.ray.setFromCamera(new THREE.Vector2((2 * pixel[0]) / card.canvas.width - 1, 1 - (2 * pixel[1]) / card.canvas.height), camera);
    const normal = card.about.planar ? new THREE.Vector3(0, 0, 1) : camera.getWorldDirection(new THREE.Vector3());
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(normal, vector(near));
    const at = this.ray.ray.intersectPlane(plane, new THREE.Vector3());
    if (at === null) return near;
    return card.about.planar ? [at.x, at.y] : [at.x, at.y, at.z];
  }
}

export function makeScenePainter(cards, however) { // null where there is no WebGL, or none by a graphics card
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("webgl2", { antialias: true, alpha: true, premultipliedAlpha: true });
  if (context === null) return null;
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  const software = /swiftshader|llvmpipe|software/i.test(name);
  if (software && !however) return null;
  return new ScenePainter(new THREE.WebGLRenderer({ canvas, context }), cards, software);
}
