"""The gait: when its clock runs, where it puts the feet, and that it turns over in a mirror."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from policies.basics import Basics
from policies.gait import BEGUN, Gait, Lean, Stride, single_loads
from policies.mirror import joint_mirror
from sim2real.config import load_robot

ROBOT = load_robot("g1")
STRIDE = Stride()
GAIT = Gait(ROBOT.joint_names, 0.02, STRIDE)
STILL = Lean(*torch.zeros(6, 1, 1))
NONE = torch.zeros(1, 3)
FORWARD = torch.tensor([[0.5, 0.0, 0.0]])


def clock(phase: float, ticks: int, command: torch.Tensor = NONE, lean: Lean = STILL) -> list[float]:
    phases = [torch.tensor([[phase]])]
    for _ in range(ticks):
        phases.append(GAIT.advance(phases[-1], command, lean, GAIT.capture(lean)))
    return [p.item() for p in phases[1:]]


@pytest.mark.parametrize("phase", [0.0, 0.5])
def test_without_a_reason_both_feet_rest(phase):
    assert clock(phase, 5) == [phase] * 5


def test_bent_legs_do_not_step():
    falling = STILL._replace(forward=torch.tensor([[1.0]]))
    advanced = [
        GAIT.advance(torch.zeros(1, 1), NONE, falling, GAIT.capture(falling), b) for b in (0.0, STRIDE.bow + 0.01)
    ]
    assert advanced[0] > 0 and advanced[1] == 0


def test_a_pose_with_flat_soles_pitches_the_base():
    bend = torch.zeros(1, len(ROBOT.joint_names))
    for side in ("left", "right"):
        for part, angle in (("hip_pitch", -1.0), ("knee", 0.7), ("ankle_pitch", -0.3)):
            bend[0, ROBOT.joint_names.index(f"{side}_{part}_joint")] = angle
    assert GAIT.pitch(bend).item() == pytest.approx(0.6)


def test_a_command_starts_the_clock_and_it_goes_round():
    phases = clock(0.0, 50, FORWARD)
    assert phases[0] == pytest.approx(0.02 / STRIDE.period + BEGUN)
    assert any(b < a for a, b in zip(phases, phases[1:], strict=False))
    assert all(0.0 <= p < 1.0 for p in phases)


@pytest.mark.parametrize("aside", [-0.3, 0.0, 0.3])
def test_feet_take_turns_and_neither_rests_while_they_walk(aside):
    """At 0.5 exactly both rest, and after a rest whichever is light begins: a robot moved to the right stepped with the left."""
    moving = STILL._replace(left_speed=torch.tensor([[aside]]))
    phases = clock(0.0, 62, FORWARD, moving)
    assert not {0.0, 0.5} & set(phases)
    halves = [p >= 0.5 for p in phases]
    assert sum(a != b for a, b in zip(halves, halves[1:], strict=False)) == 4  # of 0.3 s


def test_a_walk_is_even_soon_after_either_foot_has_left_the_ground():
    phases = torch.linspace(0.005, 0.995, 100)[:, None]
    even = GAIT.even(phases)[:, 0]
    assert even.sum() == 6 and torch.equal(even[:50], even[50:])
    assert not GAIT.even(torch.tensor([[0.0], [0.5]])).any()  # at rest


def test_a_step_once_begun_is_finished_and_then_the_feet_rest():
    phases = clock(0.2, 40)
    assert phases[0] > 0.2 and phases[-1] == 0.5 and phases == sorted(phases)
    assert clock(0.8, 40)[-1] == 0.0


@pytest.mark.parametrize(
    ("lean", "steps"),
    [
        ({"forward": STRIDE.ahead * 0.9}, False),
        ({"forward": STRIDE.ahead * 1.1}, True),
        ({"forward": -STRIDE.behind * 0.9}, False),
        ({"forward": -STRIDE.behind * 1.1}, True),
        ({"left": STRIDE.aside * 1.1}, True),
        ({"forward_speed": STRIDE.ahead * 1.1 * STRIDE.pendulum * STRIDE.leg}, True),
        ({"left_speed": -STRIDE.aside * 1.1 * STRIDE.pendulum * STRIDE.leg}, True),
    ],
)
def test_a_capture_point_outside_the_feet_asks_for_a_step(lean, steps):
    falling = STILL._replace(**{k: torch.tensor([[v]]) for k, v in lean.items()})
    assert (clock(0.0, 1, lean=falling)[0] != 0.0) is steps


def test_a_capture_point_is_believed_after_a_while_and_an_alarming_one_at_once():
    def steps(forward: float) -> int:
        falling = STILL._replace(forward=torch.tensor([[forward]]))
        steady, phase = torch.zeros(1, 2), torch.zeros(1, 1)
        for tick in range(50):
            steady = GAIT.steady(steady, falling)
            phase = GAIT.advance(phase, NONE, falling, steady)
            if phase.item():
                return tick
        return -1

    assert steps(STRIDE.ahead * STRIDE.alarm * 1.05) == 0
    assert 2 <= steps(STRIDE.ahead * 1.5) <= 10  # -ln(1 - 1 / 1.5) = 1.1 of the patience
    assert steps(STRIDE.ahead * 0.95) == -1


def test_noise_of_the_size_of_the_feet_starts_no_step():
    noise = torch.randn(500, generator=torch.Generator().manual_seed(0)).clamp(-2.8, 2.8) * STRIDE.ahead / 2
    steady, phase, raw = torch.zeros(1, 2), torch.zeros(1, 1), 0
    for n in noise:
        leaning = STILL._replace(forward=n.reshape(1, 1))
        steady = GAIT.steady(steady, leaning)
        phase = GAIT.advance(phase, NONE, leaning, steady)
        raw += n.abs().item() > STRIDE.ahead
    assert phase.item() == 0.0 and raw > 10


@pytest.mark.parametrize(("speed", "lifted"), [(1.0, "right"), (-1.0, "left")])
def test_the_unloaded_foot_is_lifted_first(speed, lifted):
    falling = STILL._replace(left_speed=torch.tensor([[speed]]))
    assert (clock(0.0, 1, lean=falling)[0] > 0.5) is (lifted == "right")


def test_a_command_is_approached_at_its_rate():
    command = GAIT.ramp(NONE, torch.tensor([[1.0, -1.0, 0.001]]))
    most = STRIDE.acceleration * 0.02
    torch.testing.assert_close(command, torch.tensor([[most, -most, 0.001]]))


def foot(side: str, offsets: torch.Tensor) -> np.ndarray:
    """Where a sole is in the base, m, at home + offsets."""
    model = mujoco.MjModel.from_xml_path(str(ROBOT.model_path))
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:] = ROBOT.home_pos + offsets[0].numpy()
    mujoco.mj_kinematics(model, data)
    return data.site(f"{side}_foot").xpos.copy()


def offsets(phase: float, command: torch.Tensor = NONE, lean: Lean = STILL) -> torch.Tensor:
    return GAIT.offsets(torch.tensor([[phase]]), command, lean)


def test_at_rest_it_adds_nothing():
    assert max(offsets(phase, FORWARD).abs().max() for phase in (0.0, 0.5)) < 1e-12


def test_the_swinging_foot_is_lifted_and_the_other_is_not():
    rest = torch.zeros(1, 29)
    assert foot("left", offsets(0.25))[2] - foot("left", rest)[2] > 0.02
    assert foot("right", offsets(0.75))[2] - foot("right", rest)[2] > 0.02
    assert abs(foot("right", offsets(0.25))[2] - foot("right", rest)[2]) < 0.01


def test_a_standing_foot_goes_back_as_fast_as_the_robot_goes_aside_and_forwards_not_at_all():
    """From one end of the stance to the other."""
    left = torch.tensor([[0.0, 0.3, 0.0]])
    for command, speed, swept in (
        (FORWARD, {"forward_speed": 0.5}, [0.0, 0.0]),
        (left, {"left_speed": 0.3}, [0.0, 0.3]),
    ):
        on_time = STILL._replace(**{k: torch.tensor([[v]]) for k, v in speed.items()})
        rest = (foot("right", offsets(phase, NONE)) for phase in (0.01, 0.49))
        moved = (foot("right", offsets(phase, command, on_time)) for phase in (0.01, 0.49))
        (a, b), (c, d) = rest, moved
        assert ((c - d) - (a - b))[:2] / (0.48 * STRIDE.period) == pytest.approx(swept, abs=0.03)


def test_a_robot_faster_than_told_puts_its_foot_further():
    fast = STILL._replace(forward_speed=torch.tensor([[0.8]]), left_speed=torch.tensor([[0.5]]))
    further = foot("left", offsets(0.49, lean=fast)) - foot("left", offsets(0.49))
    assert further[0] > 0.005 and further[1] > 0.03


def test_a_standing_leg_turns_the_trunk_back_and_a_swinging_one_stays_below_it():
    pitched = STILL._replace(pitch=torch.tensor([[0.2]]))
    change = (offsets(0.25, lean=pitched) - offsets(0.25))[0]
    hip = {side: change[ROBOT.joint_names.index(f"{side}_hip_pitch_joint")].item() for side in ("left", "right")}
    assert hip["left"] == pytest.approx(-0.2)  # in the air
    assert hip["right"] == pytest.approx(0.2 * STRIDE.upright)


def test_the_lean_is_that_of_the_legs_that_stand():
    bend, rate = torch.zeros(1, 29), torch.zeros(1, 29)
    hip = ROBOT.joint_names.index("right_hip_pitch_joint")
    bend[0, hip], rate[0, hip] = 0.2, 1.0
    level, gyro = torch.tensor([[0.0, 0.0, -1.0]]), torch.zeros(1, 3)
    for phase, share in ((0.25, 1.0), (0.75, 0.0), (0.0, 0.5)):
        lean = GAIT.lean(torch.tensor([[phase]]), level, gyro, bend, rate)
        assert lean.forward.item() == pytest.approx(0.2 * share)
        assert lean.forward_speed.item() == pytest.approx(STRIDE.leg * share)
        assert lean.left.item() == 0.0


def test_the_mirror_image_of_a_step_is_the_other_step():
    index, sign = joint_mirror(ROBOT.joint_names)
    command = torch.tensor([[0.4, 0.2, 0.3]])
    lean = Lean(*(torch.tensor([[v]]) for v in (0.1, 0.05, 0.2, 0.1, 0.6, 0.3)))
    turned = Lean(lean.forward, -lean.left, lean.pitch, -lean.roll, lean.forward_speed, -lean.left_speed)
    one = offsets(0.2, command, lean)
    other = offsets(0.7, command * torch.tensor([1.0, -1.0, -1.0]), turned)
    torch.testing.assert_close(one[:, index] * torch.tensor(sign), other, atol=1e-6, rtol=0)


def test_a_loaded_leg_is_told_of_the_torque_that_holds_the_body_up():
    """Hip roll: the weight on an arm from the foot's line to the centre of mass up to the hip, about 0.11 m."""
    model = mujoco.MjModel.from_xml_path(str(ROBOT.model_path))
    loads = single_loads(model, ROBOT.home_pos, ROBOT.home_kp)
    roll = ROBOT.joint_names.index("left_hip_roll_joint")
    weight = float(model.body_subtreemass[1]) * 9.81
    assert loads[0, roll] * ROBOT.home_kp[roll] == pytest.approx(0.11 * weight, rel=0.1)
    index, sign = joint_mirror(ROBOT.joint_names)
    np.testing.assert_allclose(loads[0, index] * sign, loads[1], atol=0.01)
    assert all(loads[0, k] == 0.0 for k, name in enumerate(ROBOT.joint_names) if name.startswith("right"))


def test_its_settings_are_part_of_a_run_s():
    assert Basics().stride == STRIDE
