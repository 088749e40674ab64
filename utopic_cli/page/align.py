"""The page of one alignment, put together from ``align.html``, ``page.css`` and ``viewer.js``."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from utopic_cli import __version__
from utopic_cli.config import DEFAULT_COLOUR_MAP, ColourMapName
from utopic_cli.io.colour import SOURCE_COLOUR, TARGET_COLOUR, colour_map
from utopic_cli.io.transformation import CONVENTION, format_transformation
from utopic_cli.page.charts import overlap_histogram, residual_histogram
from utopic_cli.page.scene import MOST_RIVALS, Scene, build_scene, draw_clouds
from utopic_cli.page.skeleton import resource, script_json, whole_page
from utopic_cli.page.words import decimals, facts, length, rival_text, verdict
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import RegistrationResult

MARKS = {"yes": "✓", "no": "✕", "none": "?"}
_HASH = 12  # digits of the weights' hash that are shown; the rest is in its tooltip


@dataclass(frozen=True)
class View:
    """One button of the 3D view.

    Attributes:
        label: what it says.
        pose: number of the source's pose in the scene: before, after, then the rivals.
        values: which values give the colours (overlap, uncertainty, residual); -1 for a colour a scan.
        legend: name of the legend that belongs to it.
        note: what is to be seen, plain text.
    """

    label: str
    pose: int
    values: int
    legend: str
    note: str


def render(
    result: RegistrationResult,
    source: PointCloud,
    target: PointCloud,
    *,
    source_name: str,
    target_name: str,
    warnings: Iterable[str] = (),
    colormap: ColourMapName = DEFAULT_COLOUR_MAP,
) -> str:
    """Make the page of one alignment.

    Args:
        result: the answer.
        source: the cloud that moves, all of its points.
        target: the cloud that stays.
        source_name: what to call the source; any text, escaped here.
        target_name: what to call the target.
        warnings: the readers' warnings, put before the result's.
        colormap: the colours of overlap, uncertainty and residual.

    Returns:
        One HTML page that loads nothing from elsewhere: about 2 MB for scans of any size. The same
        arguments give the same text.
    """
    drawn = draw_clouds(result, source, target)
    scene = build_scene(result, *drawn, colormap)
    views = _views(result, source, scene)
    script = resource(__package__, "viewer.js")
    said = verdict(result)
    shown = [{"pose": one.pose, "values": one.values} for one in views]
    fills = {
        "source_name": _text(source_name),
        "target_name": _text(target_name),
        "verdict": said.kind,
        "mark": MARKS[said.kind],
        "verdict_title": _text(said.title),
        "verdict_text": _text(said.text),
        "reasons": _list(result.reasons),
        "warnings": _warnings([*warnings, *result.warnings]),
        "buttons": "\n".join(_button(number, view) for number, view in enumerate(views)),
        "notes": "\n".join(_note(number, view) for number, view in enumerate(views)),
        "drawn": _text(_drawn(source, target, len(drawn[0].points), len(drawn[1].points))),
        "reach": _text(length(result.fit.threshold)),
        "facts": "\n".join(
            f"<dt>{_text(name)}</dt><dd>{_text(text)}</dd>" for name, text in facts(result, source, target)
        ),
        "convention": _text(CONVENTION),
        "matrix": _matrix(result.T_target_source, decimals(target, 6)),
        "matrix_text": format_transformation(result.T_target_source, ".txt").decode("ascii"),
        "overlap_chart": overlap_histogram(result.source_overlap, result.target_overlap),
        "residual_chart": residual_histogram(drawn[0].residual, drawn[1].residual, result.fit.threshold),
        "timings": _rows((step, f"{seconds:.2f} s") for step, seconds in _with_total(result.timings_s)),
        "options": _rows(result.options.items()),
        "weights_name": _text(result.weights_name or "unnamed"),
        "weights_hash": _text(result.weights_sha256),
        "weights_short": _text(result.weights_sha256[:_HASH]),
        "version": _text(__version__),
        "scene": script_json({**scene.data, "views": shown}),
        "script": script,
    }
    title = _text(f"{source_name} → {target_name} · utopic")
    style = f"{_colours(colormap)}\n{resource(__package__, 'page.css')}"
    return whole_page(title, style, resource(__package__, "align.html"), fills, only_script=script)


def _views(result: RegistrationResult, source: PointCloud, scene: Scene) -> list[View]:
    before = "Both scans as they lie in their files."
    if scene.apart is not None:
        before = (
            f"Both scans as they are turned in their files. There they lie {length(scene.apart)} file units "
            "apart; here they are drawn closer together."
        )
    reach = length(result.fit.threshold)
    views = [
        View("Before", 0, -1, "scans", before),
        View("After", 1, -1, "scans", "The source moved onto the target by the transformation found."),
        View("Overlap", 1, 0, "overlap", "How likely each point lies where both scans saw the surface."),
        View(
            "Uncertainty",
            1,
            1,
            "uncertainty",
            "How unsure the overlap is, stretched to 0..1 over the pair. "
            "Much along the border of the overlap is usual.",
        ),
        View(
            "Residual",
            1,
            2,
            "residual",
            f"Distance to the nearest point of the other scan; grey: none within {reach} file units.",
        ),
    ]
    rivals = min(len(result.ambiguous_with), MOST_RIVALS)
    views += [
        View(f"Rival {number}", number + 1, -1, "scans", f"A pose that {rival_text(result, source, number)}.")
        for number in range(1, rivals + 1)
    ]
    return views


def _button(number: int, view: View) -> str:
    pressed = "true" if view.label == "After" else "false"
    label = _text(view.label)
    return f'<button type="button" data-view="{number}" aria-pressed="{pressed}">{label}</button>'


def _note(number: int, view: View) -> str:
    hidden = "" if view.label == "After" else " hidden"
    return f'<p data-note="{number}" data-legend="{view.legend}"{hidden}>{_text(view.note)}</p>'


def _drawn(source: PointCloud, target: PointCloud, source_drawn: int, target_drawn: int) -> str:
    said = [
        f"all {len(cloud):,} points of the {name}"
        if count == len(cloud)
        else f"{count:,} of the {len(cloud):,} points of the {name}"
        for name, cloud, count in (("source", source, source_drawn), ("target", target, target_drawn))
    ]
    return f"Drawn: {said[0]}, {said[1]}."


def _colours(colormap: ColourMapName) -> str:
    colours = colour_map(np.linspace(0.0, 1.0, 11), colormap).tolist()
    stops = ", ".join(_rgb(colour) for colour in colours)
    return (
        f":root {{ --source: {_rgb(SOURCE_COLOUR)}; --target: {_rgb(TARGET_COLOUR)}; "
        f"--map: linear-gradient(90deg, {stops}); }}"
    )


def _rgb(colour: Sequence[int]) -> str:
    return "#" + "".join(f"{part:02x}" for part in colour)


def _list(texts: Sequence[str]) -> str:
    if not texts:
        return ""
    return "<ul>" + "".join(f"<li>{_text(text)}</li>" for text in texts) + "</ul>"


def _warnings(texts: Sequence[str]) -> str:
    if not texts:
        return ""
    return f'<section class="warnings" aria-label="Warnings"><h2>Warnings</h2>{_list(texts)}</section>'


def _matrix(transformation: np.ndarray, places: int) -> str:
    """Return the rows as read by a person: six digits of the rotation and of the target's extent."""
    return "".join(
        "<tr>"
        + "".join(f"<td>{value + 0.0:.6f}</td>" for value in row[:3])
        + f"<td>{row[3]:.{places}f}</td></tr>"
        for row in transformation.tolist()
    )


def _with_total(timings_s: Mapping[str, float]) -> list[tuple[str, float]]:
    return [*timings_s.items(), ("total, without reading and writing", sum(timings_s.values()))]


def _rows(items: Iterable[tuple[str, Any]]) -> str:
    return "".join(
        f'<tr><th scope="row">{_text(name)}</th><td>{_text(value)}</td></tr>' for name, value in items
    )


def _text(value: Any) -> str:
    """Return any text as HTML; bytes of a file name that are no text become question marks."""
    return html.escape(str(value).encode("utf-8", "replace").decode("utf-8"))
