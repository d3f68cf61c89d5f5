"""From a scan or a volume to points, and from points to runs of cells."""
