"""Only the effects that a scene calls for: each measured before it is computed, stored, compiled or drawn."""

from __future__ import annotations


def plan_effects(*arguments, **options):
    """See `pipeline.effects.plan.plan.plan_effects`: measures and request -> the plan."""
    from pipeline.effects.plan.plan import plan_effects as plan  # effects import this package, so not before they do

    return plan(*arguments, **options)
