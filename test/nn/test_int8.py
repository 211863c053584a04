"""Layers as products of bytes: exact where bytes hold the numbers, and near the float layers elsewhere."""

import copy

import pytest
import torch
from scenes import batch, tabletop

from regnet_core.nn import int8
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.config import AbstractionConfig, NetworkConfig, RefinementConfig, RegionConfig
from regnet_core.nn.files import load_network
from regnet_core.nn.int8 import Packed, has_byte_products
from regnet_core.nn.layers import DenseLayer, Mlp
from regnet_core.nn.network import RegNet
from regnet_core.nn.pooling import PooledMlp
from regnet_core.ops.bytes import Gathered, Own, bytes_of_rows, bytes_of_sum, largest_bytes, room_for
from regnet_core.ops.neighbourhoods import Neighbourhoods
from regnet_core.weights import weights_file

needs_products = pytest.mark.skipif(not has_byte_products(), reason="this torch does not multiply bytes")
MIDDLE = NetworkConfig(
    points=1500,
    abstractions=(
        AbstractionConfig(300, 0.03, 16, (32, 48)),
        AbstractionConfig(80, 0.08, 16, (48, 64)),
        AbstractionConfig(20, 0.3, 16, (64, 96)),
    ),
    propagations=((80, 80), (64,), (48, 40)),
    head=(64, 32),
    positives=40,
    region=RegionConfig(0.03, 32),
    refinement=RefinementConfig(16, (48, 32), fusion=(40,), margin=0.01, point_features=True, passes=2),
)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def test_sums_by_hand() -> None:
    values = torch.tensor([[0.2, -3.0], [0.4, 0.5]])
    gathered = Gathered(values, torch.tensor([[0, 1], [1, 1]]), torch.tensor([[0.5, 0.25], [1.0, 1.0]]))
    own = Own(torch.tensor([[1.0], [2.0]]), torch.tensor([[0.1, 0.0]]))
    rows, bias = torch.tensor([[0.0, 2.0], [0.0, 0.0]]), torch.tensor([0.05, 0.0])
    # 0.5 * 0.2 + 0.25 * 0.4 + 0.1 + 0.05 = 0.35, -1.5 + 0.125 + 2 = 0.625; 0.8 + 0.2 + 0.05 is above 1, 1 is 255.
    assert bytes_of_sum(gathered, own, rows, bias)[:2].tolist() == [[89, 159], [255, 255]]
    assert bytes_of_sum(Gathered(values, torch.tensor([[0], [1]])))[:2].tolist() == [[51, 0], [102, 128]]
    assert bytes_of_sum(own=own, bias=bias)[:2].tolist() == [[38, 0], [64, 0]]
    assert bytes_of_sum(Gathered(values, torch.zeros((0, 1), dtype=torch.int64))).shape == (256, 2)


def test_rows_have_room_for_few_different_numbers() -> None:
    assert [room_for(n) for n in (0, 1, 256, 257, 288, 289, 4096, 4097, 46257)] == [
        256, 256, 256, 288, 288, 320, 4096, 4608, 49152,
    ]  # fmt: skip
    rooms = {room_for(n) for n in range(1 << 16)}
    assert len(rooms) == 8 * 8 + 1 and all(n <= room_for(n) <= max(n * 1.125, 256) for n in range(1, 1 << 16))


def test_many_sums_equal_those_of_torch() -> None:
    g = generator()
    values, weight = torch.randn(500, 70, generator=g) * 0.3, torch.randn(5, 70, generator=g)
    indices, columns = torch.randint(0, 500, (3000, 3), generator=g), torch.randn(3000, 5, generator=g) * 0.1
    shares = torch.rand(3000, 3, generator=g)
    found = bytes_of_sum(Gathered(values, indices, shares), Own(columns, weight))
    expected = ((values[indices] * shares[:, :, None]).sum(dim=1) + columns @ weight) * 255.0
    assert (found[:3000].float() - expected.clamp(0.0, 255.0)).abs().max() < 0.51


def test_rows_become_bytes_of_one_unit() -> None:
    rows = torch.tensor([[0.0, 1.0, 0.5], [0.1, 0.25, 2.0]])
    taken, unit = bytes_of_rows(rows)
    assert taken[:2].tolist() == [[0, 128, 64], [13, 32, 255]] and unit == pytest.approx(2.0 / 255.0)
    assert bytes_of_rows(torch.zeros(2, 3))[0][:2].tolist() == [[0] * 3] * 2
    assert bytes_of_rows(torch.zeros(0, 3))[0].shape == (256, 3)


def test_largest_bytes_of_segments() -> None:
    values = torch.tensor([[1, 200], [3, 100], [255, 0], [0, 7]], dtype=torch.uint8)
    assert largest_bytes(values, torch.tensor([0, 2, 2, 4])).tolist() == [[3, 200], [0, 0], [255, 7]]


@needs_products
def test_products_of_bytes_are_exact() -> None:
    g = generator()
    weight = torch.randint(-127, 128, (40, 64), generator=g).float()
    weight[:, 0] = 127.0  # so that a byte of the weights stands for 1
    rows = torch.randint(0, 256, (300, 64), generator=g, dtype=torch.uint8)
    bias = torch.randn(40, generator=g)
    expected = rows.double() @ weight.t().double() + bias
    packed = Packed.of(weight, bias)
    found = packed(rows, 1.0, rectified=False, as_bytes=False)
    torch.testing.assert_close(found.double(), expected, rtol=1e-6, atol=0.05)
    found = packed(rows, 1e-6, rectified=True, as_bytes=True)
    expected = ((rows.double() @ weight.t().double() * 1e-6 + bias) * 255.0).clamp(0.0, 255.0)
    assert (found.double() - expected).abs().max() < 0.51


