"""Labels of stored trials: made, held against the truth, read with people's decisions."""
