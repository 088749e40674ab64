"""The layers of an E57 file below its meaning: checked pages, the XML section, and packed columns."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import cache
from xml.parsers import expat

import numpy as np

from utopic_cli.io.records import FormatError

_HEADER = struct.Struct("<8sIIQQQQ")
_CHECKSUM = 4  # bytes at the end of every page
_DAMAGED = "the file is cut short or damaged, copy it again"
_AT_ONCE = 1 << 20  # numbers unpacked at a time
_DEEPEST = 64


@dataclass
class Node:
    """An element of the XML section.

    Attributes:
        name: without its namespace.
        attributes: by name.
        children: the elements in it.
        text: its text, without that of its children.
        start, end: the bytes of the section that it takes, tags included.
    """

    name: str
    attributes: dict[str, str]
    start: int
    end: int = 0
    text: str = ""
    children: list[Node] = field(default_factory=list)

    def child(self, name: str) -> Node | None:
        """Return the first child of a name, or None."""
        return next((child for child in self.children if child.name == name), None)


@dataclass(frozen=True)
class E57File:
    """A file without its checksums.

    Attributes:
        page: bytes of a page, with its checksum.
        content: the bytes of all pages without the checksums.
        xml_at: where the XML section starts in ``content``.
        xml: the section.
    """

    page: int
    content: bytes
    xml_at: int
    xml: bytes

    def place(self, physical: int) -> int:
        """Turn an offset in the file into one in ``content``."""
        return physical - physical // self.page * _CHECKSUM

    def with_xml(self, xml: bytes) -> bytes:
        """Return the file with another XML section; all else stays where it is."""
        usable = self.page - _CHECKSUM
        # As a rule only padding follows the section; if there is more, the new one comes last.
        last = len(self.content) - self.xml_at - len(self.xml) < usable
        at = self.xml_at if last else -(-len(self.content) // 4) * 4
        content = bytearray(self.content[:at].ljust(at, b"\0") + xml)
        content += bytes(-len(content) % usable)
        pages = len(content) // usable
        start = at // usable * self.page + at % usable
        signature, major, minor, *_ = _HEADER.unpack_from(content)
        _HEADER.pack_into(content, 0, signature, major, minor, pages * self.page, start, len(xml), self.page)
        rows = np.frombuffer(content, np.uint8).reshape(pages, usable)
        return np.concatenate([rows, _checksums(rows)], axis=1).tobytes()


def open_e57(data: bytes, *, check: bool = True) -> E57File:
    """Check the pages of a file and find its XML section.

    Args:
        data: the file.
        check: hold every page against its checksum; it takes most of the time.

    Raises:
        FormatError: a checksum is wrong, or the header promises what is not there.
    """
    check_header(data, len(data))
    *_, xml_physical, xml_length, page = _HEADER.unpack_from(data)
    pages = np.frombuffer(data, np.uint8).reshape(-1, page)
    if check:
        wrong = int((_checksums(pages[:, :-_CHECKSUM]) != pages[:, -_CHECKSUM:]).any(axis=1).sum())
        if wrong:
            raise FormatError(f"has {wrong} E57 pages with a wrong checksum; {_DAMAGED}")
    content = pages[:, :-_CHECKSUM].tobytes()
    xml_at = xml_physical - xml_physical // page * _CHECKSUM
    if xml_at + xml_length > len(content):
        raise FormatError(f"has an E57 XML section beyond its end; {_DAMAGED}")
    return E57File(page, content, xml_at, content[xml_at : xml_at + xml_length])


def check_header(data: bytes, size: int) -> None:
    """Compare a file's header with its size.

    Args:
        data: the file, or some of its beginning.
        size: of the file, in bytes.

    Raises:
        FormatError: it is no E57 file of version 1, or promises what is not there.
    """
    if data[:8] != b"ASTM-E57" or len(data) < _HEADER.size:
        raise FormatError("is no E57 file by its content; check what it is")
    _, major, _, length, _, _, page = _HEADER.unpack_from(data)
    if major != 1:
        raise FormatError(f"is E57 version {major}; version 1 is read")
    if not 64 <= page <= 1 << 20 or length != size or length % page:
        raise FormatError(f"its E57 header promises {length} bytes but there are {size}; {_DAMAGED}")


@cache
def _crc_table() -> np.ndarray:
    """(256,) uint32 of CRC-32C, reflected."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(0x82F63B78), table >> 1).astype(np.uint32)
    return table


def _checksums(pages: np.ndarray) -> np.ndarray:
    """Return the checksums (P, 4) of pages (P, bytes), as they are stored: the high byte first."""
    table = _crc_table()
    crc = np.full(len(pages), 0xFFFFFFFF, np.uint32)
    for column in pages.T:  # one byte of every page at a time
        crc = table[(crc ^ column) & 0xFF] ^ (crc >> 8)
    return (crc ^ np.uint32(0xFFFFFFFF)).astype(">u4")[:, None].view(np.uint8)


