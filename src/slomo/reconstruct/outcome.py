"""From the fitted variables to metric key points at every frame, contacts, confidence and the figures of the report."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from slomo.reconstruct import losses, silhouette, standing
from slomo.reconstruct.kinematics import Posed
from slomo.reconstruct.problem import Draw, Problem, Variables
from slomo.reconstruct.run import Run
from slomo.reconstruct.trajectory import Guess

Array = np.ndarray

WHILE = 0.3  # s


@dataclass(frozen=True)
class Outcome:
    """names: N key points; keypoints (T, N, 3) m; confidence (T, N); contact (T, F); T_world_cam (T, 4, 4) m; body at
    every time, in the fit's units, of which `metres_per_unit` says the length."""

    names: tuple[str, ...]
    keypoints: Array
    confidence: Array
    contact: Array
    T_world_cam: Array
    body: Posed
    metres_per_unit: float
    report: dict[str, Any]


def assess(problem: Problem, run: Run, metres: float) -> Outcome:
    """Evaluate the winner at every frame and scale it so that its body is `metres` long."""
    obs, kin = problem.obs, problem.kin
    skeleton = kin.skeleton
    every = torch.arange(len(obs.t))
    with torch.no_grad():
        shape = {k.removeprefix("shape."): v for k, v in run.x.items() if k.startswith("shape.")}
        body, contact, _ = stood(problem, run.x, run.guess)
        R_cam, centre = problem.cameras(run.x["tilt"], every)
        own = own_length(problem, shape)
        per_unit = metres / own
        nodes = body.nodes[0].numpy().astype(float)
        error, frame_iou = _overlap(problem, run)
        low, low_at = lowest(frame_iou, obs.t.numpy()[obs.at.numpy()])
        confidence = _confidence(problem, body, R_cam, centre, frame_iou)
        loss, parts = problem.loss(run.x, run.guess, problem.draw(48, 400, torch.Generator().manual_seed(11)))
    T_world_cam = np.tile(np.eye(4), (len(obs.t), 1, 1))
    T_world_cam[:, :3, :3] = R_cam[0].transpose(-1, -2).numpy()
    T_world_cam[:, :3, 3] = centre[0].numpy() * per_unit
    keep = [m for m, n in enumerate(skeleton.names) if n != "tail_mid"]
    feet = nodes[:, list(skeleton.contacts)] * per_unit
    report = {
        "loss": round(float(loss[0]), 4),
        "losses": {k: round(float(v[0]), 4) for k, v in parts.items()},
        "silhouette_iou": round(float(np.nanmean(frame_iou)), 4),
        "silhouette_iou_low": round(low, 4),
        "silhouette_low_s": round(low_at, 2),
        "flow_residual_px": round(error, 3),
        "hypothesis": run.labels[0],
        "swap_margin": _swap_margin(run.log),
        "margin": _margin(run.log),
        "search": run.log,
        "foot_skate_mps": round(_skate(feet, contact, obs.t.numpy()), 4),
        "metres_per_unit": round(per_unit, 5),
        "tilt_deg": np.degrees(run.x["tilt"][0].numpy() * problem.tilt_spread).round(2).tolist(),
        "fit_frames": len(obs.at),
        "working_size": [obs.K.width, obs.K.height],
    }
    names = tuple(skeleton.names[m] for m in keep)
    return Outcome(names, nodes[:, keep] * per_unit, confidence[:, keep], contact, T_world_cam, body, per_unit, report)


def stood(problem: Problem, x: Variables, guess: Guess) -> tuple[Posed, Array, torch.Tensor]:
    """The body of one hypothesis at every frame with its feet held where they stand, the probability (T, F) that each
    stands, and its joint angles (1, T, B, 3)."""
    kin = problem.kin
    skeleton = kin.skeleton
    with torch.no_grad():
        shape = {k.removeprefix("shape."): v.detach() for k, v in x.items() if k.startswith("shape.")}
        length = shape["log_length"].exp()
        position, R, q = problem.path(x, guess, length, torch.arange(len(problem.obs.t)))
        free = kin.pose(shape, position, R, q).nodes[0].numpy().astype(float)
        t, feet = problem.obs.t.numpy().astype(float), free[:, list(skeleton.contacts)]
        contact = standing.contact_probability(
            feet, free[:, 0], t, length=own_length(problem, shape), leg=kin.leg, sole=skeleton.sole
        )
        ground = skeleton.sole * float(length[0])
        q = standing.stand(kin, shape, position, R, q, standing.places(feet, contact, t, ground))
        return kin.pose(shape, position, R, q), contact, q


