"""Measurements of a rig before it is used: lens and scale, the skin's crop, the tool's tip."""
