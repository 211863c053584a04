"""Objects: families of shapes, the library drawn from them, and meshes of the user's own."""
