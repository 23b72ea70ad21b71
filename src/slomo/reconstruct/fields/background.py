"""What colour a ray sees behind the subject: a network of where it meets the ground, of its direction, and a little of
where the camera is.

A point of the ground has one colour from wherever it is seen, which serves moving cameras; the direction serves what is
far and cameras that only turn; the camera's place lets what stands between the two shift slowly. The cameras are the
estimated ones without the fit's tilt, so the background says nothing about the pose by itself.
"""

import cv2
import numpy as np
import torch

from slomo.pinhole import ground_points
from slomo.reconstruct.fields.networks import Variables, encode
from slomo.reconstruct.observations import Observations
from slomo.reconstruct.trajectory import mlp

Array = np.ndarray
Tensor = torch.Tensor


def colours(frames: Array, obs: Observations) -> Tensor:
    """(F, n, 3) sRGB in [0, 1] of decoded frames (T, H, W, 3) uint8 at the fit frames and the working resolution."""
    size = (obs.K.width, obs.K.height)
    small = [cv2.resize(frames[int(k)], size, interpolation=cv2.INTER_AREA) for k in obs.at]
    return torch.as_tensor(np.stack(small).reshape(len(small), -1, 3), dtype=torch.float32) / 255


class Background:
    """The geometry of rays against the ground and the far; the network's weights are among the variables."""

    def __init__(self, obs: Observations, frequencies: int):
        K, at = obs.K, obs.at.numpy()
        T = obs.T_world_cam[at]
        self.K, self.frequencies = K, frequencies
        middle = np.stack([(obs.box[:, 0] + obs.box[:, 2]) / 2, obs.box[:, 3]], -1)
        feet = np.stack([ground_points(K, M, u, v) for M, (u, v) in zip(T, middle, strict=True)])[:, :2]
        feet = feet[~obs.empty & np.isfinite(feet).all(-1)]
        place = T[:, :3, 3]
        # Where no foot of a ray lies on the ground (camera at its level) the camera's surroundings serve as well.
        self.origin = np.append(np.median(feet, 0) if len(feet) else place[:, :2].mean(0), 0.0)
        # A unit is half a picture's width: at the subject's distance on the ground, and among directions.
        half = 0.5 * K.width / K.fx
        self.unit = max(1e-6, half * float(np.median(np.linalg.norm(place - self.origin, axis=1))))
        f = lambda x: torch.as_tensor(x, dtype=torch.float32)  # noqa: E731
        ahead = T[:, :3, 2].mean(0)
        yaw = np.arctan2(ahead[1], ahead[0])
        level = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        self.R = f(level.T @ T[:, :3, :3])
        self.place = f((place - self.origin) @ level / self.unit)
        self.half = half

    def features(self, k: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """(N, D) of pixels u, v (N,) of fit frames k (N,)."""
        K, R, o = self.K, self.R.to(u.device), self.place.to(u.device)
        ray = torch.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, torch.ones_like(u)], -1)
        d = (R[k] @ ray[..., None])[..., 0]
        d = d / d.norm(dim=-1, keepdim=True)
        o = o[k]
        meets = (d[:, 2] < -1e-3) & (o[:, 2] > 0)
        far = torch.where(meets, -o[:, 2] / torch.where(meets, d[:, 2], -1), 0)
        g = o[:, :2] + far[:, None] * d[:, :2]
        # Contraction of the plane to a disc of radius 2 (Barron et al. 2022, eq. 10).
        r = g.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        g = torch.where(r > 1, (2 - 1 / r) * g / r, g) * meets[:, None]
        angle = torch.stack([torch.atan2(d[:, 1], d[:, 0]), torch.asin(d[:, 2].clamp(-1, 1))], -1) / self.half
        n = self.frequencies
        return torch.cat([encode(g, n), encode(angle, n), encode(o, 2), meets[:, None].float()], 1)

    def colour(self, variables: Variables, k: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """(N, 3) sRGB in [0, 1]."""
        return torch.sigmoid(mlp(variables, "F.background", self.features(k, u, v))[0])
