"""Positions and normals as one number a splat, over a quadric that is fitted to each chunk."""
