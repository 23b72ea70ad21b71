"""The learned prior: small networks, trained on our own renderings, that see view, parts, surface and key points."""
