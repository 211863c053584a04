"""Independent judges of grasps: collision and contacts on the true meshes of a scene; studies that compare methods."""
