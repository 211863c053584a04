"""Layers as products of bytes: exact where bytes hold the numbers, and near the float layers elsewhere."""

import copy
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from llvmlite import binding
from scenes import batch, tabletop

from regnet_core.nn.clouds import Clouds
from regnet_core.nn.config import AbstractionConfig, NetworkConfig, RefinementConfig, RegionConfig
from regnet_core.nn.files import load_network
from regnet_core.nn.int8 import rounded
from regnet_core.nn.layers import DenseLayer, Mlp
from regnet_core.nn.network import RegNet
from regnet_core.nn.pooling import PooledMlp
from regnet_core.ops.bytes import (
    Gathered,
    Layers,
    Own,
    Sum,
    bytes_of_sum,
    floats_of_rows,
    floats_of_sum,
    largest_of_sum,
)
from regnet_core.ops.neighbourhoods import Neighbourhoods
from regnet_core.weights import weights_file

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
    assert bytes_of_sum(Sum(gathered, own, rows, bias)).tolist() == [[89, 159], [255, 255]]
    assert bytes_of_sum(Sum(Gathered(values, torch.tensor([[0], [1]])))).tolist() == [[51, 0], [102, 128]]
    assert bytes_of_sum(Sum(own=own, bias=bias)).tolist() == [[38, 0], [64, 0]]
    assert bytes_of_sum(Sum(rows=values[1:])).tolist() == [[102, 128]]
    assert bytes_of_sum(Sum(Gathered(values, torch.zeros((0, 1), dtype=torch.int64)))).shape == (0, 2)


@pytest.mark.parametrize(("gathers", "columns", "channels"), [(3, 5, 70), (1, 0, 64), (2, 4, 32), (0, 11, 33)])
def test_many_sums_equal_those_of_torch(gathers: int, columns: int, channels: int) -> None:
    g = generator()
    values, weight = torch.randn(500, channels, generator=g) * 0.3, torch.randn(columns, channels, generator=g)
    indices, own = torch.randint(0, 500, (3001, gathers), generator=g), torch.randn(3001, columns, generator=g) * 0.1
    shares, bias = torch.rand(3001, gathers, generator=g), torch.randn(channels, generator=g) * 0.1
    found = bytes_of_sum(Sum(Gathered(values, indices, shares), Own(own, weight), bias=bias))
    expected = ((values[indices] * shares[:, :, None]).sum(dim=1) + own @ weight + bias) * 255.0
    assert found.shape == (3001, channels)
    assert (found.float() - expected.clamp(0.0, 255.0)).abs().max() < 0.51


