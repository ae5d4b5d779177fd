"""LZF (M. Lehmann's libLZF), with which PCL packs points: literal bytes, and repeats of earlier bytes."""

LARGEST_RATIO = 88
"""Three bytes repeat up to 264."""


def unpack(packed: bytes, size: int) -> bytes:
    """The ``size`` bytes that are packed. Raises ValueError if they are others, or refer to what is not
    there."""
    out, at, end = bytearray(), 0, len(packed)
    while at < end:
        control = packed[at]
        at += 1
        if control < 32:  # control + 1 literal bytes follow
            out += packed[at : at + control + 1]
            at += control + 1
            if at > end:
                raise ValueError("it ends within a run of literal bytes")
        else:  # a repeat of length + 2 bytes that begin distance + 1 bytes back
            length = control >> 5
            if length == 7 and at < end:
                length += packed[at]
                at += 1
            if at >= end:
                raise ValueError("it ends within a repeat")
            first = len(out) - ((control & 31) << 8 | packed[at]) - 1
            at += 1
            if first < 0:
                raise ValueError("a repeat begins before the first byte")
            piece = out[first : first + length + 2]
            while len(piece) < length + 2:  # a repeat may run into itself
                piece += piece[: length + 2 - len(piece)]
            out += piece
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError(f"it unpacks to {'more' if len(out) > size else 'fewer'} than {size} bytes")
    return bytes(out)
