"""Which grasp is learnt where, on scenes small enough to work out by hand."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from regnet_core.data.dataset import GraspBatch
from regnet_core.errors import InvalidInputError
from regnet_core.nn import matching
from regnet_core.nn.anchors import RESIDUALS, GraspCoder, Pose, RefineCoder
from regnet_core.nn.matching import (
    IGNORED,
    NEGATIVE,
    NO_GRASP,
    POSITIVE,
    LabelledGrasps,
    Match,
    MatchConfig,
    Matcher,
    proposal_targets,
    region_targets,
)

ANCHORS = GraspCoder().anchors(torch.zeros(1))
ALL = [POSITIVE] * 4


def rotation(
    closing: tuple[float, float, float], approach: tuple[float, float, float] = (0.0, 0.0, -1.0)
) -> np.ndarray:
    """A grasp frame with this closing direction, and the approach as near to the given one as it can be."""
    y = np.array(closing) / np.linalg.norm(closing)
    x = np.array(approach if abs(y @ approach) < 0.999 else (1.0, 0.0, 0.0))
    x -= y * (y @ x)
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def labelled(
    closings: list[tuple[float, float, float]],
    entries: list[tuple[float, float, float]],
    preference: list[float] | None = None,
    *,
    scene: list[int] | None = None,
    objects: list[int] | None = None,
) -> LabelledGrasps:
    """Grasps from above; their centres are 0.03 m above the entry points where they approach straight down."""
    m = len(closings)
    frames = torch.tensor(np.array([rotation(c) for c in closings]).reshape(m, 3, 3), dtype=torch.float32)
    entry = torch.tensor(entries, dtype=torch.float32).reshape(m, 3)
    score = torch.tensor(preference or [0.5] * m)
    return LabelledGrasps(
        Pose(frames, entry - 0.03 * frames[:, :, 0]),
        score,
        entry,
        score,
        torch.tensor(objects or [0] * m),
        torch.tensor(scene or [0] * m),
    )


def match_at(grasps: LabelledGrasps, *points: tuple[float, float, float], config: MatchConfig | None = None) -> Match:
    at = torch.tensor(points)
    return Matcher(config).match_regions(at, torch.zeros(len(at), dtype=torch.int64), ANCHORS, grasps)


# Regions and anchors


def test_alpha_bands_of_all_anchors() -> None:
    """An anchor's own direction: 0 degrees to it, and 70.5 degrees (cosine 1 / 3) to the line of each other one."""
    match = match_at(labelled([(1, 1, -1)], [(0, 0, 0)]), (0.0, 0.0, 0.0))
    assert match.label.tolist() == [[IGNORED, POSITIVE, IGNORED, IGNORED]]
    assert match.grasp.tolist() == [[NO_GRASP, 0, NO_GRASP, NO_GRASP]]


def test_a_coordinate_axis_is_positive_for_all_anchors() -> None:
    """54.7 degrees to each of them."""
    for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
        assert match_at(labelled([axis], [(0, 0, 0)]), (0.0, 0.0, 0.0)).label.tolist() == [ALL]


@pytest.mark.parametrize(("degrees", "label"), [(59.0, POSITIVE), (61.0, IGNORED), (74.0, IGNORED), (76.0, NEGATIVE)])
def test_alpha1_and_alpha2(degrees: float, label: int) -> None:
    first = ANCHORS[0].numpy().astype(float)
    side = np.cross(first, [0.0, 0.0, 1.0])
    turned = Rotation.from_rotvec(np.radians(degrees) * side / np.linalg.norm(side)).apply(first)
    assert match_at(labelled([tuple(turned)], [(0, 0, 0)]), (0.0, 0.0, 0.0)).label[0, 0].item() == label


def test_a_turned_jaw_matches_alike() -> None:
    there, back = labelled([(1, 1, -1)], [(0, 0, 0)]), labelled([(-1, -1, 1)], [(0, 0, 0)])
    assert torch.equal(match_at(there, (0.0, 0.0, 0.0)).label, match_at(back, (0.0, 0.0, 0.0)).label)


def test_grasps_beyond_the_radius_are_not_learnt() -> None:
    match = match_at(labelled([(1, 0, 0)], [(0, 0, 0)]), (0.019, 0.0, 0.0), (0.021, 0.0, 0.0))
    assert match.label.tolist() == [ALL, [NEGATIVE] * 4]


