"""A valid file with something wrong in it: text, numbers, structure, arrays, bytes."""

import io
import json
import random
import re
import struct
import zipfile
from typing import Any

import numpy as np
import safetensors.numpy

NUMBERS = [
    *"0 -1 1e400 -1e308 1e-320 nan NaN Infinity null true [] {}".split(),
    *"99999999999999999999 2147483648 10000000000000 4611686018427387904 1e200 0x10 1_000".split(),
    "9" * 5000,
    "0." + "0" * 400 + "1",
    "[" * 2000 + "]" * 2000,
    '"' + "a" * 3000 + '"',
    "{a: 1, a: 2}",
]
WORDS = [
    "zzz",
    "",
    "../../x",
    "a\\u0000b",
    "\u202e",
    "name",
    "*a",
    "&a",
    "!!python/object:os.system",
    "<!DOCTYPE a>",
]
VALUES = [
    0,
    1,
    -1,
    3,
    0.5,
    -0.5,
    1e-320,
    1e9,
    1e200,
    -1e308,
    2**31,
    2**62,
    10**19,
    float("nan"),
    float("inf"),
]
VALUES += [
    "",
    "a",
    "../../x",
    "a\0b",
    "\ud800",
    "\x1b[31m",
    "=1+1",
    True,
    False,
    None,
    [],
    {},
    [[]],
    {"a": 1},
]
_LARGEST = 2**18
"""Bytes of what comes out: readers are to be tried, not the disk."""
_TEXT = re.compile(rb"[\t\n\r -~]{64}")


@np.errstate(all="ignore")
def mutated(content: bytes, rng: random.Random) -> bytes:
    """`content` with one to three things changed, as fits what it is."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if content[:2] == b"PK" and rng.random() < 0.9:
            content = _archive(content, rng)
        elif content[:3] == b"\x08\x07:" and rng.random() < 0.7:
            content = _fields(content, rng)
        elif content[8:10] == b'{"' and rng.random() < 0.8:
            content = _tensors(content, rng)
        elif content[:1] in (b"{", b"[") and rng.random() < 0.6:
            content = _json(content, rng)
        elif _TEXT.match(content) is not None and rng.random() < 0.9:
            content = _text(content.decode("utf-8", "replace"), rng).encode("utf-8", "replace")
        else:
            content = _bytes(content, rng)
        content = content[:_LARGEST]
    return content


def _text(text: str, rng: random.Random) -> str:
    """Cut, or with something changed, taken out, doubled or renamed."""
    place = rng.randrange(len(text) + 1)
    match rng.randrange(8):
        case 0:
            return text[:place]
        case 1:
            return (
                text[:place]
                + rng.choice("0123456789-.eE[]{}\":,=<>/ \nax\x00&*%!\\'")
                + text[place + 1 :]
            )
        case 2:
            return text[:place] + text[place + rng.randrange(1, 40) :]
        case 3:
            return text[: place + rng.randrange(1, 60)] + text[place:]
        case 4 | 5:
            found, new = list(re.finditer(r"-?\d+\.?\d*(e-?\d+)?", text)), rng.choice(NUMBERS)
        case 6:
            found, new = list(re.finditer(r"[A-Za-z_]{3,}", text)), rng.choice(WORDS)
        case _:
            lines = text.splitlines(keepends=True) or [""]
            one, other = rng.randrange(len(lines)), rng.randrange(len(lines))
            lines[one], lines[other] = lines[other], lines[one] * rng.choice((0, 1, 2, 50))
            return "".join(lines)
    if len(found) == 0:
        return text
    chosen, number = rng.choice(found), rng.random()
    if (
        chosen[0][-1].isdigit() and number < 0.4
    ):  # one that could be meant: another of the file, or nearly the same
        near = float(chosen[0]) * rng.choice((-1, 0.999, 1.1, 10, 1000))
        new = rng.choice(found)[0] if number < 0.2 else f"{near:.9g}"
    return text[: chosen.start()] + new + text[chosen.end() :]


def _json(content: bytes, rng: random.Random) -> bytes:
    """A value of it is another one, taken out, or of another place; still JSON."""
    try:
        value = json.loads(content)
        places: list[tuple[Any, Any]] = []
        waiting = [value]
        while len(waiting) > 0:
            each = waiting.pop()
            keys = list(each) if isinstance(each, dict) else range(len(each))
            places += [(each, key) for key in keys]
            waiting += [each[key] for key in keys if isinstance(each[key], dict | list)]
        holder, key = rng.choice(places)
        other, other_key = rng.choice(places)
        match rng.randrange(5):
            case 0:
                del holder[key]
            case 1:
                holder[key] = other[other_key]
            case 2 if isinstance(holder, list):
                holder.insert(key, holder[key])
            case 2:
                holder[rng.choice(WORDS)] = holder[key]
            case _:
                holder[key] = rng.choice(VALUES)
        return json.dumps(value).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError, TypeError, IndexError):
        return _bytes(content, rng)


def _archive(content: bytes, rng: random.Random) -> bytes:
    """An `.npz` with one array changed, its checksum right again; or its own bytes changed."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:
        return _bytes(content, rng)
    if len(members) == 0 or rng.random() < 0.08:
        return _bytes(content, rng)
    name = rng.choice(sorted(members))
    if rng.random() < 0.1:
        members[rng.choice((name + "x", "frame.npy", "../x.npy"))] = members.pop(name)
    elif rng.random() < 0.7:
        members[name] = _member(members[name], rng)
    elif rng.random() < 0.5:
        members[name] = _header(members[name], rng)
    else:
        members[name] = _bytes(members[name], rng)
    stream = io.BytesIO()
    with zipfile.ZipFile(
        stream, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    ) as archive:
        for key, value in members.items():
            archive.writestr(key, value)
    return stream.getvalue()


