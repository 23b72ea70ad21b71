"""A batch of roll-outs as one differentiable function: torch tensors in, places of the nodes out."""

from dataclasses import dataclass, fields

import numpy as np
import torch
import warp as wp

from slomo.gravity import GRAVITY
from slomo.reconstruct.physics import kernel
from slomo.reconstruct.physics.model import Body

Tensor = torch.Tensor


@dataclass(frozen=True)
class Controls:
    """What a batch of N windows of S steps is simulated with. SI units, z up.

    Attributes:
        target: (N, S + 1, B, 3) rad, joint angles that the controllers track (`kinematics.joint_rotation`).
        position: (N, 3), quaternion: (N, 4) xyzw, velocity: (N, 3), spin: (N, 3) of the root at the start; the joints
            start at their targets.
        mass_scale: (N, B) of the link masses. ke: (N,) N/m and kd: (N,) s/m of the ground. gravity: (N,) m/s^2.
        assistance: (N,) share of the pull of the root towards the guide.
        guide_position: (N, S + 1, 3) m, guide_quaternion: (N, S + 1, 4) xyzw.
    """

    target: Tensor
    position: Tensor
    quaternion: Tensor
    velocity: Tensor
    spin: Tensor
    mass_scale: Tensor
    ke: Tensor
    kd: Tensor
    gravity: Tensor
    assistance: Tensor
    guide_position: Tensor
    guide_quaternion: Tensor


@dataclass(frozen=True)
class Watched:
    """What there is to see of a roll-out besides the nodes. N windows, S steps.

    Attributes:
        p, v, w: (N, S + 1, B, 3) m, m/s, rad/s of the links' origins. q: (N, S + 1, B, 4) xyzw.
        force: (N, S, C, 3) N of the ground on the contact points. wrench: (N, S, 2, 3) N, N m of the assistance.
    """

    p: np.ndarray
    v: np.ndarray
    q: np.ndarray
    w: np.ndarray
    force: np.ndarray
    wrench: np.ndarray


LEARNED = tuple(f.name for f in fields(Controls))[:9]
_TYPES = {
    "target": wp.vec3, "position": wp.vec3, "quaternion": wp.quat, "velocity": wp.vec3, "spin": wp.vec3,
    "mass_scale": wp.float32, "contact": wp.vec2, "gravity": wp.float32, "assistance": wp.float32,
    "guide_position": wp.vec3, "guide_quaternion": wp.quat,
}  # fmt: skip
_HISTORY = {
    "p": (wp.vec3, 1), "v": (wp.vec3, 1), "q": (wp.quat, 1), "w": (wp.vec3, 1), "A": (wp.mat33, 0),
    "G": (wp.mat33, 0), "M": (wp.mat33, 0), "n": (wp.vec3, 0), "f": (wp.vec3, 0), "D": (wp.mat33, 0),
    "E": (wp.mat33, 0), "u": (wp.vec3, 0), "alpha": (wp.vec3, 0), "a": (wp.vec3, 0),
}  # fmt: skip


