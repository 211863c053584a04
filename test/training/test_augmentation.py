"""Augmentation moves cloud and labels together."""

import dataclasses

import torch
from scipy.spatial.transform import Rotation

from regnet_core.data.dataset import GraspSample
from regnet_core.training.augmentation import augment
from regnet_core.training.recipe import Augmentation


def _sample(n: int = 400, m: int = 60) -> GraspSample:
    g = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=g)

    rotation = torch.from_numpy(Rotation.random(m, random_state=0).as_matrix()).float()
    back = rotation[:, 0, 1] < 0
    rotation[back, :, 1:] *= -1.0
    translation = rand(m, 3)
    return GraspSample(
        rand(n, 3), rand(n, 3), rand(n), torch.arange(n), torch.tensor(0.08), rand(3), torch.eye(3),
        translation, rotation, rand(m),
        rand(m, 2) - 0.5, translation + 0.03 * rotation[:, :, 0], torch.arange(m), 0, 0,
    )  # fmt: skip


def _contact_points(sample: GraspSample) -> torch.Tensor:
    """(M, 2, 3) of both fingers, in no particular order: sorted by their first coordinate."""
    points = sample.translation[:, None] + sample.contacts[:, :, None] * sample.rotation[:, None, :, 1]
    order = points[:, :, 0].argsort(dim=1)
    return points.gather(1, order[:, :, None].expand_as(points))


def test_distances_between_points_and_grasps_stay() -> None:
    before = _sample()
    config = Augmentation(tilt=0.2, jitter=0.0, dropout=0.0)
    after = augment(before, config, torch.Generator().manual_seed(1))
    assert not torch.allclose(after.points, before.points, atol=0.05)
    for name in ("translation", "entry_point", "viewpoint"):
        expected, found = (torch.cdist(one.points, getattr(one, name).reshape(-1, 3)) for one in (before, after))
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=0.0)
    expected, found = (torch.cdist(one.points, _contact_points(one).reshape(-1, 3)).sort(dim=1).values
                       for one in (before, after))  # fmt: skip
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0.0)
    torch.testing.assert_close(
        after.entry_point, after.translation + 0.03 * after.rotation[:, :, 0], atol=1e-5, rtol=0.0
    )


def test_rotations_stay_right_handed_and_canonical() -> None:
    after = augment(_sample(), Augmentation(), torch.Generator().manual_seed(2))
    assert bool((after.rotation[:, 0, 1] >= 0).all())
    torch.testing.assert_close(torch.linalg.det(after.rotation), torch.ones(60), atol=1e-4, rtol=0.0)


def test_a_turn_about_the_vertical_keeps_heights() -> None:
    before = _sample()
    after = augment(before, Augmentation(tilt=0.0, jitter=0.0, dropout=0.0), torch.Generator().manual_seed(3))
    torch.testing.assert_close(after.points[:, 2], before.points[:, 2])


def test_lost_points_are_replaced_by_others_with_their_labels() -> None:
    before = _sample()
    config = Augmentation(rotation=False, tilt=0.0, jitter=0.0, dropout=0.9)
    after = augment(before, config, torch.Generator().manual_seed(4))
    assert after.points.shape == before.points.shape
    rows = after.object_index  # the sample's points are numbered by it
    assert len(rows.unique()) < 400
    torch.testing.assert_close(after.points, before.points[rows])
    torch.testing.assert_close(after.confidence, before.confidence[rows])


def test_nothing_changes_without_strength() -> None:
    before = _sample()
    after = augment(before, Augmentation(False, 0.0, 0.0, 0.0), torch.Generator().manual_seed(5))
    for field in dataclasses.fields(GraspSample):
        a, b = getattr(after, field.name), getattr(before, field.name)
        if isinstance(a, torch.Tensor) and a.dtype == torch.float32:
            torch.testing.assert_close(a, b, atol=1e-6, rtol=0.0)
