"""From the network's output to grasps: which are left out, and how the best of a region is found."""

import torch

from regnet_core.nn.anchors import RESIDUALS, Pose
from regnet_core.nn.decoding import spread
from regnet_core.nn.results import Candidates, Refined, StagePrediction, best_of_regions, expected_quality


def test_grasps_next_to_better_ones_are_left_out() -> None:
    centres = torch.tensor([[0.0, 0.0, 0.0], [0.015, 0.0, 0.0], [0.03, 0.0, 0.0], [0.5, 0.0, 0.0], [0.5, 0.019, 0.0]])
    # The second goes because of the first; the third is near the second only, which is gone.
    assert spread(centres, 0.02).tolist() == [0, 2, 3]
    assert spread(centres, 0.0).tolist() == [0, 1, 2, 3, 4]
    assert spread(centres[:0], 0.02).tolist() == []


def test_what_stays_is_spread_and_covers_what_goes() -> None:
    centres = torch.rand((300, 3), generator=torch.Generator().manual_seed(1)) * 0.1
    kept = spread(centres, 0.02)
    between = torch.cdist(centres[kept], centres[kept]).fill_diagonal_(1.0)
    assert between.min() >= 0.02 - 1e-6
    for row in set(range(300)) - set(kept.tolist()):
        better = kept[kept < row]
        assert (centres[better] - centres[row]).norm(dim=1).min() < 0.02 + 1e-6


def _refined(quality: list[float], occupied: list[bool]) -> Refined:
    count = len(quality)
    prediction = StagePrediction(torch.zeros(count), torch.zeros(count, RESIDUALS), torch.tensor(quality))
    return Refined(prediction, torch.tensor(occupied, dtype=torch.bool))


def test_the_best_of_a_region_sees_something_between_its_fingers() -> None:
    region = torch.tensor([0, 0, 1, 1, 2, 2])
    candidates = Candidates(Pose(torch.eye(3).expand(6, 3, 3), torch.zeros(6, 3)), region, torch.zeros_like(region))
    refined = _refined([0.1, 0.3, 2.0, -1.0, 5.0, 0.0], [True, True, True, True, False, True])
    assert best_of_regions(candidates, refined).tolist() == [1, 2, 5]
    nothing = candidates._replace(region=region[:0])
    assert best_of_regions(nothing, _refined([], [])).tolist() == []


def test_expected_quality_is_probability_times_quality() -> None:
    prediction = StagePrediction(torch.tensor([0.0, 9e3]), torch.zeros(2, RESIDUALS), torch.tensor([0.0, -9e3]))
    torch.testing.assert_close(expected_quality(prediction), torch.tensor([0.25, 0.0]))
