"""Speed against error over a grid of settings."""
