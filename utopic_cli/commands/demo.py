"""``utopic demo``: two simulated range scans of an object, aligned: the quickstart."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from utopic_cli.commands.align import AlignOutcome, AlignRequest, run
from utopic_cli.commands.console import (
    DEFAULTS,
    WRITING,
    Colormap,
    Console,
    Debug,
    Device,
    Overwrite,
    Quiet,
    Seed,
    Threads,
    Verbose,
    Weights,
)
from utopic_cli.commands.outputs import OutputPlan, check_outputs, plan_outputs, write_outputs
from utopic_cli.config import DEFAULT_COLOUR_MAP, AlignOptions

if TYPE_CHECKING:
    import numpy as np

    from utopic_cli.synthesis.scan_pair import ScanPair


def demo(
    out_dir: Annotated[
        Path, typer.Option(metavar="DIR", help="Where to put everything.", rich_help_panel=WRITING)
    ] = Path("utopic-demo"),
    colormap: Colormap = DEFAULT_COLOUR_MAP,
    overwrite: Overwrite = False,
    weights: Weights = DEFAULTS.weights,
    device: Device = "auto",
    threads: Threads = DEFAULTS.threads,
    seed: Seed = DEFAULTS.seed,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Make two simulated range scans of an object, align them and write the whole set.

    The scans see the object from two sides and lie in frames of their own.
    The answer is known: the demo says how far from it the result is.

    Example: [bold]utopic demo --out-dir demo[/bold]
    """
    console = Console(quiet=quiet, verbose=verbose)
    source, target = out_dir / "source.ply", out_dir / "target.ply"
    scans = OutputPlan(files=(("source", source), ("target", target)), folders=(out_dir,))
    plan = plan_outputs(source, out_dir=out_dir)
    everything = OutputPlan(files=scans.files + plan.files, folders=plan.folders)
    check_outputs(everything, (), overwrite)
    with console.progress() as progress:
        progress("simulating two range scans")
        import numpy as np

        from utopic_cli.synthesis.demo_object import demo_pair

        pair = demo_pair(np.random.default_rng(seed))
        contents = {
            source: _scan_file(pair.source.points, "source"),
            target: _scan_file(pair.target.points, "target"),
        }
    request = AlignRequest(
        source=source,
        target=target,
        plan=plan,
        options=AlignOptions(weights=weights, device=device, threads=threads, seed=seed),
        overwrite=overwrite,
        colormap=colormap,
    )
    with write_outputs(scans, contents, overwrite) as undo:  # without an answer the scans go again
        outcome = run(request, console)
        undo.pop_all()
    _say_error(outcome, pair, console)
    from utopic_cli.io.colour import COLOUR_MAPS

    console.line(f"open {out_dir / 'report.html'} in a browser: both scans in 3D, and the numbers;")
    console.line(f"or look at {out_dir / 'aligned.ply'} together with {target} in any viewer;")
    more = COLOUR_MAPS[colormap].more
    console.line(
        f"*_overlap.ply and *_uncertainty.ply are {more} where there is more; report.json has the numbers"
    )


def _scan_file(points: np.ndarray, name: str) -> bytes:
    import numpy as np

    from utopic_cli.io.ply_writer import scalar_cloud_ply

    grey = np.full((len(points), 3), 190, np.uint8)
    return scalar_cloud_ply(points, grey, {}, (f"utopic demo: simulated range scan ({name})",))


def _say_error(outcome: AlignOutcome, pair: ScanPair, console: Console) -> None:
    from utopic_cli.geometry.rigid import relative_rotation_error_deg, relative_translation_error

    found, known = outcome.result.T_target_source, pair.gt_T_target_source
    degrees = relative_rotation_error_deg(found, known)
    distance = relative_translation_error(found, known, pair.source.points.mean(axis=0))
    console.fact(
        "error",
        f"{degrees:.3f} degrees and {distance / pair.extent:.3%} of the object's size from the known answer",
    )
