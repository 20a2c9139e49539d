// The page of a running session: the socket, the state of the page, and what belongs to no single part.
// Newest state wins: the server sends a frame when this page has drawn the one before.
import { Arms, WORDS_MS } from "./arms.js";
import { Hands } from "./hands.js";
import { Network } from "./network.js";
import { Plots } from "./plots.js";
import { Shares } from "./shares.js";
import { renew, Stage } from "./stage.js";
import { Headset } from "./xr.js";

const $ = (id) => document.getElementById(id);
const countNouns = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
const page = { hello: null, frame: null, takesPart: null, sent: 0, frames: 0, energies: [] };
window.trilat = page; // for tests, and for whoever opens the console

let socket = null;
let parts = null;
let pause = 500;

export function send(message) {
  if (socket === null || socket.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(message));
  page.sent += 1;
  return true;
}

const FINGERS = matchMedia("(pointer: coarse)");
const LATE_MS = 1000;
const CONTROLS = "#link-form input, #link-form select, #link-form button, #mark, #mark-text, #end, #ages";
const stage = new Stage(send); // of an experiment; without one it shows nothing

let hidesAt = 0;
let nextWords = 0;
let heardAt = performance.now(); // when the newest message came
let late = false;
function notice(text, ms = 6000) {
  $("notice").textContent = text;
  $("notice").hidden = false;
  hidesAt = performance.now() + ms;
}

function state(text, kind = "") {
  if ($("state").textContent === text) return;
  $("state").textContent = text;
  $("state").className = `chip ${kind}`;
}

function enable() { // controls act as long as the session runs and the page takes part and is not cut off
  const ended = Boolean(page.frame?.ended);
  const able = page.takesPart && !late && !ended;
  for (const control of document.querySelectorAll(CONTROLS)) control.disabled = !able;
  for (const button of document.querySelectorAll("#alarms button")) { // who does not take part yet begins with that
    button.disabled = late || ended;
    button.textContent = page.takesPart ? RELEASES[button.dataset.order] : page.asks ? "asking ..." : "Take part";
  }
  $("part").disabled = late || ended;
  $("stop").disabled = !page.stops || ended || socket?.readyState !== WebSocket.OPEN;
  document.body.classList.toggle("ended", ended);
}

const tell = (text, kind = "") => { // the line that says what to do
  if ($("todo").textContent === text && $("todo").className === kind) return;
  $("todo").textContent = text;
  $("todo").className = kind;
};

function advise(frame) {
  const { hello } = page;
  const able = parts.arms.cards.filter((card) => card.graspable).map((card) => card.name);
  const held = parts.arms.cards.filter((card) => card.hold).map((card) => card.name);
  if (frame.ended && frame.results.length) return results(frame.results);
  if (frame.ended) return tell(hello.ends ? "The session has ended. Its log is being checked; report and log will be here." : "The session has ended.");
  if (frame.silent_s) return tell(`No site has been heard for ${Math.floor(frame.silent_s)} s: what this page shows is old. It waits, and goes on as soon as they are heard.`, "late");
  const still = Object.values(frame.sites).some(({ alarm }) => alarm?.order);
  if (still && hello.role !== "experimenter") return tell("Arms are stopped; the experimenter lets them follow again.");
  if (still && !frame.takes_part) return tell("Arms are stopped. Take part to let them follow again.");
  if (still) return tell("Arms are stopped. The button beside the reason lets them follow again.");
  if (held.length) return tell(`You hold ${held.join(" and ")}: lead the end where it shall go, and let go when you are there.`);
  const where = hello.as ? "your arm" : able.length > 1 ? "an arm" : able[0];
  if (able.length && FINGERS.matches) return tell(`Drag the ring at the end of ${where}. STOP stops every arm.`);
  if (able.length) return tell(`Drag the ring at the end of ${where}, or press space and the arrow keys. STOP or Esc stops every arm.`);
  if (hello.role === "experimenter" && !frame.takes_part) return tell(frame.asks ? "Asking the pages that hold an arm ..." : "You watch. Press “take part” to hold arms and change links.");
  if (hello.role === "experimenter") return tell("Change links and dominance at the side; no arm here can be held.");
  tell(page.stops ? "You watch. STOP or Esc stops every arm." : "You watch.");
}