def test_the_preferred_grasp_wins_unless_it_is_too_far() -> None:
    """At distance 0 and 0.01 m, with the weight 0.15 at 0.02 m: the far one is worth 0.075 less."""
    entries = [(0.0, 0.0, 0.0), (0.01, 0.0, 0.0)]
    x = [(1, 0, 0), (1, 0, 0)]
    assert match_at(labelled(x, entries, [0.5, 0.58]), (0.0, 0.0, 0.0)).grasp.tolist() == [[1] * 4]
    assert match_at(labelled(x, entries, [0.5, 0.57]), (0.0, 0.0, 0.0)).grasp.tolist() == [[0] * 4]
    assert match_at(labelled(x, entries, [0.5, 0.5]), (0.008, 0.0, 0.0)).grasp.tolist() == [[1] * 4]


def test_the_paper_takes_the_nearest() -> None:
    grasps = labelled([(1, 0, 0)] * 2, [(0, 0, 0), (0.001, 0, 0)], [0.1, 1.0])
    match = match_at(grasps, (0.0, 0.0, 0.0), (0.0006, 0.0, 0.0), config=MatchConfig.paper())
    assert match.grasp[:, 0].tolist() == [0, 1]


@pytest.mark.parametrize(
    ("second", "label"), [(0.9, POSITIVE), (0.86, POSITIVE), (0.84, IGNORED), (0.81, IGNORED), (0.79, NEGATIVE)]
)
def test_each_anchor_learns_its_own_grasp_if_it_is_nearly_as_good(second: float, label: int) -> None:
    """Closing directions 70.5 degrees apart, each along an anchor and in the ignored band of the other three."""
    match = match_at(labelled([(1, 1, 1), (1, -1, -1)], [(0, 0, 0)] * 2, [0.9, second]), (0.0, 0.0, 0.0))
    # The better one's band makes the anchor of a bad second one ignored.
    seen = IGNORED if label == NEGATIVE else label
    assert match.label.tolist() == [[POSITIVE, IGNORED, seen, IGNORED]]
    assert match.grasp.tolist() == [[0, NO_GRASP, 1 if label == POSITIVE else NO_GRASP, NO_GRASP]]


@pytest.mark.parametrize(("score", "label"), [(0.86, POSITIVE), (0.84, IGNORED), (0.79, NEGATIVE)])
def test_an_anchor_with_bad_grasps_only_is_negative(score: float, label: int) -> None:
    """The best grasp closes 90 degrees from the fourth anchor; one along that anchor is a little or much worse."""
    grasps = labelled([(0, 1, 1), (1, -1, 1)], [(0, 0, 0)] * 2, [0.9, score])
    assert match_at(grasps, (0.0, 0.0, 0.0)).label[0, [0, 3]].tolist() == [POSITIVE, label]
    best_alone = match_at(grasps, (0.0, 0.0, 0.0), config=MatchConfig(margin1=0.0, margin2=0.0))
    assert best_alone.label.tolist() == [[POSITIVE, NEGATIVE, POSITIVE, NEGATIVE]]


def test_a_single_anchor_learns_every_grasp() -> None:
    """The ablation: any closing direction is within 90 degrees of it."""
    config = MatchConfig(alpha1=math.pi / 2, alpha2=math.pi / 2)
    grasps = labelled([(0.01, 1, 0)], [(0, 0, 0)])
    one = Matcher(config).match_regions(torch.zeros(1, 3), torch.tensor([0]), torch.tensor([[1.0, 0, 0]]), grasps)
    assert one.label.tolist() == [[POSITIVE]] and one.grasp.tolist() == [[0]]


def test_regions_without_grasps_are_negative() -> None:
    match = match_at(labelled([(1, 0, 0)], [(0, 0, 0)]), (0.5, 0.0, 0.0))
    assert match.label.tolist() == [[NEGATIVE] * 4] and match.grasp.tolist() == [[NO_GRASP] * 4]


