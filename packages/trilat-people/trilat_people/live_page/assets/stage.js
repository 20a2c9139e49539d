// The stage of an experiment: what a user is asked between trials, the target and the time in them, and who
// does what for the experimenter. A sheet covers the arms while nobody is to hold them; a bar never moves them.
import { css, WORDS_MS } from "./arms.js";

const MEASURES = {
  completion_s: ["time", "s", 2], movement_s: ["time in motion", "s", 2], reaction_s: ["reaction", "s", 2],
  wall_force_n: ["force at the wall", "N", 1], error_end_mm: ["error at the end", "mm", 1], error_rms_mm: ["mean error", "mm", 1], path_m: ["way", "m", 2],
};
const PHASES = {
  consent: "Users are asked for consent", trial: "The trial begins once all users are ready", starting: "The arms are being set up",
  checking: "The log is being checked", questionnaire: "Users answer a questionnaire", over: "All trials are done",
};
const MOST_BUTTONS = 11; // a longer scale is a slider

function make(parent, tag, text = "", name = "") {
  const made = parent.appendChild(document.createElement(tag));
  made.textContent = text;
  if (name) made.className = name;
  return made;
}

function button(parent, text, act) {
  const made = make(parent, "button", text, "main");
  made.type = "button";
  made.addEventListener("click", act);
  return made;
}

export class Stage {
  constructor(send) {
    Object.assign(this, { send, signs: {}, nextWords: 0 });
    this.bar = document.getElementById("stage");
    this.sheet = document.getElementById("sheet");
  }

  take(shown, page, arms) {
    if (!shown) return;
    this.now = shown;
    this.running = shown.left_s !== undefined;
    for (const card of arms?.cards || []) {
      const target = this.running && shown.target.site === card.name ? shown.target : null;
      card.extra = target && ((g, ratio, tip) => {
        if (shown.way) this.corridor(card, target, shown.way, g);
        this.circle(card, target, g, ratio, tip);
      });
      card.needs = target ? [target.at] : [];
    }
    this.fill(this.bar, "bar", [shown.phase, this.running, shown.key, shown.users, shown.appeared, shown.second], () => this.head(shown, page.hello));
    const covered = page.hello.role === "user" && (shown.phase !== "trial" || !this.running || shown.second);
    this.fill(this.sheet, "sheet", [covered, shown.phase, shown.key, shown.done, shown.second, shown.told, shown.done && shown.users], () => covered && this.ask(shown));
    this.sheet.hidden = !covered;
    document.body.classList.toggle("asked", covered);
    if (performance.now() > this.nextWords) this.words(shown);
  }

  fill(element, name, sign, build) { // anew only if it says something else: whoever types or presses is not disturbed
    const text = JSON.stringify(sign);
    if (this.signs[name] === text) return;
    this.signs[name] = text;
    this.nextWords = 0;
    element.replaceChildren();
    element.hidden = false;
    build();
  }

  words(shown) {
    this.nextWords = performance.now() + WORDS_MS;
    if (this.left && this.running) {
      this.most = shown.appeared ? Math.max(this.most || 0, shown.left_s) : shown.left_s;
      this.left.textContent = shown.appeared ? `${Math.ceil(shown.left_s)} s` : "";
      this.left.style.setProperty("--left", shown.appeared ? shown.left_s / this.most : 1);
    }
    const rests = shown.rest_s > 0;
    if (this.ready) {
      this.ready.disabled = rests;
      this.ready.textContent = rests ? `rest for ${Math.ceil(shown.rest_s)} s` : "I am ready";
    }
  }

  where({ trial, trials, block, blocks, practice }) {
    return `trial ${trial} of ${trials}${practice ? ", for practice" : ""}${blocks > 1 ? ` · block ${block} of ${blocks}` : ""}`;
  }

  head(shown, hello) {
    const { bar } = this;
    this.left = null;
    const words = make(bar, "p", "", "task");
    if (hello.role !== "user") return this.overview(shown, hello, words);
    if (!this.running) return make(words, "span", shown.who ? `You are ${shown.who}` : shown.title);
    make(words, "strong", shown.appeared ? shown.task : `Take hold of ${hello.as}: the circle is about to appear.`);
    this.left = make(bar, "output", "", "left");
    if (!shown.second) button(bar, "stop this trial", () => this.send({ do: "abort" })).className = "";
  }

