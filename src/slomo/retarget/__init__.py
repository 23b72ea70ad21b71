"""From the key points of a creature to the key points of a robot: scale, heading, names, grounded feet."""
