"""What ``sim2real doctor`` looks at. A check is one function in CHECKS that yields findings; it changes nothing.

Every finding that is not OK says why it matters and the exact command that mends it.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

from drivers.bus import BusSpec
from drivers.open import PROTOCOLS
from sim2real.bringup.machine import Machine
from sim2real.config import RobotConfig, Wiring
from sim2real.types import Sim2realError

BASE = (
    "mcap",
    "mujoco",
    "numpy",
    "onnx",
    "onnxruntime",
    "pydantic",
    "pyserial",
    "python-can",
    "pyyaml",
    "rich",
    "tyro",
)
EXTRAS = {"train": ("torch", "rsl-rl-lib"), "dds": ("cyclonedds",)}
CLOCKS = {"tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page"}  # read without leaving the program
DISK_FAIL, DISK_WARN = 200 << 20, 2 << 30  # bytes; a record is about 1 MB/s
CAN_QUEUE = 100  # frames: a tick of any bus here, with room
CAN_RESTART = (1, 1000)  # ms
G1_NETWORK = "192.168.123."


class Level(IntEnum):
    """How bad a finding is."""

    OK = 0
    WARN = 1
    FAIL = 2


@dataclass(frozen=True)
class Finding:
    """``what`` was looked at, what it ``said``; unless OK, ``why`` that matters and the command to ``fix`` it."""

    level: Level
    what: str
    said: str
    why: str = ""
    fix: str = ""


@dataclass(frozen=True)
class Question:
    """What the machine is wanted for. Without a robot: simulation and training in general."""

    machine: Machine
    records: Path  # where records will go
    robot: RobotConfig | None = None
    wiring: Wiring | None = None
    hardware: bool = False

    @property
    def missing(self) -> Level:
        """How bad it is that a piece of hardware is not there."""
        return Level.FAIL if self.hardware else Level.WARN

    def buses(self, wire: str) -> list[BusSpec]:
        specs = self.wiring.bus_specs() if self.wiring else []
        return [s for s in specs if s.protocol in PROTOCOLS and PROTOCOLS[s.protocol].wire == wire]


def ok(what: str, said: str) -> Finding:
    """A finding with which all is well."""
    return Finding(Level.OK, what, said)


def packages(q: Question) -> Iterator[Finding]:
    """Python, the base install, and the extras."""
    yield (
        ok("python", platform.python_version())
        if sys.version_info >= (3, 11)
        else Finding(Level.FAIL, "python", platform.python_version(), "expected 3.11 or later", "make deploy")
    )
    absent = [name for name in BASE if not q.machine.version(name)]
    if absent:
        yield Finding(
            Level.FAIL, "packages", f"missing: {', '.join(absent)}", "nothing runs without them", "pip install -e ."
        )
    else:
        yield ok(
            "packages", ", ".join(f"{name} {q.machine.version(name)}" for name in ("mujoco", "onnxruntime", "numpy"))
        )
    for extra, names in EXTRAS.items():
        absent = [name for name in names if not q.machine.version(name)]
        if not absent:
            yield ok(f"extra [{extra}]", ", ".join(f"{name} {q.machine.version(name)}" for name in names))
        elif extra == "dds" and q.buses("dds"):
            why = "this wiring is DDS: only its simulation runs without"
            yield Finding(q.missing, "extra [dds]", "not installed", why, "pip install 'sim2real[dds]'")
        else:
            yield ok(f"extra [{extra}]", "not installed, not needed here")


def realtime(q: Question) -> Iterator[Finding]:
    """Whether the loops may ask the kernel for punctuality."""
    m = q.machine
    group = "sudo groupadd -f realtime && sudo usermod -aG realtime $USER && "
    limits = (
        group + r"printf '@realtime - rtprio 98\n@realtime - memlock unlimited\n' | "
        "sudo tee /etc/security/limits.d/99-realtime.conf  # then log in again"
    )
    if m.uid == 0 or m.rtprio:
        yield ok("real-time priority", "permitted")
    else:
        why = "without SCHED_FIFO any other program can make a tick late"
        yield Finding(Level.WARN, "real-time priority", "not permitted", why, limits)
    if m.uid == 0 or m.memlock < 0:
        yield ok("locked memory", "permitted")
    else:
        why = "a page fault in a tick costs milliseconds"
        yield Finding(Level.WARN, "locked memory", f"at most {m.memlock >> 10} kB", why, limits)
    if m.path("/dev/cpu_dma_latency").exists():
        if m.writable("/dev/cpu_dma_latency"):
            yield ok("idle states", "can be kept shallow")
        else:
            rule = 'KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"'
            yield Finding(
                Level.WARN, "idle states", "cannot be kept shallow", "waking a sleeping core takes up to 0.2 ms",
                group + f"echo '{rule}' | sudo tee /etc/udev/rules.d/99-realtime.rules && sudo udevadm control --reload && "
                "sudo udevadm trigger --name-match=cpu_dma_latency  # then log in again",
            )  # fmt: skip


def processor(q: Question) -> Iterator[Finding]:
    """Cores, their governor, and the clock."""
    m = q.machine
    if m.cores >= 2:
        yield ok("cores", f"{m.cores}")
    else:
        why = "guardian and policy share one: expect late ticks"
        yield Finding(Level.WARN, "cores", "1", why, "nproc  # run on a computer, or in a container, with two or more")
    paths = sorted(m.path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = {path.read_text().strip() for path in paths}
    if governors - {"performance"}:
        yield Finding(
            Level.WARN, "CPU governor", ", ".join(sorted(governors)), "a clock that speeds up late makes ticks late",
            "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
        )  # fmt: skip
    else:
        yield ok("CPU governor", "performance" if governors else "none to set (a virtual machine, or fixed)")
    folder = "/sys/devices/system/clocksource/clocksource0"
    clock = m.read(f"{folder}/current_clocksource")
    if clock is None or clock in CLOCKS:
        yield ok("clock source", clock or "not stated")
    else:
        better = CLOCKS.intersection((m.read(f"{folder}/available_clocksource") or "").split())
        fix = f"echo {sorted(better)[0]} | sudo tee {folder}/current_clocksource" if better else f"cat {folder}/*source"
        yield Finding(Level.WARN, "clock source", clock, "reading it takes microseconds, and every stage is timed", fix)


def disk(q: Question) -> Iterator[Finding]:
    """Room for records."""
    folder = next(p for p in (q.records.absolute(), *q.records.absolute().parents) if p.exists())
    free = q.machine.free(folder)
    said = f"{free / 1e9:.1f} GB free in {folder}"
    if free >= DISK_WARN:
        yield ok("disk", said)
    else:
        level = Level.WARN if free >= DISK_FAIL else Level.FAIL
        yield Finding(
            level, "disk", said, "a record takes about 1 MB/s, and ends when the disk is full", f"du -sh {folder}/*"
        )


def graphics(q: Question) -> Iterator[Finding]:
    """Rendering without a screen, for --video."""
    if found := q.machine.library("EGL") or q.machine.library("OSMesa"):
        yield ok("OpenGL", found)
    else:
        fix = "sudo apt-get install libegl1 libgl1-mesa-dri"
        yield Finding(
            Level.WARN, "OpenGL", "neither EGL nor OSMesa", "--video cannot render; nothing else needs it", fix
        )


def can_buses(q: Question) -> Iterator[Finding]:
    """The SocketCAN interfaces of the wiring."""
    for spec in q.buses("can"):
        if spec.interface != "socketcan":
            continue
        name, what = spec.channel, f"CAN {spec.channel} ({spec.name})"
        up = f"sudo ip link set {name} up type can bitrate {spec.bitrate} restart-ms 100"
        again = f"sudo ip link set {name} down && {up}"
        link = q.machine.link(name)
        if link is None:
            simulated = "" if q.hardware else "; simulation does not"
            yield Finding(
                q.missing, what, "no such interface", f"the motors of {spec.name} need it{simulated}",
                f"{up}  # after plugging the adapter in; `ip link` lists what there is",
            )  # fmt: skip
            continue
        details = link.get("linkinfo", {}).get("info_data", {})
        bitrate = details.get("bittiming", {}).get("bitrate", 0)
        state, restart = str(details.get("state", "")), int(details.get("restart_ms", 0))
        queue = int(link.get("txqlen", 0))
        problems: list[tuple[Level, str, str, str]] = []
        if "UP" not in link.get("flags", []):
            problems.append((Level.FAIL, "down", "no frame goes in or out", up))
        if bitrate and bitrate != spec.bitrate:
            why = f"the wiring says {spec.bitrate}: at another rate every frame is an error"
            problems.append((Level.FAIL, f"bit rate {bitrate}", why, again))
        if state in ("BUS-OFF", "ERROR-PASSIVE"):
            why = (
                "nobody acknowledges, or a motor at another bit rate breaks every frame off: check motor power, wiring and "
                f"termination, and `sim2real scan --channel {name} --protocol {spec.protocol}` at {spec.bitrate} and others"
            )
            problems.append((Level.FAIL, state, why, again))
        if details and not CAN_RESTART[0] <= restart <= CAN_RESTART[1]:
            why = "after bus-off the interface would stay dead until somebody restarts it"
            problems.append((Level.WARN, f"restart-ms {restart}", why, again))
        if queue < CAN_QUEUE:
            why = f"a tick of {len(spec.motors)} motors may not fit (ENOBUFS)"
            fix = f"sudo ip link set {name} txqueuelen {CAN_QUEUE + 28}"
            problems.append((Level.WARN, f"txqueuelen {queue}", why, fix))
        for level, said, why, fix in problems:
            yield Finding(level, what, said, why, fix)
        if not problems:
            yield ok(what, f"up, {bitrate or 'virtual'} bit/s, {state or 'no state'}, txqueuelen {queue}")


def serial_ports(q: Question) -> Iterator[Finding]:
    """The serial devices of the wiring: there, permitted, and without an adapter that waits 16 ms for more bytes."""
    ports = {s.channel: s.name for s in q.buses("serial") if s.interface == "serial"}
    if q.wiring and q.wiring.imu.interface == "serial":
        ports.setdefault(q.wiring.imu.channel, "imu")
    for channel, name in ports.items():
        what = f"serial {channel} ({name})"
        if not q.machine.path(channel).exists():
            simulated = "" if q.hardware else "; simulation does not"
            fix = "ls -l /dev/serial/by-id  # and put what is there into the wiring"
            yield Finding(q.missing, what, "no such device", f"the {name} needs it{simulated}", fix)
            continue
        if not q.machine.writable(channel):
            fix = "sudo usermod -aG dialout $USER  # then log in again"
            yield Finding(Level.FAIL, what, "not permitted", "it cannot be opened", fix)
            continue
        timer = f"/sys/bus/usb-serial/devices/{q.machine.path(channel).resolve().name}/latency_timer"
        latency = q.machine.read(timer)
        if latency is not None and int(latency) > 1:
            why = "this adapter holds received bytes back for so long: at 16 ms not even 50 Hz is possible"
            yield Finding(Level.FAIL, what, f"latency timer {latency} ms", why, f"echo 1 | sudo tee {timer}")
        else:
            yield ok(what, "can be opened" + (f", latency timer {latency} ms" if latency else ""))


def dds(q: Question) -> Iterator[Finding]:
    """The network interface towards a robot behind DDS."""
    for spec in q.buses("dds"):
        name = spec.channel.partition(":")[0]
        what = f"DDS {spec.channel} ({spec.name})"
        link = q.machine.link(name)
        if link is None:
            fix = "ip -brief link  # and put the one with the robot's cable into the wiring"
            yield Finding(q.missing, what, "no such interface", "the robot is reached through it", fix)
            continue
        addresses = [a.get("local", "") for a in link.get("addr_info", [])]
        if name == "lo" or any(a.startswith(G1_NETWORK) for a in addresses):
            yield ok(what, ", ".join(addresses) or "loopback")
        else:
            yield Finding(
                q.missing, what, f"addresses {', '.join(addresses) or 'none'}", f"a G1 is in the network {G1_NETWORK}0/24",
                f"sudo ip address add {G1_NETWORK}222/24 dev {name} && sudo ip link set {name} up",
            )  # fmt: skip
        if spec.watchdog and q.hardware and name != "lo":
            why = "a G1 has no watchdog that could be programmed, and what it does when commands stop is undocumented"
            fix = "sim2real robots  # in its YAML 'watchdog: 0' accepts that, for a robot that hangs from its gantry"
            yield Finding(Level.FAIL, what, f"watchdog {spec.watchdog:g} s", why, fix)


def policies(q: Question) -> Iterator[Finding]:
    """Every policy that the robot's YAML names: there, whole, and made for it."""
    from sim2real.policy import load_policy

    if q.robot is None:
        return
    root = Path(__file__).resolve().parents[2]
    for name, entry in q.robot.policies.items():
        what = f"policy {name}"
        try:
            policy = load_policy(root / entry.file, q.robot)
        except (Sim2realError, OSError) as error:
            fix = f"sim2real check {entry.file} --robot {q.robot.name}"
            yield Finding(Level.FAIL, what, str(error).splitlines()[0], "deploy would refuse it", fix)
        else:
            yield ok(what, f"fits, sha256 {policy.sha256[:12]}")


CHECKS: tuple[Callable[[Question], Iterator[Finding]], ...] = (
    packages, realtime, processor, disk, graphics, can_buses, serial_ports, dds, policies,
)  # fmt: skip
