"""Hostile files out of valid ones: structure kept and one thing wrong, or bytes changed anywhere.

Equal seeds give equal files, so that a run can be repeated.
"""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import yaml

Mutator = Callable[[random.Random, bytes], bytes]

PATHS = (
    "../decoy.txt",
    "../../decoy.png",
    "/etc/hostname",
    "/etc/passwd",
    "depth/../../decoy.png",
    "~/decoy",
    "//etc/hostname",
    "depth",
    ".",
    "..",
    "",
    "a\x00b",
    "x" * 5000,
    "file:///etc/passwd",
    "C:\\decoy",
)
"""What must not lead out of a folder."""

NUMBERS: tuple[Any, ...] = (
    0,
    -1,
    1,
    2,
    1e-320,
    -0.0,
    0.5,
    1e6,
    1e19,
    1e154,
    1e308,
    65535,
    65536,
    2**31,
    2**32 - 1,
    2**63,
    2**64,
    10**400,
    float("nan"),
    float("inf"),
    -float("inf"),
)
OTHERS: tuple[Any, ...] = (
    None,
    True,
    False,
    "",
    "a",
    "nan",
    "1e999",
    "٣",
    "\ud7ff\u2028",
    [],
    {},
    [[]],
)
WORDS = (
    *[
        "nan",
        "inf",
        "-inf",
        "1e999",
        "-1",
        "0",
        "1e308",
        "1e-320",
        "0x10",
        "1_0",
        "٣",
        "99999999999999999999",
        "#",
        ",",
        ":",
        "-",
        "{",
        "[",
        "]",
        "}",
        "&",
        "*",
        "!",
    ],
    "1" * 5000,
    "\x00",
    "é",
    "\ufeff",
    "\u2028",
    "!!python/object/apply:os.getcwd []",
)
INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**63 - 1)


