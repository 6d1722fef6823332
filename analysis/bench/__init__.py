"""An open bench of slip detectors: their interface, their figures, and those that ship."""
