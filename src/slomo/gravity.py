"""The one value of g."""

GRAVITY = 9.81  # m/s^2
