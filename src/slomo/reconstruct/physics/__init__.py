"""Physics: a differentiable roll-out of the fitted body, and what the fit takes from it (PPR, Yang et al. 2023)."""
