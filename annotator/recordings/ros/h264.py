"""Lost pictures of an H.264 stream, told by the numbers in its slice headers.

A decoder replaces a lost reference picture by another one without a word, and all pictures up to the next key frame
are made up. Syntax: ITU-T H.264, 7.3 (parameter sets, slice header) and 7.4.3 (`frame_num`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

START_CODE = b"\x00\x00\x01"
SLICE, KEY_SLICE, SEQUENCE, PICTURE = 1, 5, 7, 8
# Profiles whose sequence parameter sets describe chroma and scaling.
HIGH_PROFILES = {44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244}
# Bytes of a slice that have the beginning of its header; of a sequence parameter set.
HEAD_BYTES, SET_BYTES = 32, 1024
MOST_ZEROS = 32


@dataclass(frozen=True)
class _Sequence:
    """Of a sequence parameter set: bits of a picture's number, whether numbers may be left out, and colour planes."""

    bits: int
    has_gaps: bool
    has_planes: bool


@dataclass
class _Parameters:
    sequences: dict[int, _Sequence] = field(default_factory=dict)
    # picture parameter set -> sequence parameter set
    pictures: dict[int, int] = field(default_factory=dict)


def lost_before(pictures: Sequence[bytes]) -> int | None:
    """Returns which picture is the first after a lost one; None if none is lost, as far as the stream tells.

    Args:
        pictures: of an Annex B stream, in order, each with all its NAL units, from a key frame on.
    """
    parameters, expected = _Parameters(), None
    for index, data in enumerate(pictures):
        try:
            found = _number(data, parameters)
        except ValueError:  # damaged, or of an unknown form: the decoder judges it
            found = None
        if found is None:
            expected = None
            continue
        number, bits, is_reference, is_key = found
        if not is_key and expected is not None and number != expected:
            return index
        # pictures that are no references have the number of the next one that is
        expected = (number + is_reference) % (1 << bits)
    return None


def nal_units(data: bytes) -> Iterator[tuple[int, int]]:
    """Yields the first byte of each NAL unit, and the place after it."""
    at = data.find(START_CODE)
    while 0 <= at < len(data) - 3:
        yield data[at + 3], at + 4
        at = data.find(START_CODE, at + 3)


def _number(data: bytes, parameters: _Parameters) -> tuple[int, int, bool, bool] | None:
    """Returns a picture's number, its bits, and whether it is a reference and a key frame; None if that is not told."""
    for head, at in nal_units(data):
        kind = head & 31
        if kind == SEQUENCE:
            number, sequence = _read_sequence(_Bits(data[at : at + SET_BYTES]))
            parameters.sequences[number] = sequence
        elif kind == PICTURE:
            bits = _Bits(data[at : at + HEAD_BYTES])
            parameters.pictures[bits.exp_golomb()] = bits.exp_golomb()
        elif kind in (SLICE, KEY_SLICE):
            bits = _Bits(data[at : at + HEAD_BYTES])
            bits.exp_golomb()  # first macroblock
            bits.exp_golomb()  # type
            found = parameters.sequences.get(parameters.pictures.get(bits.exp_golomb(), -1))
            if found is None or found.has_gaps:
                return None
            bits.read(2 if found.has_planes else 0)
            return bits.read(found.bits), found.bits, bool(head & 0x60), kind == KEY_SLICE
    return None


def _read_sequence(bits: _Bits) -> tuple[int, _Sequence]:
    """Reads a sequence parameter set; returns its number and content."""
    profile = bits.read(8)
    bits.read(16)  # constraints, level
    number, has_planes = bits.exp_golomb(), False
    if profile in HIGH_PROFILES:
        chroma = bits.exp_golomb()
        has_planes = chroma == 3 and bool(bits.read(1))
        bits.exp_golomb()  # depth of luma
        bits.exp_golomb()  # depth of chroma
        bits.read(1)
        if bits.read(1):
            for index in range(12 if chroma == 3 else 8):
                if bits.read(1):
                    _skip_scaling(bits, 16 if index < 6 else 64)
    length = bits.exp_golomb() + 4
    order = bits.exp_golomb()
    if order == 0:
        bits.exp_golomb()
    elif order == 1:
        bits.read(1)
        bits.exp_golomb()
        bits.exp_golomb()
        for _ in range(bits.exp_golomb()):
            bits.exp_golomb()
    bits.exp_golomb()  # number of reference frames
    return number, _Sequence(length, bool(bits.read(1)), has_planes)


def _skip_scaling(bits: _Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            coded = bits.exp_golomb()
            following = (last + (coded + 1) // 2 * (1 if coded % 2 else -1)) % 256
        last = following or last


class _Bits:
    """The bits of a NAL unit's content, without its emulation prevention bytes."""

    def __init__(self, content: bytes) -> None:
        content = content.replace(b"\0\0\3", b"\0\0")
        self._value, self._left = int.from_bytes(content), 8 * len(content)

    def read(self, count: int) -> int:
        """Returns the next `count` bits as a number; raises ValueError at the end."""
        if count > self._left:
            raise ValueError("a NAL unit is cut")
        self._left -= count
        return self._value >> self._left & (1 << count) - 1

    def exp_golomb(self) -> int:
        """Returns the next number in Exp-Golomb code; raises ValueError at the end."""
        zeros = 0
        while not self.read(1):
            zeros += 1
        if zeros > MOST_ZEROS:
            raise ValueError("a number is too long")
        return (1 << zeros) - 1 + self.read(zeros)
