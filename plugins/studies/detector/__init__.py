"""Speed against error of the detector's settings."""
