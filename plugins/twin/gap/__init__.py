"""Networks that a twin has trained, tested on the rig that it imitates."""