def test_points_learn_grasps_of_their_own_scene_and_object() -> None:
    x = (1.0, 0.0, 0.0)
    grasps = labelled([x] * 3, [(0, 0, 0)] * 3, [0.9, 0.8, 0.7], scene=[0, 1, 1], objects=[0, 0, 1])
    points = torch.zeros(5, 3)
    scene, objects = torch.tensor([1, 1, 0, 1, 2]), torch.tensor([0, 1, 1, -1, 0])
    match = Matcher().match_regions(points, scene, ANCHORS, grasps, objects)
    assert match.grasp[:, 0].tolist() == [1, 2, NO_GRASP, 1, NO_GRASP]
    assert match.label[:, 0].tolist() == [POSITIVE, POSITIVE, NEGATIVE, POSITIVE, NEGATIVE]


def test_pieces_give_what_the_whole_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    m, p = 300, 200
    grasps = labelled(
        [tuple(v) for v in rng.normal(size=(m, 3))],
        [tuple(v) for v in rng.uniform(-0.05, 0.05, (m, 3))],
        rng.random(m).tolist(),
        scene=sorted(rng.integers(0, 3, m).tolist()),
    )
    points = torch.from_numpy(rng.uniform(-0.05, 0.05, (p, 3)).astype(np.float32))
    scene = torch.from_numpy(rng.integers(0, 3, p))
    proposals = Pose(torch.tensor(Rotation.random(p, random_state=0).as_matrix(), dtype=torch.float32), points)
    for matcher in (Matcher(), Matcher(MatchConfig(margin1=0.0, margin2=0.0, d1=0.04, d2=0.05))):
        monkeypatch.setattr(matching, "_PAIRS", 1 << 21)
        whole = matcher.match_regions(points, scene, ANCHORS, grasps)
        whole_proposals = matcher.match_proposals(proposals, scene, grasps)
        monkeypatch.setattr(matching, "_PAIRS", 1000)
        pieces = matcher.match_regions(points, scene, ANCHORS, grasps)
        assert torch.equal(whole.label, pieces.label) and torch.equal(whole.grasp, pieces.grasp)
        assert torch.equal(whole_proposals.grasp, matcher.match_proposals(proposals, scene, grasps).grasp)
        assert set(whole.label.unique().tolist()) == {POSITIVE, NEGATIVE, IGNORED}


def test_regions_match_like_a_loop_over_points_anchors_and_grasps() -> None:
    rng = np.random.default_rng(1)
    closings = rng.normal(size=(60, 3))
    entries = rng.uniform(-0.03, 0.03, (60, 3))
    preference = rng.random(60)
    grasps = labelled([tuple(v) for v in closings], [tuple(v) for v in entries], preference.tolist())
    points = rng.uniform(-0.03, 0.03, (40, 3))
    match = match_at(grasps, *(tuple(p) for p in points.tolist()))
    closings /= np.linalg.norm(closings, axis=1, keepdims=True)
    for p, point in enumerate(points):
        distance = np.linalg.norm(point - entries, axis=1)
        utility = {g: preference[g] - 0.15 * distance[g] / 0.02 for g in range(60) if distance[g] <= 0.02}
        for a, anchor in enumerate(ANCHORS.numpy()):
            label, wanted, most = NEGATIVE, NO_GRASP, -np.inf
            for g, value in utility.items():
                angle = np.degrees(np.arccos(abs(closings[g] @ anchor)))
                below = max(utility.values()) - value
                if angle <= 60 and below <= 0.05 and value > most:
                    label, wanted, most = POSITIVE, g, value
                elif angle <= 75 and below <= 0.1 and label == NEGATIVE:
                    label = IGNORED
            assert match.label[p, a].item() == label and match.grasp[p, a].item() == wanted


# Proposals


def proposal(translation: tuple[float, float, float], turn: tuple[float, float, float] = (0, 0, 0)) -> Pose:
    """The frame of ``labelled([(1, 0, 0)])`` turned by a rotation vector in degrees, in the grasp's frame."""
    frame = rotation((1, 0, 0)) @ Rotation.from_rotvec(np.radians(turn)).as_matrix()
    return Pose(torch.tensor(frame[None], dtype=torch.float32), torch.tensor([translation], dtype=torch.float32))


def refine_label(pose: Pose, grasps: LabelledGrasps) -> int:
    return int(Matcher().match_proposals(pose, torch.tensor([0]), grasps).label.item())


