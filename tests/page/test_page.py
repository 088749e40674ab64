from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from tests.page.conftest import make_pair, with_rivals
from utopic_cli import page
from utopic_cli.page.scene import MOST_POINTS
from utopic_cli.point_cloud import PointCloud

EVIL = "</title></script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&{{scene}}.ply"
ALONE = {"meta", "link", "input", "br", "line", "path"}  # elements that have no end


def rendered(pair, source_name="a.ply", target_name="b.ply", **more):
    return page.render(
        pair.result, pair.source, pair.target, source_name=source_name, target_name=target_name, **more
    )


class Outline(HTMLParser):
    """Reads a page: elements in order with their attributes, text, and whether all are closed."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.text, self._open = [], [], []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in ALONE:
            self._open.append(tag)

    def handle_endtag(self, tag):
        if tag not in ALONE:
            assert self._open.pop() == tag

    def handle_data(self, data):
        if not self._open or self._open[-1] not in ("script", "style"):
            self.text.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())


def test_the_same_result_gives_the_same_page(pair):
    assert rendered(pair) == rendered(pair)


def test_names_and_texts_can_neither_add_elements_nor_end_any(pair):
    plain = Outline(rendered(pair.with_result(warnings=("w",), options={"o": 1}), warnings=["v"]))
    pair = pair.with_result(
        reasons=(EVIL,), warnings=(EVIL,), options={EVIL: EVIL}, weights_name=EVIL, weights_sha256=EVIL
    )
    pair = pair.with_result(timings_s={EVIL: 1.0, "refine": 0.5})
    evil = Outline(rendered(pair, EVIL, EVIL, warnings=[EVIL]))
    assert [tag for tag, _ in evil.elements] == [tag for tag, _ in plain.elements]
    assert not [name for _, attributes in evil.elements for name in attributes if name.startswith("on")]
    assert evil.words.count("<script>alert(1)</script>") >= 7


def test_a_file_name_that_is_no_text_can_be_written(pair):
    assert b">a?b<" in rendered(pair, source_name="a\udcffb").encode()


def test_nothing_is_loaded_from_elsewhere(pair):
    text = rendered(pair)
    outline = Outline(text)
    assert "://" not in text
    for _, attributes in outline.elements:
        assert not {"src", "srcset", "action"} & set(attributes)
        assert attributes.get("href", "data:,") == "data:,"
    assert "url(" not in text and "@import" not in text


def test_the_policy_lets_only_the_pages_own_script_run(pair):
    text = rendered(pair)
    (policy,) = [one["content"] for one in Outline(text).all("meta") if "http-equiv" in one]
    script = text.rsplit("<script>", 1)[1].split("</script>", 1)[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy


def test_every_name_in_the_script_is_in_the_page(pair):
    text = rendered(pair)
    outline = Outline(text)
    identities = [attributes["id"] for _, attributes in outline.elements if "id" in attributes]
    assert len(identities) == len(set(identities))
    asked = set(re.findall(r'get\("(\w+)"\)', text))
    assert len(asked) > 8
    assert asked <= set(identities)
    assert "{{" not in text


def test_controls_have_labels(pair):
    outline = Outline(rendered(with_rivals(pair, 1)))
    assert len(outline.all("input")) == 3 == len(outline.all("label"))
    assert all("aria-label" in one for one in (*outline.all("canvas"), *outline.all("svg")))
    pressed = [one["aria-pressed"] for one in outline.all("button") if "data-view" in one]
    assert pressed.count("true") == 1


@pytest.mark.parametrize(("rivals", "buttons"), [(0, 5), (2, 7), (5, 8)])
def test_up_to_three_rivals_have_a_button_and_all_are_named(pair, rivals, buttons):
    outline = Outline(rendered(with_rivals(pair, rivals)))
    assert len([one for one in outline.all("button") if "data-view" in one]) == buttons
    assert outline.words.count("Rival pose") == rivals


def test_the_matrix_is_there_to_the_last_digit(pair):
    text = rendered(pair)
    copied = re.search(r'<pre id="matrix"[^>]*>(.*?)</pre>', text, re.S)[1]
    matrix = np.array([row.split() for row in copied.strip().splitlines()], float)
    np.testing.assert_array_equal(matrix, pair.result.T_target_source)
    assert "p_target = T_target_source @ p_source" in text


def test_what_a_person_asks_for_is_in_the_page(pair):
    words = Outline(rendered(pair.with_result(warnings=("watch out",)), warnings=["odd header"])).words
    for wanted in (
        "a.ply", "b.ply", "No verdict", "nobody checked it", "watch out", "odd header", "41%", "52%",
        "0.0123", "network 1.25 s", "total, without reading and writing 1.75 s",
        "some-weights", "0123456789ab", "seed 7",
        f"all {len(pair.source):,} points of the source",
    ):  # fmt: skip
        assert wanted in words, wanted


def test_large_scans_are_thinned_and_the_page_says_so():
    pair = make_pair(55_000)
    text = rendered(pair)
    assert len(pair.source) > MOST_POINTS
    assert f"{MOST_POINTS:,} of the {len(pair.source):,} points of the source" in text
    assert len(text.encode()) < 2_500_000


def test_the_data_is_strict_json_whatever_was_not_measured(pair):
    nothing = replace(
        pair.result.fit, inlier_rmse=float("nan"), residual_percentiles={"p50": float("nan")}, threshold=1e-9
    )
    pair = pair.with_result(fit=nothing, observability=None)
    text = rendered(pair)
    data = text.split('id="scene">', 1)[1].split("</script>", 1)[0]
    json.loads(data, parse_constant=lambda constant: pytest.fail(constant))
    assert "<" not in data
    words = Outline(text).words
    assert "not measured: no point has a counterpart" in words
    assert "nan" not in words.split("Transformation")[0].split()


@pytest.mark.parametrize("kind", ["line", "plane", "twice the same point", "few"])
def test_clouds_without_a_volume_have_a_page(kind):
    rng = np.random.default_rng(0)
    points = {
        "line": np.linspace(0, 1, 60)[:, None] * np.array([1.0, 2, 3]),
        "plane": np.column_stack([rng.random((60, 2)), np.zeros(60)]),
        "twice the same point": np.zeros((2, 3)),
        "few": rng.random((4, 3)),
    }[kind]
    base = make_pair(50).result
    values = np.full(len(points), 0.5, np.float32)
    result = replace(
        base, T_target_source=np.eye(4), source_overlap=values, target_overlap=values,
        source_uncertainty=values, target_uncertainty=values * np.nan,
    )  # fmt: skip
    text = page.render(result, PointCloud(points), PointCloud(points), source_name="a", target_name="b")
    assert "NaN" not in text.split('id="scene">', 1)[1].split("</script>", 1)[0]
