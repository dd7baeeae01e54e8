"""The exact time of a CAN-FD frame on the wire, counted in bits of the arbitration phase.

    at the bit rate        start (1), identifier (11), remote request substitution, identifier extension, format and
                           reserved bit (4), bit-rate switch (1); extended: 18 more of the identifier and the substitute
                           remote request (1)
    at the data bit rate   error state (1), length (4), data, stuff count (4), CRC (17 up to 16 bytes, else 21), and CRC
                           delimiter (1)
    at the bit rate        acknowledge (2), end of frame (7), and the space behind it (3)

From the start to the end of the data, five equal bits are followed by a stuff bit, as in classic CAN; stuff count and CRC
have fixed ones instead, before the first and after every fourth bit, whatever they say. The rate changes at the sample points
of the bit-rate switch and of the CRC delimiter: with the same sample point in both phases that comes to the same as changing
behind the one and behind the other, which is how it is counted here.

Source: Bosch, "CAN with Flexible Data-Rate" (2012), section 3; ISO 11898-1:2015, 10.4 and 10.5, for the stuff count.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from drivers.wire import BIT_RATE_SWITCH, EXTENDED, FD_LENGTHS

CHUNK_BITS = 16
START = 1 << 2  # state (last bit 1, once); a state is last bit << 2 | (how many like it in a row) - 1
TAIL_BITS = 2 + 7 + 3
SHORT = 16  # bytes up to which the CRC has 17 bits
CRC_BITS = (4 + 17 + 6 + 1, 4 + 21 + 7 + 1)  # stuff count, CRC, fixed stuff bits, delimiter: up to SHORT, beyond


def fd_bits(frames: np.ndarray, ratio: float) -> np.ndarray:
    """How long (n,) each of ``frames`` (FD_FRAME, (n,)) takes, in bits of the arbitration phase. ``ratio``: data bit rate
    over bit rate, for frames with BIT_RATE_SWITCH."""
    slow, fast = phases(frames)
    switched = (frames["flags"] & BIT_RATE_SWITCH) > 0
    return slow + fast / np.where(switched, ratio, 1.0)


def phases(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bits (n,) of each of ``frames`` (FD_FRAME, (n,)) in the arbitration and in the data phase, stuff bits included."""
    n = len(frames)
    slow, fast = np.zeros(n, np.int64), np.zeros(n, np.int64)
    ids, lengths = frames["id"].astype(np.int64), frames["length"]
    extended = ids & EXTENDED > 0
    for kind in np.unique(np.stack([extended, lengths]), axis=1).T if n else ():
        rows = np.flatnonzero((extended == kind[0]) & (lengths == kind[1]))
        switch = (frames["flags"][rows] & BIT_RATE_SWITCH).astype(np.int64)
        length = int(kind[1])
        slow[rows], state = _head(ids[rows], bool(kind[0]), switch)
        fast[rows] = _payload(frames["data"][rows, :length], length, state)
    return slow, fast


def _head(ids: np.ndarray, extended: bool, switch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bits in front of and behind the data phase, and the states that the first of them leave behind."""
    if extended:
        value = (ids >> 18 & 0x7FF) << 24 | 0b11 << 22 | (ids & 0x3FFFF) << 4 | 0b0100 | switch
        count = 36
    else:
        value = (ids & 0x7FF) << 5 | 0b00100 | switch
        count = 17
    filled = -(-count // CHUNK_BITS) * CHUNK_BITS
    # In front: bits that take turns and end in a 1, as if the wire had been idle. They need no stuff bits.
    padding = int("01" * CHUNK_BITS, 2) & (1 << filled - count) - 1
    value |= padding << count
    total, state = np.full(len(ids), count + TAIL_BITS), np.full(len(ids), START)
    for shift in range(filled - CHUNK_BITS, -1, -CHUNK_BITS):
        state, stuffed = _step(state, value >> shift & (1 << CHUNK_BITS) - 1, CHUNK_BITS)
        total += stuffed
    return total, state


def _payload(data: np.ndarray, length: int, state: np.ndarray) -> np.ndarray:
    """Bits in the data phase: ``data`` (n, length) uint8 behind the error state and the length."""
    code = min(int(np.searchsorted(FD_LENGTHS, length)), 15)
    total = np.full(len(data), 1 + 4 + 8 * length + CRC_BITS[length > SHORT])
    state, stuffed = _step(state, code, 5, last=not length)
    total += stuffed
    odd = length % 2
    if odd:
        state, stuffed = _step(state, data[:, 0], 8, last=length == 1)
        total += stuffed
    words = np.ascontiguousarray(data[:, odd:]).view(">u2").astype(np.int64)
    for i in range(words.shape[1]):
        state, stuffed = _step(state, words[:, i], CHUNK_BITS, last=i == words.shape[1] - 1)
        total += stuffed
    return total


def _step(state: np.ndarray, chunk: np.ndarray | int, bits: int, last: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The states after ``chunk`` of ``bits`` bits, and the stuff bits in it. ``last``: a fixed stuff bit follows it."""
    entry = _stuffing(bits, last)[state << bits | chunk]
    return entry >> 8, entry & 0xFF


@cache
def _stuffing(bits: int, last: bool) -> np.ndarray:
    """(8 << bits,) next state << 8 | stuff bits, at state << bits | chunk."""
    state, chunk = np.divmod(np.arange(8 << bits), 1 << bits)
    value, run = state >> 2, (state & 3) + 1
    stuffed = np.zeros_like(state)
    for shift in reversed(range(bits)):
        bit = chunk >> shift & 1
        run = np.where(bit == value, run + 1, 1)
        full = run == 5
        stuffed += full & (not last or shift > 0)
        value = np.where(full, 1 - bit, bit)
        run[full] = 1
    return (value << 2 | run - 1) << 8 | stuffed
