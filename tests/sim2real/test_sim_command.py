"""``sim2real sim``: what it says, and other people's programs that drive the twins it serves in a process of their own."""

from __future__ import annotations

import asyncio
import importlib.util
import re
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest
import yaml

from drivers.bus import ImuSpec
from drivers.codecs import hipnuc, moteus
from drivers.open import open_wire
from sim2real.cli import main
from sim2real.config import load_robot

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-c", "import sys; from sim2real.cli import main; sys.exit(main())", "sim"]


@contextmanager
def served(folder: Path, robot: str, *arguments: str) -> Iterator[str]:
    """What the command printed once it listens."""
    command = [*COMMAND, "--robot", robot, "--serve", "--directory", str(folder), *arguments]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout
        said = ""
        while "WorldRemote" not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
        try:
            yield said
        finally:
            process.terminate()


def until(condition, seconds: float = 10.0):
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.002)
    return found


def servo_robot(folder: Path, protocol: str, model: str, **bus) -> str:
    """The bench with two motors of another protocol."""
    bench = yaml.safe_load((ROOT / "configs/robots/bench.yaml").read_text())
    bench["model"] = str(ROOT / "configs/robots" / bench["model"])
    wiring = bench["wirings"][bench["default_wiring"]]
    (only,) = wiring["buses"]
    motors = [{"joint": m["joint"], "model": model, "id": i} for i, m in enumerate(only["motors"], 1)]
    wiring["buses"] = [{"name": "arm", "protocol": protocol, "motors": motors} | bus]
    (folder / "robot.yaml").write_text(yaml.safe_dump(bench))
    return str(folder / "robot.yaml")


def test_without_serve_it_says_what_it_would_do(capsys):
    assert main(["sim", "--robot", "g1", "--can", "socketcan:vcan{n}"]) == 0
    said = capsys.readouterr().out
    for n, bus in enumerate(load_robot("g1").wiring("can").buses, 2):
        assert bus.name in said and f'can.Bus(interface="socketcan", channel="vcan{n}")' in said
    assert main(["sim", "--robot", "g1", "--wiring", "dds", "--dds", "lo:3"]) == 0
    assert 'ChannelFactoryInitialize(3, "lo")' in capsys.readouterr().out


def test_dds_stays_on_loopback(capsys):
    assert main(["sim", "--robot", "g1", "--wiring", "dds", "--dds", "eth0", "--serve"]) == 2
    assert "expected lo or lo:1 (domain 1): a twin stays at home" in capsys.readouterr().err


def multicast() -> str:
    """A group of its own on which this machine carries frames; skips where it carries none."""
    place = f"239.74.{uuid.uuid4().int % 250 + 1}.{uuid.uuid4().int % 250 + 1}"
    try:
        with (
            can.Bus(interface="udp_multicast", channel=place) as a,
            can.Bus(interface="udp_multicast", channel=place) as b,
        ):
            a.send(can.Message(arbitration_id=1))
            if b.recv(1.0) is None:
                pytest.skip("no UDP multicast on this machine")
    except (can.CanError, OSError, ImportError) as error:
        pytest.skip(f"no UDP multicast on this machine: {error}")
    return place


def test_a_python_can_program_talks_to_a_motor(tmp_path):
    place = multicast()
    with served(tmp_path, "bench", "--can", f"udp_multicast:{place}") as said:
        assert f'can.Bus(interface="udp_multicast", channel="{place}")' in said
        motor = load_robot("bench").wiring("").buses[0].motors[0]
        with can.Bus(interface="udp_multicast", channel=place, receive_own_messages=False) as bus:

            def ask():
                """Register PMAX (21) of the motor, as its manual has it."""
                data = bytes([motor.id, 0, 0x33, 21, 0, 0, 0, 0])
                bus.send(can.Message(arbitration_id=0x7FF, data=data, is_extended_id=False))
                message = bus.recv(0.5)
                return message if message is not None and message.arbitration_id == motor.feedback_id else None

            assert until(ask).data[:4].hex() == f"{motor.id:02x}003315"
        line = open_wire(ImuSpec("hipnuc", "serial", str(tmp_path / "imu.tty")))
        parser = hipnuc.Parser()
        assert until(lambda: parser.feed(line.read()))[0].acceleration[2] == pytest.approx(9.8, abs=0.5)
        line.close()


