"""``utopic calibrate``: teach weights of your own how far to trust their answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from utopic_cli.commands.bench_options import Data, Points, Workers, countdown, open_data
from utopic_cli.commands.console import DEFAULTS, MEASURING, Console, Debug, Device, Overwrite, Quiet, Seed
from utopic_cli.config import AlignOptions
from utopic_cli.errors import OutputError


def calibrate(
    weights: Annotated[
        Path, typer.Argument(metavar="WEIGHTS", help="A .safetensors file; its JSON card is completed.")
    ],
    data: Data = "procedural",
    trials: Annotated[
        int, typer.Option(min=40, help="Labelled pairs to learn from.", rich_help_panel=MEASURING)
    ] = 800,
    points: Points = DEFAULTS.points,
    workers: Workers = 1,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Fit the confidence of newly trained weights and write it into their card.

    Aligns labelled pairs, half of which have no right answer, of shapes held out from training.
    Without this, answers of such weights are never trusted.

    Example: [bold]utopic calibrate runs/mine/utopic.safetensors --data shapes/[/bold]
    """
    from utopic_cli.io.output import check_writable, write_atomically
    from utopic_cli.model.weights import find_weights, read_card

    path = find_weights(str(weights))
    card_path = path.with_suffix(".json")
    card = read_card(path)
    check_writable([card_path], overwrite=True)
    if card.get("calibration") is not None and not overwrite:
        raise OutputError(f"{card_path}: has a calibration already; use --overwrite to fit another")
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.calibration import calibrate as fit

        shapes = open_data(data, step)
        step("starting")
        options = AlignOptions(weights=str(path), points=points, device=device, seed=seed)
        found = fit(shapes, data, trials, seed, options, workers, countdown(step))
    card.pop("measured", None)  # with the calibration before
    completed = json.dumps({**card, "calibration": found.as_dict()}, indent=2, allow_nan=False) + "\n"
    write_atomically(card_path, completed.encode("utf-8"), overwrite=True)
    seen = found.description["out_of_fold"]
    console.line(
        f"{card_path}: calibrated on {found.description['answers']} answers, "
        f"{found.description['right']} of them right"
    )
    console.line(
        f"  on answers not learnt from: AUROC {seen['auroc']:.3f}, Brier {seen['brier']:.3f}, "
        f"calibration error {seen['expected_calibration_error']:.3f}"
    )
    console.line(f"  trusted from a confidence of {found.threshold:.0%}")
