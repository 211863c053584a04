"""The network: the same as a plain padded implementation, trainable in every part, deterministic, and robust."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from scenes import batch, tabletop

from benchmarks import padded
from regnet_core.errors import CloudError, InvalidInputError, ModelError
from regnet_core.gripper import Gripper
from regnet_core.nn import layers, pooling, refinement, tiles
from regnet_core.nn import network as network_module
from regnet_core.nn.anchors import CoderConfig
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.config import AbstractionConfig, NetworkConfig, RefinementConfig, RegionConfig
from regnet_core.nn.hierarchy import build_hierarchy
from regnet_core.nn.layers import DenseLayer
from regnet_core.nn.network import RegNet
from regnet_core.nn.point_features import PointFeatures
from regnet_core.nn.results import Output, expected_quality
from regnet_core.nn.zoo import NETWORKS, WITHOUT_ANCHORS, network_config
from regnet_core.ops import ball_query, box_query, farthest_points, grasp_frame, interpolation, segments

TINY = NetworkConfig(
    name="tiny",
    points=1500,
    abstractions=(
        AbstractionConfig(300, 0.03, 16, (8, 12)),
        AbstractionConfig(80, 0.08, 16, (12, 16)),
        AbstractionConfig(20, 0.3, 16, (16, 24)),
    ),
    propagations=((20, 20), (16,), (14, 12)),
    head=(16, 12),
    positives=40,
    region=RegionConfig(0.03, 12),
    refinement=RefinementConfig(8, (16, 12)),
)
REFINEMENT = RefinementConfig(8, (16, 12), fusion=(10,), margin=0.01, point_features=True)
VARIANTS = {
    "layer1": TINY,
    "layer2": TINY.replace(layer=2),
    "layer3": TINY.replace(layer=3),
    "no width": TINY.replace(width=False),
    "colour": TINY.replace(colour=True),
    "colour, no width": TINY.replace(colour=True, width=False),
    "no anchors": TINY.replace(coder=WITHOUT_ANCHORS),
    "no region": TINY.replace(region=None),
    "no refinement": TINY.replace(refinement=None),
    "shared grasp head": TINY.replace(grasp_heads=1),
    "no grasp head": TINY.replace(grasp_heads=0),
    "rich refinement": TINY.replace(colour=True, refinement=REFINEMENT),
    "shapes": TINY.replace(shape_radius=0.03),
    "shapes, colour, rich refinement": TINY.replace(shape_radius=0.03, colour=True, refinement=REFINEMENT),
}
every_variant = pytest.mark.parametrize("config", VARIANTS.values(), ids=VARIANTS)


def network(config: NetworkConfig, seed: int = 0) -> RegNet:
    torch.manual_seed(seed)
    net = RegNet(config).eval()
    padded.randomise_norms(net, seed)
    return net


def numbers(output: Output) -> list[torch.Tensor]:
    proposed, refined = output.proposed, output.refined
    return [
        proposed.features, proposed.confidence, proposed.regions.source, proposed.region_features, *proposed.anchors,
        *output.candidates.pose, *(() if refined is None else (*refined.prediction, refined.occupied)),
    ]  # fmt: skip


@every_variant
def test_equals_the_padded_implementation(config: NetworkConfig) -> None:
    net, clouds, gripper = network(config), batch(1500, width=0.1), Gripper(height=0.03)
    with torch.no_grad():
        output = net(clouds, gripper)
        features = padded.backbone_features(net, clouds)
        close(output.proposed.features, features)
        close(output.proposed.confidence, padded.confidence(net, features))
        pooled = padded.region_features(net, clouds, features, output.proposed.regions.source)
        close(output.proposed.region_features, pooled)
        logit, rest = padded.anchor_numbers(net, pooled)
        close(output.proposed.anchors.logit, logit)
        close(output.proposed.anchors.residual, rest[..., :8])
        close(output.proposed.anchors.quality, rest[..., 8])
        if output.refined is None:
            return
        logit, rest = padded.refined_numbers(net, clouds, features, pooled, output.candidates, gripper)
    seen = output.refined.occupied
    assert seen.sum() > 10
    close(output.refined.prediction.logit[seen], logit[seen])
    close(output.refined.prediction.residual[seen], rest[seen, :8])
    close(output.refined.prediction.quality[seen], rest[seen, 8])


def close(got: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


@every_variant
def test_gradients_reach_every_parameter(config: NetworkConfig) -> None:
    net, clouds = network(config).train(), batch(1500, 1400)
    output = net(clouds, Gripper(height=0.03))
    proposed, loss = output.proposed, torch.zeros(())
    for part in (
        proposed.confidence,
        *proposed.anchors,
        *(() if output.refined is None else output.refined.prediction),
    ):
        assert part.dtype == torch.float32
        loss = loss + part.square().mean() + part.mean()
    loss.backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all() and parameter.grad.abs().sum() > 0, name


def test_a_batch_gives_what_its_clouds_give() -> None:
    net, sizes = network(VARIANTS["rich refinement"]), (700, 1500, 90)
    clouds = batch(*sizes)
    rows = clouds.slices()
    assert clouds.colors is not None
    with torch.no_grad():
        together = net(clouds)
        alone = [
            net(Clouds.of([clouds.points[own]], [float(w)], [clouds.colors[own]]))
            for own, w in zip(rows, clouds.width, strict=True)
        ]
    close(together.proposed.features, torch.cat([one.proposed.features for one in alone]))
    bounds = together.proposed.regions.offsets.tolist()
    assert bounds == [0, 40, 80, 120] and together.proposed.regions.cloud.unique().tolist() == [0, 1, 2]
    for i, one in enumerate(alone):
        some = slice(bounds[i], bounds[i + 1])
        assert torch.equal(together.proposed.regions.source[some] - rows[i].start, one.proposed.regions.source)
        close(together.proposed.anchors.residual[some], one.proposed.anchors.residual)
        assert together.refined is not None and one.refined is not None
        close(together.refined.prediction.residual[some], one.refined.prediction.residual)


def test_most_promising_proposals_of_each_cloud_are_refined() -> None:
    refinement = dataclasses.replace(REFINEMENT, passes=2)
    clouds = batch(1500, 900)
    every = TINY.replace(colour=True, refinement=refinement)
    some = every.replace(refinement=dataclasses.replace(refinement, proposals=(30, 11)))
    full, net = network(every), network(some)
    with torch.no_grad():
        proposed = full.propose(clouds)
        candidates = full.best_anchors(proposed)
        quality = expected_quality(proposed.anchors)[candidates.region, candidates.anchor].reshape(2, 40)
        chosen = torch.cat([cloud.topk(30).indices.sort().values + 40 * i for i, cloud in enumerate(quality)])
        first = full.refine(candidates.take(chosen), proposed, clouds)
        worth = torch.where(first.occupied, first.prediction.quality, -torch.inf)
        region = candidates.region[chosen]
        best = torch.full((80,), -torch.inf).scatter_reduce(0, region, worth, "amax").reshape(2, 40)
        expected = torch.cat([cloud.topk(11).indices.sort().values + 40 * i for i, cloud in enumerate(best)])
        output = net(clouds)
    assert torch.equal(output.candidates.region, expected)
    assert output.refined is not None and len(output.refined.occupied) == 22
    assert len(full(clouds).candidates.region) == 80


def test_positive_points_are_the_most_confident_of_their_layer() -> None:
    for layer, candidates in ((1, 1500), (2, 300), (3, 80)):
        net, clouds = network(TINY.replace(layer=layer)), batch(1500)
        with torch.no_grad():
            proposed = net.propose(clouds)
        source = torch.arange(1500) if layer == 1 else proposed.hierarchy.levels[layer - 2].source
        assert len(source) == candidates
        best = source[proposed.confidence[source].sort(descending=True, stable=True).indices[:40]]
        assert torch.equal(proposed.regions.source, best)


@pytest.mark.parametrize("layer", [1, 2])
def test_confidence_is_computed_where_it_is_needed(layer: int) -> None:
    net, clouds = network(TINY.replace(layer=layer, least_confidence=0.05)), batch(900, 600)
    eligible = clouds.points[:, 0] > clouds.points[:, 0].median()
    with torch.no_grad():
        every, some = net.propose(clouds), net.propose(clouds, eligible=eligible)
    known = some.confidence.isfinite()
    candidates = eligible.clone()
    if layer == 2:
        candidates[:] = False
        candidates[every.hierarchy.levels[0].source] = True
        candidates &= eligible
    assert torch.equal(known, candidates) and 0 < known.sum() < 1000
    torch.testing.assert_close(some.confidence[known], every.confidence[known], atol=1e-5, rtol=1e-5)
    chosen = some.regions.source
    assert len(chosen) > 0 and candidates[chosen].all() and (some.confidence[chosen].sigmoid() >= 0.05).all()


def test_positive_points_can_be_given() -> None:
    clouds = batch(300, 400)
    proposed = network(TINY).propose(clouds, positives=torch.tensor([299, 7, 300, 650]))
    assert proposed.regions.cloud.tolist() == [0, 0, 1, 1] and proposed.regions.offsets.tolist() == [0, 2, 4]
    assert torch.equal(proposed.regions.points, clouds.points[[299, 7, 300, 650]])
    assert proposed.anchors.logit.shape == (4, 4)


def test_the_width_matters_where_it_is_an_input() -> None:
    def change(config: NetworkConfig) -> float:
        net = network(config)
        with torch.no_grad():
            narrow, wide = (net(batch(1500, width=w)).proposed.confidence for w in (0.06, 0.12))
        return float((narrow - wide).abs().max())

    assert change(TINY) > 1e-3
    assert change(TINY.replace(width=False)) == 0.0


def test_where_the_origin_is_does_not_matter() -> None:
    net, clouds = network(TINY), batch(1500)
    moved = clouds._replace(points=clouds.points + torch.tensor([0.5, -0.25, 0.125]))
    with torch.no_grad():
        a, b = net.propose(clouds), net.propose(moved)
    torch.testing.assert_close(a.confidence, b.confidence, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_the_same_input_gives_the_same_output_and_gradients(precision: str) -> None:
    clouds, results = batch(1500, 900), []
    for _ in range(2):
        net = network(VARIANTS["rich refinement"]).train()
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            output = net(clouds)
        assert output.refined is not None
        (output.proposed.confidence.sum() + output.refined.prediction.residual.square().sum()).backward()
        results.append([*numbers(output), *(p.grad for p in net.parameters() if p.grad is not None)])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


@every_variant
def test_bfloat16_is_close_to_float32(config: NetworkConfig) -> None:
    net, clouds = network(config), batch(1500)
    with torch.no_grad():
        high = net.propose(clouds)
        with torch.autocast("cpu", torch.bfloat16):
            low = net(clouds, hierarchy=high.hierarchy)
    error = (low.proposed.features.float() - high.features).square().mean().sqrt()
    assert error < 0.03 * high.features.square().mean().sqrt()
    assert all(part.dtype == torch.float32 and part.isfinite().all() for part in low.proposed.anchors)


def test_the_functions_in_torch_give_what_the_kernels_give(monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs on other devices, run here."""
    net, clouds = network(VARIANTS["rich refinement"]), batch(1500, 800)
    with torch.no_grad():
        expected = net(clouds, Gripper(height=0.03))
    monkeypatch.setattr(
        farthest_points, "_sampled_on_cpu", lambda *a: farthest_points.farthest_points_in_torch(*a[:-1])
    )
    monkeypatch.setattr(ball_query, "_queried_on_cpu", lambda *a: ball_query.ball_query_in_torch(*a[:-1]))
    monkeypatch.setattr(box_query, "_queried_on_cpu", lambda *a: box_query.box_query_in_torch(*a[:-1]))
    monkeypatch.setattr(interpolation, "three_nearest_on_cpu", lambda *a: interpolation.three_nearest_in_torch(*a[:2]))
    monkeypatch.setattr(segments, "has_kernel", lambda values: False)
    monkeypatch.setattr(refinement, "seen_from_grasps", grasp_frame.seen_from_grasps_in_torch)
    with torch.no_grad():
        found = net(clouds, Gripper(height=0.03))
    assert torch.equal(found.proposed.hierarchy.levels[0].source, expected.proposed.hierarchy.levels[0].source)
    for a, b in zip(numbers(found), numbers(expected), strict=True):
        close(a, b)


