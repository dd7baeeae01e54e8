"""What the makers' own Python packages say of the same numbers and bytes, where they are installed (extra ``oracles``)."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from test_unitree_hg import SPEC, command

from drivers.codecs import odrive
from drivers.codecs import unitree_hg as hg


@pytest.fixture(scope="module")
def odrive_enums():
    """The enumerations of the package odrive, without its USB library."""
    found = importlib.util.find_spec("odrive")
    if found is None or not found.submodule_search_locations:
        pytest.skip("the maker's package (pip install odrive) is not installed")
    path = Path(found.submodule_search_locations[0]) / "enums.py"
    spec = importlib.util.spec_from_file_location("odrive_enums", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["odrive_enums"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["odrive_enums"]


def test_odrive_states_and_modes(odrive_enums):
    """The same in 0.5 and 0.6."""
    theirs = odrive_enums.AxisState
    assert odrive.AxisState.IDLE == theirs.IDLE
    assert odrive.AxisState.FULL_CALIBRATION == theirs.FULL_CALIBRATION_SEQUENCE
    assert odrive.AxisState.CLOSED_LOOP == theirs.CLOSED_LOOP_CONTROL
    assert odrive.POSITION_CONTROL == odrive_enums.ControlMode.POSITION_CONTROL
    assert odrive.PASSTHROUGH == odrive_enums.InputMode.PASSTHROUGH


def test_unitree_message_classes_serialise_the_same_command():
    """LowCmd_ and CRC of unitree_sdk2_python, as PyPI has them, against our packer: the payload is the same bytes."""
    pytest.importorskip("cyclonedds", reason="Cyclone DDS is not installed: pip install 'sim2real[dds]'")
    if importlib.util.find_spec("unitree_sdk2py") is None:
        pytest.skip("the maker's message classes (pip install unitree-sdk2py-dimos) are not installed")
    from unitree_sdk2py.idl.default import unitree_hg_msg_dds__LowCmd_
    from unitree_sdk2py.idl.unitree_hg.msg.dds_ import LowCmd_
    from unitree_sdk2py.utils.crc import CRC

    ours = hg.UnitreeHgCodec(SPEC).pack_command(command(3), 5)
    read = LowCmd_.deserialize(ours)
    c = command(3)
    assert CRC().Crc(read) == read.crc and read.mode_machine == 5
    for i, m in enumerate(SPEC.motors):
        motor = read.motor_cmd[m.id]
        assert motor.mode == 1
        np.testing.assert_allclose(
            [motor.q, motor.dq, motor.tau], [c.position[i], c.velocity[i], c.torque[i]], rtol=1e-6
        )
        np.testing.assert_allclose([motor.kp, motor.kd], [c.kp[i], c.kd[i]], rtol=1e-6)

    theirs = unitree_hg_msg_dds__LowCmd_()
    theirs.mode_pr, theirs.mode_machine = 0, 5
    for i, m in enumerate(SPEC.motors):
        motor = theirs.motor_cmd[m.id]
        motor.mode, motor.q, motor.dq, motor.tau = 1, c.position[i], c.velocity[i], c.torque[i]
        motor.kp, motor.kd = c.kp[i], c.kd[i]
    theirs.crc = CRC().Crc(theirs)
    assert theirs.serialize() == ours
    assert hg.read_command(theirs.serialize()) is not None