def of_bytes(rng: random.Random, data: bytes) -> bytes:
    """Change bytes anywhere: flipped, cut, repeated, or overwritten with integers at the edge."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        at = rng.randrange(len(out) + 1)
        match rng.randrange(7):
            case 0 if out:
                out[at % len(out)] ^= 1 << rng.randrange(8)
            case 1 if out:
                out[at % len(out)] = rng.randrange(256)
            case 2:
                del out[at : at + rng.choice((1, 2, 4, 8, 64, 1024))]
            case 3:
                out[at:at] = out[at : at + rng.choice((1, 4, 64, 1024))]
            case 4:
                out[at:at] = rng.randbytes(rng.choice((1, 4, 16)))
            case 5:
                width, order = rng.choice((1, 2, 4, 8)), rng.choice(("little", "big"))
                value = rng.choice(INTEGERS) & ((1 << 8 * width) - 1)
                out[at : at + width] = value.to_bytes(width, order)  # type: ignore[arg-type]
            case 6:
                del out[at:]
    return bytes(out)


def of_text(rng: random.Random, data: bytes) -> bytes:
    """Change words and lines of a text."""
    if rng.random() < 0.25:
        return of_bytes(rng, data)
    lines = data.decode("latin-1").split("\n")
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(len(lines))
        words = lines[at].split(" ")
        word = rng.randrange(len(words))
        match rng.randrange(8):
            case 0 | 1 | 2:
                words[word] = rng.choice(WORDS)
                lines[at] = " ".join(words)
            case 3:
                words[word] = rng.choice(PATHS)
                lines[at] = " ".join(words)
            case 4:
                del words[word]
                lines[at] = " ".join(words)
            case 5:
                lines.insert(at, lines[rng.randrange(len(lines))])
            case 6:
                if len(lines) > 1:
                    del lines[at]
            case 7:
                words.insert(word, rng.choice(words))
                lines[at] = " ".join(words)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def of_json(rng: random.Random, data: bytes) -> bytes:
    """Change one value of a JSON text, whatever it is."""
    if rng.random() < 0.2:
        return of_text(rng, data)
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return of_bytes(rng, data)
    for _ in range(rng.choice((1, 1, 2))):
        value = _changed(rng, value)
    text = json.dumps(value)
    if rng.random() < 0.05:
        text = "[" * 100_000 + text
    return text.encode()


def of_lines(rng: random.Random, data: bytes) -> bytes:
    """Change one value of one line of a text with a JSON value a line."""
    if rng.random() < 0.3:
        return of_text(rng, data)
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    lines[at] = of_json(rng, lines[at])
    return b"\n".join(lines)


def of_yaml(rng: random.Random, data: bytes) -> bytes:
    """Change one value of a YAML text; or let aliases multiply."""
    what = rng.random()
    if what < 0.4 or b"*a" in data or b"[[[[[[" in data:  # these trees are for others to build
        return of_text(rng, data)
    if what < 0.5:
        bomb = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
        bomb += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
        key = rng.choice(
            (b"name: *a11\n", b"poses: *a11\n", b"rig: *a11\n", b"config: *a11\n", b"")
        )
        loop = rng.choice((b"", b"", b"hand_eye: &b [*b, *b]\n", b"limits: &c {camera: *c}\n"))
        return data + b"\n" + "\n".join(bomb).encode() + b"\n" + key + loop
    if what < 0.53:
        return data + b"\nz: " + b"[" * 20_000
    try:
        value = yaml.safe_load(data)
        return yaml.safe_dump(_changed(rng, value), sort_keys=False, allow_unicode=True).encode()
    except (yaml.YAMLError, ValueError, RecursionError):
        return of_bytes(rng, data)


def of_png(rng: random.Random, data: bytes) -> bytes:
    """Change a chunk of a PNG and let its check sum agree."""
    if rng.random() < 0.1:
        return of_bytes(rng, data)
    chunks = _chunks(data)
    if not chunks:
        return of_bytes(rng, data)
    at = rng.randrange(len(chunks))
    kind, body = chunks[at]
    match rng.randrange(8):
        case 0 | 1:
            width, height, *rest = struct.unpack(">IIBBBBB", chunks[0][1][:13].ljust(13, b"\0"))
            sizes = (0, 1, 8, 6, 1000, 20_000, 65_535, 2**24, 2**31 - 1, 2**32 - 1)
            width, height = rng.choice((width, *sizes)), rng.choice((height, *sizes))
            chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", width, height, *rest))
        case 2:
            head = bytearray(chunks[0][1].ljust(13, b"\0"))
            head[rng.randrange(8, 13)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
            chunks[0] = (b"IHDR", bytes(head))
        case 3:
            chunks[at] = (kind, of_bytes(rng, body))
        case 4:
            more = rng.choice(
                (b"iCCP", b"PLTE", b"tRNS", b"zTXt", b"gAMA", b"eXIf", b"acTL", b"fdAT")
            )
            packed = b"a\0\0" + zlib.compress(bytes(rng.choice((10, 10_000, 20_000_000))))
            chunks.insert(1, (more, rng.choice((packed, rng.randbytes(30), b""))))
        case 5:
            chunks[at:at] = [chunks[at]]
        case 6:
            del chunks[at]
        case 7:
            bomb = zlib.compress(bytes(rng.choice((1, 100, 30_000_000))), 9)
            chunks = [(k, bomb if k == b"IDAT" else b) for k, b in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*chunk) for chunk in chunks)


def of_npy(rng: random.Random, data: bytes) -> bytes:
    """Change the head of an array, which says its shape and type."""
    if rng.random() < 0.3 or len(data) < 10 or data[:6] != b"\x93NUMPY":
        return of_bytes(rng, data)
    shapes = ("()", "(1,)", "(0, 8)", "(6, 8)", "(100000, 100000)", "(99999999999999999999,)")
    shapes += ("(-1,)", "(2, 2, 2)", "(1.5,)", "None", "(" * 100, "(True,)")
    types = ("'<f8'", "'<u2'", "'|O'", "'<f4'", "'|S100'", "'<M8[s]'", "[('x', '<f8')]", "'q' * 9")
    head = f"{{'descr': {rng.choice(types)}, 'fortran_order': {rng.choice(('True', 'False', '2'))},"
    head += f" 'shape': {rng.choice(shapes)}, }}"
    size = struct.unpack_from("<H", data, 8)[0]
    packed = (head + " " * 20 + "\n").encode()
    return data[:8] + struct.pack("<H", len(packed)) + packed + data[10 + size :]


def of_npz(rng: random.Random, data: bytes) -> bytes:
    """Change one array of an archive of arrays."""
    if rng.random() < 0.3:
        return of_bytes(rng, data)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:
        return of_bytes(rng, data)
    if not members:
        return data
    name = rng.choice(list(members))
    match rng.randrange(6):
        case 0:
            del members[name]
        case 1:
            members[name] = members[rng.choice(list(members))]
        case 2:
            head, _, _ = members[name].partition(b"\n")
            members[name] = head + b"\n" + bytes(rng.choice((0, 0, 8, 8, 64, 300_000_000)))
        case _:
            members[name] = of_npy(rng, members[name])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for member, body in members.items():
            archive.writestr(member, body)
    return out.getvalue()


def of_ply(rng: random.Random, data: bytes) -> bytes:
    """Change the head of a PLY or PCD file, which is text, or what follows it."""
    for end in (b"end_header\n", b"DATA binary\n", b"DATA ascii\n", b"DATA binary_compressed\n"):
        head, found, body = data.partition(end)
        if found:
            break
    if not found or rng.random() < 0.2:
        return of_bytes(rng, data)
    if rng.random() < 0.3:
        return head + found + of_bytes(rng, body)
    return of_text(rng, head + found) + body


def of_packets(rng: random.Random, data: bytes) -> bytes:
    """Change packets of RTDE, each with a size before it that agrees, or not."""
    packets = []
    at = 0
    while at + 3 <= len(data):
        size = max(3, struct.unpack_from(">H", data, at)[0])
        packets.append((data[at + 2 : at + 3], data[at + 3 : at + size]))
        at += size
    if not packets:
        return of_bytes(rng, data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        k = rng.randrange(len(packets))
        kind, body = packets[k]
        match rng.randrange(6):
            case 0:
                packets[k] = (bytes([rng.choice((*b"VvOIUSPM", rng.randrange(256)))]), body)
            case 1 | 2:
                packets[k] = (kind, of_bytes(rng, body))
            case 3:
                packets.insert(k, rng.choice(packets))
            case 4:
                doubles = (float("nan"), float("inf"), -1.0, 0.0, 1e308, 500.0)
                packets[k] = (kind, struct.pack(">d", rng.choice(doubles)) + body[8:])
            case 5:
                names = ("actual_q", "timestamp", "input_int_register_0", "nothing", "")
                packets[k] = (
                    kind,
                    body[:8] + ",".join(rng.choices(names, k=rng.choice((1, 50, 5000)))).encode(),
                )
    out = b"".join(struct.pack(">H", min(len(b) + 3, 65535)) + k + b[:65532] for k, b in packets)
    return of_bytes(rng, out) if rng.random() < 0.2 else out


def _changed(rng: random.Random, value: Any) -> Any:
    """Return a copy of a tree with one of its places changed."""
    places = list(_places(value, ()))
    if not places:
        return _nasty(rng, value)
    place = rng.choice(places)
    holder = value
    for key in place[:-1]:
        holder = holder[key]
    last = place[-1]
    what = rng.random()
    if what < 0.12:
        del holder[last]
    elif what < 0.17 and isinstance(holder, list):
        holder.insert(last, holder[last])
    elif what < 0.22 and isinstance(holder, dict):
        holder[str(rng.choice((*PATHS, *OTHERS)))] = holder.pop(last)
    else:
        holder[last] = _nasty(rng, holder[last])
    return value


def _nasty(rng: random.Random, value: Any) -> Any:
    choices: Sequence[Any] = OTHERS
    if isinstance(value, str) and rng.random() < 0.6:
        choices = PATHS
    elif isinstance(value, int | float) and rng.random() < 0.7:
        choices = NUMBERS
    elif rng.random() < 0.2:
        return [rng.choice(NUMBERS)] * rng.choice((1, 3, 4, 16, 1000))
    elif rng.random() < 0.2:
        return {str(rng.choice(OTHERS)): rng.choice(NUMBERS)}
    return json.loads(json.dumps(rng.choice(choices)))


def _places(value: Any, above: tuple[Any, ...]) -> Any:
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, inner in items:
        yield (*above, key)
        yield from _places(inner, (*above, key))


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    chunks, at = [], 8
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        chunks.append((kind, data[at + 8 : at + 8 + length]))
        at += 12 + length
    return chunks


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