def _margin(log: dict) -> float | None:
    """Relative loss by which the winner beat the runner-up among the rivals."""
    rivals = sorted(e["loss"] for e in log["rivals"])
    return round(rivals[1] / rivals[0] - 1, 4) if len(rivals) > 1 else None


def _swap_margin(log: dict) -> float | None:
    """Relative loss by which the winner beats its left-right opposite: among the rivals, else (where the opposite of
    another one was there) of its gait after the short fits; and, if that is less, the one with a pair of legs exchanged
    in the end, for all of the clip or between moments in which they meet. A person turned around is the one of the
    end, where there is one. None where nothing was compared."""
    chosen = _named(log["final"][0])
    rivals = [(_named(e), e["loss"]) for e in log["rivals"]]
    own = next(loss for name, loss in rivals if name == chosen)
    flips = [
        {k: v for k, v in chosen.items() if k != key} if chosen.get(key) == value else chosen | {key: value}
        for key, value in (("legs", "exchanged"), ("seen", "turned around"))
    ]
    other = [loss for name, loss in rivals if name in flips]
    if not other and chosen.get("gait", "none") != "none":
        own = next(e["loss"] for e in log["gait"] if _named(e) == chosen)
        other = [
            e["loss"] for e in log["gait"]
            if e["gait"] == chosen["gait"] and abs(abs(e["phase"] - chosen["phase"]) - 0.5) < 0.13
            and abs(e["stride_hz"] / chosen["stride_hz"] - 1) < 0.15
        ]  # fmt: skip
    best, *rest = log["limbs"]
    turned = [e for e in rest if e.get("seen") != best.get("seen")]
    margins = [min(other) / own - 1] if other and not turned else []
    opposite = [*turned, *(e for e in rest if e.get("exchanged") != best.get("exchanged"))]
    margins += [e["loss"] / best["loss"] - 1 for e in opposite]
    for phase in ("overtaking", "the other pair"):
        best, *rest = log.get(phase, [{}])
        margins += [e["picture"] / best["picture"] - 1 for e in rest]
    return round(min(margins), 4) if margins else None


def _named(entry: dict) -> dict:
    """What a hypothesis in the log is, without its loss."""
    return {k: v for k, v in entry.items() if k != "loss"}


def own_length(problem: Problem, shape: dict[str, torch.Tensor]) -> float:
    """Body length of the fitted shape at rest, world units: withers to tail base, or standing height."""
    skeleton = problem.kin.skeleton
    offset = problem.kin.offsets(shape)[0].numpy()
    p = np.zeros_like(offset)
    for m in range(1, len(p)):
        p[m] = p[skeleton.link[m]] + offset[m]
    if skeleton.length_between:
        a, b = (skeleton.index(n) for n in skeleton.length_between)
        return float(np.linalg.norm(p[a] - p[b]))
    sole = skeleton.sole * float(shape["log_length"].exp()[0])
    return float(p[:, 2].max() - np.mean([p[c, 2] for c in skeleton.contacts]) + sole)


def _skate(feet: Array, contact: Array, t: Array) -> float:
    """Mean horizontal speed m/s of feet while they stand."""
    v = np.linalg.norm(np.gradient(feet, t, axis=0)[..., :2], axis=-1)
    stands = contact > 0.5
    return float(v[stands].mean()) if stands.any() else 0.0


