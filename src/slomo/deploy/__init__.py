"""Deploy: the tracking loop on a robot, or on its twin: wire format, transport, safety supervisor, log."""
