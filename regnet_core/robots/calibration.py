"""The paper's calibration of the selection policy, for a robot: reach samples and executed grasps to a policy file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from regnet_core.policies import PolicyFile
from regnet_core.policy import AnalyticPolicy
from regnet_core.robots import reach, trials
from regnet_core.robots.fits import GraspFit, ReachFit, Samples, fit_grasp, fit_reach
from regnet_core.robots.model import get_robot
from regnet_core.robots.reach import ReachSamples, ReachSettings
from regnet_core.robots.trials import Trials, TrialSettings


@dataclass(frozen=True, eq=False)
class Calibration:
    """Both experiments with one robot, and the curves through them.

    Attributes:
        robot: its name.
        quality: which s_q the second curve is over, "predicted" or "true".
        reach_samples, trials: what was tried.
        reach, grasp: the fits.
        origin: the settings, as plain values.
    """

    robot: str
    quality: str
    reach_samples: ReachSamples
    trials: Trials
    reach: ReachFit
    grasp: GraspFit
    origin: dict[str, Any]

    @property
    def file(self) -> PolicyFile:
        """The policy file with the fitted constants."""
        policy = AnalyticPolicy(
            quality_gain=_rounded(self.grasp.gain),
            quality_offset=_rounded(self.grasp.offset),
            slope=_rounded(self.reach.slope),
            midpoint=_rounded(self.reach.midpoint),
        )
        errors = {
            "quality_gain": _rounded(self.grasp.gain_error),
            "quality_offset": _rounded(self.grasp.offset_error),
            "slope": _rounded(self.reach.slope_error),
            "midpoint": _rounded(self.reach.midpoint_error),
        }
        return PolicyFile(policy, errors, self.origin)


def calibrate(
    reach_settings: ReachSettings,
    trial_settings: TrialSettings,
    reach_samples: ReachSamples,
    executed: Trials,
    quality: str = "predicted",
) -> Calibration:
    """Fit both curves.

    Args:
        reach_settings, trial_settings: of the experiments, for the record.
        reach_samples: of `reach.sample_reach`.
        executed: of `trials.execute_grasps`.
        quality: "predicted": s_q as the policy will be given it; "true": the antipodal score on the true meshes, which
            depends on no detector.

    Raises:
        FitError: the samples do not determine a curve.
        InvalidInputError: there is no such quality.
    """
    robot = get_robot(reach_settings.robot)
    origin = {
        "robot": robot.title,
        "reach": {**reach.describe(reach_settings), "reached": reach_samples.counts.get(reach.REACHED, 0)},
        "grasp": {**trials.describe(trial_settings, quality), "held": int(executed.held.sum())},
    }
    return Calibration(
        robot=robot.name,
        quality=quality,
        reach_samples=reach_samples,
        trials=executed,
        reach=fit_reach(Samples.of(reach_samples.vertical_score, reach_samples.reached)),
        grasp=fit_grasp(Samples.of(executed.quality(quality), executed.held)),
        origin=origin,
    )


def _rounded(value: float) -> float:
    """As many digits as the paper's constants have."""
    return round(value, 4)
