"""Differences between a rendered colour and the one that a camera reports."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from regnet_core.checks import check_range


@dataclass(frozen=True)
class ColourNoise:
    """Strength of each effect; all are off by default. Plausible: 4 levels, 0.15 and 0.05.

    Attributes:
        pixel: standard deviation of every channel of every pixel [of 255 levels].
        brightness: standard deviation of the logarithm of the exposure, one for a view.
        white_balance: standard deviation of the logarithm of each channel's gain, one for a view.

    Raises:
        InvalidInputError: a number is negative.
    """

    pixel: float = 0.0
    brightness: float = 0.0
    white_balance: float = 0.0

    def __post_init__(self) -> None:
        for name in ("pixel", "brightness", "white_balance"):
            check_range(f"ColourNoise.{name}", getattr(self, name), 0.0)


def add_colour_noise(colours: NDArray[np.uint8], noise: ColourNoise, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The colours (..., 3) of one view as a camera would report them."""
    gain = np.exp(noise.brightness * rng.standard_normal() + noise.white_balance * rng.standard_normal(3))
    noisy = colours * gain + noise.pixel * rng.standard_normal(colours.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)
