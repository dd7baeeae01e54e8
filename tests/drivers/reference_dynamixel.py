"""The straightforward Dynamixel Protocol 2.0, one bit, byte and servo at a time: the oracle of the tests."""

from __future__ import annotations


def crc16(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def stuff(body: bytes) -> bytes:
    out = bytearray()
    for byte in body:
        out.append(byte)
        if out[-3:] == b"\xff\xff\xfd":
            out.append(0xFD)
    return bytes(out)


def pack(id: int, instruction: int, parameters: bytes) -> bytes:
    body = stuff(bytes([instruction]) + parameters)
    packet = b"\xff\xff\xfd\x00" + bytes([id, (len(body) + 2) & 0xFF, (len(body) + 2) >> 8]) + body
    crc = crc16(packet)
    return packet + bytes([crc & 0xFF, crc >> 8])


def is_packet(raw: bytes) -> bool:
    """Whether ``raw`` is exactly one packet: header, length and CRC."""
    if raw[:4] != b"\xff\xff\xfd\x00" or len(raw) < 10 or len(raw) != 7 + (raw[5] | raw[6] << 8):
        return False
    return crc16(raw[:-2]) == raw[-2] | raw[-1] << 8


def state(
    torque_enable: int, error: int, watchdog: int, current: int, velocity: int, position: int, celsius: int
) -> bytes:
    """The block of bytes that a servo's indirect registers gather."""
    parts = [(torque_enable, 1), (error, 1), (watchdog, 1), (current, 2), (velocity, 4), (position, 4), (celsius, 1)]
    return b"".join((value & (1 << 8 * size) - 1).to_bytes(size, "little") for value, size in parts)


def goal(p_gain: int, position: int) -> bytes:
    return p_gain.to_bytes(2, "little") + (position & 0xFFFF_FFFF).to_bytes(4, "little")
