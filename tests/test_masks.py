"""Masks: the user's own, the motion segmenter on clips with known answers, and the errors."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from slomo.errors import InvalidData, UsageError
from slomo.packed import pack, unpack
from slomo.reconstruct import decode_stage
from slomo.reconstruct.flow import dense_flow
from slomo.reconstruct.instances_motion import SharedMotion
from slomo.reconstruct.motion_segment import border_distance
from slomo.reconstruct.passing import give_back_what_passes
from slomo.reconstruct.segment import component_at, frame_certainty, frame_quality
from slomo.reconstruct.stage import MasksConfig, run_masks
from slomo.reconstruct.surroundings import _staying, give_back_patches, give_back_surroundings
from slomo.reconstruct.votes import vote_over_time
from slomo.stage import Artifact, Inputs, Silent

SHARED = Path(__file__).parents[2] / "shared"
ASSET = Path(__file__).parents[1] / "src/slomo/assets/walk"


def iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a & b).sum((1, 2)) / np.maximum((a | b).sum((1, 2)), 1)


def noise(h: int, w: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.uniform(0, 255, (h // s + 1, w // s + 1, 3)).astype(np.float32), (w, h)) for s in (3, 10, 30)
    ]
    return sum(layers) / 3  # type: ignore[return-value]


def moving_disc(T: int = 24, *, speed: float = 2.0, camera: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A textured ellipse that crosses a textured background while the camera drifts. Frames and masks."""
    ground, coat = noise(160, 320, 0), 0.6 * noise(160, 320, 1) + np.array([80, 20, 0])
    y, x = np.mgrid[:120, :200]
    frames, masks = [], []
    for t in range(T):
        shift = round(camera * t)
        center = 60 + speed * t
        mask = ((x - center) / 28) ** 2 + ((y - 60) / 20) ** 2 < 1
        picture = ground[20:140, 30 + shift : 230 + shift].copy()
        coat_now = np.roll(coat, round(center), axis=1)[20:140, :200]
        picture[mask] = coat_now[mask]
        frames.append(np.uint8(np.clip(picture, 0, 255)))
        masks.append(mask)
    return np.array(frames), np.array(masks)


def inputs(frames: np.ndarray, **files) -> Inputs:
    decoded = Artifact(npz={"frames.npz": {"frames": frames, "t": np.arange(len(frames)) / 30}})
    return Inputs(artifacts={"decode": decoded}, files=files)


def test_votes_find_what_single_frames_miss_and_stop_at_another_colour():
    """A piece that the network misses in two frames is found from the others; what it sees once is outvoted."""
    frames, masks = moving_disc(16)
    flow = dense_flow(frames)
    piece = np.zeros_like(masks)
    for t in range(len(masks)):
        piece[t, 52:68, 38 + 2 * t : 48 + 2 * t] = True  # moves with the ellipse, whose centre is at 60 + 2 t
    layers = {t: masks[t].astype(np.float32) for t in range(16)}
    for t in (7, 8):
        layers[t] = np.where(piece[t], 0, layers[t])
    layers[12] = layers[12].copy()
    layers[12][5:20, 5:20] = 1
    votes = np.stack([*vote_over_time(layers, frames, flow, lambda f: None)])
    for t in (7, 8):
        assert votes[t][piece[t]].mean() > 0.5
    assert votes[12][5:20, 5:20].mean() < 0.4
    assert iou(votes > 0.5, masks).min() > 0.9
    # However far apart the frames are that the network saw, those between are filled.
    sparse = {t: masks[t].astype(np.float32) for t in (0, 15)}
    assert iou(np.stack([*vote_over_time(sparse, frames, flow, lambda f: None)]) > 0.5, masks).min() > 0.7
    # So are those before the first and after the last one.
    middle = {t: masks[t].astype(np.float32) for t in (7, 8)}
    assert iou(np.stack([*vote_over_time(middle, frames, flow, lambda f: None)]) > 0.5, masks).min() > 0.6
    # The same piece in another colour in those frames is another point: nothing is carried there.
    for t in (7, 8):
        frames[t][piece[t]] = 255 - frames[t][piece[t]]
    other = np.stack([*vote_over_time(layers, frames, flow, lambda f: None)])
    assert other[8][piece[8]].mean() < 0.5 * votes[8][piece[8]].mean()


