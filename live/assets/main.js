// The page of a running session: the socket, the state of the page, and what belongs to no single part.
// Newest state wins: the server sends a frame when this page has drawn the one before.
import { Arms, WORDS_MS } from "./arms.js";
import { Hands } from "./hands.js";
import { Network, describeLink } from "./network.js";
import { Plots } from "./plots.js";
import { Shares } from "./shares.js";
import { renew, Stage } from "./stage.js";

const $ = (id) => document.getElementById(id);
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

const stage = new Stage(send); // of an experiment; without one it shows nothing

let hidesAt = 0;
let nextWords = 0;
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

function begin(hello) {
  page.hello = hello;
  $("title").textContent = hello.title || "trilat live";
  $("session").textContent = `session ${hello.session}`;
  $("end").hidden = !hello.ends;
  document.body.className = `${hello.role}${hello.as ? " as" : ""}`;
  $("whose").textContent = hello.as ? `as ${hello.as} knows it: its own arm now, the others as received` : "as it is, without delay";
  document.title = hello.running ? `${hello.name} – trilat live` : "trilat live";
  stage.take(hello.stage, page, parts?.arms);
  if (!hello.running && hello.stage) {
    parts?.hands.letGo();
    alarms({ sites: {} });
    $("stop").disabled = true; // there is no arm
    return state("between trials");
  }
  if (!hello.running) {
    const missing = hello.missing.length ? `waiting for ${hello.missing.join(", ")}` : "waiting for the session";
    state(hello.here.length && !hello.missing.length ? "about to begin" : missing, "warn");
    return;
  }
  const able = Object.values(hello.sites).filter((site) => site.stops).length;
  $("stop").disabled = !able;
  $("stop").title = able ? "stop every arm at once" : 'no arm of this scenario can be stopped: on_stale.action is not "glide"';
  if (parts !== null) return renew(parts, hello, page.sites);
  page.sites = hello.sites;
  const names = Object.keys(hello.sites);
  const arms = new Arms($("arms"), hello, (text) => { $("painter").textContent = text; });
  const hands = new Hands(arms, hello, send, page, stop);
  const network = hello.as ? null : new Network(hello, send, page); // what a site does not know is not on its user's page
  const plots = hello.as ? null : new Plots($("plots"), hello, page);
  const shares = hello.as ? null : new Shares($("shares"), $("share-rows"), hello, send, page);
  parts = { arms, hands, names, network, plots, shares };
  page.parts = parts;
}

function take(frame) {
  if (parts === null) return;
  for (const site of Object.values(frame.sites)) for (const key of ["ghost", "hand", "wall"]) site[key] ??= []; // not known of a peer
  page.frame = frame;
  page.frames += 1;
  if (page.takesPart !== frame.takes_part) {
    page.takesPart = frame.takes_part;
    for (const control of document.querySelectorAll("#link-form input, #link-form select, #link-form button, #mark, #mark-text, #end, #ages")) {
      control.disabled = !frame.takes_part;
    }
    $("part").setAttribute("aria-pressed", frame.takes_part);
  }
  if (page.asks && !frame.asks && !frame.takes_part) notice("nobody who holds an arm let this page take part");
  page.asks = frame.asks;
  const part = frame.takes_part ? "taking part" : frame.asks ? "asking ..." : "take part";
  if ($("part").textContent !== part) $("part").textContent = part;
  page.asked = frame.asked;
  $("ask").hidden = !frame.asked.length;
  if (frame.asked.length) $("ask").firstElementChild.textContent = `page ${frame.asked[0]} asks to take part.`;
  const silent = parts.names.filter((name) => frame.sites[name].silent);
  const diverged = parts.names.filter((name) => frame.sites[name].mode === "diverged");
  const stopped = alarms(frame);
  if (stopped.length) state(stopped.join(", "), "bad");
  else if (diverged.length) state(`${diverged.join(", ")} diverged`, "bad");
  else if (frame.ended) state("ended");
  else if (silent.length) state(`${silent.join(", ")} silent`, "bad");
  else state("running", "good");
  for (const { ok, text } of frame.notices) if (!ok) notice(text);
  if (hidesAt && performance.now() > hidesAt) { $("notice").hidden = true; hidesAt = 0; }
  events(frame.events);
  parts.plots?.take(frame);
  stage.take(frame.stage, page, parts.arms);
  $("ages").checked = frame.ages;
  if (performance.now() < nextWords) return;
  nextWords = performance.now() + WORDS_MS;
  $("clock").textContent = `${frame.t.toFixed(1)} s`;
  if (page.hello.as) return;
  const pages = frame.pages === 1 ? "1 page" : `${frame.pages} pages`;
  const late = Math.max(...parts.names.map((name) => frame.sites[name].late_us));
  const refused = frame.refused ? ` · ${frame.refused} messages refused` : "";
  const missing = parts.names.reduce((sum, name) => sum + frame.sites[name].missing, 0);
  $("counts").textContent = `${pages} · loops late by at most ${late} µs · ${missing} records missing${refused}`;
}

