"""``sim2real doctor`` on computers made of files: each thing that can be wrong is found, once, with what mends it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from sim2real.bringup import checks
from sim2real.bringup.checks import CHECKS, Level, Question
from sim2real.bringup.machine import Machine, link, version
from sim2real.cli import main
from sim2real.config import load_robot

CAN = {
    "ifname": "can0",
    "flags": ["NOARP", "UP", "LOWER_UP"],
    "txqlen": 128,
    "linkinfo": {
        "info_kind": "can",
        "info_data": {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 1_000_000}},
    },
}
CLOCK = "sys/devices/system/clocksource/clocksource0/current_clocksource"
GOVERNOR = "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"


def files(root: Path, **texts: str) -> None:
    for name, text in texts.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def can_with(**data):
    changed = {k: data.pop(k) for k in ("flags", "txqlen") if k in data}
    details = CAN["linkinfo"]["info_data"] | data
    return CAN | changed | {"linkinfo": {"info_kind": "can", "info_data": details}}


@pytest.fixture
def machine(tmp_path):
    """A computer on which everything is as it should be."""
    for name, text in {CLOCK: "tsc", GOVERNOR: "performance", "dev/cpu_dma_latency": "", "dev/ttyUSB0": ""}.items():
        files(tmp_path, **{name.replace("/", "__"): text})
    files(tmp_path, sys__bus__usb__x="", **{"sys__bus__usb-serial__devices__ttyUSB0__latency_timer": "1"})
    return Machine(
        root=tmp_path, link=lambda name: CAN | {"ifname": name}, version=lambda name: "1.0", library=lambda name: name,
        uid=1000, rtprio=98, memlock=-1, cores=4, free=lambda path: 10**11,
    )  # fmt: skip


def ask(machine: Machine, robot: str = "", wiring: str = "", hardware: bool = True) -> Question:
    config = load_robot(robot) if robot else None
    return Question(machine, Path("/"), config, config.wiring(wiring) if config else None, hardware)


def found(question: Question, checks_=CHECKS[:-1]):
    """Without the policies, which take a second."""
    return [f for check in checks_ for f in check(question)]


@pytest.mark.parametrize("robot", ["", "g1", "bench"])
def test_a_computer_as_it_should_be(machine, robot):
    assert {f.level for f in found(ask(machine, robot))} == {Level.OK}


# What changes in the machine -> level, part of what is said, part of the fix.
WRONG = {
    "package": ({"version": lambda n: "" if n == "mujoco" else "1"}, Level.FAIL, "missing: mujoco", "pip install"),
    "priority": ({"rtprio": 0}, Level.WARN, "not permitted", "rtprio 98"),
    "memory": ({"memlock": 65536}, Level.WARN, "at most 64 kB", "memlock unlimited"),
    "core": ({"cores": 1}, Level.WARN, "1", "nproc"),
    "governor": ({GOVERNOR: "powersave"}, Level.WARN, "powersave", "echo performance | sudo tee"),
    "clock": ({CLOCK: "hpet", CLOCK.replace("current", "available"): "hpet tsc"}, Level.WARN, "hpet", "echo tsc | sudo tee"),
    "disk": ({"free": lambda p: 10**9}, Level.WARN, "1.0 GB free", "du -sh"),
    "full disk": ({"free": lambda p: 10**7}, Level.FAIL, "0.0 GB free", "du -sh"),
    "graphics": ({"library": lambda n: None}, Level.WARN, "neither EGL nor OSMesa", "apt-get install libegl1"),
    "no CAN": ({"link": lambda n: None}, Level.FAIL, "no such interface", "ip link set can0 up type can bitrate 1000000"),
    "CAN down": ({"link": lambda n: can_with(flags=["NOARP"])}, Level.FAIL, "down", "ip link set can0 up"),
    "bit rate": ({"link": lambda n: can_with(bittiming={"bitrate": 500_000})}, Level.FAIL, "500000", "set can0 down &&"),
    "bus off": ({"link": lambda n: can_with(state="BUS-OFF")}, Level.FAIL, "BUS-OFF", "set can0 down &&"),
    "restart": ({"link": lambda n: can_with(restart_ms=0)}, Level.WARN, "restart-ms 0", "restart-ms 100"),
    "queue": ({"link": lambda n: can_with(txqlen=10)}, Level.WARN, "txqueuelen 10", "txqueuelen 128"),
    "FTDI": (
        {"sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16"}, Level.FAIL, "latency timer 16 ms",
        "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_found_once_and_mended_by_a_command(machine, case):
    changes, level, said, fix = WRONG[case]
    fields = {k: v for k, v in changes.items() if "/" not in k}
    files(machine.root, **{k.replace("/", "__"): v for k, v in changes.items() if "/" in k})
    (finding,) = (f for f in found(ask(replace(machine, **fields), "bench")) if f.level != Level.OK)
    assert finding.level == level and said in finding.said and fix in finding.fix and finding.why


@pytest.mark.parametrize(("hardware", "level"), [(True, Level.FAIL), (False, Level.WARN)])
def test_hardware_that_is_not_there_fails_only_where_it_is_wanted(machine, hardware, level):
    question = ask(replace(machine, link=lambda name: None), "g1", hardware=hardware)
    missing = [f for f in checks.can_buses(question)]
    assert len(missing) == 5 and {f.level for f in missing} == {level}
    assert ("simulation does not" in missing[0].why) != hardware


def test_a_port_that_is_not_there(machine):
    (machine.root / "dev/ttyUSB0").unlink()
    (finding,) = checks.serial_ports(ask(machine, "bench"))
    assert finding.level == Level.FAIL and "no such device" in finding.said


def test_a_port_that_may_not_be_opened(machine, monkeypatch):
    monkeypatch.setattr(Machine, "writable", lambda self, path: False)
    (finding,) = checks.serial_ports(ask(machine, "bench"))
    assert finding.level == Level.FAIL and "usermod -aG dialout" in finding.fix


ADDRESSED = {"addr_info": [{"local": "192.168.123.222"}]}


@pytest.mark.parametrize(
    ("answer", "said"),
    [(None, ["no such interface"]), ({"addr_info": [{"local": "10.0.0.1"}]}, ["addresses 10.0.0.1", "watchdog 0.08 s"]),
     (ADDRESSED, ["192.168.123.222", "watchdog 0.08 s"])],
)  # fmt: skip
def test_the_network_of_a_factory_g1(machine, answer, said):
    findings = list(checks.dds(ask(replace(machine, link=lambda name: answer), "g1", "dds")))
    assert [f.said for f in findings] == said
    assert findings[-1].level == Level.FAIL and findings[-1].fix


def test_dds_without_its_extra(machine):
    question = ask(replace(machine, version=lambda name: "" if name == "cyclonedds" else "1"), "g1", "dds")
    assert [f.fix for f in checks.packages(question) if f.level] == ["pip install 'sim2real[dds]'"]


def test_a_policy_that_deploy_would_refuse(machine):
    robot = load_robot("g1")
    entry = next(iter(robot.policies.values())).model_copy(update={"file": "nowhere.onnx"})
    question = replace(ask(machine), robot=robot.model_copy(update={"policies": {"lost": entry}}))
    (finding,) = checks.policies(question)
    assert finding.level == Level.FAIL and "nowhere.onnx" in finding.said and "sim2real check" in finding.fix


def test_every_finding_that_is_not_ok_has_a_fix_here_too(capsys):
    """On the computer that runs this, whatever it is."""
    code = main(["doctor", "--robot", "bench", "--json"])
    findings = json.loads(capsys.readouterr().out)
    assert all(f["why"] and f["fix"] for f in findings if f["level"] != "OK")
    assert code == int(any(f["level"] == "FAIL" for f in findings))
    main(["doctor", "--robot", "bench"])
    said = capsys.readouterr().out
    assert all(f["what"] in said for f in findings)


def test_asking_for_nobodys_hardware(capsys):
    assert main(["doctor", "--hardware"]) == 2
    assert "whose?" in capsys.readouterr().err


def test_the_real_askers():
    assert link("lo") is None or link("lo")["ifname"] == "lo"
    assert link("nope0") is None
    assert version("numpy") and version("no-such-thing") == ""
