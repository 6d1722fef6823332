"""Levels left out of training, and other skins."""
