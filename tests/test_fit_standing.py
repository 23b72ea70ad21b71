"""Which foot stands when, and feet that stay there."""

import numpy as np
import pytest
import torch

from slomo.reconstruct import standing
from slomo.reconstruct.kinematics import Kinematics, limb_links
from slomo.runs import runs
from slomo.skeleton import list_skeletons, load_skeleton

T = np.arange(60) / 30
SOLE = 0.035


def _stepping(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """(60, 1, 3) a foot of a body 1 long that stands half of every second and steps 0.8 ahead in the rest of it, and
    (60,) when it stands."""
    down = T % 1.0 < 0.5
    swing = np.clip((T % 1.0 - 0.5) / 0.5, 0, 1)
    x = 0.8 * (np.floor(T) + swing)
    feet = np.stack([x, np.zeros(60), SOLE + 0.15 * np.sin(np.pi * swing)], 1)[:, None]
    return feet + noise * np.random.default_rng(3).normal(size=feet.shape), down


def test_a_stepping_foot_stands_when_it_stands():
    feet, down = _stepping(noise=0.003)
    root = np.stack([0.8 * T, 0 * T, 0.8 + 0 * T], 1)
    p = standing.contact_probability(feet, root, T, length=1.0, leg=0.735, sole=SOLE)[:, 0]
    assert ((p > 0.5) == down).mean() > 0.9
    assert p[5] > 0.95
    assert p[22] < 0.05


def test_heights_and_speeds_are_judged_by_the_length_of_the_legs():
    """A foot an eighth of a leg above the ground is up, and one that slides is no stance: of a person, whose legs are
    half as long as the body, as of an animal, whose legs are three quarters of the trunk."""
    for leg in (0.497, 0.735):
        up = (T > 0.5) & (T < 1.0)
        feet = np.zeros((60, 1, 3))
        feet[:, 0, 2] = SOLE + np.where(up, 0.12 * leg, 0.01)
        p = standing.contact_probability(feet, np.zeros((60, 3)), T, length=1.0, leg=leg, sole=SOLE)[:, 0]
        assert ((p < 0.5) == up).all()
        slides = np.zeros((60, 1, 3))
        slides[:, 0, 0], slides[:, 0, 2] = 0.6 * leg * T, SOLE
        p = standing.contact_probability(slides, np.zeros((60, 3)), T, length=1.0, leg=leg, sole=SOLE)[:, 0]
        assert (p < 0.5).all()


def test_a_blink_is_no_step_and_a_long_rise_is():
    seen = np.zeros((30, 1, 2))
    seen[..., 1] = 2.0
    seen[10, 0] = seen[20:26, 0] = 0.0, -2.0
    p = standing.smoothed(seen, np.full(29, 0.1))[:, 0]
    assert p[10] > 0.5
    assert (p[21:25] < 0.5).all()


def test_smoothing_is_the_posterior_of_every_path():
    seen, change = np.random.default_rng(0).normal(size=(4, 1, 2)), np.array([0.1, 0.3, 0.2])
    total = np.zeros((4, 2))
    for path in np.ndindex(2, 2, 2, 2):
        steps = np.where(np.diff(path) == 0, 1 - change, change)
        weight = np.exp(sum(seen[k, 0, s] for k, s in enumerate(path))) * steps.prod()
        for k, s in enumerate(path):
            total[k, s] += weight
    np.testing.assert_allclose(standing.smoothed(seen, change)[:, 0], total[:, 1] / total.sum(1), atol=1e-12)


def test_a_standing_foot_stays_and_one_in_the_air_is_not_moved_more_than_its_stances():
    feet, down = _stepping(noise=0.01)
    contact = np.where(down, 0.9, 0.1)[:, None]
    out = standing.places(feet, contact, T, SOLE)
    for a, b in runs(down):
        assert np.ptp(out[a:b, 0], axis=0) == pytest.approx(0, abs=1e-12)
        assert out[a, 0, 2] == pytest.approx(SOLE)
    moved = np.abs(out - feet).max(axis=(1, 2))
    assert moved[~down].max() <= moved[down].max() + 1e-12
    np.testing.assert_array_equal(standing.places(feet, 0 * contact, T, SOLE), feet)


@pytest.mark.parametrize("name", list_skeletons())
def test_legs_reach_what_they_can_with_bones_as_they_are(name: str):
    kin = Kinematics(load_skeleton(name))
    generator = torch.Generator().manual_seed(0)
    q = 0.2 * torch.randn(1, 7, kin.B, 3, generator=generator)
    shape = kin.shape_variables(1) | {"log_length": torch.tensor([0.7])}
    place, R = torch.randn(1, 7, 3, generator=generator), torch.eye(3).expand(1, 7, 3, 3)
    before = kin.pose(shape, place, R, q).nodes[0]
    length = float(shape["log_length"].exp()[0])
    # Up and about: away from the end of a straight leg's reach.
    shift = 0.03 * length * (torch.rand(7, len(kin.contacts), 3, generator=generator) + torch.tensor([-0.5, -0.5, 0.0]))
    target = (before[:, kin.contacts] + shift).numpy()
    bent = standing.stand(kin, shape, place, R, q, target)
    after = kin.pose(shape, place, R, bent).nodes[0]
    assert np.abs(after[:, kin.contacts].numpy() - target).max() < 0.004 * length
    legs = sorted({j for limb in kin.skeleton.limbs for j in limb_links(kin.skeleton, limb)})
    same = [j for j in range(kin.B) if j not in legs]
    torch.testing.assert_close(bent[:, :, same], q[:, :, same])
    assert float((bent - q).abs().max()) < 0.5