function lastResort() { // what stops the arms where this page cannot; only an experimenter has a terminal
  if (page.hello?.role === "experimenter") return `To stop every arm: trilat stop --session ${page.hello.session}`;
  return "Let go of your arm, and tell the experimenter.";
}

function results(paths) { // of a session that this program ran: its report and its log
  if ($("todo").querySelector("a")) return;
  $("todo").className = "";
  $("todo").replaceChildren("The session has ended. ", ...paths.map((path) => {
    const link = document.createElement("a");
    Object.assign(link, { href: path, target: "_blank", textContent: path.endsWith(".html") ? "Open its report" : `Save its log, ${path.split("/").pop()}` });
    if (!path.endsWith(".html")) link.download = path.split("/").pop();
    return link;
  }));
}

setInterval(() => { // what is shown is as old as the newest message; nobody is called silent for that
  const silent_ms = performance.now() - heardAt;
  const now = silent_ms > LATE_MS && Boolean(page.hello);
  if (now) {
    const seconds = Math.floor(silent_ms / 1000);
    if (page.frame?.ended) {
      state("ended");
      if (!$("todo").querySelector("a")) tell("The session has ended, and its server with it.");
    } else {
      state(`${seconds} s behind`, "bad");
      const old = `This page is ${seconds} s behind: what it shows is old, and its buttons are off`;
      tell(socket?.readyState === WebSocket.OPEN ? `${old} but for STOP, which may be late.` : `This page is cut off. ${old}. ${lastResort()}`, "late");
    }
  }
  if (now === late) return enable();
  late = now;
  document.body.classList.toggle("late", late && !page.frame?.ended);
  if (late) parts?.hands.letGo();
  enable();
}, 250);

function begin(hello) {
  page.hello = hello;
  $("title").textContent = hello.title || "trilat live";
  $("session").textContent = `session ${hello.session}`;
  $("end").hidden = !hello.ends;
  for (const role of ["experimenter", "user", "watcher"]) document.body.classList.toggle(role, hello.role === role);
  document.body.classList.toggle("as", Boolean(hello.as));
  document.body.classList.toggle("staged", Boolean(hello.stage)); // the stage says what to do
  $("whose").textContent = hello.as ? `as ${hello.as} knows it: its own arm now, the others as received` : "as it is, without delay";
  document.title = hello.running ? `${hello.name} – trilat live` : "trilat live";
  stage.take(hello.stage, page, parts?.arms);
  if (!hello.running && hello.stage) {
    parts?.hands.letGo();
    alarms({ sites: {} });
    page.stops = false; // there is no arm
    enable();
    return state("between trials");
  }
  if (!hello.running) {
    const missing = hello.missing.length ? `waiting for ${hello.missing.join(", ")}` : "waiting for the session";
    state(hello.here.length && !hello.missing.length ? "about to begin" : missing, "warn");
    const start = hello.role === "experimenter" && hello.missing.length ? `: trilat site ${hello.missing[0]}` : ".";
    tell(hello.missing.length ? `The session begins when ${hello.missing.join(" and ")} ${hello.missing.length > 1 ? "are" : "is"} there${start}` : "The session is about to begin.");
    return;
  }
  page.stops = Object.values(hello.sites).some((site) => site.stops);
  $("stop").dataset.tip = page.stops ? "stop every arm at once" : "the arms of this scenario stop only at the end of the session";
  enable();
  if (parts !== null) return renew(parts, hello, page.sites);
  page.sites = hello.sites;
  document.body.classList.add("begun"); // before its parts ask for their sizes
  const names = Object.keys(hello.sites);
  const arms = new Arms($("arms"), hello, (text) => { $("painter").textContent = text; });
  const hands = new Hands(arms, hello, send, page, stop);
  const network = hello.as ? null : new Network(hello, send, page); // what a site does not know is not on its user's page
  const plots = hello.as ? null : new Plots($("plots"), hello, page);
  const shares = hello.as ? null : new Shares($("shares"), $("share-rows"), hello, send, page);
  const headset = new Headset(arms, hands, page, send, stop, document.querySelector("header"));
  parts = { arms, hands, names, network, plots, shares, headset };
  page.parts = parts;
}

