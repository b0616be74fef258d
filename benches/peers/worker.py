"""One engine in a process of its own: `worker.py ENGINE PICTURES ANSWERS HEIGHT WIDTH THREADS MODEL`.

Reads f32 pictures of [3, HEIGHT, WIDTH], side by side in the file PICTURES; prints a line after the first answer and, with
all answers written to the file ANSWERS, another. Then each line from stdin, a number, is answered by as many times in ms,
after one frame that is not timed. `serve.rs` speaks the same way. An engine is a function of (model file, threads) that says
what it runs on, and a function from a picture [1, 3, H, W] to a mask and joints on the CPU.
"""

import itertools
import json
import sys
import time
from pathlib import Path

import numpy as np


def onnxruntime(model, threads):
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    return "CPU", lambda picture: session.run(["mask", "joints"], {"image": picture})


def openvino(precision):
    def start(model, threads):
        from openvino import Core

        compiled = Core().compile_model(model, "CPU", {
            "INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": precision})
        request = compiled.create_infer_request()

        def infer(picture):
            request.infer([picture], share_inputs=True)
            return [request.get_output_tensor(index).data.copy() for index in range(2)]
        return "CPU", infer
    return start


def ncnn(vulkan):
    def start(model, threads):
        import ncnn as lib

        net = lib.Net()
        net.opt.num_threads = threads
        net.opt.use_vulkan_compute = vulkan
        # In halves its answers would not be comparable with the others'.
        net.opt.use_fp16_packed = net.opt.use_fp16_storage = net.opt.use_fp16_arithmetic = False
        if vulkan and not lib.get_gpu_count():
            raise RuntimeError("no Vulkan device")
        for load, suffix in ((net.load_param, "param"), (net.load_model, "bin")):
            if load(f"{model}.{suffix}") != 0:
                raise RuntimeError(f"ncnn cannot load {model}.{suffix}")

        def infer(picture):
            with net.create_extractor() as extractor:
                extractor.input("in0", lib.Mat(picture[0]))
                results = [extractor.extract(name) for name in ("out0", "out1")]
                if any(status != 0 for status, _ in results):
                    raise RuntimeError("ncnn cannot run the network")
                return [np.array(value) for _, value in results]
        return lib.get_gpu_info(0).device_name() if vulkan else "CPU", infer
    return start


def torch(variant):
    """PyTorch with the trainer's own modules; MODEL is the whereabot model file. On CUDA a frame is timed as everywhere
    else: from a picture on the CPU to answers on the CPU.
    """
    def start(model, threads):
        sys.path.insert(0, str(Path(__file__).parents[2] / "trainer"))
        import torch as lib
        from whereabot_trainer.model import read_model
        from whereabot_trainer.networks import overlay

        mask_network, joint_network, description = read_model(model)
        lib.set_num_threads(threads)
        lib.set_grad_enabled(False)
        lib.backends.cudnn.benchmark = True
        # TF32 would be a third precision.
        lib.backends.cudnn.allow_tf32 = False
        device = lib.device("cpu" if variant == "cpu" else "cuda")
        dtype, layout = lib.float32, lib.contiguous_format
        networks = lib.nn.ModuleList([mask_network, joint_network]).to(device)
        if variant not in ("cpu", "eager"):
            dtype, layout = lib.float16, lib.channels_last
            for module in networks.modules():
                # Dense layers stay in f32, as in training: rounded coordinates alone cost millimetres.
                if isinstance(module, lib.nn.Conv2d):
                    module.to(dtype=dtype, memory_format=layout)

        def cascade(picture):
            picture = picture.to(dtype=dtype, memory_format=layout)
            mask = mask_network(picture)
            return mask, joint_network(overlay(picture, mask.to(dtype), description["overlay"]))

        run = lib.compile(cascade) if variant == "compile" else cascade
        if variant == "graph":
            still = lib.zeros(1, 3, *(description["input"][side] for side in ("height", "width")), device=device)
            stream = lib.cuda.Stream()
            stream.wait_stream(lib.cuda.current_stream())
            with lib.cuda.stream(stream):
                for _ in range(3):
                    cascade(still)
            lib.cuda.current_stream().wait_stream(stream)
            graph = lib.cuda.CUDAGraph()
            with lib.cuda.graph(graph):
                answers = cascade(still)

            def run(picture):
                still.copy_(picture)
                graph.replay()
                return answers

        def infer(picture):
            return [value.float().cpu().numpy() for value in run(lib.from_numpy(picture).to(device))]
        return "CPU" if variant == "cpu" else lib.cuda.get_device_name(), infer
    return start


ENGINES = {
    "onnxruntime": onnxruntime,
    "openvino": openvino("f32"),
    "openvino-bf16": openvino("bf16"),
    "ncnn": ncnn(vulkan=False),
    "ncnn-vulkan": ncnn(vulkan=True),
    "torch": torch("cpu"),
    "torch-cuda": torch("eager"),
    "torch-cuda-f16": torch("f16"),
    "torch-cuda-compile": torch("compile"),
    "torch-cuda-graph": torch("graph"),
}


def main():
    engine, pictures, answers, height, width, threads, model = sys.argv[1:]
    pictures = np.fromfile(pictures, "<f4").reshape(-1, 1, 3, int(height), int(width))
    device, infer = ENGINES[engine](model, int(threads))

    def say(value):
        # Libraries print to stdout too: a line of ours begins with a mark.
        print(f"> {json.dumps(value)}", flush=True)

    found = []
    for number, picture in enumerate(pictures):
        found += [np.ravel(value).astype("<f4") for value in infer(picture)]
        if number == 0:
            say({"device": device})
    np.concatenate(found).tofile(answers)
    following = itertools.cycle(pictures)

    def timed():
        picture = next(following)
        clock = time.perf_counter()
        infer(picture)
        return (time.perf_counter() - clock) * 1e3

    say({"ms": timed()})
    for line in sys.stdin:
        timed()
        say([timed() for _ in range(int(line))])


if __name__ == "__main__":
    main()
