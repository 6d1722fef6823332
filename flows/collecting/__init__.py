"""Collecting trials: sessions at a rig, requests from other terminals, checks between trials."""
