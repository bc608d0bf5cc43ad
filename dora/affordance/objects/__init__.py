"""Objects as data: bundled ones, meshes of users, and their convex pieces and distance fields."""
