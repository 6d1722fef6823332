"""What a scene needs: effects that a pilot shows, and the cheapest scene that has them."""
