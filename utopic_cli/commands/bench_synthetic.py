"""The protocols of ``utopic bench`` on synthetic pairs: the paper's, range scans, robustness curves."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from utopic_cli.commands.bench_options import (
    Asked,
    Data,
    Rotations,
    Sampling,
    countdown,
    names,
    open_data,
    table_console,
    with_shared_options,
)
from utopic_cli.commands.console import DEFAULTS, Console

if TYPE_CHECKING:
    from utopic_cli.benchmark.protocols import AnyProtocol, CropProtocol

CURVES = {
    "noise": "Success against the noise of both scans: sigma 0 to 0.03 of the extent.",
    "density": "Success against the ratio of the scans' densities: 1 : 1 to 10 : 1.",
    "outliers": "Success against the share of outliers in both scans: 0 to 30 %.",
    "rotation": "Success against the angle between the scans: 0 to 180 degrees.",
}


@with_shared_options
def modelnet(
    asked: Asked, data: Data = "procedural", sampling: Sampling = "shared", rotations: Rotations = None
) -> None:
    """The paper's ModelNet protocol: 1,024 points of a shape, both crops keep 70 %.

    Example: [bold]utopic bench modelnet --data modelnet40:DIR --json modelnet.json[/bold]
    """
    measure(asked, data, lambda: _crops("modelnet", 0.7, sampling, rotations))


@with_shared_options
def modelonet(
    asked: Asked, data: Data = "procedural", sampling: Sampling = "shared", rotations: Rotations = None
) -> None:
    """The paper's ModelLoNet protocol: 1,024 points of a shape, both crops keep 50 %.

    Example: [bold]utopic bench modelonet --pairs 100 --workers 2[/bold]
    """
    measure(asked, data, lambda: _crops("modelonet", 0.5, sampling, rotations))


@with_shared_options
def scanobjectnn(
    asked: Asked,
    data: Annotated[
        str,
        typer.Option(
            metavar="FILE|DIR",
            help="The data set's HDF5 test file, or a folder with test_objectdataset.h5.",
        ),
    ],
    sampling: Sampling = "shared",
    rotations: Rotations = None,
) -> None:
    """The paper's protocol on real objects: 1,024 points of ScanObjectNN's, both crops keep 70 %.

    Example: [bold]utopic bench scanobjectnn --data h5_files/main_split[/bold]
    """
    measure(asked, f"scanobjectnn:{data}", lambda: _crops("scanobjectnn", 0.7, sampling, rotations))


@with_shared_options
def detail(
    asked: Asked,
    data: Data = "procedural",
    sampling: Sampling = "shared",
    rotations: Rotations = None,
    relief: Annotated[
        bool | None,
        typer.Option(
            "--relief/--no-relief",
            help="Bend each surface by small random waves.",
            show_default="for built-in shapes only",
        ),
    ] = None,
) -> None:
    """Detailed shapes never seen in training: 5,000 points of each, both crops keep 70 %.

    Example: [bold]utopic bench detail --data statues/ --pairs 50[/bold]
    """

    def protocol() -> AnyProtocol:
        from dataclasses import replace

        from utopic_cli.benchmark.protocols import DETAIL_POINTS, DETAIL_RELIEF

        wanted = data == "procedural" if relief is None else relief
        plain = _crops("detail", 0.7, sampling, rotations)
        return replace(plain, points=DETAIL_POINTS, relief=DETAIL_RELIEF if wanted else 0.0)

    measure(asked, data, protocol)


@with_shared_options
def range_scans(asked: Asked, data: Data = "procedural") -> None:
    """Virtual range scans of whole shapes from two sides, in random poses, by overlap band.

    Example: [bold]utopic bench range-scans --data shapes/ --baselines fpfh,kiss-matcher[/bold]
    """

    def protocol() -> AnyProtocol:
        from utopic_cli.benchmark.protocols import RangeProtocol

        return RangeProtocol()

    measure(asked, data, protocol)


@with_shared_options
def rooms(asked: Asked, data: Data = "procedural") -> None:
    """Panoramic scans from two places in a room furnished with the shapes, in random poses.

    Example: [bold]utopic bench rooms --data furniture/ --baselines fpfh[/bold]
    """

    def protocol() -> AnyProtocol:
        from utopic_cli.benchmark.protocols import RoomProtocol

        return RoomProtocol()

    measure(asked, data, protocol)


@with_shared_options
def overlap_sweep(
    asked: Asked, data: Data = "procedural", sampling: Sampling = "shared", rotations: Rotations = None
) -> None:
    """PRNet's crops, keeping 768 down to 560 of 1,024 points: errors against overlap.

    Example: [bold]utopic bench overlap-sweep --html sweep.html[/bold]
    """

    def protocol() -> AnyProtocol:
        from utopic_cli.benchmark.curves import SweepProtocol

        return SweepProtocol(sampling=sampling, rotations=_rotations(sampling, rotations))

    measure(asked, data, protocol)


def curve_command(name: str) -> Callable[..., None]:
    """Return the command of one of ``CURVES``: they differ in nothing but the parameter."""

    def curve(asked: Asked, data: Data = "procedural") -> None:
        def protocol() -> AnyProtocol:
            from utopic_cli.benchmark.curves import CurveProtocol

            return CurveProtocol(name=name)

        measure(asked, data, protocol)

    curve.__doc__ = (
        f"{CURVES[name]}\n\nExample: [bold]utopic bench {name} --pairs 60 --html {name}.html[/bold]"
    )
    return with_shared_options(curve)


def mount(bench: typer.Typer) -> None:
    """Put the commands on ``utopic bench``."""
    for name, command in (
        ("modelnet", modelnet),
        ("modelonet", modelonet),
        ("scanobjectnn", scanobjectnn),
        ("detail", detail),
        ("range-scans", range_scans),
        ("rooms", rooms),
        ("overlap-sweep", overlap_sweep),
        *((name, curve_command(name)) for name in CURVES),
    ):
        bench.command(name)(command)


def measure(asked: Asked, data: str, make_protocol: Callable[[], AnyProtocol]) -> None:
    """Run a protocol on synthetic pairs, write what was asked for, print its tables."""
    asked.outputs.check()
    baselines = names(asked.baselines)
    console = Console(quiet=asked.quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.contestants import check_baselines
        from utopic_cli.benchmark.reports import render
        from utopic_cli.benchmark.synthetic import run

        check_baselines(baselines)
        shapes = open_data(data, step)
        step("starting")
        report = run(
            make_protocol(),
            shapes,
            data,
            pairs=asked.pairs,
            seed=asked.seed,
            weights=asked.weights if asked.weights is not None else [DEFAULTS.weights],
            baselines=baselines,
            workers=asked.workers,
            points=asked.points,
            max_rotation=asked.max_rotation,
            device=asked.device,
            progress=countdown(step),
        )
    asked.outputs.write(report, console)
    render(report, table_console())


def _crops(name: str, keep: float, sampling: str, rotations: str | None) -> CropProtocol:
    from utopic_cli.benchmark.protocols import CropProtocol

    return CropProtocol(name, keep, sampling, _rotations(sampling, rotations))


def _rotations(sampling: str, rotations: str | None) -> str:
    return rotations or ("euler45" if sampling == "shared" else "uniform")
