"""Says what works on this machine."""
