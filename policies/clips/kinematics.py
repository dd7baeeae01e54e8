"""Rotations, forward kinematics and rates of sampled motion. Quaternions are (w, x, y, z)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def quaternion_from_rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """(..., 3) rad -> (..., 4)."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), rotation * np.sinc(angle / (2 * np.pi)) / 2], axis=-1)


def rotation_vector_from_quaternion(q: np.ndarray) -> np.ndarray:
    """(..., 4) -> (..., 3) rad, the shorter way round (at most pi)."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions (..., 4)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return np.concatenate([aw * bw - (av * bv).sum(-1, keepdims=True), aw * bv + bw * av + np.cross(av, bv)], axis=-1)


def conjugate(q: np.ndarray) -> np.ndarray:
    """The inverse of a unit quaternion (..., 4)."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def heading(q: np.ndarray) -> np.ndarray:
    """(...,) rad about the vertical: where a body of orientation (..., 4) in the world looks."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned by quaternions (..., 4)."""
    t = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * t + np.cross(q[..., 1:], t)


def matrix_from_quaternion(q: np.ndarray) -> np.ndarray:
    """(..., 4) -> (..., 3, 3), columns the turned axes."""
    return np.stack([rotate(q, np.broadcast_to(axis, (*q.shape[:-1], 3))) for axis in np.eye(3)], axis=-1)


def quaternion_from_matrix(m: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 4) with w >= 0. S. W. Shepperd, J. Guidance and Control 1 (1978): by the largest component."""
    d = np.diagonal(m, axis1=-2, axis2=-1)
    trace = d.sum(-1)
    squares = np.stack([1 + trace, *(1 + 2 * d[..., i] - trace for i in range(3))], axis=-1)  # 4 w^2, 4 x^2, ...
    anti = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    products = np.empty((*m.shape[:-2], 4, 4))
    products[..., 0, 1:] = products[..., 1:, 0] = anti
    products[..., 1:, 1:] = m + np.swapaxes(m, -1, -2)
    products[..., range(4), range(4)] = squares
    row = np.take_along_axis(products, squares.argmax(-1)[..., None, None], axis=-2)[..., 0, :]
    q = row / np.linalg.norm(row, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def frame(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotation (..., 3, 3) whose z is along ``up`` and whose y is as near to ``left`` (..., 3) as that allows."""
    z = unit(up)
    x = unit(np.cross(left, z))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def unit(v: np.ndarray) -> np.ndarray:
    """(..., n) scaled to length 1; zero stays zero."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def forward(
    root_position: np.ndarray, rotation_vectors: np.ndarray, offsets: np.ndarray, parents: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Forward kinematics of a tree of ball joints.

    ``root_position`` (T, 3) m; ``rotation_vectors`` (T, B, 3) rad, the root's in the world and every other's in its
    parent; ``offsets`` (B, 3) m; ``parents`` (B,), each before its child. Returns positions (T, B, 3) m and orientations
    (T, B, 4), both in the world.
    """
    local = quaternion_from_rotation_vector(rotation_vectors)
    positions = np.empty(rotation_vectors.shape)
    orientations = np.empty(local.shape)
    positions[:, 0], orientations[:, 0] = root_position, local[:, 0]
    for body, parent in enumerate(parents):
        if parent >= 0:
            orientations[:, body] = multiply(orientations[:, parent], local[:, body])
            positions[:, body] = positions[:, parent] + rotate(orientations[:, parent], offsets[body])
    return positions, orientations


def rate(x: np.ndarray, fps: float) -> np.ndarray:
    """Time derivative of samples (T, ...) by central differences, one-sided at the ends."""
    return np.gradient(x, 1 / fps, axis=0) if len(x) > 1 else np.zeros_like(x)


def angular_velocity_in_world(q: np.ndarray, fps: float) -> np.ndarray:
    """Of orientations (T, 4) -> (T, 3) rad/s; no jump where a rotation vector would wrap at pi or a sign flips."""
    if len(q) < 2:
        return np.zeros((len(q), 3))
    step = rotation_vector_from_quaternion(multiply(q[1:], conjugate(q[:-1]))) * fps
    return np.concatenate([step[:1], (step[1:] + step[:-1]) / 2, step[-1:]])


def smooth(x: np.ndarray, width: float) -> np.ndarray:
    """Gaussian of standard deviation ``width`` frames along the first axis; the ends are continued point-symmetrically,
    so that a constant rate stays one."""
    reach = min(int(np.ceil(3 * width)), len(x) - 1)
    if width <= 0 or reach < 1:
        return x.copy()
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    before = 2 * x[:1] - x[reach:0:-1]
    after = 2 * x[-1:] - x[-2 : -reach - 2 : -1]
    padded = np.concatenate([before, x, after])
    weights = kernel / kernel.sum()
    return np.sum([w * padded[i : i + len(x)] for i, w in enumerate(weights)], axis=0)


def smooth_orientation(q: np.ndarray, width: float) -> np.ndarray:
    """``smooth`` for orientations (T, 4): neighbours are close, so their normalised mean is their mean rotation."""
    return unit(smooth(continuous(q), width))


def continuous(q: np.ndarray) -> np.ndarray:
    """The same orientations (T, 4), with signs such that neighbours are on the same half of the sphere."""
    sign = np.cumprod(np.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0))
    return q * np.concatenate([[1.0], sign])[:, None]
