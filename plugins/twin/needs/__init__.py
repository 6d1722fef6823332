"""Needs of a scene: effects that a pilot shows, and the cheapest scene that has them."""
