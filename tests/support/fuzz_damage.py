"""Ways to damage a file, each drawn from a random generator and nothing else, so that a seed repeats it.

Those of BYTES know nothing of the file. Those of TEXT and ZIP change what it says and leave its form whole,
as a program does that has a defect, or means harm.
"""

import io
import random
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np

from taichi_mrf.system.npz_file import MANIFEST, manifest_lines

Damage = Callable[[random.Random, bytes], bytes]

WORDS = [
    *("nan", "inf", "-inf", "-1", "0", "1e309", "1e-320", "99999999999999999999", "4294967296", "2147483648"),
    *("0x", "2001-99-99", "text", "", "[]", "{}", "null", "true", "[[" * 2000),
    *("*a", "&a [*a]", "!!python/x", "\0"),
]
"""Replacements for a number or a name."""

SIZES = [0, 1, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 4_000_000_000]
"""Claims of a header."""


def truncated(draw: random.Random, data: bytes) -> bytes:
    return data[: draw.randrange(len(data))]


def one_bit_flipped(draw: random.Random, data: bytes) -> bytes:
    changed = bytearray(data)
    changed[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    return bytes(changed)


def bits_flipped(draw: random.Random, data: bytes) -> bytes:
    for _ in range(draw.randint(2, 40)):
        data = one_bit_flipped(draw, data)
    return data


def stretch_replaced(draw: random.Random, data: bytes) -> bytes:
    begin = draw.randrange(len(data))
    length = min(draw.choice((1, 4, 16, 512, 4096)), len(data) - begin)
    value = draw.choice((bytes(length), b"\xff" * length, draw.randbytes(length)))
    return data[:begin] + value + data[begin + length :]


def stretch_cut_out(draw: random.Random, data: bytes) -> bytes:
    begin = draw.randrange(len(data))
    return data[:begin] + data[begin + draw.choice((1, 2, 16, 512)) :]


def stretch_doubled(draw: random.Random, data: bytes) -> bytes:
    begin = draw.randrange(len(data))
    end = min(begin + draw.choice((1, 16, 512)), len(data) - 1)  # the whole file twice may well be a file
    return data[:end] + data[begin:end] + data[end:]


def absurd_size(draw: random.Random, data: bytes) -> bytes:
    """A 32-bit integer, as headers hold them, that says 0 or billions."""
    begin = draw.randrange(max(1, min(len(data), draw.choice((64, 1024, len(data)))) - 3))
    size = struct.pack(draw.choice(("<I", ">I")), draw.choice(SIZES))
    return data[:begin] + size + data[begin + 4 :]


def emptied(draw: random.Random, data: bytes) -> bytes:
    return b""


def noise(draw: random.Random, data: bytes) -> bytes:
    return draw.randbytes(draw.choice((1, 100, 5000)))


BYTES: list[Damage] = [truncated] * 2 + [one_bit_flipped] * 3 + [bits_flipped, stretch_replaced]
BYTES += [stretch_cut_out, stretch_doubled] + [absurd_size] * 2 + [emptied, noise]


def word_replaced(draw: random.Random, data: bytes) -> bytes:
    parts = data.split(b" ") if data.count(b" ") > 2 else data.split(b"\n")
    parts[draw.randrange(len(parts))] = draw.choice(WORDS).encode()
    return (b" " if data.count(b" ") > 2 else b"\n").join(parts)


def line_cut_out(draw: random.Random, data: bytes) -> bytes:
    lines = data.splitlines(keepends=True)
    del lines[draw.randrange(len(lines))]
    return b"".join(lines)


def line_doubled(draw: random.Random, data: bytes) -> bytes:
    lines = data.splitlines(keepends=True)
    lines.insert(draw.randrange(len(lines)), draw.choice(lines))
    return b"".join(lines)


def digits_replaced(draw: random.Random, data: bytes) -> bytes:
    """A number becomes another word."""
    places = [i for i, byte in enumerate(data) if chr(byte).isdigit()]
    if not places:
        return data
    begin = end = draw.choice(places)
    while end < len(data) and chr(data[end]) in "0123456789.e-":
        end += 1
    return data[:begin] + draw.choice(WORDS).encode() + data[end:]


TEXT: list[Damage] = [word_replaced, line_cut_out, line_doubled, digits_replaced, digits_replaced]


def png_claims_another_size(draw: random.Random, data: bytes) -> bytes:
    """With the right checksum."""
    header = bytearray(data[12:29])
    struct.pack_into(">I", header, draw.choice((4, 8)), draw.choice([1, 30_000, 0xFFFF, 2**30, 2**31 - 1, 0]))
    if draw.random() < 0.5:
        struct.pack_into(">II", header, 4, 40_000, 20_000)
    return data[:12] + bytes(header) + struct.pack(">I", zlib.crc32(header)) + data[33:]


PNG: list[Damage] = [png_claims_another_size]


def zip_of(members: dict[str, bytes]) -> bytes:
    """An archive with right checksums."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return stream.getvalue()


def members_of(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=array.dtype.hasobject)
    return stream.getvalue()


def member_changed(draw: random.Random, data: bytes) -> bytes:
    """One array is missing, of another type or shape, holds odd values, or claims what it does not hold;
    where there is a manifest it mostly agrees."""
    members = members_of(data)
    sealed = members.pop(f"{MANIFEST}.npy", None)
    name = draw.choice(list(members))
    array = np.lib.format.read_array(io.BytesIO(members[name]))
    choice = draw.randrange(9)
    if choice == 0:
        del members[name]
    elif choice == 1:
        members[name] = BYTES[draw.randrange(len(BYTES))](draw, members[name])
    elif choice == 2:
        other = draw.choice([np.float64, np.int8, np.complex64, np.bool_, "U3", "S2", "M8[s]", object])
        with np.errstate(all="ignore"):
            try:
                members[name] = _npy(array.astype(other))
            except ValueError:
                members[name] = _npy(np.zeros(array.shape, other))
    elif choice == 3:
        members[name] = _npy(array.reshape(-1)[: max(0, array.size - 1)])
    elif choice == 4:
        members[name] = _npy(
            np.zeros(draw.choice([(), (0,), (1, 1), (3, 0, 2), (4, 4), (2, 4, 4)]), array.dtype)
        )
    elif choice == 5 and array.size and array.dtype.kind in "fiu":
        flat = array.reshape(-1).copy()
        odd = [np.nan, np.inf, -1.0, 1e30, 0.0] if array.dtype.kind == "f" else [0, 1, 2**31 - 1, 2**62, 99]
        with np.errstate(all="ignore"):
            flat[draw.randrange(flat.size)] = np.array(draw.choice(odd)).astype(array.dtype)
        members[name] = _npy(flat.reshape(array.shape))
    elif choice == 6:
        size = draw.choice([10**9, 10**12, 2**63, -1])
        stream = io.BytesIO()
        np.lib.format.write_array_header_2_0(
            stream, {"descr": array.dtype.str, "fortran_order": False, "shape": (size, *array.shape[1:])}
        )
        members[name] = stream.getvalue() + array.tobytes()
    elif choice == 7 and array.dtype.kind == "U" and array.ndim == 0:
        text = draw.choice(TEXT)(draw, str(array).encode())
        members[name] = _npy(np.asarray(text.decode("utf-8", "replace").replace("\0", "")))
    else:
        members["unknown.npy"] = _npy(np.zeros(3))
    if sealed is not None and draw.random() < 0.8:
        with zipfile.ZipFile(io.BytesIO(zip_of(members))) as archive:
            sealed = _npy(np.array(manifest_lines(iter(archive.infolist()))))
    return zip_of(members if sealed is None else {**members, f"{MANIFEST}.npy": sealed})


ZIP: list[Damage] = [member_changed]
