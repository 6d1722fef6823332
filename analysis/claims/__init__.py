"""Claims about a campaign: what its trials show of them so far, and which trial tells most next."""
