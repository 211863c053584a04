"""The names of the robots, for those who list them without loading their models."""

ROBOT_NAMES = ("baxter", "baxter_left", "panda")
"""Keys of `model.ROBOTS`."""