def settled(mlp: Mlp, inputs: int) -> Mlp:
    """The layers in evaluation, with statistics of what they have seen and uneven channels."""
    g = generator()
    for layer in mlp:
        assert isinstance(layer, DenseLayer)
        layer.norm.weight.data = torch.rand(layer.norm.num_features, generator=g) * 2.0 + 0.05
        layer.norm.bias.data = torch.randn(layer.norm.num_features, generator=g) * 0.5
    mlp.train()
    with torch.no_grad():
        for _ in range(60):
            mlp(torch.rand(400, inputs, generator=g) * torch.linspace(0.1, 3.0, inputs))
    return mlp.eval()


@needs_products
def test_layers_in_bytes_are_near_those_in_floats() -> None:
    torch.manual_seed(0)
    mlp = settled(Mlp(64, (96, 80, 48)), 64)
    rows = torch.rand(5000, 64, generator=generator()) * torch.linspace(0.1, 3.0, 64)  # more than a tile
    with torch.no_grad():
        expected = mlp(rows)
        mlp.use_bytes()
        found = mlp(rows)
    assert mlp.in_bytes() is None and not torch.equal(found, expected)  # with gradients there are no bytes
    error = (found - expected).square().mean().sqrt() / expected.std()
    assert error < 0.05, error
    copied = copy.deepcopy(mlp)
    mlp.eval()
    with torch.no_grad():
        assert torch.equal(mlp(rows), expected) and torch.equal(copied(rows), expected)


@needs_products
def test_pooled_layers_in_bytes_are_near_those_in_floats() -> None:
    torch.manual_seed(0)
    mlp = settled(PooledMlp(40, (64, 48)), 40)
    assert isinstance(mlp, PooledMlp)
    g = generator()
    features, own = torch.rand(600, 37, generator=g), torch.rand(6000, 3, generator=g)
    counts = torch.randint(0, 40, (300,), generator=g)
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    near = Neighbourhoods(torch.randint(0, 600, (int(offsets[-1]),), generator=g), offsets)
    starts = {int(offset): int(offset) for offset in offsets}

    def brought(some: slice, part: Neighbourhoods) -> torch.Tensor:
        first = starts[int(offsets[some.start or 0])]
        return own[first : first + len(part.indices)]

    with torch.no_grad():
        expected = mlp.pooled(brought, 3, mlp.carried(3, features), near)
        mlp.use_bytes()
        found = mlp.pooled(brought, 3, mlp.carried(3, features), near)
        nobody = Neighbourhoods(near.indices[:0], offsets[:1])
        assert mlp.pooled(brought, 3, mlp.carried(3, features), nobody).shape == (0, 48)
        lonely = Neighbourhoods(near.indices[:0], torch.zeros(3, dtype=torch.int64))
        none = mlp.pooled(lambda some, part: own[:0], 3, mlp.carried(3, features), lonely)
        assert none.tolist() == [[0.0] * 48] * 2
    assert (found[counts == 0] == 0.0).all() and (counts == 0).any()
    error = (found - expected).square().mean().sqrt() / expected.std()
    assert 0.0 < error < 0.05, error


@needs_products
def test_a_network_of_any_shape_runs_in_bytes() -> None:
    torch.manual_seed(0)
    for config in (MIDDLE, MIDDLE.replace(shape_radius=0.03, region=None, grasp_heads=0), MIDDLE.replace(layer=2)):
        net = RegNet(config).train()
        with torch.no_grad():
            for _ in range(40):
                net(batch(900, 600))
        net.eval()
        clouds = batch(800, 700)
        with torch.inference_mode():
            expected = net(clouds)
            net.use_bytes()
            found = net(clouds)
        ours, theirs = found.proposed, expected.proposed
        error = (ours.features - theirs.features).square().mean().sqrt() / theirs.features.std()
        assert 0.0 < error < 0.25, error
        assert ours.features.dtype == torch.float32 and torch.isfinite(ours.anchors.residual).all()
        with torch.inference_mode():
            nothing = net(clouds, eligible=torch.zeros(1500, dtype=torch.bool))
        assert len(nothing.candidates.region) == 0 and not nothing.proposed.confidence.isfinite().any()


@needs_products
@pytest.mark.parametrize("seed", [0, 1])
def test_the_trained_network_says_the_same_in_bytes(seed: int) -> None:
    net, _ = load_network(weights_file("regnetv2-s").path)
    clouds = Clouds.of([tabletop(9000, seed)], [0.08])
    with torch.inference_mode():
        expected = net(clouds)
        net.use_bytes()
        found = net(clouds)
    ours, theirs = found.proposed.confidence, expected.proposed.confidence
    assert (ours - theirs).square().mean().sqrt() < 0.08 * theirs.std()
    chosen, wanted = (set(output.proposed.regions.source.tolist()) for output in (found, expected))
    assert len(chosen & wanted) > 0.95 * len(wanted)


def test_without_such_products_there_is_no_use_in_trying(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*arguments: object) -> None:
        raise AttributeError("no such operation")

    monkeypatch.setattr(int8.Packed, "of", missing)
    assert not has_byte_products.__wrapped__()