@pytest.mark.parametrize(
    ("away", "turn", "label"),
    [
        (0.014, (0, 0, 0), POSITIVE),
        (0.016, (0, 0, 0), IGNORED),
        (0.021, (0, 0, 0), NEGATIVE),
        (0.0, (44, 0, 0), POSITIVE),  # about the approach: the closing direction turns
        (0.0, (46, 0, 0), IGNORED),
        (0.0, (61, 0, 0), NEGATIVE),
        (0.0, (0, 44, 0), POSITIVE),  # about the closing direction: the approach turns
        (0.0, (0, 46, 0), IGNORED),
        (0.0, (0, 61, 0), NEGATIVE),
        (0.0, (180, 0, 0), POSITIVE),  # the same jaw turned round
        (0.0, (0, 180, 0), NEGATIVE),  # the same closing direction from the other side
        (0.016, (44, 0, 0), IGNORED),
        (0.014, (0, 61, 0), NEGATIVE),
    ],
)
def test_bands_of_proposals(away: float, turn: tuple[float, float, float], label: int) -> None:
    grasps = labelled([(1, 0, 0)], [(0, 0, -0.03)])  # its centre is the origin
    assert refine_label(proposal((0.0, away, 0.0), turn), grasps) == label


def test_a_proposal_is_negative_only_if_it_is_far_from_every_grasp() -> None:
    grasps = labelled([(1, 0, 0), (1, 0, 0)], [(0, 0, -0.03), (0.03, 0, -0.03)])
    assert refine_label(proposal((0.012, 0.0, 0.0)), grasps) == POSITIVE
    assert refine_label(proposal((0.0151, 0.0, 0.0)), grasps) == POSITIVE  # of the second one
    assert refine_label(proposal((-0.018, 0.0, 0.0)), grasps) == IGNORED
    assert refine_label(proposal((-0.021, 0.0, 0.0)), grasps) == NEGATIVE


def test_a_proposal_learns_the_preferred_grasp_among_near_ones() -> None:
    x = [(1, 0, 0), (1, 0, 0)]
    grasps = labelled(x, [(0, 0, -0.03), (0.005, 0, -0.03)], [0.5, 0.7])
    assert Matcher().match_proposals(proposal((0, 0, 0)), torch.tensor([0]), grasps).grasp.tolist() == [1]
    grasps = labelled(x, [(0, 0, -0.03), (0.005, 0, -0.03)], [0.5, 0.55])
    assert Matcher().match_proposals(proposal((0, 0, 0)), torch.tensor([0]), grasps).grasp.tolist() == [0]


def test_proposals_of_another_scene_are_negative() -> None:
    grasps = labelled([(1, 0, 0)], [(0, 0, -0.03)], scene=[1])
    match = Matcher().match_proposals(proposal((0, 0, 0)), torch.tensor([0]), grasps)
    assert match.label.tolist() == [NEGATIVE] and match.grasp.tolist() == [NO_GRASP]


# Targets


def test_region_targets_decode_to_the_matched_grasps() -> None:
    grasps = labelled([(1, 1, 1), (1, -1, -1), (0, 1, 0)], [(0, 0, 0), (0.005, 0, 0), (0.3, 0, 0)], [0.9, 0.89, 0.4])
    points = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.6, 0.0, 0.0]])
    match = Matcher().match_regions(points, torch.zeros(3, dtype=torch.int64), ANCHORS, grasps)
    target = region_targets(GraspCoder(), points, match, grasps)
    assert target.residual.shape == (3, 4, RESIDUALS) and target.quality.shape == (3, 4)
    for p, a in (match.label == POSITIVE).nonzero().tolist():
        wanted = match.grasp[p, a]
        pose = GraspCoder().decode(points[p], torch.tensor(a), target.residual[p, a])
        assert torch.allclose(pose.translation, grasps.pose.translation[wanted], atol=1e-6)
        assert torch.allclose(pose.approach, grasps.pose.approach[wanted], atol=1e-6)
        assert target.quality[p, a] == grasps.score[wanted]
    assert (target.residual[match.label != POSITIVE] == 0).all()
    assert target.quality[0].tolist() == pytest.approx([0.9, math.nan, 0.89, math.nan], nan_ok=True)


