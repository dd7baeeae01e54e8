"""LowCmd and LowState: golden values, an independent packer, every variant, and whatever else may arrive."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import reference_unitree as reference
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus import BusError, BusSpec, MotorCommand, MotorSpec, MotorState
from drivers.codecs import unitree_hg as hg

N = len(hg.JOINTS)
SPEC = BusSpec(
    "body",
    "unitree_hg",
    tuple(MotorSpec(f"{joint}_joint", model, i)
          for i, (joint, model) in enumerate(zip(hg.JOINTS, hg.models_of(hg.VARIANTS[5]), strict=True))),
    "dds",
)  # fmt: skip
ZERO = np.zeros(N)


def command(seed: int = 0) -> MotorCommand:
    return MotorCommand(*np.random.default_rng(seed).normal(size=(5, N)))


def state_words(seed: int = 0) -> np.ndarray:
    """A LowState struct with random numbers in every field, and zeros in the padding."""
    rng = np.random.default_rng(seed)
    words = np.zeros(hg.STATE.itemsize // 4, "<u4")
    frame = words.view(hg.STATE)
    for name in ("version", "mode_pr", "mode_machine", "tick", "imu_temperature", "remote", "reserve"):
        frame[name] = rng.integers(0, 100, frame[name].shape)
    for name in ("orientation", "angular_velocity", "acceleration", "rpy"):
        frame[name] = rng.normal(size=frame[name].shape)
    motors = frame["motors"]
    for name in motors.dtype.names:
        motors[name] = rng.integers(0, 100, motors[name].shape)
    return words


def test_the_crc_of_an_empty_command():
    assert hg.crc32(np.zeros(250, "<u4")) == 0xFE172F9F  # the maker's library says the same


@pytest.mark.parametrize("seed", range(20))
def test_the_crc_by_its_definition(seed):
    words = np.random.default_rng(seed).integers(0, 2**32, 250, dtype=np.uint64).astype("<u4")
    expected = reference.crc32_bitwise(words.tobytes())
    assert hg.crc32(words) == expected == reference.crc32_by_table(words.tobytes())


def test_a_command_as_an_independent_packer_has_it():
    c = command()
    plain = reference.LowCmd(0, 5)
    for i in range(N):
        plain.motor_cmd[i] = reference.MotorCmd(
            1, *(float(v[i]) for v in (c.position, c.velocity, c.torque, c.kp, c.kd))
        )
    plain.crc = reference.crc32_bitwise(reference.pack_struct(plain)[:-4])
    assert hg.UnitreeHgCodec(SPEC).pack_command(c, 5) == reference.pack_cdr(plain)


def test_offsets_of_the_struct():
    """Section 3.3 of the layout facts, from the IDL: they decide what the CRC is over."""
    motors = hg.COMMAND.fields["motors"]
    assert hg.COMMAND.itemsize == 1004 and motors[1] == 4 and motors[0].base.itemsize == 28
    state = {name: offset for name, (_, offset, *_) in hg.STATE.fields.items()}
    assert hg.STATE.itemsize == 2092 and hg.STATE.fields["motors"][0].base.itemsize == 56
    assert (state["tick"], state["motors"], state["remote"], state["reserve"], state["crc"]) == (
        12,
        72,
        2032,
        2072,
        2088,
    )
    assert hg.COMMAND_SIZE == 4 + 1000 and hg.STATE_SIZE == 4 + 2088


def test_a_state_on_the_wire_has_every_field_aligned_to_its_size():
    """CDR written by hand for the head of a LowState, up to motor 1's position."""
    words = state_words()
    s = words.view(hg.STATE)[0]
    head = struct.pack("<2I2B2xI13fh", *s["version"], s["mode_pr"], s["mode_machine"], s["tick"], *s["orientation"],
                       *s["angular_velocity"], *s["acceleration"], *s["rpy"], s["imu_temperature"])  # fmt: skip
    m = s["motors"][0]
    head += struct.pack("<Bx4f2hf7I", m["mode"], m["q"], m["dq"], m["ddq"], m["tau"], *m["temperature"], m["voltage"],
                        *m["sensor"], m["error"], *m["reserve"])  # fmt: skip
    head += struct.pack("<B3xf", s["motors"][1]["mode"], s["motors"][1]["q"])
    payload = hg.state_payload(words)
    assert payload[4 : 4 + len(head)] == head and len(payload) == hg.STATE_SIZE


