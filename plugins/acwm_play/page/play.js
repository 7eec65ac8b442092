// The page of `acwm play`: shows the frames that the server sends and sends what the person does.
"use strict";

const $ = (id) => document.getElementById(id);
const all = (selector) => [...document.querySelectorAll(selector)];
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
const make = (tag, text = "", name = "") => {
  const made = document.createElement(tag);
  made.textContent = text;
  if (name) made.className = name;
  return made;
};

// What is known -----------------------------------------------------------------------------------

const FINE = 0.3; // of the way, while Shift is held
const POINT_SPEED = 0.7; // of the picture, per second
const HOLD_SPEED = 0.6; // of a dimension's range, per second
const STICK_REACH = 0.25; // of the picture: dragging so far is full speed

let socket = null, world = null, tries = 0, seq = 0, lastSent = "", hiddenPause = false;
let state = { paused: false, speed: 1, driver: "you", recording: false };
let queue = [], shownAt = 0, pace = 0, shownTimes = [], sentAt = new Map(), latency = null;
let values = [], places = [], pushes = new Map(); // pushes: by dimension, from sticks, −1 to 1
let entered = false; // whether the frames that come are of the world that was asked for
let history = {}, fresh = true, lastKeys = new Set(), padButtons = [];

// The socket --------------------------------------------------------------------------------------

function remote() {
  const address = new URL("socket", location.href);
  address.protocol = "ws:";
  return new WebSocket(address);
}

function connect() {
  socket = typeof LocalServer === "undefined" ? remote() : new LocalServer(); // in an exported page
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    tries = 0;
    $("banner").hidden = true;
    link("on", "connected");
    const scene = world ? { world: world.name, index: world.index, factors: world.asked } : {};
    say("open", scene);
    if (state.speed !== 1) say("speed", { value: state.speed });
    if (state.driver !== "you") say("drive", { by: state.driver, task: attempt.task });
    if (state.paused) say("pause", { on: true });
  };
  socket.onmessage = ({ data }) => typeof data === "string" ? hear(JSON.parse(data)) : frames(data);
  socket.onclose = ({ code, reason }) => {
    link("off", "not connected");
    queue = [];
    attempt.phase = null;
    show({ ...state, recording: false });
    lost(code, reason);
  };
}

async function lost(code, reason) {
  tries += 1;
  let text = "The server does not respond. Reconnecting …", wait = Math.min(400 * tries, 3000);
  if (code === 1013) [text, wait] = [`Too many pages: ${reason}. Close one to continue here.`, 3000];
  else if (code === 1008) text = `The server refused: ${reason}`;
  else {
    const answer = await fetch("play.js", { cache: "no-store" }).catch(() => null);
    if (answer && answer.status === 403) {
      text = "The server was restarted with another address: open the one that it printed.";
    }
  }
  $("banner").textContent = text;
  $("banner").hidden = false;
  setTimeout(connect, wait);
}

function say(type, more = {}) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ type, ...more }));
}

function hear(message) {
  if (message.type === "world") enter(message);
  else if (message.type === "state") show(message);
  else if (message.type === "figures") figures(message);
  else if (message.type === "goal") goal(message);
  else if (message.type === "attempt") attempted(message);
  else if (message.type === "busy") busy(message.text);
  else if (message.type === "notice") notice(message.text, message.wrong);
}

function link(kind, text) {
  $("link").dataset.state = kind;
  $("link-text").textContent = text;
}

// While a world is set up there is nothing to see, so its progress stands in place of the pictures.
function busy(text) {
  document.body.classList.add("busy");
  entered = false;
  $("setup-text").textContent = text;
  link("busy", "setting up");
}

let noticeTimer = 0;
function notice(text, wrong) {
  $("notice").textContent = text;
  $("notice").hidden = !text;
  $("notice").classList.toggle("wrong", Boolean(wrong));
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => { $("notice").hidden = true; }, wrong ? 20000 : 12000);
}

// Frames ------------------------------------------------------------------------------------------

