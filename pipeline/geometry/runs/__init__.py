"""Points as runs of cells of the hexagonal close packed grid: DuoDecim (Krueger et al. 2006), section 2."""