function take(frame) {
  if (parts === null) return;
  for (const site of Object.values(frame.sites)) {
    site.ended ??= frame.ended; // not known of a peer, as what follows
    for (const key of ["ghost", "hand", "wall", "pull"]) site[key] ??= [];
  }
  page.frame = frame;
  page.frames += 1;
  if (page.takesPart !== frame.takes_part) {
    page.takesPart = frame.takes_part;
    enable();
    $("part").setAttribute("aria-pressed", frame.takes_part);
  }
  if (page.asks && !frame.asks && !frame.takes_part) notice("nobody who holds an arm let this page take part");
  page.asks = frame.asks;
  const part = frame.takes_part ? "taking part" : frame.asks ? "asking ..." : "take part";
  if ($("part").textContent !== part) $("part").textContent = part;
  page.asked = frame.asked;
  $("ask").hidden = !frame.asked.length;
  if (frame.asked.length) $("ask").firstElementChild.textContent = `page ${frame.asked[0]} asks to take part.`;
  const silent = parts.names.filter((name) => frame.sites[name].silent_s);
  const diverged = parts.names.filter((name) => frame.sites[name].mode === "diverged");
  const stopped = alarms(frame);
  if (diverged.length) state(`${diverged.join(", ")} diverged`, "bad");
  else if (frame.ended) state("ended");
  else if (frame.silent_s) state(`silent for ${Math.floor(frame.silent_s)} s, waiting`, "warn");
  else if (stopped.length) state(stopped.length > 1 ? `${stopped.length} alarms` : stopped[0], "bad");
  else if (silent.length) state(`${silent.join(", ")} silent`, "bad");
  else state("running", "good");
  if (frame.ended) { $("end").hidden = true; enable(); }
  for (const { ok, text } of frame.notices) if (!ok && !frame.ended) notice(text);
  if (hidesAt && performance.now() > hidesAt) { $("notice").hidden = true; hidesAt = 0; }
  events(frame.events);
  parts.plots?.take(frame);
  stage.take(frame.stage, page, parts.arms);
  $("ages").checked = frame.ages;
  if (performance.now() < nextWords) return;
  nextWords = performance.now() + WORDS_MS;
  advise(frame);
  $("clock").textContent = `${frame.t.toFixed(1)} s`;
  if (page.hello.as) return;
  const pages = countNouns(frame.pages, "page");
  const behind = Math.max(...parts.names.map((name) => frame.sites[name].late_us));
  const refused = frame.refused ? ` · ${countNouns(frame.refused, "message")} refused` : "";
  const missing = parts.names.reduce((sum, name) => sum + frame.sites[name].missing, 0);
  $("counts").textContent = `${pages} · loops late by at most ${behind} µs · ${countNouns(missing, "record")} missing${refused}`;
}

let raised = "";
const RELEASES = { enable: "Enable", reset: "Reset" }; // the orders that end an alarm, as buttons name them
// What nobody may overlook: of arms that hold, are stopped or in fault the mode, why, and what to do; arms with
// one reason stand together. What ends it is a button for an experimenter, and for others who can end it.
function alarms(frame) {
  const alike = new Map();
  for (const name of parts?.names || []) {
    const { word, reason, advice, order } = frame.sites[name]?.alarm || {};
    const key = JSON.stringify([word, reason, advice]);
    if (word) alike.set(key, { word, reason, advice, order, names: [...(alike.get(key)?.names || []), name] });
  }
  const list = frame.ended ? [] : [...alike.values()];
  const text = JSON.stringify(list);
  if (text !== raised) {
    raised = text;
    $("alarms").replaceChildren(...list.map(raise));
    enable();
  }
  return list.map(({ names, word }) => `${names.join(", ")} ${word}`);
}

