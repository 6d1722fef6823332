"""Windows of events: how they are cut, stored and chosen."""
