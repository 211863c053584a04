"""An open bin on a table, from which things are picked."""

from dataclasses import dataclass

import numpy as np

from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box


@dataclass(frozen=True)
class Bin:
    """A floor and four walls.

    Attributes:
        inside: the space between the walls, from the floor up to their rim, in the world [m].
        boxes: the floor and the four walls.
    """

    inside: Box
    boxes: tuple[Box, ...]


@dataclass(frozen=True)
class BinConfig:
    """Least and largest sizes of a bin [m].

    Attributes:
        length, width, height: of the inside.
        wall: thickness of the walls and the floor.

    Raises:
        InvalidInputError: a size is not positive, or a range is empty.
    """

    length: tuple[float, float] = (0.35, 0.45)
    width: tuple[float, float] = (0.25, 0.35)
    height: tuple[float, float] = (0.08, 0.15)
    wall: float = 0.01

    def __post_init__(self) -> None:
        check_range("BinConfig.wall", self.wall, 0.001)
        for name in ("length", "width", "height"):
            low, high = getattr(self, name)
            check_range(f"BinConfig.{name}", low, 0.01)
            check_range(f"BinConfig.{name}", high, 0.01)
            if low > high:
                raise InvalidInputError(f"BinConfig.{name} is (least, largest), got ({low:g}, {high:g})")


def sample_bin(rng: np.random.Generator, table: Box, config: BinConfig = BinConfig()) -> Bin:
    """A bin of random size in the middle of the table's top, its longer side along x or y."""
    size = np.array([rng.uniform(*config.length), rng.uniform(*config.width)])
    if rng.uniform() < 0.5:
        size = size[::-1]
    middle = 0.5 * (np.array(table.lower) + table.upper)[:2]
    return make_bin(middle - 0.5 * size, middle + 0.5 * size, table.upper[2], rng.uniform(*config.height), config.wall)


def make_bin(lower: np.ndarray, upper: np.ndarray, ground: float, height: float, wall: float) -> Bin:
    """A bin whose inside spans lower to upper, each (2,) in x and y, and that stands on z = ground [m]."""
    (x0, y0), (x1, y1) = lower.tolist(), upper.tolist()
    floor = ground + wall
    rim = floor + height
    return Bin(
        inside=Box((x0, y0, floor), (x1, y1, rim)),
        boxes=(
            Box((x0 - wall, y0 - wall, ground), (x1 + wall, y1 + wall, floor)),
            Box((x0 - wall, y0 - wall, floor), (x0, y1 + wall, rim)),
            Box((x1, y0 - wall, floor), (x1 + wall, y1 + wall, rim)),
            Box((x0, y0 - wall, floor), (x1, y0, rim)),
            Box((x0, y1, floor), (x1, y1 + wall, rim)),
        ),
    )