@given(seed=st.integers(0, 2**32 - 1))
def test_a_command_there_and_back(seed):
    c = command(seed)
    frame = hg.read_command(hg.UnitreeHgCodec(SPEC).pack_command(c, 5))
    motors = frame["motors"][0][:N]
    for name, values in zip(
        ("q", "dq", "kp", "kd", "tau"), (c.position, c.velocity, c.kp, c.kd, c.torque), strict=True
    ):
        np.testing.assert_array_equal(motors[name], values.astype("f4"))
    assert frame["mode_machine"][0] == 5 and (motors["mode"] == 1).all() and frame["mode_pr"][0] == 0
    assert not frame["motors"][0][N:].view("u1").any()  # the slots that are not ours stay empty


@given(seed=st.integers(0, 2**32 - 1))
def test_a_state_there_and_back(seed):
    words = state_words(seed)
    frame = hg.read_state(hg.state_payload(words))
    assert frame.tobytes() == words.tobytes()
    state = MotorState.empty(N)
    assert hg.UnitreeHgCodec(SPEC).unpack(frame, state, 7.0)
    motors = frame["motors"][0][:N]
    np.testing.assert_array_equal(state.position, motors["q"])
    np.testing.assert_array_equal(state.torque, motors["tau"])
    np.testing.assert_array_equal(state.temperature, motors["temperature"].max(axis=1))
    np.testing.assert_array_equal(state.error, motors["error"])
    assert (state.time == 7.0).all() and (state.enabled == (motors["mode"] == 1)).all()


def test_padding_that_a_sender_left_dirty_does_not_matter():
    clean = hg.state_payload(state_words())
    dirty = bytearray(clean)
    for at in (10, 11, 71, 125, 126, 127):  # behind mode_machine, motor 0's mode, and motor 1's
        dirty[4 + at] = 0xAA
    assert hg.read_state(bytes(dirty)).tobytes() == hg.read_state(clean).tobytes()


PADDING = {10, 11, 71, *(69 + 56 * i + k for i in range(1, hg.SLOTS) for k in range(3))}


@given(at=st.integers(0, 8 * (hg.STATE_SIZE) - 1))
def test_no_flipped_bit_of_a_state_is_accepted(at):
    spoiled = bytearray(hg.state_payload(state_words()))
    spoiled[at // 8] ^= 1 << at % 8
    frame = hg.read_state(bytes(spoiled))
    assert frame is None or at // 8 - 4 in PADDING


@given(data=st.binary(max_size=3000) | st.binary(min_size=2092, max_size=2092).map(lambda b: hg.CDR_HEADER + b[4:]))
def test_random_bytes_are_no_message(data):
    assert hg.read_state(data) is None and hg.read_command(data) is None


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39])
@pytest.mark.parametrize("field", ["position", "velocity", "kp", "kd", "torque"])
def test_a_command_that_is_not_finite_is_refused_by_joint(value, field):
    c = command()
    getattr(c, field)[3] = value
    with pytest.raises(ValueError, match="body: command of left_knee_joint: expected finite"):
        hg.UnitreeHgCodec(SPEC).pack_command(c, 5)


def test_a_state_that_is_not_finite_leaves_the_last_one_old():
    words = state_words()
    words.view(hg.STATE)["motors"]["q"][0, 3] = np.nan
    state = MotorState.empty(N)
    assert not hg.UnitreeHgCodec(SPEC).unpack(hg.read_state(hg.state_payload(words)), state, 7.0)
    assert (state.time == -np.inf).all() and np.isnan(state.position).all()


def test_every_frame_starts_from_zeros():
    codec = hg.UnitreeHgCodec(SPEC)
    codec.pack_command(command(), 5)
    off, on = hg.read_command(codec.pack_disable(5)), hg.read_command(codec.pack_enable(5))
    assert not off["motors"].view("u1").any()
    assert (on["motors"]["mode"][0, :N] == 1).all()
    assert not any(on["motors"][name].any() for name in ("q", "dq", "tau", "kp", "kd"))


# Effort (N m) and velocity (rad/s) of hip pitch, hip roll and wrist pitch by mode_machine, as the maker's table has them.
LIMITS = {
    **dict.fromkeys((2, 3), ((88, 32), (88, 32), (5, 22))),
    **dict.fromkeys((5, 6), ((88, 32), (139, 20), (5, 22))),
    **dict.fromkeys((11, 12), ((139, 20), (139, 20), (5, 22))),
    **dict.fromkeys((13, 14), ((88, 32), (139, 20), (13.4, 27))),
    **dict.fromkeys((15, 16), ((139, 20), (139, 20), (13.4, 27))),
}


