"""Benchmark: a LowCmd for 29 motors with its CRC against a class a message, packed field by field."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from bench_codec import load
from bench_table import ROOT, Row, interleaved

from drivers.bus import MotorCommand, MotorState
from drivers.codecs import unitree_hg as hg
from sim2real.config import load_robot

FACTOR = 15.0  # how many times faster than the incumbent we want to be
MODE_MACHINE = 5


def rows() -> Iterator[Row]:
    """Packing, against the CRC by table in Python and against one that costs nothing; then taking a LowState apart."""
    reference = load(ROOT / "tests" / "drivers" / "reference_unitree.py")
    spec = load_robot("g1").wiring("dds").bus_specs()[0]
    codec, n = hg.UnitreeHgCodec(spec), len(spec.motors)
    values = np.random.default_rng(0).normal(size=(5, n))
    command = MotorCommand(*values)
    message = reference.LowCmd(0, MODE_MACHINE)

    def plain(crc: Callable[[bytes], int]) -> bytes:
        """What a message-class stack does each tick: set every field of every motor, pack the struct, sum, pack CDR."""
        for i, (q, dq, kp, kd, tau) in enumerate(values.T.tolist()):
            motor = message.motor_cmd[i]
            motor.mode, motor.q, motor.dq, motor.tau, motor.kp, motor.kd = 1, q, dq, tau, kp, kd
        message.crc = crc(reference.pack_struct(message)[:-4])
        return reference.pack_cdr(message)

    ours = codec.pack_command(command, MODE_MACHINE)
    assert ours == plain(reference.crc32_by_table), "the two disagree: nothing to compare"
    crc = message.crc
    took = interleaved(
        {
            "ours": lambda: codec.pack_command(command, MODE_MACHINE),
            "classes": lambda: plain(reference.crc32_by_table),
            "classes, CRC for free": lambda: plain(lambda _: crc),
        }
    )
    yield compared("pack a LowCmd with CRC", took, "classes", "a message class and a CRC table in Python", FACTOR)
    yield compared(
        "the same, CRC of the other for free", took, "classes, CRC for free", "a message class, no CRC at all"
    )

    zeros = np.zeros(n)
    imu = (np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    payload = hg.pack_state([zeros] * 6, imu, 1, MODE_MACHINE)
    state = MotorState.empty(n)

    def take() -> None:
        sample = hg.read_state(payload)
        assert sample is not None and codec.unpack(sample, state, 0.0)

    took = interleaved({"ours": take})
    yield Row("unitree: check a LowState and take it apart", f"{took['ours'] * 1e6:.1f} us", figures={"seconds": took})


def compared(words: str, took: dict[str, float], incumbent: str, what: str, factor: float | None = None) -> Row:
    """One row: ours against ``incumbent``."""
    ratio = took[incumbent] / took["ours"]
    return Row(
        f"unitree: {words}",
        f"{took['ours'] * 1e6:.1f} us",
        f"{took[incumbent] * 1e6:.0f} us {what}",
        f"{ratio:.1f}x faster",
        f">= {factor:g}x" if factor else "",
        ratio >= factor if factor else None,
        {"seconds": {k: took[k] for k in ("ours", incumbent)}},
    )
