"""``utopic teach``: teach weights of your own to choose among poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from utopic_cli.commands.bench_options import Data, Workers, countdown, open_data
from utopic_cli.commands.console import DEFAULTS, MEASURING, Console, Debug, Overwrite, Quiet, Seed
from utopic_cli.errors import InputError, OutputError

if TYPE_CHECKING:
    from utopic_cli.model.pose_verifier import PoseVerifier


def teach(
    weights: Annotated[
        Path,
        typer.Argument(metavar="WEIGHTS", help="A .safetensors file; it and its JSON card are completed."),
    ],
    data: Data = "procedural",
    pairs: Annotated[
        int, typer.Option(min=40, help="Simulated pairs to learn from.", rich_help_panel=MEASURING)
    ] = 1500,
    start_from: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH",
            help="Weights whose verifier to go on from: with fewer pairs it learns what is new.",
            rich_help_panel=MEASURING,
        ),
    ] = None,
    workers: Workers = 1,
    overwrite: Overwrite = False,
    seed: Seed = DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Teach newly trained weights to choose among poses, and keep that in their file.

    Solves simulated pairs of the shapes trained on, and learns what right and wrong poses look like
    close up. Without this, the surfaces alone decide. A calibration does not outlast it: calibrate after.

    Example: [bold]utopic teach runs/mine/utopic.safetensors --data shapes/[/bold]
    """
    from utopic_cli.io.output import check_writable, write_together
    from utopic_cli.model.weights import find_weights, load_weights, pack_weights

    path = find_weights(str(weights))
    card_path = path.with_suffix(".json")
    model, card = load_weights(str(path), verifier=False)
    check_writable([path, card_path], overwrite=True)
    if card.get("verifier") is not None and not overwrite:
        raise OutputError(f"{path}: has learned to choose already; use --overwrite to teach it anew")
    first, before = (None, {}) if start_from is None else _verifier_of(start_from)
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.teaching import teach as run_teaching

        shapes = open_data(data, step)
        step("starting")
        model.verifier, described = run_teaching(
            str(path), shapes, data, pairs, seed, workers, countdown(step), first
        )
        if start_from is not None:
            described["before"] = before
    old = ("name", "sha256", "calibration", "measured")  # of the file as it was
    card = {name: value for name, value in card.items() if name not in old}
    blob, text = pack_weights(model, {**card, "verifier": described})
    write_together({card_path: text, path: blob}, overwrite=True)
    counts = described["out_of_fold"].values()
    proposed, surfaces, verifier = (
        sum(count[name] for count in counts)
        for name in ("right_proposed", "first_by_surfaces", "first_by_verifier")
    )
    console.line(f"{path}: learned from {described['poses']} poses for {described['pairs']} pairs")
    console.line(
        f"  of {proposed} pairs of shapes not learned from, with a right pose among those proposed, it puts "
        f"one first in {verifier}; the surfaces alone do in {surfaces}"
    )
    if first is not None:
        known = sum(count["first_by_verifier"] for count in described["as_it_started"].values())
        kept = ", and is kept as it was" if described["kept_as_it_started"] else ""
        console.line(f"  the verifier it went on from does in {known}{kept}")
    console.line(f"so that its answers can be trusted: utopic calibrate {path} --data {data}")


def _verifier_of(weights: str) -> tuple[PoseVerifier, dict[str, Any]]:
    """Return the verifier of some weights, and what their card says of it.

    Raises:
        InputError: they have none, or one of another version.
    """
    from utopic_cli.bridge import load_network

    model, card = load_network(weights, "cpu")
    if model.verifier is None:
        raise InputError(f"{weights}: has no verifier to go on from; leave out --start-from")
    return model.verifier, card["verifier"]
