"""Track: model-predictive control of the whole robot along a reference, and its simulation."""