const HEAT_LEVELS = [0, 0.15, 0.4, 0.7, 1];
const HEAT = [[13, 14, 22], [58, 22, 92], [176, 44, 98], [245, 132, 60], [255, 244, 196]];
const FULL_ERROR = 0.5; // colours and scale of acwm's reports
const heat = new Uint8Array(256 * 3);
for (let level = 0; level < 256; level += 1) {
  const share = Math.min(level / 255 / FULL_ERROR, 1);
  const k = Math.max(HEAT_LEVELS.findIndex((each) => each >= share), 1);
  const part = (share - HEAT_LEVELS[k - 1]) / (HEAT_LEVELS[k] - HEAT_LEVELS[k - 1]);
  for (let c = 0; c < 3; c += 1) heat[3 * level + c] = HEAT[k - 1][c] + part * (HEAT[k][c] - HEAT[k - 1][c]);
}

function frames(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const [height, width] = head.size, bytes = height * width * 3;
  pace = head.pace;
  for (let i = 0; i < head.n; i += 1) {
    const last = i === head.n - 1;
    queue.push({
      sim: new Uint8Array(buffer, 4 + length + i * bytes, bytes),
      model: new Uint8Array(buffer, 4 + length + (head.n + i) * bytes, bytes),
      doubt: last && head.doubt ? new Uint8Array(buffer, 4 + length + 2 * head.n * bytes, bytes) : null,
      seq: head.seqs[i], height, width, head: last ? head : null, compared: head.pixel_error !== null, fps: world ? world.fps : 10,
    });
  }
  const most = 3 * (world ? world.stride : 4); // a page that was asleep sees the present
  if (queue.length > most) queue = queue.slice(-most / 3);
}

