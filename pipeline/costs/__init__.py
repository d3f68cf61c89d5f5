"""What a job of a size would cost: a model fitted to measured tasks, and a probe of the machine."""
