"""Puts the network of a training run among the published ones, and draws the run's curves.

python tools/publish_weights.py out/run --as regnetv2-s --as regnetv2-s-layer2 [--picture docs/training_regnetv2-s.png]
python tools/publish_weights.py out/gpd-12 --as gpd-12

Networks that differ only in where their positive points come from (layer1, layer2, layer3) learn the same: positive
points are drawn by their true confidence in training. So one run gives the weights of all of them.
"""

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from regnet_core.baselines import LEARNED
from regnet_core.baselines.files import load_weights, save_weights
from regnet_core.baselines.zoo import method
from regnet_core.nn.files import load_network, save_network
from regnet_core.nn.network import RegNet
from regnet_core.nn.zoo import network_config
from regnet_core.training.trainer import WEIGHTS

FOLDER = Path(__file__).parents[1] / "regnet_core" / "weights"
Curves = tuple[tuple[str, dict[str, str]], ...]
CURVES: Curves = (
    ("Score Network: loss (2)", {"score": "point confidence"}),
    ("Class of anchors and proposals", {"grasp/classification": "GRN", "refined 2/classification": "RN, second pass"}),
    ("Place of the grasp", {"grasp/centre": "GRN", "refined 1/centre": "RN", "refined 2/centre": "RN, second pass"}),
    ("Quality", {"grasp/quality": "GRN", "refined 1/quality": "RN", "refined 2/quality": "RN, second pass"}),
    ("True quality of the network's own grasps", {"judged": "mean of all regions, all widths"}),
)
CLASSIFIER_CURVES: Curves = (
    ("Cross entropy", {"total": "training", "validation/loss": "validation"}),
    ("Share that is told rightly", {"accuracy": "training", "validation/accuracy": "validation"}),
)
S4G_CURVES: Curves = (
    ("Class of the score", {"score": "training", "validation/score": "validation"}),
    ("Rotation", {"rotation": "training", "validation/rotation": "validation"}),
    ("Offset", {"offset": "training", "validation/offset": "validation"}),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a run of `regnet train`")
    parser.add_argument("--as", dest="names", action="append", required=True, help="of nn/zoo.py or baselines/zoo.py")
    parser.add_argument("--picture", type=Path, help="where to draw the curves")
    parser.add_argument("--folder", type=Path, default=FOLDER)
    arguments = parser.parse_args()
    for name in arguments.names:
        path = publish(arguments.run / WEIGHTS, name, arguments.folder)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    if arguments.picture is not None:
        draw(arguments.run / "log.jsonl", arguments.picture, curves_of(arguments.names[0]))
        print(arguments.picture)


def publish(weights: Path, name: str, folder: Path) -> Path:
    """Write the weights under the name of a network that learns the same, and note its checksum."""
    path = folder / f"{name}.safetensors"
    folder.mkdir(parents=True, exist_ok=True)
    if name in LEARNED:
        baseline = method(name).network()
        save_weights(path, name, baseline, load_weights(weights, name, baseline))
    else:
        save_network(path, *_network_as(weights, name))
    lines = [f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.name}\n" for p in sorted(folder.glob("*.safetensors"))]
    (folder / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")
    return path


def _network_as(weights: Path, name: str) -> tuple[RegNet, dict[str, Any]]:
    """The trained network under another name, and its card."""
    trained, card = load_network(weights)
    network = RegNet(network_config(name))
    same = trained.config.replace(name=name, layer=network.config.layer, spacing=network.config.spacing)
    if network.config != same:
        raise SystemExit(f"'{weights}' is of '{trained.config.name}', which learns something else than '{name}'")
    network.load_state_dict(trained.state_dict())
    return network, card


def curves_of(name: str) -> Curves:
    """What is drawn of a run of the network or baseline of that name."""
    if name in LEARNED:
        return S4G_CURVES if name == "s4g" else CLASSIFIER_CURVES
    return CURVES


def draw(log: Path, picture: Path, curves: Curves = CURVES) -> None:
    """Draw a run's curves: every step faintly, the mean of a hundredth of the run strongly."""
    steps: list[dict[str, Any]] = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    figure, axes = plt.subplots(1, len(curves), figsize=(3.2 * len(curves), 2.9), constrained_layout=True)
    for axis, (title, names) in zip(axes, curves, strict=True):
        for name, label in names.items():
            _curve(axis, [(s["step"], s[name]) for s in steps if name in s], label)
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("step", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25)
        axis.legend(fontsize=7, frameon=False)
        axis.set_ylim(bottom=0.0)
    figure.savefig(picture, dpi=130)


def _curve(axis: Axes, values: list[tuple[int, float]], label: str) -> None:
    if not values:
        return
    step, value = np.array(values, np.float64).T
    (line,) = axis.plot(step, value, lw=0.4, alpha=0.2)
    window = max(len(step) // 100, 1)
    means = np.convolve(value, np.ones(window) / window, mode="valid")
    axis.plot(step[window - 1 :], means, lw=1.6, color=line.get_color(), label=label)


if __name__ == "__main__":
    main()
