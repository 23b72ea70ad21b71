"""Segmenter that runs U2-Net-p on some frames, each cropped to where the subject should be, and blends over time."""

from dataclasses import dataclass, field

import numpy as np

from slomo.reconstruct.flow import Flow, sample
from slomo.reconstruct.instances import Choice, Look, clarity_of, components, distance, standing_out, tell_apart
from slomo.reconstruct.instances_motion import ALIKE, MOVES, SharedMotion, foreign, wider_than_a_leg
from slomo.reconstruct.passing import give_back_what_passes
from slomo.reconstruct.segment import Masks, Report, box_of, component_at, frame_certainty, grown, no_subject
from slomo.reconstruct.surroundings import give_back_patches, give_back_surroundings
from slomo.reconstruct.u2net import U2Net
from slomo.reconstruct.votes import vote_over_time

_FAST = 6.0  # px of motion that make a start no better
_ALIKE = 0.75  # likeness from which on a piece may be the subject's
_SURELY_ALIKE = 0.9  # the same of a piece that does not move as the subject did
_LASTING = 30  # frames in which it was seen, over which the subject's usual size is taken
_HELD = 0.4  # probability over time: thin limbs are missed more often than furniture is taken
_MEMORY = 0.93  # of who is who, from one frame to the next
_TRUSTED = 0.5  # of the last half second in which what looks the same was found to be the subject's: it still is


