"""Reader of incomplete MCAP files, without summary and index, of recorders that were killed.

Records follow one another: an operation code (1 byte), a length (8 bytes) and a body. https://mcap.dev/spec
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6
MAGIC = b"\x89MCAP0\r\n"


def mcap_messages(path: Path, message_type: str) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, time of the recorder [ns] and content of the messages of a type, up to the last complete one."""
    data = path.read_bytes()
    types: dict[int, str] = {}
    topics: dict[int, str] = {}
    for code, body in _records(data[len(MAGIC) :]):
        if code == SCHEMA:
            types[_number("<H", body)] = _text(body, 2)
        elif code == CHANNEL:
            number, schema = struct.unpack_from("<HH", body)
            if types.get(schema) == message_type:
                topics[number] = _text(body, 4)
        elif code == MESSAGE and _number("<H", body) in topics:
            number, _, recorded = struct.unpack_from("<HIQ", body)
            yield topics[number], recorded, body[22:]


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield code and body of the records, also of those within chunks, until one is cut off."""
    start = 0
    while start + 9 <= len(data):
        code, length = struct.unpack_from("<BQ", data, start)
        body = data[start + 9 : start + 9 + length]
        start += 9 + length
        if code == CHUNK:
            yield from _records(_unpacked(body))
        elif len(body) == length:
            yield code, body


def _unpacked(chunk: bytes) -> bytes:
    """Return the records of a chunk, or the complete records of a chunk that is cut off."""
    if len(chunk) < 40:
        return b""
    size = _number("<Q", chunk, 16)
    compression = _text(chunk, 28)
    packed = chunk[32 + len(compression) + 8 :]
    if not compression:
        return packed
    if compression == "zstd":
        from backports.zstd import ZstdDecompressor

        return ZstdDecompressor().decompress(packed, size)
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

    return bytes(LZ4FrameDecompressor().decompress(packed, size))


def _number(form: str, data: bytes, start: int = 0) -> int:
    """Return the number at an offset in the data."""
    return int(struct.unpack_from(form, data, start)[0])


def _text(data: bytes, start: int) -> str:
    """Return the text at an offset in the data; it is preceded by its length."""
    return data[start + 4 : start + 4 + _number("<I", data, start)].decode()
