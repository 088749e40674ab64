"""The YAML that programs print for messages: mappings, lists and plain values, nothing more.

Anchors, tags and texts over several lines are refused: a transformation needs none of them,
and a parser for all of YAML would be a dependency for seven numbers.
"""

from __future__ import annotations

import re
from typing import Any

from utopic_cli.io.records import FormatError

_KEY = re.compile(r"""([^\s:#'"{}\[\],&*!|>%@`-][^:#]*?|'[^']*'|"[^"]*")\s*:(?:\s+(.*)|$)""")
_COMMENT = re.compile(r"(^|\s)#.*$")
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_FLOW = re.compile(r"""\s*([{}\[\],:]|'[^']*'|"[^"]*"|[^\s{}\[\],:'"][^{}\[\],:]*)""")
_DEEPEST = 20
_LONGEST = 2000  # letters of a line

_Line = tuple[int, str, int]  # blanks before it, its text, its number in the file


def parse_yaml(data: bytes) -> list[Any]:
    """Return the documents of a YAML file as dictionaries, lists, numbers and strings.

    Raises:
        FormatError: it is no YAML of the plain kind.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError("is no text in UTF-8; write it again") from None
    documents: list[list[_Line]] = [[]]
    for number, line in enumerate(text.splitlines(), 1):
        if len(line) > _LONGEST:
            raise FormatError(f"line {number} is too long for a transformation; check what it is")
        bare = _COMMENT.sub("", line).rstrip()
        if bare == "---" or bare == "...":
            documents.append([])
        elif bare:
            indent = len(bare) - len(bare.lstrip(" "))
            if bare[indent] == "\t":
                raise FormatError(f"line {number} is indented by a tab; YAML takes blanks")
            documents[-1].append((indent, bare[indent:], number))
    return [_document(lines) for lines in documents if lines]


def _document(lines: list[_Line]) -> Any:
    value, end = _block(lines, 0, 0)
    if end < len(lines):
        raise _odd(lines[end])
    return value


def _block(lines: list[_Line], at: int, depth: int) -> tuple[Any, int]:
    """Parse the mapping, list or value that starts at a line; return it and where it ends."""
    if depth > _DEEPEST:
        raise FormatError(f"line {lines[at][2]} is nested too deep for a transformation")
    indent, text, _ = lines[at]
    if text == "-" or text.startswith("- "):
        return _list(lines, at, depth)
    if not _KEY.fullmatch(text):
        return _value(lines[at]), at + 1
    mapping: dict[str, Any] = {}
    while at < len(lines) and lines[at][0] == indent and (key := _KEY.fullmatch(lines[at][1])):
        name, rest = key[1].strip("'\""), key[2]
        if name in mapping:
            raise FormatError(f"line {lines[at][2]} names '{name[:40]}' again; write it again")
        if rest:
            mapping[name] = _value((indent, rest, lines[at][2]))
            at += 1
            continue
        mapping[name] = None
        at += 1
        if at < len(lines):
            below, next_text, _ = lines[at]
            if below > indent or (below == indent and (next_text == "-" or next_text.startswith("- "))):
                mapping[name], at = _block(lines, at, depth + 1)
    return mapping, at


def _list(lines: list[_Line], at: int, depth: int) -> tuple[list[Any], int]:
    indent = lines[at][0]
    entries: list[Any] = []
    while at < len(lines) and lines[at][0] == indent and (lines[at][1] + " ").startswith("- "):
        _, text, number = lines[at]
        inner = text[1:].lstrip(" ")
        if inner:  # what stands behind the dash is a block of its own, indented by the dash
            lines[at] = (indent + len(text) - len(inner), inner, number)
        else:
            at += 1
            if at == len(lines) or lines[at][0] <= indent:
                entries.append(None)
                continue
        entry, at = _block(lines, at, depth + 1)
        entries.append(entry)
    return entries, at


def _value(line: _Line) -> Any:
    _, text, _ = line
    if text[0] not in "{[":
        return _scalar(text, line)
    tokens, position = [], 0
    while position < len(text):
        found = _FLOW.match(text, position)
        if not found:
            raise _odd(line)
        tokens.append(found[1].strip())
        position = found.end()
    value, end = _flow(tokens, 0, line, 0)
    if end != len(tokens):
        raise _odd(line)
    return value


def _flow(tokens: list[str], at: int, line: _Line, depth: int) -> tuple[Any, int]:
    """Parse ``{x: 1, y: 2}`` or ``[1, 2]`` from its tokens."""
    if at >= len(tokens) or depth > _DEEPEST:
        raise _odd(line)
    opening = tokens[at]
    if opening not in ("{", "["):
        if opening in ("}", "]", ",", ":"):
            raise _odd(line)
        return _scalar(opening, line), at + 1
    closing = "}" if opening == "{" else "]"
    mapping: dict[str, Any] = {}
    entries: list[Any] = []
    at += 1
    while at < len(tokens) and tokens[at] != closing:
        if opening == "{":
            if at + 1 >= len(tokens) or tokens[at + 1] != ":":
                raise _odd(line)
            name = tokens[at].strip("'\"")
            mapping[name], at = _flow(tokens, at + 2, line, depth + 1)
        else:
            entry, at = _flow(tokens, at, line, depth + 1)
            entries.append(entry)
        if at < len(tokens) and tokens[at] == ",":
            at += 1
        elif at >= len(tokens) or tokens[at] != closing:
            raise _odd(line)
    if at >= len(tokens):
        raise _odd(line)
    return (mapping if opening == "{" else entries), at + 1


def _scalar(text: str, line: _Line) -> Any:
    if text[0] in "&*!|>%@`":
        raise _odd(line)
    if text[0] in "'\"":
        return text[1:-1]
    if _NUMBER.fullmatch(text):
        return float(text)
    return text


def _odd(line: _Line) -> FormatError:
    return FormatError(f"line {line[2]} ('{line[1][:40]}') is no plain YAML; write it as 'name: value' lines")
