"""``utopic bench ablation, attention, uncertainty``: the paper's tables of variants, trained and measured."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from utopic_cli.commands.bench_options import Common, countdown, open_data, table_console, with_common_options
from utopic_cli.commands.console import DEFAULTS, SHAPES, Console
from utopic_cli.errors import UsageError

if TYPE_CHECKING:
    from utopic_cli.benchmark.protocols import CropProtocol
    from utopic_cli.benchmark.variant_pairs import PairResult
    from utopic_cli.benchmark.variant_report import VariantReport
    from utopic_cli.commands.variant_runs import Experiment
    from utopic_cli.commands.variant_settings import Budget
    from utopic_cli.synthesis.shapes import ShapeLibrary
    from utopic_cli.training.config import TrainingConfig


AT_WORK = 5.0
"""Seconds that a variant takes at least unless it was finished before."""

TABLES = {
    "ablation": "Train the network without overlap, completion, uncertainty, geometric embedding; compare.",
    "attention": "Train with vanilla, absolute, learned and geometric self-attention; compare.",
    "uncertainty": "Train with predicted, no and sampled uncertainty, with and without masking; compare.",
}
MORE = """

All variants have one budget: the same pairs in the same order, the same rates, the same first weights.
Give it as --train-pairs, or as --minutes, which a short measurement turns into pairs. With --resume what
is finished is not done again. The tables may share a folder: variants they have in common are trained once.
"""


@dataclass(frozen=True)
class Asked(Common):
    """What the three commands are asked for alike."""

    table: str
    out: Path
    minutes: float | None
    train_pairs: int | None
    data: str
    config: str
    pairs: int
    points: int
    workers: int
    resume: bool


def variant_command(table: str) -> Callable[..., None]:
    """Return the command of one of ``TABLES``: they differ in nothing but the variants."""

    def command(
        common: Common,
        out: Annotated[
            Path, typer.Option(metavar="DIR", help="Folder of the experiment: a run for each variant.")
        ],
        minutes: Annotated[
            float | None,
            typer.Option(min=0.0, help="Train each variant for about so long, all on as many pairs."),
        ] = None,
        train_pairs: Annotated[
            int | None, typer.Option(min=1, help="Train each variant on so many pairs instead.")
        ] = None,
        data: Annotated[
            str,
            typer.Option(
                metavar=SHAPES,
                help="Shapes to train on; those held out from training make the test pairs.",
            ),
        ] = "procedural",
        config: Annotated[
            str,
            typer.Option(
                metavar="NAME|FILE.toml", help="Settings of the full network: variants, paper, a file."
            ),
        ] = "variants",
        pairs: Annotated[int, typer.Option(min=2, help="Number of test pairs.")] = 100,
        points: Annotated[
            int, typer.Option(min=50, help="Most points per cloud in the test.")
        ] = DEFAULTS.points,
        workers: Annotated[
            int, typer.Option(min=1, help="Processes that make pairs, and then answer the test pairs.")
        ] = 1,
        resume: Annotated[bool, typer.Option("--resume", help="Go on with the experiment in DIR.")] = False,
    ) -> None:
        run(
            Asked(
                **vars(common), table=table, out=out, minutes=minutes, train_pairs=train_pairs, data=data,
                config=config, pairs=pairs, points=points, workers=workers, resume=resume,
            )
        )  # fmt: skip

    example = f"utopic bench {table} --out {table} --train-pairs 5000 --html {table}.html"
    command.__doc__ = f"{TABLES[table]}{MORE}\nExample: [bold]{example}[/bold]"
    return with_common_options(command)


def mount(bench: typer.Typer) -> None:
    """Put the commands on ``utopic bench``."""
    for table in TABLES:
        bench.command(table)(variant_command(table))


def run(asked: Asked) -> None:
    """Train and measure the variants of a table, write what was asked for, print the table."""
    if asked.minutes is not None and asked.train_pairs is not None:
        raise UsageError("--minutes and --train-pairs are two budgets; give one")
    if asked.minutes is None and asked.train_pairs is None and not asked.resume:
        raise UsageError("no budget; give --minutes or --train-pairs")
    if asked.minutes == 0.0:
        raise UsageError("--minutes 0: give a time to train for")
    asked.outputs.check()
    console = Console(quiet=asked.quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.commands.variant_runs import folder_of_experiment

        before = folder_of_experiment(asked.out, asked.resume)
        from utopic_cli.benchmark.held_out import held_out

        shapes = open_data(asked.data, step)
        test, split = held_out(shapes)
    experiment = _open(asked, shapes, before, console)
    report = _measure(asked, experiment, test, split, console)
    asked.outputs.write(report, console)
    from utopic_cli.benchmark.reports import render

    render(report, table_console())


def _open(asked: Asked, shapes: ShapeLibrary, before: dict[str, Any] | None, console: Console) -> Experiment:
    """Start an experiment, or make sure that the folder holds this very one."""
    from utopic_cli.commands.variant_runs import Experiment
    from utopic_cli.commands.variant_settings import base_config, within_budget
    from utopic_cli.model.weights import choose_device
    from utopic_cli.training.config import read_training_config

    base = base_config(read_training_config(asked.config), asked.seed)
    device = choose_device(asked.device)
    budget = _budget(asked, base, shapes, before, console)
    experiment = Experiment(
        asked.out,
        within_budget(base, budget.pairs),
        budget,
        asked.data,
        shapes,
        device,
        asked.workers,
        console,
    )
    if before is None:
        experiment.write()
    else:
        experiment.check_same(before)
    return experiment


def _budget(
    asked: Asked,
    base: TrainingConfig,
    shapes: ShapeLibrary,
    before: dict[str, Any] | None,
    console: Console,
) -> Budget:
    """Return the budget asked for, in pairs; of an experiment that is gone on with, the one it has."""
    from utopic_cli.commands.variant_runs import known_budget
    from utopic_cli.commands.variant_settings import budget_of_minutes, budget_of_pairs
    from utopic_cli.model.weights import choose_device

    if before is not None:
        known = known_budget(before, asked.out)
        if asked.minutes in (None, known.minutes) and asked.train_pairs in (None, known.pairs):
            return known
    if asked.train_pairs is not None:
        return budget_of_pairs(base, asked.train_pairs)
    assert asked.minutes is not None
    if before is not None:  # another time than before: refused below, and not worth measuring
        return replace(known, minutes=asked.minutes)
    console.line("measuring how fast the full network trains")
    return budget_of_minutes(base, asked.minutes, shapes, choose_device(asked.device), asked.workers)


def _measure(
    asked: Asked, experiment: Experiment, test: ShapeLibrary, split: str, console: Console
) -> VariantReport:
    """Train and measure one variant after the other."""
    from utopic_cli.benchmark.protocols import CropProtocol
    from utopic_cli.benchmark.variant_report import SCHEMA_VERSION, VariantReport, VariantRun
    from utopic_cli.benchmark.variants import CONTROL, TABLES, VARIANTS
    from utopic_cli.benchmark.versions import versions
    from utopic_cli.commands.training_view import clock
    from utopic_cli.model.weights import read_card

    protocol = CropProtocol("modelnet", 0.7, "shared", "euler45")
    rows = TABLES[asked.table]
    runs, variants = [], {}
    took: list[float] = []
    for number, row in enumerate(rows):
        left = f", about {clock(sum(took) / len(took) * (len(rows) - number))} left in all" if took else ""
        console.line(f"{asked.table}, variant {number + 1} of {len(rows)}: {row.label}{left}")
        begun = time.monotonic()
        weights = experiment.train(row.variant)
        card = read_card(weights)
        results = _results(asked, weights, card["sha256"], protocol, test, console)
        runs.append(VariantRun(row, int(card["pairs_seen"]), card["wall_clock_s"] / 60.0, tuple(results)))
        if (seconds := time.monotonic() - begun) > AT_WORK:
            took.append(seconds)
        variants[row.variant] = {
            "label": row.label,
            "changes": {"schedule": {"seed": experiment.base.schedule.seed + 1}}
            if row.variant == CONTROL
            else VARIANTS[row.variant],
            "weights": str(weights),
            "weights_sha256": card["sha256"],
        }
    settings = {
        "schema_version": SCHEMA_VERSION,
        "protocol": asked.table,
        **experiment.as_dict(),
        "test": {
            **protocol.settings(),
            "split": split,
            "shapes": len(test),
            "pairs": asked.pairs,
            "seed": asked.seed,
            "network_points": asked.points,
        },
        "variants": variants,
        "versions": versions(),
    }
    return VariantReport(settings, tuple(runs))


def _results(
    asked: Asked,
    weights: Path,
    sha256: str,
    protocol: CropProtocol,
    test: ShapeLibrary,
    console: Console,
) -> list[PairResult]:
    """Measure a variant, unless these pairs were answered before by these weights."""
    from utopic_cli.benchmark.variant_pairs import PairResult, measure_variant
    from utopic_cli.io.output import write_atomically

    path = weights.parent / "answers.json"
    test_set = {
        **protocol.settings(),
        "data": asked.data,
        "shapes": len(test),
        "seed": asked.seed,
        "network_points": asked.points,
        "weights_sha256": sha256,
    }
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        if known["test"] == test_set and len(known["answers"]) >= asked.pairs:
            return [PairResult.from_dict(one) for one in known["answers"][: asked.pairs]]
    except (OSError, ValueError, KeyError, TypeError):
        pass  # none yet, or not to be used: they only save the time to answer again
    with console.progress() as step:
        tell = countdown(step)
        results = measure_variant(
            weights,
            protocol,
            test,
            asked.data,
            asked.pairs,
            seed=asked.seed,
            points=asked.points,
            device=asked.device,
            workers=asked.workers,
            progress=lambda done, of: tell(done, of, f"test pairs, {weights.parent.name}"),
        )
    content = {"test": test_set, "answers": [result.to_dict() for result in results]}
    write_atomically(path, (json.dumps(content, allow_nan=False) + "\n").encode("ascii"), overwrite=True)
    return results