function draw(canvas, picture, { height, width }) {
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const image = new ImageData(width, height), data = image.data;
  for (let i = 0, j = 0; j < picture.length; i += 4, j += 3) {
    data[i] = picture[j];
    data[i + 1] = picture[j + 1];
    data[i + 2] = picture[j + 2];
    data[i + 3] = 255;
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
}

function difference({ sim, model }) {
  const picture = new Uint8Array(sim.length);
  for (let j = 0; j < sim.length; j += 3) {
    const error = Math.max(Math.abs(sim[j] - model[j]), Math.abs(sim[j + 1] - model[j + 1]), Math.abs(sim[j + 2] - model[j + 2]));
    picture.set(heat.subarray(3 * error, 3 * error + 3), j);
  }
  return picture;
}

function heated(grey) {
  const picture = new Uint8Array(grey.length);
  for (let j = 0; j < grey.length; j += 3) picture.set(heat.subarray(3 * grey[j], 3 * grey[j] + 3), j);
  return picture;
}

function play(now) {
  requestAnimationFrame(play);
  pad();
  if (!entered) queue = [];
  if (!queue.length) return;
  const due = 1000 / queue[0].fps / state.speed;
  const interval = clamp(pace * 1000, due, 3 * due) * (queue.length > world.stride ? 0.9 : 1);
  if (now < shownAt + interval - 4) return;
  shownAt = Math.max(shownAt + interval, now - interval);
  const frame = queue.shift();
  draw($("sim"), frame.sim, frame);
  draw($("model"), frame.model, frame);
  if (frame.compared) draw($("diff"), difference(frame), frame);
  if (frame.head) showPoints(frame.head.keypoints || []);
  if (frame.head) draw($("doubt"), heated(frame.doubt || new Uint8Array(frame.sim.length)), frame);
  document.body.classList.toggle("uncompared", !frame.compared);
  document.body.classList.remove("busy");
  if (sentAt.has(frame.seq)) {
    const took = (now - sentAt.get(frame.seq)) / 1000;
    latency = latency === null ? took : 0.7 * latency + 0.3 * took;
    for (const each of sentAt.keys()) if (each <= frame.seq) sentAt.delete(each);
  }
  shownTimes = [...shownTimes.filter((each) => now - each < 3000), now];
  if (frame.head) headline(frame.head);
}

function headline(head) {
  $("alone-text").textContent = `${head.alone.toFixed(1)} s`;
  if (head.places && state.driver !== "you") rings(places = head.places);
  tile("alone", "Free-running time", `${head.alone.toFixed(1)} s`, `since the last true frame`);
  const error = head.pixel_error === null ? null : head.pixel_error * 100; // null: nothing is beside it
  note("pixel_error", head.alone, error);
  tile("pixel_error", "Pixel error", error === null ? "–" : `${error.toFixed(1)} %`, "root mean square");
  spread(head.alone, head.spread);
  showProgress(head.progress, head.n / world.fps);
  if (state.recording && head.recorded) {
    $("record").querySelector("span").textContent = `Stop · ${((head.recorded - 1) / world.fps).toFixed(0)} s`;
  }
  document.body.dataset.alone = head.alone;
  document.body.dataset.dropped = head.dropped;
}

const FULL_SPREAD = 0.06; // from here on the border of the model's picture is red

// Standard deviation of samples: null or undefined where it is not known.
function spread(at, share) {
  const known = typeof share === "number";
  if (!known && !document.querySelector(".tiles [data-name=spread]")) return;
  document.body.style.setProperty("--doubt", known ? Math.min(share / FULL_SPREAD, 1).toFixed(3) : 0);
  tile("spread", "Spread", known ? `${(share * 100).toFixed(1)} %` : "–", "of the model’s samples");
  note("spread", at, known ? share * 100 : null);
}

setInterval(() => {
  const busy = document.body.classList.contains("busy");
  if (!world || busy || !socket || socket.readyState !== WebSocket.OPEN) return;
  if (state.paused) return link("on", "paused");
  if (HOLDING.includes(attempt.phase)) return link("on", PHASES[phase()]);
  const span = shownTimes.length > 1 ? (shownTimes.at(-1) - shownTimes[0]) / (shownTimes.length - 1) : 0;
  const rate = span ? (1000 / span).toFixed(1) : "–";
  const delay = latency === null ? "" : ` · latency ${latency.toFixed(1)} s`;
  link("on", `${rate} frames/s${delay}`);
}, 500);

// Figures -----------------------------------------------------------------------------------------

const ORDER = ["distance", "decision", "alone", "position_error", "height_error", "mask_iou", "missing", "pixel_error", "spread"];
const PLAIN = ["alone", "missing", "decision"]; // without a curve

function tile(name, title, text, small = "", kind = "") {
  let made = document.querySelector(`.tiles [data-name=${name}]`);
  if (!made) {
    made = make("div");
    made.dataset.name = name;
    made.append(make("dt", title), make("dd"), make("small"));
    if (!PLAIN.includes(name)) made.append(make("canvas"));
    const after = all(".tiles div").find((each) => ORDER.indexOf(each.dataset.name) > ORDER.indexOf(name));
    $("tiles").insertBefore(made, after || null);
  }
  const [, value, note] = made.children;
  [value.textContent, value.className, note.textContent] = [text, kind, small || "\u00a0"];
  note.title = small;
}

function measured(value, unit) {
  if (value === null || value === undefined) return "–";
  if (unit === "m") return value < 0.1 ? `${(value * 100).toFixed(value < 0.01 ? 2 : 1)} cm` : `${(value * 100).toFixed(0)} cm`;
  return unit ? `${value.toPrecision(2)} ${unit}` : `${Math.round(value * 100)} %`;
}

function figures(read) {
  if (!world) return;
  const titles = { mask_iou: "Mask overlap" };
  for (const [name, { title, unit }] of Object.entries(world.metrics)) {
    const floor = read.floors[name];
    const small = floor === undefined || floor === null ? "" : `noise floor: ${measured(floor, unit)}`;
    tile(name, titles[name] || title, measured(read.values[name], unit), small);
    note(name, read.alone, read.values[name]);
  }
  if (!world.why_not) {
    const names = read.missing.map((each) => each.replaceAll("_", " ")).join(", ");
    const count = read.missing.length;
    tile("missing", "Missing objects", count ? `${count}` : "none", names || "all are visible", count ? "bad" : "");
  }
}

function note(name, at, value) {
  if (value === null || value === undefined) return;
  const past = history[name] ??= [];
  if (past.length && at < past.at(-1)[0]) past.length = 0;
  past.push([at, value]);
  if (past.length > 600) past.splice(0, 200);
  spark(name, past);
}

function spark(name, past) {
  const canvas = document.querySelector(`.tiles [data-name=${name}] canvas`);
  if (!canvas || !canvas.clientWidth) return;
  const scale = window.devicePixelRatio || 1, width = canvas.clientWidth * scale, height = canvas.clientHeight * scale;
  if (canvas.width !== Math.round(width)) [canvas.width, canvas.height] = [Math.round(width), Math.round(height)];
  const context = canvas.getContext("2d"), span = Math.max(past.at(-1)[0] - past[0][0], 10);
  const most = Math.max(...past.map((each) => each[1]), 1e-9) * 1.1;
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.strokeStyle = getComputedStyle(canvas).color;
  context.lineWidth = 1.6 * scale;
  context.lineJoin = "round";
  context.beginPath();
  for (const [at, value] of past) {
    context.lineTo(((at - past[0][0]) / span) * (width - 4) + 2, height - 2 - (value / most) * (height - 4));
  }
  context.stroke();
}

// The world and its controls ----------------------------------------------------------------------

function enter(about) {
  const another = !world || world.name !== about.name;
  world = about;
  [queue, history, fresh, latency] = [[], {}, true, null];
  entered = true;
  sentAt.clear();
  pushes.clear();
  values = [...about.rest];
  places = about.places || [];
  lastSent = "";
  if (another) {
    $("tiles").replaceChildren();
    for (const [name, metric] of Object.entries(about.metrics)) tile(name, name === "mask_iou" ? "Mask overlap" : metric.title, "–");
    menu(about);
    offer(about);
    dials(about);
  }
  document.title = `${about.environment} · acwm play`;
  document.querySelector(".sim figcaption b").textContent = about.recorded ? "Recording" : "Simulator";
  document.body.classList.toggle("recorded", about.recorded);
  document.body.classList.toggle("drawing", Boolean(about.samples));
  $("redraw").hidden = !(about.samples || about.noise);
  document.body.classList.toggle("wide-frames", about.size[1] > 1.5 * about.size[0]);
  $("engine").textContent = about.engine;
  $("summary").textContent = about.summary;
  for (const row of all(".views")) {
    row.replaceChildren(...about.views.map((each) => make("span", each)));
    row.hidden = !about.views.length;
  }
  badges(about);
  forgetGoal();
  factorList(about);
  rings(places);
  turned();
  document.body.dataset.scene = about.index;
}

function badges(about) {
  const shifted = about.ood.map((each) => make("span", `out of distribution: ${each.replaceAll("_", " ")}`, "ood"));
  $("badges").replaceChildren(make("span", `${about.recorded ? "episode" : "scene"} ${about.index}`), ...shifted);
}

function menu(about) {
  $("world").replaceChildren(...about.menu.map(([name, place]) => new Option(name === place ? name : `${name} · ${place}`, name, false, name === about.name)));
  $("world").disabled = about.menu.length < 2;
}

const KEY_NAMES = { ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓" };
const keyName = (code) => KEY_NAMES[code] || code.replace("Key", "");

function dials(about) {
  const how = $("how"), pointed = about.points > 0;
  const first = about.controls.filter((each) => each.place < 2 && each.keys);
  how.replaceChildren();
  const keys = first.flatMap((each) => each.keys).map((code) => make("kbd", keyName(code)));
  if (pointed) how.append("Drag in either picture, or use ", ...keys);
  else how.append("Drag in a picture as on a joystick, or use ", ...keys, ", the sliders or a gamepad");
  how.append(", with ", make("kbd", "Shift"), " for smaller steps.");
  $("why").textContent = about.stride > 1
    ? `The model predicts ${about.stride} frames at once, so both pictures are delayed by ${(about.stride / about.fps).toFixed(1)} s. They always show the same moment.`
    : "Both pictures always show the same moment.";
  $("stick").hidden = pointed || about.controls.length < 2;
  $("dials").replaceChildren(...(pointed ? [] : about.controls.map(dial)));
  if (pointed && about.points > 1) {
    how.append(" The second one: ", ...about.controls.slice(2, 4).flatMap((each) => each.keys || []).map((code) => make("kbd", keyName(code))), ".");
  }
}

function dial(control, index) {
  const row = make("div", "", "dial"), slider = make("input"), name = make("span", `${control.label} `);
  if (control.keys) name.append(...control.keys.map((code) => make("kbd", keyName(code))));
  Object.assign(slider, { type: "range", min: control.low, max: control.high, step: (control.high - control.low) / 200 });
  slider.setAttribute("aria-label", control.label);
  slider.oninput = () => { mine(); values[index] = Number(slider.value); act(); };
  const back = () => { if (!control.holds) { values[index] = world.rest[index]; act(); } };
  slider.onchange = back;
  slider.onpointerup = () => { back(); slider.blur(); };
  row.append(name, make("output"), slider);
  return row;
}

function turned() {
  const now = actual();
  all(".dial").forEach((row, i) => {
    const { unit, low, high } = world.controls[i], digits = high - low < 1 ? 3 : 2;
    if (document.activeElement !== row.querySelector("input")) row.querySelector("input").value = now[i];
    row.querySelector("output").textContent = `${now[i].toFixed(digits)} ${unit}`;
  });
  const [x, y] = [0, 1].map((place) => {
    const i = world.controls.findIndex((each) => each.place === place);
    if (i < 0) return 0;
    const { low, high, sign } = world.controls[i];
    return ((now[i] - (low + high) / 2) / ((high - low) / 2)) * sign;
  });
  const knob = $("stick").firstElementChild;
  [knob.style.left, knob.style.top] = [`${50 + 33 * x}%`, `${50 - 33 * y}%`];
}

// All of it that is pushed now: held values, and what keys and sticks add.
function actual() {
  return world.controls.map(({ low, high, holds }, i) => {
    const push = holds ? 0 : pushes.get(i) || 0;
    return clamp(values[i] + (push > 0 ? push * (high - world.rest[i]) : push * (world.rest[i] - low)), low, high);
  });
}

function mine() {
  if (state.driver !== "you") { state.driver = "you"; say("drive", { by: "you" }); show(state); }
}

function act() {
  const pointed = world.points > 0;
  const message = pointed ? { places } : { values: actual() };
  const text = JSON.stringify(message);
  if (text === lastSent || state.driver !== "you") return;
  lastSent = text;
  seq += 1;
  sentAt.set(seq, performance.now());
  if (sentAt.size > 200) sentAt.delete(sentAt.keys().next().value);
  say(pointed ? "point" : "act", { ...message, seq });
  if (pointed) rings(places);
  turned();
}

function rings(shown) {
  for (const screen of all(".screen[data-touch]")) {
    screen.querySelectorAll(".ring").forEach((ring, k) => {
      const place = world && world.points ? shown[k] : null;
      ring.classList.toggle("on", Boolean(place));
      if (place) [ring.style.left, ring.style.top] = [`${100 * place[0]}%`, `${100 * place[1]}%`];
    });
  }
}

// Things that the model sees and that can be dragged: their numbers and places, in the model's picture.
const NEAR = 0.12; // of the picture
let keypoints = [], dragged = null;

function showPoints(seen) {
  const screen = document.querySelector(".model .screen");
  if (!dragged) keypoints = seen;
  $("points").hidden = !seen.length;
  const shown = $("points").getAttribute("aria-pressed") === "true" ? keypoints : [];
  while (screen.querySelectorAll(".dot").length > shown.length) screen.querySelector(".dot").remove();
  while (screen.querySelectorAll(".dot").length < shown.length) screen.append(make("i", "", "dot"));
  screen.querySelectorAll(".dot").forEach((dot, k) => {
    const [number, x, y] = shown[k];
    [dot.style.left, dot.style.top, dot.style.background] = [`${100 * x}%`, `${100 * y}%`, `hsl(${(47 * number) % 360} 85% 55%)`];
  });
}

function nearestPoint([x, y]) {
  if ($("points").getAttribute("aria-pressed") !== "true" || !keypoints.length) return null;
  const far = (point) => Math.hypot(point[1] - x, point[2] - y);
  const best = keypoints.reduce((a, b) => far(b) < far(a) ? b : a);
  return far(best) < NEAR ? best : null;
}

function drag(point, here) {
  [point[1], point[2]] = here.map((part) => clamp(part, 0, 1));
  say("move", { number: point[0], place: [point[1], point[2]] });
  showPoints(keypoints);
}

// What is asked for lies within the bounds of actions.
function inReach(place, k) {
  const [from, to] = world.reach.map((each) => each[k]);
  return place.map((each, i) => clamp(each, Math.min(from[i], to[i]), Math.max(from[i], to[i])));
}

// Pushes along the first two dimensions, x to the right and y up, each from −1 to 1.
function lean(x, y) {
  for (const [place, way] of [[0, x], [1, y]]) {
    const i = world.controls.findIndex((each) => each.place === place);
    if (i >= 0) pushes.set(i, way * world.controls[i].sign);
  }
  act();
}

// Pointer: places in the picture, or a stick that begins where it is pressed.
for (const screen of all(".screen[data-touch]")) {
  let grabbed = null;
  const at = (event) => {
    const box = screen.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };
  const marks = (on, origin, knob) => {
    const [ring, dot] = [screen.querySelector(".ring"), screen.querySelector(".origin")];
    ring.classList.toggle("on", on);
    dot.classList.toggle("on", on);
    if (!on) return;
    [dot.style.left, dot.style.top] = origin.map((each) => `${100 * each}%`);
    [ring.style.left, ring.style.top] = knob.map((each) => `${100 * each}%`);
  };
  const move = (event) => {
    const here = at(event);
    if (world.points) {
      places = places.map((place, k) => k === grabbed ? inReach(here, k) : place);
      return act();
    }
    const way = here.map((each, k) => clamp((each - grabbed[k]) / STICK_REACH, -1, 1));
    marks(true, grabbed, here);
    lean(way[0], -way[1]);
  };
  screen.addEventListener("pointerdown", (event) => {
    if (!world || event.button) return;
    event.preventDefault();
    screen.setPointerCapture(event.pointerId);
    dragged = screen.closest(".model") ? nearestPoint(at(event)) : null;
    if (dragged) return;
    mine();
    const here = at(event), far = (place) => Math.hypot(place[0] - here[0], place[1] - here[1]);
    grabbed = world.points ? places.reduce((best, place, k) => far(place) < far(places[best]) ? k : best, 0) : here;
    move(event);
  });
  screen.addEventListener("pointermove", (event) => {
    if (dragged) drag(dragged, at(event));
    else if (grabbed !== null) move(event);
  });
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
    screen.addEventListener(kind, () => {
      dragged = null;
      if (grabbed === null) return;
      grabbed = null;
      if (!world.points) { marks(false); lean(0, 0); }
    });
  }
}

{ // The stick beside the sliders.
  const stick = $("stick");
  let held = false;
  const move = (event) => {
    const box = stick.getBoundingClientRect();
    const way = [event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2];
    lean(...way.map((each, k) => clamp((each / (box.width * 0.33)) * (k ? -1 : 1), -1, 1)));
  };
  stick.addEventListener("pointerdown", (event) => { event.preventDefault(); stick.setPointerCapture(event.pointerId); held = true; mine(); move(event); });
  stick.addEventListener("pointermove", (event) => { if (held) move(event); });
  for (const kind of ["pointerup", "pointercancel"]) stick.addEventListener(kind, () => { held = false; lean(0, 0); });
}

// Keys --------------------------------------------------------------------------------------------

const HOTKEYS = { KeyN: "new", KeyB: "same", KeyX: "take", KeyZ: "redraw", KeyK: "points", Space: "pause", Period: "step", KeyV: "record" };
const typing = (target) => target.matches("select, input[type=range], input[type=radio]");

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || !world) return;
  const button = event.target.closest && event.target.closest("button");
  if (event.target.matches && typing(event.target) && (event.code.startsWith("Arrow") || event.code === "Space")) return;
  if (button && ["Space", "Enter"].includes(event.code)) return;
  const moves = world.controls.some((each) => each.keys && each.keys.includes(event.code));
  if (moves) {
    event.preventDefault();
    mine();
    lastKeys.add(event.code);
  } else if (!event.repeat && HOTKEYS[event.code]) {
    event.preventDefault();
    $(HOTKEYS[event.code]).click();
  } else if (!event.repeat && event.code === "KeyP") {
    driveBy(state.driver === "policy" ? "you" : "policy");
  } else if (!event.repeat && event.code === "KeyL" && world.drivers.length) {
    driveBy(engaged() ? "you" : world.drivers[0].name);
  }
  if (event.key === "Shift") lastKeys.add("Shift");
});
addEventListener("keyup", (event) => { lastKeys.delete(event.code); if (event.key === "Shift") lastKeys.delete("Shift"); });
addEventListener("blur", () => lastKeys.clear());

