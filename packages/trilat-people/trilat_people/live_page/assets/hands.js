// People's hands: drag an end effector, a gamepad, or keys. What they ask for goes to the server at most sixty
// times a second, and now and then while they rest, so that the site knows that they still hold. A user's page
// holds its own arm alone.
const EVERY_MS = 1000 / 60;
const STILL_MS = 50;
const REACH_PX = 34;
const RUMBLE_MS = 100;
const RUMBLE_N = 0.5; // below that the wall is not felt

export class Hands {
  constructor(arms, hello, send, page, stop) {
    Object.assign(this, { arms, send, page, stop, own: arms.byName[hello.as], chosen: null, stopping: new Set() });
    for (const card of arms.cards) this.listen(card);
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.letGo());
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.letGo(); });
    this.keys = new Set();
    addEventListener("gamepadconnected", () => { this.padded = true; });
    if (this.own) this.choose(this.own);
    setInterval(() => this.beat(), EVERY_MS);
  }

  can(card) { return this.page.takesPart && !this.page.frame?.ended && [undefined, card].includes(this.own) && ["tip", "force"].includes(card.about.hand?.mode) && Boolean(card.project); }

  goal(card) { // the target; for an arm that is pushed the force, as far as the pointer is from the tip
    const { hand, reach } = card.about;
    if (hand.mode === "tip") return card.hold.to;
    const tip = this.tip(card);
    const pull = card.hold.to.map((x, n) => x - tip[n]);
    const size = Math.hypot(...pull) || 1;
    return pull.map((x) => (x / size) * hand.limit * Math.min(1, size / (0.35 * reach)));
  }

  pixel(card, event) {
    const box = card.canvas.getBoundingClientRect();
    const ratio = card.canvas.width / box.width;
    return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio, ratio];
  }

  tip(card) {
    const site = this.page.frame?.sites[card.name];
    return site ? site.points[site.points.length - 1] : null;
  }

  listen(card) {
    const near = (event) => {
      const tip = this.tip(card);
      if (!tip || !this.can(card)) return false;
      const [x, y, ratio] = this.pixel(card, event);
      const [tx, ty] = card.project(tip);
      return Math.hypot(x - tx, y - ty) < REACH_PX * ratio;
    };
    card.card.addEventListener("focus", () => this.choose(card));
    card.canvas.addEventListener("pointerdown", (event) => {
      this.choose(card);
      if (!near(event)) return;
      event.preventDefault();
      card.canvas.setPointerCapture(event.pointerId);
      const [x, y] = this.pixel(card, event);
      const [tx, ty] = card.project(this.tip(card));
      this.take(card, [...this.tip(card)], { pointer: event.pointerId, offset: [tx - x, ty - y] });
    });
    card.canvas.addEventListener("pointermove", (event) => { card.near = near(event); });
    const raw = "onpointerrawupdate" in window ? "pointerrawupdate" : "pointermove"; // does not wait for a frame
    card.canvas.addEventListener(raw, (event) => {
      const hold = card.hold;
      if (!hold || hold.pointer !== event.pointerId) return;
      const [x, y] = this.pixel(card, event);
      hold.to = this.arms.painter.unproject(card, [x + hold.offset[0], y + hold.offset[1]], hold.to);
      this.tell(card);
    });
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
      card.canvas.addEventListener(kind, (event) => { if (card.hold?.pointer === event.pointerId) this.release(card); });
    }
  }

  choose(card) {
    this.chosen = card;
    for (const other of this.arms.cards) other.card.classList.toggle("chosen", other === card);
  }

  take(card, to, how) {
    card.hold = { to, told: 0, moved: 0, ...how };
    card.card.classList.add("held");
    this.tell(card);
  }

  release(card) {
    if (!card.hold) return;
    card.hold = null;
    card.card.classList.remove("held");
    this.send({ do: "hand", site: card.name, grip: false });
  }

  letGo() { for (const card of this.arms.cards) this.release(card); this.keys?.clear(); }

  tell(card) {
    const now = performance.now();
    const moved = card.hold.to !== card.hold.asked;
    if (now - (moved ? card.hold.moved : card.hold.told) < EVERY_MS - 1) return; // a rest's heartbeat delays no move
    Object.assign(card.hold, { told: now, moved: moved ? now : card.hold.moved, asked: card.hold.to });
    this.send({ do: "hand", site: card.name, grip: true, to: this.goal(card) });
  }

  beat() {
    this.gamepads();
    this.steer();
    for (const card of this.arms.cards) {
      card.graspable = this.can(card);
      card.card.classList.toggle("watched", !card.graspable);
      if (!card.hold) continue;
      if (!card.graspable || this.page.frame?.ended) this.release(card);
      else if (card.hold.to !== card.hold.asked || card.about.hand.mode === "force" || performance.now() - card.hold.told > STILL_MS) this.tell(card);
    }
  }

  key(event, down) {
    const { key } = event;
    if (event.target.matches("input[type=text], select, textarea, a, .scroll") || (event.target.matches("button, input") && /^( |Enter|Arrow)/.test(key))) return;
    if (down && /^[1-9]$/.test(key) && this.arms.cards[key - 1]) this.arms.cards[key - 1].card.focus();
    else if (key === " " && this.chosen) {
      event.preventDefault();
      if (down && !event.repeat) {
        if (this.chosen.hold) this.release(this.chosen);
        else if (this.can(this.chosen) && this.tip(this.chosen)) this.take(this.chosen, [...this.tip(this.chosen)], { keys: true });
      }
    } else if (key.startsWith("Arrow") && this.chosen?.hold) {
      event.preventDefault();
      if (down) this.keys.add(key); else this.keys.delete(key);
    } else if (key.startsWith("Arrow")) this.keys.delete(key);
  }

  steer() {
    const card = this.chosen;
    if (!card?.hold?.keys || !this.keys.size) return;
    const step = (0.35 * card.about.reach * EVERY_MS) / 1000;
    const way = (plus, minus) => (this.keys.has(plus) ? step : 0) - (this.keys.has(minus) ? step : 0);
    this.shift(card, way("ArrowRight", "ArrowLeft"), way("ArrowUp", "ArrowDown"));
  }

  shift(card, right, up) {
    const at = this.arms.painter.project(card, card.hold.to);
    const unit = card.canvas.height / (2 * card.view.half);
    card.hold.to = this.within(card, this.arms.painter.unproject(card, [at[0] + right * unit, at[1] - up * unit], card.hold.to));
  }

  within(card, to) { // the nearest place that the arm can get to: steps of keys and sticks add up, and would lead the target away
    const { centre, most } = card.about.hand.reach;
    const way = to.map((x, n) => x - centre[n]);
    const distance = Math.hypot(...way);
    return most === null || distance <= most ? to : way.map((x, n) => centre[n] + (x * most) / distance);
  }

  rumble(card, pad) { // of the wall at the arm that it holds, ten times a second, each a little longer than that
    const force = Math.hypot(...this.page.frame.sites[card.name].wall);
    const now = performance.now();
    if (force < RUMBLE_N || now - (card.hold.rumbled ?? 0) < RUMBLE_MS) return;
    card.hold.rumbled = now;
    const strength = Math.min(1, force / card.about.hand.limit);
    const motor = pad.vibrationActuator ?? pad.hapticActuators?.[0];
    if (motor?.playEffect) motor.playEffect("dual-rumble", { duration: 1.2 * RUMBLE_MS, strongMagnitude: strength, weakMagnitude: strength }).catch(() => {});
    else motor?.pulse?.(strength, 1.2 * RUMBLE_MS);
  }

  gamepads() { // asked for only once there is one; the trigger or the first button takes hold of the chosen arm, or of the n-th by the n-th pad; "select" stops every arm
    if (!this.padded) return;
    const pads = (navigator.getGamepads?.() || []).filter(Boolean);
    pads.forEach((pad, n) => {
      const select = Boolean(pad.buttons[8]?.pressed);
      if (select && !this.stopping.has(pad.index)) this.stop();
      this.stopping[select ? "add" : "delete"](pad.index);
      const card = this.own ? this.own : pads.length > 1 ? this.arms.cards[n] : this.chosen || this.arms.cards[0];
      if (!card || !this.can(card)) return;
      const pressed = pad.buttons[0]?.pressed || (pad.buttons[7]?.value || 0) > 0.3;
      if (pressed && !card.hold && this.tip(card)) this.take(card, [...this.tip(card)], { pad: pad.index });
      if (!pressed && card.hold?.pad === pad.index) this.release(card);
      if (card.hold?.pad !== pad.index) return;
      const live = (axis) => (Math.abs(pad.axes[axis] || 0) > 0.12 ? pad.axes[axis] : 0);
      const step = (0.6 * card.about.reach * EVERY_MS) / 1000;
      this.shift(card, step * live(0), -step * live(1));
      this.rumble(card, pad);
    });
  }
}