@dataclass(frozen=True)
class SaliencySegmenter:
    """U2-Net-p with tracking.

    Attributes:
        network: the loaded network.
        choice: whom the user means.
        every: the network runs on every n-th frame; flow fills the frames between. Legs and tails that it sees in some
            frames only are better found when it sees them all.
        probes: frames seen whole at first, to find where the subject is best seen.
        margin: by which the subject's box is grown, in parts of its longer side, before cropping.
    """

    network: U2Net
    choice: Choice = field(default_factory=Choice)
    every: int = 1
    probes: int = 7
    margin: float = 0.15
    name: str = "u2netp"

    def segment(self, frames: np.ndarray, flow: Flow, progress: Report) -> Masks:
        T = len(frames)
        keys = sorted(
            {*range(0, T, self.every), T - 1} | ({self.choice.frame} if self.choice.how != "largest" else set())
        )
        motion = SharedMotion(flow)
        seed, seen, report = self._start(keys, frames, motion, lambda f: progress(0.2 * f))
        track = _Track(self.network, frames, flow, motion, self.margin, self.every)
        track.start(seed, *seen)
        for order in (keys[keys.index(seed) :], keys[: keys.index(seed) + 1][::-1]):
            track.follow(order, lambda: progress(0.2 + 0.5 * len(track.layers) / len(keys)))
        layers, told = track.layers, track.settle_who_is_who()
        given_back = {"colour_repaired_frames": give_back_surroundings(frames, layers, flow, motion)}
        given_back |= {"passed_frames": give_back_what_passes(layers, motion)}
        given_back |= {"patched_frames": give_back_patches(frames, layers, flow, motion)}
        progress(0.8)
        probability = vote_over_time(layers, frames, flow, lambda f: progress(0.8 + 0.15 * f))
        masks, certainty = np.empty(frames.shape[:3], bool), np.zeros(T)
        for t, p in enumerate(probability):
            pieces = components(p > _HELD, 1)
            least = 0.01 * pieces[0].sum() if pieces else 0
            pieces = [c for c in pieces if c.sum() >= least and p[c].max() > 0.8]
            masks[t] = np.logical_or.reduce(pieces) if pieces else False
            certainty[t] = frame_certainty(p, masks[t])
        if not masks.any():
            raise no_subject("the network's answer does not hold over time")
        if self.choice.how == "largest" and np.quantile([motion.liveliness(t, masks[t]) for t in keys], 0.9) < 1:
            raise no_subject("what stands out in the picture never moves against the background")
        report |= {"weights_sha256": self.network.digest, "network_frames": len(keys), "seed_frame": seed}
        report |= {"frames_with_others": told, "frames_lost": sum(not p.any() for p in layers.values())}
        return Masks(masks, certainty, report | given_back)

    def _start(self, keys: list[int], frames: np.ndarray, motion: SharedMotion, progress: Report):
        """The frame to start from, the subject and the others in it (H, W) bool, and what the report says of that.

        Of the largest, the frame that shows it most clearly; else the frame in which the user pointed at it.
        """
        probes = [keys[k] for k in np.linspace(0, len(keys) - 1, min(self.probes, len(keys))).round().astype(int)]
        chosen = self.choice.how != "largest"
        probes = sorted({*probes, self.choice.frame}) if chosen else probes
        whole = {}
        for i, k in enumerate(probes):
            whole[k] = self.network(frames[k])
            progress((i + 1) / len(probes))
        counts = [len(standing_out(p)) for p in whole.values()]
        if chosen:
            seed = self.choice.frame
            subject = self._pointed_at(frames[seed], whole[seed])
        else:
            found, bodies = {t: component_at(p > 0.5) for t, p in whole.items()}, {}
            rest = {t: (whole[t] > 0.5) & ~body for t, body in found.items()}
            found = {t: component_at(b & ~motion.apart(t, frames, found, rest)) for t, b in found.items()}
            for t, body in found.items():
                calm = foreign(body, body, motion.share(t, motion.velocity(t, body)))
                # What it passes it leaves behind, or it stands out no more: its own legs stay with it, or come along.
                left = calm & ~motion.lasting(t, calm, found)
                left &= ~motion.gone(t, left, frames, found)
                bodies[t] = component_at(body & ~(left & wider_than_a_leg(left, body)))
            speed = {t: min(float(np.linalg.norm(motion.velocity(t, b))), _FAST) for t, b in bodies.items()}
            alive = np.median([motion.liveliness(t, b) for t, b in bodies.items()]) > 1
            if max(speed.values()) < MOVES and not alive:  # what stands out is furniture, or rests
                for t in probes:
                    # A paw that one lifts that stands is no animal of its own.
                    movers = [m for m in motion.movers(t) if (m & bodies[t]).sum() < 0.5 * m.sum()]
                    p, body = self._mover(frames[t], movers)
                    if (v := float(np.linalg.norm(motion.velocity(t, body)))) > max(MOVES, speed[t]):
                        whole[t], bodies[t], speed[t] = p, body, min(v, _FAST)
            # What stands out in one frame may be a box; what moves as well is the better start.
            clarity = {
                t: clarity_of(p, bodies[t]) * (0.1 + speed[t] / (max(speed.values()) + 1)) for t, p in whole.items()
            }
            seed = max(clarity, key=lambda t: clarity[t])
            if clarity[seed] <= 0:
                raise no_subject(f"the network sees nothing that stands out in {len(whole)} frames across the clip")
            subject = bodies[seed]
        others = (whole[seed] > 0.5) & ~grown(subject, 0.03)
        report = {"chosen": self.choice.how, "instances": int(np.median(counts)), "instances_most": max(counts)}
        return seed, (subject, others), report

    def _mover(self, frame: np.ndarray, movers: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Of the places (H, W) bool where something moves, what the network finds in the first in which it finds
        anything: its answer and the body. In the whole frame what is large and still outshines a small animal."""
        nothing = np.zeros(frame.shape[:2], np.float32)
        for moving in movers:
            seen = self.network.crop(frame, box_of(moving, margin=0.5))
            body = component_at(seen > 0.5, moving)
            if (body & moving).sum() > 0.3 * moving.sum() and body.sum() < 6 * moving.sum():
                return seen, body
        return nothing, nothing > 0

    def _pointed_at(self, frame: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """(H, W) bool of what the user's point or box means in `frame`, of which the network has seen the `whole`."""
        h, w = whole.shape
        if self.choice.box is not None:
            u0, v0, u1, v1 = self.choice.box
            edge = 0.08 * max(u1 - u0, v1 - v0)
            box = max(0, int(u0 - edge)), max(0, int(v0 - edge)), min(w, int(u1 + edge) + 1), min(h, int(v1 + edge) + 1)
            inside = np.zeros((h, w), bool)
            inside[max(0, int(v0)) : int(v1) + 1, max(0, int(u0)) : int(u1) + 1] = True
            body = component_at((self.network.crop(frame, box) > 0.5) & grown(inside, 0.02), inside)
            if body.sum() < 0.1 * inside.sum():
                raise no_subject("nothing stands out in the box that --subject-box gives")
            return body
        u, v = (min(max(round(x), 0), n - 1) for x, n in zip(self.choice.point or (0, 0), (w, h), strict=True))
        seen = [whole]
        for side in (0.6, 0.35, 0.2):  # of the picture: what is small stands out only when looked at from near
            r = round(0.5 * side * max(h, w))
            seen.append(self.network.crop(frame, (max(0, u - r), max(0, v - r), min(w, u + r), min(h, v + r))))
        for probability in seen:
            near = [c for c in components(probability > 0.5, 50) if distance(c)[v, u] < 0.01 * max(h, w)]
            if near and near[0].mean() < 0.5:
                return near[0]
        raise no_subject(f"nothing stands out at the point that --subject-at gives ({u},{v} in the decoded frame)")


class _Track:
    """The subject through the frames that the network sees, and whoever comes near it."""

    def __init__(self, network: U2Net, frames: np.ndarray, flow: Flow, motion: SharedMotion, margin: float, every: int):
        self.network, self.frames, self.flow = network, frames, flow
        self.motion, self.margin, self._lasting = motion, margin, max(1, _LASTING // every)
        self.layers: dict[int, np.ndarray] = {}  # frame -> (H, W) float16 probability
        self._who: dict[int, np.ndarray] = {}  # frame -> (H, W) int8, twentieths: 2 the subject, -3 another
        self._look = Look()
        self._sizes: list[tuple[float, float, float]] = []  # of late: width, height, area of the subject, px
        self._velocity = np.zeros(2, np.float32)  # when it was last seen

    def start(self, seed: int, subject: np.ndarray, others: np.ndarray) -> None:
        """Where to start from: who is who (H, W) bool in frame `seed`."""
        self._look.learn(self.frames[seed], subject)
        self._at_seed = subject, others

    def follow(self, order: list[int], tick) -> None:
        """Fill `layers` along the frames `order`, the first of which is the seed."""
        subject, others = self._at_seed
        resting, trust = np.zeros_like(others), subject.astype(np.float32)
        x0, y0, x1, y1 = box_of(subject)
        self._sizes = [(x1 - x0, y1 - y0, float(subject.sum()))]
        self._velocity = self.motion.velocity(order[0], subject)
        for previous, t in zip([order[0], *order], order, strict=False):
            if t != previous:
                offset = self.flow.chain(t, previous)
                subject, others, resting = (
                    sample(m.astype(np.float32), offset) > 0.5 for m in (subject, others, resting)
                )
                before = sample(self.frames[previous].astype(np.float32), offset)
                same = np.abs(before - self.frames[t]).mean(-1) < ALIKE
                resting &= same
                trust = sample(trust, offset) * same
            known = others | resting
            subject, others = self._look_at(t, subject, known, trust > _TRUSTED)
            if t == previous:
                trust = np.maximum(trust, subject)
            else:
                trust = subject + _MEMORY ** abs(t - previous) * (trust - subject)
            # Furniture that does not stand out for a while is still there when the subject touches it.
            resting = known & ~others & ~grown(subject, 0.03) & self.motion.calm(t)
            tick()

    def _look_at(
        self, t: int, carried: np.ndarray, others: np.ndarray, own: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Who is who in frame t, from where flow has carried them to, and from what was the subject's `own` of late: a
        foot that stands and is missed for a while is still its foot when it stands out again. Writes the layer."""
        frame = self.frames[t]
        if carried.sum() < 0.04 * self._usual()[2]:
            subject, others, seen = self._search(t)
            sure = others
        else:
            seen = self.network.crop(frame, self._box(carried))
            alike = lambda piece: self._look.likeness(frame, piece) > _ALIKE  # noqa: E731
            found = seen > 0.5
            share = self.motion.share(t, self.motion.velocity(t, carried & found))
            trusted, usual = carried | (own & self.motion.calm(t)), self._usual()[2]
            astray = foreign(found, carried, share, known=trusted & ~others)
            before = carried & ~astray
            subject, others, sure = tell_apart(found & ~astray, before, others, alike, share, usual, own & ~others)
            others, sure = others | astray, sure | astray
            if subject.any() and self._look.likeness(frame, subject) < 0.6:
                subject, others, sure = np.zeros_like(subject), others | subject, sure | subject
        if subject.any():
            x0, y0, x1, y1 = box_of(subject)
            self._sizes = [*self._sizes[-self._lasting :], (x1 - x0, y1 - y0, float(subject.sum()))]
            velocity = self.motion.velocity(t, subject)
            self._velocity = velocity if velocity.any() else self._velocity
            if not others.any():
                self._look.learn(frame, subject)
        soft = seen * (distance(subject) <= np.minimum(distance(others), 2.0 + 0.05 * np.sqrt(subject.sum())))
        self.layers[t] = soft.astype(np.float16)
        who = np.where(subject, np.where(carried, 2.0, 0.7), np.where(others, np.where(sure, -3.0, -0.7), 0.0))
        self._who[t] = np.round(20 * who).astype(np.int8)
        return subject, sure

    def _usual(self) -> tuple[float, float, float]:
        """Width, height and area of the subject of late, where least of it was hidden."""
        width, height, area = np.quantile(self._sizes, 0.9, axis=0)
        return float(width), float(height), float(area)

    def _box(self, subject: np.ndarray) -> tuple[int, int, int, int]:
        """Where to look for the subject: around where it should be, and wherever the rest of it may reappear."""
        x0, y0, x1, y1 = box_of(subject)
        width, height, _ = self._usual()
        grow = self.margin * max(width, height, x1 - x0, y1 - y0)
        x0, x1 = min(x0, x1 - 0.9 * width) - grow, max(x1, x0 + 0.9 * width) + grow
        y0, y1 = min(y0, y1 - 0.9 * height) - grow, max(y1, y0 + 0.9 * height) + grow
        h, w = subject.shape
        return max(0, round(x0)), max(0, round(y0)), min(w, round(x1)), min(h, round(y1))

    def _search(self, t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The subject anywhere in frame t, if something there looks like it; the others; the probability."""
        seen, usual = self.network(self.frames[t]), self._usual()[2]
        found = seen > 0.5
        pieces = components(found, 0.05 * usual)
        share = self.motion.share(t, self._velocity)
        if share is not None:  # what moves as it did when it was last seen may be merged with what hid it
            pieces += components(found & (share > 0.5), 0.1 * usual)
        best, subject = 0.0, np.zeros_like(found)
        for piece in pieces:
            piece = piece & ~foreign(piece, piece, self.motion.share(t, self.motion.velocity(t, piece)))
            if not 0.03 * usual < piece.sum() < 2.5 * usual or seen[piece].mean() < 0.8:
                continue
            likeness = self._look.likeness(self.frames[t], piece)
            along = 0.0 if share is None else float(np.median(np.nan_to_num(share[piece])))
            score = (likeness + 0.2 * min(along, 1.0)) * np.sqrt(min(piece.sum(), usual))
            if likeness > (_ALIKE if share is None or along > 0.5 else _SURELY_ALIKE) and score > best:
                best, subject = score, piece
        # What touches it may be the rest of it.
        touching = component_at(found, subject) if subject.any() else subject
        apart = ~touching if share is None else ~touching | (share < 0)
        return subject, found & ~subject & apart, seen

    def settle_who_is_who(self) -> int:
        """Take out of `layers` what is another's, as the frames before and after see it. Returns the frames concerned.

        Votes run along the flow both ways, so that what has merged is told apart by what is seen before and after.
        """
        keys = sorted(self._who)
        if not any((self._who[k] < 0).any() for k in keys):
            return 0
        total = {k: self._who[k].copy() for k in keys}  # twentieths, too: 6 of one order do not outgrow 127
        for order in (keys, keys[::-1]):
            carried = np.zeros_like(total[keys[0]])
            for previous, k in zip([order[0], *order], order, strict=False):
                if k != previous:
                    before = carried + self._who[previous].astype(np.float32) / 20
                    fades = _MEMORY ** abs(k - previous)
                    carried = fades * np.clip(sample(before, self.flow.chain(k, previous)), -6, 6)
                total[k] = np.clip(total[k] + np.round(20 * carried), -127, 127).astype(np.int8)
        changed = 0
        for k in keys:
            foreign = (total[k] < 0) & (self.layers[k] > 0.5)
            changed += bool(foreign.sum() > 0.01 * max((self.layers[k] > 0.5).sum(), 1))
            self.layers[k] = np.where(total[k] < 0, 0, self.layers[k]).astype(np.float16)
        self._who = {}  # a third as large as the frames, and settled
        return changed
