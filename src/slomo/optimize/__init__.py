"""Contact-implicit trajectory optimisation of the point-foot model."""
