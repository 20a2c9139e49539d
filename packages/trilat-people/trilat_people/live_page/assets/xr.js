// A headset: the arms stand before whoever wears it, and its controllers take hold of them. Trigger or grip takes
// hold, and the arm follows the controller's motion from there, turned and scaled as the scenario says; a pose that
// jumps moves nothing. B or Y stops every arm. While a headset is worn the browser draws no page: frames are seen here.
const LOST_MS = 200;
const [LEAST_S, MOST_S] = [0.005, 0.05]; // as a device's jumps are judged (device_hand.py)
const PRESSED = 0.3;
const SCALES = [0.25, 0.5, 1, 2, 4];

const toUser = ({ x, y, z }) => [x, -z, y]; // to the right, ahead, up; a headset has y up and z back
const toHeadset = ([right, ahead, up]) => [right, up, -ahead];

export class Headset {
  constructor(arms, hands, page, send, stop, place) {
    Object.assign(this, { arms, hands, page, send, stop, controllers: {}, dropped: 0, frames: 0, session: null, scale: 0 });
    navigator.xr?.isSessionSupported("immersive-vr").then((able) => { if (able) this.offer(place); }, () => {});
  }

  offer(place) {
    this.parts = Promise.all([import("./three.module.min.js"), import("./painter3d.js")]);
    const actions = place.appendChild(document.createElement("div"));
    actions.className = "state";
    actions.id = "vr";
    this.button = actions.appendChild(document.createElement("button"));
    Object.assign(this.button, { id: "enter-vr", type: "button", textContent: "enter VR", title: "lead arms with the controllers of a headset" });
    const choice = actions.appendChild(document.createElement("select"));
    choice.id = "vr-scale";
    choice.setAttribute("aria-label", "motion of the arm over motion of a controller");
    choice.append(new Option("scale of the scenario", 0), ...SCALES.map((scale) => new Option(`arm moves ${scale} ×`, scale)));
    choice.addEventListener("change", () => { this.scale = Number(choice.value); });
    this.button.addEventListener("click", () => {
      if (this.session) this.session.end();
      else this.enter().catch((error) => { this.session?.end(); Object.assign(this.button, { textContent: "enter VR: failed", title: error.message }); });
    });
  }

  async enter() {
    const session = await navigator.xr.requestSession("immersive-vr", { optionalFeatures: ["local-floor"] });
    const [THREE, { ArmScene }] = await this.parts;
    this.session = session;
    this.button.textContent = "leave VR";
    session.addEventListener("end", () => this.leave());
    session.addEventListener("visibilitychange", () => { if (session.visibilityState !== "visible") this.letGo(); });
    this.renderer = new THREE.WebGLRenderer({ antialias: true });
    this.renderer.xr.enabled = true;
    this.build(THREE, ArmScene);
    await this.renderer.xr.setSession(session);
    this.renderer.setAnimationLoop((time, frame) => { if (frame) this.draw(time, frame); });
  }

  leave() {
    this.letGo();
    this.renderer?.setAnimationLoop(null);
    this.renderer?.dispose();
    this.session = null;
    this.button.textContent = "enter VR";
  }

  build(THREE, ArmScene) { // each arm at its size, its axes to where its hand says that they point
    const { cards } = this.arms;
    const wide = Math.max(...cards.map((card) => card.about.reach));
    this.world = new THREE.Scene();
    this.world.background = new THREE.Color(getComputedStyle(document.body).backgroundColor);
    this.camera = new THREE.PerspectiveCamera();
    this.scenes = cards.map((card, n) => {
      const scene = new ArmScene(card, false);
      const lights = scene.scene.children.filter((one) => one.isLight);
      if (n) scene.scene.remove(...lights);
      const axes = (card.about.hand?.device?.rows ?? (card.about.planar ? [[1, 0, 0], [0, 0, 1]] : [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])).map((row) => new THREE.Vector3(...toHeadset(row)));
      if (axes.length === 2) axes.push(axes[0].clone().cross(axes[1]));
      scene.scene.matrixAutoUpdate = false;
      scene.scene.matrix.makeBasis(...axes).setPosition((n - (cards.length - 1) / 2) * 1.5 * wide, 0.9, -1.5 * wide);
      this.world.add(scene.scene);
      return [card.name, scene];
    });
  }

  draw(time, frame) {
    const space = this.renderer.xr.getReferenceSpace();
    this.frames += 1;
    for (const source of this.session.inputSources) {
      if (!source.gamepad || !source.gripSpace) continue;
      const pose = frame.getPose(source.gripSpace, space);
      this.lead(source, pose && !pose.emulatedPosition ? toUser(pose.transform.position) : null, time);
    }
    for (const own of Object.values(this.controllers)) if (own.card && time - own.time > LOST_MS) this.release(own); // not seen
    const now = this.page.frame;
    if (now) {
      for (const [name, scene] of this.scenes) scene.pose(now.sites[name]);
      if (now.n !== this.seen) this.send({ do: "seen", n: now.n });
      this.seen = now.n;
    }
    this.renderer.render(this.world, this.camera);
  }

  cardOf(side) { // a user's own arm; else the left controller has the arm after that of the right one
    const { own, chosen } = this.hands;
    const first = chosen ?? this.arms.cards[0];
    const next = this.arms.cards[(this.arms.cards.indexOf(first) + 1) % this.arms.cards.length];
    return own ?? (side === "left" ? next : first);
  }

  lead(source, at, time) {
    const side = source.handedness;
    const own = (this.controllers[side] ??= { card: null, at: null, time: 0, pressed: true, stops: true });
    const down = (n) => (source.gamepad.buttons[n]?.value ?? 0) > PRESSED;
    const [pressed, stops] = [down(0) || down(1), down(5)];
    if (stops && !own.stops) this.stop();
    if (pressed && !own.pressed && at) this.take(own, side);
    Object.assign(own, { pressed, stops });
    if (own.card?.hold?.controller !== side) own.card = null; // let go by STOP, or by the end
    if (own.card && !pressed) this.release(own);
    if (own.card && at) this.move(own, at, (time - own.time) * 1e-3);
    if (own.card) this.hands.rumble(own.card, source.gamepad);
    if (at) Object.assign(own, { at, time });
  }

  take(own, side) {
    const card = this.cardOf(side);
    const tip = this.hands.tip(card);
    if (card.hold || !tip || !this.hands.can(card)) return;
    own.card = card;
    own.at = null;
    this.hands.take(card, [...tip], { controller: side });
  }

  move(own, at, passed) {
    const { rows, scale, jump_m_s: jump } = own.card.about.hand.device;
    if (own.at === null) return;
    const moved = at.map((x, n) => x - own.at[n]);
    if (!(Math.hypot(...moved) <= jump * Math.min(Math.max(passed, LEAST_S), MOST_S))) { this.dropped += 1; return; }
    const { hold } = own.card;
    hold.to = hold.to.map((x, n) => x + (this.scale || scale) * rows[n].reduce((sum, v, i) => sum + v * moved[i], 0));
    this.hands.tell(own.card);
  }

  release(own) {
    this.hands.release(own.card);
    own.card = null;
  }

  letGo() { for (const own of Object.values(this.controllers)) if (own.card) this.release(own); }
}
