"""The page of curves: whole, small, and showing the numbers that are in the records."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from datetime import datetime, timezone
from html.parser import HTMLParser

import pytest
import torch

from utopic_cli.training.config import TrainingConfig
from utopic_cli.training.curves import MOST_POINTS, curves_page, kind_of
from utopic_cli.training.network import LossWeights
from utopic_cli.training.validation import validate

SETTINGS = TrainingConfig().as_dict()
METRICS = list(validate(torch.nn.Identity(), [], 0))  # type: ignore[arg-type]
RUNNING = ("rate", "gradient", "pairs_per_s", "waiting")


def record(number, **values):
    stage = "descriptor" if number < 6 else "joint"
    return {"pairs": 10 * number, "of": 200_000, "stage": stage, "elapsed_s": 30.0 * number, **values}


def data_of(page):
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.S).group(1))


def cells(page):
    return [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(<td>.*?)</tr>", page)]


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.attributes = []

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, name, value) for name, value in attrs]


def test_the_page_loads_nothing():
    page = curves_page([record(1, descriptor=1.0)], "run", SETTINGS)
    assert not re.search(r"https?:|url\((?!#)|@import|fetch\(|import\(", page.replace("url(#${clip})", ""))
    tags = Tags()
    tags.feed(page)
    loaded = [(tag, value) for tag, name, value in tags.attributes if name in ("src", "href", "action")]
    assert loaded == [("link", "data:,")]


def test_last_first_and_best_values_are_in_the_table():
    records = [
        record(1, descriptor=5.5),
        record(2, descriptor=4.5, hit_rate=0.25),
        record(3, descriptor=4.0, hit_rate=0.5, overlap_accuracy=0.9),
        record(4, descriptor=4.125, hit_rate=0.375, pairs_per_s=2.5),
    ]
    rows = cells(curves_page(records, "run", SETTINGS))
    assert ["hit rate", "37.5 %", "25.0 %", "50.0 %", "30"] in rows
    assert ["overlap accuracy", "90.0 %", "90.0 %", "90.0 %", "30"] in rows
    assert ["descriptor", "4.125", "5.5", "", ""] in rows
    assert ["pairs/s", "2.5", "2.5", "", ""] in rows
    assert ["schedule.batch", str(SETTINGS["schedule"]["batch"])] in rows


def test_the_time_left_is_said_as_of_when_and_only_while_there_is_some():
    records = [record(2, left_s=1320.0)]
    now = datetime(2024, 5, 3, 14, 7, 31, tzinfo=timezone.utc)
    assert "about 22 min left as of 2024-05-03 14:07+00:00<" in curves_page(records, "run", {}, now=now)
    ended = curves_page(records, "run", {})
    assert "20 of 200,000 pairs in 1 min" in ended and "min left" not in ended


def test_curves_hold_the_records_numbers_by_pairs_and_minutes():
    records = [record(4, descriptor=2.0), record(5, descriptor=1.5, hit_rate=0.5), record(6, overlap=0.7)]
    data = data_of(curves_page(records, "run", SETTINGS))
    assert data["records"]["pairs"] == [40, 50, 60]
    assert data["records"]["minutes"] == [2.0, 2.5, 3.0]
    assert data["records"]["values"] == {"descriptor": [2.0, 1.5, None], "overlap": [None, None, 0.7]}
    assert data["validations"]["values"] == {"hit_rate": [0.5]}
    assert data["stages"] == [{"name": "joint", "pairs": 50, "minutes": 2.5}]


def test_every_number_has_a_chart():
    names = [*LossWeights._fields, *METRICS, *RUNNING, "recall_of_tomorrow"]
    data = data_of(curves_page([record(1, **dict.fromkeys(names, 0.5))], "run", SETTINGS))
    charts = [chart for group in data["groups"] for chart in group["charts"]]
    assert sorted(name for chart in charts for name in chart["names"]) == sorted(names)
    assert all(set(chart["names"]) <= set(data[chart["table"]]["values"]) for chart in charts)


def test_kinds():
    assert {kind_of(name) for name in LossWeights._fields} == {"loss"}
    assert {kind_of(name) for name in METRICS} == {"validation"}
    assert {kind_of(name) for name in record(1, left_s=1.0)} == {"about"}


def test_a_long_run_stays_small_and_its_means_stay_true():
    names = [*LossWeights._fields, *METRICS, *RUNNING]
    records = [
        record(i, **{name: (i * 7919 + 31 * k) % 1000 / 997 for k, name in enumerate(names)})
        for i in range(20_000)
    ]
    page = curves_page(records, "run", SETTINGS)
    assert len(page.encode()) < 1_000_000
    table = data_of(page)["records"]
    assert MOST_POINTS / 2 < len(table["pairs"]) <= MOST_POINTS + 1
    assert table["pairs"][-1] == 199_990
    assert table["pairs"][0] == 50  # no mean reaches over the change of the stage
    expected = sum(one["waiting"] for one in records[:6]) / 6
    assert table["values"]["waiting"][0] == pytest.approx(expected, rel=1e-4)
    assert cells(page)[0][1] == f"{100 * records[-1]['hit_rate']:.1f} %"


def test_what_is_no_number_leaves_a_gap():
    page = curves_page([record(1, descriptor=float("nan"), overlap=float("inf"), hit_rate=0.5)], "run", {})
    data = data_of(page)  # strict JSON: NaN would stop the page's script
    assert data["records"]["values"] == {}
    assert not re.search(r"\bNaN\b|Infinity,", json.dumps(data))


def test_names_from_outside_are_text():
    bad = "</script><b>&"
    page = curves_page([{**record(1, descriptor=1.0), "stage": bad}, record(2)], bad, {bad: {bad: bad}})
    assert "<b>&" not in page
    assert page.count("</script>") == 2


def test_a_run_without_records_has_a_page():
    page = curves_page([], "run", SETTINGS)
    assert "No record yet" in page
    assert "{{" not in page and data_of(page)["groups"] == []


BROWSER = shutil.which("chromium") or shutil.which("google-chrome")


def drawn_by_a_browser(records, folder):
    """What Chromium makes of the page of these records, without the script's own text."""
    (folder / "curves.html").write_text(curves_page(records, "run", SETTINGS), encoding="utf-8")
    flags = "--headless --no-sandbox --disable-gpu --enable-logging=stderr --virtual-time-budget=2000"
    done = subprocess.run(
        [
            str(BROWSER),
            *flags.split(),
            "--dump-dom",
            f"--user-data-dir={folder / 'profile'}",
            folder / "curves.html",
        ],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "CONSOLE" not in done.stderr
    return done.stdout.split("<script", 1)[0]


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here")
def test_a_browser_draws_every_curve_without_a_complaint(tmp_path):
    records = [record(i, descriptor=5.0 / i, hit_rate=0.1 * i, waiting=0.0) for i in range(1, 9)]
    drawn = drawn_by_a_browser(records, tmp_path)
    curves = re.findall(r'<path class="curve" [^>]*d="(M[^"]*)"', drawn)
    assert [len(re.findall("[ML]", path)) for path in curves] == [8, 8, 8]
    assert not re.search(r"NaN|undefined|Infinity", drawn)
    assert re.findall(r"<b>(.*?)</b>", drawn) == ["80.0 %", "0.625", "0.0 %"]
    assert drawn.count('class="stage"') == 3


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here")
def test_a_browser_draws_single_values_as_dots(tmp_path):
    drawn = drawn_by_a_browser([record(1, descriptor=5.0, waiting=0.0)], tmp_path)
    assert drawn.count("<circle") == 2