@pytest.mark.parametrize("mode_machine", LIMITS)
def test_limits_by_variant(mode_machine):
    models = hg.models_of(hg.VARIANTS[mode_machine])
    assert tuple(tuple(hg.MODELS[models[i]]) for i in (0, 1, 20)) == LIMITS[mode_machine]
    assert tuple(hg.MODELS[models[i]] for i in (6, 7, 27)) == tuple(hg.MODELS[models[i]] for i in (0, 1, 20))


@pytest.mark.parametrize(("mode_machine", "absent"), [(v, (13, 14)) for v in (3, 6, 12, 14, 16)]
                         + [(v, (13, 14, 20, 21, 27, 28)) for v in (1, 4, 10)])  # fmt: skip
def test_motors_that_a_variant_does_not_have(mode_machine, absent):
    models = hg.models_of(hg.VARIANTS[mode_machine])
    assert tuple(i for i, model in enumerate(models) if not model) == absent


def test_only_the_variant_of_the_wiring_fits():
    codec = hg.UnitreeHgCodec(SPEC)
    assert [v for v in hg.VARIANTS if not codec.misfits(v)] == [5]
    assert codec.misfits(11)[0] == (
        "left_hip_pitch_joint: the robot has a M7520-22 (139 N m, 20 rad/s), the wiring a M7520-14 (88 N m, 32 rad/s)"
    )
    assert "waist_roll_joint: the robot has no motor" in codec.misfits(6)[0]
    assert codec.misfits(0) == ["mode_machine 0 is no variant known here"]


@pytest.mark.parametrize(
    ("motor", "message"),
    [
        (MotorSpec("left_knee_joint", "M7520-22", 29), "got id 29, expected 0 to 28"),
        (MotorSpec("left_knee_joint", "M7520-22", 4), "slot of left_ankle_pitch"),
        (MotorSpec("left_knee_joint", "DM8009", 3), "no motor 'DM8009' in a G1"),
    ],
)
def test_a_wiring_that_no_robot_has(motor, message):
    with pytest.raises(BusError, match=message):
        hg.UnitreeHgCodec(BusSpec("body", "unitree_hg", (motor,)))


@pytest.mark.parametrize(
    ("code", "name"),
    [(0, "none"), (0x1, "over-current"), (0x210, "chip over-temperature + winding over-temperature"),
     (0xC00, "rotor encoder"), (0x40, "unknown 0x40"), (0x10008, "under-voltage + unknown 0x10000")],
)  # fmt: skip
def test_errors_have_names(code, name):
    assert hg.UnitreeHgCodec(SPEC).error_name(code) == name


def test_the_robots_side():
    mode, error = np.ones(N, int), np.zeros(N, int)
    payload = hg.pack_state([mode, ZERO + 1, ZERO + 2, ZERO + 3, ZERO + 40, error],
                            [np.array([1, 0, 0, 0]), np.ones(3), np.full(3, 9.81)], 2**32 + 4, 5)  # fmt: skip
    frame = hg.read_state(payload)
    assert frame["tick"][0] == 4 and frame["mode_machine"][0] == 5
    state = MotorState.empty(N)
    hg.UnitreeHgCodec(SPEC).unpack(frame, state, 0.0)
    assert (state.position == 1).all() and (state.torque == 3).all() and (state.temperature == 40).all()
    assert state.enabled.all()


def test_the_imu_takes_new_samples_only():
    payloads = [hg.state_payload(state_words(seed)) for seed in range(3)]
    parser = hg.ImuParser()
    samples = parser.feed(payloads[0] + payloads[0] + payloads[1] + b"?" + payloads[2][1:])
    assert len(samples) == 2 and parser.rejected == 2
    np.testing.assert_array_equal(samples[1].orientation, state_words(1).view(hg.STATE)["orientation"][0])


def test_the_remote():
    data = struct.pack("<2xH5f16x", 1 << 8 | 1 << 5, 0.1, 0.2, 0.3, 0.9, -0.5)
    remote = hg.read_remote(np.frombuffer(data, np.uint8))
    assert remote.buttons == {"A", "L2"}
    assert remote.left == pytest.approx((0.1, -0.5)) and remote.right == pytest.approx((0.2, 0.3))
