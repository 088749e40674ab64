"""``utopic train``: train a network on pairs synthesised on the fly."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from utopic_cli.commands.console import SHAPES, Console, Debug, Device, Quiet
from utopic_cli.errors import OutputError

if TYPE_CHECKING:
    from torch import Tensor

    from utopic_cli.synthesis.shapes import ShapeLibrary

RUN_FILES = ("checkpoint.pt", "utopic.safetensors", "utopic.json")
"""What may not be lost: curves and records without a checkpoint belong to a run that never got so far."""

PROCEDURAL = "procedural"


def train(
    out: Annotated[
        Path,
        typer.Option(metavar="RUN", help="Folder of the run: checkpoint, records, curves, exported weights."),
    ],
    data: Annotated[
        str,
        typer.Option(
            metavar=SHAPES,
            help="Shapes made on the fly, a folder of meshes or clouds of your own, or ModelNet40.",
        ),
    ] = PROCEDURAL,
    config: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE.toml", help="Settings: default, paper, variants, or a file of your own."
        ),
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
    synthesis: Annotated[
        Literal["auto", "workers", "device"],
        typer.Option(help="Where pairs are made: by worker processes, or in batches on the training device."),
    ] = "auto",
    device: Device = "auto",
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Train a network and export its weights.

    Checkpoints survive a kill: run the same command with --resume to go on.
    Open RUN/curves.html at any time to see how far it is.

    Example: [bold]utopic train --data shapes/ --out runs/mine --minutes 60[/bold]
    """
    # torchrun starts this several times; one of them writes and speaks for all.
    leads = os.environ.get("RANK", "0") == "0"
    if leads:
        check_run(out, resume)
    console = Console(quiet=quiet or not leads)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.commands.training_view import TrainingView
        from utopic_cli.model.weights import choose_device
        from utopic_cli.training.config import read_training_config
        from utopic_cli.training.pace import InterruptedRun
        from utopic_cli.training.trainer import train as run_training

        settings = read_training_config(config)
        place = choose_device(device)
        first, before = _network_of(start_from) if start_from else (None, [])
    shapes = load_library(data, console, resume)
    counts = {split: len(shapes.select(split)) for split in ("train", "val")}
    console.line(f"training on {place} with {counts['train']} shapes, {counts['val']} more to validate")
    try:
        with TrainingView(console) as view:
            written = run_training(
                settings,
                shapes.select("train"),
                shapes.select("val"),
                out,
                resume=resume,
                minutes=minutes,
                device=place,
                workers=workers,
                synthesis=synthesis,
                start_from=first,
                before=before,
                progress=view.show,
            )
    except InterruptedRun as stop:
        console.line(f"saved {out / RUN_FILES[0]} and exported {stop.weights}; go on: the same with --resume")
        raise
    for line in (view.outcome(), *describe_files(out, written, data)):
        console.line(line)


def _network_of(weights: str) -> tuple[dict[str, Tensor], list[dict[str, Any]]]:
    """Return the tensors of some weights, and the runs that they come from.

    Less the verifier: it learned from another network's matches.
    """
    from utopic_cli.model.weights import load_weights

    model, card = load_weights(weights, verifier=False)
    return model.state_dict(), list(card.get("runs", []))


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


def load_library(data: str, console: Console, resume: bool = False) -> ShapeLibrary:
    """Return the shapes to train on, and say which were skipped; when resuming, how many.

    Args:
        data: ``procedural``, a folder of shapes, or ``modelnet40:DIR``.
        console: told how far it is.
        resume: whether the run was told before which were skipped.

    Raises:
        InputError: nothing usable is there.
    """
    console.line("making procedural shapes" if data == PROCEDURAL else f"reading shapes from {data}")
    from utopic_cli.synthesis.packing import describe_skipped, open_shapes

    with console.progress() as step:
        step("looking")
        shapes = open_shapes(data, progress=lambda done, of, name: step(f"{done}/{of} shapes: {name}"))
    skipped = describe_skipped(shapes)
    if skipped and resume:
        console.line(skipped.split(":")[0])
    elif skipped:
        console.warnings((skipped,))
    return shapes


def describe_files(out: Path, weights: Path, data: str) -> list[str]:
    """Say where everything is that a run left, one line each."""
    library = f" --data {shlex.quote(data)}" if data != PROCEDURAL else ""
    lines = [
        f"wrote {weights}; use it: utopic align SOURCE TARGET --weights {weights}",
        f"so that it chooses well among poses: utopic teach {weights}{library}",
        f"so that its answers can be trusted: utopic calibrate {weights}{library}",
    ]
    if (out / "curves.html").is_file():
        lines.append(f"curves: {out / 'curves.html'}")
    if (out / "tensorboard").is_dir():
        lines.append(f"TensorBoard: tensorboard --logdir {out / 'tensorboard'}")
    return lines
