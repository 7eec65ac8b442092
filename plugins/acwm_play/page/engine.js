// The model of an exported page: ONNX Runtime in a worker, which keeps the state of the stream.
"use strict";

// A part of the page's data: it was compressed and written as text.
async function unpack(name) {
  const text = atob(window.parts[name]), bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; i += 1) bytes[i] = text.charCodeAt(i);
  delete window.parts[name];
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// What the worker does; it sees nothing of the page.
function inference() {
  const sessions = {}, queue = [];
  let state = [], reference = null, working = false;

  async function begin({ glue, wasm, graphs }) {
    ort.env.wasm.numThreads = 1; // threads would need headers of a server
    ort.env.wasm.wasmPaths = { mjs: URL.createObjectURL(new Blob([glue], { type: "text/javascript" })) };
    ort.env.wasm.wasmBinary = wasm;
    for (const [name, graph] of Object.entries(graphs)) {
      sessions[name] = await ort.InferenceSession.create(graph, { executionProviders: ["wasm"] });
    }
  }

  async function run(name, ...tensors) {
    const session = sessions[name];
    const made = await session.run(Object.fromEntries(session.inputNames.map((each, k) => [each, tensors[k]])));
    return session.outputNames.map((each) => made[each]);
  }

  // Frames [1, n, 3, H, W] in [0, 1] as bytes [n, H, W, 3].
  function pixels({ data, dims: [, n, , height, width] }) {
    const size = height * width, made = new Uint8Array(data.length);
    for (let k = 0; k < n; k += 1) {
      for (let c = 0; c < 3; c += 1) {
        for (let i = 0; i < size; i += 1) {
          made[3 * (k * size + i) + c] = Math.round(255 * Math.min(1, Math.max(0, data[(3 * k + c) * size + i])));
        }
      }
    }
    return made;
  }

  const work = {
    begin,
    async start({ frames, dims: [n, height, width], draw }) {
      const size = height * width, data = new Float32Array(frames.length);
      for (let k = 0; k < n; k += 1) {
        for (let c = 0; c < 3; c += 1) {
          for (let i = 0; i < size; i += 1) data[(3 * k + c) * size + i] = frames[3 * (k * size + i) + c] / 255;
        }
      }
      reference = new ort.Tensor("float32", data.slice(-3 * size), [1, 3, height, width]); // the last of them
      const given = new ort.Tensor("float32", data, [1, n, 3, height, width]);
      const noise = draw.length ? [new ort.Tensor("float32", draw, [1, draw.length])] : [];
      const [latent, ...begun] = await run("start", given, ...noise);
      state = begun;
      const decoded = pixels((await run("decode", latent, reference))[n === 1 ? 0 : 1]);
      return decoded.slice(-3 * size);
    },
    async step({ actions }) {
      const rows = new ort.Tensor("float32", actions.flat(), [1, actions.length, actions[0].length]);
      const [latent, ...moved] = await run("step", rows, ...state);
      state = moved;
      return pixels((await run("decode", latent, reference))[1]);
    },
  };

  async function next() { // one after the other, in the order in which they were asked for
    working = true;
    while (queue.length) {
      const { id, what, ...rest } = queue.shift();
      try {
        postMessage({ id, answer: await work[what](rest) });
      } catch (error) {
        postMessage({ id, error: String(error) });
      }
    }
    working = false;
  }
  onmessage = ({ data }) => { queue.push(data); if (!working) next(); };
}

class Engine {
  // Loads everything; what goes wrong is thrown.
  static async begun() {
    const made = new Engine(), names = ["ort", "glue", "wasm", "start", "step", "decode"];
    const [script, glue, wasm, start, step, decode] = await Promise.all(names.map(unpack));
    const source = new Blob([script, `\n;(${inference})();`], { type: "text/javascript" });
    made.worker = new Worker(URL.createObjectURL(source));
    made.waiting = new Map();
    made.asked = 0;
    made.worker.onmessage = ({ data: { id, answer, error } }) => {
      const [good, bad] = made.waiting.get(id);
      made.waiting.delete(id);
      if (error) bad(new Error(error)); else good(answer);
    };
    await made.ask("begin", { glue, wasm, graphs: { start, step, decode } });
    return made;
  }

  ask(what, more) {
    this.asked += 1;
    const id = this.asked;
    return new Promise((good, bad) => {
      this.waiting.set(id, [good, bad]);
      this.worker.postMessage({ id, what, ...more });
    });
  }

  // The last of the given frames as the model sees it; the stream begins with them.
  // `draw` is the noise of a model that draws one of several futures, otherwise empty.
  start(frames, dims, draw) { return this.ask("start", { frames, dims, draw }); }

  // The frames of the next latent frame.
  step(actions) { return this.ask("step", { actions }); }
}
