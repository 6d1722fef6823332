"""What it means: pure functions from recordings to labels, spikes, detections and figures."""
