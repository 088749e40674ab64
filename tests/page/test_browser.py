"""The page in a real browser, where one is installed."""

from __future__ import annotations

import os

import numpy as np
import pytest

from tests.page.browser import CHROMIUM, Browser
from tests.page.conftest import make_pair, with_rivals
from utopic_cli import page

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None or os.name == "nt", reason="no Chromium, or no pipes to talk to it"),
    pytest.mark.slow,
]

# Pixels of the canvas as one number each, without the page's colour behind.
PIXELS = """(() => {
  const canvas = document.getElementById("canvas"), copy = document.createElement("canvas");
  [copy.width, copy.height] = [canvas.width, canvas.height];
  const context = copy.getContext("2d");
  context.drawImage(canvas, 0, 0);
  const found = [], bytes = context.getImageData(0, 0, copy.width, copy.height).data;
  for (let i = 0; i < bytes.length; i += 4 * 13)
    found.push(bytes[i] << 16 | bytes[i + 1] << 8 | bytes[i + 2]);
  return found;
})()"""
HOSTILE = '</script><script>alert(1)</script><img src="https://example.org/x.png" onerror=alert(2)>'


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    opened = Browser(tmp_path_factory.mktemp("profile"))
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    pair = with_rivals(make_pair(4000), 2)
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(
        page.render(pair.result, pair.source, pair.target, source_name=HOSTILE, target_name="b.ply"),
        encoding="utf-8",
    )
    return path


def pixels(browser):
    found = np.array(browser.value(PIXELS))
    return np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1)


def counted(image):
    """Share of the picture that is neither background nor shadow, by kind of colour."""
    red, blue = image[:, 0], image[:, 2]
    return {"orange": float((red > blue + 60).mean()), "blue": float((blue > red + 60).mean())}


def changed(before, after):
    return float((before != after).any(axis=1).mean())


@pytest.mark.parametrize(("width", "dark"), [(1200, False), (1200, True), (390, False)])
def test_the_page_opens_without_a_word_or_a_request_and_fits(browser, example, width, dark):
    browser.open(example, width=width, dark=dark)
    assert browser.complaints() == []
    assert browser.value("document.documentElement.scrollWidth") <= width
    assert browser.value("document.getElementById('no_view').hidden")
    seen = counted(pixels(browser))
    assert seen["orange"] > 0.02
    assert seen["blue"] > 0.02
    background = pixels(browser)[0]
    assert (background < 60).all() if dark else (background > 200).all()


def test_every_button_shows_something_else(browser, example):
    browser.open(example)
    shown = []
    for number in range(7):
        browser.click(f"[data-view='{number}']")
        shown.append(pixels(browser))
        pressed = browser.value(
            "[...document.querySelectorAll('[aria-pressed=true]')].map(b => b.dataset.view)"
        )
        assert pressed == [str(number)]
        notes = browser.value("[...document.querySelectorAll('[data-note]')].filter(n => !n.hidden).length")
        assert notes == 1
    for i, one in enumerate(shown):
        for other in shown[:i]:
            assert changed(one, other) > 0.01
    legends = browser.value("[...document.querySelectorAll('[data-for]')].filter(n => !n.hidden).length")
    assert legends == 0  # a rival is shown in the scans' own colours
    browser.click("[data-view='4']")
    assert (
        browser.value("[...document.querySelectorAll('[data-for]')].find(n => !n.hidden).dataset.for")
        == "residual"
    )
    assert browser.complaints() == []


def test_a_switch_that_moves_ends_where_one_without_motion_does(browser, example):
    browser.open(example)
    browser.click("[data-view='0']")
    still = pixels(browser)
    browser.open(example, **{"prefers-reduced-motion": "no-preference"})
    after = pixels(browser)
    browser.click("[data-view='0']")
    browser.value("new Promise(done => setTimeout(done, 900))")
    browser.settle()
    assert changed(pixels(browser), still) < 0.001 < changed(after, still)


def test_scans_are_hidden_and_shown_and_points_sized(browser, example):
    browser.open(example)
    both = counted(pixels(browser))
    browser.click("#show_source")
    assert counted(pixels(browser))["orange"] == 0
    browser.click("#show_target")
    assert counted(pixels(browser))["blue"] == 0
    browser.click("#show_source")
    alone = counted(pixels(browser))
    assert alone["orange"] > both["orange"]
    browser.value("size.value = -2; size.dispatchEvent(new Event('input'))")
    browser.settle()
    assert counted(pixels(browser))["orange"] < 0.6 * alone["orange"]


