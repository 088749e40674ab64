from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from tests.benchmark.conftest import bumpy_object
from utopic_cli.benchmark.picture import ColouredCloud, facing_view, main, read_coloured_cloud, render
from utopic_cli.errors import InputError, OutputError
from utopic_cli.geometry.rigid import is_rigid, random_rotation, rigid
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.io.transformation import format_transformation

RED, BLUE = (255, 0, 0), (0, 0, 255)


def sheet(height: float, colour: tuple[int, int, int], half: float = 1.0) -> ColouredCloud:
    axis = np.linspace(-half, half, 60)
    x, y = np.meshgrid(axis, axis)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    return ColouredCloud(points, np.empty(points.shape, np.uint8)).painted(colour)


def test_the_nearer_sheet_hides_the_other_whatever_the_order() -> None:
    near, far = sheet(1.0, RED, half=0.5), sheet(0.0, BLUE)
    for clouds in ([near, far], [far, near]):
        image = render(clouds, np.eye(3), size=64).astype(int)
        assert image[32, 32, 0] > image[32, 32, 2]  # red in the middle
        assert image[10, 32, 2] > image[10, 32, 0]  # blue around it
        assert (image[0, 0] == 255).all()  # white outside
    behind = np.diag([-1.0, 1.0, -1.0])
    image = render([near, far], behind, size=64).astype(int)
    assert image[32, 32, 2] > image[32, 32, 0]


def test_up_in_the_view_is_up_in_the_picture() -> None:
    mark = sheet(0.1, RED, half=0.2).moved(rigid(np.eye(3), np.array([0.0, 0.7, 0.0])))
    image = render([sheet(0.0, BLUE), mark], np.eye(3), size=64).astype(int)
    reds = np.argwhere(image[..., 0] > image[..., 2] + 50)
    assert reds[:, 0].mean() < 20 and reds[:, 1].mean() == pytest.approx(31.5, abs=2)


def test_the_view_looks_at_the_surface() -> None:
    rng = np.random.default_rng(0)
    cap = bumpy_object(rng, 4000)
    rotation = random_rotation(rng)
    view = facing_view(cap[cap[:, 2] > 0.4] @ rotation.T)
    assert is_rigid(rigid(view, np.zeros(3)), 1e-9)
    assert view[2] @ rotation[:, 2] > 0.9


def test_a_picture_from_a_finished_alignment(tmp_path: Path) -> None:
    matplotlib_image = pytest.importorskip("matplotlib.image")
    points = bumpy_object(np.random.default_rng(1), 500)
    for side in ("source", "target"):
        for shown in ("overlap", "uncertainty"):
            ply = scalar_cloud_ply(points, np.full(points.shape, np.uint8(200)), {shown: np.ones(500, "f4")})
            (tmp_path / f"{side}_{shown}.ply").write_bytes(ply)
    (tmp_path / "transformation.txt").write_bytes(format_transformation(np.eye(4), ".txt"))
    picture = tmp_path / "picture.png"
    main([str(tmp_path), "-o", str(picture), "--size", "100"])
    image = matplotlib_image.imread(io.BytesIO(picture.read_bytes()), format="png")
    assert image.shape[0] >= 200 and image.shape[1] >= 300
    assert (image[..., :3] < 0.9).any(axis=2).mean() > 0.05  # something was drawn
    with pytest.raises(OutputError):
        main([str(tmp_path), "-o", str(picture), "--size", "100"])
    (tmp_path / "target_overlap.ply").write_bytes(b"ply\n")
    with pytest.raises(InputError, match=r"target_overlap\.ply"):
        main([str(tmp_path), "-o", str(tmp_path / "other.png")])


def test_our_own_ply_is_read_exactly(tmp_path: Path) -> None:
    points = np.array([[4e5 + 1 / 3, 5e6, -1e-9], [0.0, 1.0, 2.0]])
    colours = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    path = tmp_path / "cloud.ply"
    path.write_bytes(scalar_cloud_ply(points, colours, {"overlap": np.zeros(2, "f4")}, ("a comment",)))
    cloud = read_coloured_cloud(path)
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.colours, colours)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="no coloured PLY"):
        read_coloured_cloud(path)
