from __future__ import annotations

import base64
import hashlib

import pytest

from utopic_cli.page.skeleton import filled, script_json, whole_page


def test_fills_are_put_in_once_and_not_looked_into() -> None:
    assert filled("<b>{{one}}</b>{{two}}{{one}}", {"one": "{{two}}", "two": "2"}) == "<b>{{two}}</b>2{{two}}"
    with pytest.raises(KeyError, match="three"):
        filled("{{three}}", {"one": ""})


def test_only_the_script_that_is_named_may_run() -> None:
    script = "alert('é')"
    page = whole_page("t", "p {}\n", "<script>{{script}}</script>\n", {"script": script}, only_script=script)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page and f"<script>{script}</script>\n</body>" in page
    assert "Content-Security-Policy" not in whole_page("t", "", "", {})


def test_no_text_ends_the_script_element() -> None:
    assert script_json({"name": "</script>"}) == '{"name":"\\u003c/script>"}'
    with pytest.raises(ValueError, match="JSON compliant"):
        script_json(float("nan"))
