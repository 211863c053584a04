"""Three depth cameras: nominal intrinsics and noise, with the source of each number.

"Plausible" means chosen to look like the device's images, not measured.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from regnet_core.data.cameras.camera import KINECT_V1, KINECT_V2, REALSENSE_D435, Intrinsics
from regnet_core.data.cameras.noise import AxialNoise, DepthNoise


@dataclass(frozen=True)
class Sensor:
    """A depth camera.

    Attributes:
        name: its key in SENSORS.
        intrinsics: of its depth image.
        noise: of its depth.
    """

    name: str
    intrinsics: Intrinsics
    noise: DepthNoise


KINECT_V1_NOISE = DepthNoise(
    # Nguyen, Izadi, Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012:
    # sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 + 0.0001 / sqrt(z) theta^2 / (pi/2 - theta)^2 [m], here multiplied out.
    axial_model=AxialNoise(
        constant=1.2 + 1.9 * 0.4**2, linear=-1.9 * 2.0 * 0.4, quadratic=1.9, slant=0.1, slant_power=-0.5
    ),
    lateral=0.8,  # Nguyen et al. 2012: 0.8 pixel, and 0.035 theta / (pi/2 - theta) more on slanted surfaces
    correlation=1.0,  # plausible: it matches patches of 9 x 9 pixels
    quantum=0.001,  # the driver reports whole millimetres
    disparity=580.0 * 0.075,  # nominal focal length and baseline
    # 1/8 pixel, 0.0029 / m of inverse depth: Konolige, Mihelich, "Technical description of Kinect calibration";
    # OpenKinect's fit to the raw values of a device, 0.0031 / m, agrees.
    disparity_step=0.125,
    near=0.5,
    far=4.0,  # Microsoft: 0.8 to 4.0 m in the default mode; drivers report depths from 0.5 m
    grazing=np.radians(75.0),  # plausible
    edge_width=1,  # plausible, as all shares that follow
    edge_loss=0.45,
    edge_flying=0.03,
    edge_bleeding=0.12,
    dropout=0.002,
)
"""Microsoft Kinect v1, structured light."""

REALSENSE_D435_NOISE = DepthNoise(
    # Intel, "Tuning depth cameras for best performance": RMS error = z^2 subpixel / (f baseline). Baseline 0.05 m;
    # subpixel error 0.08: A. Grunnet-Jepsen of Intel, in issue 3904 of librealsense ("best to use about 0.08").
    axial_model=AxialNoise(
        constant=0.0, linear=0.0, quadratic=1000.0 * 0.08 / (385.0 * 0.05), slant=0.0, slant_power=0.0
    ),
    lateral=0.6,  # plausible
    correlation=1.5,  # plausible: patches and the filters of the chip
    quantum=0.001,  # the driver's default depth unit
    disparity=385.0 * 0.05,
    disparity_step=1.0 / 32.0,  # Intel, "Subpixel linearity improvement for RealSense depth camera D400 series"
    near=0.2,
    far=4.0,  # plausible: the data sheet says 0.195 m at 640 x 480 and "up to 10 m", where the noise is 40 cm
    grazing=np.radians(82.0),  # plausible
    edge_width=2,  # plausible, as all shares that follow
    edge_loss=0.2,
    edge_flying=0.15,
    edge_bleeding=0.35,
    dropout=0.004,
)
"""Intel RealSense D435, active stereo, at 640 x 480."""

SENSORS: Mapping[str, Sensor] = MappingProxyType(
    {
        sensor.name: sensor
        for sensor in (
            Sensor("kinect_v2", KINECT_V2, DepthNoise()),
            Sensor("kinect_v1", KINECT_V1, KINECT_V1_NOISE),
            Sensor("realsense_d435", REALSENSE_D435, REALSENSE_D435_NOISE),
        )
    }
)
"""Every sensor by name."""
