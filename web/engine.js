// What finds robots: the browser's GPU, or plain Rust in a worker. Both draw the picture, with the robot
// tinted, on the canvas, and have the same methods:
//   load(file, name)                       reads a model file, a Uint8Array
//   locate(picture, width, height, hfov)   searches an ImageBitmap or a <video>: see src/answer.rs
//   probabilities()                        the last mask at the network's size, a Float32Array
//   benchmark(progress)                    the JSON of the benchmark
//   verify(progress)                       the JSON of `whereabot verify`; the GPU alone has it
import init, { Gpu } from './whereabot_web.js';

class OnGpu {
  static async open(canvas, adapter) {
    const engine = new OnGpu();
    engine.name = nameOf(adapter.info);
    engine.gpu = await Gpu.open(canvas, engine.name, navigator.gpu.getPreferredCanvasFormat());
    return engine;
  }

  async load(file, name) {
    this.gpu.load(file, name);
  }

  async locate(picture, width, height, hfov) {
    return JSON.parse(await this.gpu.locate(picture, width, height, hfov));
  }

  probabilities() {
    return this.gpu.probabilities();
  }

  benchmark(progress) {
    return this.gpu.benchmark(progress);
  }

  verify(progress) {
    return this.gpu.verify(progress);
  }
}

class OnCpu {
  name = 'plain Rust';
  #worker = new Worker(new URL('worker.js', import.meta.url), { type: 'module' });
  #waiting = new Map();
  #count = 0;
  #pixels = new OffscreenCanvas(1, 1).getContext('2d', { willReadFrequently: true });

  constructor(canvas) {
    this.screen = canvas.getContext('2d');
    this.#worker.onmessage = ({ data: { number, result, error, progress } }) => {
      const task = this.#waiting.get(number);
      if (progress !== undefined) return task.progress?.(progress);
      this.#waiting.delete(number);
      if (error !== undefined) task.reject(new Error(error));
      else task.resolve(result);
    };
  }

  #ask(task, values = [], progress) {
    const number = this.#count++;
    this.#worker.postMessage([number, task, ...values]);
    return new Promise((resolve, reject) => this.#waiting.set(number, { resolve, reject, progress }));
  }

  load(file, name) {
    return this.#ask('load', [file, name]);
  }

  async locate(picture, width, height, hfov) {
    Object.assign(this.#pixels.canvas, { width, height });
    this.#pixels.drawImage(picture, 0, 0, width, height);
    const { data } = this.#pixels.getImageData(0, 0, width, height);
    const { answer, tinted } = await this.#ask('locate', [data, width, height, hfov]);
    this.screen.putImageData(new ImageData(new Uint8ClampedArray(tinted.buffer), width, height), 0, 0);
    return JSON.parse(answer);
  }

  probabilities() {
    return this.#ask('probabilities');
  }

  benchmark(progress) {
    return this.#ask('benchmark', [], progress);
  }
}

/// Opens the `wanted` engine, `gpu` or `cpu`; where none is wanted, the faster one. Gives the engine and, for
/// plain Rust, why it is not the GPU.
export async function open(canvas, wanted) {
  await init();
  const onCpu = (why) => ({ engine: new OnCpu(canvas), why });
  if (wanted === 'cpu') return onCpu('');
  const adapter = await navigator.gpu?.requestAdapter();
  if (wanted !== 'gpu') {
    if (!navigator.gpu) return onCpu('This browser has no WebGPU');
    if (!adapter) return onCpu('This browser has WebGPU, but offers no adapter');
    if (adapter.info.isFallbackAdapter) return onCpu('This browser runs WebGPU in software, which is slower');
  }
  if (!adapter) throw new Error('WebGPU: this browser offers no adapter');
  try {
    return { engine: await OnGpu.open(canvas, adapter), why: '' };
  } catch (error) {
    if (wanted) throw error;
    return onCpu(`WebGPU failed (${error.message})`);
  }
}

// Browsers hide some of it.
function nameOf({ vendor, architecture, device, description }) {
  return description || [vendor, architecture, device].filter(Boolean).join(' ') || 'unnamed GPU';
}
