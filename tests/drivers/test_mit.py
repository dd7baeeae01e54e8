"""MIT packing: golden frames, the straightforward codec as an oracle, saturation, magic frames, wrap."""

from __future__ import annotations

import numpy as np
import pytest
import reference_mit as reference
from hypothesis import given
from hypothesis import strategies as st

from drivers.codecs.mit import MitCodec, Ranges

P, V, T = 12.5, 45.0, 54.0  # a DM8009
P_LSB, V_LSB, T_LSB = 2 * P / 0xFFFF, 2 * V / 0xFFF, 2 * T / 0xFFF


def codec(n: int = 1, p: float = P, v: float = V, t: float = T) -> MitCodec:
    full = lambda x: np.full(n, x)  # noqa: E731
    return MitCodec(Ranges(full(p), full(v), full(t), full(500.0), full(5.0)))


def command_bytes(position: float, velocity: float, kp: float, kd: float, torque: float) -> str:
    one = (np.array([x]) for x in (position, velocity, kp, kd, torque))
    return codec().pack_command(*one)[0].tobytes().hex(" ")


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        # All zero: each symmetric range sends the code below its middle (bgkatz/motorcontrol packing, P V T any).
        ((0, 0, 0, 0, 0), "7f ff 7f f0 00 00 07 ff"),
        # By hand: p = 1.25 -> (13.75 * 65535 / 25) = 36044 = 8ccc; v = -9 -> 36 * 4095 / 90 = 1638 = 666;
        # kp = 100 -> 819 = 333; kd = 2.5 -> 2047 = 7ff; t = 5.4 -> 59.4 * 4095 / 108 = 2252 = 8cc.
        ((1.25, -9, 100, 2.5, 5.4), "8c cc 66 63 33 7f f8 cc"),
        ((-P, -V, 0, 0, -T), "00 00 00 00 00 00 00 00"),
        # Full scale everywhere: the velocity stays one code below, so that this is no magic frame.
        ((P, V, 500, 5, T), "ff ff ff ef ff ff ff ff"),
        ((99, 999, 9999, 99, 999), "ff ff ff ef ff ff ff ff"),  # saturates, never wraps
        ((-99, -999, -1, -1, -999), "00 00 00 00 00 00 00 00"),
        ((1e308, -1e308, 1e308, -1e308, 1e308), "ff ff 00 0f ff 00 0f ff"),
    ],
)
def test_command_bytes(command, expected):
    assert command_bytes(*command) == expected


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        # Byte 0 and the last two are the vendor's; p = 8ccc -> 36044, v = 666, t = 8cc as above.
        ("11 8c cc 66 68 cc 1e 2a", (36044 * P_LSB - P, 1638 * V_LSB - V, 2252 * T_LSB - T, 0x11, 30, 42)),
        ("01 00 00 00 00 00 00 00", (-P, -V, -T, 1, 0, 0)),
        ("ff ff ff ff ff ff ff ff", (P, V, T, 255, 255, 255)),
    ],
)
def test_feedback_bytes(data, expected):
    feedback = codec().unpack_feedback(np.frombuffer(bytes.fromhex(data), np.uint8)[None])
    np.testing.assert_allclose([x[0] for x in feedback], expected, atol=1e-12)
    again = codec().pack_feedback(*feedback)
    assert again.tobytes() == bytes.fromhex(data)


def test_agrees_with_the_reference_on_a_whole_robot():
    n, rng = 29, np.random.default_rng(1)
    p, v, t = rng.uniform(1, 30, n), rng.uniform(5, 60, n), rng.uniform(1, 200, n)
    scales = list(zip(p.tolist(), v.tolist(), t.tolist(), strict=True))
    codecs = MitCodec(Ranges(p, v, t, np.full(n, 500.0), np.full(n, 5.0)))
    for _ in range(50):
        x = rng.uniform(-1.2, 1.2, (5, n)) * np.array([p, v, np.full(n, 500), np.full(n, 5), t])
        packed = codecs.pack_command(*x)
        rows = zip(x.T.tolist(), scales, strict=True)
        assert [bytes(d) for d in packed] == [reference.pack_command(*c, *s) for c, s in rows]
        command = codecs.unpack_command(packed)
        got = [command.position, command.velocity, command.kp, command.kd, command.torque]
        want = [reference.unpack_command(bytes(d), *s) for d, s in zip(packed, scales, strict=True)]
        np.testing.assert_allclose(np.transpose(got), want, atol=1e-9)

        head, tail6, tail7 = rng.integers(0, 256, (3, n))
        packed = codecs.pack_feedback(x[0], x[1], x[4], head, tail6, tail7)
        rows = zip(x.T.tolist(), head.tolist(), tail6.tolist(), tail7.tolist(), scales, strict=True)
        expected = [reference.pack_feedback(c[0], c[1], c[4], h, a, b, *s) for c, h, a, b, s in rows]
        assert [bytes(d) for d in packed] == expected
        want = [reference.unpack_feedback(bytes(d), *s) for d, s in zip(packed, scales, strict=True)]
        np.testing.assert_allclose(np.transpose(codecs.unpack_feedback(packed)), want, atol=1e-9)


