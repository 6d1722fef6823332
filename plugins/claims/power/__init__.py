"""How many trials the claims of a protocol need, by campaigns that are drawn from a pilot."""
