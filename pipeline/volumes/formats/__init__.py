"""Readers of volumes, one a format."""
