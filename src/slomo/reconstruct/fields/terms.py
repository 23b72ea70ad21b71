"""The evidence of the fields: terms of one rendering, with the signature of all evidence (see `losses`)."""

from dataclasses import replace
from functools import partial

import torch

from slomo.reconstruct.fields import networks
from slomo.reconstruct.fields.background import Background
from slomo.reconstruct.fields.canonical import Capsules
from slomo.reconstruct.fields.config import FieldsConfig
from slomo.reconstruct.fields.device import CPU, on
from slomo.reconstruct.fields.networks import Variables
from slomo.reconstruct.fields.render import Rendered, mean, render
from slomo.reconstruct.kinematics import Kinematics
from slomo.reconstruct.losses import FLOW_PX
from slomo.reconstruct.observations import Observations
from slomo.reconstruct.state import State, Term

Tensor = torch.Tensor

NOISE = 0.02  # colour differences below this are noise, of a range of 1
STEP = 0.005  # body lengths, of finite differences of the distance
BEHIND = 64  # background pixels of a frame at most in one evaluation


class Fields:
    """The neural model of one clip: creates its variables, renders a state once, and offers the terms.

    Args:
        images: (F, n, 3) sRGB in [0, 1] of the fit frames, see `background.colours`.
        device: where networks live and rays are rendered. States are given, and terms returned, on the CPU.
    """

    def __init__(
        self, config: FieldsConfig, obs: Observations, kin: Kinematics, images: Tensor,
        device: torch.device = CPU,
    ):  # fmt: skip
        self.config, self.device = config, device
        seen = {k: on(getattr(obs, k), device) for k in ("at", "quality", "flow", "flow_ok")}
        self.obs, self.kin, self.images = replace(obs, **seen), on(kin, device), images.to(device)
        self.background = Background(obs, config.background_frequencies)
        self._moved: tuple[State, State] | None = None  # the last state given, and that state on the device
        self._rendered: tuple[State, Rendered] | None = None

    def variables(self, generator: torch.Generator) -> Variables:
        """Everything the fields learn; see `networks.variables`."""
        capsules, joints = len(self.kin.c_link), self.kin.B - 1
        new = networks.variables(self.config, capsules=capsules, joints=joints, generator=generator)
        return self.placed(new)

    def placed(self, x: Variables) -> Variables:
        """All of a fit's variables, those of the fields on the device."""
        return {k: v.to(self.device) if k.startswith(networks.PREFIX) else v for k, v in x.items()}

    def terms(self) -> dict[str, Term]:
        """The terms by name; all of them share the rendering of a state."""
        each = {
            "colour": self.colour, "opacity": self.opacity, "field_flow": self.flow, "eikonal": self.eikonal,
            "cycle": self.cycle, "background": self.behind, "residual": self.residual,
        }  # fmt: skip
        return {name: partial(self._evaluated, term) for name, term in each.items()}

    def _evaluated(self, term: Term, given: State) -> Tensor:
        """A term of a state that is on the CPU; the state goes to the device once for all terms."""
        if self._moved is None or self._moved[0] is not given:
            drawn = {k: on(v, self.device) for k, v in vars(given).items() if k not in ("obs", "kin", "x")}
            own = {k: v for k, v in given.x.items() if k.startswith(networks.PREFIX)}
            self._moved = given, State(obs=self.obs, kin=self.kin, x=own, **drawn)
        return term(self._moved[1]).to(given.u.device)

    def rendered(self, s: State) -> Rendered:
        """The rendering of a state, made when it is first asked for."""
        if self._rendered is None or self._rendered[0] is not s:
            self._rendered = s, render(s, self.config)
        return self._rendered[1]

    def _pixels(self, s: State, r: Rendered) -> tuple[Tensor, Tensor, Tensor]:
        """Fit frame, flat pixel and weight (R,) of the rendered rays."""
        k = s.seen[r.rays.frame]
        return k, s.pixel[r.rays.frame, r.rays.chosen[r.rays.column]], s.obs.quality[k]

    def colour(self, s: State) -> Tensor:
        """Rendered colour, body in front of the background, against the picture; robust, in tenths of the range."""
        r = self.rendered(s)
        k, pixel, w = self._pixels(s, r)
        drawn = r.rays.chosen[r.rays.column]
        with torch.no_grad():
            behind = self.background.colour(dict(s.x), k, s.u[r.rays.frame, drawn], s.v[r.rays.frame, drawn])
        seen = r.colour + (1 - r.opacity)[:, None] * behind
        error = (seen - self.images[k, pixel]).square().mean(-1)
        total = s.obs.quality[s.seen].sum() * len(r.rays.chosen)
        return (10 * w * ((error + NOISE**2).sqrt() - NOISE)).sum()[None] / (total + 1e-6)

    def opacity(self, s: State) -> Tensor:
        """Rendered silhouette against the mask, mask and background weighted alike (class balanced)."""
        r = self.rendered(s)
        full = torch.zeros(len(s.seen), len(r.rays.chosen), device=s.u.device)
        full = full.index_put((r.rays.frame, r.rays.column), r.opacity)
        w, n = s.obs.quality[s.seen][:, None], r.rays.inside
        total = w.sum() + 1e-6
        miss = ((1 - full[:, :n]) * w).sum() / (total * max(n, 1))
        extra = (full[:, n:] * w).sum() / (total * max(full.shape[1] - n, 1))
        return (miss + extra)[None]

    def flow(self, s: State) -> Tensor:
        """Rendered flow to the next fit frame against the optical flow; robust as `losses.flow`."""
        r = self.rendered(s)
        k, pixel, quality = self._pixels(s, r)
        use = (k < len(s.obs.at) - 1) & (r.rays.column < r.rays.inside)
        k, pixel, quality = k[use], pixel[use], quality[use]
        error = ((r.flow[use] - s.obs.flow[k, pixel]).square().sum(-1) + FLOW_PX**2).sqrt() - FLOW_PX
        size = 2.0 + s.obs.flow_size
        w = quality * s.obs.flow_ok[k, pixel].float() * r.opacity[use].detach()
        e = size * (1 - torch.exp(-error / size))
        return ((e * w).sum() / (w.sum() + 0.05 * len(w) + 1e-6) / (1.0 + 0.25 * s.obs.flow_size))[None]

    def eikonal(self, s: State) -> Tensor:
        """The gradient of the signed distance is 1 long near the surface (Gropp et al. 2020), by differences to the
        corners of a tetrahedron around each point, which costs no second derivative."""
        r = self.rendered(s)
        x = r.queried[:, 0].detach()
        corners = x.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * STEP
        c = r.rest.capsules
        fixed = Capsules(c.a.detach(), c.b.detach(), c.radii.detach())
        points = (x[:, None] + corners).flatten(0, 1)
        sdf = fixed.union(points) + networks.residual(dict(s.x), points, self.config.frequencies)[0]
        gradient = sdf.reshape(-1, 4) @ corners / (4 * STEP**2)
        length = (gradient.square().sum(-1) + 1e-8).sqrt()
        return mean((length - 1).square())[None]

    def cycle(self, s: State) -> Tensor:
        """Points come back to where they were after the way to rest and back, in fiftieths of the body length."""
        r = self.rendered(s)
        w = r.queried_weight.detach()
        return (w * r.cycle / 0.02**2).sum()[None] / (w.sum() + 1e-6)

    def behind(self, s: State) -> Tensor:
        """Colour of the background model against the drawn pixels outside the mask, in tenths of the range."""
        columns = slice(s.inside, s.inside + BEHIND)
        u, v, pixel = (y[:, columns].flatten() for y in (s.u, s.v, s.pixel))
        k = s.seen.repeat_interleave(len(pixel) // len(s.seen))
        error = (self.background.colour(dict(s.x), k, u, v) - self.images[k, pixel]).square().mean(-1)
        w = s.obs.quality[k]
        return (10 * w * ((error + NOISE**2).sqrt() - NOISE)).sum()[None] / (w.sum() + 1e-6)

    def residual(self, s: State) -> Tensor:
        """What the networks add to the capsules and to the Gaussian bones stays small: distance in 0.03 body lengths,
        logits in units of 3, near the surface."""
        r = self.rendered(s)
        w = r.weight.detach()
        near = (w * (r.residual / 0.03).square()).sum() / (w.sum() + 1e-6)
        return (near + r.delta / 9)[None]
