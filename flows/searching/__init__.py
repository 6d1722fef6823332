"""What accuracy costs: trade-offs of scene and detector, and what the scene's guesses decide."""
