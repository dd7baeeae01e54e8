"""The ball bounces as recorded: dropped from many heights, at every time step in use."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from drivers.sim.plant import Plant
from policies.ball import CONTACTS, MASS, NAME, RADIUS, ball, contact

HEIGHTS = np.linspace(0.3, 1.2, 46)  # m; one height would only measure the phase of its impact within a step


def rebounds(timestep: float, **properties) -> np.ndarray:
    """Coefficient of restitution of a drop from each of HEIGHTS on the robot's own floor, sqrt(rebound / drop)."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], conaffinity=0)
    spec.option.timestep, spec.option.integrator = timestep, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ball(timestep, **properties)(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    return np.array([rebound(model, data, h, properties.get("radius", RADIUS)) for h in HEIGHTS])


def rebound(model: mujoco.MjModel, data: mujoco.MjData, height: float, radius: float) -> float:
    mujoco.mj_resetData(model, data)
    data.qpos[2] = height + radius
    while data.qpos[2] > radius or data.qvel[2] < 0:
        mujoco.mj_step(model, data)
    while data.qvel[2] > 0:
        mujoco.mj_step(model, data)
    return float(np.sqrt((data.qpos[2] - radius) / height))


@pytest.mark.parametrize(("timestep", "spread"), [(0.002, 0.03), (0.005, 0.05), (0.00833, 0.055)])
def test_bounces_like_the_recorded_ball(timestep, spread):
    restitution = rebounds(timestep)
    assert restitution.mean() == pytest.approx(0.80, abs=0.015)
    assert abs(restitution - 0.80).max() < spread


@pytest.mark.parametrize("wanted", [0.7, 0.75, 0.85, 0.9])
def test_restitution_can_be_randomised(wanted):
    assert rebounds(0.005, restitution=wanted).mean() == pytest.approx(wanted, abs=0.02)


@pytest.mark.parametrize("properties", [{"mass": 0.3}, {"mass": 1.2}, {"radius": 0.12}])
def test_mass_and_size_do_not_change_the_bounce(properties):
    assert rebounds(0.005, **properties).mean() == pytest.approx(0.80, abs=0.015)


def test_a_contact_spans_five_steps():
    """Fewer, and the ball can gain energy."""
    for timestep, law in CONTACTS.items():
        assert np.pi / np.sqrt(law.stiffness) / timestep >= 5


@pytest.mark.parametrize(
    ("call", "message"), [((0.02,), "timestep"), ((0.005, 0.0), "restitution"), ((0.005, 1.0), "restitution")]
)
def test_refuses_what_cannot_bounce(call, message):
    with pytest.raises(ValueError, match=message):
        contact(*call)


def test_joins_a_robot(robot):
    """In the plant of every robot: after the robot's coordinates, with its mass, and it rolls nowhere by itself."""
    plant = Plant(
        robot.model_path, robot.joint_names, robot.base, timestep=0.002, prepare=ball(0.002, position=(1.5, 0, RADIUS))
    )
    model, data = plant.model, plant.data
    assert model.body(NAME).mass[0] == pytest.approx(MASS)
    assert model.joint(NAME).qposadr[0] == model.nq - 7
    assert data.body(NAME).xpos == pytest.approx([1.5, 0, RADIUS], abs=1e-6)
    for _ in range(250):
        plant.step()
    assert data.body(NAME).xpos[2] == pytest.approx(RADIUS, abs=2e-3)
    assert np.linalg.norm(data.body(NAME).xpos[:2] - [1.5, 0]) < 1e-3


def test_touches_floor_hands_and_feet(robot):
    """Whatever a robot's own contact bits are, its colliding geoms stop the ball: of a hand, the box that is all of it."""
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    ball(0.002)(spec)
    model = spec.compile()
    ours = model.geom(NAME).id
    solid = [g for g in range(model.ngeom) if g != ours and (model.geom_contype[g] or model.geom_conaffinity[g])]
    assert solid
    deaf = [
        model.geom(g).name
        for g in solid
        if not (
            model.geom_contype[ours] & model.geom_conaffinity[g] or model.geom_contype[g] & model.geom_conaffinity[ours]
        )
    ]
    whole = {model.geom(g).bodyid[0] for g in solid if model.geom(g).name in ("left_palm", "right_palm")}
    assert [name for name in deaf if model.geom(name).bodyid[0] not in whole] == []