def largest(made: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """Of each segment of rows; 0 in empty ones."""
    none = made.new_zeros(1, made.shape[1])
    return torch.stack([torch.cat([none, made[a:z]]).amax(0) for a, z in pairwise(offsets.tolist())])


def test_largest_of_segments() -> None:
    rows = torch.tensor([[1.0, 200.0], [3.0, 100.0], [255.0, 0.0], [0.0, 7.0]]) / 255.0
    none = Layers.of([], to_floats=False)
    offsets = torch.tensor([0, 2, 2, 4])
    assert largest_of_sum(Sum(rows=rows), none, torch.ones(2), offsets).tolist() == [[3, 200], [0, 0], [255, 7]]
    assert largest_of_sum(Sum(rows=rows[:0]), none, torch.ones(2), torch.zeros(1, dtype=torch.int64)).shape == (0, 2)


def whole(outputs: int, inputs: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A weight that bytes hold exactly, of which a byte of 1 stands for 1, and a bias."""
    g = generator()
    weight = torch.randint(-127, 128, (outputs, inputs), generator=g).float()
    weight[:, 0] = 127.0
    return weight, torch.randn(outputs, generator=g)


@pytest.mark.parametrize(("outputs", "inputs", "rows"), [(40, 64, 300), (32, 33, 1), (1, 4, 96), (130, 7, 97)])
def test_products_of_bytes_are_exact(outputs: int, inputs: int, rows: int) -> None:
    weight, bias = whole(outputs, inputs)
    given = torch.randint(0, 256, (rows, inputs), generator=generator()).float()
    given[0, 0] = 255.0  # so that a byte of the rows stands for 1
    expected = given.double() @ weight.t().double() + bias
    found = floats_of_rows(given, Layers.of([rounded(weight, bias)], to_floats=True), outputs, rectified=False)
    torch.testing.assert_close(found.double(), expected, rtol=1e-6, atol=0.05)
    found = floats_of_sum(
        Sum(rows=given / 255.0), Layers.of([rounded(weight / 1e4, bias)], to_floats=True), outputs
    )  # fmt: skip
    expected = (given.double() / 255.0 @ weight.t().double() / 1e4 + bias).clamp(min=0.0)
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-5)


def test_bytes_between_layers_are_rounded() -> None:
    (first, added), (second, bias) = whole(48, 40), whole(20, 48)
    given = torch.randint(0, 256, (1000, 40), generator=generator()).float() / 255.0
    first, second = first / 1e4, second / 1e4
    between = ((given @ first.t() + added) * 255.0).clamp(0.0, 255.0).add(0.5).floor() / 255.0
    expected = ((between @ second.t() + bias) * 255.0).clamp(0.0, 255.0)
    offsets = torch.tensor([0, 0, 7, 300, 301, 1000])
    layers = Layers.of([rounded(first, added), rounded(second, bias)], to_floats=False)
    found = largest_of_sum(Sum(rows=given), layers, torch.ones(20), offsets)
    assert found.max() == 255 and (found[1:] > 0).any() and (found[0] == 0).all()
    assert (found.float() - largest(expected, offsets)).abs().max() < 0.6  # where a sum is just on an edge


def test_rows_of_nothing_and_no_rows_pass() -> None:
    weight, bias = whole(8, 8)
    layers = Layers.of([rounded(weight, bias)], to_floats=True)
    assert torch.equal(floats_of_rows(torch.zeros(2, 8), layers, 8, rectified=False), bias.expand(2, 8))
    assert floats_of_rows(torch.zeros(0, 8), layers, 8, rectified=True).shape == (0, 8)


_ON_A_PROCESSOR = """
import torch
from regnet_core.nn.int8 import rounded
from regnet_core.ops import byte_products
from regnet_core.ops.bytes import Layers, Sum, floats_of_sum
g = torch.Generator().manual_seed(0)
layers = [rounded(torch.randn(b, a, generator=g), torch.zeros(b)) for a, b in ((70, 50), (50, 40))]
made = floats_of_sum(Sum(rows=torch.rand(200, 70, generator=g)), Layers.of(layers, to_floats=True), 40)
print(byte_products.has_byte_products(), byte_products.COLUMNS, float(made.double().sum()))
"""
_AVX = "+avx,+avx2,+fma,+avxvnni"


@pytest.mark.parametrize("features", ["", pytest.param(_AVX, marks=pytest.mark.skipif(
    not binding.get_host_cpu_features().get("avxvnni"), reason="this processor has no AVX-VNNI"
))])  # fmt: skip
def test_every_kind_of_processor_comes_to_the_same(features: str, tmp_path: Path) -> None:
    def answer(**settings: str) -> list[str]:
        env = {**os.environ, **settings}
        done = subprocess.run(
            [sys.executable, "-c", _ON_A_PROCESSOR], env=env, capture_output=True, text=True, timeout=200
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    here = answer()
    there = answer(NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES=features, NUMBA_CACHE_DIR=str(tmp_path))
    assert there[:2] == [str(bool(features)), "16"]
    assert float(there[2]) == pytest.approx(float(here[2]), rel=1e-6)


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
        assert torch.equal(mlp(rows), expected) and torch.equal(copied(rows), found)


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
