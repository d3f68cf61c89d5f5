"""Stages from a volume to the points of its surfaces."""
