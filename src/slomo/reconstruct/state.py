"""One evaluation of the fit, as its terms see it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from torch import Tensor

from slomo.reconstruct.kinematics import Kinematics, Posed
from slomo.reconstruct.observations import Observations
from slomo.reconstruct.silhouette import Outline


@dataclass(frozen=True)
class State:
    """One evaluation of H hypotheses.

    Attributes:
        body: posed at the F fit frames. q: (H, F, B, 3). R_root: (H, F, 3, 3).
        shape: the unit-normal shape variables. tilt: (H, 2) unit-normal camera tilt.
        R_cam, centre: (H, F, 3, 3) world to camera, (H, F, 3).
        seen: frames drawn for image terms (S,), as positions among the fit frames; u, v: (S, P) px, flat index
            `pixel`; the first `inside` of P lie in the mask. out: outline of the capsules there; sd, h: (H, S, P, C).
        near, least, nearest: (H, S, P) smooth minimum and minimum of sd over the capsules, and where that is.
        ends: camera-frame capsule ends (H, F, C, 3) a and b.
        stance: (H, F-1, L) hypothetical contact times its present weight; negative where there is none.
        x: all variables by name, for terms that have some of their own.
    """

    obs: Observations
    kin: Kinematics
    body: Posed
    q: Tensor
    R_root: Tensor
    shape: dict[str, Tensor]
    tilt: Tensor
    R_cam: Tensor
    centre: Tensor
    seen: Tensor
    u: Tensor
    v: Tensor
    pixel: Tensor
    inside: int
    out: Outline
    sd: Tensor
    h: Tensor
    near: Tensor
    least: Tensor
    nearest: Tensor
    ends: tuple[Tensor, Tensor]
    stance: Tensor
    x: Mapping[str, Tensor]


Term = Callable[[State], Tensor]