let raised = "";
// What nobody may overlook: of each arm that holds, is stopped or in fault the mode, why, and what to do.
function alarms(frame) {
  const list = (parts?.names || []).map((name) => [name, frame.sites[name]?.alarm]).filter(([, alarm]) => alarm);
  const text = JSON.stringify(list);
  if (text !== raised) {
    raised = text;
    $("alarms").replaceChildren(...list.map(([name, { word, reason, advice }]) => {
      const block = document.createElement("div");
      const [what, why, act] = ["strong", "span", "code"].map((tag) => block.appendChild(document.createElement(tag)));
      block.className = ["FAULT", "STOPPED"].includes(word) ? "raised" : "raised mild";
      what.textContent = `${name} ${word}`;
      why.textContent = reason;
      act.textContent = advice;
      return block;
    }));
  }
  return list.map(([name, { word }]) => `${name} ${word}`);
}

const LOUD = ["lost", "left", "unheard", "diverged", "failed", "refused", "clock fault"];
function describe({ link, dominance, to, at_s: at }) {
  const shares = () => Object.entries(to).map(([peer, share]) => `${peer} ${share.toFixed(2)}`).join(" + ");
  const what = link ? `${link.replace("->", " → ")}: ${describeLink(to)}` : `${dominance} follows ${shares()}`;
  return `${what}, from ${at.toFixed(2)} s on`;
}

function events(list) {
  for (const { t, member, kind, text, change } of list) {
    const item = document.createElement("li");
    const [time, who, what] = ["time", "span", "span"].map((tag) => item.appendChild(document.createElement(tag)));
    time.textContent = t === null ? "" : `${t.toFixed(2)} s`;
    who.textContent = member;
    what.textContent = change ? describe(change) : text;
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
  if ($("stop").disabled) return;
  if (send({ do: "stop" })) notice("stopping every arm", 3000);
  else notice(`not connected: nothing is stopped by this page; trilat stop --session ${page.hello?.session}`, 1e9);
}
$("stop").addEventListener("click", stop);
$("end").addEventListener("click", () => { if (confirm("End the session for everybody?")) send({ do: "end" }); });
const mark = () => { send({ do: "mark", text: $("mark-text").value.trim() || "mark" }); $("mark-text").value = ""; };
$("mark").addEventListener("click", mark);
$("mark-text").addEventListener("keydown", (event) => { if (event.key === "Enter") mark(); });
addEventListener("keydown", (event) => {
  if (event.key === "Escape" && !event.repeat) stop();
  if (page.hello?.role === "experimenter" && !event.target.matches("input, select, textarea") && event.key.toLowerCase() === "m" && !event.ctrlKey && !event.metaKey) mark();
});
connect();
