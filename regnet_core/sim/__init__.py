"""Physics: scenes in MuJoCo, and a free-floating parallel gripper that tries grasps in them."""
