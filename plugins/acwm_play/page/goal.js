// The goal of a driver that plans: its picture, the distance to it, and what the driver is doing.
"use strict";

const PHASES = { starting: "getting ready …", planning: "planning …", acting: "acting", solved: "solved ✓" };
const HOLDING = ["starting", "planning", "solved"]; // meanwhile the simulator holds still

let attempt = { phase: null }, aim = null, since = 0, seconds = 0;

const engaged = () => Boolean(world) && world.drivers.some((each) => each.name === state.driver);

// The drivers and tasks of another world.
function offer(about) {
  for (const label of all(".choice .driver")) label.remove();
  about.drivers.forEach(({ name, summary }, k) => {
    const label = make("label", "", "driver"), input = make("input"), text = make("span");
    Object.assign(input, { type: "radio", name: "driver", value: name, checked: state.driver === name });
    input.onchange = () => { driveBy(name); input.blur(); };
    text.append(make("b", (name[0].toUpperCase() + name.slice(1)).replaceAll("_", " ")), ...(k ? [] : [make("kbd", "L")]));
    label.title = summary;
    label.append(input, text);
    document.querySelector("input[name=driver]").closest("fieldset").append(label);
  });
  $("task").replaceChildren(...about.tasks.map(({ name }) => new Option(name.replaceAll("_", " "), name)));
  $("task").hidden = about.tasks.length < 2;
}

// A scene begins without a goal.
function forgetGoal() {
  aim = null;
  delete history.distance;
  for (const name of ["distance", "decision"]) document.querySelector(`.tiles [data-name=${name}]`)?.remove();
  showAttempt();
}

function goal(message) {
  aim = message;
  seconds = 0;
  delete history.distance;
  const [height, width] = message.size, text = atob(message.pixels);
  draw($("goal"), Uint8Array.from(text, (each) => each.charCodeAt(0)), { height, width });
  const { summary } = world.tasks.find(({ name }) => name === message.task);
  $("aim").textContent = summary[0].toUpperCase() + summary.slice(1);
  $("task").value = message.task;
  showProgress(message, 0);
  showAttempt();
}

// How the simulator's frame stands to the goal; `passed` seconds after the one before.
function showProgress(now, passed) {
  if (!aim || !now) return;
  const { unit, tolerance } = world.tasks.find(({ name }) => name === aim.task);
  aim.solved = now.solved;
  seconds += passed;
  const small = now.failed ? "failed; start a new scene" : `solved within ${length(tolerance, unit)}`;
  tile("distance", "Distance to goal", length(now.distance, unit), small, now.solved ? "good" : now.failed ? "bad" : "");
  note("distance", seconds, now.distance);
  showAttempt();
}

const length = (value, unit) => unit ? measured(value, unit) : `${(100 * value).toFixed(1)} %`;

function attempted(message) {
  if (message.phase !== attempt.phase) since = performance.now();
  attempt = message;
  if (message.phase === "planning" && message.decisions === 0) tile("decision", "Decision time", "–", "", "");
  if (message.decisions) {
    const many = message.decisions > 1 ? `number ${message.decisions}` : "number 1";
    tile("decision", "Decision time", `${message.took.toFixed(1)} s`, many, "");
  }
  showAttempt();
}

function showAttempt() {
  $("attempt").hidden = !aim && !attempt.phase;
  $("attempt").classList.toggle("waiting", !aim);
  $("task").disabled = !engaged();
  const kind = phase(), [text, elapsed] = $("phase").children;
  $("phase").hidden = !kind;
  $("phase").dataset.kind = kind;
  if (text.textContent !== (PHASES[kind] || "")) text.textContent = PHASES[kind] || "";
  elapsed.textContent = kind === "planning" ? ` ${((performance.now() - since) / 1000).toFixed(1)} s` : "";
}

// What the shown frame says; the server is some frames ahead.
function phase() {
  if (aim && aim.solved) return "solved";
  return attempt.phase === "solved" ? "acting" : attempt.phase || "";
}

setInterval(() => { if (attempt.phase === "planning") showAttempt(); }, 100);
