"""``utopic train``: train a network on pairs synthesised on the fly."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from utopic_cli.commands.console import Console, Debug, Device, Quiet
from utopic_cli.errors import OutputError

if TYPE_CHECKING:
    from utopic_cli.synthesis.shapes import ShapeLibrary

RUN_FILES = ("checkpoint.pt", "utopic.safetensors", "utopic.json")
PROCEDURAL = "procedural"
PROCEDURAL_SHAPES = 200
PROCEDURAL_RESOLUTION = 32  # detail comes from the random warps
PROCEDURAL_SEED = 20221015  # another stream than any training seed; the shapes are always the same


def train(
    out: Annotated[
        Path, typer.Option(metavar="RUN", help="Folder of the run: checkpoint, log, exported weights.")
    ],
    data: Annotated[
        str,
        typer.Option(
            metavar="procedural|DIR", help="Shapes made on the fly, or a folder of packed meshes (.npz)."
        ),
    ] = PROCEDURAL,
    config: Annotated[
        str, typer.Option(metavar="NAME|FILE.toml", help="Settings: default, paper, or a file of your own.")
    ] = "default",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the run's checkpoint.")] = False,
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after this long, with a checkpoint and an export.")
    ] = None,
    start_from: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH", help="Weights to start from; their architecture must be the settings'."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=0, help="Processes that make pairs.")] = 1,
    device: Device = "auto",
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Train a network and export its weights.

    Checkpoints survive a kill: run the same command with --resume to go on.
    """
    check_run(out, resume)
    console = Console(quiet=quiet)
    from utopic_cli.model.weights import choose_device, load_weights
    from utopic_cli.training.config import read_training_config
    from utopic_cli.training.trainer import train as run_training

    settings = read_training_config(config)
    place = choose_device(device)
    first = load_weights(start_from)[0].state_dict() if start_from else None
    console.line("making procedural shapes" if data == PROCEDURAL else f"reading shapes from {data}")
    shapes = load_library(data)
    console.line(f"training on {place} with {len(shapes)} shapes")
    written = run_training(
        settings,
        shapes.select("train"),
        shapes.select("val"),
        out,
        resume=resume,
        minutes=minutes,
        device=place,
        workers=workers,
        start_from=first,
        progress=lambda record: console.line(describe(record)),
    )
    console.line(f"wrote {written}")
    console.line(f"use it: utopic align SOURCE TARGET --weights {written}")


def check_run(out: Path, resume: bool) -> None:
    """Refuse, before any work, a folder that can't be written or holds another run.

    Raises:
        OutputError: it is no folder, can't be made or written, or holds what a run leaves.
    """
    from utopic_cli.io.output import check_writable

    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is not a folder; name another place")
    held = [name for name in RUN_FILES if (out / name).exists()]
    if held and not resume:
        raise OutputError(
            f"{out}: holds a run already ({held[0]}); go on with --resume, or name another folder"
        )
    there = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    check_writable([there / RUN_FILES[0]], overwrite=True)


def load_library(data: str) -> ShapeLibrary:
    """Return the shapes to train on.

    Args:
        data: ``procedural``, or the path of packed meshes.

    Raises:
        InputError: nothing usable is there.
    """
    import numpy as np

    from utopic_cli.synthesis.shapes import load_shapes, procedural_shapes

    if data == PROCEDURAL:
        rng = np.random.default_rng(PROCEDURAL_SEED)
        return procedural_shapes(rng, PROCEDURAL_SHAPES, PROCEDURAL_RESOLUTION)
    return load_shapes(data)


def describe(record: dict[str, Any]) -> str:
    """Return one record of the training log as one line."""
    head = f"{record['pairs']}/{record['of']} pairs, {record['stage']}, {record['elapsed_s'] / 60:.1f} min"
    terms = {k: v for k, v in record.items() if k not in ("pairs", "of", "stage", "elapsed_s")}
    return ", ".join([head, *(f"{name} {value:g}" for name, value in terms.items())])