def furniture(T: int = 40) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A pale body before a brown floor and a white wall, with a brown head and beside a brown box before the wall."""
    y, x = np.mgrid[:120, :200]
    parts = dict(
        body=((x - 100) / 40) ** 2 + ((y - 62) / 22) ** 2 < 1,
        head=(x - 68) ** 2 + (y - 36) ** 2 < 90,
        box=(np.abs(x - 132) < 10) & (np.abs(y - 34) < 12),
        floor=(np.abs(x - 95) < 18) & (y > 78) & (y < 96),
    )
    picture = np.where((y > 58)[..., None], np.array([95.0, 55, 35]), np.array([225.0, 225, 230]))
    picture[parts["head"] | parts["box"]] = 95, 55, 35
    picture[parts["body"]] = 215, 185, 140
    rng = np.random.default_rng(0)
    return np.uint8(np.clip(picture + rng.normal(0, 3, (T, *picture.shape)), 0, 255)), parts


class Resting:
    """Motion of a picture in which nothing moves; of some frames flow is not known."""

    size = (200, 120)

    def __init__(self, lost: Callable[[int], bool] = lambda k: False):
        self.lost = lost

    def chain(self, source: int, target: int) -> np.ndarray:
        there = 500.0 if self.lost(source) != self.lost(target) else 0.0
        return np.full((*self.size[::-1], 2), there, np.float32)


@pytest.mark.parametrize(
    ("joins", "lost", "stays"),
    [
        (range(25, 45), None, False),  # a box that it stands before
        (range(25, 80), None, True),  # whoever has it for longer than not
        (range(25, 45), range(25, 45), True),  # what is not seen before and after, behind a post, may be its own
    ],
)
def test_what_joins_for_a_while_is_given_back(joins, lost, stays):
    _, parts = furniture(1)
    box = parts["box"] & ~parts["body"]
    layers = {k: (parts["body"] | (box if k in joins else False)).astype(np.float16) for k in range(80)}
    motion = Resting(lambda k: lost is not None and k in lost)
    taken = give_back_what_passes(layers, motion)  # pyright: ignore[reportArgumentType]
    assert (taken == 0) == stays
    for k in (0, 26, 35, 44, 79):
        assert (layers[k] > 0.5)[parts["body"]].mean() > 0.99
        assert (layers[k] > 0.5)[box].mean() == pytest.approx(float(k in joins and stays), abs=0.02)


def test_a_piece_that_moves_along_with_the_body_is_not_given_back():
    """In frame 20 it moves along, in 30 the body rests, which is near enough; in 8 it does not, in 12 in part."""
    frames, parts = furniture()
    flow = SimpleNamespace(chain=lambda source, target: np.zeros((*parts["body"].shape, 2), np.float32))
    bodies = dict.fromkeys(range(len(frames)), parts["body"] | parts["floor"] | parts["box"])
    moves = {8: 0.0, 12: np.arange(200) < 100, 20: 1.0}
    share = lambda k, _: np.where(parts["floor"], moves[k], 0.1) if k in moves else None  # noqa: E731
    motion = SimpleNamespace(velocity=lambda k, body: body.sum() * 0.0, share=share)
    gone = parts["floor"] | (parts["box"] & ~parts["body"])
    for k, stays in ((8, False), (12, False), (20, True), (30, True), (39, False)):
        left = _staying(gone, k, bodies, flow, motion)  # pyright: ignore[reportArgumentType]
        assert left[parts["floor"]].mean() == (0 if stays else 1)
        assert left[gone & ~parts["floor"]].all()


@pytest.mark.parametrize(("along", "stays"), [(1.0, True), (0.0, False)])
def test_a_flank_of_the_grounds_colour_stays_where_it_moves_along(along: float, stays: bool):
    """Masks that show a dark front are the smallest, so colours are learned from them; where the body turns its flank,
    which has the colour of the ground, motion says whether that is its own."""
    frames, parts = furniture()
    y, x = np.mgrid[:120, :200]
    flank = (np.abs(x - 95) < 28) & (y > 78) & (y < 100) & ~parts["body"]
    frames[:10][:, flank] = 225  # in other frames it is elsewhere
    layers = {k: (parts["body"] | (flank if k >= 10 else False)).astype(np.float16) for k in range(len(frames))}
    moves = np.where(flank, along, 1.0) * (parts["body"] | flank)
    flow = SimpleNamespace(chain=lambda source, target: np.zeros((*flank.shape, 2), np.float32))
    motion = SimpleNamespace(velocity=lambda k, body: np.ones(2), share=lambda k, velocity: moves)
    count = give_back_surroundings(frames, layers, flow, motion)  # pyright: ignore[reportArgumentType]
    assert (count == 0) == stays
    assert (layers[20] > 0.5)[flank].mean() == pytest.approx(float(stays), abs=0.1)
    assert (layers[20] > 0.5)[parts["body"]].mean() > 0.95


def test_floor_goes_where_a_flank_of_its_colour_stays():
    frames, parts = furniture()
    y, x = np.mgrid[:120, :200]
    below, flank = (np.abs(x - 95) < 28) & (y > 90) & (y < 112), (np.abs(x - 140) < 16) & (y > 46) & (y < 78)
    flank, below = flank & ~parts["body"], below & ~parts["body"]
    frames[:, flank | below] = 95, 55, 35
    frames[:10][:, flank | below] = 225
    layers = {k: (parts["body"] | (flank | below if k >= 10 else False)).astype(np.float16) for k in range(len(frames))}
    moves = np.where(below, 0.0, 1.0) * (parts["body"] | flank)
    flow = SimpleNamespace(chain=lambda source, target: np.zeros((*flank.shape, 2), np.float32))
    motion = SimpleNamespace(velocity=lambda k, body: np.ones(2), share=lambda k, velocity: moves)
    assert give_back_surroundings(frames, layers, flow, motion) > 0  # pyright: ignore[reportArgumentType]
    seen = layers[20] > 0.5
    assert seen[flank].mean() > 0.8
    assert seen[below].mean() < 0.1
    assert seen[parts["body"]].mean() > 0.95


def test_pieces_of_furniture_are_given_back_and_a_head_of_their_colour_is_not():
    frames, parts = furniture()
    flow = dense_flow(frames)
    layers = {k: (parts["body"] | parts["head"]).astype(np.float16) for k in range(len(frames))}
    for k in range(12, 40):  # has no edge where the mask ends
        layers[k][parts["floor"]] = 1
    for k in range(20, 26):  # has edges all round, but only these frames take it for the body
        layers[k][parts["box"]] = 1
    assert give_back_patches(frames, layers, flow, SharedMotion(flow)) == 28
    for k in (0, 15, 23, 39):
        seen = layers[k] > 0.5
        assert seen[parts["body"]].mean() > 0.97
        assert seen[parts["head"]].mean() > 0.95
        assert seen[parts["box"] & ~parts["body"]].mean() < 0.1
        assert seen[parts["floor"] & ~parts["body"]].mean() < 0.15


def test_component_and_reach():
    mask = np.zeros((40, 60), bool)
    mask[5:15, 5:25] = mask[17:30, 8:12] = mask[5:35, 40:58] = True
    assert component_at(mask)[10, 50]
    hint = np.zeros_like(mask)
    hint[8:12, 8:12] = True
    assert component_at(mask, hint).sum() == 200
    assert component_at(mask, hint, reach=4).sum() == 252
    assert not component_at(np.zeros_like(mask)).any()


def test_border_distance_sees_bodies_and_not_posts():
    """A post shares the ground's motion at its foot; a body is closed off all around."""
    field = np.zeros((60, 90, 2))
    field[10:50, 20:25, 0] = np.linspace(8, 0, 40)[:, None]  # parallax grows towards the top
    field[20:40, 50:70, 0] = 5.0
    score = border_distance(field)
    assert score[30, 60] > 4.5
    assert score[48, 22] < 1.0
    assert score[5, 5] < 0.1


