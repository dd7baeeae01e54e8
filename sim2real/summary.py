"""What a run amounted to: fell or not, distance, velocity, ticks, faults, margins. One JSON-able object."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from sim2real.config import RobotConfig, Wiring
from sim2real.skills import SkillPlayer
from sim2real.types import Mode


@dataclass
class Summary:
    """Distances and velocities are ground truth of a simulation and absent (None) on hardware.

    ``mean_velocity``: forward, left (m/s) in the yaw frame and turn (rad/s), from ``settled`` seconds after the policy
    took over. ``joint_margin``: the closest any joint came to its mechanical range (rad; negative: beyond).
    """

    robot: str
    duration: float  # s under the policy
    fell: bool | None = None
    fell_at: float | None = None
    distance: float | None = None
    lateral: float | None = None
    mean_velocity: list[float] | None = None
    ticks: int = 0
    late_ticks: int = 0
    policy_ticks: int = 0
    late_policy_ticks: int = 0
    faults: list[str] = field(default_factory=list)
    refused_skills: list[str] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    joint_margin: float = np.inf
    joint_margin_of: str = ""
    torque_max: float = 0.0
    torque_max_of: str = ""
    torque_share: float = 0.0  # of that joint's limit
    temperature_max: float | None = None  # deg C; None: no motor reports any
    temperature_max_of: str = ""
    bus_load_max: float = 0.0
    frames_lost: int = 0
    real_time_factor: float | None = None
    wire_sha256: str = ""
    record: str = ""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


class Measures:
    """Accumulates a Summary. ``tick`` sees every guardian record, ``observe`` the body at the policy rate."""

    settled = 2.0  # s after the policy took over from which velocities count

    def __init__(self, config: RobotConfig, wiring: Wiring, player: SkillPlayer):
        self._config = config
        n = len(config.joint_names)
        self._lowest, self._highest = np.full(n, np.inf), np.full(n, -np.inf)  # rad, where joints were in RUN
        self._torque = np.zeros(n)
        self._temperature = np.full(n, -np.inf)
        self._load = np.zeros(len(wiring.buses))
        self._faults: list[str] = []
        self._fault = 0
        self._ticks = self._late = self._lost = self._policy_ticks = self._policy_late = 0
        self._start: tuple[np.ndarray, float] | None = None
        self._end: np.ndarray | None = None
        self._sum = np.zeros(3)
        self._count = 0
        self._since = 0.0
        self._fell_at: float | None = None
        self._seen_body = False

    def tick(self, r: np.ndarray) -> None:
        if int(r["mode"][0]) == Mode.RUN:  # numpy takes twenty times as long to compare its own number with a Mode
            pos = r["state.joint_pos"][0]
            np.fmin(self._lowest, pos, out=self._lowest)
            np.fmax(self._highest, pos, out=self._highest)
        np.fmax(self._torque, np.abs(r["state.joint_torque"][0]), out=self._torque)
        np.fmax(self._temperature, r["state.joint_temperature"][0], out=self._temperature)
        np.fmax(self._load, r["bus.load"][0], out=self._load)
        fault = int(r["fault"][0])
        if fault and fault != self._fault:
            joint = int(r["fault_joint"][0])
            self._faults.append(f"S2R-{fault:03d}" + (f" {self._config.joint_names[joint]}" if joint >= 0 else ""))
        self._fault = fault
        self._ticks, self._late, self._lost = int(r["tick"][0]) + 1, int(r["late"][0]), sum(r["bus.lost"][0].tolist())

    def observe(self, world: Any, tick: np.ndarray, pilot: np.ndarray, since: float) -> None:
        self._policy_ticks, self._policy_late = int(pilot["tick"][0]) + 1, int(pilot["late"][0])
        if since < 0 or int(tick["mode"][0]) not in (Mode.RUN, Mode.HOLD):
            return
        truth = world.truth()
        self._seen_body = True
        self._since = since
        yaw = yaw_of(truth.orientation_base_in_world)
        if self._start is None:
            self._start = (truth.position_base_in_world.copy(), yaw)
        self._end = truth.position_base_in_world.copy()
        if truth.fallen and self._fell_at is None:
            self._fell_at = since
        if since >= self.settled:
            v, c, s = truth.velocity_base_in_world, np.cos(yaw), np.sin(yaw)
            self._sum += (c * v[0] + s * v[1], c * v[1] - s * v[0], truth.angular_velocity_base_in_base[2])
            self._count += 1

    def summary(self, messages: list[str], player: SkillPlayer, **more: Any) -> Summary:
        names = self._config.joint_names
        margins = np.minimum(self._lowest - self._config.position_min, self._config.position_max - self._highest)
        margin, torque, hot = (
            int(np.argmin(margins)),
            int(np.argmax(self._torque)),
            int(np.argmax(self._temperature)),
        )
        measured = bool(np.isfinite(self._temperature[hot]))
        out = Summary(
            robot=self._config.name,
            duration=self._since,
            ticks=self._ticks,
            late_ticks=self._late,
            policy_ticks=self._policy_ticks,
            late_policy_ticks=self._policy_late,
            faults=self._faults,
            refused_skills=[f"{r.skill}: {r.reason}" for r in player.refusals],
            messages=list(messages),
            joint_margin=float(margins[margin]),
            joint_margin_of=names[margin],
            torque_max=float(self._torque[torque]),
            torque_max_of=names[torque],
            torque_share=float(self._torque[torque] / self._config.torque_max[torque]),
            temperature_max=float(self._temperature[hot]) if measured else None,
            temperature_max_of=names[hot] if measured else "",
            bus_load_max=float(self._load.max()),
            frames_lost=self._lost,
            **more,
        )
        if self._seen_body and self._start is not None and self._end is not None:
            (origin, yaw), end = self._start, self._end
            d = end - origin
            out.distance = float(d[0] * np.cos(yaw) + d[1] * np.sin(yaw))
            out.lateral = float(d[1] * np.cos(yaw) - d[0] * np.sin(yaw))
            out.mean_velocity = [float(v) for v in self._sum / self._count] if self._count else None
            out.fell, out.fell_at = self._fell_at is not None, self._fell_at
        return out


def yaw_of(q: np.ndarray) -> float:
    """Heading (rad) of a quaternion (w, x, y, z)."""
    return float(np.arctan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] ** 2 + q[3] ** 2)))