class RollOut:
    """Simulates N windows of S steps of `dt` s and watches the nodes at moments `step` (N, F), in steps.

    Its buffers are used again by every call, so a call's gradient must be taken before the next call.
    """

    def __init__(self, body: Body, step: np.ndarray, *, steps: int, dt: float, device: str = "cpu"):
        self.body, self.steps, self.dt, self.device = body, steps, dt, device
        self.N, self.F = step.shape
        B, C, M = len(body.parent), len(body.contact_link), len(body.link)
        m, weight, L = body.mechanics, body.weight, body.length
        pace = np.sqrt(L / GRAVITY)
        stiffness = m.stiffness * weight * L
        pull = m.pull * weight / L
        damp = 2 * np.sqrt(m.pull) * weight / L * pace
        with wp.ScopedDevice(device):
            s = kernel.BodyStruct()
            i32 = lambda x: wp.array(np.asarray(x, np.int32), dtype=int)  # noqa: E731
            f32 = lambda x, t: wp.array(np.asarray(x, np.float32), dtype=t)  # noqa: E731
            s.parent = i32(body.parent)
            s.offset = f32(body.offset[:B], wp.vec3)
            s.com, s.inertia = f32(body.com, wp.vec3), f32(body.inertia, wp.mat33)
            s.mass = f32(body.mass, float)
            s.stiffness = f32(np.full(B, stiffness), float)
            s.damping = f32(np.full(B, m.damping * stiffness * pace), float)
            s.contact_start = i32(np.searchsorted(body.contact_link, np.arange(B + 1)))
            s.contact_place, s.contact_radius = f32(body.contact_place, wp.vec3), f32(body.contact_radius, float)
            s.friction, s.creep, s.round = m.mu, m.creep * np.sqrt(GRAVITY * L), m.round * L
            s.pull = wp.vec4(pull, damp, 0.1 * pull * L**2, 0.1 * damp * L**2)
            self._struct = s
            self._look = [f32(body.offset, wp.vec3), i32(body.link), B, f32(step, float)]
            make = lambda n, k, t: wp.zeros((self.N, n, k), dtype=t, requires_grad=True)  # noqa: E731
            self._history = {k: make(steps + more, B, t) for k, (t, more) in _HISTORY.items()}
            self._forces = {k: make(steps, n, wp.vec3) for k, n in dict(touch=C, grip=C, wrench=2).items()}
            self._nodes = make(self.F, M, wp.vec3)
        self._inputs: list[wp.array] = []

    def __call__(self, controls: Controls) -> Tensor:
        """(N, F, M, 3) m, differentiable in `LEARNED`."""
        return _Function.apply(self, *(getattr(controls, f.name) for f in fields(Controls)))  # pyright: ignore

    def forward(self, values: dict[str, Tensor]) -> Tensor:
        with wp.ScopedDevice(self.device):
            self._inputs = [
                wp.from_torch(v.detach().to(self.device, torch.float32).contiguous(), dtype=_TYPES[k],
                              requires_grad=k not in ("assistance", "guide_position", "guide_quaternion"))
                for k, v in values.items()
            ]  # fmt: skip
            for k in "AGMnf":  # they add up
                self._history[k].zero_()
            self._launch(adjoint=False)
            return wp.to_torch(self._nodes).detach().cpu().clone()

    def backward(self, grad: Tensor) -> dict[str, Tensor]:
        with wp.ScopedDevice(self.device):
            for x in (*self._history.values(), *self._forces.values(), *self._inputs):
                if x.grad is not None:
                    x.grad.zero_()
            wp.to_torch(_grad(self._nodes)).copy_(grad)
            self._launch(adjoint=True)
            inputs = zip(_TYPES, self._inputs, strict=True)
            return {k: wp.to_torch(_grad(x)).cpu().clone() for k, x in inputs if x.requires_grad}

    def _launch(self, *, adjoint: bool) -> None:
        h = self._history
        roll_out = (
            kernel.roll_out, self.N, [self._struct, self.steps, self.dt, *self._inputs],
            [*h.values(), *self._forces.values()],
        )  # fmt: skip
        look = kernel.look, (self.N, self.F, len(self.body.link)), [*self._look, h["p"], h["q"]], [self._nodes]
        for which, dim, inputs, outputs in (look, roll_out) if adjoint else (roll_out, look):
            grads = [[x.grad if isinstance(x, wp.array) else x for x in xs] for xs in (inputs, outputs)]
            more = dict(adj_inputs=grads[0], adj_outputs=grads[1]) if adjoint else {}
            wp.launch(which, dim, inputs, outputs, adjoint=adjoint, **more)  # pyright: ignore[reportArgumentType]

    def watched(self) -> Watched:
        """Everything about the last call."""
        h = {k: self._history[k].numpy() for k in ("p", "v", "q", "w", "alpha", "a")}
        R = _rotate(h["q"][:, :-1][:, :, self.body.contact_link], self.body.contact_place)
        link = self.body.contact_link
        w, alpha, a = h["w"][:, :-1, link], h["alpha"][:, :, link], h["a"][:, :, link]
        acceleration = a + np.cross(alpha, R) + np.cross(w, np.cross(w, R))
        force = self._forces["touch"].numpy() - self.dt * self._forces["grip"].numpy() * acceleration
        return Watched(h["p"], h["v"], h["q"], h["w"], force, self._forces["wrench"].numpy())


def _grad(x: wp.array) -> wp.array:
    assert x.grad is not None
    return x.grad


def _rotate(q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Vectors x (C, 3) turned by quaternions q (..., C, 4) xyzw."""
    v, w = q[..., :3], q[..., 3:]
    t = 2 * np.cross(v, x)
    return x + w * t + np.cross(v, t)


class _Function(torch.autograd.Function):
    @staticmethod
    def forward(ctx, roll: RollOut, *values: Tensor) -> Tensor:
        named = dict(zip((f.name for f in fields(Controls)), values, strict=True))
        contact = torch.stack([named.pop("ke"), named.pop("kd")], -1)
        named["contact"] = contact
        ctx.roll = roll
        return roll.forward({k: named[k] for k in _TYPES})

    @staticmethod
    def backward(ctx, *grads: Tensor):
        g = ctx.roll.backward(grads[0])
        ke, kd = g.pop("contact").unbind(-1)
        g |= dict(ke=ke, kd=kd)
        return (None, *(g.get(f.name) for f in fields(Controls)))
