"""What all our pages are built on: one file each, that loads nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

_POLICY = """\
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'sha256-{hash}'; \
style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'">
"""


def whole_page(
    title: str, style: str, body: str, fills: Mapping[str, str], *, only_script: str | None = None
) -> str:
    """Put a page together.

    Args:
        title: of the window, as HTML.
        style: the style sheet.
        body: a template of all that is shown.
        fills: what stands in it for each ``{{name}}``, as HTML.
        only_script: where given, browsers run nothing but this script, whatever a fill may hold.

    Returns:
        The page as HTML.
    """
    policy = ""
    if only_script is not None:
        digest = hashlib.sha256(only_script.encode("utf-8")).digest()
        policy = _POLICY.format(hash=base64.b64encode(digest).decode("ascii"))
    parts = {"policy": policy, "title": title, "style": style, "body": filled(body, fills)}
    return filled(resource("utopic_cli.page", "skeleton.html"), parts)


def filled(template: str, fills: Mapping[str, str]) -> str:
    """Put each fill where the template has its name in double braces; fills are not looked into."""
    pieces = template.split("{{")
    page = [pieces[0]]
    for piece in pieces[1:]:
        name, rest = piece.split("}}", 1)
        page += [fills[name], rest]
    return "".join(page)


def script_json(data: Any) -> str:
    """Return data as JSON that can stand in a script element: no closing tag in it ends the element."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def resource(package: str, name: str) -> str:
    """Return the text of a file that lies in a package."""
    return (resources.files(package) / name).read_text(encoding="utf-8")