def test_the_moteus_library_talks_to_a_controller(tmp_path):
    """The maker's own python-can transport, CAN-FD, another process."""
    library = pytest.importorskip("moteus", reason="the maker's library (pip install moteus) is not installed")
    place = multicast()
    robot = servo_robot(tmp_path, "moteus", "qdd100-beta2", data_bitrate=moteus.DATA_BITRATE)
    with served(tmp_path, robot, "--can", f"udp_multicast:{place}") as said:
        assert f'moteus.PythonCanDevice(interface="udp_multicast", channel="{place}")' in said

        async def ask():
            device = library.PythonCanDevice(interface="udp_multicast", channel=place)
            controller = library.Controller(id=2, transport=library.Transport([device]))
            for _ in range(20):
                try:
                    return await asyncio.wait_for(controller.query(), 0.5)
                except TimeoutError:
                    pass
            raise AssertionError("no answer")

        values = asyncio.run(ask()).values
        assert values[library.Register.MODE] == 0 and values[library.Register.VOLTAGE] == 24.0


@pytest.mark.parametrize(
    ("protocol", "model", "module", "bus"),
    [
        ("dynamixel", "XM430-W350", "dynamixel_sdk", {}),
        ("feetech", "STS3215-12V", "scservo_sdk", {"watchdog": 86400.0}),
    ],
)
def test_a_makers_sdk_talks_to_a_servo(tmp_path, protocol, model, module, bus):
    sdk = pytest.importorskip(module, reason=f"the maker's SDK ({module}) is not installed")
    robot = servo_robot(tmp_path, protocol, model, interface="serial", bitrate=1_000_000, **bus)
    with served(tmp_path, robot) as said:
        (path,) = re.findall(rf'{module}.PortHandler\("([^"]+)"\)', said)
        port = sdk.PortHandler(path)
        assert port.openPort() and port.setBaudRate(1_000_000)
        ping = sdk.PacketHandler(2.0).ping if protocol == "dynamixel" else sdk.sms_sts(port).ping
        number = {"dynamixel": 1020, "feetech": 777}[protocol]
        try:
            until(lambda: ping(*((port, 2) if protocol == "dynamixel" else (2,)))[:2] == (number, 0))
        finally:
            port.closePort()


def test_the_unitree_message_classes_read_the_robot(tmp_path):
    """LowState as the maker's own Python class takes it from DDS, with the CRC that its library computes."""
    pytest.importorskip("cyclonedds", reason="Cyclone DDS is not installed: pip install 'sim2real[dds]'")
    if importlib.util.find_spec("unitree_sdk2py") is None:
        pytest.skip("the maker's message classes (pip install unitree-sdk2py-dimos) are not installed")
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from unitree_sdk2py.idl.unitree_hg.msg.dds_ import LowState_
    from unitree_sdk2py.utils.crc import CRC

    from drivers.dds_wire import _configure

    domain = 90 + uuid.uuid4().int % 50
    with served(tmp_path, "g1", "--wiring", "dds", "--dds", f"lo:{domain}") as said:
        assert f'ChannelFactoryInitialize({domain}, "lo")' in said
        _configure("lo", domain)
        participant = DomainParticipant(domain)
        reader = DataReader(participant, Topic(participant, "rt/lowstate", LowState_))
        (state, *_) = until(lambda: reader.take(N=1), 20.0)
        assert CRC().Crc(state) == state.crc and state.mode_machine == 5
        assert abs(sum(q * q for q in state.imu_state.quaternion) - 1.0) < 1e-3
