"""slomo: from a casual video of an animal or a person to a motion that a legged robot performs."""

__version__ = "0.1.0"