@every_variant
def test_features_where_they_are_needed_give_what_those_of_all_points_give(
    config: NetworkConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    net, clouds = network(config), batch(1500, 800)
    eligible = torch.rand(len(clouds.points), generator=torch.Generator().manual_seed(0)) < 0.2
    asked = []
    fine = net.backbone.fine
    monkeypatch.setattr(net.backbone, "fine", lambda coarse, rows: asked.append(rows) or fine(coarse, rows))
    with torch.no_grad():
        some = net(clouds, Gripper(height=0.03), eligible=eligible)
        assert asked and all(rows is not None and len(rows) < len(clouds.points) for rows in asked)
        everywhere = torch.cat([rows for rows in asked if rows is not None])
        assert len(everywhere.unique()) == len(everywhere), "none is computed twice"
        monkeypatch.setattr(network_module, "PointFeatures", lambda *given: PointFeatures(*given[:3], of_all=True))
        expected = net(clouds, Gripper(height=0.03), eligible=eligible)
    for a, b in zip(numbers(some)[1:], numbers(expected)[1:], strict=True):
        close(a, b)
    close(some.proposed.features[everywhere], expected.proposed.features[everywhere])


@every_variant
def test_tiles_do_not_change_the_result(config: NetworkConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    net, clouds = network(config), batch(1500, 300)
    with torch.no_grad():
        expected = net(clouds)
        for module in (layers, pooling, tiles):
            monkeypatch.setattr(module, "TILE", 37)
        found = net(clouds, hierarchy=expected.proposed.hierarchy)
    for a, b in zip(numbers(found), numbers(expected), strict=True):
        close(a, b)


def test_levels_are_nested() -> None:
    clouds = batch(1500, 200)
    levels = build_hierarchy(clouds, TINY).to("cpu").levels
    assert [level.offsets.tolist() for level in levels] == [[0, 300, 500], [0, 80, 160], [0, 20, 40]]
    below = clouds.points
    for level in levels:
        assert torch.equal(level.points, clouds.points[level.source])
        assert torch.equal(level.points, below[level.below])
        own = torch.repeat_interleave(torch.arange(2), level.offsets.diff())
        reach = (below[level.neighbours.indices] - level.points[level.neighbours.centres()]).norm(dim=1)
        assert len(own) == len(level.points) and level.neighbours.counts.min() >= 1 and reach.max() <= 0.3
        below = level.points


def test_a_hierarchy_may_be_made_ahead() -> None:
    net, clouds = network(TINY), batch(1500)
    with torch.no_grad():
        pairs = zip(numbers(net(clouds)), numbers(net(clouds, hierarchy=build_hierarchy(clouds, TINY))), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("sizes", [(0,), (0, 300), (300, 0), (0, 0)])
def test_empty_clouds(sizes: tuple[int, ...]) -> None:
    clouds = Clouds.of([tabletop(size) for size in sizes], [0.08] * len(sizes))
    with torch.no_grad():
        output = network(TINY)(clouds)
    counts = [min(40, size) for size in sizes]
    assert output.proposed.regions.offsets.diff().tolist() == counts
    assert output.proposed.anchors.residual.shape == (sum(counts), 4, 8)


@pytest.mark.parametrize("mode", ["train", "eval"])
@pytest.mark.parametrize("cloud", [torch.ones(1, 3), torch.ones(50, 3), tabletop(3), tabletop(30)])
def test_tiny_and_degenerate_clouds(cloud: torch.Tensor, mode: str) -> None:
    net = network(TINY).train(mode == "train")
    output = net(Clouds.of([cloud], [0.08]))
    assert len(output.proposed.regions.source) == min(40, len(cloud))
    assert all(part.isfinite().all() for part in output.proposed.anchors)


def test_an_empty_closing_area_is_reported() -> None:
    net, clouds = network(TINY), batch(1500)
    proposed = net.propose(clouds)
    candidates = net.best_anchors(proposed)
    away = candidates.pose._replace(translation=candidates.pose.translation + 1.0)
    refined = net.refine(candidates._replace(pose=away), proposed, clouds)
    assert not refined.occupied.any() and refined.prediction.logit.isfinite().all()


def test_folded_normalisation_equals_the_layers_themselves() -> None:
    layer = DenseLayer(6, 5).eval()
    padded.randomise_norms(layer, 3)
    rows = torch.randn(20, 6, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(layer(rows), torch.relu(layer.norm(layer.linear(rows))))
    layer.train()
    before = layer.norm.running_mean.clone()
    layer(rows[:1])
    assert torch.equal(layer.norm.running_mean, before), "one row has no statistics"
    layer(rows)
    assert not torch.equal(layer.norm.running_mean, before)


@pytest.mark.parametrize("name", ["regnetv2", "regnetv2-s", "regnetv2-s-layer2"])
def test_a_cloud_of_full_size(name: str) -> None:
    net, clouds = network(network_config(name)), batch(25600, side=0.7)
    count = {"regnetv2": 768}.get(name, 256)
    for enabled in (False, True):
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            output = net(clouds)
        assert output.proposed.confidence.shape == (25600,) and output.proposed.anchors.residual.shape == (768, 4, 8)
        assert output.refined is not None and output.refined.prediction.residual.shape == (count, 8)


def test_networks_by_name() -> None:
    assert all(config.name == name for name, config in NETWORKS.items())
    assert NETWORKS["regnet"].positives == 64 and not NETWORKS["regnet"].width


def test_what_is_missing_is_said() -> None:
    clouds = batch(100)._replace(colors=None)
    with pytest.raises(CloudError, match="'tiny' needs the points' colours"):
        network(TINY.replace(colour=True)).propose(clouds)
    net = network(TINY.replace(refinement=None))
    proposed = net.propose(clouds)
    with pytest.raises(ModelError, match="'tiny' has no refinement"):
        net.refine(net.best_anchors(proposed), proposed, clouds)
    with pytest.raises(CloudError, match="one width"):
        Clouds.of([torch.zeros(4, 3)], [])
    with pytest.raises(CloudError, match=r"\(n, 3\), got \(4, 2\)"):
        Clouds.of([torch.zeros(4, 2)], [0.08])


WRONG: dict[str, Callable[[], object]] = {
    "layer must be 1 to 3, got 4": lambda: TINY.replace(layer=4),
    "grasp_heads must be 0, 1 or 2, got 3": lambda: TINY.replace(grasp_heads=3),
    "positives must be": lambda: TINY.replace(positives=0),
    "as many feature propagations as set abstractions": lambda: TINY.replace(propagations=((4,),)),
    "at most the centroids of the last": lambda: TINY.replace(abstractions=TINY.abstractions[::-1]),
    "radius must be": lambda: dataclasses.replace(TINY.abstractions[0], radius=0.0),
    "at least one number of channels": lambda: dataclasses.replace(TINY.abstractions[0], channels=()),
    "each above 0": lambda: RefinementConfig(channels=(3, 0)),
    "margin must be": lambda: RefinementConfig(margin=-0.01),
    "points must be": lambda: RegionConfig(points=0),
    "at least one closing direction": lambda: TINY.replace(coder=CoderConfig(anchors=())),
}


@pytest.mark.parametrize("message", WRONG)
def test_configurations_that_make_no_sense_are_refused(message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        WRONG[message]()


def test_folded_numbers_are_forgotten_when_the_numbers_change() -> None:
    layer, rows = DenseLayer(3, 4).eval(), torch.randn(6, 3)
    other = DenseLayer(3, 4).eval()
    with torch.no_grad():
        before, expected = layer(rows), other(rows)
        assert torch.equal(layer(rows), before)
        with torch.autocast("cpu", torch.bfloat16):
            assert layer(rows).dtype == torch.bfloat16
        assert layer(rows).dtype == torch.float32
        layer.load_state_dict(other.state_dict())
        assert torch.equal(layer(rows), expected)
        layer.linear.weight.mul_(0.0)
        assert torch.equal(layer.eval()(rows), torch.relu(layer.linear_part().bias).expand(6, 4))
    assert layer(rows).requires_grad
