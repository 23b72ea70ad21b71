"""Rendered clips of a procedural animal with known truth: a test tool, and the embedded clip of the demo."""
