"""The straightforward MIT codec, one motor and one field at a time: the oracle of the tests and the bench's incumbent."""

from __future__ import annotations


def encode(value: float, low: float, high: float, bits: int) -> int:
    value = min(max(value, low), high)
    return int((value - low) * ((1 << bits) - 1) / (high - low) + 1e-6)  # full scale must not fall below by rounding


def decode(code: int, low: float, high: float, bits: int) -> float:
    return code * (high - low) / ((1 << bits) - 1) + low


def pack_command(p, v, kp, kd, t, p_max, v_max, t_max, kp_max=500.0, kd_max=5.0) -> bytes:
    p = encode(p, -p_max, p_max, 16)
    v = encode(v, -v_max, v_max, 12)
    kp = encode(kp, 0.0, kp_max, 12)
    kd = encode(kd, 0.0, kd_max, 12)
    t = encode(t, -t_max, t_max, 12)
    v = min(v, 0xFFE)
    return bytes(
        [
            p >> 8,
            p & 0xFF,
            v >> 4,
            (v & 0xF) << 4 | kp >> 8,
            kp & 0xFF,
            kd >> 4,
            (kd & 0xF) << 4 | t >> 8,
            t & 0xFF,
        ]
    )


def unpack_command(data: bytes, p_max, v_max, t_max, kp_max=500.0, kd_max=5.0) -> tuple[float, ...]:
    return (
        decode(data[0] << 8 | data[1], -p_max, p_max, 16),
        decode(data[2] << 4 | data[3] >> 4, -v_max, v_max, 12),
        decode((data[3] & 0xF) << 8 | data[4], 0.0, kp_max, 12),
        decode(data[5] << 4 | data[6] >> 4, 0.0, kd_max, 12),
        decode((data[6] & 0xF) << 8 | data[7], -t_max, t_max, 12),
    )


def pack_feedback(p, v, t, byte0, byte6, byte7, p_max, v_max, t_max) -> bytes:
    p = encode(p, -p_max, p_max, 16)
    v = encode(v, -v_max, v_max, 12)
    t = encode(t, -t_max, t_max, 12)
    return bytes([byte0, p >> 8, p & 0xFF, v >> 4, (v & 0xF) << 4 | t >> 8, t & 0xFF, byte6, byte7])


def unpack_feedback(data: bytes, p_max, v_max, t_max) -> tuple[float, float, float, int, int, int]:
    return (
        decode(data[1] << 8 | data[2], -p_max, p_max, 16),
        decode(data[3] << 4 | data[4] >> 4, -v_max, v_max, 12),
        decode((data[4] & 0xF) << 8 | data[5], -t_max, t_max, 12),
        data[0],
        data[6],
        data[7],
    )