  overview(shown, hello, words) {
    const { bar } = this;
    if (!shown.key) return make(words, "strong", PHASES[shown.phase] || shown.phase);
    const inTrial = shown.phase === "trial" && this.running;
    make(words, "strong", inTrial ? shown.task : PHASES[shown.phase]);
    const counted = shown.number ? `trial ${shown.number} of ${shown.of}: ${shown.condition} · ` : "";
    make(words, "span", ` ${counted}${this.where(shown)}`, "soft");
    const people = make(bar, "p", "", "people");
    for (const { site, who, state } of shown.users) {
      const said = inTrial || !state ? state && "takes part" : state === "done" ? (shown.phase === "trial" ? "is ready" : "has answered") : "is asked";
      make(people, "span", `${site} ${who} ${said || "has no page"}`, `chip ${state ? (state === "done" || inTrial ? "good" : "warn") : "bad"}`);
    }
    if (inTrial) this.left = make(bar, "output", "", "left");
    if (inTrial && hello.role === "experimenter") button(bar, "abort this trial", () => this.send({ do: "abort" })).className = "danger";
  }

  ask(shown) {
    const { sheet } = this;
    this.ready = null;
    const card = make(sheet, "div", "", "card sheet");
    make(card, "p", [shown.who, shown.title].filter(Boolean).join(" · "), "soft");
    if (shown.second) {
      make(card, "h2", "Another page of this user is open");
      make(card, "p", "Go on there, or close it to go on here.");
      return;
    }
    this.feedback(card, shown);
    if (shown.phase === "consent") this.consent(card, shown);
    else if (shown.phase === "questionnaire") this.form(card, shown);
    else if (shown.phase === "trial") this.invite(card, shown);
    else if (shown.phase === "starting") {
      make(card, "h2", "Get ready");
      make(card, "p", shown.task);
      make(card, "p", "The arms appear in a moment.", "soft waits");
    } else if (shown.phase === "over") {
      make(card, "h2", "That was all. Thank you.");
    } else make(card, "p", shown.key ? "The trial is being written down." : "A moment, please.", "waits");
  }

  consent(card, shown) {
    make(card, "h2", "Before you begin");
    for (const part of shown.text.trim().split(/\n\s*\n/)) make(card, "p", part.replace(/\s+/g, " "));
    this.confirm(card, shown, "I agree");
  }

  feedback(card, shown) {
    const { why, measures, succeeded } = shown.told;
    if (why) make(card, "p", `This trial is made again: ${why}.`, "again");
    if (succeeded !== undefined) {
      const told = make(card, "dl", "", succeeded ? "told good" : "told");
      make(told, "dt", "last trial");
      make(told, "dd", succeeded ? "done" : "not in time");
      for (const [name, value] of Object.entries(measures)) {
        const [label, unit, digits] = MEASURES[name];
        make(told, "dt", label);
        make(told, "dd", `${value.toFixed(digits)} ${unit}`).dataset.measure = name;
      }
    }
  }

  invite(card, shown) {
    make(card, "h2", this.where(shown).replace(/^t/, "T"));
    make(card, "p", shown.task);
    this.ready = this.confirm(card, shown, "I am ready");
  }

  confirm(card, shown, text) {
    if (!shown.done) return button(card, text, () => this.send({ do: "step", key: shown.key }));
    this.others(card, shown);
    return null;
  }

  others(card, shown) {
    const waits = shown.users.filter(({ state }) => state !== "done").map(({ site, state }) => (state ? site : `${site}, whose page is not open`));
    make(card, "p", waits.length ? `Waiting for ${waits.join(" and ")}.` : "Thank you.", "waits");
  }

