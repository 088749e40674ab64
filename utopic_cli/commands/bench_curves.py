"""``utopic bench overlap-sweep, noise, density, outliers, rotation``: one thing made worse by steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import typer

from utopic_cli.commands.bench import (
    Asked,
    Data,
    HtmlOut,
    JsonOut,
    Matchers,
    Outputs,
    Pairs,
    Points,
    Rotations,
    Sampling,
    SeveralWeights,
    Workers,
    measure,
)
from utopic_cli.commands.console import Debug, Device, Overwrite, Quiet, Seed
from utopic_cli.config import AlignOptions

if TYPE_CHECKING:
    from utopic_cli.benchmark.protocols import AnyProtocol

_DEFAULTS = AlignOptions()

CURVES = {
    "noise": "Success against the noise of both scans: sigma 0 to 0.03 of the extent.",
    "density": "Success against the ratio of the scans' densities: 1 : 1 to 10 : 1.",
    "outliers": "Success against the share of outliers in both scans: 0 to 30 %.",
    "rotation": "Success against the angle between the scans: 0 to 180 degrees.",
}


def overlap_sweep(
    data: Data = "procedural",
    sampling: Sampling = "shared",
    rotations: Rotations = None,
    pairs: Pairs = 300,
    weights: SeveralWeights = None,
    baselines: Matchers = "",
    points: Points = _DEFAULTS.points,
    workers: Workers = 1,
    json_out: JsonOut = None,
    html_out: HtmlOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """PRNet's crops, keeping 768 down to 560 of 1,024 points: errors against overlap."""

    def protocol() -> AnyProtocol:
        from utopic_cli.benchmark.curves import SweepProtocol

        return SweepProtocol(
            sampling=sampling, rotations=rotations or ("euler45" if sampling == "shared" else "uniform")
        )

    outputs = Outputs(json_out, html_out, overwrite)
    measure(Asked(data, pairs, weights, baselines, points, workers, outputs, device, seed, quiet), protocol)


def curve_command(name: str) -> Callable[..., None]:
    """Return the command of one of ``CURVES``: they differ in nothing but the parameter."""

    def curve(
        data: Data = "procedural",
        pairs: Pairs = 300,
        weights: SeveralWeights = None,
        baselines: Matchers = "",
        points: Points = _DEFAULTS.points,
        workers: Workers = 1,
        json_out: JsonOut = None,
        html_out: HtmlOut = None,
        overwrite: Overwrite = False,
        device: Device = "auto",
        seed: Seed = _DEFAULTS.seed,
        quiet: Quiet = False,
        debug: Debug = False,
    ) -> None:
        def protocol() -> AnyProtocol:
            from utopic_cli.benchmark.curves import CurveProtocol

            return CurveProtocol(name=name)

        outputs = Outputs(json_out, html_out, overwrite)
        asked = Asked(data, pairs, weights, baselines, points, workers, outputs, device, seed, quiet)
        measure(asked, protocol)

    curve.__doc__ = CURVES[name]
    return curve


def mount(bench: typer.Typer) -> None:
    """Put the commands on ``utopic bench``."""
    bench.command("overlap-sweep")(overlap_sweep)
    for name in CURVES:
        bench.command(name)(curve_command(name))