@given(st.binary(min_size=8, max_size=8))
def test_a_decoded_command_is_encoded_as_the_same_bytes(data):
    row = np.frombuffer(data, np.uint8)[None]
    command = codec().unpack_command(row)
    again = codec().pack_command(command.position, command.velocity, command.kp, command.kd, command.torque)
    word = int.from_bytes(data, "big")
    if word >> 36 & 0xFFF == 0xFFF:  # the one velocity that is never sent
        word -= 1 << 36
    assert again.tobytes() == word.to_bytes(8, "big")


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=5, max_size=5))
def test_every_finite_command_decodes_within_one_code_of_its_saturated_self(values):
    data = codec().pack_command(*(np.array([x]) for x in values))
    command = codec().unpack_command(data)
    got = np.array([command.position, command.velocity, command.kp, command.kd, command.torque])[:, 0]
    high = np.array([P, V - V_LSB, 500, 5, T])
    low = np.array([-P, -V, 0, 0, -T])
    lsb = np.array([P_LSB, V_LSB, 500 / 4095, 5 / 4095, T_LSB])
    error = np.clip(values, low, high) - got
    assert (error >= -1e-5 * lsb).all() and (error <= 1.00001 * lsb).all()
    assert (got >= low - 1e-9).all() and (got <= high + 1e-9).all()


extreme = st.sampled_from([1.0, 0.9999, 1e300, np.nextafter(1.0, 0), 0.998, -1.0, 0.0])


@given(st.lists(extreme, min_size=5, max_size=5))
def test_no_command_begins_with_six_ff(values):
    scale = np.array([P, V, 500, 5, T])
    with np.errstate(over="ignore"):
        x = np.nan_to_num(np.array(values) * scale)
    assert codec().pack_command(*x[:, None])[0].tobytes()[:6] != b"\xff" * 6


@pytest.mark.parametrize("quantity", range(5))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_refuses_what_is_not_finite(quantity, value):
    x = np.zeros((5, 3))
    x[quantity, 2] = value
    name = ("position", "velocity", "kp", "kd", "torque")[quantity]
    with pytest.raises(ValueError, match=f"motor 2 .*{name} {value}"):
        codec(3).pack_command(*x)


def test_a_position_out_of_range_wraps_or_saturates():
    zero = np.zeros(1)
    position = lambda p, wrap: (  # noqa: E731
        codec().unpack_feedback(codec().pack_feedback(np.array([p]), zero, zero, zero, zero, zero, wrap)).position[0]
    )
    assert position(P + 1.0, False) == pytest.approx(P)
    assert position(P + 1.0, True) == pytest.approx(-P + 1.0, abs=2 * P_LSB)
    assert position(-P - 1.0, True) == pytest.approx(P - 1.0, abs=2 * P_LSB)
    assert position(3.0, True) == position(3.0, False)


def test_rows_by_index_use_the_ranges_of_their_motor():
    two = MitCodec(Ranges(np.array([1.0, 10.0]), *(np.array([1.0, 1.0]) for _ in range(4))))
    data = np.full((3, 8), 255, np.uint8)
    assert two.unpack_feedback(data, np.array([1, 0, 1])).position.tolist() == pytest.approx([10.0, 1.0, 10.0])
    assert two.unpack_command(data, np.array([1, 0, 1])).position.tolist() == pytest.approx([10.0, 1.0, 10.0])
