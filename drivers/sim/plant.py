"""The body of the simulated robot: a MuJoCo model whose joints are driven by motors and whose base carries an IMU.

The model's own actuators, sensors and keyframes are replaced: every
joint named gets one motor with the law ``torque = bias - kp q - kd dq``, clipped to the joint's torque limit and
evaluated by MuJoCo inside every substep, implicitly in velocity (``implicitfast``). A real motor runs that law at
10 kHz or more, so sampling kd once in 2 ms would be the cruder model.

Not modelled: flexible links, backlash, friction that depends on load or temperature, supply voltage, torque that falls
with speed, contact compliance other than MuJoCo's.
"""

# MuJoCo ships no types.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from drivers.bus import BusError
from drivers.sim.ball import ball_of
from drivers.sim.gantry import Gantry
from drivers.sim.truth import Truth

IMU_SITE = "sim2real/imu"
UNLIMITED = 1e6  # N m


class Plant:
    """A MuJoCo body. ``joints``: which joints have motors, in which order all (n,) arrays are. ``base``: its root body.

    ``prepare`` may alter the ``mujoco.MjSpec`` before it is compiled (randomisation, objects). ``imu_site`` places the
    IMU; its axes are those of the body that carries the site. Without a plane in the model a floor is laid at z = 0.
    """

    def __init__(
        self,
        model_path: str | Path,
        joints: Sequence[str],
        base: str,
        timestep: float = 0.002,
        prepare: Callable[[mujoco.MjSpec], None] | None = None,
        imu_site: str = "",
    ):
        spec = mujoco.MjSpec.from_file(str(model_path))
        if prepare is not None:
            prepare(spec)
        _fit(spec, model_path, joints, base, imu_site)
        spec.option.timestep = timestep
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.model = model = spec.compile()
        self.data = data = mujoco.MjData(model)
        self.joints = tuple(joints)
        self.timestep = timestep
        ids = self._joint_ids = np.array([model.joint(name).id for name in joints])
        self._qpos_at, self._qvel_at = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
        self._base = model.body(base).id
        first = model.body_jntadr[self._base]
        self.floating = bool(first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE)
        self._free_qpos = int(model.jnt_qposadr[first]) if self.floating else -1
        self._free_qvel = int(model.jnt_dofadr[first]) if self.floating else -1
        self._root = int(model.body_rootid[self._base])
        self._robot = np.flatnonzero(model.body_rootid == self._root)
        self._hook_body = int(self._robot[np.argmax(model.body_mass[self._robot])])  # a humanoid's torso
        self._hook_in_body = np.zeros(3)
        mass = float(model.body_subtreemass[self._root])
        self.gantry = Gantry(mass)
        # Plain views: an attribute of MjData costs half a microsecond, an array does not.
        self._ctrl, self._bias = data.ctrl, model.actuator_biasprm
        self._force, self._sensors = data.actuator_force, data.sensordata
        self._bolted = bool(model.body_weldid[model.site(IMU_SITE).bodyid[0]] == 0)
        self._qpos, self._qvel = data.qpos, data.qvel
        self._stood = 0.0
        self.ball = ball_of(model, data)
        self.limit(np.full(len(joints), UNLIMITED))
        self.reset()

    # -- driving -----------------------------------------------------------------------------------------------------

    def drive(self, bias: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> None:
        """From now on every joint's motor gives ``bias - kp q - kd dq``; (n,) N m, N m/rad, N m s/rad."""
        self._ctrl[:] = bias
        np.negative(kp, out=self._bias[:, 1])
        np.negative(kd, out=self._bias[:, 2])

    def limit(self, torque: np.ndarray) -> None:
        """Let no motor give more than ``torque`` (n,) N m, nor more than the model allows its joint."""
        most = np.minimum(torque, self.torque_max)
        self.model.actuator_forcerange[:] = np.stack([-most, most], axis=1)

    def step(self) -> None:
        """One substep. Afterwards every position, velocity and sensor belongs to the new time."""
        if self.gantry.engaged:
            self._pull()
        mujoco.mj_step2(self.model, self.data)
        mujoco.mj_step1(self.model, self.data)

    def push(self, velocity_delta: Sequence[float]) -> None:
        """Change the velocity of a floating base at once; ``velocity_delta`` (3,) m/s in the world."""
        if not self.floating:
            raise BusError(f"push: the base of {self.joints[0]}... is bolted to the world; expected a free joint")
        self._qvel[self._free_qvel : self._free_qvel + 3] += np.asarray(velocity_delta, float)
        mujoco.mj_step1(self.model, self.data)

    def pull(self, joint: str, torque: float) -> None:
        """A hand on one joint: N m about it from now on; 0: it lets go."""
        self.data.qfrc_applied[self._qvel_at[self.joints.index(joint)]] = torque

    def weight_on(self, joint: str) -> tuple[float, float]:
        """What a hand on a joint feels: the torque (N m) that keeps it from falling, and its inertia where it was built
        (kg m^2).
        """
        at = int(self._qvel_at[self.joints.index(joint)])
        return float(self.data.qfrc_bias[at]), float(self.model.dof_M0[at])

    def release(self) -> None:
        """Unhook the gantry."""
        self.gantry.release()
        self.data.xfrc_applied[self._hook_body] = 0.0

    # -- placing -----------------------------------------------------------------------------------------------------

    def reset(
        self,
        joint_pos: Mapping[str, float] | Sequence[float] | np.ndarray | None = None,
        *,
        hang: float | None = None,
        noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        """At rest at ``joint_pos`` ((n,) rad, or by name, else the model's own) plus uniform ``noise`` rad, upright.

        A floating base is lowered until its lowest point touches the floor; with ``hang`` it is hung from the gantry
        with that much air (m) below.
        """
        mujoco.mj_resetData(self.model, self.data)
        q = self._qpos[self._qpos_at].copy()
        if isinstance(joint_pos, Mapping):
            for name, value in joint_pos.items():
                if name in self.joints:
                    q[self.joints.index(name)] = value
        elif joint_pos is not None:
            q[:] = joint_pos
        q += np.random.default_rng(seed).uniform(-noise, noise, len(q)) if noise else 0.0
        self._qpos[self._qpos_at] = q
        mujoco.mj_kinematics(self.model, self.data)
        if self.floating:
            self._qpos[self._free_qpos + 2] -= self._lowest() - (hang or 0.0)
        zero = np.zeros(len(self.joints))
        self.drive(zero, zero, zero)
        self.data.xfrc_applied[:] = 0.0
        self.gantry.release()
        mujoco.mj_forward(self.model, self.data)
        self._stood = float(self.data.subtree_com[self._root][2]) - (hang or 0.0)
        if hang is not None and self.floating:
            com = self.data.subtree_com[self._root] + np.array([0.0, 0.0, 0.3])
            frame = self.data.xmat[self._hook_body].reshape(3, 3)
            self._hook_in_body = frame.T @ (com - self.data.xpos[self._hook_body])
            self.gantry.hang(com)

    def _lowest(self) -> float:
        """Height of the lowest point of the robot's colliding geoms (their boxes: exact for spheres and boxes), m."""
        m, d = self.model, self.data
        solid = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
        solid[m.pair_geom1], solid[m.pair_geom2] = True, True
        geoms = np.flatnonzero(np.isin(m.geom_bodyid, self._robot) & solid)
        if not len(geoms):
            return 0.0
        down = d.geom_xmat[geoms][:, 6:9]  # third row of each rotation
        centre, half = m.geom_aabb[geoms, :3], m.geom_aabb[geoms, 3:]
        return float((d.geom_xpos[geoms, 2] + (down * centre).sum(1) - (abs(down) * half).sum(1)).min())

    def _pull(self) -> None:
        b, d = self._hook_body, self.data
        hook = d.xpos[b] + d.xmat[b].reshape(3, 3) @ self._hook_in_body
        spin = d.cvel[b, :3]
        velocity = d.cvel[b, 3:] + _cross(spin, hook - d.subtree_com[self._root])
        force, torque = self.gantry.wrench(hook, velocity, spin, d.xmat[b, 2::3], self.timestep)
        d.xfrc_applied[b, :3] = force
        d.xfrc_applied[b, 3:] = torque + _cross(hook - d.xipos[b], force)

    # -- reading -----------------------------------------------------------------------------------------------------

    @property
    def joint_pos(self) -> np.ndarray:
        """(n,) rad."""
        return self._qpos.take(self._qpos_at)

    @property
    def joint_vel(self) -> np.ndarray:
        """(n,) rad/s."""
        return self._qvel.take(self._qvel_at)

    @property
    def joint_torque(self) -> np.ndarray:
        """(n,) N m the motors gave in the last substep."""
        return self._force

    @property
    def torque_max(self) -> np.ndarray:
        """(n,) N m the model allows each joint (``actuatorfrcrange``); inf where it says nothing."""
        ids = self.model.actuator_trnid[:, 0]
        most = np.abs(self.model.jnt_actfrcrange[ids]).min(axis=1)
        return np.where(self.model.jnt_actfrclimited[ids] != 0, most, np.inf)

    def gravity_torque(self, joint_pos: np.ndarray, orientation_base_in_world: np.ndarray) -> np.ndarray:
        """N m (n,) that keep each joint at rest at ``joint_pos`` (n,), for limbs whose ends touch nothing, with the base
        turned by the quaternion (4,) w, x, y, z. Moves the plant there."""
        self.reset(joint_pos)
        if self.floating:
            self._qpos[self._free_qpos + 3 : self._free_qpos + 7] = orientation_base_in_world
        mujoco.mj_forward(self.model, self.data)
        return self.data.qfrc_bias[self._qvel_at].copy()

    @property
    def friction(self) -> np.ndarray:
        """(n,) N m of dry friction in each joint."""
        return self.model.dof_frictionloss[self._qvel_at]

    @property
    def axes_in_base(self) -> np.ndarray:
        """(n, 3) the axis of each joint where the plant is now, in the base's frame."""
        return self.data.xaxis[self._joint_ids] @ self.data.xmat[self._base].reshape(3, 3)

    @property
    def orientation_imu_in_world(self) -> np.ndarray:
        """(4,) w, x, y, z; the axes of the body that carries the IMU."""
        return self._sensors[0:4]

    @property
    def angular_velocity_imu_in_imu(self) -> np.ndarray:
        """(3,) rad/s."""
        return self._sensors[4:7]

    @property
    def acceleration_imu_in_imu(self) -> np.ndarray:
        """(3,) m/s^2, +g upwards at rest; of the last substep."""
        if self._bolted:  # MuJoCo says nothing about bodies that cannot move
            return self.data.site(IMU_SITE).xmat.reshape(3, 3).T @ -self.model.opt.gravity
        return self._sensors[7:10]

    @property
    def tilt(self) -> float:
        """rad between the base's up and the world's."""
        return float(np.arccos(min(max(self.data.xmat[self._base, 8], -1.0), 1.0)))

    @property
    def fallen(self) -> bool:
        """The centre of mass is below a third of the height at which it stood at reset, or the base leans by more than 1 rad.

        Not the base's height: some makers put its frame on the floor. Not half of it: who picks something up is as low."""
        return bool(self.floating and (self.data.subtree_com[self._root, 2] < self._stood / 3 or self.tilt > 1.0))

    def truth(self) -> Truth:
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_XBODY, self._base, velocity, 0)
        spin = self.data.xmat[self._base].reshape(3, 3).T @ velocity[:3]
        return Truth(
            time=float(self.data.time),
            position_base_in_world=self.data.xpos[self._base].copy(),
            orientation_base_in_world=self.data.xquat[self._base].copy(),
            velocity_base_in_world=velocity[3:].copy(),
            angular_velocity_base_in_base=spin,
            tilt=self.tilt,
            fallen=self.fallen,
            position_object_in_world=self.ball.position if self.ball else None,
            velocity_object_in_world=self.ball.velocity if self.ball else None,
        )


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """As numpy's, which spends 20 us on the general case."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _fit(spec: mujoco.MjSpec, path: str | Path, joints: Sequence[str], base: str, imu_site: str) -> None:
    """Swap the model's actuators, sensors and keyframes for our motors and IMU, and lay a floor if there is none."""
    for old in (*spec.keys, *spec.sensors, *spec.actuators):
        spec.delete(old)
    known = {j.name for j in spec.joints}
    if missing := [name for name in joints if name not in known]:
        raise BusError(f"{path}: no joint {missing}, expected the joints of the wiring; it has {sorted(known)}")
    if spec.body(base) is None:
        raise BusError(f"{path}: no body '{base}' (the base); it has {[b.name for b in spec.bodies]}")
    for name in joints:
        motor = spec.add_actuator(name=f"sim2real/{name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = 1.0
        motor.ctrllimited, motor.forcelimited = False, True
        motor.forcerange = (-UNLIMITED, UNLIMITED)
    body, place = spec.body(base), np.zeros(3)
    if imu_site:
        site = spec.site(imu_site)
        if site is None:
            raise BusError(f"{path}: no site '{imu_site}' (the IMU); it has {[s.name for s in spec.sites]}")
        body, place = site.parent, site.pos
    body.add_site(name=IMU_SITE, pos=place)
    kinds = mujoco.mjtSensor
    for kind in (kinds.mjSENS_FRAMEQUAT, kinds.mjSENS_GYRO, kinds.mjSENS_ACCELEROMETER):
        spec.add_sensor(name=f"{IMU_SITE}/{kind.name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=IMU_SITE)
    if not any(g.type == mujoco.mjtGeom.mjGEOM_PLANE for g in spec.worldbody.geoms):
        spec.worldbody.add_geom(name="sim2real/floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05))