function raise({ word, reason, advice, order, names }) {
  const block = document.createElement("div");
  const add = (tag, words) => Object.assign(block.appendChild(document.createElement(tag)), { textContent: words });
  block.className = ["FAULT", "STOPPED"].includes(word) ? "raised" : "raised mild";
  add("strong", `${names.join(", ")} ${word}`);
  add("span", reason);
  if (order && page.hello.role !== "experimenter") add("b", "the experimenter lets it follow again");
  else if (advice) add("b", advice);
  if (order && page.hello.role === "experimenter") {
    const button = add("button", RELEASES[order]);
    button.type = "button";
    button.dataset.order = order;
    button.addEventListener("click", () => {
      const message = page.takesPart ? { do: "release", order, sites: names } : { do: "control", want: true };
      if (!send(message)) notice("not connected: nothing was ordered");
    });
  }
  return block;
}

const LOUD = ["lost", "left", "unheard", "diverged", "failed", "refused", "clock fault"];
function events(list) {
  for (const { t, member, kind, text } of list) {
    const item = document.createElement("li");
    const [time, who, what] = ["time", "span", "span"].map((tag) => item.appendChild(document.createElement(tag)));
    time.textContent = t === null ? "" : `${t.toFixed(2)} s`;
    who.textContent = member;
    what.textContent = text.replaceAll("->", " → ");
    if (LOUD.includes(kind)) what.className = "bad";
    $("event-list").prepend(item);
  }
  while ($("event-list").children.length > 200) $("event-list").lastChild.remove();
}

const BUSY_MS = 9;
const LAG_MS = 28;
let lag = 0;
let asked = 0;
let waiting = false;
let busy = 0;
let turn = 0;
function draw() {
  waiting = false;
  const frame = page.frame;
  if (parts === null || frame === null) return;
  const begun = performance.now();
  parts.arms.draw(frame);
  turn = (turn + 1) % (busy > BUSY_MS ? 4 : 1); // where drawing is slow, arms come first
  if (turn === 0) {
    parts.network?.draw(frame);
    parts.shares?.draw(frame);
    parts.plots?.draw();
  }
  busy += 0.1 * (performance.now() - begun - busy);
  lag += 0.1 * (begun - asked - lag);
  const rest = lag > LAG_MS ? Math.min(1.5 * lag, 200) : 0; // a machine that cannot keep up draws less, and hands come first
  if (rest) setTimeout(() => send({ do: "seen", n: frame.n }), rest);
  else send({ do: "seen", n: frame.n });
}

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const query = [location.search.slice(1), location.hash.slice(1)].filter(Boolean).join("&"); // the fragment is the token
  let opened = false;
  socket = new WebSocket(`${scheme}://${location.host}/socket?${query}`);
  socket.addEventListener("open", () => { pause = 500; opened = true; });
  socket.addEventListener("message", ({ data }) => {
    const message = JSON.parse(data);
    heardAt = performance.now();
    if (message.hello) {
      begin(message.hello);
      send({ do: "seen", n: message.hello.n });
      return;
    }
    take(message);
    if (!waiting) { waiting = true; asked = performance.now(); requestAnimationFrame(draw); }
    if (document.hidden) draw(); // no animation frames then: the connection stays alive all the same
  });
  socket.addEventListener("close", ({ code, reason }) => {
    state(page.frame?.ended ? "ended" : "not connected", page.frame?.ended ? "" : "bad");
    enable();
    parts?.hands.letGo();
    if (code === 1008) return notice(`the server closed this page: ${reason}`, 1e9);
    if (!opened) { // a browser does not say why
      fetch(`/socket?${query}`).then(async (answer) => { if (answer.status === 403) notice(`the server refuses this link: ${await answer.text()}`); }, () => {});
    }
    setTimeout(connect, pause);
    pause = Math.min(2 * pause, 8000);
  });
}

