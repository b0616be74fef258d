"""The command line: `python -m whereabot_trainer COMMAND`."""

import argparse

import torch

from . import data, export, golden, pipeline, train
from .networks import OVERLAYS


def _training_flags(parser, *, minutes, batch, learning_rate, momentum, dilations):
    parser.add_argument("--recording", nargs="+", required=True, metavar="DIR", help="recordings to train on")
    parser.add_argument("--validation", nargs="+", metavar="DIR",
                        help="recordings to validate on (without: a random fifth of the others)")
    parser.add_argument("--validation-samples", type=int, default=100, metavar="N",
                        help="validate on at most so many samples (%(default)s)")
    parser.add_argument("--samples", type=int, metavar="N", help="train on at most so many samples")
    parser.add_argument("--init-from", metavar="MODEL", help="start from the weights of a model file, of any robot, or of"
                        " another run's folder")
    parser.add_argument("--out", required=True, metavar="RUN", help="folder for the checkpoint, log.csv and settings.json")
    parser.add_argument("--resume", action="store_true", help="go on from RUN/last.pt")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=float, default=minutes, metavar="M",
                        help="train for so long, resumed parts included; rates follow the clock (%(default)s)")
    length.add_argument("--iterations", type=int, metavar="N", help="train for N batches instead: reproducible")
    # A GPU takes as long for fewer.
    parser.add_argument("--batch", type=int, default=128 if torch.cuda.is_available() else batch, metavar="N",
                        help=f"samples a batch ({batch}, on a GPU 128)")
    parser.add_argument("--camera", choices=("free", "fixed"), default="free",
                        help="free: show other views too (mask: zoomed, tilted, mirrored; joints: a turned camera, parts"
                        " hidden); fixed: the recordings' camera stays where it is (%(default)s)")
    parser.add_argument("--dilations", type=_integers, default=dilations, metavar="D,D,...",
                        help="dilation of each convolution (%(default)s)")
    parser.add_argument("--optimizer", choices=("muon", "adamw", "sgd"), default="muon",
                        help="muon: for the hidden convolutions, AdamW for the rest (%(default)s)")
    parser.add_argument("--learning-rate", nargs=2, type=float, default=learning_rate, metavar=("START", "END"),
                        help="cosine from START to END (%(default)s)")
    parser.add_argument("--momentum", nargs=2, type=float, default=momentum, metavar=("START", "END"),
                        help="momentum of Muon and SGD, and beta1 of AdamW, growing linearly (%(default)s)")
    parser.add_argument("--weight-decay", type=float, default=1e-4, metavar="W", help="(%(default)s)")
    parser.add_argument("--clip-gradient", type=float, default=5.0, metavar="NORM", help="(%(default)s)")
    parser.add_argument("--normalise", action=argparse.BooleanOptionalAction, default=True,
                        help="batch normalisation while training, folded into the convolutions at export (%(default)s)")
    parser.add_argument("--evaluate-every", type=int, default=500, metavar="N",
                        help="validate and save every N batches (%(default)s)")
    parser.add_argument("--precision", choices=("bf16", "f32"), default="bf16", help="of the training pass (%(default)s)")
    _machine_flags(parser)