  form(card, shown) { // an item that nobody touches has no answer: it is sent as null, once people were told
    const { form } = shown;
    make(card, "h2", form.title || form.name);
    if (shown.done) return this.others(card, shown);
    const answers = new Map();
    const sheet = make(card, "form");
    const items = Object.entries(form.items);
    const fields = new Map();
    let told = false;
    for (const [name, text] of items) {
      const field = make(sheet, "fieldset");
      fields.set(name, field);
      make(field, "legend", text);
      const [low, high] = form.ends[name] || [form.low, form.high];
      const row = make(field, "div", "", "scale");
      const count = (form.most - form.least) / form.step + 1;
      const set = (value) => { answers.set(name, value); show(); };
      make(row, "span", low, "soft");
      if (count > MOST_BUTTONS) this.slider(row, text, form, set);
      else this.buttons(row, name, form, set);
      make(row, "span", high, "soft");
    }
    const left = make(sheet, "p", "", "left-out");
    left.setAttribute("role", "status");
    const send = button(sheet, "", () => {
      const missing = items.length - answers.size;
      if (missing && !told) { told = true; return show(); }
      this.send({ do: "step", key: shown.key, answers: items.map(([name]) => answers.get(name) ?? null) });
    });
    const show = () => {
      const missing = items.length - answers.size;
      const count = missing === 1 ? "1 item has no answer" : `${missing} items have no answer`;
      left.textContent = missing ? `${count} yet.${told ? " You may leave them out." : ""}` : "";
      send.textContent = missing && told ? `send without ${missing} of ${items.length} answers` : "that is my answer";
      send.disabled = Boolean(form.forced && missing);
      for (const [name, field] of fields) field.classList.toggle("missing", told && !answers.has(name));
    };
    show();
  }

  buttons(row, name, { least, most, step }, set) {
    const group = make(row, "span", "", "choices");
    for (let value = least; value <= most; value += step) {
      const label = make(group, "label");
      const input = make(label, "input");
      Object.assign(input, { type: "radio", name, value });
      input.addEventListener("change", () => set(value));
      make(label, "span", value);
    }
  }

  slider(row, text, { least, most, step }, set) { // empty, without a place, until somebody gives it one
    const input = make(make(row, "span", "", "slider"), "input", "", "unset");
    Object.assign(input, { type: "range", min: least, max: most, step });
    input.setAttribute("aria-label", text);
    input.setAttribute("aria-valuetext", "no answer yet");
    const place = () => {
      input.className = "";
      input.removeAttribute("aria-valuetext");
      set(input.valueAsNumber);
    };
    input.addEventListener("input", place);
    input.addEventListener("click", place);
    input.addEventListener("keydown", ({ key }) => { if (key === "Enter" || key === " ") place(); });
  }

  corridor(card, { at }, { from, width_m: width }, g) {
    const [left, to] = [card.project(from), card.project(at)];
    const edge = card.project(at.map((v, n) => v + (n === 0 ? width : 0)));
    g.strokeStyle = css("--accent");
    g.lineWidth = Math.hypot(edge[0] - to[0], edge[1] - to[1]);
    g.lineCap = "round";
    g.globalAlpha = 0.1;
    g.beginPath();
    g.moveTo(...left);
    g.lineTo(...to);
    g.stroke();
    g.globalAlpha = 1;
    g.lineCap = "butt";
  }

  circle(card, { at, width_m: width }, g, ratio, tip) {
    const [x, y] = card.project(at);
    const edge = card.project(at.map((v, n) => v + (n === 0 ? width / 2 : 0)));
    const inside = Math.hypot(...tip.map((v, n) => v - at[n])) <= width / 2;
    g.strokeStyle = g.fillStyle = css(inside ? "--good" : "--accent");
    g.lineWidth = 2.5 * ratio;
    g.beginPath();
    g.arc(x, y, Math.max(4 * ratio, Math.hypot(edge[0] - x, edge[1] - y)), 0, 2 * Math.PI);
    g.globalAlpha = 0.22; g.fill();
    g.globalAlpha = 1; g.stroke();
  }
}

export function renew(parts, hello, sites) { // another session: the same arms from their start, or others
  if (JSON.stringify(hello.sites) !== JSON.stringify(sites)) return location.reload();
  parts.plots?.clear();
  for (const card of parts.arms.cards) card.trail = [];
}