def test_proposal_targets_decode_to_the_matched_grasps() -> None:
    grasps = labelled([(1, 0, 0)], [(0, 0, -0.03)], [0.8])
    near, far = proposal((0.004, 0.0, 0.0), (10, -20, 5)), proposal((0.2, 0.0, 0.0))
    both = Pose(torch.cat([near.rotation, far.rotation]), torch.cat([near.translation, far.translation]))
    match = Matcher().match_proposals(both, torch.tensor([0, 0]), grasps)
    target = proposal_targets(RefineCoder(), both, match, grasps)
    assert target.label.tolist() == [POSITIVE, NEGATIVE]
    assert target.quality.tolist() == pytest.approx([0.8, math.nan], nan_ok=True) and (target.residual[1] == 0).all()
    pose = RefineCoder().decode(near, target.residual[:1])
    assert torch.allclose(pose.translation[0], grasps.pose.translation[0], atol=1e-6)
    assert torch.allclose(pose.rotation[0], grasps.pose.rotation[0], atol=1e-6)


def test_a_batch_without_any_grasp_has_negative_targets() -> None:
    nothing = labelled([], [], [])
    points = torch.zeros(2, 3)
    match = match_at(nothing, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    target = region_targets(GraspCoder(), points, match, nothing)
    assert (target.label == NEGATIVE).all() and target.residual.shape == (2, 4, RESIDUALS)
    refined = Matcher().match_proposals(proposal((0, 0, 0)), torch.tensor([0]), nothing)
    assert proposal_targets(RefineCoder(), proposal((0, 0, 0)), refined, nothing).label.tolist() == [NEGATIVE]


# Preference


def batch(contacts: tuple[float, float], closing: tuple[float, float, float], entry: float, score: float) -> GraspBatch:
    """One scene with one grasp from above and W = 0.08 m."""
    frame = torch.tensor(rotation(closing)[None], dtype=torch.float32)
    none = torch.zeros(0)
    return GraspBatch(
        points=none, colors=none, confidence=none, object_index=none, width=torch.tensor([0.08]), viewpoint=none,
        turn=none, translation=torch.zeros(1, 3), rotation=frame, score=torch.tensor([score]),
        contacts=torch.tensor([contacts]), entry_point=entry * frame[:, :, 0], grasp_object=torch.tensor([3]),
        grasp_batch=torch.tensor([0]), scene=(0,), view=(0,),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("contacts", "closing", "entry", "expected"),
    [
        ((-0.02, 0.02), (1, 0, 0), 0.03, 0.5 + 0.2 + 0.3),
        ((-0.02, 0.04), (1, 0, 0), 0.03, 0.5 + 0.2 + 0.3 * 0.75),  # 0.01 m off the middle, of 0.04 m
        ((-0.02, 0.02), (1, 0, 0), 0.015, 0.5 + 0.2 + 0.3 - 0.2 * 0.5),
        ((-0.02, 0.02), (0, 1, 1), 0.03, 0.5 + 0.2 * 0.75 + 0.3),  # the approach leans by 45 degrees
    ],
)
def test_preference_by_hand(
    contacts: tuple[float, float], closing: tuple[float, float, float], entry: float, expected: float
) -> None:
    grasps = LabelledGrasps.of(batch(contacts, closing, entry, 0.5), MatchConfig())
    assert grasps.preference.item() == pytest.approx(expected, abs=1e-6)
    assert grasps.score.item() == 0.5 and grasps.object_index.tolist() == [3]


@pytest.mark.parametrize(
    "wrong", [{"radius": 0.0}, {"alpha1": 1.4}, {"d2": 0.01}, {"distance_weight": -0.1}, {"margin1": 0.3}]
)
def test_impossible_limits_are_refused(wrong: dict) -> None:
    with pytest.raises(InvalidInputError):
        MatchConfig(**wrong)


def test_limits_are_those_of_the_paper() -> None:
    cfg = MatchConfig()
    assert (math.degrees(cfg.alpha1), math.degrees(cfg.alpha2)) == pytest.approx((60, 75))
    assert (cfg.d1, cfg.d2) == (0.015, 0.020)
    assert [math.degrees(v) for v in (cfg.beta1, cfg.beta2, cfg.gamma1, cfg.gamma2)] == pytest.approx([45, 60, 45, 60])
