"""`python -m coec_lab.training render|train|export`: see the package."""

import argparse
import logging
from itertools import chain
from pathlib import Path

STEPS = 4900
"""Steps of the shipped network."""
SEED = 7
FIRST = 1000
"""Seed of the first street, above those of demonstrations and tests, which stay unseen."""


def main() -> None:
    """Runs the command line."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    parser = argparse.ArgumentParser(prog="python -m coec_lab.training", description="Our own depth network.")
    commands = parser.add_subparsers(required=True)
    render = commands.add_parser("render", help="render frames to learn from; goes on where it was stopped")
    render.add_argument("folder", type=Path)
    render.add_argument("--streets", type=int, default=228, help="how many seeds of streets, of 12 frames each")
    render.add_argument("--crowded", type=int, default=100, help="how many seeds of jams and halls, likewise")
    render.set_defaults(run=_render)
    train = commands.add_parser("train", help="train on a folder of frames; goes on from the checkpoint")
    train.add_argument("folder", type=Path)
    train.add_argument("checkpoint", type=Path)
    train.add_argument("--steps", type=int, default=STEPS)
    train.add_argument("--seed", type=int, default=SEED)
    train.add_argument("--threads", type=int, default=2)
    train.set_defaults(run=_train)
    export = commands.add_parser("export", help="write the ONNX file of a checkpoint")
    export.add_argument("checkpoint", type=Path)
    export.add_argument("network", type=Path)
    export.set_defaults(run=_export)
    arguments = parser.parse_args()
    arguments.run(arguments)


# Each command imports only what it needs: rendering needs no torch, training no Embree.


def _render(arguments: argparse.Namespace) -> None:
    from coec_lab.training import training_frames, training_scenes
    from coec_lab.training.training_scenes import CROWDED

    arguments.folder.mkdir(parents=True, exist_ok=True)
    there = set(training_frames.towns(arguments.folder))
    seeds = [range(first, first + n) for first, n in ((FIRST, arguments.streets), (CROWDED, arguments.crowded))]
    for seed in chain(*seeds):
        if training_frames.path_of(arguments.folder, seed) not in there:
            logging.info("%s", training_frames.write(arguments.folder, seed, training_scenes.frames(seed)))


def _train(arguments: argparse.Namespace) -> None:
    from coec_lab.training.train import train

    train(arguments.folder, arguments.checkpoint, arguments.steps, arguments.seed, arguments.threads)


def _export(arguments: argparse.Namespace) -> None:
    from coec_lab.training.network import export

    export(arguments.checkpoint, arguments.network)


if __name__ == "__main__":
    main()