def parse_xml(xml: bytes) -> Node:
    """Parse the XML section, remembering where each element stands.

    Raises:
        FormatError: it is not sound, or declares entities.
    """
    parser = expat.ParserCreate()
    parser.buffer_text = True
    root = Node("", {}, 0)
    open_nodes = [root]

    def start(name: str, attributes: dict[str, str]) -> None:
        if len(open_nodes) > _DEEPEST:
            raise FormatError(f"has an E57 XML section nested too deep; {_DAMAGED}")
        node = Node(name.rsplit(":", 1)[-1], attributes, parser.CurrentByteIndex)
        open_nodes[-1].children.append(node)
        open_nodes.append(node)

    def end(name: str) -> None:
        node = open_nodes.pop()
        # At an empty element's end the parser stands at its start, or behind it.
        closing = xml.find(b">", max(node.start, min(parser.CurrentByteIndex, len(xml) - 1)))
        first = xml.find(b">", node.start)
        node.end = (first if xml[first - 1 : first] == b"/" else closing) + 1

    def text(words: str) -> None:
        open_nodes[-1].text += words

    def refuse(*_: object) -> None:
        raise FormatError("has an E57 XML section with a document type, which is not read")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = text
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(xml, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise FormatError(f"has an E57 XML section that is not sound ({error}); {_DAMAGED}") from None
    return root.children[0]


def read_columns(file: E57File, section: int, count: int, streams: list[Stream]) -> list[np.ndarray]:
    """Read some columns of a compressed vector.

    Args:
        file: the file.
        section: where the vector's section starts in the file's content.
        count: number of records; of columns that are constant, and take no bits, any number is there.
        streams: the columns to read.

    Returns:
        A (count,) float64 array for each of them.

    Raises:
        FormatError: the section is not sound or holds less than it promises.
    """
    wanted = {stream.number: stream for stream in streams}
    parts = _collect(file, section, set(wanted))
    for number, stream in wanted.items():
        there = sum(map(len, parts[number])) * 8
        if count * stream.bits > there:
            raise FormatError(f"promises {count} E57 points but holds {there // stream.bits}; {_DAMAGED}")
    return [stream.unpack(b"".join(parts[stream.number]), count) for stream in streams]


def _collect(file: E57File, section: int, wanted: set[int]) -> dict[int, list[memoryview]]:
    """Gather the bytes of some streams from the packets of a section."""
    content = memoryview(file.content)
    kind, length, first = _unpack(content, "<B7xQQ", section)
    if kind != 1:
        raise FormatError(f"has no E57 points where it says; {_DAMAGED}")
    at, end = file.place(first), section + length
    parts: dict[int, list[memoryview]] = {number: [] for number in wanted}
    while at < end:
        packet, _, size, streams = _unpack(content, "<BBHH", at)
        if packet == 1:
            sizes = _unpack(content, f"<{streams}H", at + 6)
            places = at + 6 + 2 * streams + np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])
            if places[-1] > at + size + 1:
                raise FormatError(f"has an E57 packet that is not whole; {_DAMAGED}")
            for number in wanted:
                if number < streams:
                    parts[number].append(content[places[number] : places[number + 1]])
        elif packet not in (0, 2):
            raise FormatError(f"has an E57 packet of unknown kind {packet}; {_DAMAGED}")
        at += size + 1
    return parts


def _unpack(content: memoryview, kind: str, at: int) -> tuple[int, ...]:
    if not 0 <= at <= len(content) - struct.calcsize(kind):
        raise FormatError(f"has E57 packets beyond its end; {_DAMAGED}")
    return struct.unpack_from(kind, content, at)


@dataclass(frozen=True)
class Stream:
    """How the numbers of one column are stored.

    Attributes:
        number: which of a packet's streams.
        bits: taken by each number.
        dtype: of floating point numbers; None for packed integers.
        least: added to packed integers.
        scale, offset: of the packed integers, after ``least`` was added.
    """

    number: int
    bits: int
    dtype: np.dtype | None = None
    least: int = 0
    scale: float = 1.0
    offset: float = 0.0

    def unpack(self, stream: bytes, count: int) -> np.ndarray:
        """Return (count,) float64."""
        if self.dtype is not None:
            with np.errstate(invalid="ignore"):
                return np.frombuffer(stream, self.dtype, count).astype(np.float64)
        values = np.full(count, float(self.least))
        if self.bits:
            padded = np.frombuffer(stream + bytes(9), np.uint8)
            least = np.uint64(self.least % 2**64)  # two's complement: sums wrap to the right integer
            for start in range(0, count, _AT_ONCE):
                stop = min(start + _AT_ONCE, count)
                values[start:stop] = (self._unpacked(padded, start, stop) + least).view(np.int64)
        return values * self.scale + self.offset

    def _unpacked(self, stream: np.ndarray, start: int, stop: int) -> np.ndarray:
        """Return the integers from ``start`` to ``stop``, the low bit first, as uint64."""
        places = np.arange(start, stop, dtype=np.int64) * self.bits
        first, shift = places >> 3, (places & 7).astype(np.uint64)
        values = np.zeros(stop - start, np.uint64)
        for byte in range((self.bits + 14) // 8):
            part = stream[first + byte].astype(np.uint64)
            if byte < 8:
                values |= (part << np.uint64(8 * byte)) >> shift
            else:  # the ninth byte: only its low bits belong
                values |= np.where(shift > 0, part << (np.uint64(64) - shift), 0).astype(np.uint64)
        return values & np.uint64(2**self.bits - 1)
