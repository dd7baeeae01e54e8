"""Clips as moving pictures: the person as a stick figure, the robot as itself, with the ball, side by side in one GIF.

Needs an OpenGL that works without a screen: ``MUJOCO_GL=egl`` or ``osmesa``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from policies.ball import NAME, ball
from policies.clips import skeleton
from policies.clips.feasibility import place
from policies.clips.format import Clip, ClipError
from policies.clips.kinematics import heading, smooth
from policies.clips.resample import resample
from policies.clips.robot import RobotBody
from policies.clips.targets import scaled_ball

SIZE = (240, 240)  # pixels of one picture: width, height
FPS = 20.0
BONE, SKIN, TOUCH = (0.25, 0.45, 0.75, 1.0), (0.16, 0.30, 0.52, 1.0), (0.90, 0.20, 0.15, 1.0)
ROBOT_GROUP = 1
SWATCHES = ((217, 102, 31), (230, 51, 38), (64, 115, 191), (245, 245, 245))  # colours a palette must not lose
DRAWN = [i for i, name in enumerate(skeleton.BODIES) if not name.endswith(("2", "3")) or name == "Spine2"]


class Scene:
    """Draws frames of clips. One renderer for all."""

    def __init__(self, body: RobotBody | None, ball_radius: float):
        spec = mujoco.MjSpec.from_file(str(body.robot.model_path)) if body else _bare()
        ball(0.002, radius=ball_radius)(spec)
        self.body = body
        self.model = spec.compile()
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = SIZE
        self.model.vis.quality.shadowsize = 1024  # an OpenGL in software draws at a few frames per second
        robot = (self.model.geom_bodyid != 0) & (self.model.geom_bodyid != self.model.body(NAME).id)
        self.model.geom_group[robot & (self.model.geom_group < 3)] = ROBOT_GROUP
        self.data = mujoco.MjData(self.model)
        self.with_robot, self.without_robot = mujoco.MjvOption(), mujoco.MjvOption()
        self.without_robot.geomgroup[ROBOT_GROUP] = 0
        try:
            self.renderer = mujoco.Renderer(self.model, SIZE[1], SIZE[0])
        except Exception as error:  # whatever the OpenGL in use raises
            raise ClipError(f"no pictures without OpenGL ({error}); set MUJOCO_GL=egl, or MUJOCO_GL=osmesa") from None

    def robot(self, clip: Clip, t: int, camera: mujoco.MjvCamera) -> np.ndarray:
        """(height, width, 3) uint8: frame ``t`` of a robot clip."""
        assert self.body is not None
        place(self.model, self.data, clip, self.body, t)
        return self._render(clip, camera, self.with_robot, lambda scene: None)

    def human(self, clip: Clip, t: int, camera: mujoco.MjvCamera) -> np.ndarray:
        """(height, width, 3) uint8: frame ``t`` of a human clip, hands red while they touch the ball."""
        self.data.qpos[:3] = clip.base_position_in_world[t]  # lights follow whatever body there is
        self.data.qpos[-7:-4] = clip.ball_position_in_world[t]
        mujoco.mj_kinematics(self.model, self.data)
        return self._render(clip, camera, self.without_robot, lambda scene: _bones(scene, clip, t))

    def _render(
        self,
        clip: Clip,
        camera: mujoco.MjvCamera,
        options: mujoco.MjvOption,
        add: Callable[[mujoco.MjvScene], None],
    ) -> np.ndarray:
        if not clip.header.has_ball:
            self.data.qpos[-5] = -5.0
            mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self.renderer.update_scene(self.data, camera, options)
        add(self.renderer.scene)
        return self.renderer.render()

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()


def _bare() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], rgba=[0.7, 0.72, 0.75, 1], conaffinity=0
    )
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0.2, 0.3, -1])
    spec.worldbody.add_body(name="absent").add_freejoint()
    spec.bodies[-1].mass, spec.bodies[-1].inertia, spec.bodies[-1].explicitinertial = 1, [1, 1, 1], True
    return spec


def _bones(scene: mujoco.MjvScene, clip: Clip, t: int) -> None:
    s = clip.header.length_scale
    points = clip.points_in_world[t]
    touching = [clip.contact[t, k] for k in range(2)]
    for i in DRAWN[1:]:
        hand = next((k for k, ids in enumerate(skeleton.HANDS) if i in ids), None)
        colour = TOUCH if hand is not None and touching[hand] else BONE
        _capsule(scene, points[skeleton.PARENTS[i]], points[i], (0.012 if hand is not None else 0.035) * s, colour)
    head = points[skeleton.INDEX["Head"]]
    _capsule(scene, head, head + (0, 0, 0.05 * s), 0.085 * s, SKIN)


def _capsule(scene: mujoco.MjvScene, a: np.ndarray, b: np.ndarray, radius: float, colour: tuple) -> None:
    if scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.zeros(9), np.array(colour, dtype=np.float32))
    mujoco.mjv_connector(geom, capsule, radius, np.asarray(a, float), np.asarray(b, float))
    scene.ngeom += 1


def scaled(clip: Clip, scale: float, ball_radius: float, fps: float) -> Clip:
    """A human ``clip`` at the robot's size and time, so that one can look at both with one camera."""
    clip = resample(clip, fps, slower=float(np.sqrt(scale)))
    return Clip(
        clip.header.model_copy(update={"length_scale": scale, "ball_radius": ball_radius}),
        base_position_in_world=scale * clip.base_position_in_world,
        base_orientation_in_world=clip.base_orientation_in_world,
        joint_pos=clip.joint_pos,
        points_in_world=scale * clip.points_in_world,
        ball_position_in_world=scaled_ball(clip.ball_position_in_world, scale, ball_radius),
        ball_velocity_in_world=scale * clip.ball_velocity_in_world,
        contact=clip.contact,
    )


