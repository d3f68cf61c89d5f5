"""Volumes as scans: readers of grids of voxels, resampling into the HCP grid, the points where values pass an iso value."""