def test_quality_falls_where_the_mask_jumps():
    frames, masks = moving_disc(10)
    flow = dense_flow(frames)
    good = frame_quality(masks, flow)
    assert good.min() > 0.85
    broken = masks.copy()
    broken[5] = np.roll(masks[5], 30, axis=1)
    assert frame_quality(broken, flow)[5] < 0.6 * good[5]
    assert frame_quality(np.zeros_like(masks), flow).max() == 0
    sure = np.where(np.arange(10) == 5, 0.5, 0.95)
    quality = frame_quality(masks, flow, sure)
    assert quality[5] < 0.75 < 0.9 < np.delete(quality, 5).min()
    halved = masks.copy()
    halved[4, :, : int(np.flatnonzero(masks[4].any(0)).mean())] = False
    assert frame_quality(halved, flow, np.full(10, 0.95))[4] < 0.9


def test_certainty():
    mask = np.zeros((10, 10), bool)
    mask[2:8, 2:8] = True
    assert frame_certainty(mask.astype(np.float32), mask) == 1.0
    assert frame_certainty(np.where(mask, 0.6, 0.0), mask) == pytest.approx(0.6)
    assert frame_certainty(np.where(mask, 1.0, 0.3), mask) < 0.8
    assert frame_certainty(np.zeros((10, 10)), np.zeros_like(mask)) == 0.0


