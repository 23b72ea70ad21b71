"""What a solve works on: its unknowns and multipliers, and its scratch memory."""

from typing import NamedTuple, Self

import numpy as np

Array = np.ndarray


class Iterate(NamedTuple):
    """Unknowns, the contact forces that follow from them, and multipliers.

    Attributes:
        qs: (N + 1, 7 + 3 C), vs: (N + 1, 6 + 3 C), us: (N, nu) as in `cost.Task`.  lam: (N, C, 3) N.
        multiplier: (N + 1, M) of `constraints`.  cone: (N, C) of friction cones.  closing: (nx,) of `closing.end_gap`.
        loads: (N, J), speeds: (N + 1, J) of `load`.  beyond: (N + 1, M) of `reach`.
    """

    qs: Array
    vs: Array
    us: Array
    lam: Array
    multiplier: Array
    cone: Array
    closing: Array
    loads: Array
    speeds: Array
    beyond: Array

    @classmethod
    def at(cls, qs: Array, vs: Array, us: Array, *, C: int, M: int) -> Self:
        """An iterate at copies of these, for C points and M constraints, with no forces and multipliers yet."""
        z, N = np.zeros, len(us)
        qs, vs, us = (np.array(x, float, order="C") for x in (qs, vs, us))
        return cls(
            qs, vs, us, z((N, C, 3)), z((N + 1, M)), z((N, C)), z(12 + 6 * C), z((N, 0)), z((N + 1, 0)), z((N + 1, 0))
        )

    def copy(self) -> Self:
        """A deep copy."""
        return type(self)(*(x.copy() for x in self))

    def fitting(self, *, loads: int, speeds: int, beyond: int) -> Self:
        """A deep copy for so many limits of joints and half-spaces; multipliers of new ones are 0."""
        z, N = np.zeros, len(self.us)
        it = self.copy()
        if it.loads.shape[1] != loads:
            it = it._replace(loads=z((N, loads)))
        if it.speeds.shape[1] != speeds:
            it = it._replace(speeds=z((N + 1, speeds)))
        return it._replace(beyond=np.column_stack([it.beyond, z((N + 1, beyond - it.beyond.shape[1]))]))


class Work(NamedTuple):
    """Everything else that a solve writes to.

    Attributes:
        A, B, D: derivatives of the dynamics.  Lx, Lu, Lt: gradients of the cost (Lt: of a cyclic end by the start).
        K: (N, nu, nx) feedback gains; Kt: those on the first state, of a cyclic motion.  k: (N, nu) feed-forward.
        dx, du: the Newton step.  gap: (N, nx) defects of the dynamics.  trial, trial_gap: after a step.
        end: (nx,) gap of a cyclic motion.  q1, v1: one state.
    """

    A: Array
    B: Array
    D: Array
    Lx: Array
    Lu: Array
    Lt: Array
    K: Array
    Kt: Array
    k: Array
    dx: Array
    du: Array
    gap: Array
    trial: Iterate
    trial_gap: Array
    end: Array
    q1: Array
    v1: Array

    @classmethod
    def make(cls, it: Iterate, *, cyclic: bool = False) -> Self:
        """Memory for an iterate of this size."""
        N, nu = it.us.shape
        nv = it.vs.shape[1]
        nx, C = 2 * nv, it.lam.shape[1]
        z = np.zeros
        return cls(
            A=z((N, nx, nx)), B=z((N, nx, nu)), D=z((C, 3, 10)), Lx=z((N + 1, nx)), Lu=z((N, nu)), Lt=z(nx),
            K=z((N, nu, nx)), Kt=z((N if cyclic else 0, nu, nx)), k=z((N, nu)), dx=z((N + 1, nx)), du=z((N, nu)),
            gap=z((N, nx)), trial=it.copy(), trial_gap=z((N, nx)), end=z(nx), q1=z(nv + 1), v1=z(nv),
        )  # fmt: skip
