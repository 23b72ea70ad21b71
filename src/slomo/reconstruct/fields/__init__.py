"""The neural model of the body: a signed distance and colour field at rest, neural blend skinning, volume rendering."""