def side_by_side(human: Clip, robot: Clip, body: RobotBody, path: str | Path) -> None:
    """Write a GIF: left the person at the robot's size and time, right the robot. Raises ClipError without OpenGL."""
    person = scaled(human, robot.header.length_scale, robot.header.ball_radius, robot.fps)
    scene = Scene(body, robot.header.ball_radius)
    pictures = []
    for t, camera in _cameras(robot):
        left, right = (scene.human(person, min(t, len(person) - 1), camera), scene.robot(robot, t, camera))
        pictures.append(np.concatenate([left, right], axis=1))
    scene.close()
    write_gif(pictures, path, f"{robot.header.skill}  {robot.name}")


def view(clip: Clip, path: str | Path, body: RobotBody | None = None) -> None:
    """Write a GIF of one clip; of a robot's, ``body`` must be that robot's. Raises ClipError without OpenGL."""
    scene = Scene(body, clip.header.ball_radius)
    draw = scene.robot if body else scene.human
    pictures = [draw(clip, t, camera).copy() for t, camera in _cameras(clip)]
    scene.close()
    write_gif(pictures, path, f"{clip.header.skill}  {clip.name}")


def _cameras(clip: Clip) -> list[tuple[int, mujoco.MjvCamera]]:
    """The frames to draw and where from: from the front left, following the body slowly."""
    at = smooth(clip.base_position_in_world, clip.fps / 3)
    yaw = np.degrees(heading(clip.base_orientation_in_world[0]))
    tall = 0.85 if clip.header.body == "human" and clip.header.length_scale == 1 else 0.65
    thrown = clip.header.has_ball and clip.ball_position_in_world[:, 2].max() > 2 * tall
    height = 1.3 * tall if thrown else tall
    shots = []
    for t in np.arange(0, len(clip), clip.fps / FPS).astype(int):
        camera = mujoco.MjvCamera()
        camera.lookat[:] = *at[t, :2], height
        camera.azimuth, camera.elevation, camera.distance = yaw + 145, -12, 3.6 * height
        shots.append((int(t), camera))
    return shots


def write_gif(pictures: list[np.ndarray], path: str | Path, caption: str) -> None:
    """Write (height, width, 3) uint8 ``pictures`` as a GIF at ``FPS`` with a caption and one palette."""
    frames = [Image.fromarray(p) for p in pictures]
    for frame in frames:
        ImageDraw.Draw(frame).text((6, 4), caption, fill=(30, 30, 30))
    sample = Image.new("RGB", (frames[0].width, frames[0].height + 40 * len(SWATCHES)))
    sample.paste(frames[len(frames) // 2], (0, 0))
    for k, colour in enumerate(SWATCHES):
        for shade in range(8):
            box = (shade * 40, frames[0].height + 40 * k, shade * 40 + 40, frames[0].height + 40 * k + 40)
            sample.paste(tuple(int(c * (0.3 + 0.1 * shade)) for c in colour), box)
    palette = sample.quantize(64, method=Image.Quantize.MEDIANCUT)
    frames = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=round(1000 / FPS), loop=0, optimize=True)