def _machine_flags(parser):
    parser.add_argument("--cache", default=".cache", metavar="DIR", help="folder for decoded images (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of weights, split and order (%(default)s)")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads (PyTorch's choice)")


def _integers(text):
    return tuple(int(part) for part in text.split(","))


def _prepare(args):
    args.device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.set_default_device(args.device)
    torch.manual_seed(args.seed)
    if args.threads:
        torch.set_num_threads(args.threads)


def _run(function):
    def run(args):
        _prepare(args)
        function(args)
    return run


def main(argv=None):
    parser = argparse.ArgumentParser(prog="whereabot_trainer", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("train", help="train and export one robot or several, from recordings to model files")
    command.add_argument("--recording", nargs="+", required=True, metavar="DIR", help="recordings to train on")
    command.add_argument("--validation", nargs="+", metavar="DIR",
                         help="recordings to validate on (without: the fifth of the others that is kept for testing)")
    command.add_argument("--family", choices=("paper", "context"), default="context",
                         help="the paper's networks, for each robot its own, or the context family's, whose mask network is"
                         " shared and whose joint networks start from a common one (%(default)s)")
    command.add_argument("--negatives", nargs="+", metavar="DIR", help="folders of photographs without a robot")
    command.add_argument("--minutes", type=float, default=120, metavar="M", help="of training in all (%(default)s)")
    command.add_argument("--out", required=True, metavar="DIR", help="folder for runs and model files; called again, it"
                         " goes on where it stopped")
    command.add_argument("--dtype", choices=("f32", "f16"), default="f16", help="of the tensors (%(default)s)")
    command.add_argument("--cache", default=".cache", metavar="DIR", help="folder for decoded images (%(default)s)")
    command.add_argument("--seed", type=int, default=1, metavar="S", help="of weights and order (%(default)s)")
    command.set_defaults(run=lambda args: pipeline.run(args, main))

    command = commands.add_parser("train-mask", help="train the mask network")
    _training_flags(command, minutes=40, batch=8, learning_rate=(4e-3, 2e-5), momentum=(0.95, 0.95),
                    dilations=(1, 3, 9, 27, 1))
    command.add_argument("--family", choices=("paper", "context"), default="paper",
                         help="the paper's network, or a wider one with skips that has no --dilations and no --kernel (%(default)s)")
    command.add_argument("--coarse", action="store_true",
                         help="train the context family's coarse network, which tells its mask network where to look")
    command.add_argument("--coarse-run", metavar="RUN", help="finished run of train-mask --coarse, or a model file, by whose masks the"
                         " network looks: it is trained on what it will see, without --crop and --zoom")
    command.add_argument("--kernel", type=int, default=3, metavar="K",
                         help="columns and rows of the paper's network's convolutions (%(default)s)")
    command.add_argument("--crop", nargs=2, type=int, default=(160, 128), metavar=("W", "H"),
                         help="pixels of a training crop (%(default)s)")
    command.add_argument("--zoom", nargs=2, type=float, default=(0.7, 1.6), metavar=("LEAST", "MOST"),
                         help="magnification of the crops (%(default)s)")
    command.add_argument("--negatives", nargs="+", metavar="DIR",
                         help="folders of photographs without a robot, to train on beside the recordings")
    command.add_argument("--negative-share", type=float, default=0.15, metavar="SHARE",
                         help="share of training samples that are such photographs (%(default)s)")
    command.set_defaults(run=_run(train.train_mask))

    command = commands.add_parser("train-joint", help="train the joint network")
    _training_flags(command, minutes=35, batch=16, learning_rate=(2e-3, 2e-5), momentum=(0.95, 0.95), dilations=(1, 2, 4))
    command.add_argument("--family", choices=("paper", "context"), default="paper",
                         help="the paper's network, or heat maps with votes, without --dilations and --pool (%(default)s)")
    command.add_argument("--heat-weight", type=float, default=0.02, metavar="W",
                         help="weight of the heat maps' own loss, context family alone (%(default)s)")
    command.add_argument("--pool", type=int, default=4, metavar="P", help="size of both max-pools (%(default)s)")
    command.add_argument("--overlay", choices=tuple(OVERLAYS),
                         help="colour where the mask is at least 0.5, colour times mask, or colour that fades in between 0.4"
                         " and 0.6 (paper: threshold, context: ramp)")
    command.add_argument("--mask-run", metavar="RUN", help="finished run of train-mask, or a model file, whose masks"
                         " the full system is validated with")
    command.add_argument("--coarse-run", metavar="RUN", help="finished run of train-mask --coarse, or a model file, by whose masks"
                         " --mask-run's network looks (without: as its model file has it)")
    command.add_argument("--estimated-masks", type=float, default=0.0, metavar="SHARE",
                         help="share of training samples with the mask run's masks for the true ones (%(default)s)")
    command.add_argument("--estimated-after", type=float, default=0.0, metavar="PROGRESS",
                         help="from this progress (0 to 1) on (%(default)s)")
    command.add_argument("--min-coverage", type=float, default=train.MIN_COVERAGE, metavar="SHARE",
                         help="leave out samples with less of the robot in view (%(default)s)")
    command.set_defaults(run=_run(train.train_joint))

    command = commands.add_parser("export", help="write the networks as a model file")
    command.add_argument("--mask", required=True, nargs="+", metavar="RUN", help="run of train-mask, or a model file whose mask"
                         " network stays; of several runs that started from each other, the mean of their weights, the first of which may be the"
                         " model file that they started from")
    command.add_argument("--coarse", metavar="RUN", help="run of train-mask --coarse, or a model file, by whose masks the mask network"
                         " looks (without: as its model file has it)")
    command.add_argument("--joint", required=True, nargs="+", metavar="RUN", help="run of train-joint, or a model file likewise; of several runs,"
                         " likewise")
    source = command.add_mutually_exclusive_group(required=True)
    source.add_argument("--validation", nargs="+", metavar="DIR",
                        help="recordings to choose the presence threshold and measure the figures on")
    source.add_argument("--recording", nargs="+", metavar="DIR",
                        help="recordings trained on: figures on the fifth of them that is kept for testing")
    command.add_argument("--validation-samples", type=int, default=100, metavar="N",
                         help="choose on N samples, the ones training validated on, and report on others (%(default)s)")
    command.add_argument("--robot", metavar="NAME", help="whose file it is, where the recordings are of several; theirs all"
                         " choose the presence threshold")
    command.add_argument("--out", required=True, metavar="FILE")
    command.add_argument("--dtype", choices=("f32", "f16"), default="f32", help="of the tensors (%(default)s)")
    command.add_argument("--no-fit", action="store_true", help="leave joints where the network puts them, instead of where an arm can"
                         " have them")
    command.add_argument("--note", default="", metavar="TEXT", help="what the card is to say about the data")
    command.add_argument("--licence", default="MIT OR Apache-2.0", help="of the weights (%(default)s)")
    _machine_flags(command)
    command.set_defaults(run=_run(export.export_runs))

    command = commands.add_parser("golden", help="write the golden files of the engine's tests")
    command.add_argument("--out", required=True, metavar="DIR")
    command.set_defaults(run=lambda args: golden.write_golden(args.out))

    args = parser.parse_args(argv)
    try:
        args.run(args)
    except data.RecordingError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