def lowest(iou: Array, t: Array) -> tuple[float, float]:
    """Least mean over `WHILE` of the IoU (F,) of frames at t (F,) s, and the middle of that time, s, where it is known
    of half of these frames at least; NaN where of none. What is wrong for half a second only, a raised leg that is
    fitted where the other one stands, hardly shows in the mean over a clip."""
    step = float(np.median(np.diff(t))) if len(t) > 1 else WHILE
    count = min(len(t), max(1, round(WHILE / step)))
    whiles = np.lib.stride_tricks.sliding_window_view(iou, count)
    known = (~np.isnan(whiles)).mean(1) >= 0.5
    if not known.any():
        return float("nan"), float("nan")
    mean = np.array([np.nanmean(w) if k else np.inf for w, k in zip(whiles, known, strict=True)])
    low = int(mean.argmin())
    return float(mean[low]), float(t[low : low + count][~np.isnan(whiles[low])].mean())


def _overlap(problem: Problem, run: Run) -> tuple[float, Array]:
    """Median flow error in decoded pixels, and silhouette IoU of each fit frame (F,), NaN where it shows no subject."""
    obs = problem.obs
    ious, errors = [], []
    pose = problem.pose(run.x, run.guess)
    look = lambda f, pixels: problem.state(  # noqa: E731
        run.x, run.guess, Draw(torch.tensor([f]), pixels, pixels.shape[1]), stance_weight=0.0, pose=pose
    )
    n = obs.mask.shape[1]
    pixels = torch.arange(n)[None]
    for f in range(len(obs.at)):
        inside = torch.nonzero(obs.mask[f])[:, 0][None]
        state = look(f, pixels)
        covered = state.sd[0, 0].amin(-1) < 0
        union = (covered | obs.mask[f]).sum()
        ious.append(float((covered & obs.mask[f]).sum() / union) if union and not obs.empty[f] else np.nan)
        if f == len(obs.at) - 1 or not inside.numel():
            continue
        state = look(f, inside)
        c, meets = silhouette.visible(obs.K, state.out, state.sd, state.h)
        X = silhouette.surface(obs.K, state.out, c, state.u, state.v)
        moved = losses.carry(state, torch.tensor([f]), c, X)[0, 0] - torch.stack([state.u[0], state.v[0]], -1)
        e = (moved - obs.flow[f][inside[0]]).norm(dim=-1)
        errors.append(e[obs.flow_ok[f][inside[0]] & meets[0, 0]].numpy() / obs.scale.mean())
    error = float(np.median(np.concatenate(errors))) if errors and sum(map(len, errors)) else float("nan")
    return error, np.array(ious)


def _confidence(problem: Problem, body: Posed, R_cam: torch.Tensor, centre: torch.Tensor, frame_iou: Array) -> Array:
    """(T, M) in [0, 1]: mask quality times overlap, less for a node that is hidden or lies outside the mask."""
    obs = problem.obs
    T = len(obs.t)
    u, v, z = silhouette.project(obs.K, silhouette.to_camera(R_cam, centre, body.nodes))
    a = silhouette.to_camera(R_cam, centre, body.a)
    b = silhouette.to_camera(R_cam, centre, body.b)
    o = silhouette.outline(obs.K, a, b, body.radii)
    sd, h = silhouette.distances(o, u[0], v[0])
    depth = o.za[:, :, None] + h * (o.zb - o.za)[:, :, None]
    length = float(body.length[0])
    # Hidden: some capsule covers the node's pixel well in front of it (its own flesh is within a tenth of the body).
    hidden = ((sd < 0) & (depth < z[..., None] - 0.12 * length)).any(-1)[0].numpy()
    near = np.abs(np.arange(T)[:, None] - obs.at.numpy()[None]).argmin(1)
    grid = torch.stack([u[0] * (2 / (obs.K.width - 1)) - 1, v[0] * (2 / (obs.K.height - 1)) - 1], -1)[:, :, None]
    edge = torch.nn.functional.grid_sample(obs.edge[near], grid, padding_mode="border", align_corners=True)[:, 0, :, 0]
    outside = np.clip(edge.numpy() / 4.0, 0, 1)
    shown = (grid.abs() < 1).all(-1)[..., 0].numpy()
    frame = obs.quality.numpy()[near] * np.nan_to_num(frame_iou, nan=0.0)[near]
    return frame[:, None] * np.where(hidden, 0.55, 1.0) * (1 - 0.7 * outside) * np.where(shown, 1.0, 0.3)
