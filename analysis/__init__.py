"""Pure functions from recordings to labels, spikes, detections and figures."""