@pytest.mark.parametrize("camera", [0.0, 1.0])
def test_motion_segmenter(camera):
    frames, truth = moving_disc(camera=camera)
    notes = []
    progress = Silent()
    progress.note = notes.append  # type: ignore[method-assign]
    out = run_masks(inputs(frames), MasksConfig(), progress)
    masks = unpack(out.npz["masks.npz"])
    assert iou(masks, truth).mean() > 0.85
    assert out.json["report.json"]["segmenter"] == "motion"
    assert any("slomo weights fetch" in note for note in notes)
    assert out.npz["masks.npz"]["quality"].shape == (24,)
    assert out.npz["flow.npz"]["flow"].dtype == np.float16


def test_a_shadow_that_moves_along_is_none_of_the_subject():
    frames, truth = moving_disc(48)
    soft = np.stack([cv2.GaussianBlur(frame, (0, 0), 2.0) for frame in frames])  # or the ground's own flow would show
    frames = np.where(truth[..., None], frames, soft)
    shade = np.roll(truth, (18, 26), axis=(1, 2)) & ~truth  # falls below and ahead, and touches it
    shade[:, :, :26] = False
    frames = np.where(shade[..., None], 0.35 * frames, frames).astype(np.uint8)
    masks = unpack(run_masks(inputs(frames), MasksConfig(), Silent()).npz["masks.npz"])
    assert iou(masks, truth).mean() > 0.75
    assert (masks & shade).sum() < 0.35 * shade.sum()


def test_clip_without_a_subject():
    frames = np.repeat(np.uint8(noise(120, 200, 3))[None], 10, 0)
    with pytest.raises(InvalidData, match="no subject found") as caught:
        run_masks(inputs(frames), MasksConfig(segmenter="motion"), Silent())
    assert "--masks" in str(caught.value)


