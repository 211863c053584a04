"""Errors of regnet_core: one base class, and one class for each kind of bad input."""


class RegnetError(Exception):
    """Base class of every error that regnet_core raises on purpose."""


class InvalidInputError(RegnetError, ValueError):
    """The caller gave something that cannot be used; the message says what and what would be right."""


class CloudError(InvalidInputError):
    """The point cloud has the wrong shape or type."""


class BagError(CloudError):
    """A recording cannot be read, or does not hold what is wanted."""


class GripperError(InvalidInputError):
    """A dimension of the gripper is outside the range that is supported."""


class ModelError(InvalidInputError):
    """The model or device that was asked for does not exist here."""
