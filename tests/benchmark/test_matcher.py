from __future__ import annotations

import numpy as np
import pytest

from tests.benchmark.conftest import bumpy_object
from utopic_cli.benchmark.contestants import load_contestants
from utopic_cli.benchmark.fpfh import Fpfh, dual_softmax
from utopic_cli.benchmark.matcher import load_matchers
from utopic_cli.bridge import predict
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.geometry.rigid import random_rotation, relative_rotation_error_deg, rigid
from utopic_cli.look import look_both_sides
from utopic_cli.pipeline import register
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import prepare


@pytest.fixture(scope="module")
def clouds() -> tuple[PointCloud, PointCloud, np.ndarray]:
    rng = np.random.default_rng(4)
    world = bumpy_object(rng, 6000)
    gt = rigid(random_rotation(rng), np.array([1.0, 2.0, 3.0]))
    target = PointCloud(world[world[:, 0] < 0.8])
    source = PointCloud(world[world[:, 0] > -0.3]).transformed(np.linalg.inv(gt))
    return PointCloud(source.points[::2]), PointCloud(target.points[1::2]), gt


def test_a_network_is_solved_for_as_the_pipeline_does(clouds, monkeypatch) -> None:
    source, target, _ = clouds
    monkeypatch.setattr("utopic_cli.look.UNCLEAR_MARGIN", (1.0, 1.0))  # one sampling
    (network,) = load_matchers(["utopic"], [], seed=3, device="cpu")
    prepared = prepare(source, target, 300)
    look = look_both_sides(network.look, prepared)
    options = AlignOptions(points=300, refine=False, seed=3, device="cpu")
    expected = register(source, target, options).T_target_source
    found = look.prepared.denormalise(look.estimate.T_target_source)
    # The same steps; where arrays happen to lie in memory can change the last bits of a sum.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_fpfh_aligns_two_parts_of_an_object(clouds) -> None:
    pytest.importorskip("open3d")
    source, target, gt = clouds
    fpfh = Fpfh()
    prepared = prepare(source, target, 600)
    view = fpfh.look(prepared)
    assert view.matching_scores.shape == (len(prepared.source.points), len(prepared.target.points))
    assert (view.source_overlap == 1).all() and (view.target_uncertainty == 0).all()
    look = look_both_sides(fpfh.look, prepared)
    T = look.prepared.denormalise(look.estimate.T_target_source)
    assert relative_rotation_error_deg(T, gt) < 2.0


def test_dual_softmax_rewards_mutual_preference() -> None:
    similarity = np.array([[0.9, 0.1, 0.1], [0.8, 0.5, 0.1], [0.1, 0.1, 0.6]])
    scores = dual_softmax(similarity)
    assert scores.min() >= 0 and scores.max() <= 1
    # Row 1 likes column 0 best too, but column 0 likes row 0 better; row and column 2 are a clear case.
    assert scores[1, 0] < scores[0, 0] < scores[2, 2] and scores[2, 2] > 0.99
    assert list(scores.argmax(axis=1)) == [0, 0, 2]
    np.testing.assert_allclose(dual_softmax(5.0 * similarity + 3.0), scores)
    assert np.isfinite(dual_softmax(np.ones((2, 2)))).all()


def test_overlap_is_weighed_where_the_odds_are_told(clouds) -> None:
    source, target, gt = clouds
    (network,) = load_matchers(["utopic"], [], 0, "cpu")
    prepared = prepare(source, target, 200)
    T = prepared.normalise(gt)
    first = network.look(prepared)
    plain = predict(network.model, prepared, 0, T)
    sure, unlikely = (network.look_again(prepared, first, T, odds) for odds in (60.0, -60.0))
    usual = network.model.verifier.overlap[2].item()
    np.testing.assert_allclose(unlikely.source_overlap, usual)
    assert np.ptp(sure.source_overlap) > 0.5 and not np.allclose(sure.source_overlap, plain.source_overlap)
    np.testing.assert_allclose(sure.source_raw, plain.source_raw)
    np.testing.assert_allclose(unlikely.target_raw, first.target_raw)


def test_weights_of_one_name_are_told_apart(tmp_path) -> None:
    from utopic_cli.model.weights import find_weights

    bundled = find_weights("utopic")
    for suffix in (".safetensors", ".json"):
        (tmp_path / f"utopic{suffix}").write_bytes(bundled.with_suffix(suffix).read_bytes())
    other = str(tmp_path / "utopic.safetensors")
    names = [matcher.name for matcher in load_matchers(["utopic", other, "utopic"], [], 0, "cpu")]
    assert names == ["utopic", other]


def test_what_cant_be_measured_is_refused() -> None:
    with pytest.raises(UsageError, match=r"'magic'.*fpfh.*small-gicp"):
        load_contestants([], ["magic"], 0, "cpu")
    with pytest.raises(UsageError, match="nothing to measure"):
        load_contestants([], [], 0, "cpu")
    with pytest.raises(InputError, match="no bundled weights"):
        load_matchers(["nobody"], [], 0, "cpu")


def test_features_and_whole_methods_are_told_apart() -> None:
    pytest.importorskip("open3d")
    found = load_contestants([], ["open3d-icp", "fpfh", "open3d-icp"], 0, "cpu")
    assert [one.name for one in found.matchers] == ["fpfh"]
    assert [one.name for one in found.methods] == ["open3d-icp"]
    assert found.settings().keys() == {"fpfh", "open3d-icp"}
