# SPDX-License-Identifier: BSD-3-Clause
"""Seeded mutations of files: bytes, truncation, lengths, numbers, words, names, lines, archives."""

from __future__ import annotations

import bz2
import io
import re
import struct
import zipfile
import zlib
from random import Random

LARGEST = 1 << 20
NUMBERS = [struct.pack("<d", value) for value in (float("nan"), float("inf"), -float("inf"), 1e308, 5e-324, -1.0, 0.0)]
NUMBERS += [struct.pack("<Q", value) for value in (2**64 - 1, 2**63, 2**40, 2**31, 2**20, 0, 1)]
NUMBERS += [struct.pack("<I", value) for value in (2**32 - 1, 2**31, 2**20, 0, 1)]
NUMBERS += [struct.pack(">I", value) for value in (2**32 - 1, 2**31 - 1, 40000, 0)]
WORDS = [
    b"nan", b"inf", b"-inf", b"1e400", b"-1e308", b"1e308", b"1e-320", b"-1", b"0", b"0x10", b"1_0",
    b"99999999999999999999", b"-9223372036854775809", b"1" * 400, b"1" * 5000, b"word", b"a" * 20000,
    b"\0", b"\xff\xfe", "é٣".encode(), b"", b"#", b"../../x.png", b"/etc/hostname", b"..", b"a\0b.png",
    b"a/../../../b", b"C:x", b"~", b"-", b"[", b"]", b":", b"|", b",", b"<script>", b"%s", b"n" * 300,
]  # fmt: skip
SPECIAL = [b"nan", b"inf", b"1e400", b"1e308", b"-0.0", b"1e-308", b"1e16", b"2147483648", b"18446744073709551615"]
SHAPES = [b"(99999999999,)", b"(-1,)", b"()", b"(0, 3)", b"(3, 99999999)", b"(2, 2, 2)", b"('a',)", b"(1e9,)", b"(((("]
TYPES = [
    b"'<f4'", b"'<U9'", b"'|O'", b"'|b1'", b"'<c16'", b"'>i8'", b"'<U99999999'", b"'|V8'", b"'<M8[s]'",
    b"[('a', '<f8')]", b"'",
]  # fmt: skip
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


