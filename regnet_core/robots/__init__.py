"""Robot arms: models, inverse kinematics, the calibration of the selection policy, and a simulated work cell."""
