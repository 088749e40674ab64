"""A picture of one alignment, drawn from the files it left: no window, no graphics library.

    python -m utopic_cli.benchmark.picture OUT_DIR -o picture.png

``OUT_DIR`` is what ``utopic align ... --out-dir OUT_DIR`` (or ``utopic demo``) wrote. Six panels:
both scans as they lie in their files and as aligned, then overlap and uncertainty of each scan in
the target's frame, in the colours of the PLY files themselves. Points are drawn as small shaded
discs into a depth buffer, seen along the direction that most of the aligned surface faces.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.errors import InputError, UtopicError, optional_part
from utopic_cli.geometry.normals import estimate_normals, orient_normals
from utopic_cli.geometry.rigid import apply
from utopic_cli.geometry.voxel import voxel_downsample
from utopic_cli.io.colour import SOURCE_COLOUR, TARGET_COLOUR
from utopic_cli.io.output import write_atomically
from utopic_cli.io.transformation import read_transformation

OVERSAMPLING = 2
_LIGHT = np.array([-0.35, 0.45, 0.82])  # from the upper left, in view coordinates
_PLY_TYPES = {"double": "<f8", "float": "<f4", "uchar": "u1"}


@dataclass(frozen=True)
class ColouredCloud:
    """Points to draw.

    Attributes:
        points: (N, 3) float64.
        colours: (N, 3) uint8.
    """

    points: np.ndarray
    colours: np.ndarray

    def moved(self, transformation: np.ndarray) -> ColouredCloud:
        """Return the cloud moved by a (4, 4) transformation."""
        return replace(self, points=apply(transformation, self.points))

    def painted(self, colour: tuple[int, int, int]) -> ColouredCloud:
        """Return the cloud in one colour."""
        return replace(self, colours=np.tile(np.array(colour, np.uint8), (len(self.points), 1)))


def render(clouds: Sequence[ColouredCloud], view: np.ndarray, size: int = 480) -> np.ndarray:
    """Draw clouds orthographically on white, filling the frame.

    Args:
        clouds: at least one point in all.
        view: (3, 3) rotation whose rows are right, up and towards the viewer.
        size: width and height in pixels.

    Returns:
        (size, size, 3) uint8.
    """
    points = [cloud.points @ view.T for cloud in clouds]
    everything = np.concatenate(points)
    low, high = everything.min(axis=0), everything.max(axis=0)
    pixels = size * OVERSAMPLING
    scale = 0.94 * pixels / max(float((high - low)[:2].max()), 1e-300)
    middle = (low + high)[:2] / 2.0

    places, depths, colours = [], [], []
    for seen, cloud in zip(points, clouds, strict=True):
        lit = _shaded(seen, cloud.colours)
        centre = np.rint((seen[:, :2] - middle) * (scale, -scale) + pixels / 2.0).astype(np.int64)
        radius = float(np.clip(0.8 * _spacing(seen) * scale, 1.0, pixels / 40.0))
        for offset in _disc(radius):
            places.append(centre + offset)
            depths.append(seen[:, 2])
            colours.append(lit)
    place, depth, colour = np.concatenate(places), np.concatenate(depths), np.concatenate(colours)
    inside = ((place >= 0) & (place < pixels)).all(axis=1)
    order = np.flatnonzero(inside)[np.argsort(depth[inside], kind="stable")]
    image = np.full((pixels * pixels, 3), 255.0)
    image[place[order, 1] * pixels + place[order, 0]] = colour[order]  # the last, nearest one stays
    blocks = image.reshape(size, OVERSAMPLING, size, OVERSAMPLING, 3)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)


def facing_view(points: np.ndarray, roll_deg: float = 0.0, turn_deg: float = 0.0) -> np.ndarray:
    """Choose a view: along the mean outward normal, the longest direction across it upright.

    Args:
        points: (N, 3).
        roll_deg: turn the picture counter-clockwise.
        turn_deg: then walk around its vertical.

    Returns:
        (3, 3) rotation whose rows are right, up and towards the viewer.
    """
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    thinned, _ = voxel_downsample(points, max(extent / 60.0, 1e-300))
    normals = orient_normals(thinned, estimate_normals(thinned))
    towards = normals.mean(axis=0)
    length = float(np.linalg.norm(towards))
    # A closed surface faces nowhere.
    towards = towards / length if length > 0.02 else np.array([0.0, 0.0, 1.0])
    across = (thinned - thinned.mean(axis=0)) @ (np.eye(3) - np.outer(towards, towards))
    up = np.linalg.svd(across, full_matrices=False)[2][0]
    up = up - (up @ towards) * towards
    up *= (1.0 if up[np.abs(up).argmax()] > 0 else -1.0) / np.linalg.norm(up)
    view = np.stack([np.cross(up, towards), up, towards])
    roll, turn = np.radians([roll_deg, turn_deg])
    rolled = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    turned = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    return turned @ rolled @ view


def read_coloured_cloud(path: Path) -> ColouredCloud:
    """Read points and colours of a PLY file that this tool wrote.

    Raises:
        InputError: it can't be read or is no such file.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror}); give the folder of --out-dir") from error
    header, end, body = data.partition(b"end_header\n")
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    try:
        count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
        fields = [(line[2], _PLY_TYPES[line[1]]) for line in lines if line[:1] == ["property"]]
        table = np.frombuffer(body, np.dtype(fields), count=count)
        points = np.stack([table[name] for name in "xyz"], axis=1).astype(np.float64)
        colours = np.stack([table[name] for name in ("red", "green", "blue")], axis=1).astype(np.uint8)
    except (StopIteration, KeyError, IndexError, ValueError) as error:
        raise InputError(f"{path}: is no coloured PLY of this tool ({error})") from error
    if not end or not count:
        raise InputError(f"{path}: is no coloured PLY of this tool")
    return ColouredCloud(points, colours)


