"""How much of a CAN bus a wiring takes, and the exact length of a frame on it.

A frame of d data bits and an identifier of 11 bits is start (1), identifier (11), remote and format flags (3), length (4),
data (d), CRC-15 (15), then CRC delimiter (1), acknowledge (2), end of frame (7) and the space behind it (3). After five
equal bits from the start to the end of the CRC the sender inserts one of the other value ("stuffing"), which itself
counts as the first of the next five. Source: Bosch, "CAN Specification 2.0" (1991), part B, sections 3 and 5.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec
from drivers.canfd import fd_bits
from drivers.codecs.mit import words_of
from drivers.open import PROTOCOLS, load
from drivers.wire import EXTENDED, REMOTE

LOAD_MAX = 0.7  # share of a bus to plan for: the rest is for retransmission and what else is on it
CRC_POLYNOMIAL = 0x4599  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
TAIL_BITS = 1 + 2 + 7 + 3  # CRC delimiter, acknowledge, end of frame, inter-frame space: never stuffed


class Budget(NamedTuple):
    """What ticks at ``rate`` (Hz) put on a bus. Loads are shares of its bit rate."""

    bus: str
    rate: float
    frames: int  # a tick: a command and an answer for each motor, or what the codec says (TICK_FRAMES, MOTOR_FRAMES)
    bits: float  # a tick, typical
    bits_worst: float  # a tick, the most that stuffing can make of it
    load: float
    load_worst: float
    rate_max: float  # Hz at a typical load of LOAD_MAX

    def __str__(self) -> str:
        return (
            f"bus {self.bus}: {self.frames} frames a tick at {self.rate:g} Hz, load {self.load:.0%} typical, "
            f"{self.load_worst:.0%} worst; best rate {self.rate_max:.0f} Hz"
        )


def budget(spec: BusSpec, rate: float) -> Budget:
    """The load of ``spec`` when every motor is commanded and answers ``rate`` times a second."""
    n = len(spec.motors)
    codec = load(PROTOCOLS[spec.protocol].codec)
    overhead = getattr(codec, "TICK_OVERHEAD_BITS", 0.0)  # of packets that hold all motors
    typical, worst = (n * bits + overhead for bits in codec.TICK_BITS)
    return Budget(
        bus=spec.name,
        rate=rate,
        frames=getattr(codec, "TICK_FRAMES", round(n * getattr(codec, "MOTOR_FRAMES", 2))),
        bits=typical,
        bits_worst=worst,
        load=typical * rate / spec.bitrate,
        load_worst=worst * rate / spec.bitrate,
        rate_max=LOAD_MAX * spec.bitrate / typical,
    )


def check(spec: BusSpec, rate: float) -> Budget:
    """The same. Raises BusError if the worst case does not fit into the bus: then commands would queue up and age."""
    b = budget(spec, rate)
    if b.load_worst > 1.0:
        raise BusError(
            f"bus {spec.name}: {len(spec.motors)} motors at {rate:g} Hz need {b.load_worst:.0%} of {spec.bitrate} bit/s "
            f"in the worst case, expected at most 100%.\n  Lower the rate (at most {b.rate_max:.0f} Hz is sensible), or "
            "move motors to another bus"
        )
    return b


def bits_of(spec: BusSpec) -> Callable[[np.ndarray], np.ndarray]:
    """What tells the length (n,) of frames on the bus of ``spec``, in bits of ``spec.bitrate``."""
    if not spec.data_bitrate:
        return frame_bits
    ratio = spec.data_bitrate / spec.bitrate
    return lambda frames: fd_bits(frames, ratio)


# A standard frame with 8 bytes has 98 bits from the start to the end of the CRC: 7 chunks of 14. The state between two
# chunks is the last bit and how many like it came in a row (1 to 4; the fifth is followed by a stuff bit at once), and
# tables of 8 states x 2^14 chunks tell the next state and the stuff bits. Before the frame: a 1, once. All tables are of the
# smallest type that holds them: they share a cache with everything else that a tick looks at.
CHUNK_BITS = 14
CHUNK = 1 << CHUNK_BITS
MASK = CHUNK - 1
EXTENDED_SHIFT = 29  # of the flags in ``id``
START = 4 * CHUNK  # state (1, once)
# What of the payload is in chunks 1 to 5: 9 bits, 14, 14, 14 and 13.
_SHIFTS = np.array([55, 41, 27, 13, 0])[:, None]
_MASKS = np.array([0x1FF, MASK, MASK, MASK, 0x1FFF])[:, None]


def frame_bits(frames: np.ndarray) -> np.ndarray:
    """Bits (n,) int64 that each of ``frames`` (FRAME, (n,)) takes on the wire, with stuff bits and the space behind it."""
    ids = frames["id"]
    whole = frames["length"] == 8
    plain = (ids < 0x800) & whole
    if plain.all():
        return _plain_bits(ids, frames["data"])
    extended = (ids >> EXTENDED_SHIFT == EXTENDED >> EXTENDED_SHIFT) & whole
    other = ~(plain | extended)
    bits = np.empty(len(frames), np.int64)
    if plain.any():
        bits[plain] = _plain_bits(ids[plain], frames["data"][plain])
    if extended.any():
        bits[extended] = _extended_bits(ids[extended], frames["data"][extended])
    bits[other] = [_any_bits(int(f["id"]), int(f["length"]), f["data"].tobytes()) for f in frames[other]]
    return bits


def _plain_bits(ids: np.ndarray, data: np.ndarray) -> np.ndarray:
    """The same for standard data frames with 8 bytes: identifiers (n,), payloads (n, 8) uint8."""
    chunks = np.empty((7, len(ids)), np.int64)
    np.multiply(ids, 4, out=chunks[0])  # start, identifier, remote and format flags, length 8 = 01000 from here on
    payload = chunks[1:6]
    np.right_shift(words_of(data).view(np.int64), _SHIFTS, out=payload)
    payload &= _MASKS
    chunks[1] |= 0b01000 << 9
    chunks[5] <<= 1
    crc = np.bitwise_xor.reduce(_crc().take(chunks[:6] + _CRC_OFFSETS), axis=0)
    chunks[5] |= crc >> CHUNK_BITS
    np.bitwise_and(crc, MASK, out=chunks[6])
    return _stuff_bits(chunks) + (7 * CHUNK_BITS + TAIL_BITS)


def _extended_bits(ids: np.ndarray, data: np.ndarray) -> np.ndarray:
    """The same for extended data frames with 8 bytes: 118 bits, 8 chunks and 6 bits, which are filled up with bits that
    take turns and so need no stuffing."""
    id = ids.astype(np.int64) & 0x1FFF_FFFF
    head = (
        (id >> 18 << 2 | 0b11) << 18 | id & 0x3FFFF
    ) << 7 | 0b000_1000  # start, 11, SRR, IDE, 18, RTR, r1, r0, length
    word = words_of(data).view(np.int64)
    tail = [word >> shift & MASK for shift in (0, 14, 28, 42)]
    tail += [(head << 8 | (word >> 56 & 0xFF)) & MASK, head >> 6 & MASK, head >> 20 & MASK, head >> 34]
    crc = np.bitwise_xor.reduce(_extended_crc().take(np.array(tail) + _EXTENDED_OFFSETS), axis=0)
    end = crc & 0x3F
    chunks = [
        head >> 25,
        head >> 11 & MASK,
        (head & 0x7FF) << 3 | (word >> 61 & 0b111),
        *(word >> shift & MASK for shift in (47, 33, 19, 5)),
        (word & 0x1F) << 9 | crc >> 6,
        end << 8 | np.where(end & 1, 0x55, 0xAA),
    ]
    return _stuff_bits(np.array(chunks)) + (118 + TAIL_BITS)


def _stuff_bits(chunks: np.ndarray) -> np.ndarray:
    """(n,) int64 stuff bits in ``chunks`` (k, n) that follow each other; they are overwritten."""
    following, stuffed = _stuffing()
    chunks[0] |= START
    for before, chunk in pairwise(chunks):
        chunk |= following.take(before)
    return np.add.reduce(stuffed.take(chunks), axis=0, dtype=np.int64)


_CRC_OFFSETS = (np.arange(6) * CHUNK)[:, None]


_EXTENDED_OFFSETS = (np.arange(8) * CHUNK)[:, None]


@cache
def _extended_crc() -> np.ndarray:
    """(8 * CHUNK,) the CRC of each chunk of 14 bits, counted from the end of what the CRC covers."""
    contribution = [CRC_POLYNOMIAL]
    while len(contribution) < 8 * CHUNK_BITS:
        contribution.append(_crc_step(contribution[-1], 0))
    chunk = np.arange(CHUNK)
    crc_of = np.zeros((8, CHUNK), np.int64)
    for k in range(8):
        for b in range(CHUNK_BITS):
            crc_of[k] ^= np.where(chunk >> b & 1, contribution[k * CHUNK_BITS + b], 0)
    return crc_of.reshape(-1).astype(np.uint16)


@cache
def _stuffing() -> tuple[np.ndarray, np.ndarray]:
    """(8 * CHUNK,) next state * CHUNK, and (8 * CHUNK,) stuff bits, at state * CHUNK + chunk."""
    state, chunk = np.divmod(np.arange(8 * CHUNK), CHUNK)
    last, run = np.divmod(state, 4)
    run += 1
    stuffed = np.zeros_like(state)
    for shift in reversed(range(CHUNK_BITS)):
        bit = chunk >> shift & 1
        run = np.where(bit == last, run + 1, 1)
        full = run == 5
        stuffed += full
        last = np.where(full, 1 - bit, bit)
        run[full] = 1
    return ((last * 4 + run - 1) * CHUNK).astype(np.int32), stuffed.astype(np.uint8)


@cache
def _crc() -> np.ndarray:
    """(6 * CHUNK,) the CRC of each chunk of a standard frame.

    The CRC starts at 0 and is linear over GF(2): that of a frame is the exclusive or of those of its chunks.
    """
    contribution = [CRC_POLYNOMIAL]  # of the last of the 83 bits, then of the one before it, ...
    while len(contribution) < 83:
        contribution.append(_crc_step(contribution[-1], 0))
    contribution = [0, *contribution]  # chunk 5 ends in the first bit of the CRC itself
    chunk = np.arange(CHUNK)
    crc_of = np.zeros((6, CHUNK), np.int64)
    for k in range(6):
        for b in range(CHUNK_BITS):
            crc_of[k] ^= np.where(chunk >> b & 1, contribution[(5 - k) * CHUNK_BITS + b], 0)
    return crc_of.reshape(-1).astype(np.uint16)


@lru_cache(4096)  # short frames are questions and their answers, and these repeat themselves
def _any_bits(id: int, length: int, data: bytes) -> int:
    """One frame of any kind, bit by bit."""
    remote = f"{bool(id & REMOTE):b}"
    if id & EXTENDED:
        id29 = f"{id & 0x1FFF_FFFF:029b}"
        head = "0" + id29[:11] + "11" + id29[11:] + remote + "00"
    else:
        head = "0" + f"{id & 0x7FF:011b}" + remote + "00"
    payload = b"" if id & REMOTE else data[:length]
    bits = head + f"{length:04b}" + "".join(f"{byte:08b}" for byte in payload)
    crc = 0
    for bit in bits:
        crc = _crc_step(crc, int(bit))
    bits += f"{crc:015b}"

    stuffed, last, run = 0, "1", 1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed, last, run = stuffed + 1, "01"[bit == "0"], 1
    return len(bits) + stuffed + TAIL_BITS


def _crc_step(crc: int, bit: int) -> int:
    """The CRC-15 register after one more bit."""
    carry = crc >> 14 ^ bit
    return (crc << 1 & 0x7FFF) ^ (CRC_POLYNOMIAL if carry else 0)
