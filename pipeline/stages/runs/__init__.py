"""Stages that make runs of a scan's points: grid, cells, codes, and the decoded cells as points."""
