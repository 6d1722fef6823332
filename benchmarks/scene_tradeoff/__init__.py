"""Speed against error of the simulated scene."""