let heldKeys = false;
function held(pads) {
  return world.controls.map((control, i) => {
    if (!control.keys) return pads[control.place] || 0;
    const way = (lastKeys.has(control.keys[1]) - lastKeys.has(control.keys[0])) * (lastKeys.has("Shift") ? FINE : 1);
    return (world.points ? 1 : control.sign) * clamp(way + (pads[control.place] || 0), -1, 1);
  });
}

let beat = performance.now();
setInterval(() => {
  const now = performance.now(), passed = Math.min((now - beat) / 1000, 0.1);
  beat = now;
  if (!world) return;
  const ways = held(padAxes), any = ways.some(Boolean);
  if (!any && !heldKeys) return;
  heldKeys = any;
  if (state.driver !== "you") return;
  if (world.points) {
    const step = POINT_SPEED * passed;
    places = places.map(([x, y], k) => inReach([x + ways[2 * k] * step, y - ways[2 * k + 1] * step], k));
  } else {
    world.controls.forEach(({ holds, low, high }, i) => {
      if (holds) values[i] = clamp(values[i] + ways[i] * HOLD_SPEED * passed * (high - low), low, high);
      else pushes.set(i, ways[i]);
    });
  }
  act();
}, 33);

// A gamepad: sticks are the first four dimensions, triggers the fifth; A takes over, Y is a new scene.
let padAxes = [];
function pad() {
  const found = navigator.getGamepads ? [...navigator.getGamepads()].find(Boolean) : null;
  if (!found) { padAxes = []; return; }
  const dead = (value) => Math.abs(value) < 0.15 ? 0 : value;
  const trigger = (k) => found.buttons[k] ? found.buttons[k].value : 0;
  padAxes = [dead(found.axes[0] || 0), -dead(found.axes[1] || 0), dead(found.axes[2] || 0), -dead(found.axes[3] || 0), trigger(7) - trigger(6)];
  if (world && padAxes.some(Boolean)) mine();
  const pressed = found.buttons.map((each) => each.pressed);
  for (const [k, id] of [[0, "take"], [3, "new"], [9, "pause"]]) if (pressed[k] && !padButtons[k]) $(id).click();
  padButtons = pressed;
}