def test_mouse_and_keys_turn_zoom_move_and_a_double_click_resets(browser, example):
    browser.open(example)
    start = pixels(browser)
    box = browser.value(
        "(({x, y, width, height}) => ({x, y, width, height}))(canvas.getBoundingClientRect())"
    )
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def drag(button, buttons):
        browser.mouse("mousePressed", x, y, button=button, buttons=buttons, clickCount=1)
        browser.mouse("mouseMoved", x + 60, y + 25, button=button, buttons=buttons)
        browser.mouse("mouseReleased", x + 60, y + 25, button=button, clickCount=1)
        browser.settle()

    def reset():
        for count in (1, 2):
            browser.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=count)
            browser.mouse("mouseReleased", x, y, button="left", clickCount=count)
        browser.settle()
        assert changed(pixels(browser), start) == 0

    drag("left", 1)
    turned = pixels(browser)
    assert changed(turned, start) > 0.02
    reset()
    drag("right", 2)
    moved = pixels(browser)
    assert min(changed(moved, start), changed(moved, turned)) > 0.02
    reset()
    browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=-400)
    browser.settle()
    assert sum(counted(pixels(browser)).values()) > 1.3 * sum(counted(start).values())
    reset()
    browser.value("canvas.focus()")
    for key in ("ArrowLeft", "ArrowUp", "+"):
        before = pixels(browser)
        browser.call("Input.dispatchKeyEvent", type="keyDown", key=key)
        browser.settle()
        assert changed(pixels(browser), before) > 0.01
    browser.call("Input.dispatchKeyEvent", type="keyDown", key="0")
    browser.settle()
    assert changed(pixels(browser), start) == 0
    assert browser.complaints() == []


def test_two_fingers_zoom(browser, example):
    browser.open(example, width=390, height=844)
    start = sum(counted(pixels(browser)).values())
    browser.value("canvas.scrollIntoView({block: 'center'})")
    box = browser.value(
        "(({x, y, width, height}) => ({x, y, width, height}))(canvas.getBoundingClientRect())"
    )
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    browser.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    for kind, apart in (("touchStart", 30), ("touchMove", 45), ("touchMove", 60)):
        points = [{"x": x - apart, "y": y, "id": 1}, {"x": x + apart, "y": y, "id": 2}]
        browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        browser.settle()
    browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    browser.call("Emulation.setTouchEmulationEnabled", enabled=False)
    assert sum(counted(pixels(browser)).values()) > 1.3 * start


def test_the_theme_is_switched_by_hand_too(browser, example):
    browser.open(example)
    light = browser.value("getComputedStyle(document.body).backgroundColor")
    browser.click("#theme")
    assert browser.value("getComputedStyle(document.body).backgroundColor") != light
    assert (pixels(browser)[0] < 60).all()
    browser.click("#theme")
    assert browser.value("getComputedStyle(document.body).backgroundColor") == light


def test_the_matrix_is_copied_whole(browser, example):
    browser.open(example)
    browser.value(
        "navigator.clipboard.writeText = text => { window.caught = text; return Promise.resolve(); }"
    )
    browser.click("#copy")
    matrix = np.array([row.split() for row in browser.value("window.caught").strip().splitlines()], float)
    np.testing.assert_array_equal(matrix, make_pair(4000).result.T_target_source)
    assert "copied" in browser.value("document.getElementById('copied').textContent")
    browser.value("navigator.clipboard.writeText = () => Promise.reject(new Error('not here'))")
    browser.click("#copy")  # by a selection then
    assert browser.value("getSelection().toString().trim().split(/\\s+/).length") == 16


def test_a_browser_without_webgl_says_so_and_shows_the_rest(tmp_path, example):
    opened = Browser(tmp_path / "profile", "--disable-3d-apis")
    try:
        opened.open(example)
        assert "no WebGL 2" in opened.value("document.getElementById('no_view').innerText")
        assert opened.value("document.querySelector('[data-view]').disabled")
        assert "No verdict" in opened.value("document.body.innerText")
        opened.click("#theme")
        assert not [one for one in opened.complaints() if "exceptionThrown" in one]
    finally:
        opened.close()