def panels(out_dir: Path, roll_deg: float, turn_deg: float, size: int) -> list[tuple[str, np.ndarray]]:
    """Draw the six panels of an alignment.

    Returns:
        Title and (size, size, 3) uint8 image of each, row by row of a 2 x 3 grid.

    Raises:
        InputError: a file of the set is missing or unreadable.
    """
    transformation = read_transformation(out_dir / "transformation.txt")
    names = ("source_overlap", "source_uncertainty", "target_overlap", "target_uncertainty")
    cloud = {name: read_coloured_cloud(out_dir / f"{name}.ply") for name in names}
    source = cloud["source_overlap"].painted(SOURCE_COLOUR)
    target = cloud["target_overlap"].painted(TARGET_COLOUR)
    aligned = source.moved(transformation)
    view = facing_view(np.concatenate([aligned.points, target.points]), roll_deg, turn_deg)
    in_target_frame = {
        name: shown.moved(transformation) if name.startswith("source") else shown
        for name, shown in cloud.items()
    }
    return [
        ("before", render([source, target], view, size)),
        *((_title(name), render([in_target_frame[name]], view, size)) for name in names[:2]),
        ("after", render([aligned, target], view, size)),
        *((_title(name), render([in_target_frame[name]], view, size)) for name in names[2:]),
    ]


def _title(name: str) -> str:
    side, shown = name.split("_")
    return f"{shown} of the {side}"


def compose(drawn: Sequence[tuple[str, np.ndarray]], columns: int = 3) -> bytes:
    """Return titled images of one size as the bytes of one PNG file.

    Raises:
        UsageError: matplotlib is not installed.
    """
    with optional_part("pictures need matplotlib", "matplotlib"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    rows = -(-len(drawn) // columns)
    side = drawn[0][1].shape[0] / 100.0
    figure = Figure(figsize=(columns * side, rows * (side + 0.3)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (title, image) in zip(figure.subplots(rows, columns, squeeze=False).flat, drawn, strict=False):
        axes.imshow(image)
        axes.set_title(title, fontsize=11)
    for axes in figure.axes:
        axes.axis("off")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the picture of a finished alignment.

    Raises:
        UtopicError: an input or the output can't be used.
    """
    parser = argparse.ArgumentParser(description="Draw a finished alignment as a PNG.")
    parser.add_argument("out_dir", type=Path, metavar="OUT_DIR", help="what utopic align --out-dir wrote")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")
    parser.add_argument("--roll", type=float, default=0.0, metavar="DEG", help="turn counter-clockwise")
    parser.add_argument("--turn", type=float, default=0.0, metavar="DEG", help="walk around the vertical")
    parser.add_argument("--size", type=int, default=400, metavar="PIXELS", help="side of a panel")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    given = parser.parse_args(arguments)
    drawn = panels(given.out_dir, given.roll, given.turn, given.size)
    write_atomically(given.output, compose(drawn), overwrite=given.overwrite)


def _shaded(seen: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Light (N, 3) colours by the surface's slope in view coordinates; both sides are lit alike."""
    if len(seen) < 4:
        return colours.astype(np.float64)
    normals = estimate_normals(seen, neighbours=16)
    normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0)
    light = np.clip(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    return colours * (0.45 + 0.55 * light)[:, None]


def _spacing(points: np.ndarray) -> float:
    """Distance to the fourth neighbour, the median over some points: what a disc has to cover."""
    some = points[:: max(1, len(points) // 4000)]
    distance, _ = cKDTree(points).query(some, k=min(5, len(points)))
    return float(np.median(distance.reshape(len(some), -1)[:, -1]))


def _disc(radius: float) -> np.ndarray:
    """Pixel offsets (K, 2) of a filled disc."""
    reach = int(np.ceil(radius))
    across, down = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    offsets = np.stack([across.ravel(), down.ravel()], axis=1)
    return offsets[np.linalg.norm(offsets, axis=1) <= radius]


if __name__ == "__main__":
    try:
        main()
    except UtopicError as error:
        sys.stderr.write(f"utopic: error: {error}\n")
        raise SystemExit(error.exit_code) from None
