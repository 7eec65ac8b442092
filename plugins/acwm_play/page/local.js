// What an exported page has in place of the server: the model and recorded episodes.
"use strict";

// Looks like the socket to `play.js` and says the same messages; see `acwm_play/messages.py`.
class LocalServer {
  constructor() {
    this.readyState = WebSocket.OPEN;
    Object.assign(this, { paused: false, speed: 1, driver: "policy", wanted: null, again: false, stepping: false });
    Object.assign(this, { values: null, places: null, seq: 0, alone: 0, pace: 0, due: 0, wake: () => {} });
    Object.assign(this, { episode: null, at: 0, drifted: false, predicting: null, draw: null });
    this.run().catch((error) => this.tell("notice", { text: `The model cannot run in this browser: ${error.message}`, wrong: true }));
  }

  // What the page asks for ------------------------------------------------------------------------

  send(text) {
    const wish = JSON.parse(text);
    if (wish.type === "act") [this.values, this.places, this.seq] = [wish.values, null, wish.seq];
    else if (wish.type === "point") [this.values, this.places, this.seq] = [null, wish.places, wish.seq];
    else {
      this.note(wish);
      this.wake();
      this.tellState();
    }
  }

  note(wish) {
    if (wish.type === "open") this.wanted = wish;
    else if (wish.type === "take_over") this.again = true;
    else if (wish.type === "redraw") [this.again, this.draw] = [true, null];
    else if (wish.type === "pause") this.paused = wish.on;
    else if (wish.type === "step") this.stepping = true;
    else if (wish.type === "speed") this.speed = wish.value;
    else if (wish.type === "drive") {
      if (wish.by === "policy" && this.drifted) this.again = true; // continue where it stopped
      [this.driver, this.values, this.places] = [wish.by, null, null];
    }
  }

  // The loop --------------------------------------------------------------------------------------

  async run() {
    await new Promise(requestAnimationFrame); // the page sets its handlers
    this.tell("busy", { text: "Loading the model …" });
    this.about = JSON.parse(new TextDecoder().decode(await unpack("about")));
    this.engine = await Engine.begun();
    this.onopen();
    for (;;) {
      if (this.wanted) await this.open();
      else if (this.again) await this.start();
      else if (this.paused && !this.stepping) await new Promise((wake) => { this.wake = wake; });
      else await this.latentFrame();
    }
  }

  async open() {
    const { index } = this.wanted, { episodes } = this.about;
    const before = this.episode ? episodes.indexOf(this.episode) : -1;
    const named = episodes.find((each) => each.index === index);
    this.wanted = null;
    this.episode = named || episodes[(before + 1) % episodes.length];
    this.episode.pictures ??= await unpack(`episode${this.episode.index}`);
    this.at = this.about.given - 1;
    [this.values, this.places] = [null, null];
    const rest = this.episode.stills[this.at];
    this.tell("world", { ...this.about, index: this.episode.index, rest, places: this.placesOf(rest) });
    await this.start();
  }

  // The model begins from the recording's frame.
  async start() {
    this.again = false;
    await this.predicting;
    const { given, noise, size: [height, width] } = this.about;
    this.draw ??= Float32Array.from({ length: noise }, normal);
    const from = Math.max(this.at - given + 1, 0);
    const seen = await this.engine.start(this.recorded(from, from + given), [given, height, width], this.draw);
    [this.alone, this.drifted] = [0, false];
    this.show(this.recorded(this.at, this.at + 1), seen, [this.seq], true);
    this.tellState();
  }

  async latentFrame() {
    const { stride, fps } = this.about, began = performance.now();
    const actions = [], seqs = [], recorded = this.driver === "policy", first = this.at;
    this.stepping = false;
    if (recorded && first + stride >= this.episode.frames) { // it ends
      this.wanted = {};
      return;
    }
    while (actions.length < stride) {
      await this.tick(1000 / (fps * this.speed));
      if (this.wanted || this.again || (this.driver === "policy") !== recorded) return this.tell("state", this.state());
      seqs.push(this.seq);
      actions.push(recorded ? this.episode.actions[first + actions.length] : this.mine());
    }
    await this.predicting;
    this.pace = (performance.now() - began) / 1000 / stride;
    if (recorded) this.at = first + stride;
    else this.drifted = true;
    const frames = recorded ? this.recorded(first + 1, first + 1 + stride) : null;
    this.predicting = this.predict(actions, frames, seqs);
  }

  async predict(actions, frames, seqs) {
    const seen = await this.engine.step(actions), last = seqs.length;
    this.alone += last;
    const still = frames || this.recorded(this.at, this.at + 1);
    const beside = frames || new Uint8Array(seen.length).map((_, i) => still[i % still.length]);
    this.show(beside, seen, seqs, Boolean(frames), frames ? actions.at(-1) : null);
  }

  // Until the next frame is due; one that comes late delays those after it.
  async tick(interval) {
    const now = performance.now();
    this.due = this.paused ? now : Math.min(Math.max(this.due + interval, now), now + interval);
    await new Promise((go) => setTimeout(go, this.due - now));
  }

  // Actions ---------------------------------------------------------------------------------------

  // What the person wants, within bounds.
  mine() {
    const { controls, maps } = this.about;
    const asked = this.places ? this.places.flatMap((place, k) => moved(maps[k][0], place)) : this.values;
    return (asked || this.episode.stills[this.at]).map((value, i) => Math.fround(Math.min(controls[i].high, Math.max(controls[i].low, value))));
  }

  placesOf(action) {
    const { maps } = this.about;
    return maps.length ? maps.map(([, back], k) => moved(back, action.slice(2 * k, 2 * k + 2))) : null;
  }

  // What the page is told -------------------------------------------------------------------------

  recorded(from, to) {
    const { size: [height, width] } = this.about, bytes = height * width * 3;
    return this.episode.pictures.slice(from * bytes, to * bytes);
  }

  tell(type, more) { this.onmessage({ data: JSON.stringify({ type, ...more }) }); }

  state() { return { paused: this.paused, speed: this.speed, driver: this.driver, recording: false }; }

  tellState() { this.tell("state", this.state()); }

  show(beside, seen, seqs, compared, action = null) {
    const { size, fps } = this.about;
    const head = {
      n: seqs.length, size, seqs, alone: this.alone / fps, pace: this.pace, dropped: 0, recorded: 0,
      pixel_error: compared ? rootMeanSquare(beside, seen, size) : null,
      places: action && this.placesOf(action),
    };
    const text = new TextEncoder().encode(JSON.stringify(head));
    const packed = new Uint8Array(4 + text.length + 2 * seen.length);
    new DataView(packed.buffer).setUint32(0, text.length, true);
    packed.set(text, 4);
    packed.set(beside, 4 + text.length);
    packed.set(seen, 4 + text.length + seen.length);
    this.onmessage({ data: packed.buffer });
  }
}

// A standard normal number, by Box and Muller.
function normal() {
  return Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
}

// A point through a homography.
function moved(rows, [x, y]) {
  const [across, down, scale] = rows.map((row) => row[0] * x + row[1] * y + row[2]);
  return [across / scale, down / scale];
}

// Of the last frame of both, as a share of full scale.
function rootMeanSquare(one, other, [height, width]) {
  const from = one.length - height * width * 3;
  let sum = 0;
  for (let i = from; i < one.length; i += 1) sum += (one[i] - other[i]) ** 2;
  return Math.sqrt(sum / (one.length - from)) / 255;
}