// Buttons -----------------------------------------------------------------------------------------

function show(now) {
  state = { ...state, ...now };
  $("pause").setAttribute("aria-pressed", state.paused);
  $("pause").firstElementChild.textContent = state.paused ? "Continue" : "Pause";
  $("step").disabled = !state.paused;
  $("record").setAttribute("aria-pressed", state.recording);
  if (!state.recording) $("record").querySelector("span").textContent = "Record";
  for (const input of all("input[name=speed]")) input.checked = Number(input.value) === state.speed;
  for (const input of all("input[name=driver]")) input.checked = input.value === state.driver;
  showAttempt();
}

const open = (index, factors) => say("open", { world: world.name, index, factors });
function driveBy(by, task) {
  state.driver = by;
  if (by === "you" && world) [values, lastSent] = [[...world.rest], ""];
  say("drive", { by, task });
  show(state);
}

$("new").onclick = () => open(null, world.asked);
$("same").onclick = () => open(world.index, world.asked);
$("take").onclick = () => say("take_over");
$("redraw").onclick = () => say("redraw");
$("points").onclick = ({ currentTarget }) => {
  currentTarget.setAttribute("aria-pressed", currentTarget.getAttribute("aria-pressed") !== "true");
  showPoints(keypoints);
};
$("pause").onclick = () => say("pause", { on: !state.paused });
$("step").onclick = () => say("step");
$("record").onclick = () => say("record", { on: !state.recording });
$("usual").onclick = () => open(world.index, {});
$("task").onchange = (event) => { driveBy(state.driver, event.target.value); event.target.blur(); };
$("world").onchange = (event) => { say("open", { world: event.target.value }); event.target.blur(); };
for (const input of all("input[name=speed]")) input.onchange = () => { say("speed", { value: Number(input.value) }); input.blur(); };
for (const input of all("input[name=driver]")) input.onchange = () => { driveBy(input.value); input.blur(); };
addEventListener("click", (event) => { // so that Space pauses after a click, too
  const button = event.target.closest("button");
  if (button && event.detail) button.blur();
});
document.addEventListener("visibilitychange", () => {
  if (document.hidden && !state.paused) [hiddenPause] = [true, say("pause", { on: true })];
  else if (!document.hidden && hiddenPause) [hiddenPause] = [false, say("pause", { on: false })];
});