def mutated(rng: Random, content: bytes) -> bytes:
    """Return a mutation of a file, chosen by what it holds; sometimes several, one after the other."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        content = _mutated_once(rng, content)[:LARGEST]
    return content


def _mutated_once(rng: Random, content: bytes) -> bytes:
    if content[:4] == b"PK\x03\x04" and rng.random() < 0.7:
        return _archive(rng, content)
    if content[:3] in (b"\x1f\x8b\x08", b"BZh") and rng.random() < 0.7:
        return _inside(rng, content)
    if _is_text(content) and rng.random() < 0.75:
        return rng.choice((_word, _word, _line, _number))(rng, content)
    return _bytes(rng, content)


def _inside(rng: Random, content: bytes) -> bytes:
    """Mutate what is compressed."""
    is_gzip = content[:1] == b"\x1f"
    try:
        inner = zlib.decompress(content, 31) if is_gzip else bz2.decompress(content)
    except (zlib.error, OSError, ValueError):  # an earlier mutation has spoilt it
        return _bytes(rng, content)
    inner = _mutated_once(rng, inner)
    return gzip_stored(inner) if is_gzip else bz2.compress(inner)


def _is_text(content: bytes) -> bool:
    return b"\0" not in content[:200] and content[:20].isascii()


def _bytes(rng: Random, content: bytes) -> bytes:
    at = rng.randrange(len(content) + 1)
    head, tail = content[:at], content[at:]
    kind = rng.randrange(8)
    blob = rng.choice([*NUMBERS, rng.randbytes(rng.randrange(1, 16)), rng.choice(WORDS)])
    if kind == 0:
        return head
    if kind == 1:
        return head + bytes([tail[0] ^ 1 << rng.randrange(8)]) + tail[1:] if tail else head
    if kind in (2, 3):
        return head + blob + tail[len(blob) :]
    if kind == 4:
        return head + blob + tail
    if kind == 5:
        return head + tail[rng.randrange(1, 64) :]
    if kind == 6:
        return content + blob * rng.choice((1, 1, 50))
    return head + tail[:64] * rng.choice((2, 3, 200)) + tail


def _word(rng: Random, content: bytes) -> bytes:
    """Replace, remove or exchange words."""
    words = list(re.finditer(rb"[^\s,]+", content))
    if not words:
        return _bytes(rng, content)
    one, two = rng.choice(words), rng.choice(words)
    new = rng.choice([*WORDS, two.group(), b"%d" % rng.randrange(-3, 3000)])
    return content[: one.start()] + new + content[one.end() :]


def _number(rng: Random, content: bytes) -> bytes:
    """Replace a number by a special one everywhere, or once."""
    words = re.findall(rb"-?\d[\d.e+-]*", content)
    if not words:
        return _word(rng, content)
    new = rng.choice(SPECIAL)
    return content.replace(rng.choice(words), new, rng.choice((1, 1, -1)))


def _line(rng: Random, content: bytes) -> bytes:
    """Drop, repeat, shuffle, join or grow lines."""
    lines = content.split(b"\n")
    at, kind = rng.randrange(len(lines)), rng.randrange(6)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, rng.choice(lines))
    elif kind == 2:
        rng.shuffle(lines)
    elif kind == 3:
        lines[at] = lines[at] * rng.choice((2, 500))
    elif kind == 4:
        lines[at] = lines[at].replace(b" ", rng.choice((b"", b"  ", b",", b"\t", b"\r", b"\x0b")))
    else:
        return content.replace(b"\n", rng.choice((b"\r\n", b"\r", b" ", b"\n\n")))
    return b"\n".join(lines)


def _archive(rng: Random, content: bytes) -> bytes:
    """Change one member of a zip file, and write the file again so that its checksums are right."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            members = {info.filename: file.read(info) for info in file.infolist()}
    except Exception:  # an earlier mutation has spoilt it
        return _bytes(rng, content)
    if not members:
        return _bytes(rng, content)
    name = rng.choice(list(members))
    kind = rng.randrange(6)
    if kind == 0:
        del members[name]
    elif kind == 1:
        other = rng.choice([*(word.decode("latin1") for word in WORDS), "x.npy", rng.choice(list(members))])
        members[other] = members[name]
    elif kind == 2:
        members[name] = _bytes(rng, members[name])
    else:
        members[name] = _array(rng, members[name])
    target = io.BytesIO()
    try:
        with zipfile.ZipFile(target, "w", rng.choice(METHODS)) as file:
            for member, data in members.items():
                file.writestr(member, data)
    except Exception:  # names and sizes that a zip file cannot hold
        return _bytes(rng, content)
    return target.getvalue()


def _array(rng: Random, data: bytes) -> bytes:
    """Change header or numbers of an ``.npy`` file."""
    end = data.find(b"\n") + 1
    head, body = data[:end], data[end:]
    kind = rng.randrange(4)
    if kind == 0:
        head = re.sub(rb"'shape': \([^)]*\)", lambda _: b"'shape': " + rng.choice(SHAPES), head)
    elif kind == 1:
        head = re.sub(rb"'descr': '[^']*'", lambda _: b"'descr': " + rng.choice(TYPES), head)
    elif body:
        at = rng.randrange(len(body)) // 8 * 8
        number = rng.choice(NUMBERS)[:8]
        body = body[:at] + number + body[at + len(number) :]
        if kind == 3:
            body = number * (len(body) // len(number)) + body[: len(body) % len(number)]
    return head + body


def gzip_stored(text: bytes) -> bytes:
    """Wrap bytes as gzip without zlib's compressor, which pycolmap's wheel may have broken in this process."""
    blocks = [text[at : at + 65535] for at in range(0, len(text), 65535)] or [b""]
    body = b"".join(
        bytes([number == len(blocks) - 1]) + struct.pack("<HH", len(block), len(block) ^ 0xFFFF) + block
        for number, block in enumerate(blocks)
    )
    return b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + body + struct.pack("<II", zlib.crc32(text), len(text) & 0xFFFFFFFF)
