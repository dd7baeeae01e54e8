"""A motor at another bit rate than its bus: error frames, a controller that goes error-passive and bus-off, and who tells."""

from __future__ import annotations

import numpy as np
import pytest
from can_bench import Bench
from rich.console import Console

from drivers.bus import MotorState
from drivers.codecs.damiao import DamiaoCodec
from drivers.open import open_world
from drivers.wire import BUS_OFF, CONTROLLER, ERROR, RESTARTED, WireFull
from sim2real.cli.scan import _print, _sweep
from sim2real.clock import SimClock
from sim2real.config import load_robot


def poll(bench: Bench) -> np.ndarray:
    return DamiaoCodec(bench.spec).pack_poll(MotorState.empty(2))


def at_another_rate(tmp_path, code: int, *joints: str) -> Bench:
    """Damiao motors on 1 Mbit/s, of which ``joints`` listen at the bit rate of can_br ``code``."""
    registers = {joint: {"CAN_BR": float(code)} for joint in joints}
    return Bench(tmp_path, "damiao", connect=False, registers=registers)


def told(bench: Bench, seconds: float) -> list[tuple[int, int]]:
    """What the controller says of itself: the class of each error frame, and data[1]."""
    wire, said = bench.world.wires["arm"], []
    for _ in range(round(seconds * 1000)):
        bench.world.advance(bench.world.time + 0.001)
        frames = wire.recv()
        said += [(int(f["id"]) & ~ERROR, int(f["data"][1])) for f in frames[frames["id"] & ERROR > 0]]
    return said


@pytest.mark.parametrize(
    ("code", "broken", "bus_off"),
    [(3, 16, 0), (2, 16, 1), (0, 16, 2)],  # 500, 250 and 125 kbit/s: the slower, the longer its error flags
)
def test_a_motor_at_another_bit_rate_breaks_frames_off_until_it_is_error_passive(tmp_path, code, broken, bus_off):
    bench = at_another_rate(tmp_path, code, "right")
    wire, heard = bench.world.wires["arm"], []
    for _ in range(bus_off + 1):
        wire.send(poll(bench))
        heard += told(bench, 0.15)
    counters = bench.world.counters()["arm"]
    assert (counters["corrupted"], counters["bus_off"]) == (broken, bus_off)
    classes = [c for c, _ in heard]
    assert classes.count(BUS_OFF) == classes.count(RESTARTED) == bus_off
    assert (CONTROLLER, 0x20) in heard  # error-passive, transmitting
    wire.send(poll(bench))
    bench.world.advance(bench.world.time + 0.01)
    assert set(wire.recv()["id"].tolist()) == {0x11}  # the other one answers, now that the stranger is quiet


def test_where_all_listen_at_another_rate_nobody_acknowledges(tmp_path):
    bench = at_another_rate(tmp_path, 3, "left", "right")
    wire = bench.world.wires["arm"]
    wire.send(poll(bench))
    assert told(bench, 0.2) == [(CONTROLLER, 0x20)]
    assert bench.world.counters()["arm"]["bus_off"] == 0  # ISO 11898-1: no acknowledgement alone takes nobody off
    with pytest.raises(WireFull):
        wire.send(np.zeros(200, wire.recv().dtype))
    bench.world.buses[0].retune(500_000)
    wire.send(poll(bench))
    bench.world.advance(bench.world.time + 0.01)
    assert set(wire.recv()["id"].tolist()) == {0x11, 0x12}


def test_a_motor_that_was_off_is_angry_anew(tmp_path):
    options = {"registers": {"right": {"CAN_BR": 3.0}}, "faults": ["reboot:arm/right=0.01@0.1"]}
    bench = Bench(tmp_path, "damiao", connect=False, **options)
    for count in (16, 32):
        bench.world.wires["arm"].send(poll(bench))
        told(bench, 0.15)
        assert bench.world.counters()["arm"]["corrupted"] == count


def test_a_motor_at_another_rate_is_told_by_scan(tmp_path, capsys):
    """As a person sees it: the bench, one motor at 125 kbit/s."""
    config = load_robot("bench")
    wiring = config.wiring()
    world = open_world(config.model_path, config.base, wiring.bus_specs(), wiring.imu_spec(),
                       registers={"elbow_joint": {"CAN_BR": 0.0}})  # fmt: skip
    clock = SimClock(world.advance, lambda: world.time)
    (spec,) = wiring.bus_specs()
    bus = _sweep(spec, False, world, clock)
    assert bus["controller"] == "bus-off" and bus["error_frames"] > 0
    assert {m["joint"]: bool(m["problems"]) for m in bus["motors"]} == {"shoulder_joint": False, "elbow_joint": True}
    _print(Console(width=200), "arm", bus["motors"], bus["error_frames"], bus["controller"])
    assert "the controller went bus-off" in capsys.readouterr().out
    bus = _sweep(spec, True, world, clock)
    told = {m["id"]: m["problems"] for m in bus["motors"] if m["registers"] and m["problems"]}
    assert "listens at 125000 bit/s, the bus runs at 1000000" in told[2][0]
