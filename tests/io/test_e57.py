"""E57 against libE57, which writes and reads the files here through pye57."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import bumpy_points, motion, moved, mutated
from utopic_cli.io.e57 import read_e57
from utopic_cli.io.e57_file import E57File, open_e57
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import read_scan

pye57 = pytest.importorskip("pye57")
libe57 = pye57.libe57

TURN = np.array([0.5, 0.5, 0.5, 0.5])  # w x y z: x to y, y to z, z to x
SHIFT = np.array([1.0, 2.0, 3.0])
POSE = np.array([[0.0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])


def write(path: Path, *scans: np.ndarray, **fields: np.ndarray) -> Path:
    """Write scans, the first with a pose and further fields."""
    file = pye57.E57(str(path), "w")
    for number, points in enumerate(scans):
        data = {f"cartesian{axis}": points[:, i] for i, axis in enumerate("XYZ")}
        if number == 0:
            file.write_scan_raw(data | fields, rotation=TURN, translation=SHIFT)
        else:
            file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=np.zeros(3))
    file.close()
    return path


def write_columns(path: Path, columns: dict, names: tuple[str, ...]) -> Path:
    """Write one scan of columns (node of the prototype, values) by libE57 itself."""
    file = pye57.E57(str(path), "w")
    image = file.image_file
    scan, prototype = libe57.StructureNode(image), libe57.StructureNode(image)
    buffers, kept = libe57.VectorSourceDestBuffer(), []
    for name in names:
        node, values = columns[name]
        prototype.set(name, node(image))
        kept.append(np.array(values, np.float64))
        buffers.append(libe57.SourceDestBuffer(image, name, kept[-1], len(values), True, True))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("points", points)
    file.data3d.append(scan)
    writer = points.writer(buffers)
    writer.write(len(kept[0]))
    writer.close()
    file.close()
    return path


def read_back(path: Path) -> np.ndarray:
    file = pye57.E57(str(path))
    scans = [file.read_scan(i, ignore_missing_fields=True) for i in range(file.scan_count)]
    file.close()
    return np.concatenate([np.stack([s[f"cartesian{axis}"] for axis in "XYZ"], axis=1) for s in scans])


def test_scans_are_put_together_by_their_poses_without_invalid_points(tmp_path: Path) -> None:
    first, second = bumpy_points(30_000), bumpy_points(70, seed=2) + 10
    invalid = (np.arange(len(first)) % 7 == 0).astype(np.int8)
    rows = np.arange(len(first)) % 500
    path = write(
        tmp_path / "a.e57", first, second, cartesianInvalidState=invalid, rowIndex=rows, columnIndex=rows
    )
    scan = read_scan(path)
    np.testing.assert_array_equal(scan.cloud.points, read_back(path))
    expected = np.concatenate([moved(first[invalid == 0], POSE), second])
    np.testing.assert_allclose(scan.cloud.points, expected, atol=1e-12)
    assert scan.records == len(first) + len(second)
    assert any("2 scans" in warning for warning in scan.warnings)


def test_moved_by_its_poses_no_point_is_touched(tmp_path: Path) -> None:
    T = motion(translation=(-4e5, 3.0, 7.0))
    path = write(tmp_path / "a.e57", bumpy_points(5000), bumpy_points(70))
    data = path.read_bytes()
    out = tmp_path / "b.e57"
    out.write_bytes(read_e57(data).moved(T))
    np.testing.assert_allclose(read_back(out), moved(read_back(path), T), rtol=0, atol=1e-9)
    before, after = open_e57(data), open_e57(out.read_bytes())
    assert before.content[48 : before.xml_at] == after.content[48 : before.xml_at]
    assert before.xml_at == after.xml_at and len(out.read_bytes()) <= len(data) + 1024


def test_pictures_move_with_the_scans(tmp_path: Path) -> None:
    file = open_e57(write(tmp_path / "a.e57", bumpy_points()).read_bytes())
    start = file.xml.index(b"<pose")
    pose = file.xml[start : file.xml.index(b"</pose>") + 7]
    picture = b'<images2D type="Vector"><vectorChild type="Structure">' + pose + b"</vectorChild></images2D>"
    head, _, tail = file.xml.partition(b"<images2D")
    data = file.with_xml(head + picture + tail[tail.index(b"</images2D>") + 11 :])
    written = open_e57(read_e57(data).moved(motion())).xml
    poses = [part.partition(b"</pose>")[0] for part in written.split(b"<pose")[1:]]
    assert len(poses) == 2 and poses[0] == poses[1] and poses[0] not in data


def test_a_scan_without_a_pose_gets_one(tmp_path: Path) -> None:
    points = np.rint(1000 * bumpy_points())
    node = lambda image: libe57.IntegerNode(image, 0, -1000, 1000)  # noqa: E731
    columns = {f"cartesian{axis}": (node, points[:, i]) for i, axis in enumerate("XYZ")}
    path = write_columns(tmp_path / "a.e57", columns, tuple(columns))
    records = read_e57(path.read_bytes())
    np.testing.assert_array_equal(records.points, points)
    out = tmp_path / "b.e57"
    out.write_bytes(records.moved(motion()))
    np.testing.assert_allclose(read_back(out), moved(points, motion()), atol=1e-9)


@pytest.mark.parametrize(
    ("least", "most"), [(0, 1), (-5, 5), (-500, 511), (-(2**20), 2**21), (0, 2**33), (-(2**51), 2**52 - 1)]
)
def test_packed_integers_of_any_width(tmp_path: Path, least: int, most: int) -> None:
    rng = np.random.default_rng(6)
    values = rng.integers(least, most, (20_000, 3), endpoint=True) * 0.25 + 8.0
    node = lambda image: libe57.ScaledIntegerNode(image, 0, least, most, 0.25, 8.0)  # noqa: E731
    columns = {f"cartesian{axis}": (node, values[:, i]) for i, axis in enumerate("XYZ")}
    path = write_columns(tmp_path / "a.e57", columns, tuple(columns))
    np.testing.assert_array_equal(read_e57(path.read_bytes()).points, values)


@pytest.mark.parametrize("least", [-(2**62) - 1, -(2**63)])
def test_packed_integers_whose_limits_no_double_holds(tmp_path: Path, least: int) -> None:
    """Small numbers of a wide column are exact, wherever its limits lie."""
    values = np.random.default_rng(6).integers(-(2**40), 2**40, (300, 3))
    node = lambda image: libe57.IntegerNode(image, 0, least, -least - 1)  # noqa: E731
    columns = {f"cartesian{axis}": (node, values[:, i]) for i, axis in enumerate("XYZ")}
    path = write_columns(tmp_path / "a.e57", columns, tuple(columns))
    np.testing.assert_array_equal(read_e57(path.read_bytes()).points, values)


def constant(tmp_path: Path, points: np.ndarray) -> Path:
    """Points of an E57 file whose only further field takes no bits."""
    double = lambda image: libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e3, 1e3)  # noqa: E731
    columns = {f"cartesian{axis}": (double, points[:, i]) for i, axis in enumerate("XYZ")}
    columns["intensity"] = (lambda image: libe57.IntegerNode(image, 7, 7, 7), np.full(len(points), 7.0))
    return write_columns(tmp_path / "a.e57", columns, tuple(columns))


def test_a_field_that_is_constant_is_told(tmp_path: Path) -> None:
    records = read_e57(constant(tmp_path, bumpy_points()).read_bytes())
    np.testing.assert_array_equal(records.document.fields(80)["intensity"], np.full(80, 7.0))
    with pytest.raises(FormatError, match="promises 80 E57 points but holds 79"):
        records.document.fields(79)


def test_coordinates_that_are_constant_are_refused_whatever_the_promised_number(tmp_path: Path) -> None:
    node = lambda image: libe57.IntegerNode(image, 3, 3, 3)  # noqa: E731
    columns = {f"cartesian{axis}": (node, np.full(80, 3.0)) for axis in "XYZ"}
    columns["cartesianInvalidState"] = (lambda image: libe57.IntegerNode(image, 0, 0, 2), np.zeros(80))
    path = write_columns(tmp_path / "a.e57", columns, tuple(columns))
    with pytest.raises(FormatError, match="all equal"):
        read_e57(path.read_bytes())


def test_spherical_coordinates(tmp_path: Path) -> None:
    points = bumpy_points() + [3, 0, 0]
    distance = np.linalg.norm(points, axis=1)
    values = (distance, np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / distance))
    node = lambda image: libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e3, 1e3)  # noqa: E731
    names = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
    path = write_columns(tmp_path / "a.e57", {n: (node, v) for n, v in zip(names, values)}, names)
    np.testing.assert_allclose(read_e57(path.read_bytes()).points, points, atol=1e-12)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    points = bumpy_points(60)
    return write(tmp_path_factory.mktemp("e57") / "a.e57", points, points).read_bytes()


def test_a_changed_byte_is_found_by_its_checksum(small: bytes) -> None:
    for place in (100, 700, len(small) - 200):
        damaged = bytearray(small)
        damaged[place] ^= 1
        with pytest.raises(FormatError, match="checksum"):
            read_e57(bytes(damaged))


def test_promises_are_held_against_the_file(small: bytes) -> None:
    file = open_e57(small)

    def with_xml(old: bytes, new: bytes) -> bytes:
        assert old in file.xml
        return file.with_xml(file.xml.replace(old, new))

    with pytest.raises(FormatError, match="promises"):
        read_e57(with_xml(b'recordCount="60"', b'recordCount="%d"' % 10**15))
    with pytest.raises(FormatError, match="document type"):
        read_e57(with_xml(b"<e57Root", b'<!DOCTYPE x [<!ENTITY a "b">]><e57Root'))
    with pytest.raises(FormatError, match="nested too deep"):
        read_e57(file.with_xml(b"<a>" * 200 + b"</a>" * 200))
    with pytest.raises(FormatError, match=r"beyond its end|no E57 points"):
        read_e57(with_xml(b'fileOffset="48"', b'fileOffset="99999999"'))
    with pytest.raises(FormatError, match=f"{len(small) - 1024}"):
        read_e57(small[:-1024])


def test_mutated_files_are_read_or_refused(small: bytes) -> None:
    rng, file = np.random.default_rng(7), open_e57(small)
    outcomes = set()
    for turn in range(120):
        if turn % 2:  # the checksums are right: as a hostile hand would leave it
            start, end = (48, file.xml_at) if turn % 4 == 1 else (file.xml_at, len(file.content))
            content = bytearray(file.content)
            content[int(rng.integers(start, end))] = int(rng.integers(256))
            data = _sealed(content, file)
        else:
            data = mutated(small, rng)
        try:
            read_e57(data).moved(motion())
            outcomes.add("read")
        except FormatError:
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


def _sealed(content: bytearray, file: E57File) -> bytes:
    xml = bytes(content[file.xml_at : file.xml_at + len(file.xml)])
    return E57File(file.page, bytes(content), file.xml_at, file.xml).with_xml(xml)
