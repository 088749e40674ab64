"""ModelNet40 and ScanObjectNN, as they are handed out."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from tests.synthesis.conftest import cuboid
from utopic_cli.errors import InputError
from utopic_cli.synthesis.packing import open_shapes
from utopic_cli.synthesis.surface import sample_surface

pytestmark = pytest.mark.usefixtures("cache")


# ModelNet40 --------------------------------------------------------------------------------


@pytest.fixture
def modelnet40(tmp_path):
    h5py = pytest.importorskip("h5py")
    root = tmp_path / "modelnet40_ply_hdf5_2048"
    root.mkdir()
    rng = np.random.default_rng(0)
    for name, labels in (("train0", [0, 19, 20, 39]), ("train1", [5]), ("test0", [1, 25, 19, 30])):
        clouds = [sample_surface(*cuboid((1, 1 + label / 20, 2)), 300, rng)[0] for label in labels]
        if name == "test0":
            clouds[3] = np.full_like(clouds[3], np.nan)
        with h5py.File(root / f"ply_data_{name}.h5", "w") as file:
            file["data"] = np.stack(clouds).astype(np.float32)
            file["label"] = np.array(labels, np.uint8)[:, None]
    (root / "shape_names.txt").write_text("\n".join(f"thing_{i}" for i in range(40)))
    return root


def test_modelnet40_is_split_by_category(modelnet40, tmp_path):
    h5py = pytest.importorskip("h5py")
    for folder in (modelnet40, tmp_path):  # the data set's folder, or the one it was unpacked in
        library = open_shapes(f"modelnet40:{folder}")
        found = {s: library.select(s).sets.tolist() for s in ("train", "val", "test")}
        assert found == {
            "train": ["thing_0", "thing_19", "thing_5"],
            "val": ["thing_1", "thing_19"],
            "test": ["thing_25"],
        }
        assert [name for name, _ in library.skipped] == ["ply_data_test0/0003"]
    with h5py.File(modelnet40 / "ply_data_test0.h5") as file:
        original = file["data"][1]
    test = library.select("test")
    assert test.samples is not None and test.samples.dtype == np.float16
    np.testing.assert_allclose(test.samples[0], original, atol=1e-3)
    assert len(test.mesh(0)[1]) > 300


def test_modelnet40_elsewhere_or_damaged_is_an_input_error(modelnet40, tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"ply_data_train\*\.h5.*Stanford"):
        open_shapes(f"modelnet40:{tmp_path / 'empty'}")
    with pytest.raises(InputError, match="no such folder"):
        open_shapes("modelnet40:")
    (modelnet40 / "ply_data_train1.h5").write_bytes(b"cut short")
    with pytest.raises(InputError, match=r"ply_data_train1\.h5: can't be read"):
        open_shapes(f"modelnet40:{modelnet40}")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match="pip install h5py"):
        open_shapes(f"modelnet40:{modelnet40}")


# ScanObjectNN ------------------------------------------------------------------------------


@pytest.fixture
def scanobjectnn(tmp_path):
    h5py = pytest.importorskip("h5py")
    rng = np.random.default_rng(0)
    for folder, size in (("main_split", 4), ("main_split_nobg", 3)):
        root = tmp_path / "h5_files" / folder
        root.mkdir(parents=True)
        clouds = [sample_surface(*cuboid((1, 2, 3)), 300, rng)[0] * 0.4 + [5.0, 0, 1] for _ in range(size)]
        with h5py.File(root / "test_objectdataset.h5", "w") as file:
            file["data"] = np.stack(clouds).astype(np.float32)
            file["label"] = np.arange(size, dtype=np.uint8)
            file["mask"] = np.full((size, 300), -1, np.int32)
    return tmp_path


def test_scanobjectnn_is_all_for_testing_and_in_the_unit_sphere(scanobjectnn):
    split = scanobjectnn / "h5_files" / "main_split"
    for path in (scanobjectnn, scanobjectnn / "h5_files", split, split / "test_objectdataset.h5"):
        library = open_shapes(f"scanobjectnn:{path}")
        assert library.splits.tolist() == ["test"] * 4
    assert library.names[0] == "test_objectdataset/0000"
    assert library.sets.tolist() == [f"category {label}" for label in range(4)]
    assert library.samples is not None and library.samples.shape == (4, 300, 3)
    reach = np.linalg.norm(library.samples.astype(float), axis=2).max(axis=1)
    np.testing.assert_allclose(reach, 1.0, atol=2e-3)  # kept in half precision
    assert len(library.mesh(0)[1]) > 300
    assert len(open_shapes(f"scanobjectnn:{scanobjectnn / 'h5_files' / 'main_split_nobg'}")) == 3


def test_scanobjectnn_elsewhere_or_damaged_is_an_input_error(scanobjectnn, tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    (tmp_path / "empty").mkdir()
    for missing in ("empty", "nothing"):
        with pytest.raises(InputError, match=rf"{missing}: no test_objectdataset\.h5 here.*hkust-vgd"):
            open_shapes(f"scanobjectnn:{tmp_path / missing}")
    with pytest.raises(InputError, match="no such folder"):
        open_shapes("scanobjectnn:")
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["points"] = np.zeros((2, 30, 3))
    with pytest.raises(InputError, match=r"other\.h5: has no arrays 'data' and 'label'.*hkust-vgd"):
        open_shapes(f"scanobjectnn:{other}")
    with h5py.File(other, "w") as file:
        file["data"], file["label"] = np.zeros((2, 30, 3)), np.zeros(2, int)
    with pytest.raises(InputError, match=r"other\.h5: has a cloud that can't be used"):
        open_shapes(f"scanobjectnn:{other}")
    other.write_bytes(b"cut short")
    with pytest.raises(InputError, match=r"other\.h5: can't be read as HDF5"):
        open_shapes(f"scanobjectnn:{other}")
