// Plain Rust in a thread of its own, so that the page stays awake. Messages are [number, task, ...arguments];
// answers are {number, result}, {number, error} and {number, progress}.
import init, { Cpu } from './whereabot_web.js';

const ready = init();
let cpu;

const tasks = {
  load(_, file, name) {
    cpu = new Cpu(file, name);
  },
  async locate(_, pixels, width, height, hfov) {
    const { answer, pixels: tinted } = await cpu.locate(pixels, width, height, hfov);
    return { answer, tinted };
  },
  probabilities: () => cpu.probabilities(),
  benchmark: (number) => cpu.benchmark((progress) => postMessage({ number, progress })),
};

onmessage = async ({ data: [number, task, ...values] }) => {
  try {
    await ready;
    postMessage({ number, result: await tasks[task](number, ...values) });
  } catch (error) {
    postMessage({ number, error: error.message ?? String(error) });
  }
};