addEventListener("hashchange", () => location.reload()); // another link
$("ages").addEventListener("change", () => send({ do: "ages", shown: $("ages").checked }));
$("part").addEventListener("click", () => send({ do: "control", want: !page.takesPart }));
for (const answer of ["yes", "no"]) {
  $(`ask-${answer}`).addEventListener("click", () => send({ do: "answer", page: page.asked[0], yes: answer === "yes" }));
}
function stop() { // of whoever sees the page, whether it takes part or not
  parts?.hands.letGo();
  if ((page.hello?.running && !page.stops) || page.frame?.ended) return;
  if (send({ do: "stop" })) notice("stopping every arm", 3000);
  else notice(`This page is not connected and has stopped nothing. ${lastResort()}`, 1e9);
}
$("stop").addEventListener("pointerdown", stop); // at the press, not when it is let go
$("stop").addEventListener("click", ({ detail }) => { if (detail === 0) stop(); }); // by a key
$("end").addEventListener("click", () => { if (confirm("End the session for everybody?")) send({ do: "end" }); });
const mark = () => { send({ do: "mark", text: $("mark-text").value.trim() || "mark" }); $("mark-text").value = ""; };
$("mark").addEventListener("click", mark);
$("mark-text").addEventListener("keydown", (event) => { if (event.key === "Enter") { mark(); event.target.blur(); } });
addEventListener("keydown", (event) => {
  if (event.key === "Escape" && !event.repeat) stop();
  if (event.target.matches("input[type=text], select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
  if (page.hello?.role === "experimenter" && event.key.toLowerCase() === "m") mark();
  if (event.key.toLowerCase() === "f" && !event.repeat) fullScreen();
});

function fullScreen() { // the arms alone, on the whole screen where the browser lets it
  const on = document.body.classList.toggle("full");
  $("full").setAttribute("aria-pressed", on);
  if (on) document.documentElement.requestFullscreen?.().then(() => navigator.keyboard?.lock?.(["Escape"])).catch(() => {});
  else if (document.fullscreenElement) document.exitFullscreen();
}
$("full").addEventListener("click", fullScreen);
document.addEventListener("fullscreenchange", () => {
  if (document.fullscreenElement || !document.body.classList.contains("full")) return;
  fullScreen();
  if (!navigator.keyboard?.lock) stop(); // the browser keeps the Esc that leaves the full screen, and Esc stops every arm
});
for (const id of ["apart", "scene"]) {
  $(id).addEventListener("click", () => {
    parts?.arms.together(id === "scene");
    for (const one of ["apart", "scene"]) $(one).setAttribute("aria-pressed", one === id);
  });
}
// What was pressed with a pointer keeps no focus: keys then lead arms, wherever one has clicked.
for (const kind of ["click", "change"]) {
  addEventListener(kind, ({ target }) => { if (target.matches?.("button, select, input:not([type=text])") && !target.matches("button:focus-visible")) target.blur(); });
}

function showTip({ target }) {
  const owner = target.closest?.("[data-tip]");
  $("tip").hidden = !owner;
  if (!owner) return;
  $("tip").textContent = owner.dataset.tip;
  owner.setAttribute("aria-describedby", "tip");
  const [at, own] = [owner.getBoundingClientRect(), $("tip").getBoundingClientRect()];
  const above = at.bottom + own.height + 8 > innerHeight;
  $("tip").style.left = `${Math.max(4, Math.min(innerWidth - own.width - 4, at.left + at.width / 2 - own.width / 2))}px`;
  $("tip").style.top = `${above ? at.top - own.height - 5 : at.bottom + 5}px`;
}
for (const kind of ["pointerover", "focusin"]) addEventListener(kind, showTip);
for (const kind of ["pointerdown", "focusout", "scroll"]) addEventListener(kind, () => { $("tip").hidden = true; }, true);
connect();