def test_user_masks(tmp_path):
    frames, truth = moving_disc(10)
    for t, mask in enumerate(truth):
        cv2.imwrite(str(tmp_path / f"{t:03d}.png"), cv2.resize(255 * mask.astype(np.uint8), (400, 240)))
    out = run_masks(inputs(frames, masks=tmp_path), MasksConfig(), Silent())
    assert iou(unpack(out.npz["masks.npz"]), truth).min() > 0.95
    assert out.json["report.json"]["segmenter"] == "user"
    np.savez(tmp_path / "masks.npz", allow_pickle=False, **pack(truth))
    out = run_masks(inputs(frames, masks=tmp_path / "masks.npz"), MasksConfig(), Silent())
    np.testing.assert_array_equal(unpack(out.npz["masks.npz"]), truth)


def test_user_masks_that_do_not_fit(tmp_path):
    frames, truth = moving_disc(10)
    for t in range(7):
        cv2.imwrite(str(tmp_path / f"{t}.png"), 255 * truth[t].astype(np.uint8))
    with pytest.raises(InvalidData, match="holds 7 masks, the decoded clip has 10"):
        run_masks(inputs(frames, masks=tmp_path), MasksConfig(), Silent())
    (tmp_path / "a.npz").write_text("not an archive")
    with pytest.raises(InvalidData, match="not a readable"):
        run_masks(inputs(frames, masks=tmp_path / "a.npz"), MasksConfig(), Silent())
    np.savez(tmp_path / "whole.npz", **pack(truth))
    whole = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "b.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InvalidData, match="not a readable"):
        run_masks(inputs(frames, masks=tmp_path / "b.npz"), MasksConfig(), Silent())
    np.savez(tmp_path / "c.npz", masks=truth)
    with pytest.raises(InvalidData, match="cannot be read as masks"):
        run_masks(inputs(frames, masks=tmp_path / "c.npz"), MasksConfig(), Silent())


def test_choice_of_segmenter(tmp_path):
    frames, _ = moving_disc(10)
    with pytest.raises(UsageError, match=r"auto, u2netp, still, motion, user"):
        run_masks(inputs(frames), MasksConfig(segmenter="sam"), Silent())
    with pytest.raises(UsageError, match=r"'drft'.*draft, normal, high"):
        run_masks(inputs(frames), MasksConfig(quality="drft"), Silent())
    with pytest.raises(UsageError, match="SLOMO_U2NETP"):
        run_masks(inputs(frames), MasksConfig(segmenter="u2netp"), Silent())
    with pytest.raises(UsageError, match="--masks"):
        run_masks(inputs(frames), MasksConfig(segmenter="user"), Silent())
    (tmp_path / "w.onnx").write_text("no network")
    with pytest.raises(InvalidData, match="not a network"):
        run_masks(inputs(frames, weights=tmp_path / "w.onnx"), MasksConfig(), Silent())


def shared(*parts: str) -> Path:
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"needs ../shared/{'/'.join(parts)}")
    return path


@pytest.mark.slow
def test_network_on_the_camel():
    """The bar of the first light: mean IoU of 0.80 with the camel's truth."""
    clip, weights = shared("clips", "camel"), shared("weights", "u2netp.onnx")
    decoded = decode_stage.run(Inputs(files={"clip": clip / "clip.mp4"}), decode_stage.Config(), Silent())
    out = run_masks(Inputs(artifacts={"decode": decoded}, files={"weights": weights}), MasksConfig(), Silent())
    masks = unpack(out.npz["masks.npz"])
    with np.load(clip / "masks.npz") as z:
        size = masks.shape[:0:-1]
        truth = [cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5 for m in unpack(z)]
    assert iou(masks, np.array(truth)).mean() >= 0.80
    assert out.json["report.json"]["segmenter"] == "u2netp"


@pytest.mark.slow
def test_motion_on_the_embedded_clip():
    """`make demo` has no network: motion alone has to do."""
    decoded = decode_stage.run(Inputs(files={"clip": ASSET / "clip.mp4"}), decode_stage.Config(), Silent())
    out = run_masks(Inputs(artifacts={"decode": decoded}), MasksConfig(segmenter="motion"), Silent())
    with np.load(ASSET / "masks.npz") as z:
        truth = unpack(z)
    assert iou(unpack(out.npz["masks.npz"]), truth).mean() >= 0.85
