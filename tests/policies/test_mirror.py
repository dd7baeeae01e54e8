"""The mirror: an involution, true to the physics, and exactly obeyed by actor and critic."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from policies.basics import Basics
from policies.env import Env
from policies.mirror import action_mirror, joint_mirror, observation_mirror
from policies.physics import training_model
from policies.train import make_ppo, networks
from sim2real.config import load_robot

CONFIG = Basics(envs=4, hidden=(32, 16))


def turn(x: torch.Tensor, mirror: tuple[list[int], list[float]]) -> torch.Tensor:
    return x[..., mirror[0]] * torch.tensor(mirror[1], dtype=x.dtype)


def test_mirroring_twice_is_nothing():
    env = Env(CONFIG, seed=0)
    mirror = observation_mirror(env.graph)
    assert len(mirror[0]) == env.observation.shape[1]
    torch.testing.assert_close(turn(turn(env.observation, mirror), mirror), env.observation)


def test_actor_turns_over_with_its_observation_and_the_critic_does_not_care():
    env = Env(CONFIG, seed=0)
    torch.manual_seed(0)
    ppo = make_ppo(CONFIG, env)
    for parameter in ppo.actor.parameters():
        parameter.data.add_(0.1 * torch.randn_like(parameter))
    actor, critic = networks(ppo)
    with torch.no_grad():
        image = turn(env.observation, observation_mirror(env.graph))
        torch.testing.assert_close(actor(image), turn(actor(env.observation), action_mirror(env.graph)))
        torch.testing.assert_close(critic(image), critic(env.observation))
        assert actor(env.observation).abs().max() > 0.1


def test_the_mirror_image_of_a_motion_is_a_motion():
    """A robot that falls freely, told mirrored targets from a mirrored pose, ends in the mirror image of where it would."""
    robot = load_robot("g1")
    model = training_model(robot, robot.home_kp, robot.home_kd, 0.005)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    index, sign = joint_mirror(robot.joint_names)
    rng = np.random.default_rng(0)
    pose, target = robot.home_pos + rng.uniform(-0.1, 0.1, (2, model.nu))
    ends = []
    for flip in (False, True):
        data = mujoco.MjData(model)
        data.qpos[:] = [0, 0, 1, 1, 0, 0, 0, *(pose[index] * sign if flip else pose)]
        data.ctrl[:] = target[index] * sign if flip else target
        mujoco.mj_step(model, data, 40)
        joint_pos = data.qpos[7:]
        ends.append(joint_pos[index] * sign if flip else joint_pos.copy())
    np.testing.assert_allclose(ends[0], ends[1], atol=5e-3)  # the maker's left and right inertias differ a little
    assert np.abs(ends[0] - pose).max() > 0.05
