from __future__ import annotations

import base64
import hashlib
import html
import os
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from tests.multiway.stubs import make_stub, write_scans
from tests.page.browser import CHROMIUM, Browser
from utopic_cli.multiway import batch as room
from utopic_cli.multiway.page import batch_page
from utopic_cli.multiway.plan import BatchRequest

NAMES = ("a.ply", "b.ply", "{{pairs}}.ply", "d.ply", "hostile.ply")
HOSTILE = "</script><script>alert(1)</script><img src='https://example.org/x.png' onerror=alert(2)>"


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    """Two groups, an unreadable file, and a name that no file system here would take."""
    folder = tmp_path_factory.mktemp("batch")
    write_scans(folder / "scans", NAMES, objects=2)
    (folder / "scans" / "broken.ply").write_text("ply")
    weights, room.weights_of = room.weights_of, lambda options: {"name": "stub", "sha256": "stub"}
    try:
        found = room.run_batch(
            BatchRequest((folder / "scans",), folder / "out"), make_task=partial(make_stub)
        )
    finally:
        room.weights_of = weights
    scans = [
        replace(entry, file=replace(entry.file, name=HOSTILE)) if entry.file.name == "hostile" else entry
        for entry in found.scans
    ]
    reports = {
        pair: {**record, "report": {**record["report"], "reasons": [f"because of {HOSTILE}"]}}
        for pair, record in found.records.items()
    }
    return replace(found, scans=tuple(scans), records=reports, notes=(f"mind {HOSTILE}",))


def test_the_page_says_what_became_of_scans_and_pairs_and_why(outcome):
    page = batch_page(outcome).decode("utf-8")
    assert "5 of 6 scans placed, in 2 groups" in page
    assert "10 pairs tried: 4 used, 6 unconfirmed." in page
    assert page.count("because of") == 10
    assert "broken.ply: " in page and page.count("<tr><td class='name'>") == 6 + 10
    assert page.count("class='used'") == 4


def test_names_are_text_and_nothing_is_fetched(outcome):
    page = batch_page(outcome).decode("utf-8")
    assert html.escape(HOSTILE) in page and HOSTILE not in page
    assert "{{pairs}}" in page  # a name is not a place to fill in
    assert len(re.findall("<script", page)) == 2 and "<img" not in page
    without = page.replace(html.escape(HOSTILE), "")
    assert re.findall(r"(?:src|href)=['\"]?([^ >'\"]*)", without) == ["data:,"]
    script = page.rsplit("<script>", 1)[1].split("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None or os.name == "nt", reason="no Chromium, or no pipes to talk to it")
def test_a_browser_draws_it_without_complaint_at_any_width(outcome, tmp_path):
    path = tmp_path / "report.html"
    path.write_bytes(batch_page(outcome))
    browser = Browser(tmp_path / "profile")
    inked = """(() => { const c = document.getElementById("canvas");
      const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
      let n = 0; for (let i = 3; i < d.length; i += 4) n += d[i] > 0; return n; })()"""
    try:
        for width, dark in ((1200, False), (1200, True), (390, False)):
            browser.open(path, width, 800, dark)
            assert browser.complaints() == []
            assert browser.value("document.documentElement.scrollWidth") <= width
            paper = browser.value("getComputedStyle(document.body).backgroundColor")
            assert (np.array(re.findall(r"\d+", paper), int) < 128).all() == dark
            first = browser.value(inked)
            assert first > 300  # some hundreds of points, a few pixels each
            browser.click("button[data-group='1']")
            assert 0 < browser.value(inked) != first
        canvas = "document.getElementById('canvas')"
        before = browser.value(f"{canvas}.toDataURL()")
        browser.value(f"{canvas}.dispatchEvent(new KeyboardEvent('keydown', {{key: 'ArrowLeft'}}))")
        browser.settle()
        assert browser.value(f"{canvas}.toDataURL()") != before
    finally:
        browser.close()