def _member(content: bytes, rng: random.Random) -> bytes:
    """An array of an archive that is another one."""
    stream = io.BytesIO()
    try:
        np.save(stream, _array(np.load(io.BytesIO(content)), rng))
    except Exception:  # not an array any more
        return _bytes(content, rng)
    return stream.getvalue()


def _header(array: bytes, rng: random.Random) -> bytes:
    """An array that says something else of itself, in as many bytes."""
    head, body = array[:128], array[128:]
    changes = [
        (b"'<f8'", b"'<i8'"),
        (b"'<i8'", b"'<f8'"),
        (b"'<f8'", b"'<U2'"),
        (b"'<f", b"'>f"),
        (rb"'\S\S\S'", b"'|O8'"),
        (rb"\d+,", b"%d," % rng.randrange(-2, 10)),
        (rb"\(\d", b"(9"),
        (b"False", b"True "),
        (rb"\d", b"0"),
    ]
    old, new = rng.choice(changes)
    head = re.sub(old, new, head, count=1)
    if rng.random() < 0.5:
        kind = rng.choice(
            (
                b"\xff" * 8,
                b"\0" * 8,
                b"\0" * 6 + b"\xf0\x7f",
                b"\0" * 6 + b"\xf8\x7f",
                struct.pack("<d", 1e200),
                struct.pack("<q", rng.choice((2**40, 2**52, 2**62))),
            )
        )
        at = 8 * rng.randrange(max(1, len(body) // 8))
        body = body[:at] + kind + body[at + 8 :]
    return head[:128] + body


def _tensors(content: bytes, rng: random.Random) -> bytes:
    """A `.safetensors` with one array, or what is said of them, changed; readable again."""
    try:
        arrays = safetensors.numpy.load(content)
        said = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
    except Exception:
        return _bytes(content, rng)
    if len(arrays) == 0 or rng.random() < 0.2:
        name = rng.choice(sorted(said))
        return safetensors.numpy.save(arrays, said | {name: _text(said[name], rng)})
    name = rng.choice(sorted(arrays))
    match rng.randrange(7):
        case 0:
            del arrays[name]
        case 1:
            arrays[rng.choice((name + "x", *sorted(arrays)))] = arrays.pop(name)
        case _:
            arrays[name] = _array(arrays[name], rng)
    return safetensors.numpy.save(arrays, said)


def _array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """An array cut, doubled, of another type, or with other values; half of them such that only
    values tell.
    """
    if rng.random() < 0.5 and array.size > 0 and array.ndim > 0 and array.dtype.kind in "fiub":
        return _values(array, rng)
    match rng.randrange(6):
        case 0:
            return array.reshape(-1)[: rng.randrange(array.size + 1)]
        case 1:
            return np.concatenate([array, array]) if array.ndim > 0 else array[None]
        case 2 if array.dtype.kind != "U":
            return array.astype(rng.choice(("<f8", "<i8", "<f4", "u1", "?")))
        case _ if array.size > 0:
            array = array.copy()
            numbers = (
                0,
                1,
                -1,
                3,
                255,
                2**40,
                2**62,
                1e-300,
                0.5,
                1e3,
                1e9,
                1e200,
                np.nan,
                np.inf,
                -np.inf,
            )
            where = slice(None) if rng.random() < 0.3 else rng.randrange(array.size)
            if array.dtype.kind == "U":
                array.reshape(-1)[where] = rng.choice(WORDS)
            elif rng.random() < 0.3:
                array.reshape(-1)[where] = array.reshape(-1)[rng.randrange(array.size)]
            else:
                array.reshape(-1)[where] = np.array(rng.choice(numbers)).astype(array.dtype)
    return array


def _values(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """An array of the same shape and type with values that could be meant: little else, exchanged,
    repeated.
    """
    rows, places = rng.sample(range(len(array)), len(array)), np.arange(len(array))
    one, other = rng.choice(rows), rng.choice(rows)
    match rng.randrange(7):
        case 0:
            return array[rows]
        case 1:
            places[one] = other
            return array[places]
        case 2:
            return np.repeat(array[one : one + 1], len(array), axis=0)
        case 3 if array.ndim > 1:
            return np.flip(array, axis=rng.randrange(1, array.ndim)).copy()
        case 4 if array.dtype.kind == "f" and array.shape[-1] == (
            array.shape[-2] if array.ndim > 1 else 0
        ):
            scale = rng.choice(
                (1e-300, 1e-9, 1e-3, 10.0, 1e9, 1e150)
            )  # a matrix that stays one of a Gaussian
            return (array * scale).astype(array.dtype)
        case 5 if array.dtype.kind == "f":
            noise = np.random.default_rng(rng.randrange(2**32)).normal(size=array.shape)
            return (array * (1 + rng.choice((1e-12, 1e-3, 0.3)) * noise)).astype(array.dtype)
    array = array.copy()
    if array.dtype.kind == "b":
        array[one] = ~array[one]
    elif array.dtype.kind == "f":
        array[one] *= rng.choice((-1, 0, 0.5, 1.1, 100, 1e6, np.nan))
    else:
        array[one] = array[one] + array.dtype.type(rng.choice((1, 2, 7, 100)))
    return array


def _bytes(content: bytes, rng: random.Random) -> bytes:
    """Bits turned, bytes put in, cut out or doubled."""
    if len(content) == 0:
        return rng.randbytes(3)
    place, length = rng.randrange(len(content)), rng.randrange(1, 16)
    match rng.randrange(6):
        case 0:
            return content[:place]
        case 1:
            return (
                content[:place]
                + bytes([content[place] ^ 1 << rng.randrange(8)])
                + content[place + 1 :]
            )
        case 2:
            return content[:place] + rng.randbytes(length) + content[place + length :]
        case 3:
            return content[:place] + content[place + length :]
        case 4:
            return content[: place + length] + content[place:]
        case _:
            return content[:place] + b"\xff" * length + content[place + length :]


_ELSEWHERE = (
    b"j\x12\x0a\x08location\x12\x06canary",
    b"p\x01",
    b"j\x12\x12\x06canary\x0a\x08location",
    b"j\x00",
)
"""What a tensor of ONNX says whose numbers are in the file "canary"."""


def _fields(content: bytes, rng: random.Random) -> bytes:
    """A message of protobuf with one of its fields, or of a message in it, changed; lengths right
    again.
    """
    fields, at = list[tuple[bytes, bytes | None, bytes]](), 0
    while at < len(content):  # tag, value of a number, content
        try:
            start = at
            tag, at = _number(content, at)
            head = content[start:at]
            if tag & 7 == 2:
                length, at = _number(content, at)
                fields.append((head, None, content[at : at + length]))
                at += length
            else:
                start, at = (
                    at,
                    _number(content, at)[1] if tag & 7 == 0 else at + (8 if tag & 7 == 1 else 4),
                )
                fields.append((head, content[start:at], b""))
        except IndexError:
            return _bytes(content, rng)
    if len(fields) == 0:
        return rng.choice((b"", *_ELSEWHERE))
    n = rng.randrange(len(fields))
    head, value, inner = fields[n]
    match rng.randrange(12):
        case 0:
            del fields[n]
        case 1:
            fields.insert(n, fields[rng.randrange(len(fields))])
        case 2:
            fields[n] = fields[rng.randrange(len(fields))]
        case 3:
            fields[n] = (
                rng.choice((b"\xba\x00", b"\x3b", b"\x3c", bytes([rng.randrange(128)]))),
                value,
                inner,
            )
        case 4:
            fields[n] = _wide(head, rng), value, inner
        case 5 if value is None:
            fields[n] = head, None, inner + rng.choice(_ELSEWHERE)
        case 6 if value is None:
            fields[n] = head, None, inner * 2
        case _ if value is None:
            fields[n] = (
                head,
                None,
                _fields(inner, rng) if rng.random() < 0.8 else _bytes(inner, rng),
            )
        case _:
            fields[n] = (
                head,
                rng.choice((b"\0", b"\1", b"\x7f", b"\xff" * 9 + b"\1", b"\x81\x80\x80\x80\x10")),
                b"",
            )
    return b"".join(
        head + (value if value is not None else _length(len(inner), rng) + inner)
        for head, value, inner in fields
    )


def _number(content: bytes, at: int) -> tuple[int, int]:
    """A whole number of protobuf at a place, and where it ends."""
    value = shift = 0
    while content[at] > 127:
        value, at, shift = value | (content[at] & 127) << shift, at + 1, shift + 7
    return value | content[at] << shift, at + 1


def _length(number: int, rng: random.Random) -> bytes:
    """A whole number as protobuf writes it; now and then in more bytes."""
    out = b""
    while number > 127:
        out, number = out + bytes([number & 127 | 128]), number >> 7
    return out + bytes([number]) if rng.random() < 0.97 else _wide(out + bytes([number]), rng)


def _wide(number: bytes, rng: random.Random) -> bytes:
    """The same whole number in more bytes, or with bits that 32 do not hold."""
    more = b"\x80" * rng.randrange(9)
    return number[:-1] + bytes([number[-1] | 128]) + more + rng.choice((b"\0", b"\x10", b"\x01"))