// Factors -----------------------------------------------------------------------------------------

function factorList(about) {
  $("usual").hidden = !Object.keys(about.asked).length;
  $("factors").replaceChildren(...about.factors.map((factor) => {
    const row = make("div", "", "factor"), drawn = about.drawn[factor.name];
    row.dataset.factor = factor.name;
    row.append(make("span", factor.name.replaceAll("_", " ")), make("output"));
    row.title = factor.description;
    row.classList.toggle("ood", about.ood.some((each) => each === factor.name || each.startsWith(`${factor.name}=`)));
    const change = (value) => open(about.index, { ...about.asked, [factor.name]: value });
    const chosen = factor.kind === "continuous" ? range(factor, drawn, change, row) : choice(factor, drawn, change);
    (chosen.querySelector("input") || chosen).setAttribute("aria-label", factor.name.replaceAll("_", " "));
    row.append(chosen);
    return row;
  }));
}

function range(factor, drawn, change, row) {
  const spans = [factor.train, ...factor.ood].flat(), box = make("div", "", "range"), band = make("i"), slider = make("input");
  const low = Math.min(...spans, drawn), high = Math.max(...spans, drawn);
  const text = (value) => `${Number(Number(value).toPrecision(3))} ${factor.unit}`;
  Object.assign(slider, { type: "range", min: low, max: high, step: (high - low) / 200, value: drawn });
  slider.min = low; slider.max = high; slider.value = drawn; // in this order, whatever was there
  row.querySelector("output").textContent = text(drawn);
  slider.oninput = () => { row.querySelector("output").textContent = text(slider.value); };
  slider.onchange = () => { slider.blur(); change(Number(slider.value)); };
  band.style.left = `${(100 * (factor.train[0] - low)) / (high - low)}%`;
  band.style.width = `${(100 * (factor.train[1] - factor.train[0])) / (high - low)}%`;
  box.append(band, slider);
  return box;
}

function choice(factor, drawn, change) {
  const select = make("select"), listed = [...new Set([...factor.train, ...factor.ood, drawn])];
  select.append(...listed.map((value, k) => {
    const seen = factor.train.includes(value) ? "" : " · not in training";
    return new Option(`${value}${seen}`, k, false, value === drawn);
  }));
  select.onchange = () => { select.blur(); change(listed[Number(select.value)]); };
  return select;
}

connect();
requestAnimationFrame(play);
