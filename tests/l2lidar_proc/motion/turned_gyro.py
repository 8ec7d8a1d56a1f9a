"""A gyro that is turned about three axes, and poses that tell how."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from l2lidar_node.types import F64, IMU_SAMPLE
from l2lidar_proc.motion.gyro_alignment import GyroModel

EPOCH = 1_700_000_000_000_000_000
TRUE = GyroModel.of(
    np.array([0.02, -0.03, 0.05, 0.004, -0.003, 0.002, 1e-3, -2e-3, 1e-3, 0.01, -0.02, 0.03, 4e-3])
)
ALL = (1.0, 0.8, 1.3)


def orientation(t: F64, axes: tuple[float, ...]) -> Rotation:
    """Turn about three axes at frequencies that do not keep step; smooth."""
    angles = [
        a * np.sin(2 * np.pi * f * t + f) for a, f in zip(axes, (0.41, 0.53, 0.37), strict=True)
    ]
    return Rotation.from_euler("xyz", np.stack(angles, axis=-1))


def recording(
    axes: tuple[float, ...] = ALL, noise: float = 0.0, seed: int = 0, seconds: float = 30.0
) -> tuple[NDArray[np.int64], F64, NDArray[np.void]]:
    """Return stamps and orientations of poses, and what a gyro such as TRUE measures."""
    source = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.004)
    h = 1e-5
    q = orientation(t, axes)
    rate = (orientation(t - h, axes).inv() * orientation(t + h, axes)).as_rotvec() / (2 * h)
    samples = np.zeros(len(t), IMU_SAMPLE)
    samples["stamp"] = EPOCH + np.round((t + TRUE.offset_s) * 1e9).astype(np.int64)
    mixing = np.linalg.inv(TRUE.unmixing)
    samples["angular_velocity"] = rate @ TRUE.rotation @ mixing.T + TRUE.bias
    samples["angular_velocity"] += 30.0 * noise * source.standard_normal(rate.shape)
    every = 57
    poses = q[::every] * Rotation.from_rotvec(noise * source.standard_normal((len(t[::every]), 3)))
    wxyz = np.roll(poses.as_quat(), 1, axis=1)
    return EPOCH + np.round(t[::every] * 1e9).astype(np.int64), wxyz, samples
